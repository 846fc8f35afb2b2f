"""Newton's method for the mode of a log density of few coordinates, and the Gaussian (Laplace) fit at the mode.

Coordinates are about standard normal a priori. Without closed forms, gradient and Hessian are finite differences
(`ByValues`) with steps of a twentieth of the density's own width, accurate for any posterior width. "Curvature" is the
negative Hessian throughout.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from bayescal._inference.gaussian import LOG_2PI

FIRST_DIFFERENCE = 0.02  # initial difference step, in prior scales
DIFFERENCE = 0.05  # difference step, in posterior standard deviations
ONE_SIDED = 0.2  # forward difference step over `DIFFERENCE`
MIN_CURVATURE = 0.05  # floor of the eigenvalues of the scaled curvature
# Correlation below which a cross term is reused, and distance (posterior deviations) within which all are.
LOOSE, UNMOVED = 0.03, 0.1
LONGEST_STEP = 1.5  # prior standard deviations
STEPS = 100  # Newton steps at most
BACKTRACKS, SHORTER = 8, 0.3  # of a line search at most; factor of each
CONVERGED_NATS = 1e-6  # default tolerance: predicted increase, about the error of differences
COARSE_NATS = 0.01  # tolerance below `coarse_below`
SPREAD_SHARE = 0.1  # squared length outside group deviations, below which an eigenvector is theirs
MIN_SHRINK = 0.1  # smallest factor by which a difference step is shortened at once
NOWHERE = -1e300  # log density where it is undefined

Values = Callable[[np.ndarray], np.ndarray]  # log density of several points, (s, d) → (s,)


class LocalModel(NamedTuple):
    """Second-order Taylor model of a log density at a point: value, gradient, negative Hessian."""

    log_density: float
    gradient: Float[np.ndarray, "d"]
    curvature: Float[np.ndarray, "d d"]


class Nearby(NamedTuple):
    """Curvature of a similar density at a point; `reliable`: coordinates in which it is as accurate as this one's."""

    v: Float[np.ndarray, "d"]
    curvature: Float[np.ndarray, "d d"]
    reliable: Bool[np.ndarray, "d"] | bool = False


class GaussianFit(NamedTuple):
    """Laplace approximation of a density: mode, inverse curvature, evidence; whether eigenvalues had to be clipped."""

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
    """Maximise from v by Newton steps with a line search; tolerance `ftol` nats, coarse below `coarse_below`.

    Eigenvalues of the curvature are replaced by their absolute values, small ones by a floor (J. Nocedal and S. Wright,
    Numerical Optimization, 2006, §3.4).
    """
    scale, use_exact, radius = np.broadcast_to(density.scale, v.shape), False, LONGEST_STEP
    for _ in range(STEPS if len(v) else 0):
        if (current := density.evaluate(v, exact=use_exact)) is None:
            break
        eigenvalues, vectors = np.linalg.eigh(scale[:, None] * current.curvature * scale)
        gradient = scale * current.gradient
        step = vectors @ (vectors.T @ gradient / np.maximum(np.abs(eigenvalues), MIN_CURVATURE))
        predicted_change = float(step @ gradient)
        if 0.5 * predicted_change < (ftol if current.log_density > coarse_below else COARSE_NATS):
            break
        length = float(np.max(np.abs(step)))
        t = t_max = min(1.0, radius / length)
        for _ in range(BACKTRACKS):
            trial = v + t * scale * step
            change = density.value(trial) - current.log_density
            # Sufficient increase (Armijo condition; ibid., eq. 3.4).
            if change >= 1e-4 * t * predicted_change:
                break
            t *= SHORTER
        else:
            if use_exact:
                break
            use_exact = True
            continue
        # Where the curvature is indefinite a BFGS update would not correct it: recompute.
        use_exact, v = bool(eigenvalues[0] < 0), trial
        # Trust region: after a shortened step the next is at most twice as long.
        radius = min(LONGEST_STEP, 2 * length * t) if t < t_max else min(LONGEST_STEP, 2 * radius)
    return v


def gaussian_fit(
    density: ByValues,
    v: Float[np.ndarray, "d"],
    spreads: Bool[np.ndarray, "d"] | bool = False,
    exact: bool = True,
) -> GaussianFit:
    """Return the Gaussian fit at a mode.

    Clipping along `spreads` (group deviations, flat towards zero) does not count as indefinite. Not `exact`: with the
    BFGS curvature of the maximisation.
    Source: L. Tierney and J. Kadane, JASA 81 (1986) 82 (Laplace).
    """
    slopes = density.evaluate(v, exact)
    if slopes is None:  # the density is undefined within a difference step
        return GaussianFit(v, np.full((len(v), len(v)), np.nan), density.value(v), -math.inf, True)
    scale = np.broadcast_to(density.scale, v.shape)
    eigenvalues, vectors = np.linalg.eigh(scale[:, None] * slopes.curvature * scale)
    # Smaller eigenvalues belong to a flank, such as a deviation towards zero: clipped, so that proposals stay finite.
    clipped = np.maximum(eigenvalues, MIN_CURVATURE)
    covariance = (vectors / clipped) @ vectors.T * np.outer(scale, scale)
    log_volume = 0.5 * len(v) * LOG_2PI - 0.5 * float(np.sum(np.log(clipped / scale**2)))
    other_fraction = np.sum(vectors[~np.broadcast_to(spreads, len(v))] ** 2, axis=0)
    indefinite = bool(np.any((eigenvalues < MIN_CURVATURE) & (other_fraction > SPREAD_SHARE)))
    covariance, value = 0.5 * (covariance + covariance.T), slopes.log_density
    return GaussianFit(v, covariance, value, value + log_volume, indefinite)


class ByValues:
    """Gradient and curvature of a log density by differences; `scale` are prior standard deviations or larger.

    During a maximisation the curvature is updated from the previous point, or a similar density, by its diagonal and a
    BFGS update (J. Nocedal and S. Wright, Numerical Optimization, 2006, eq. 6.19); with a reliable similar density,
    differences are one-sided, from the second point where some coordinates are not. If `exact`, cross terms are
    differences, or correlations of the similar density where these are small or the point is close.
    """

    def __init__(
        self,
        values: Values,
        scale: Float[np.ndarray, "d"] | float = 1.0,
        like: Nearby | None = None,
    ) -> None:
        self.values = values
        self.scale = scale
        self._begin(like)

    def _begin(self, like: Nearby | None = None) -> None:
        """Reset the state, with the curvature of a similar density if given."""
        self._like, self._last = like, None
        self._exact = False  # whether the latest curvature is by differences throughout
        self._axes: Any = None  # the latest point, steps along the axes, and densities there

    def hold_others(self, near: Nearby, free: Bool[np.ndarray, "d"]) -> ByValues:
        """Return the density of the free coordinates, with the others fixed as in `near`."""
        fixed, embedding = np.where(free, 0.0, near.v), np.eye(len(free))[free]
        like = Nearby(near.v[free], near.curvature[np.ix_(free, free)], True)
        return ByValues(lambda vs: self.values(fixed + vs @ embedding), like=like)

    @property
    def nearby(self) -> Nearby | None:
        """Return the latest point and curvature, as a first estimate for a similar density."""
        last: tuple[np.ndarray, LocalModel] | None = self._last
        return self._like if last is None else Nearby(last[0], last[1].curvature)

    def value(self, v: Float[np.ndarray, "d"]) -> float:
        # Most line searches accept the first step: evaluate its gradient at once.
        value = self.evaluate(v)
        return float(self.values(v[None])[0]) if value is None else value.log_density

    def evaluate(self, v: Float[np.ndarray, "d"], exact: bool = False) -> LocalModel | None:
        """Return value, gradient and curvature, the latest cached; None if the density is undefined."""
        last, near = self._last, self.nearby
        if last is not None and (self._exact or not exact) and np.array_equal(last[0], v):
            return last[1]
        scale = np.broadcast_to(self.scale, v.shape)
        steps = FIRST_DIFFERENCE * scale
        if near is not None:
            curvatures = np.maximum(np.diag(near.curvature) * scale**2, MIN_CURVATURE)
            steps = DIFFERENCE * scale / np.sqrt(curvatures)
        expansion, reliable = None, np.False_ if self._like is None else self._like.reliable
        if near is not None and not exact and (np.all(reliable) or (last and np.any(reliable))):
            expansion = self._forward_differences(v, ONE_SIDED * steps, np.diag(near.curvature))
        expansion = expansion or self._central_differences(v, steps, exact)
        if near is not None and expansion is not None and not exact:
            curvature = _update_bfgs(near.curvature, last, v, expansion, MIN_CURVATURE / scale**2)
            expansion = expansion._replace(curvature=curvature)
        if expansion is not None:
            self._last, self._exact = (v.copy(), expansion), exact
        return expansion

    def _forward_differences(
        self, v: Float[np.ndarray, "d"], steps: Float[np.ndarray, "d"], curvatures: np.ndarray
    ) -> LocalModel | None:
        """Return the local model by forward differences, with the diagonal curvature of a nearby point."""
        value, *above = self.values(np.concatenate([v[None], v + np.diag(steps)]))
        if not min(value, *above) > NOWHERE:
            return None
        gradient = (np.array(above) - value) / steps + 0.5 * steps * curvatures
        return LocalModel(value, gradient, np.diag(curvatures))

    def _central_differences(
        self, v: Float[np.ndarray, "d"], steps: Float[np.ndarray, "d"], curved: bool
    ) -> LocalModel | None:
        axes = self._axes if curved and self._axes and np.array_equal(self._axes[0], v) else None
        for _ in range(BACKTRACKS):
            # Along the axes: basis columns are reused where only noise parameters change.
            delta = np.diag(steps if axes is None else axes[1])
            if axes is None:
                points = np.concatenate([v[None], v + delta, v - delta])
                axes = v.copy(), steps, self.values(points)
            (_, steps, (value, *ends)), self._axes, axes = axes, axes, None
            if not value > NOWHERE:
                return None
            above, below = np.reshape(ends, (2, len(v)))
            second = 2 * value - above - below
            # Shorten steps that are too long for the density's own width, and repeat.
            if np.any(long := second > 4 * DIFFERENCE**2):
                ratio = np.maximum(DIFFERENCE / np.sqrt(np.where(long, second, 1.0)), MIN_SHRINK)
                steps = steps * np.where(long, ratio, 1.0)
                continue
            hessian = self._seed_hessian(v, second) if curved else np.diag(second)
            i, j = np.nonzero(np.triu(np.isnan(hessian)))
            if len(i):
                shift = delta[i] + delta[j]
                ends = self.values(np.concatenate([v + shift, v - shift]))
                if not np.min(ends) > NOWHERE:
                    steps = SHORTER * steps
                    continue
                mixed = 2 * value - ends.reshape(2, -1).sum(axis=0)
                hessian[i, j] = hessian[j, i] = 0.5 * (mixed - second[i] - second[j])
            gradient = 0.5 * (above - below) / steps
            return LocalModel(value, gradient, hessian / np.outer(steps, steps))
        return None

    def _seed_hessian(self, v: np.ndarray, diagonal: Float[np.ndarray, "d"]) -> np.ndarray:
        """Return second differences: the diagonal, cross terms by correlations of a similar density, otherwise NaN."""
        hessian, similar_density = np.full((len(v), len(v)), np.nan), self._like
        if similar_density is not None:
            scale = np.sqrt(np.maximum(np.diag(similar_density.curvature), np.finfo(float).tiny))
            curvature = similar_density.curvature / np.outer(scale, scale)
            usable = similar_density.reliable & (diagonal > 0)
            is_close = np.abs(v - similar_density.v) * scale < UNMOVED
            reuse = (np.abs(curvature) < LOOSE) | np.outer(is_close, is_close)
            reuse &= np.outer(usable, usable)
            hessian[reuse] = (curvature * np.sqrt(np.abs(np.outer(diagonal, diagonal))))[reuse]
        np.fill_diagonal(hessian, diagonal)
        return hessian


def _update_bfgs(
    curvature: Float[np.ndarray, "d d"],
    last: tuple[np.ndarray, LocalModel] | None,
    v: Float[np.ndarray, "d"],
    slopes: LocalModel,
    least: Float[np.ndarray, "d"],
) -> Float[np.ndarray, "d d"]:
    """Update a curvature to v: rescale it to the new diagonal, then apply a BFGS update by the gradient change."""
    old, new = np.diag(curvature), np.diag(slopes.curvature)
    is_positive = (new > least) & (old > 0)
    ratio = np.sqrt(np.where(is_positive, new, 1.0) / np.where(is_positive, old, 1.0))
    curvature = ratio[:, None] * curvature * ratio
    if last is None:
        return curvature
    step, y = v - last[0], last[1].gradient - slopes.gradient
    bs = curvature @ step
    sy, sbs = float(step @ y), float(step @ bs)
    if not sy > 1e-12 or not sbs > 1e-12:
        return curvature
    return curvature + np.outer(y, y) / sy - np.outer(bs, bs) / sbs
