"""The mode of a log density of few coordinates by Newton's method, and the Gaussian fit there.

Coordinates are about standard normal a priori. Where gradient and curvature have no closed form they are differences
(`ByValues`), with steps of a twentieth of what the density itself allows: right whether the readings know a coordinate
to a tenth or to a billionth.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from bayescal._inference.gaussian import LOG_2PI

FIRST_DIFFERENCE = 0.02  # of a coordinate over its scale,
DIFFERENCE = 0.05  # and of one in which the density is about standard normal;
ONE_SIDED = 0.2  # of these, where bends are nearly known
LEAST_CURVATURE = 0.05  # that counts as one
# Correlation and standard deviations, up to which two coordinates hardly bend together, and one has not moved.
LOOSE, UNMOVED = 0.03, 0.1
LONGEST_STEP = 1.5  # in prior standard deviations
STEPS = 100  # uphill at most
SHORTENINGS, SHORTER = 8, 0.3  # of a step that leads down, by how much each
# That a step would gain, below which the mode is found, if not said: differences hold no more,
CONVERGED_NATS = 1e-6
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


class Nearby(NamedTuple):
    """The curvature of a density that is much alike at a point, and which coordinates it knows as well as this one."""

    v: Float[np.ndarray, "d"]
    curvature: Float[np.ndarray, "d d"]
    reliable: Bool[np.ndarray, "d"] | bool = False


class GaussianFit(NamedTuple):
    """A density at its mode: inverse curvature, evidence by Laplace, and whether the curvature had to be mended."""

    v: Float[np.ndarray, "d"]
    covariance: Float[np.ndarray, "d d"]
    log_density: float
    log_evidence: float
    indefinite: bool


def climb(
    density: ByValues,
    v: Float[np.ndarray, "d"],
    coarse_below: float = -math.inf,
    ftol: float = CONVERGED_NATS,
) -> Float[np.ndarray, "d"]:
    """Climb from v to the mode by Newton steps with a line search; tolerance `ftol` nats, coarse below `coarse_below`.

    Directions that the density bends up along are gone the other way, those that it hardly bends along as if it did
    (J. Nocedal and S. Wright, Numerical Optimization, 2006, §3.4).
    """
    scale, doubtful, reach = np.broadcast_to(density.scale, v.shape), False, LONGEST_STEP
    for _ in range(STEPS if len(v) else 0):
        if (current := density.evaluate(v, exact=doubtful)) is None:
            break
        bend, vectors = np.linalg.eigh(scale[:, None] * current.curvature * scale)
        slope = scale * current.gradient
        step = vectors @ (vectors.T @ slope / np.maximum(np.abs(bend), LEAST_CURVATURE))
        gain = float(step @ slope)
        if 0.5 * gain < (ftol if current.log_density > coarse_below else ROUGHLY):
            break
        length = float(np.max(np.abs(step)))
        share = whole = min(1.0, reach / length)
        for _ in range(SHORTENINGS):
            further = v + share * scale * step
            gained = density.value(further) - current.log_density
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
        # Where a step was too long the next may not be twice as long as what was left of it (a trust region).
        reach = (
            min(LONGEST_STEP, 2 * length * share) if share < whole else min(LONGEST_STEP, 2 * reach)
        )
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
    slopes = density.evaluate(v, exact)
    if slopes is None:  # a step away the density is nowhere: no hill that a Gaussian describes
        return GaussianFit(v, np.full((len(v), len(v)), np.nan), density.value(v), -math.inf, True)
    scale = np.broadcast_to(density.scale, v.shape)
    weights, vectors = np.linalg.eigh(scale[:, None] * slopes.curvature * scale)
    # Less than a twentieth is the flank of a hill, such as a spread's way to zero: mended, proposals stay finite.
    mended = np.maximum(weights, LEAST_CURVATURE)
    covariance = (vectors / mended) @ vectors.T * np.outer(scale, scale)
    volume = 0.5 * len(v) * LOG_2PI - 0.5 * float(np.sum(np.log(mended / scale**2)))
    share = np.sum(vectors[~np.broadcast_to(spreads, len(v))] ** 2, axis=0)
    indefinite = bool(np.any((weights < LEAST_CURVATURE) & (share > SPREAD_SHARE)))
    covariance, value = 0.5 * (covariance + covariance.T), slopes.log_density
    return GaussianFit(v, covariance, value, value + volume, indefinite)


class ByValues:
    """Slopes and curvature of a log density by differences; in `scale` priors are about standard normal or wider.

    Of a point that a climb asks for the curvature is carried on from the one before it, or from a density nearby, by
    its bends along the axes and what the gradient changed on the way (BFGS: J. Nocedal and S. Wright, Numerical
    Optimization, 2006, eq. 6.19); where a density nearby knows coordinates as well, differences are one-sided after the
    first point, with the bends of the one before. Where it is to be exact, two coordinates that are known nearby have
    the correlation that they have there, if they hardly bend together or neither has moved.
    """

    def __init__(self, values: Values, scale: Float[np.ndarray, "d"] | float = 1.0) -> None:
        self.values = values
        self.scale = scale
        self._begin()

    def _begin(self, like: Nearby | None = None) -> None:
        """Reset, or begin with the curvature of a similar density."""
        self._like, self._last = like, None
        self._exact = False  # whether the latest curvature is by differences
        self._axes: Any = None  # the latest point, steps along the axes, and values there

    @property
    def nearby(self) -> Nearby | None:
        """Return the latest curvature, for a similar density."""
        last: tuple[np.ndarray, Slopes] | None = self._last
        return self._like if last is None else Nearby(last[0], last[1].curvature)

    def value(self, v: Float[np.ndarray, "d"]) -> float:
        # Most steps of a climb are taken, and their ends evaluated: all at once.
        value = self.evaluate(v)
        return float(self.values(v[None])[0]) if value is None else value.log_density

    def evaluate(self, v: Float[np.ndarray, "d"], exact: bool = False) -> Slopes | None:
        """Return value, gradient and curvature; the latest are kept. None where the density is nowhere."""
        last, near = self._last, self.nearby
        if last is not None and (self._exact or not exact) and np.array_equal(last[0], v):
            return last[1]
        scale = np.broadcast_to(self.scale, v.shape)
        steps = FIRST_DIFFERENCE * scale
        if near is not None:
            bends = np.maximum(np.diag(near.curvature) * scale**2, LEAST_CURVATURE)
            steps = DIFFERENCE * scale / np.sqrt(bends)
        slopes = None
        if last is not None and not exact and self._like and np.any(self._like.reliable):
            slopes = self._one_sided(v, ONE_SIDED * steps, last[1])
        slopes = slopes or self._differences(v, steps, exact)
        if near is not None and slopes is not None and not exact:
            curvature = _carried(near.curvature, last, v, slopes, LEAST_CURVATURE / scale**2)
            slopes = slopes._replace(curvature=curvature)
        if slopes is not None:
            self._last, self._exact = (v.copy(), slopes), exact
        return slopes

    def _one_sided(
        self, v: Float[np.ndarray, "d"], steps: Float[np.ndarray, "d"], last: Slopes
    ) -> Slopes | None:
        """Return the slopes by steps up, with the bends of the point before."""
        value, *ends = self.values(np.concatenate([v[None], v + np.diag(steps)]))
        if not min(value, *ends) > NOWHERE:
            return None
        bends = np.diag(last.curvature)
        return Slopes(value, (np.array(ends) - value) / steps + 0.5 * steps * bends, np.diag(bends))

    def _differences(
        self, v: Float[np.ndarray, "d"], steps: Float[np.ndarray, "d"], curved: bool
    ) -> Slopes | None:
        axes = self._axes if curved and self._axes and np.array_equal(self._axes[0], v) else None
        for _ in range(SHORTENINGS):
            # Along the axes: what a coordinate of the noise moves is computed at columns that stay.
            moves = np.diag(steps if axes is None else axes[1])
            if axes is None:
                axes = v.copy(), steps, self.values(np.concatenate([v[None], v + moves, v - moves]))
            (_, steps, (value, *ends)), self._axes, axes = axes, axes, None
            if not value > NOWHERE:
                return None
            up, down = np.reshape(ends, (2, len(v)))
            bends = 2 * value - up - down
            # In place of a step that was long against what the density allows, one that is right.
            if np.any(long := bends > 4 * DIFFERENCE**2):
                right = np.maximum(DIFFERENCE / np.sqrt(np.where(long, bends, 1.0)), LEAST_SHARE)
                steps = steps * np.where(long, right, 1.0)
                continue
            hessian = self._bent(v, bends) if curved else np.diag(bends)
            i, j = np.nonzero(np.triu(np.isnan(hessian)))
            if len(i):
                both = moves[i] + moves[j]
                ends = self.values(np.concatenate([v + both, v - both]))
                if not np.min(ends) > NOWHERE:
                    steps = SHORTER * steps
                    continue
                bent = 2 * value - ends.reshape(2, -1).sum(axis=0)
                hessian[i, j] = hessian[j, i] = 0.5 * (bent - bends[i] - bends[j])
            return Slopes(value, 0.5 * (up - down) / steps, hessian / np.outer(steps, steps))
        return None

    def _bent(self, v: Float[np.ndarray, "d"], bends: Float[np.ndarray, "d"]) -> np.ndarray:
        """Return second differences: along the axes, between them by correlations nearby; NaN where none are known."""
        second, near = np.full((len(v), len(v)), np.nan), self._like
        if near is not None:
            size = np.sqrt(np.maximum(np.diag(near.curvature), np.finfo(float).tiny))
            curvature, is_known = near.curvature / np.outer(size, size), near.reliable & (bends > 0)
            unmoved = np.abs(v - near.v) * size < UNMOVED
            stays = (np.abs(curvature) < LOOSE) | np.outer(unmoved, unmoved)
            stays &= np.outer(is_known, is_known)
            second[stays] = (curvature * np.sqrt(np.abs(np.outer(bends, bends))))[stays]
        np.fill_diagonal(second, bends)
        return second


def _carried(
    curvature: Float[np.ndarray, "d d"],
    last: tuple[np.ndarray, Slopes] | None,
    v: Float[np.ndarray, "d"],
    slopes: Slopes,
    least: Float[np.ndarray, "d"],
) -> Float[np.ndarray, "d d"]:
    """Return a curvature as it is at v: with the bends along the axes there and, by BFGS, what the gradient changed."""
    before, new = np.diag(curvature), np.diag(slopes.curvature)
    fit = (new > least) & (before > 0)
    ratio = np.sqrt(np.where(fit, new, 1.0) / np.where(fit, before, 1.0))
    curvature = ratio[:, None] * curvature * ratio
    if last is None:
        return curvature
    step, lost = v - last[0], last[1].gradient - slopes.gradient
    bent = curvature @ step
    along, by = float(step @ lost), float(step @ bent)
    if not along > 1e-12 or not by > 1e-12:
        return curvature
    return curvature + np.outer(lost, lost) / along - np.outer(bent, bent) / by
