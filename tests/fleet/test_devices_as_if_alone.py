"""Many devices at once: each comes out as if it were fitted alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.made_up.gyro_lot import MODEL, NOISE


def restricted(one: bc.Measurements) -> tuple[np.ndarray, np.ndarray, float]:
    """x̂, its covariance and σ of the gyro's line, by the textbook's formulas and a scalar minimiser."""
    t, y = one["temperature"], one["output"]
    j = np.column_stack([np.ones(len(t)), t - np.round(t.mean())])
    d = np.diag([e.coefficients[0].size ** 2 for e in MODEL.effects])

    def negative(log_sd: float) -> float:
        v = np.exp(2 * log_sd) * np.eye(len(y)) + j @ d @ j.T
        return 0.5 * (np.linalg.slogdet(v)[1] + y @ np.linalg.solve(v, y))

    low = np.log(NOISE) - 2
    best: Any = minimize_scalar(
        negative, bounds=(low, low + 4), method="bounded", options={"xatol": 1e-10}
    )
    sd = float(np.exp(best.x))
    covariance = np.linalg.inv(j.T @ j / sd**2 + np.linalg.inv(d))
    return covariance @ j.T @ y / sd**2, covariance, sd


def test_each_device_is_fitted_as_if_alone(readings, result) -> None:
    assert result.ok.all()
    for name in readings.names:
        x, covariance, sd = restricted(readings[name])
        one = result[name]
        np.testing.assert_allclose(one.mean[:2], x, rtol=1e-7)
        np.testing.assert_allclose(one.covariance[:2, :2], covariance, rtol=1e-5)
        assert one["noise.white"][0] == pytest.approx(sd, rel=5e-6)


def test_offsets_of_a_narrow_record_are_at_the_temperature_of_its_fit() -> None:
    """A batch rounded the mean temperature to a degree, a fit to a tenth of the record's standard deviation."""
    rng = np.random.default_rng(5)
    temperature = 25.34 + 0.5 * rng.standard_normal(60)
    output = 3.0 + 0.1 * (temperature - 25.0) + 0.01 * rng.standard_normal(60)
    one = bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, temperature=temperature, output=output)
    constant, sd = bc.fit_batch(MODEL, {"narrow": one})["narrow"]["bias.constant"]
    alone = bc.fit(MODEL, one, bc.LeastSquares()).samples("bias.constant")
    assert constant == pytest.approx(alone.mean(), abs=sd)


def test_flat_priors_give_ordinary_least_squares(readings) -> None:
    flat = [
        bc.Effect(e.name, e.slot, e.basis, (bc.Coefficient(e.coefficients[0].unit, bc.Flat()),))
        for e in MODEL.effects
    ]
    model = bc.Model(mems_gyro.INSTRUMENT, tuple(flat), MODEL.noise)
    found = bc.fit_batch(model, [readings[name] for name in readings.names])
    for name in readings.names:
        t, y = readings[name]["temperature"], readings[name]["output"]
        j = np.column_stack([np.ones(len(t)), t - np.round(t.mean())])
        x, rest = np.linalg.lstsq(j, y)[:2]
        variance = rest[0] / (len(y) - 2)
        np.testing.assert_allclose(found[name].mean[:2], x, rtol=1e-9)
        assert found[name]["noise.white"][0] == pytest.approx(np.sqrt(variance), rel=1e-9)
        expected = variance * np.linalg.inv(j.T @ j)
        np.testing.assert_allclose(found[name].covariance[:2, :2], expected, rtol=1e-8)


def test_marginal_carries_the_noise(readings) -> None:
    """Against the posterior in closed form at each noise, summed over a grid of it."""
    own = {name: readings[name].select(np.arange(11)) for name in readings.names[:3]}
    found = bc.fit_batch(MODEL, own, method=bc.Marginal(proposals=4096, rounds=2))
    assert found.ok.all()
    for name, one in own.items():
        mean, covariance = _over_noise(one)
        sd = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose((found[name].mean[:2] - mean) / sd, 0, atol=0.1)
        np.testing.assert_allclose(found[name].sd[:2], sd, rtol=0.06)


def _over_noise(one: bc.Measurements) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the gyro's line, its noise integrated out under its half-Cauchy prior."""
    t, y = one["temperature"], one["output"]
    j = np.column_stack([np.ones(len(t)), t - np.round(t.mean())])
    d = np.diag([e.coefficients[0].size ** 2 for e in MODEL.effects])
    scale = 0.1  # of the half-Cauchy
    assert MODEL.noise.parameters()["noise.white"] == bc.HalfCauchy(scale)
    logs, means, inners = [], [], []
    for sd in np.exp(np.linspace(np.log(0.03), np.log(3.0), 400)):
        v = sd**2 * np.eye(len(y)) + j @ d @ j.T
        logs.append(-0.5 * (np.linalg.slogdet(v)[1] + y @ np.linalg.solve(v, y)))
        logs[-1] += np.log(sd / (scale**2 + sd**2))
        inners.append(np.linalg.inv(j.T @ j / sd**2 + np.linalg.inv(d)))
        means.append(inners[-1] @ j.T @ y / sd**2)
    w = np.exp(np.array(logs) - max(logs))
    w /= w.sum()
    mean, apart = w @ np.array(means), np.array(means) - w @ np.array(means)
    return mean, np.einsum("k,kij->ij", w, inners) + np.einsum("k,ki,kj->ij", w, apart, apart)
