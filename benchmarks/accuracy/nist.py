"""The NIST Statistical Reference Datasets for regression, and how many certified digits are met.

Linear sets go through the public API: an instrument whose one effect is the set's columns, with
flat priors, by `LeastSquares`. Nonlinear sets have no instrument; they go through the two routines
that `LeastSquares` is made of: `least_squares` for the point, `condition_white` for the covariance.
Source: NIST, Statistical Reference Datasets (www.itl.nist.gov/div898/strd).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import bayescal as bc
from bayescal._core.levenberg_marquardt import least_squares
from bayescal._inference import gaussian, laplace
from benchmarks.record import REFERENCE_DATA

FOLDER = REFERENCE_DATA / "nist_strd"
MOST = 16.0  # digits that a double can agree to

exp, cos, sin, pi = jnp.exp, jnp.cos, jnp.sin, jnp.pi


class Estimate(NamedTuple):
    """What a fit gives, in the order of the certificate."""

    parameters: np.ndarray
    sd: np.ndarray
    residual_sd: float
    converged: bool
    steps: int | None = None


def digits(found: Any, certified: Any) -> float:
    """Fewest digits that agree: −log10 of the relative error, of the error itself beside zero."""
    found, certified = (
        np.atleast_1d(np.asarray(found, float)),
        np.atleast_1d(np.asarray(certified, float)),
    )
    if not np.all(np.isfinite(found)):
        return 0.0
    error = np.abs(found - certified) / np.where(certified == 0, 1.0, np.abs(certified))
    worst = float(np.max(error))
    return MOST if worst < 10.0**-MOST else max(0.0, -math.log10(worst))


# Nonlinear sets: the expected response as a function of the parameters and the predictors.


def saturating(b, x):
    return b[0] * (1 - exp(-b[1] * x))


def misra1b(b, x):
    return b[0] * (1 - (1 + b[1] * x / 2) ** -2)


def misra1c(b, x):
    return b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5)


def misra1d(b, x):
    return b[0] * b[1] * x / (1 + b[1] * x)


def chwirut(b, x):
    return exp(-b[0] * x) / (b[1] + b[2] * x)


def lanczos(b, x):
    return b[0] * exp(-b[1] * x) + b[2] * exp(-b[3] * x) + b[4] * exp(-b[5] * x)


def gauss(b, x):
    peaks = b[2] * exp(-((x - b[3]) ** 2) / b[4] ** 2) + b[5] * exp(-((x - b[6]) ** 2) / b[7] ** 2)
    return b[0] * exp(-b[1] * x) + peaks


def power(b, x):
    return b[0] * x ** b[1]


def quadratics(b, x):
    return (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2)


def cubics(b, x):
    top = b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3
    return top / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)


def nelson(b, x1, x2):
    return b[0] - b[1] * x1 * exp(-b[2] * x2)


def mgh17(b, x):
    return b[0] + b[1] * exp(-x * b[3]) + b[2] * exp(-x * b[4])


def roszman1(b, x):
    return b[0] - b[1] * x - jnp.arctan(b[2] / (x - b[3])) / pi


def enso(b, x):
    year = b[0] + b[1] * cos(2 * pi * x / 12) + b[2] * sin(2 * pi * x / 12)
    second = b[4] * cos(2 * pi * x / b[3]) + b[5] * sin(2 * pi * x / b[3])
    return year + second + b[7] * cos(2 * pi * x / b[6]) + b[8] * sin(2 * pi * x / b[6])


def mgh09(b, x):
    return b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3])


def rat42(b, x):
    return b[0] / (1 + exp(b[1] - b[2] * x))


def rat43(b, x):
    return b[0] / (1 + exp(b[1] - b[2] * x)) ** (1 / b[3])


def eckerle4(b, x):
    return b[0] / b[1] * exp(-0.5 * ((x - b[2]) / b[1]) ** 2)


def mgh10(b, x):
    return b[0] * exp(b[1] / (x + b[2]))


def bennett5(b, x):
    return b[0] * (b[1] + x) ** (-1 / b[2])


NONLINEAR: dict[str, Callable] = {
    **{"Misra1a": saturating, "Misra1b": misra1b, "Misra1c": misra1c, "Misra1d": misra1d},
    **{"Chwirut1": chwirut, "Chwirut2": chwirut, "DanWood": power, "Nelson": nelson},
    **{"Lanczos1": lanczos, "Lanczos2": lanczos, "Lanczos3": lanczos},
    **{"Gauss1": gauss, "Gauss2": gauss, "Gauss3": gauss},
    **{"Kirby2": quadratics, "Hahn1": cubics, "Thurber": cubics},
    **{"MGH09": mgh09, "MGH10": mgh10, "MGH17": mgh17, "Roszman1": roszman1, "ENSO": enso},
    **{
        "BoxBOD": saturating,
        "Rat42": rat42,
        "Rat43": rat43,
        "Eckerle4": eckerle4,
        "Bennett5": bennett5,
    },
}


def fit_nonlinear(
    expected: Callable, predictors: tuple[np.ndarray, ...], y: np.ndarray, starts: list[np.ndarray]
) -> list[Estimate]:
    """The least-squares fit from each start; noise by restricted likelihood, Σr²/(n − p)."""

    @jax.jit
    def from_start(start):
        scale = jnp.where(start == 0, 1.0, jnp.abs(start))
        found = least_squares(lambda b: expected(b, *predictors) - y, start, scale)
        residual = expected(found.value, *predictors) - y
        jacobian = jax.jacfwd(lambda b: expected(b, *predictors))(found.value)
        sigma = jnp.sqrt(residual @ residual / (len(y) - start.size))
        flat = gaussian.Prior(0 * start, laplace.column_scale(jacobian), 0 * start)
        given = gaussian.condition_white(
            jacobian / sigma, residual / sigma, jnp.zeros(()), flat, found.value
        )
        return found, jnp.sqrt(jnp.diag(given.covariance)), sigma

    estimates = []
    for start in starts:
        found, sd, sigma = from_start(jnp.asarray(start))
        estimates.append(
            Estimate(
                np.asarray(found.value),
                np.asarray(sd),
                float(sigma),
                bool(found.converged),
                int(found.steps),
            )
        )
    return estimates


def nonlinear_set(name: str, folder: Path = FOLDER) -> dict[str, Any]:
    """Certificate of a set, with its data as `y` and `predictors`."""
    certificate = json.loads(
        (folder / "nonlinear" / "certified_nonlinear.json").read_text("utf-8")
    )[name]
    table = np.loadtxt(folder / "nonlinear" / f"{name}.csv", delimiter=",", skiprows=1)
    y = np.log(table[:, 0]) if name == "Nelson" else table[:, 0]  # its model is of log y
    return {**certificate, "y": y, "predictors": tuple(table[:, 1:].T)}


def nonlinear_digits(name: str, folder: Path = FOLDER) -> list[dict[str, Any]]:
    """Digits met from start 1 and start 2: of the parameters, of their standard deviations."""
    known = nonlinear_set(name, folder)
    starts = [np.asarray(known["start1"]), np.asarray(known["start2"])]
    fits = fit_nonlinear(NONLINEAR[name], known["predictors"], known["y"], starts)
    return [
        {
            "set": name,
            "start": number,
            "parameters": round(digits(fit.parameters, known["certified"]), 2),
            "sd": round(digits(fit.sd, known["sd"]), 2),
            "converged": fit.converged,
            "steps": fit.steps,
        }
        for number, fit in enumerate(fits, 1)
    ]


# Linear sets, through the public API.

# (centre, half-width) where powers of x are too nearly parallel for a double: Legendre polynomials
# of u = (x − centre)/half-width span the same and are not.
CENTRED = {
    "filip": (-6.0, 3.0),
    **{f"wampler{i}": (10.0, 10.0) for i in range(1, 6)},
}
LINEAR = (
    "norris",
    "pontius",
    "noint1",
    "noint2",
    "filip",
    "longley",
    *(f"wampler{i}" for i in range(1, 6)),
)


def line_model(
    columns: dict[str, np.ndarray], powers: tuple[int, ...], place: tuple[float, float] | None
) -> bc.Model:
    """A model whose effect is powers of x, or Legendre polynomials of (x − centre)/half-width, or
    (without `powers`) the columns themselves with a constant."""

    def basis(r: bc.Frame):
        if place:
            u = (r["x"] - place[0]) / place[1]
            found = [jnp.ones(r.size), u]
            for k in powers[1:-1]:
                found.append(((2 * k + 1) * u * found[k] - k * found[k - 1]) / (k + 1))
            return jnp.stack(found, axis=1)
        if powers:
            return jnp.stack([r["x"] ** k for k in powers], axis=1)
        return jnp.stack([jnp.ones(r.size), *(r[name] for name in columns)], axis=1)

    count = len(powers) or len(columns) + 1
    effect = bc.Effect(
        "value.line",
        "value",
        basis,
        tuple(bc.Coefficient("1", bc.Flat(), part=f"b{i}") for i in range(count)),
        columns=tuple(columns),
        source="NIST StRD, linear regression",
    )
    instrument = bc.Instrument(
        "line",
        "a linear regression",
        (bc.Column("output", "1"), *(bc.Column(name, "1") for name in columns)),
        (bc.Slot("value", "1"),),
        lambda slots, readings: slots["value"],
        (effect,),
        noise=bc.White(bc.Flat()),
    )
    return instrument.baseline()


def expand(degree: int, centre: float, half: float) -> np.ndarray:
    """T such that β = T·γ: from Legendre polynomials of (x − centre)/half to powers of x."""
    size = degree + 1
    shifted, powers = np.zeros((size, size)), np.zeros((size, size))
    for k in range(size):
        powers[: k + 1, k] = np.polynomial.legendre.leg2poly(np.eye(size)[k, : k + 1])
        for j in range(k + 1):
            shifted[j, k] = math.comb(k, j) * (-centre) ** (k - j) / half**k
    return shifted @ powers


def fit_linear(
    columns: dict[str, np.ndarray],
    y: np.ndarray,
    powers: tuple[int, ...] = (),
    place: tuple[float, float] | None = None,
) -> Estimate:
    """A polynomial in `x`, or all columns and a constant, by `bc.fit` with `LeastSquares`."""
    model = line_model(columns, powers, place)
    readings = bc.Measurements.from_arrays(model.instrument, output=y, **columns)
    fit = bc.fit(model, readings, bc.LeastSquares(), strict=False)
    names = model.effects[0].coefficients
    draws = np.stack([fit.samples(f"value.line[{c.part}]") for c in names], axis=1)
    best = np.asarray(fit.mode.point.x)  # the mean of the draws but for their rounding
    if place:
        matrix = expand(powers[-1], *place)
        best, draws = matrix @ best, draws @ matrix.T
    noise = float(fit.samples("noise.white")[0])
    return Estimate(best, draws.std(axis=0, ddof=1), noise, fit.verdict.ok)


def linear_digits(name: str, centred: bool = True, folder: Path = FOLDER) -> dict[str, Any]:
    """Digits met: of the parameters, their standard deviations, the residual standard deviation."""
    known = json.loads((folder / "linear" / "certified_linear.json").read_text("utf-8"))[name]
    table = np.loadtxt(folder / "linear" / f"{name}.csv", delimiter=",", skiprows=1)
    powers = tuple(int(t[2:]) for t in known["terms"] if t.startswith("x^"))
    labels = ["x"] if powers else [t for t in known["terms"] if t != "1"]
    columns = dict(zip(labels, table[:, 1:].T, strict=True))
    place = CENTRED.get(name) if centred else None
    fit = fit_linear(columns, table[:, 0], powers, place)
    exact = float(known["residual_sd_exact"]) == 0
    return {
        "set": name,
        "basis": "Legendre" if place else "as given",
        "parameters": round(digits(fit.parameters, [float(b) for b in known["beta_exact"]]), 2),
        "sd": None if exact else round(digits(fit.sd, [float(s) for s in known["sd_exact"]]), 2),
        "residual_sd": None
        if exact
        else round(digits(fit.residual_sd, known["residual_sd_exact"]), 2),
        "converged": fit.converged,
    }
