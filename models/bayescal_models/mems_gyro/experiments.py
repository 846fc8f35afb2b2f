"""What can be done next with a gyro in a chamber: feasible changes of the standard campaign."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bayescal_models.mems_gyro.campaign import Campaign
from bayescal_models.mems_gyro.simulator import simulated_columns


def _plan(campaign: Campaign) -> Callable[[], dict[str, Any]]:
    return lambda: simulated_columns(seed=0, campaign=campaign)


EXPERIMENTS = (
    ("the same again", _plan(Campaign())),
    ("twice as many runs", _plan(Campaign(runs=6))),
    ("steps four times as long", _plan(Campaign(dwell=1200.0, average=120.0))),
    ("steps of one minute", _plan(Campaign(dwell=60.0, average=10.0))),
    (
        "one temperature, held for an hour",
        _plan(Campaign(temperatures=(50.0, 55.0), dwell=3600.0, average=120.0)),
    ),
    ("every run upwards", _plan(Campaign(alternate=False))),
    ("power left on between runs for a minute", _plan(Campaign(pause=60.0))),
    ("six hours between runs", _plan(Campaign(pause=21600.0))),
    ("turned at ±100 °/s", _plan(Campaign(rate_input=(0.0, 100.0, -100.0)))),
)
