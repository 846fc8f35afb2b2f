"""NIST's nonlinear sets, each from both of its starts.

They have no instrument, and go through the two routines that `LeastSquares` is made of: `least_squares` for the
point, `condition_white` for the covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayescal._core.levenberg_marquardt import least_squares
from bayescal._inference import gaussian, laplace
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
                parameters=np.asarray(found.value),
                sd=np.asarray(sd),
                residual_sd=float(sigma),
                converged=bool(found.converged),
                steps=int(found.steps),
            )
        )
    return estimates


def nonlinear_set(name: str, folder: Path = FOLDER) -> dict[str, Any]:
    """Certificate of a set, with its data as `y` and `predictors`."""
    known, table = certificate(folder, "nonlinear", name)
    y = np.log(table[:, 0]) if name == "Nelson" else table[:, 0]  # its model is of log y
    return {**known, "y": y, "predictors": tuple(table[:, 1:].T)}


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
