"""Noise laws are the densities that they claim to be, and fits under them do what they are for."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy import stats

import bayescal as bc
from bayescal import effects
from bayescal_models.mems_gyro import INSTRUMENT
from tests.support.inside import Parameters, constants_of, frame_of

CONSTANT = bc.Model(
    INSTRUMENT, (effects.constant("bias", 10.0, "deg/s", source="none"),), bc.White()
)
STEP = 0.5
LAWS: dict[str, tuple[bc.Noise, dict[str, float]]] = {
    "white": (bc.White(), {"noise.white": 0.3}),
    "heteroscedastic": (
        bc.Heteroscedastic("temperature"),
        {"noise.white": 0.3, "noise.slope": 0.8, "noise.curvature": -0.4},
    ),
    "student_t": (bc.StudentT(), {"noise.white": 0.3, "noise.freedom": 3.5}),
    "quantised": (bc.Quantised(STEP), {"noise.white": 0.3}),
}


def readings(output, **more) -> bc.Measurements:
    temperature = np.linspace(30.0, 80.0, len(output))
    return bc.Measurements.from_arrays(INSTRUMENT, temperature=temperature, output=output, **more)


def arrays(values: dict[str, float]) -> Parameters:
    return {name: jnp.asarray(value) for name, value in values.items()}


def log_density(
    law: bc.Noise, values: dict[str, float], y: ArrayLike, mean: float, **more: Any
) -> np.ndarray:
    y = np.atleast_1d(y)
    frame = frame_of(readings(np.resize(y, max(2, len(y))), **more))
    spread = jnp.full(frame.size, mean)
    found = law.log_density(
        jnp.resize(jnp.asarray(y), (frame.size,)), spread, arrays(values), frame
    )
    return np.asarray(found)[: len(y)]


def test_white_noise_density_equals_scipy_normal() -> None:
    y = np.linspace(-3, 3, 9)
    found = log_density(*LAWS["white"], y, 0.4)
    np.testing.assert_allclose(found, stats.norm.logpdf(y, 0.4, 0.3), rtol=1e-12)


def test_scatter_follows_a_column_and_stays_as_at_its_end_beyond_it() -> None:
    law, values = LAWS["heteroscedastic"]
    fitted = readings(np.zeros(11))
    z = np.linspace(-1, 1, 11)
    sd = 0.3 * np.exp(0.8 * z - 0.4 * (1.5 * z**2 - 0.5))
    frame = frame_of(fitted)
    found = law.log_density(jnp.ones(11), jnp.full(11, 0.4), arrays(values), frame)
    np.testing.assert_allclose(found, stats.norm.logpdf(1.0, 0.4, sd), rtol=1e-12)
    beyond = frame_of(
        bc.Measurements.from_arrays(INSTRUMENT, temperature=[0.0, 200.0], output=[0.0, 0.0]),
        constants_of(fitted),
    )
    np.testing.assert_allclose(law.variance(arrays(values), beyond), sd[[0, -1]] ** 2, rtol=1e-12)


def test_student_t_density_equals_scipy() -> None:
    y = np.linspace(-3, 3, 9)
    found = log_density(*LAWS["student_t"], y, 0.4)
    np.testing.assert_allclose(found, stats.t.logpdf(y, 3.5, 0.4, 0.3), rtol=1e-10)


def test_quantised_is_the_probability_of_the_rounding_interval() -> None:
    grid = STEP * np.arange(-6, 7)
    found = log_density(*LAWS["quantised"], grid, 0.4)
    normal = stats.norm(0.4, 0.3)
    upper = grid > 0.4  # there from the far side, where scipy keeps its digits
    near = np.where(upper, -1, 1) * (grid - STEP / 2)
    far = np.where(upper, -1, 1) * (grid + STEP / 2)
    other = stats.norm(-0.4, 0.3)
    interval = np.where(upper, other.cdf(near) - other.cdf(far), normal.cdf(far) - normal.cdf(near))
    np.testing.assert_allclose(np.exp(found) * STEP, interval, rtol=1e-6, atol=1e-300)


def test_quantised_keeps_its_digits_and_slope_far_from_the_mean() -> None:
    law, frame = bc.Quantised(STEP), frame_of(readings(np.zeros(2)))

    def one(mean):
        return law.log_density(
            jnp.zeros(2), jnp.full(2, mean), {"noise.white": jnp.asarray(0.1)}, frame
        )[0]

    # At 30 and 80 sd: log ∫ of the near edge of the interval, by the asymptotic series of the normal tail.
    for mean in (3.0, 8.0):
        edge = (mean - STEP / 2) / 0.1
        assert float(one(mean)) == pytest.approx(stats.norm.logsf(edge) - np.log(STEP), rel=1e-8)
        assert np.isfinite(jax.grad(one)(mean))
    assert float(jax.grad(one)(0.0)) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("law", LAWS)
def test_samples_have_the_stated_variance_and_density(law, key) -> None:
    noise, numbers = LAWS[law]
    numbers = {**numbers, "noise.freedom": 9.0}
    parameters = arrays(numbers)
    frame = frame_of(readings(np.zeros(20000)))
    made = np.asarray(noise.sample(key, jnp.full(20000, 0.1), parameters, frame))
    stated = np.asarray(noise.variance(parameters, frame))
    assert made.var() == pytest.approx(np.mean(stated), rel=0.05)
    if law == "quantised":
        values, counts = np.unique(made, return_counts=True)
        assert np.allclose(values / STEP, np.round(values / STEP))
        share = np.exp(log_density(noise, numbers, values, 0.1)) * STEP
        np.testing.assert_allclose(counts / 20000, share, atol=0.015)
    elif law == "heteroscedastic":
        assert stats.kstest((made - 0.1) / np.sqrt(stated), stats.norm.cdf).pvalue > 0.01
    else:
        exact = stats.norm(0.1, 0.3) if law == "white" else stats.t(9.0, 0.1, 0.3)
        assert stats.kstest(made, exact.cdf).pvalue > 0.01


@pytest.mark.parametrize("law", LAWS)
def test_known_uncertainty_of_a_reading_adds_in_quadrature(law) -> None:
    noise, parameters = LAWS[law]
    known = np.array([0.0, 0.4, 0.4, 2.0])
    y = np.array([0.1, 0.1, 0.6, -1.0])
    found = log_density(noise, parameters, y, 0.0, output_uncertainty=known)
    if law == "heteroscedastic":  # which adds it to a scatter of each reading's own
        parameters = {**parameters, "noise.slope": 0.0, "noise.curvature": 0.0}
        found = log_density(noise, parameters, y, 0.0, output_uncertainty=known)
    for i, extra in enumerate(known):
        alone = {**parameters, "noise.white": np.hypot(0.3, extra)}
        assert found[i] == pytest.approx(log_density(noise, alone, y[i : i + 1], 0.0)[0], rel=1e-10)


def test_noise_excludes_known_uncertainties(rng) -> None:
    known = rng.uniform(0.0, 0.2, 300)
    data = readings(5 + np.hypot(known, 0.1) * rng.standard_normal(300), output_uncertainty=known)
    noise = bc.fit(CONSTANT, data).samples("noise.white")
    assert abs(noise.mean() - 0.1) < 3 * noise.std()
    assert noise.std() < 0.02


@pytest.mark.slow
def test_student_t_resists_outliers(rng) -> None:
    output = 5 + 0.1 * rng.standard_normal(40)
    output[[3, 17, 30]] += [6.0, 8.0, 5.0]
    data = readings(output)
    white = bc.fit(CONSTANT, data)
    robust = bc.fit(
        CONSTANT.with_noise(bc.StudentT(bc.HalfCauchy(0.1))), data, bc.Marginal(draws=2000)
    )
    assert white.samples("bias.constant").mean() > 5.2
    constant = robust.samples("bias.constant")
    assert constant.mean() == pytest.approx(5, abs=0.06)
    assert abs(constant.mean() - 5) < 3 * constant.std()
    assert constant.std() < 0.04
    assert robust.samples("noise.freedom").mean() < 4
    assert robust.verdict.sampler == "importance sampling"
    assert robust.log_evidence is not None and white.log_evidence is not None
    assert robust.log_evidence[0] > white.log_evidence[0] + 20
    chains = bc.fit(robust.model, data, bc.NUTS(draws=1000)).samples("bias.constant")
    assert constant.mean() == pytest.approx(chains.mean(), abs=0.1 * chains.std())
    assert constant.std() == pytest.approx(chains.std(), rel=0.1)


@pytest.mark.slow
def test_coarse_rounding_does_not_bias_a_quantised_fit(rng) -> None:
    # Noise of a fifth of the step, a mean near the edge of a rounding interval.
    step, sd, truth = 1.0, 0.2, 5.36
    data = readings(np.round((truth + sd * rng.standard_normal(150)) / step) * step)
    # With two printed values only (truth − edge)/sd is measured: the scatter before rounding must be known.
    rounded = CONSTANT.with_noise(bc.Quantised(step, bc.HalfNormal(0.3))).fix({"noise.white": sd})
    constant = bc.fit(rounded, data, bc.Marginal(draws=2000)).samples("bias.constant")
    assert abs(constant.mean() - truth) < 3 * constant.std()
    # The mean and scatter of the printed values themselves are far off.
    as_printed = bc.fit(CONSTANT, data).samples("bias.constant")
    assert abs(as_printed.mean() - truth) > 3 * as_printed.std()
