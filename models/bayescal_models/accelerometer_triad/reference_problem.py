"""The reference problem: small, with proper priors; intervals must cover on it, and methods agree.

    model, readings = reference_problem.model(), reference_problem.readings()

`reference_posterior.json` holds its posterior for `readings(seed=0)`, by long NUTS.
"""

from __future__ import annotations

import bayescal as bc
from bayescal_models.accelerometer_triad.campaign import Campaign
from bayescal_models.accelerometer_triad.model import INSTRUMENT, simulate

CAMPAIGN = Campaign()


def model() -> bc.Model:
    """The baseline: bias, scale factors and three misalignments."""
    return INSTRUMENT.baseline()


def readings(seed: int = 0) -> bc.Measurements:
    """24 poses at 0.5 mg, in unknown directions, in which nothing else is hidden."""
    return simulate(seed=seed, campaign=CAMPAIGN)
