"""A tone that an output's sampling folds and the temperature moves is found, and none where there is none."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal._model.summed_noise import over_octaves
from bayescal._search.noise_laws import on_residuals
from bayescal_models import still_sensor

STEP, ROWS = 0.5, 3000
MIDDLE, SLOPE, BEND = 0.95, 0.35, -0.1  # Hz; it folds at 1 Hz


def evidence(amplitude: float, seed: int) -> tuple[float, dict[str, float]]:
    """Log Bayes factor of a tone beside white and Ornstein–Uhlenbeck noise of one unit, and its parameters."""
    random = np.random.default_rng(seed)
    time = STEP * np.arange(ROWS)
    z = np.sin(time / 150)  # twice from one end of its range to the other
    turns = np.cumsum(MIDDLE + SLOPE * z + BEND * z**2) * STEP
    phase = np.cumsum(0.2 * random.standard_normal(ROWS))  # forgotten within tens of readings
    output = amplitude * np.sqrt(2) * np.cos(2 * np.pi * turns + phase)
    output += random.standard_normal(ROWS)
    data = bc.Measurements.from_arrays(
        still_sensor.INSTRUMENT,
        units={"output": "ug"},
        time=time,
        temperature=20 + 30 * z,
        output=output,
    )
    model = still_sensor.INSTRUMENT.for_readings(data).baseline()
    fit = bc.fit(model, data, bc.LeastSquares(draws=20))
    left, scale = bc.predict(fit).residual, model.noise.parameters()["noise.white"]
    sums = {
        terms: over_octaves(
            scale, STEP, ROWS * STEP, terms, "temperature" if "tone" in terms else ""
        )
        for terms in (("correlated",), ("correlated", "tone"))
    }
    plain, with_it = (on_residuals(law, fit.problem.record.of_noise(left)) for law in sums.values())
    priors = sums["correlated", "tone"].parameters()
    values = {name: float(priors[name].value(v)) for name, v in with_it.hint.items()}
    return with_it.log_evidence - plain.log_evidence, values


@pytest.mark.slow
def test_a_folded_tone_that_moves_is_found_with_its_frequency() -> None:
    gain, values = evidence(0.8, seed=2)
    assert gain > 100
    z = np.linspace(-1, 1, 21)
    found = values["noise.tone.frequency"] + values["noise.tone.slope"] * z
    found = np.cos(2 * np.pi * STEP * (found + values["noise.tone.bend"] * z**2))
    np.testing.assert_allclose(
        found, np.cos(2 * np.pi * STEP * (MIDDLE + SLOPE * z + BEND * z**2)), atol=0.05
    )
    assert values["noise.tone"] == pytest.approx(0.8, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, *(pytest.param(s, marks=pytest.mark.slow) for s in (4, 5))])
def test_none_is_found_in_white_noise(seed: int) -> None:
    assert evidence(0.0, seed)[0] < 0
