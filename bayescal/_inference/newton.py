"""The mode of a log density of few coordinates by Newton's method, and the Gaussian fit there.

Coordinates are about standard normal a priori. Where gradient and curvature have no closed form they are differences
(`ByValues`), with steps of a twentieth of what the density itself allows: right whether the readings know a coordinate
to a tenth or to a billionth.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from bayescal._inference.gaussian import LOG_2PI

FIRST_DIFFERENCE = 0.02  # of a coordinate over its scale,
DIFFERENCE = 0.05  # and of one in which the density is about standard normal
LEAST_CURVATURE = 0.05  # that counts as one
LONGEST_STEP = 1.5  # in prior standard deviations
STEPS = 100  # uphill at most
SHORTENINGS, SHORTER = 8, 0.3  # of a step that leads down, by how much each
CONVERGED_NATS = 1e-7  # that a step would gain, below which the mode is found,
ROUGHLY = 0.01  # and where nothing hangs on it
# Of a direction's squared length beside spreads, up to which it is one of spreads.
SPREAD_SHARE = 0.1
LEAST_SHARE = 0.1  # of a step, that it is shortened to at once
NOWHERE = -1e300  # log density where there is none

Values = Callable[[np.ndarray], np.ndarray]  # log density of several points, (s, d) → (s,)


class Slopes(NamedTuple):
    """A log density at a point, its gradient, and its negative curvature."""

    log_density: float
    gradient: Float[np.ndarray, "d"]
    curvature: Float[np.ndarray, "d d"]


class GaussianFit(NamedTuple):
    """A density at its mode: inverse curvature, evidence by Laplace, and whether the curvature had to be mended."""

    v: Float[np.ndarray, "d"]
    covariance: Float[np.ndarray, "d d"]
    log_density: float
    log_evidence: float
    indefinite: bool


def climb(
    density: ByValues, v: Float[np.ndarray, "d"], wanted_from: float = -math.inf
) -> Float[np.ndarray, "d"]:
    """Return the mode uphill from v; below `wanted_from` one that is found to a hundredth of a nat will do.

    Directions that the density bends up along are gone the other way, those that it hardly bends along as if it did
    (J. Nocedal and S. Wright, Numerical Optimization, 2006, §3.4).
    """
    scale, doubtful = np.broadcast_to(density.scale, v.shape), False
    for _ in range(STEPS if len(v) else 0):
        if (here := density.evaluate(v, exact=doubtful)) is None:
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
            gained = density.value(further) - here.log_density
            # Sufficient increase: some of what the slope promised (same, eq. 3.4).
            if gained >= 1e-4 * share * gain:
                break
            share *= SHORTER
        else:
            if doubtful:
                break
            doubtful = True
            continue
        # On no hill a curvature that is carried on would not become right.
        doubtful, v = bool(bend[0] < 0), further
    return v


def gaussian_fit(
    density: ByValues,
    v: Float[np.ndarray, "d"],
    spreads: Bool[np.ndarray, "d"] | bool = False,
    exact: bool = True,
) -> GaussianFit:
    """Return the Gaussian fit at a mode.

    Where the curvature had to be mended along `spreads` alone, which lie flat on the way to zero, it does not count.
    Not `exact`: with the curvature that a climb carried on.
    Source: L. Tierney and J. Kadane, JASA 81 (1986) 82 (Laplace).
    """
    found = density.evaluate(v, exact)
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
    """Slopes and curvature of a log density by differences; in `scale` priors are about standard normal or wider.

    Of a point that is asked for by a climb the curvature is carried on from the one before it, by what the gradient
    changed on the way (BFGS: J. Nocedal and S. Wright, Numerical Optimization, 2006, eq. 6.19).
    """

    def __init__(self, values: Values, scale: Float[np.ndarray, "d"] | float = 1.0) -> None:
        self.values, self.scale = values, scale
        self._begin()

    def _begin(self, like: ByValues | None = None) -> None:
        """Know nothing yet, or the curvature of a density that is much alike."""
        self._last: tuple[np.ndarray, Slopes] | None = None if like is None else like._last
        self._own = False  # whether this is of the density itself
        self._exact = False  # whether its curvature is by differences

    def value(self, v: Float[np.ndarray, "d"]) -> float:
        # Most steps of a climb are taken, and their ends evaluated: all at once.
        found = self.evaluate(v)
        return float(self.values(v[None])[0]) if found is None else found.log_density

    def evaluate(self, v: Float[np.ndarray, "d"], exact: bool = False) -> Slopes | None:
        """Return value, gradient and curvature; the latest are kept. None where the density is nowhere."""
        last = self._last
        known = self._own and (self._exact or not exact)
        if last is not None and known and np.array_equal(last[0], v):
            return last[1]
        scale = np.broadcast_to(self.scale, v.shape)
        steps = FIRST_DIFFERENCE * scale
        if last is not None:
            bends = np.maximum(np.diag(last[1].curvature) * scale**2, LEAST_CURVATURE)
            steps = DIFFERENCE * scale / np.sqrt(bends)
        found = self._differences(v, steps, exact)
        if last is not None and found is not None and not exact:
            found = found._replace(curvature=_carried(*last, v, found.gradient, self._own))
        if found is not None:
            self._last, self._own, self._exact = (v.copy(), found), True, exact
        return found

    def _differences(
        self, v: Float[np.ndarray, "d"], steps: Float[np.ndarray, "d"], curved: bool
    ) -> Slopes | None:
        # Along the axes: what a coordinate of the noise moves is computed at columns that stay.
        dim, pairs = len(v), [*itertools.combinations(range(len(v)), 2)]
        for _ in range(SHORTENINGS):
            moves = np.diag(steps)
            value, *ends = self.values(np.concatenate([v[None], v + moves, v - moves]))
            if not value > NOWHERE:
                return None
            up, down = np.reshape(ends, (2, dim))
            bends = 2 * value - up - down
            # In place of a step that was long against what the density allows, one that is right.
            if np.any(long := bends > 4 * DIFFERENCE**2):
                right = np.maximum(DIFFERENCE / np.sqrt(np.where(long, bends, 1.0)), LEAST_SHARE)
                steps = steps * np.where(long, right, 1.0)
                continue
            hessian = np.diag(bends)
            if curved and pairs:
                i, j = np.transpose(pairs)
                both = moves[i] + moves[j]
                ends = self.values(np.concatenate([v + both, v - both]))
                if not np.min(ends) > NOWHERE:
                    steps = SHORTER * steps
                    continue
                bent = 2 * value - ends.reshape(2, -1).sum(axis=0)
                hessian[i, j] = hessian[j, i] = 0.5 * (bent - bends[i] - bends[j])
            return Slopes(value, 0.5 * (up - down) / steps, hessian / np.outer(steps, steps))
        return None


def _carried(
    before: Float[np.ndarray, "d"],
    there: Slopes,
    v: Float[np.ndarray, "d"],
    gradient: Float[np.ndarray, "d"],
    same: bool,
) -> Float[np.ndarray, "d d"]:
    """Return the curvature at v, by BFGS from that at a point before; as it is where that is of another density."""
    step, bent, lost = v - before, there.curvature @ (v - before), there.gradient - gradient
    along, by = float(step @ lost), float(step @ bent)
    if not same or not along > 1e-12 or not by > 1e-12:
        return there.curvature
    return there.curvature + np.outer(lost, lost) / along - np.outer(bent, bent) / by
