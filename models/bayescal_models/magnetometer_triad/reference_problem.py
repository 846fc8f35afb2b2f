"""The reference problem: small, with proper priors; intervals must cover on it, and methods agree.

    model, readings = reference_problem.model(), reference_problem.readings()

`reference_posterior.json` holds its posterior for `readings(seed=0)`, by long NUTS.
"""

from __future__ import annotations

import bayescal as bc
from bayescal_models.magnetometer_triad.campaign import Campaign
from bayescal_models.magnetometer_triad.model import INSTRUMENT, simulate

CAMPAIGN = Campaign(poses=40)


def model() -> bc.Model:
    """The baseline: bias, scale factors and three misalignments."""
    return INSTRUMENT.baseline()


def readings(seed: int = 0) -> bc.Measurements:
    """40 readings at 0.3 µT, in unknown directions, in which nothing else is hidden."""
    return simulate(seed=seed, campaign=CAMPAIGN)
