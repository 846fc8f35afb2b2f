"""What can be done next on the tilted table: feasible changes of instrument A's campaign."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bayescal_models.ng_accelerometer.campaign import Campaign
from bayescal_models.ng_accelerometer.simulator import simulated_columns
from bayescal_models.ng_accelerometer.sizes import DEGREE, HOUR

TILT = 0.45 * DEGREE
OVER = 180 * DEGREE - TILT


def _plan(campaign: Campaign) -> Callable[[], dict[str, Any]]:
    return lambda: simulated_columns(seed=0, campaign=campaign)


EXPERIMENTS = (
    ("the same again", _plan(Campaign())),
    ("twice as many runs", _plan(Campaign(runs=6))),
    ("every second run downwards", _plan(Campaign(alternate=True))),
    ("each cell at two tilts, 0.45° and 0.30°", _plan(Campaign(tilts=(TILT, 0.30 * DEGREE)))),
    ("each cell at 0.45° and −0.45°", _plan(Campaign(tilts=(TILT, -TILT)))),
    ("the face turned over in each cell", _plan(Campaign(tilts=(TILT, OVER)))),
    ("24 positions", _plan(Campaign(positions=24))),
    ("three hours' soak", _plan(Campaign(soak=3 * HOUR))),
    ("ten days between runs", _plan(Campaign(pause=240 * HOUR))),
    ("the laboratory's temperature varied by 3 °C", _plan(Campaign(laboratory_daily=3.0))),
)
