"""What can be done next with a beam accelerometer in a chamber: feasible changes of the standard campaign."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bayescal_models.quartz_beam_accelerometer.campaign import Campaign
from bayescal_models.quartz_beam_accelerometer.simulator import simulated_columns


def _plan(campaign: Campaign) -> Callable[[], dict[str, Any]]:
    return lambda: simulated_columns(seed=0, campaign=campaign)


EXPERIMENTS = (
    ("the same again", _plan(Campaign())),
    (
        "ramps of 0.5 and 4 °C/min",
        _plan(Campaign(ramp_speeds=(0.5, 4.0), interval=120.0, average=120.0)),
    ),
    ("four tumbles", _plan(Campaign(repeats=4))),
    ("ramps at five attitudes", _plan(Campaign(attitudes=(1.0, 0.5, 0.0, -0.5, -1.0)))),
    (
        "held for two hours at each end of a ramp",
        _plan(Campaign(hold=7200.0, interval=120.0, average=120.0)),
    ),
    ("a minute without power between runs", _plan(Campaign(pause=60.0))),
)
