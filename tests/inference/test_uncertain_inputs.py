"""Straight lines of which both variables are uncertain, by every method, against an independent minimisation.

References: ISO/TS 28037:2010, clause 7, whose example is stated to four digits; the sum of squares over the effective
variance, minimised here by SciPy.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.optimize import least_squares

import bayescal as bc
from bayescal import effects

S = "ours"


def _first(r):
    return r["x"]


def meter(unit: str, *uncertain: bc.Effect, more: tuple[bc.Column, ...] = ()) -> bc.Instrument:
    """A straight line in a column of any unit, wide priors, no noise but what is stated."""
    slope = "count" if unit == "1" else f"count/{unit}"
    line = bc.Effect(
        "response.line",
        "response",
        basis=_first,
        coefficients=(bc.Coefficient(slope, bc.Normal(0.0, 1e3)),),
        columns=("x",),
        source=S,
    )
    return bc.Instrument(
        name="meter",
        title="a straight line, both variables uncertain",
        columns=(bc.Column("x", unit), *more, bc.Column("output", "count")),
        slots=(bc.Slot("response", "count"),),
        response=lambda s, r: s["response"],
        effects=(effects.constant("response", 1e3, "count", source=S), line, *uncertain),
        noise=bc.White(bc.HalfCauchy(1e-4)),
    )


class Line(NamedTuple):
    x: np.ndarray
    y: np.ndarray
    of_x: np.ndarray
    of_y: np.ndarray


ISO = Line(
    np.array([1.2, 1.9, 2.9, 4.0, 4.7, 5.9]),
    np.array([3.4, 4.4, 7.2, 8.5, 10.8, 13.5]),
    np.full(6, 0.2),
    np.array([0.2, 0.2, 0.2, 0.4, 0.4, 0.4]),
)


def simulated(seed: int, n: int = 12, each: bool = False) -> Line:
    random = np.random.default_rng(seed)
    x = np.linspace(0.0, 30.0, n)
    of_x = 0.5 * np.exp(0.5 * random.standard_normal(n)) if each else np.full(n, 0.5)
    of_y = np.full(n, 0.2)
    y = 2.0 + 1.5 * x + of_y * random.standard_normal(n)
    return Line(x + of_x * random.standard_normal(n), y, of_x, of_y)


def reference(line: Line) -> tuple[np.ndarray, np.ndarray, float]:
    """Intercept and slope, their standard uncertainties, and χ², by SciPy."""

    def residuals(p):
        return (line.y - p[0] - p[1] * line.x) / np.hypot(line.of_y, p[1] * line.of_x)

    found = least_squares(residuals, [1.0, 1.0], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return found.x, np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac))), 2 * found.cost


@cache
def fitted(name: str, method: str) -> tuple[bc.Calibration, Line]:
    line: Line = LINES[name]
    columns: dict[str, Any] = {"x": line.x, "output": line.y, "output_uncertainty": line.of_y}
    if np.ptp(line.of_x):
        uncertain = effects.uncertain_input("x", "x_uncertainty", source=S)
        instrument = meter("kPa", uncertain, more=(bc.Column("x_uncertainty", "kPa"),))
        columns["x_uncertainty"] = line.of_x
    else:
        uncertain = effects.uncertain_input("x", float(line.of_x[0]), "kPa", source=S)
        instrument = meter("kPa", uncertain)
    readings = bc.Measurements.from_arrays(instrument, **columns)
    model = instrument.baseline().fix({"noise.white": 0.0})
    how = {"least squares": bc.LeastSquares(), "marginal": bc.Marginal(), "nuts": bc.NUTS()}
    return bc.fit(model, readings, how[method], seed=3), line


LINES = {
    "ISO/TS 28037": ISO,
    "simulated, seed 77": simulated(77),
    "each its own, seed 78": simulated(78, each=True),
}


def moments(found: bc.Calibration) -> tuple[np.ndarray, np.ndarray]:
    draws = np.array([found.samples(n) for n in ("response.constant", "response.line")])
    return draws.mean(axis=1), draws.std(axis=1)


@pytest.mark.parametrize("name", LINES)
def test_least_squares_is_the_least_sum_over_the_effective_variance(name) -> None:
    found, line = fitted(name, "least squares")
    (mean, sd), (want, uncertainty, _) = moments(found), reference(line)
    np.testing.assert_allclose((mean - want) / uncertainty, 0.0, atol=2e-3)
    np.testing.assert_allclose(sd, uncertainty, rtol=2e-3)


def test_the_example_of_iso_28037() -> None:
    """0.5788 ± 0.4764 and 2.1597 ± 0.1355; χ² = 2.743 with 4 degrees of freedom."""
    mean, sd = moments(fitted("ISO/TS 28037", "least squares")[0])
    np.testing.assert_allclose([*mean, *sd], [0.5788, 2.1597, 0.4764, 0.1355], rtol=2e-3)
    assert reference(ISO)[2] == pytest.approx(2.743, abs=5e-4)


@pytest.mark.parametrize("name", LINES)
def test_chi_squared_counts_the_uncertainty_of_the_inputs(name) -> None:
    found, line = fitted(name, "least squares")
    squares, freedom, _ = found.chi_squared_test
    assert (freedom, squares) == (len(line.x) - 2, pytest.approx(reference(line)[2], rel=1e-4))


@pytest.mark.parametrize("method", ["marginal", pytest.param("nuts", marks=pytest.mark.slow)])
def test_sampling_agrees_with_quadrature(method) -> None:
    """Of the density with log s², on a grid; chains begin where the density is high, not on another hill."""
    found, line = fitted("simulated, seed 77", method)
    want, sd, _ = reference(line)
    a, b = (w + s * np.linspace(-6, 6, 401) for w, s in zip(want, sd, strict=True))
    left = line.y - a[:, None, None] - b[:, None] * line.x
    variance = line.of_y**2 + (b[:, None] * line.of_x) ** 2
    log = -0.5 * np.sum(left**2 / variance + np.log(variance), axis=-1)
    p = np.exp(log - log.max())
    p /= p.sum()
    along = [(p.sum(axis=1), a), (p.sum(axis=0), b)]
    mean = np.array([w @ v for w, v in along])
    spread = np.array([np.sqrt(w @ (v - m) ** 2) for (w, v), m in zip(along, mean, strict=True)])
    ours, ours_sd = moments(found)
    np.testing.assert_allclose((ours - mean) / spread, 0.0, atol=0.1)
    np.testing.assert_allclose(ours_sd, spread, rtol=0.1)
