"""The reference problem of a bias over temperature; what one is for stands in `bayescal_models`."""

from __future__ import annotations

from collections.abc import Mapping

import bayescal as bc
from bayescal_models.mems_gyro.campaign import Campaign
from bayescal_models.mems_gyro.model import INSTRUMENT, simulate

# Four runs over 30 to 80 °C, one reading a step: 44 rows.
CAMPAIGN = Campaign(average=300, runs=4)
TURNING = (0.0, 100.0, -100.0)  # °/s, rates of the table, without which no scale factor shows

model = INSTRUMENT.baseline
"""The baseline, a line over temperature; its priors are proper as they stand."""


def readings(seed: int = 0) -> bc.Measurements:
    """44 readings, °/s, of a gyro whose bias is a line and in which nothing else is hidden."""
    return simulate(seed=seed, campaign=CAMPAIGN)


def hidden(effects: Mapping[str, float], seed: int) -> bc.Measurements:
    """The instrument's own campaign with effects hidden in it, turning where they are effects on the scale."""
    turning = any(name.startswith("scale") for name in effects)
    return simulate(effects, seed=seed, campaign=Campaign(rate_input=TURNING if turning else None))
