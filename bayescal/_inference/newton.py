"""Mode, Laplace evidence and weighted draws of a log density of few coordinates, of which many cost little at once.

Slopes and curvatures are central differences, in coordinates in which the density is about standard normal: so a step
is right whether the readings know a coordinate to a tenth or to a billionth.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from bayescal._core.importance_weights import smoothed
from bayescal._inference.gaussian import LOG_2PI
from bayescal._inference.laplace import Mode
from bayescal._inference.sampling import adapted, propose

FIRST_DIFFERENCE = 0.02  # of a coordinate over its scale,
DIFFERENCE = 0.1  # and of one that is about standard normal
LEAST_CURVATURE = 0.05  # in scaled coordinates, that counts as one
LONGEST_STEP = 1.5  # of a scaled coordinate
STEP_SHARES = np.array([1.0, 2.0, 0.5, 0.2, 0.05])  # of a Newton step that are tried
ITERATIONS = 40  # at most; five are usual
CONVERGED_NATS = 1e-4  # that a Newton step would gain, below which the mode is found
ROUNDS = 4  # of proposals that are adapted, at most

Values = Callable[
    [Float[np.ndarray, "s d"]], Float[np.ndarray, "s"]
]  # log density of several points


class GaussianFit(NamedTuple):
    """A density at its mode.

    Attributes:
        v: the mode (d,).
        root: L of the inverse Hessian L·Lᵀ (d, d).
        log_density: at the mode.
        log_evidence: by Laplace's approximation.
    """

    v: Float[np.ndarray, "d"]
    root: Float[np.ndarray, "d d"]
    log_density: float
    log_evidence: float


def climb(values: Values, v: Float[np.ndarray, "d"], scale: Float[np.ndarray, "d"]) -> GaussianFit:
    """Return the mode by Newton's method with a line search.

    Args:
        values: log density.
        v: where to begin.
        scale: of each coordinate, in which its prior is about standard normal or wider.
    """
    root, difference, value = np.eye(len(v)), FIRST_DIFFERENCE, float(values(v[None])[0])
    for _ in range(ITERATIONS):
        slope, hessian = _differences(values, v, value, scale[:, None] * root * difference)
        inverse = np.linalg.inv(root) / difference
        slope, hessian = inverse.T @ slope, inverse.T @ hessian @ inverse
        if not np.all(np.isfinite(hessian)):
            break
        weights, vectors = np.linalg.eigh(hessian)
        root = vectors / np.sqrt(np.maximum(weights, LEAST_CURVATURE))
        step = root @ (root.T @ slope)
        converged = difference == DIFFERENCE and 0.5 * float(slope @ step) < CONVERGED_NATS
        step *= min(1.0, LONGEST_STEP / max(float(np.max(np.abs(step))), 1e-300))
        tries = v + STEP_SHARES[:, None] * step * scale
        found = values(tries)
        best, difference = int(np.argmax(found)), DIFFERENCE
        if found[best] > value:
            v, value = tries[best], float(found[best])
        elif converged or float(slope @ step) < CONVERGED_NATS:
            converged = True
        if converged:
            break
    root = scale[:, None] * root
    volume = 0.5 * len(v) * LOG_2PI + float(np.linalg.slogdet(root)[1])
    return GaussianFit(v, root, value, value + volume)


def _differences(
    values: Values, v: Float[np.ndarray, "d"], value: float, steps: Float[np.ndarray, "d d"]
) -> tuple[Float[np.ndarray, "d"], Float[np.ndarray, "d d"]]:
    """Return slopes of a log density along steps, its columns, and its negative curvatures."""
    dim = len(v)
    pairs = list(itertools.combinations(range(dim), 2))
    first, second = (list(p) for p in zip(*pairs, strict=True)) if pairs else ([], [])
    moves = np.concatenate([steps.T, steps.T[first] + steps.T[second]])
    up, down = values(np.concatenate([v + moves, v - moves])).reshape(2, -1)
    bends = 2 * value - up - down
    hessian = np.diag(bends[:dim])
    hessian[first, second] = 0.5 * (bends[dim:] - bends[first] - bends[second])
    return 0.5 * (up - down)[:dim], hessian + np.triu(hessian, 1).T


def importance_draws(
    values: Values, fit: GaussianFit, seed: int, count: int
) -> tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "s"], float]:
    """Return draws (s, d), their smoothed weights, summing to one, and the log evidence.

    Proposals are adapted in the coordinates of the Gaussian fit.

    Args:
        values: log density.
        fit: at its mode.
        seed: of every random number.
        count: of draws.
    """
    dim, random = len(fit.v), np.random.default_rng(seed)
    origin, identity = np.zeros(dim), np.eye(dim)
    mode = Mode(origin[:0], origin, identity, fit.log_density, 0.0, 0.0, origin[:0], False)

    def centred(u: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
        return values(fit.v + u @ fit.root.T)

    mixture = adapted(mode, centred, None, random, count // 2, ROUNDS, math.inf)
    u, log_proposal = propose(mixture, None, random, count)
    log_weight = centred(u) - log_proposal
    evidence = float(np.asarray(logsumexp(log_weight))) - math.log(count)
    evidence += float(np.linalg.slogdet(fit.root)[1])
    return fit.v + u @ fit.root.T, smoothed(log_weight)[0], evidence
