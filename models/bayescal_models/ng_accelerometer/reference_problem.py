"""Reference problem (see `bayescal_models`) of the ng accelerometer: 72 readings, with priors of a recalibration."""

from __future__ import annotations

from dataclasses import replace

import bayescal as bc
from bayescal_models.ng_accelerometer.campaign import INSTRUMENT_A
from bayescal_models.ng_accelerometer.model import INSTRUMENT

PRIORS = {
    "bias.constant": bc.Normal(850.0, 200.0),
    "bias.temperature": bc.Normal(10.0, 5.0),
    "scale.constant": bc.Normal(1500.0, 2000.0),
    "scale.temperature": bc.Normal(60.0, 100.0),
}
SD_PRIORS = {
    "bias.cell": bc.HalfNormal(5.0),
    "scale.cell": bc.HalfNormal(50.0),
    "fixture_tilt.cell": bc.HalfNormal(5.0),
    "base_tilt.cell": bc.HalfNormal(1.0),
}
NOISE = bc.White(bc.HalfNormal(1.0))
CAMPAIGN = replace(INSTRUMENT_A, temperatures=(20.0, 30.0, 40.0), runs=2, pause=2 * 3600.0)


def model() -> bc.Model:
    """Return the baseline with proper priors, as narrow as those of a recalibration."""
    return bc.Model(INSTRUMENT, tuple(_narrow_priors(e) for e in INSTRUMENT.effects), NOISE)


def readings(seed: int = 0) -> bc.Measurements:
    """Simulate 72 readings, µg: 12 positions at three temperatures in two runs."""
    return INSTRUMENT.simulate(seed=seed, campaign=CAMPAIGN)


def _narrow_priors(effect: bc.Effect) -> bc.Effect:
    coefficients = effect.coefficients
    if effect.name in PRIORS:
        coefficients = tuple(replace(c, prior=PRIORS[effect.name]) for c in coefficients)
    if effect.name in SD_PRIORS:
        coefficients = tuple(replace(c, group_sd=SD_PRIORS[effect.name]) for c in coefficients)
    return replace(effect, coefficients=coefficients)
