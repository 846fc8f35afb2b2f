"""The reference problem: small, with proper priors; intervals must cover on it, and methods agree.

    model, readings = reference_problem.model(), reference_problem.readings()

`reference_posterior.json` holds its posterior for `readings(seed=0)`, by long NUTS.
"""

from __future__ import annotations

from collections.abc import Mapping

import bayescal as bc
from bayescal_models.quartz_beam_accelerometer.campaign import Campaign
from bayescal_models.quartz_beam_accelerometer.model import INSTRUMENT, simulate

# Two tumbles over five temperatures and a ramp at each of three attitudes, a reading every ten minutes.
CAMPAIGN = Campaign(
    temperatures=(-40.0, -10.0, 20.0, 45.0, 70.0), interval=600.0, average=60.0, soak=3600.0
)


def model() -> bc.Model:
    """The baseline, cubics of the head's temperature; its priors are proper as they stand."""
    return INSTRUMENT.baseline()


def readings(seed: int = 0) -> bc.Measurements:
    """Readings, µg, of a device that follows the baseline and in which nothing else is hidden."""
    return simulate(seed=seed, campaign=CAMPAIGN)


def hidden(effects: Mapping[str, float], seed: int) -> bc.Measurements:
    """The instrument's own campaign with effects hidden in it.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficient.
        seed: of every random number.
    """
    return simulate(effects, seed=seed)
