"""Smooth blocks: an unknown dependence on a covariate, as a Gaussian process of few columns.

Averaged over length and amplitude, a block's log Bayes factor says whether the residuals hold structure against that
covariate. It is the score test of a variance component, in the metric in which all nuisances are marginalised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from bayescal._calibration.calibration import Calibration
from bayescal._diagnostics import efficient_score
from bayescal._discovery import susie

LENGTHS = (0.08, 0.25, 0.8)  # of the process, in parts of the covariate's range
SHORT = 0.03  # and in time, where there are cycles and jumps
AMPLITUDES = tuple(np.geomspace(0.15, 15.0, 7))  # in noise standard deviations
KNOTS, KNOTS_IN_TIME = 14, 40
WAVES = 2  # along each of two covariates together


@dataclass(frozen=True)
class Block:
    """A covariate and its columns, each length a set of columns of unit amplitude.

    `levels` are the members' names where the covariate is a group, whose values are their numbers.
    """

    name: str
    values: np.ndarray
    bases: tuple[np.ndarray, ...]
    unit: str = ""
    levels: tuple[str, ...] = ()


def smooth(name: str, values: np.ndarray, unit: str = "", *, in_time: bool = False) -> Block:
    """A smooth dependence on a covariate that takes several values."""
    lengths, most = ((SHORT, *LENGTHS), KNOTS_IN_TIME) if in_time else (LENGTHS, KNOTS)
    span = np.ptp(values)
    position = (values - values.min()) / (span if span > 0 else 1.0)
    distinct = np.unique(position)
    knots = distinct if len(distinct) <= most else np.linspace(0, 1, most)
    return Block(name, values, tuple(_process(position, knots, length) for length in lengths), unit)


def _process(position: np.ndarray, knots: np.ndarray, length: float) -> np.ndarray:
    """Columns Φ with ΦΦᵀ near the squared-exponential kernel (its Nyström form on the knots)."""

    def kernel(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.exp(-0.5 * ((a[:, None] - b[None, :]) / length) ** 2)

    values, vectors = np.linalg.eigh(kernel(knots, knots))
    keep = values > 1e-8 * values.max()
    return kernel(position, knots) @ (vectors[:, keep] / np.sqrt(values[keep]))


def members(name: str, codes: np.ndarray, levels: tuple[str, ...]) -> Block:
    """One level for each member of a group."""
    indicator = (codes[:, None] == np.unique(codes[codes >= 0])[None, :]).astype(float)
    return Block(name, codes.astype(float), (indicator,), levels=levels)


def together(first: Block, second: Block) -> Block:
    """A dependence on two covariates at once that is no sum of one on each: products of long waves along them."""
    one, two = _waves(first.values), _waves(second.values)
    basis = (one[:, :, None] * two[:, None, :]).reshape(len(one), -1)
    scale = np.sqrt(np.mean(np.sum(basis**2, axis=1)))
    return Block(f"{first.name} × {second.name}", first.values, (basis / max(scale, 1e-300),))


def _waves(values: np.ndarray) -> np.ndarray:
    """Legendre polynomials of the first orders over the range, without the constant."""
    low, high = values.min(), values.max()
    position = 2 * (values - low) / (high - low) - 1
    return np.polynomial.legendre.legvander(position, WAVES)[:, 1:]


def log_bayes_factors(calibration: Calibration, blocks: list[Block], noise: float) -> list[float]:
    """For each block the log Bayes factor of a dependence on it against none.

    Args:
        noise: standard deviation that amplitudes are counted in, output unit.
    """
    if not blocks:
        return []
    bases = [basis for block in blocks for basis in block.bases]
    score = efficient_score.score(calibration, np.concatenate(bases, axis=1) * noise)
    found, at = [], 0
    for block in blocks:
        terms = []
        for basis in block.bases:
            part = score.part(list(range(at, at + basis.shape[1])))
            at += basis.shape[1]
            terms += [
                susie.log_bayes_factor(part.u, part.information, np.full(len(part.u), a**2))
                for a in AMPLITUDES
            ]
        found.append(float(logsumexp(terms) - np.log(len(terms))))
    return found
