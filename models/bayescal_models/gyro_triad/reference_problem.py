"""The reference problem: small, with proper priors; intervals must cover on it, and methods agree.

    model, readings = reference_problem.model(), reference_problem.readings()

`reference_posterior.json` holds its posterior for `readings(seed=0)`, by long NUTS.
"""

from __future__ import annotations

from collections.abc import Mapping

import bayescal as bc
from bayescal_models.gyro_triad.campaign import Campaign
from bayescal_models.gyro_triad.model import INSTRUMENT, simulate

CAMPAIGN = Campaign(mountings=("x", "y", "z"))


def model() -> bc.Model:
    """The baseline: bias, scale factors, six misalignments, and the mountings' errors."""
    return INSTRUMENT.baseline()


def readings(seed: int = 0) -> bc.Measurements:
    """Five rates in three mountings known to 1 mrad, in which nothing else is hidden."""
    return simulate(seed=seed, campaign=CAMPAIGN)


def hidden(effects: Mapping[str, float], seed: int) -> bc.Measurements:
    """Two sessions over temperature with effects hidden in them.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficients.
        seed: of every random number.
    """
    return simulate(effects, seed=seed, campaign=Campaign(temperatures=(-20.0, 25.0, 70.0), runs=2))
