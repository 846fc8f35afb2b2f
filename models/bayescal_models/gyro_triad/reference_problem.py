"""The reference problem of rates about three axes; what one is for stands in `bayescal_models`."""

from __future__ import annotations

from collections.abc import Mapping

import bayescal as bc
from bayescal_models.gyro_triad.campaign import Campaign
from bayescal_models.gyro_triad.model import INSTRUMENT, simulate

CAMPAIGN = Campaign(mountings=("x", "y", "z"))

model = INSTRUMENT.baseline
"""The baseline: bias, scale factors, six misalignments, and the mountings' errors."""


def readings(seed: int = 0) -> bc.Measurements:
    """Five rates in three mountings known to 1 mrad, in which nothing else is hidden."""
    return simulate(seed=seed, campaign=CAMPAIGN)


def hidden(effects: Mapping[str, float], seed: int) -> bc.Measurements:
    """Two sessions over temperature with effects hidden in them."""
    return simulate(effects, seed=seed, campaign=Campaign(temperatures=(-20.0, 25.0, 70.0), runs=2))
