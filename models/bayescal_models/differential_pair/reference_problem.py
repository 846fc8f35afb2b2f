"""Reference problem (see `bayescal_models`) of the differential pair: four devices on an arm."""

from __future__ import annotations

import bayescal as bc
from bayescal_models.differential_pair.campaign import Campaign
from bayescal_models.differential_pair.model import INSTRUMENT

# Two outer and two inner devices, 16 readings each: 64 rows.
CAMPAIGN = Campaign(outer=2, inner=2, samples=16, thermometer=None)


def model() -> bc.Model:
    """Return the baseline with a half-normal prior of the noise, which excludes extreme noise."""
    return INSTRUMENT.baseline().with_noise(bc.White(bc.HalfNormal(50.0)))


def readings(seed: int = 0) -> bc.Measurements:
    """Simulate 64 readings, µg, of four devices on an arm that goes through six plateaus."""
    return INSTRUMENT.simulate(seed=seed, campaign=CAMPAIGN)
