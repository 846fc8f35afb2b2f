"""Smooth terms: an unknown dependence on a covariate, by the columns of `unknown(covariate)`.

Averaged over length and amplitude, a covariate's log Bayes factor says whether the residuals hold structure against
it. It is the score test of a variance component, in the metric in which all nuisances are marginalised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from bayescal._calibration.fitted import Fitted
from bayescal._core.errors import InputError
from bayescal._model.unknown_effect import process_columns, process_weights, resolution

SCALES = (3, 4)  # lengths of the process over their plausible range; in time, where that is wider
AMPLITUDES = tuple(np.geomspace(0.15, 15.0, 7))  # in noise standard deviations
WAVES = 2  # along each of two covariates together
INVISIBLE = 1e-12  # I·W of a direction below this: its prior spread is lost in its uncertainty
ROUNDING = 64 * float(np.finfo(float).eps)  # of the largest of its group: below it is only rounding


@dataclass(frozen=True)
class Covariate:
    """A covariate and its columns (n, k), with the weights (k,) that make them of unit amplitude at each length.

    `levels` are the members' names where the covariate is a group, whose values are their numbers.
    """

    name: str
    values: np.ndarray
    columns: np.ndarray
    weights: tuple[np.ndarray, ...]
    unit: str = ""
    levels: tuple[str, ...] = ()


def smooth(name: str, values: np.ndarray, unit: str = "", *, in_time: bool = False) -> Covariate:
    """A smooth dependence on a covariate that takes several values."""
    terms, plausible = resolution(in_time)
    span = np.ptp(values)
    position = (values - values.min()) / (span if span > 0 else 1.0)
    lengths = np.geomspace(*plausible, SCALES[in_time])
    weights = tuple(process_weights(length, terms) for length in lengths)
    return Covariate(name, values, process_columns(position, terms), weights, unit)


def members(name: str, codes: np.ndarray, levels: tuple[str, ...]) -> Covariate:
    """One level for each member of a group."""
    indicator = (codes[:, None] == np.unique(codes[codes >= 0])[None, :]).astype(float)
    even = (np.ones(indicator.shape[1]),)
    return Covariate(name, codes.astype(float), indicator, even, levels=levels)


def together(first: Covariate, second: Covariate) -> Covariate:
    """An interaction of two covariates, not explained by additive terms: products of long waves along them."""
    one, two = _waves(first.values), _waves(second.values)
    basis = (one[:, :, None] * two[:, None, :]).reshape(len(one), -1)
    scale = np.sqrt(np.mean(np.sum(basis**2, axis=1)))
    weights = (np.full(basis.shape[1], 1 / max(scale, 1e-300)),)
    return Covariate(f"{first.name} × {second.name}", first.values, basis, weights)


def _waves(values: np.ndarray) -> np.ndarray:
    """Legendre polynomials of the first orders over the range, without the constant."""
    low, high = values.min(), values.max()
    position = 2 * (values - low) / (high - low) - 1
    return np.polynomial.legendre.legvander(position, WAVES)[:, 1:]


def log_bayes_factors(
    calibration: Fitted, covariates: list[Covariate], noise: float
) -> list[float]:
    """For each covariate the log Bayes factor of a dependence on it against none.

    Args:
        noise: standard deviation that amplitudes are counted in, output unit.
    """
    found = []
    for covariate in covariates:
        u, information = calibration.linear.score(covariate.columns * noise)
        terms = [
            at_sizes(weight * u, weight[:, None] * information * weight, AMPLITUDES)
            for weight in covariate.weights
        ]
        found.append(float(logsumexp(terms) - np.log(np.size(terms))))
    return found


def at_sizes(
    score: Float[np.ndarray, "k"], information: Float[np.ndarray, "k k"], sizes: Sequence[float]
) -> Float[np.ndarray, "s"]:
    """Log Bayes factors, in nats, of one group of columns at prior standard deviations common to all of its columns.

    Each is ½ u'(W⁻¹ + I)⁻¹u − ½ log|1 + IW|, W the prior variance. A direction without information counts nothing, so
    that zero and linearly dependent columns are allowed.

    Raises:
        InputError: score or information is not finite.
    """
    if not (np.isfinite(score).all() and np.isfinite(information).all()):
        raise InputError(
            "the score of a group of columns is not finite: every prior must be proper"
        )
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    variance = np.square(np.asarray(sizes, float))[:, None]
    spread = variance * values
    seen = spread > np.maximum(INVISIBLE, ROUNDING * spread[:, -1:])
    spread = np.where(seen, spread, 0.0)
    energy = np.where(seen, variance * (vectors.T @ score) ** 2, 0.0) / (1 + spread)
    return 0.5 * np.sum(energy - np.log1p(spread), axis=1)
