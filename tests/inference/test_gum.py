"""Straight lines by `LeastSquares` with flat priors are weighted least squares; a budget names the readings alone.

The examples of the GUM and of ISO/TS 28037 are clauses of `bayescal validate` (`test_validation.py`).
"""

from __future__ import annotations

from functools import cache

import jax.numpy as jnp
import numpy as np

import bayescal as bc

LINE = bc.Effect(
    "line",
    "line",
    basis=lambda r: jnp.stack([jnp.ones(r.size), r["x"]], axis=1),
    coefficients=tuple(bc.Coefficient("1", bc.Flat(), part=part) for part in "ab"),
    columns=("x",),
)
STRAIGHT = bc.Instrument(
    name="straight",
    title="y = a + b·x, used to find x",
    columns=(bc.Column("x", "1"), bc.Column("output", "1")),
    slots=(bc.Slot("line", "1"),),
    response=lambda slots, r: slots["line"],
    effects=(LINE,),
    noise=bc.White(bc.Flat()),
    use=bc.Use("x", "1"),
)


def estimates(fit: bc.Calibration) -> tuple[np.ndarray, np.ndarray]:
    draws = np.array([fit.samples("line[a]"), fit.samples("line[b]")])
    return draws.mean(axis=1), np.cov(draws)


@cache
def fitted(x: tuple[float, ...], y: tuple[float, ...], u: tuple[float, ...]) -> bc.Calibration:
    readings = bc.Measurements.from_arrays(STRAIGHT, x=x, output=y, output_uncertainty=u)
    model = STRAIGHT.baseline().fix({"noise.white": 0.0})
    return bc.fit(model, readings, bc.LeastSquares())


def test_noise_as_stated_is_weighted_least_squares_and_its_chi_squared() -> None:
    x, u = np.arange(8.0), np.tile([0.5, 1.5], 4)
    y = 2.0 + 0.75 * x + u * np.random.default_rng(3).normal(size=8)
    fit = fitted(*(tuple(v.tolist()) for v in (x, y, u)))
    rows = np.column_stack([np.ones(8), x]) / u[:, None]
    cov = np.linalg.inv(rows.T @ rows)
    mean, covariance = estimates(fit)
    np.testing.assert_allclose(mean, cov @ rows.T @ (y / u), rtol=1e-9)
    np.testing.assert_allclose(covariance, cov, rtol=1e-9)
    squares, freedom, chance = fit.chi_squared_test
    np.testing.assert_allclose(squares, np.sum((y / u - rows @ mean) ** 2), rtol=1e-9)
    assert freedom == 6 and 0 < chance < 1


def test_with_flat_priors_all_of_a_budget_comes_from_the_readings() -> None:
    fit = fitted((0.0, 1.0, 2.0, 3.0), (1.0, 3.0, 4.0, 6.0), (1.0,) * 4)
    sources = {s.name: s for s in bc.budget(fit, {"x": 2.0}).sources}
    readings = "noise of the calibration's readings"
    assert set(sources) == {readings, "between-run sd, time constants, second-order terms"}
    np.testing.assert_allclose(sources[readings].share, 1.0, atol=1e-7)
