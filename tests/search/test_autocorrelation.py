"""Neighbouring residuals count as correlated by what the fit does not explain of their correlation."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal_models import still_sensor
from tests.support.inside import autocorrelation, forward

SENSOR = still_sensor.instrument("ug", size=20.0, constant=200.0, span=20.0)
FAST = bc.LeastSquares(draws=100)
LEVELS = SENSOR.baseline() + "bias.run"


def runs_of(counts: list[int], noise: np.ndarray, levels: np.ndarray, step: np.ndarray | float):
    """Readings a minute apart or as given, runs of these counts a day apart, each with its level."""
    run = np.repeat(np.arange(len(counts)), counts)
    within = np.concatenate([np.arange(n) for n in counts])
    temperature = 30 + 20 * np.sin(1.7 * np.arange(run.size))
    output = 5 + 0.4 * (temperature - 30) + levels[run] + noise
    return bc.Measurements.from_arrays(
        SENSOR,
        run=run.astype(str),
        time=86400.0 * run + step * within,
        temperature=temperature,
        output=output,
    )


def of(model: bc.Model, readings: bc.Measurements) -> tuple[bc.Calibration, tuple[float, float]]:
    found = bc.fit(model, readings, FAST, strict=False)
    return found, bc.check(found).autocorrelation


def test_levels_of_short_runs_are_allowed_for() -> None:
    """Forty white runs of three readings: about its own level each run's residuals have −1/2."""
    scores = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        data = runs_of([3] * 40, rng.standard_normal(120), 20 * rng.standard_normal(40), 60.0)
        _, (coefficient, z) = of(LEVELS, data)
        assert abs(coefficient) < 0.3
        scores.append(z)
    assert np.abs(scores).max() < 3
    assert abs(np.mean(scores)) < 3 / np.sqrt(6)


def test_z_is_standard_under_the_model(rng) -> None:
    data = runs_of(
        [3] * 12 + [2, 1, 9], rng.standard_normal(48), 20 * rng.standard_normal(15), 60.0
    )
    found, _ = of(LEVELS, data)
    g = found.linear.directions
    layout, mode = found.layout, found.mode
    hyper = layout.hyper(jnp.asarray(mode.v))
    line = forward.linearise(layout, found.frame, mode.x, hyper)
    prior, noise = found.problem.prior(found.problem.hyper(mode.v), mode.flat), found.model.noise
    sd = np.sqrt(np.broadcast_to(noise.variance(hyper, found.frame), len(data)))
    a = np.asarray(line.jacobian * prior.sd) / sd[:, None]
    h = a @ np.linalg.solve(a.T @ a + np.diag(prior.weight), a.T)
    np.testing.assert_allclose(g @ g.T, h, atol=1e-9)
    values, vectors = np.linalg.eigh(np.eye(len(data)) - h)
    root = vectors * np.sqrt(np.maximum(values, 0))
    drawn = [autocorrelation(found, root @ rng.standard_normal(len(data))) for _ in range(400)]
    coefficients, z = np.array(drawn).T
    assert abs(z.mean()) < 0.2
    assert 0.85 < z.std() < 1.15
    assert np.abs(coefficients).max() <= 1


@pytest.mark.parametrize("counts", [[300], [10] * 30], ids=["one run", "runs of ten"])
def test_a_correlated_record_is_caught(counts, rng) -> None:
    noise = rng.standard_normal(300)
    for i in range(1, 300):
        noise[i] += 0.5 * noise[i - 1]
    data = runs_of(counts, noise, 20 * rng.standard_normal(len(counts)), 60.0)
    _, (coefficient, z) = of(LEVELS if len(counts) > 1 else SENSOR.baseline(), data)
    assert 0.3 < coefficient < 0.7
    assert z > 4
