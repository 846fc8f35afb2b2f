"""The mode of a log density of few coordinates by Newton's method, and the Gaussian fit there.

Coordinates are about standard normal a priori. Where gradient and curvature have no closed form they are differences
(`ByValues`), with steps of a tenth of what the density itself allows: right whether the readings know a coordinate to
a tenth or to a billionth.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float

from bayescal._inference.gaussian import LOG_2PI

FIRST_DIFFERENCE = 0.02  # of a coordinate over its scale,
DIFFERENCE = 0.1  # and of one in which the density is about standard normal
LONG_STEP_CURVATURE = (
    100.0  # in prior standard deviations, from which a first difference is too long
)
LEAST_CURVATURE = 0.05  # that counts as one
LONGEST_STEP = 1.5  # in prior standard deviations
STEPS, SHORTENINGS, SHORTER = (
    100,
    8,
    0.3,
)  # uphill at most; of a step that leads down, by how much each
CONVERGED_NATS = 1e-7  # that a step would gain, below which the mode is found,
ROUGHLY = 0.01  # and where nothing hangs on it
# Of a direction's squared length beside spreads, up to which it is one of spreads.
SPREAD_SHARE = 0.1

Values = Callable[
    [Float[np.ndarray, "s d"]], Float[np.ndarray, "s"]
]  # log density of several points


class Climbable(Protocol):
    """A log density with gradient and curvature; `scale` is of its coordinates."""

    scale: Any

    def value(self, v: Float[np.ndarray, "d"]) -> float: ...
    def evaluate(self, v: Float[np.ndarray, "d"]) -> Any: ...


class Slopes(NamedTuple):
    """A log density at a point, its gradient, and its negative curvature."""

    log_density: float
    gradient: Float[np.ndarray, "d"]
    curvature: Float[np.ndarray, "d d"]


class GaussianFit(NamedTuple):
    """A density at its mode.

    Attributes:
        v: the mode (d,).
        covariance: inverse curvature (d, d).
        log_density: at the mode.
        log_evidence: by Laplace's approximation.
        indefinite: whether the curvature had to be mended.
    """

    v: Float[np.ndarray, "d"]
    covariance: Float[np.ndarray, "d d"]
    log_density: float
    log_evidence: float
    indefinite: bool


def climb(
    density: Climbable, v: Float[np.ndarray, "d"], wanted_from: float = -math.inf
) -> Float[np.ndarray, "d"]:
    """Return the mode uphill from v.

    Directions that the density bends up along are gone the other way, those that it hardly bends along as if it did
    (J. Nocedal and S. Wright, Numerical Optimization, 2006, §3.4).

    Args:
        density: which.
        v: where to begin.
        wanted_from: log density, below which a mode found to a hundredth of a nat will do.
    """
    scale = np.broadcast_to(density.scale, v.shape)
    for _ in range(STEPS if len(v) else 0):
        if (here := density.evaluate(v)) is None:
            break
        bend, vectors = np.linalg.eigh(scale[:, None] * here.curvature * scale)
        slope = scale * here.gradient
        step = vectors @ (vectors.T @ slope / np.maximum(np.abs(bend), LEAST_CURVATURE))
        gain = float(step @ slope)
        if 0.5 * gain < (CONVERGED_NATS if here.log_density > wanted_from else ROUGHLY):
            break
        share = min(1.0, LONGEST_STEP / float(np.max(np.abs(step))))
        for _ in range(SHORTENINGS):
            further = v + share * scale * step
            # Sufficient increase: some of what the slope promised (same, eq. 3.4).
            if density.value(further) >= here.log_density + 1e-4 * share * gain:
                break
            share *= SHORTER
        else:
            break
        v = further
    return v


def gaussian_fit(
    density: Climbable, v: Float[np.ndarray, "d"], spreads: Bool[np.ndarray, "d"] | bool = False
) -> GaussianFit:
    """Return the Gaussian fit at a mode.

    Where the curvature had to be mended along `spreads` alone, which lie flat on the way to zero, it does not count.
    Source: L. Tierney and J. Kadane, JASA 81 (1986) 82 (Laplace).
    """
    found = density.evaluate(v)
    if found is None:  # a step away the density is nowhere: no hill that a Gaussian describes
        return GaussianFit(v, np.full((len(v), len(v)), np.nan), density.value(v), -math.inf, True)
    scale = np.broadcast_to(density.scale, v.shape)
    weights, vectors = np.linalg.eigh(scale[:, None] * found.curvature * scale)
    # Less than a twentieth is no hill but the flank of one, such as a spread's way to zero: mended, its proposals stay
    # finite.
    mended = np.maximum(weights, LEAST_CURVATURE)
    covariance = (vectors / mended) @ vectors.T * np.outer(scale, scale)
    volume = 0.5 * len(v) * LOG_2PI - 0.5 * float(np.sum(np.log(mended / scale**2)))
    share = np.sum(vectors[~np.broadcast_to(spreads, len(v))] ** 2, axis=0)
    indefinite = bool(np.any((weights < LEAST_CURVATURE) & (share > SPREAD_SHARE)))
    covariance, value = 0.5 * (covariance + covariance.T), found.log_density
    return GaussianFit(v, covariance, value, value + volume, indefinite)


class ByValues:
    """Slopes and curvature of a log density by central differences.

    Args:
        values: log density of several points.
        scale: of each coordinate, in which its prior is about standard normal or wider.
    """

    def __init__(self, values: Values, scale: Float[np.ndarray, "d"] | float = 1.0) -> None:
        self.values, self.scale = values, scale
        self._root: np.ndarray | None = None  # of the inverse curvature
        self._last: tuple[np.ndarray, Slopes | None] | None = None

    def value(self, v: Float[np.ndarray, "d"]) -> float:
        return float(self.values(v[None])[0])

    def evaluate(self, v: Float[np.ndarray, "d"]) -> Slopes | None:
        """Return value, gradient and curvature; the latest are kept. None where the density is nowhere."""
        if self._last is None or not np.array_equal(self._last[0], v):
            first, found = self._root is None, self._differences(v)
            # In place of a first step that was long against what the density allows, one that is right.
            if (
                first
                and found is not None
                and np.max(np.diag(found.curvature) * np.square(self.scale), initial=0)
                > LONG_STEP_CURVATURE
            ):
                found = self._differences(v)
            self._last = v.copy(), found
        return self._last[1]

    def _differences(self, v: Float[np.ndarray, "d"]) -> Slopes | None:
        dim, scale = len(v), np.broadcast_to(self.scale, v.shape)
        first = self._root is None
        root = np.diag(scale) if self._root is None else self._root
        steps = (FIRST_DIFFERENCE if first else DIFFERENCE) * root
        pairs = np.array(list(itertools.combinations(range(dim), 2)), dtype=int).reshape(-1, 2)
        moves = np.concatenate([steps.T, steps.T[pairs[:, 0]] + steps.T[pairs[:, 1]]])
        found = self.values(np.concatenate([v[None], v + moves, v - moves]))
        value, (up, down) = float(found[0]), found[1:].reshape(2, -1)
        bends = 2 * value - up - down
        hessian = np.diag(bends[:dim])
        across = 0.5 * (bends[dim:] - bends[pairs[:, 0]] - bends[pairs[:, 1]])
        hessian[pairs[:, 0], pairs[:, 1]] = hessian[pairs[:, 1], pairs[:, 0]] = across
        inverse = np.linalg.inv(steps)
        gradient = inverse.T @ (0.5 * (up - down)[:dim])
        curvature = inverse.T @ hessian @ inverse
        if not np.max(np.abs(found)) < 1e200 or not np.all(np.isfinite(curvature)):
            return None
        weights, vectors = np.linalg.eigh(scale[:, None] * curvature * scale)
        self._root = scale[:, None] * vectors / np.sqrt(np.maximum(weights, LEAST_CURVATURE))
        return Slopes(value, gradient, 0.5 * (curvature + curvature.T))
