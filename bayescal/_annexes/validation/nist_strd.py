"""NIST Statistical Reference Datasets for regression: fits, and their errors relative to the certified values.

The sets are fitted by LeastSquares, nonlinear ones with the equation of their certificate and from both of its starting
points; the largest relative errors are compared. For Filip and the Wamplers, whose powers of x are collinear in double
precision, Legendre polynomials are fitted and converted to powers. P = log10(1 + e/(κ·η)) is the number of digits lost
beyond those that every stable algorithm loses: e is the error of the parameters, κ the condition number of the Jacobian
times the parameters, η = 2.2e-16 (M. Cox and P. Harris, SSfM Best Practice Guide 6, NPL 1999). Certificates of
nonlinear sets have eleven digits, which bounds P from below. Standard deviations of data without noise are rounding
errors and not compared.

Source: NIST StRD (www.itl.nist.gov/div898/strd).
"""

from __future__ import annotations

import itertools
import json
import math
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import Legendre, Polynomial
from numpy.polynomial.legendre import legvander

import bayescal as bc
from bayescal._annexes.validation.regressions import evaluate, fit

FOLDER = Path(__file__).parent / "data" / "nist_strd"
MAX_DIGITS = 16.0  # digits to which doubles can agree
# Ranges of x, over which Legendre polynomials are fitted.
LEGENDRE = {"filip": (-9.0, -3.0)} | {f"wampler{i}": (0.0, 20.0) for i in range(1, 6)}
NOISELESS_DATA_SETS = ("Lanczos1", "wampler1", "wampler2")  # data sets whose sd is a rounding error

ABOUT = " ".join(str(__doc__).split("\n\n")[1].split())


@cache
def load_certificates(kind: str) -> dict[str, Any]:
    """Return the certified values of the "linear" or the "nonlinear" sets, by name."""
    return json.loads((FOLDER / kind / f"certified_{kind}.json").read_text("utf-8"))


class Estimate(NamedTuple):
    """Fitted values of a set, in the order of its certificate, and the certified values."""

    parameters: np.ndarray
    sd: np.ndarray
    residual_sd: float
    converged: bool
    certified: tuple[np.ndarray, np.ndarray, float]  # certified values of the first three fields
    condition_number: float  # κ

    @property
    def errors(self) -> tuple[float, ...]:
        """Return the largest relative errors of parameters, standard deviations and residual standard deviation."""
        return tuple(map(find_relative_error, self[:3], self.certified))

    @property
    def performance(self) -> float:
        """Return P, the number of digits lost."""
        return math.log10(1 + self.errors[0] / (self.condition_number * float(np.finfo(float).eps)))


def fit_data_set(name: str) -> list[Estimate]:
    """Fit a data set by least squares; a nonlinear set from both of its starting points."""
    kind = "linear" if name in load_certificates("linear") else "nonlinear"
    table = np.loadtxt(FOLDER / kind / f"{name}.csv", delimiter=",", skiprows=1)
    return (_fit_linear if kind == "linear" else _fit_nonlinear)(name, table[:, 0], table[:, 1:])


def _fit_linear(name: str, y: np.ndarray, x: np.ndarray) -> list[Estimate]:
    entry = load_certificates("linear")[name]
    degrees = [int(t[2:]) for t in entry["terms"] if t.startswith("x^")]
    design = x ** np.array(degrees) if degrees else np.insert(x, 0, 1.0, axis=1)
    matrix, regressors = np.eye(design.shape[1]), design
    if name in LEGENDRE:
        low, high = LEGENDRE[name]
        regressors = legvander((2 * x[:, 0] - low - high) / (high - low), degrees[-1])
        for k in degrees:  # β = matrix·γ, of powers by Legendre polynomials
            powers = Legendre.basis(k, domain=[low, high]).convert(domain=[-1, 1], kind=Polynomial)
            matrix[: k + 1, k] = powers.coef
    c = fit(y, {f"x{i}": column for i, column in enumerate(regressors.T)})
    draws = c.draws()[0] @ matrix.T
    mean = matrix @ (c.mode.x + c.layout.x_origins)  # the mean of draws except for rounding
    certified = [np.array(entry[f"{key}_exact"], float) for key in ("beta", "sd", "residual_sd")]
    return [_estimate(c, mean, draws, certified, design * certified[0])]


def _fit_nonlinear(name: str, y: np.ndarray, x: np.ndarray) -> list[Estimate]:
    entry = load_certificates("nonlinear")[name]
    lines = itertools.takewhile(lambda line: not line.startswith("Starting"), entry["model"][2:])
    text = " ".join(lines)
    response, _, equation = text[text.index("y") :].partition("=")
    expected = equation.strip().removesuffix("e").rstrip(" +")
    y = np.log(y) if "]" in response else y  # Nelson's response is log[y]
    columns: dict[str, Any] = dict(
        zip(("x1", "x2") if x.shape[1] > 1 else ("x",), x.T, strict=True)
    )
    certified = (np.array(entry["certified"]), np.array(entry["sd"]), entry["residual_sd"])

    def evaluate_shifted(i: int) -> Any:
        b = certified[0] * (1 + 1e-30j * (np.arange(len(certified[0])) == i))  # a complex step
        return evaluate(expected, columns | {f"b{k}": value for k, value in enumerate(b, 1)})

    slopes = np.transpose([np.imag(evaluate_shifted(i)) * 1e30 for i in range(len(certified[0]))])
    fits = []
    for start in (entry["start1"], entry["start2"]):
        c = fit(y, columns, start, expected, method=bc.LeastSquares(draws=512))
        draws = start + c.draws()[0] + c.layout.x_origins  # draws with the moments of the fit
        fits.append(_estimate(c, draws.mean(axis=0), draws, certified, slopes))
    return fits


def _estimate(c: bc.Calibration, mean: Any, draws: Any, certified: Any, slopes: Any) -> Estimate:
    noise, kappa = float(c.samples("noise.white")[0]), float(np.linalg.cond(slopes))
    return Estimate(mean, draws.std(axis=0, ddof=1), noise, c.verdict.ok, certified, kappa)


def find_relative_error(value: Any, certified: Any) -> float:
    """Return the largest relative error; the absolute error where the certified value is zero."""
    true = np.asarray(certified, float)
    error = float(np.max(np.abs(value - true) / np.where(true == 0, 1.0, np.abs(true))))
    return math.inf if math.isnan(error) else error


def count_digits(error: float) -> float:
    """Return the log relative error −log10(error), the number of agreeing digits, from 0 to `MAX_DIGITS`."""
    return MAX_DIGITS if error < 10.0**-MAX_DIGITS else max(0.0, -math.log10(error))
