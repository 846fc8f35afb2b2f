"""The GUM's own example and straight lines after ISO/TS 28037 are met to all printed digits.

By `LeastSquares` with flat priors, where the estimate is that of least squares and the noise, if unknown, is
divided by the degrees of freedom: u of JCGM 100.

The Bayesian standard deviation beside it is larger by the factor of the t distribution. Under flat priors of the
coefficients and the noise flat in σ, the posterior of a coefficient about its estimate is Student's t with
ν' = n − p − 1 degrees of freedom and scale u·√((n − p)/ν'); its standard deviation is that scale times √(ν'/(ν' − 2)),
so sd = u·√((n − p)/(n − p − 3)). (With the density 1/σ in place of a flat one it would be the textbook's
√((n − p)/(n − p − 2)), t with n − p degrees of freedom.) The GUM keeps u and puts the t factor into k instead (its
annex G): both say that 9 degrees of freedom leave the noise itself uncertain.
"""

from __future__ import annotations

import json
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc


def line(centre: float, unit: str = "1") -> bc.Effect:
    return bc.Effect(
        "line",
        "line",
        basis=lambda r: jnp.stack([jnp.ones(r.size), r["x"] - centre], axis=1),
        coefficients=(
            bc.Coefficient(unit, bc.Flat(), part="a"),
            bc.Coefficient(unit, bc.Flat(), part="b"),
        ),
        columns=("x",),
    )


STRAIGHT = bc.Instrument(
    name="straight",
    title="y = a + b·x, used to find x",
    columns=(bc.Column("x", "1"), bc.Column("output", "1")),
    slots=(bc.Slot("line", "1"),),
    response=lambda slots, r: slots["line"],
    effects=(line(0.0),),
    noise=bc.White(bc.Flat()),
    use=bc.Use("x", "1"),
)
# GUM H.3: the correction b of a thermometer at its reading t; in use, true temperature = t + b(t).
THERMOMETER = bc.Instrument(
    name="thermometer",
    title="a thermometer's correction b = y1 + y2·(t − 20 °C)",
    columns=(bc.Column("x", "1", "reading of the thermometer"), bc.Column("output", "1")),
    slots=(bc.Slot("line", "1"),),
    response=lambda slots, r: slots["line"],
    effects=(line(20.0),),
    noise=bc.White(bc.Flat()),
    use=bc.Use("true", "1", equation=lambda true, slots, r: true - slots["line"]),
)


def printed(value: float, like: float) -> bool:
    """Whether a value rounds to a printed one, to all of its digits."""
    text = repr(like)
    places = len(text.partition(".")[2])
    return round(value, places) == like


def estimates(fit: bc.Calibration) -> tuple[np.ndarray, np.ndarray]:
    draws = np.array([fit.samples("line[a]"), fit.samples("line[b]")])
    return draws.mean(axis=1), np.cov(draws)


@pytest.fixture(scope="module")
def gum(certified_data):
    folder = certified_data / "gum" / "gum_h3"
    table = np.loadtxt(folder / "gum_h3.csv", delimiter=",", skiprows=1)
    said = json.loads((folder / "certified.json").read_text("utf-8"))["published"]
    readings = bc.Measurements.from_arrays(THERMOMETER, x=table[:, 0], output=table[:, 1])
    return readings, said


@pytest.fixture(scope="module")
def gum_fit(gum) -> bc.Calibration:
    return bc.fit(THERMOMETER.baseline(), gum[0], bc.LeastSquares())


def test_gum_h3_is_met_to_all_printed_digits(gum, gum_fit) -> None:
    said = gum[1]
    mean, covariance = estimates(gum_fit)
    sd = np.sqrt(np.diag(covariance))
    assert printed(mean[0], said["y1"]) and printed(sd[0], said["u_y1"])
    assert printed(mean[1], said["y2"]) and printed(sd[1], said["u_y2"])
    assert printed(covariance[0, 1] / sd[0] / sd[1], said["r"])
    assert printed(gum_fit.samples("noise.white").mean(), said["s"])


def test_the_correction_of_gum_h3_is_predicted_at_30_degrees(gum, gum_fit) -> None:
    said = gum[1]
    corrected = bc.compensator(gum_fit)(
        output=30.0, x=30.0, noise=False, method="first order", warn=False
    )
    assert printed(corrected.value[0] - 30.0, said["b30"])
    assert printed(corrected.uncertainty[0], said["u_b30"])
    assert printed(bc.budget(gum_fit, {"true": 30.0, "x": 30.0}).uncertainty, said["u_b30"])


@pytest.mark.slow
def test_the_bayesian_sd_of_gum_h3_is_wider_by_the_t_factor(gum, gum_fit) -> None:
    posterior = bc.fit(THERMOMETER.baseline(), gum[0], bc.Marginal(), seed=1)
    (_, plain), (_, bayes) = estimates(gum_fit), estimates(posterior)
    freedom = len(gum[0]) - 2
    factor = np.sqrt(freedom / (freedom - 3))
    np.testing.assert_allclose(np.sqrt(np.diag(bayes) / np.diag(plain)), factor, rtol=0.05)


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
    squares, freedom, chance = fit.chi_squared
    np.testing.assert_allclose(squares, np.sum((y / u - rows @ mean) ** 2), rtol=1e-9)
    assert freedom == 6 and 0 < chance < 1


@pytest.fixture(scope="module")
def iso(certified_data):
    path = certified_data / "gum" / "iso28037" / "examples.json"
    return json.loads(path.read_text("utf-8"))


@pytest.mark.parametrize("name", ["ex1_equal", "ex2_unequal", "gtc_unequal"])
def test_lines_of_iso_28037_are_met(name, iso) -> None:
    example = iso[name]
    fit = fitted(*(tuple(example[k]) for k in ("x", "y", "u_y")))
    mean, covariance = estimates(fit)
    np.testing.assert_allclose(mean, [example["a"], example["b"]], rtol=1e-10)
    sd = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(sd, [example["u_a"], example["u_b"]], rtol=1e-10)
    np.testing.assert_allclose(covariance[0, 1], example["cov_ab"], rtol=1e-10)
    residual = (np.array(example["y"]) - mean[0] - mean[1] * np.array(example["x"])) / example[
        "u_y"
    ]
    np.testing.assert_allclose(residual @ residual, example["chi2"], rtol=1e-9)
    np.testing.assert_allclose(fit.chi_squared[0], example["chi2"], rtol=1e-9)
    said = example["published_gtc"]
    found = {"a": mean[0], "b": mean[1], "u_a": sd[0], "u_b": sd[1], "cov": covariance[0, 1]}
    for key, value in found.items():
        places = len(repr(said[key]).partition(".")[2])
        assert abs(value - said[key]) <= 1.5 * 10.0**-places, (
            key
        )  # the last digit is GTC's rounding


@pytest.mark.parametrize(
    ("name", "key", "uncertainty"),
    [
        ("ex1_equal", "inverse_for_y_10p5_u_0p5", 0.5),
        ("ex2_unequal", "inverse_for_y_10p5_u_1", 1.0),
    ],
)
def test_the_inverse_prediction_of_iso_28037_is_met(name, key, uncertainty, iso) -> None:
    example = iso[name]
    fit = fitted(*(tuple(example[k]) for k in ("x", "y", "u_y")))
    found = bc.compensator(fit)(
        output=10.5, output_uncertainty=uncertainty, method="first order", warn=False
    )
    said = example["published_gtc"][key]
    for value, like in zip((found.value[0], found.uncertainty[0]), said, strict=True):
        places = min(len(repr(like).partition(".")[2]), 13)
        assert abs(value - like) <= 1.01 * 10.0**-places / (2 if places < 6 else 1)


def test_with_flat_priors_all_of_a_budget_comes_from_the_readings() -> None:
    fit = fitted((0.0, 1.0, 2.0, 3.0), (1.0, 3.0, 4.0, 6.0), (1.0,) * 4)
    sources = {s.name: s for s in bc.budget(fit, {"x": 2.0}).sources}
    readings, rest = "noise of the calibration's readings", "between-group sd, shapes, curvature"
    assert set(sources) == {readings, rest}
    np.testing.assert_allclose(sources[readings].share, 1.0, atol=1e-7)
