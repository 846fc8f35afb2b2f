"""The reference problem of poses in unknown directions; what one is for stands in `bayescal_models`."""

from __future__ import annotations

from collections.abc import Mapping

import bayescal as bc
from bayescal_models.accelerometer_triad.campaign import Campaign
from bayescal_models.accelerometer_triad.model import INSTRUMENT, simulate
from bayescal_models.triad.campaign import TWO_SESSIONS

CAMPAIGN = Campaign()

model = INSTRUMENT.baseline
"""The baseline: bias, scale factors and three misalignments."""


def readings(seed: int = 0) -> bc.Measurements:
    """24 poses at 0.5 mg, in unknown directions, in which nothing else is hidden."""
    return simulate(seed=seed, campaign=CAMPAIGN)


def hidden(effects: Mapping[str, float], seed: int) -> bc.Measurements:
    """Two sessions over temperature with effects hidden in them, directions known to 0.5 mrad."""
    return simulate(effects, seed=seed, campaign=Campaign(**TWO_SESSIONS))
