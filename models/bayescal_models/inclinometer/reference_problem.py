"""The reference problem of zero offsets over placement angles; what one is for stands in `bayescal_models`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import bayescal as bc
from bayescal_models.inclinometer.campaign import VERIFICATION, Campaign
from bayescal_models.inclinometer.model import INSTRUMENT, simulate

# ±45° by 15°, forward and backward, two mountings of each axis: 56 rows.
CAMPAIGN = Campaign(angles=tuple(float(a) for a in range(-45, 46, 15)))
ON_TILT = ("zero.electrical_tilt", "zero.exact_placement", "scale.constant")

model = INSTRUMENT.baseline
"""The baseline, a line for each axis; its priors are proper as they stand."""


def readings(seed: int = 0) -> bc.Measurements:
    """56 zero offsets, arcsec, of source 4's two lines, in which nothing else is hidden."""
    return simulate(seed=seed, campaign=CAMPAIGN)


def hidden(effects: Mapping[str, float], seed: int) -> bc.Measurements:
    """The zero test with effects hidden in it; a verification where they are effects on tilt."""
    tilted = any(name in ON_TILT for name in effects)
    campaign = replace(VERIFICATION, runs=2) if tilted else Campaign()
    return simulate(effects, seed=seed, campaign=campaign)
