"""The reference problem of a device with two thermometers; what one is for stands in `bayescal_models`."""

from __future__ import annotations

from collections.abc import Mapping

import bayescal as bc
from bayescal_models.quartz_beam_accelerometer.campaign import Campaign
from bayescal_models.quartz_beam_accelerometer.model import INSTRUMENT, simulate

# Two tumbles over five temperatures and a ramp at each of three attitudes, a reading every ten minutes.
CAMPAIGN = Campaign(
    temperatures=(-40.0, -10.0, 20.0, 45.0, 70.0), interval=600.0, average=60.0, soak=3600.0
)

model = INSTRUMENT.baseline
"""The baseline, cubics of the head's temperature; its priors are proper as they stand."""


def readings(seed: int = 0) -> bc.Measurements:
    """Readings, µg, of a device that follows the baseline and in which nothing else is hidden."""
    return simulate(seed=seed, campaign=CAMPAIGN)


def hidden(effects: Mapping[str, float], seed: int) -> bc.Measurements:
    """The instrument's own campaign with effects hidden in it."""
    return simulate(effects, seed=seed)
