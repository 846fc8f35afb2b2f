"""NIST's nonlinear sets, each from both of its starts.

Each is an instrument whose slots are the parameters, fitted by `bc.LeastSquares` as any other.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import bayescal as bc
from benchmarks.accuracy.nist import FOLDER, Estimate, certificate, digits

exp, cos, sin, pi = jnp.exp, jnp.cos, jnp.sin, jnp.pi

# The expected response of each set as a function of the parameters b and the predictors x.


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


def instrument_of(expected: Callable, predictors: int, start: np.ndarray) -> bc.Instrument:
    """Build an instrument whose slots are the parameters, less their starting values."""

    def response(slots, r):
        b = [slots[f"b{i}"] + initial for i, initial in enumerate(start)]
        return expected(b, *(r[f"x{i}"] for i in range(predictors)))

    def coefficient(i: int) -> bc.Effect:
        prior = bc.Flat(abs(float(start[i])) or 1.0)
        slot = f"b{i}"
        return bc.Effect(
            f"{slot}.constant", slot, lambda r: 1.0, (bc.Coefficient("1", prior),), source="NIST"
        )

    columns = [bc.Column(f"x{i}", "1", "input") for i in range(predictors)]
    return bc.Instrument(
        name="nist",
        title="a set of NIST's",
        columns=(*columns, bc.Column("output", "1", "output")),
        slots=tuple(bc.Slot(f"b{i}", "1") for i in range(len(start))),
        response=response,
        effects=tuple(coefficient(i) for i in range(len(start))),
        noise=bc.White(bc.Flat(1.0)),
    )


def fit_nonlinear(
    expected: Callable, predictors: tuple[np.ndarray, ...], y: np.ndarray, starts: list[np.ndarray]
) -> list[Estimate]:
    """Fit by `bc.LeastSquares` from each start."""
    estimates = []
    for start in starts:
        instrument = instrument_of(expected, len(predictors), np.asarray(start, dtype=float))
        columns: dict[str, Any] = {f"x{i}": values for i, values in enumerate(predictors)}
        readings = bc.Measurements.from_arrays(instrument, output=y, **columns)
        fit = bc.fit(instrument.baseline(), readings, bc.LeastSquares(draws=512), strict=False)
        moved = fit.draws()[0] + fit.layout.origin_of_x
        estimates.append(
            Estimate(
                parameters=start + np.mean(moved, axis=0),
                sd=np.std(moved, axis=0, ddof=1),  # the draws have the moments of the fit
                residual_sd=float(fit.samples("noise.white")[0]),
                converged=fit.verdict.ok,
            )
        )
    return estimates


def nonlinear_set(name: str, folder: Path = FOLDER) -> dict[str, Any]:
    """Return a set's certificate, with its data as `y` and `predictors`."""
    certified, table = certificate(folder, "nonlinear", name)
    y = np.log(table[:, 0]) if name == "Nelson" else table[:, 0]  # its model is of log y
    return {**certified, "y": y, "predictors": tuple(table[:, 1:].T)}


def nonlinear_digits(name: str, folder: Path = FOLDER) -> list[dict[str, Any]]:
    """Return the agreeing digits from start 1 and start 2: of parameters and standard deviations."""
    certified = nonlinear_set(name, folder)
    starts = [np.asarray(certified["start1"]), np.asarray(certified["start2"])]
    fits = fit_nonlinear(NONLINEAR[name], certified["predictors"], certified["y"], starts)
    return [
        {
            "set": name,
            "start": number,
            "parameters": round(digits(fit.parameters, certified["certified"]), 2),
            "sd": round(digits(fit.sd, certified["sd"]), 2),
            "converged": fit.converged,
        }
        for number, fit in enumerate(fits, 1)
    ]
