"""Noise in a sum that follows a column, its scatter or its tone: found where it is there, and with intervals."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import still_sensor
from tests.support.inside import Record, build_sum, fit_to_residuals, frame_of

SENSOR = still_sensor.instrument("ug", size=30.0, constant=300.0, span=20.0)
LEVEL = effects.constant("bias", 30.0, "ug", source="none")
STEP, TIME, DIFFUSION, WHITE, SLOPE = 1.0, 40.0, 0.3, 1.0, 0.7
TRUTH = {
    "noise.white": WHITE,
    "noise.slope": SLOPE,
    "noise.curvature": 0.0,
    "noise.correlated1.diffusion": DIFFUSION,
    "noise.correlated1.time": TIME,
}


def recorded(seed: int, slope: float, n: int = 1500) -> bc.Measurements:
    """Two rises of the temperature, so that it is no measure of the time."""
    random, z = np.random.default_rng(seed), -np.cos(4 * np.pi * np.arange(n) / n)
    kept, slow = np.exp(-STEP / TIME), np.empty(n)
    slow[0] = DIFFUSION * np.sqrt(TIME / 2) * random.standard_normal()
    fresh = DIFFUSION * np.sqrt(TIME / 2 * (1 - kept**2)) * random.standard_normal(n)
    for i in range(1, n):
        slow[i] = kept * slow[i - 1] + fresh[i]
    output = 5.0 + slow + WHITE * np.exp(slope * z) * random.standard_normal(n)
    return bc.Measurements.from_arrays(
        SENSOR, time=STEP * np.arange(n), temperature=40 + 20 * z, output=output
    )


def law(scatter: str = "temperature") -> bc.SummedNoise:
    return build_sum(bc.HalfCauchy(1.0), STEP, 1500.0, ("correlated",), scatter=scatter)


def gain(readings: bc.Measurements) -> float:
    """Log evidence of the scatter, over the same sum without it, nats."""
    frame = frame_of(readings)
    record = Record(SENSOR, frame, np.asarray(readings["output"]))
    left = readings["output"] - readings["output"].mean()
    with_it, without = (fit_to_residuals(x, record.residual_record(left)) for x in (law(), law("")))
    return with_it.log_evidence - without.log_evidence


def test_readings_are_whitened_by_the_dense_covariance(rng) -> None:
    readings = recorded(1, SLOPE, n=60)
    frame = frame_of(readings).sort_by_time()
    values: dict[str, Any] = {n: jnp.asarray(v) for n, v in TRUTH.items()}
    values["noise.curvature"] = jnp.asarray(-0.4)
    time, t = np.asarray(frame["time"]), readings["temperature"]
    z = 2 * (t - t.min()) / np.ptp(t) - 1
    own = WHITE**2 * np.exp(2 * (SLOPE * z - 0.4 * (1.5 * z**2 - 0.5)))
    dense = DIFFUSION**2 * TIME / 2 * np.exp(-np.abs(time[:, None] - time) / TIME) + np.diag(own)
    np.testing.assert_allclose(law().variance(values, frame), np.diag(dense), 1e-12)
    columns = rng.standard_normal((60, 2))
    white, log_sd = law().whiten(jnp.asarray(columns), 0.0, values, frame)
    np.testing.assert_allclose(white, np.linalg.solve(np.linalg.cholesky(dense), columns), 1e-8)
    assert 2 * float(log_sd.sum()) == pytest.approx(np.linalg.slogdet(dense)[1], abs=1e-9)


@pytest.mark.slow
def test_evidence_favours_scatter_only_where_it_is_present() -> None:
    assert gain(recorded(2, SLOPE)) > 20
    assert max(gain(recorded(seed, 0.0)) for seed in (3, 4, 5)) < 0


@pytest.mark.slow
@pytest.mark.parametrize("slope", [0.0, SLOPE])
def test_intervals_hold_the_truth(slope: float) -> None:
    """Twelve records of five parameters: 57 of 60 intervals of 95 % are expected to hold it, 51 or more in 99.9 %."""
    model, held = bc.Model(SENSOR, (LEVEL,), law()), 0
    for seed in range(12):
        fit = bc.fit(model, recorded(100 + seed, slope), bc.Marginal(proposals=1024), strict=False)
        for name, truth in {**TRUTH, "noise.slope": slope}.items():
            low, high = np.quantile(fit.samples(name), [0.025, 0.975])
            held += bool(low <= truth <= high)
    assert held >= 51


# A tone that the output's sampling folds and the temperature moves.

TONE_STEP, ROWS = 0.5, 3000
MIDDLE, MOVES, BEND = 0.95, 0.35, -0.1  # Hz; it folds at 1 Hz


def evidence_of_tone(amplitude: float, seed: int) -> tuple[float, dict[str, float]]:
    """Log Bayes factor of a tone beside white and Ornstein–Uhlenbeck noise of one unit, and its parameters."""
    random = np.random.default_rng(seed)
    time = TONE_STEP * np.arange(ROWS)
    z = np.sin(time / 150)  # twice from one end of its range to the other
    turns = np.cumsum(MIDDLE + MOVES * z + BEND * z**2) * TONE_STEP
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
        terms: build_sum(
            scale, TONE_STEP, ROWS * TONE_STEP, terms, "temperature" if "tone" in terms else ""
        )
        for terms in (("correlated",), ("correlated", "tone"))
    }
    plain, with_it = (
        fit_to_residuals(law, fit.problem.record.residual_record(left)) for law in sums.values()
    )
    priors = sums["correlated", "tone"].parameters()
    values = {name: float(priors[name].value(v)) for name, v in with_it.start.items()}
    return with_it.log_evidence - plain.log_evidence, values


@pytest.mark.slow
def test_a_folded_tone_that_moves_is_found_with_its_frequency() -> None:
    gain, values = evidence_of_tone(0.8, seed=2)
    assert gain > 100
    z = np.linspace(-1, 1, 21)
    found = values["noise.tone.frequency"] + values["noise.tone.slope"] * z
    found = np.cos(2 * np.pi * TONE_STEP * (found + values["noise.tone.bend"] * z**2))
    np.testing.assert_allclose(
        found, np.cos(2 * np.pi * TONE_STEP * (MIDDLE + MOVES * z + BEND * z**2)), atol=0.05
    )
    assert values["noise.tone"] == pytest.approx(0.8, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4, 5])
def test_none_is_found_in_white_noise(seed: int) -> None:
    assert evidence_of_tone(0.0, seed)[0] < 0
