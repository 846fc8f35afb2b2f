"""What can be done next on the dividing table: feasible changes of the zero test."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bayescal_models.inclinometer.campaign import Campaign
from bayescal_models.inclinometer.simulator import simulated_columns


def _plan(campaign: Campaign) -> Callable[[], dict[str, Any]]:
    return lambda: simulated_columns(seed=0, campaign=campaign)


EXPERIMENTS = (
    ("the same again", _plan(Campaign())),
    ("four mountings of each axis", _plan(Campaign(runs=4))),
    ("±75° by 5°", _plan(Campaign(angles=tuple(float(a) for a in range(-75, 76, 5))))),
    ("±45° by 1°", _plan(Campaign(angles=tuple(float(a) for a in range(-45, 46))))),
    ("forward sweeps alone", _plan(Campaign(backward=False))),
    ("the laboratory's temperature varied by 8 °C", _plan(Campaign(swing=8.0))),
    ("ten minutes at each angle", _plan(Campaign(interval=600.0))),
)
