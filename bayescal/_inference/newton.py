"""Newton's method for the mode of a log density of few coordinates, and the Gaussian (Laplace) fit at the mode.

Coordinates are about standard normal a priori. Without closed forms, gradient and Hessian are finite differences
(`NumericDensity`) with steps of a twentieth of the density's width. "Curvature" means the negative Hessian throughout.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from bayescal._inference.gaussian import LOG_2PI

FIRST_STEP_PRIOR_SD = 0.02  # initial difference step, in prior scales
STEP_SD = 0.05  # difference step, in posterior standard deviations
FORWARD_RATIO = 0.2  # forward over central difference step
MIN_CURVATURE = 0.05  # floor of the eigenvalues of the scaled curvature
# Largest correlation whose cross term is reused, and distance (posterior deviations) within which all are.
MAX_REUSED_CORRELATION, MAX_REUSE_DISTANCE_SD = 0.03, 0.1
MAX_STEP_SD = 1.5  # largest Newton step, prior standard deviations
MAX_NEWTON_STEPS = 100  # of one maximisation
MAX_BACKTRACKS, BACKTRACK_FACTOR = 8, 0.3  # of a line search
FTOL_NATS = 1e-6  # default tolerance of the predicted increase, about the error of differences
MAX_FTOL_NATS = 0.01  # tolerance below `coarse_below`
MAX_OUTSIDE = 0.1  # largest squared length, outside group deviations, of an eigenvector along them
MIN_FACTOR = 0.1  # smallest factor by which a difference step is shortened at once
LOG_ZERO = -1e300  # log density where it is undefined

Values = Callable[[np.ndarray], np.ndarray]  # log density of several points, (s, d) → (s,)


class LocalModel(NamedTuple):
    """Second-order Taylor model of a log density at a point: value, gradient, negative Hessian."""

    log_density: float
    gradient: Float[np.ndarray, "d"]
    curvature: Float[np.ndarray, "d d"]


class HessianGuess(NamedTuple):
    """Hessian estimate from a similar density at v, and the coordinates in which it is reliable."""

    v: Float[np.ndarray, "d"]
    curvature: Float[np.ndarray, "d d"]
    reliable: Bool[np.ndarray, "d"] | bool = False


class GaussianFit(NamedTuple):
    """Laplace approximation of a density: mode, covariance, evidence, and whether its Hessian is indefinite."""

    v: Float[np.ndarray, "d"]
    covariance: Float[np.ndarray, "d d"]
    log_density: float
    log_evidence: float
    indefinite: bool


def maximise(
    density: NumericDensity,
    v: Float[np.ndarray, "d"],
    coarse_below: float = -math.inf,
    ftol: float = FTOL_NATS,
) -> Float[np.ndarray, "d"]:
    """Maximise a density from v by Newton steps with a line search; return the maximum's coordinates (d,).

    ftol: tolerance, nats; 0.01 where the log density is below `coarse_below`. Eigenvalues of the curvature are replaced
    by their absolute values, small ones by a floor (J. Nocedal and S. Wright, Numerical Optimization, 2006, §3.4).
    """
    scale, use_exact, radius = np.broadcast_to(density.scale, v.shape), False, MAX_STEP_SD
    for _ in range(MAX_NEWTON_STEPS if len(v) else 0):
        if (model := density.evaluate(v, exact=use_exact)) is None:
            break
        eigenvalues, vectors = np.linalg.eigh(scale[:, None] * model.curvature * scale)
        gradient = scale * model.gradient
        step = vectors @ (vectors.T @ gradient / np.maximum(np.abs(eigenvalues), MIN_CURVATURE))
        predicted_change = float(step @ gradient)
        if 0.5 * predicted_change < (ftol if model.log_density > coarse_below else MAX_FTOL_NATS):
            break
        length = float(np.max(np.abs(step)))
        t = t_max = min(1.0, radius / length)
        for _ in range(MAX_BACKTRACKS):
            trial = v + t * scale * step
            change = density.value(trial) - model.log_density
            # Sufficient increase (Armijo condition; ibid., eq. 3.4).
            if change >= 1e-4 * t * predicted_change:
                break
            t *= BACKTRACK_FACTOR
        else:
            if use_exact:
                break
            use_exact = True
            continue
        # Where the curvature is indefinite a BFGS update would not correct it: recompute.
        use_exact, v = bool(eigenvalues[0] < 0), trial
        # Trust region: after a shortened step the next is at most twice as long.
        radius = min(MAX_STEP_SD, 2 * length * t) if t < t_max else min(MAX_STEP_SD, 2 * radius)
    return v


def fit_gaussian(
    density: NumericDensity,
    v: Float[np.ndarray, "d"],
    is_group_sd: Bool[np.ndarray, "d"] | bool = False,
    use_exact: bool = True,
) -> GaussianFit:
    """Return the Laplace approximation of a density at its mode, with the log evidence (log marginal likelihood).

    is_group_sd: coordinates in which the density is flat towards zero, so that clipped eigenvalues along them do not
    count as indefinite. use_exact: compute the Hessian; otherwise take the BFGS estimate of the maximisation.
    Source: L. Tierney and J. Kadane, JASA 81 (1986) 82 (Laplace).
    """
    model = density.evaluate(v, use_exact)
    if model is None:  # the density is undefined within a difference step
        return GaussianFit(v, np.full((len(v), len(v)), np.nan), density.value(v), -math.inf, True)
    scale = np.broadcast_to(density.scale, v.shape)
    eigenvalues, vectors = np.linalg.eigh(scale[:, None] * model.curvature * scale)
    # Smaller eigenvalues belong to a flank, such as a deviation towards zero: clipped, so that proposals stay finite.
    clipped_values = np.maximum(eigenvalues, MIN_CURVATURE)
    covariance = (vectors / clipped_values) @ vectors.T * np.outer(scale, scale)
    log_volume = 0.5 * len(v) * LOG_2PI - 0.5 * float(np.sum(np.log(clipped_values / scale**2)))
    outside_squares = np.sum(vectors[~np.broadcast_to(is_group_sd, len(v))] ** 2, axis=0)
    is_indefinite = bool(np.any((eigenvalues < MIN_CURVATURE) & (outside_squares > MAX_OUTSIDE)))
    covariance, value = 0.5 * (covariance + covariance.T), model.log_density
    return GaussianFit(v, covariance, value, value + log_volume, is_indefinite)


class NumericDensity:
    """Log density with gradient and curvature by finite differences; `scale`: at least the prior standard deviations.

    A maximisation updates the curvature of the previous point, or of a similar density, with a new diagonal and by BFGS
    (J. Nocedal and S. Wright, Numerical Optimization, 2006, eq. 6.19). Differences are one-sided in coordinates that
    `guess` calls reliable. If `exact`, cross terms are central differences, except in reliable coordinates where the
    similar density has a small correlation or its point is close: there its correlation is used.
    """

    def __init__(
        self,
        values: Values,
        scale: Float[np.ndarray, "d"] | float = 1.0,
        guess: HessianGuess | None = None,
    ) -> None:
        self.values, self.scale = values, scale
        self._reset(guess)

    def _reset(self, guess: HessianGuess | None = None) -> None:
        """Discard cached points, and set the first estimate of the Hessian."""
        self._guess, self._last = guess, None
        self._exact = False  # whether the latest curvature has cross terms by differences
        self._stencil: Any = None  # latest point, steps along the axes, log densities there

    def fix_others(self, guess: HessianGuess, free: Bool[np.ndarray, "d"]) -> NumericDensity:
        """Return the density of the coordinates that are `free` (d,), with the others fixed at those of `guess`."""
        fixed, embedding = np.where(free, 0.0, guess.v), np.eye(len(free))[free]
        guess = HessianGuess(guess.v[free], guess.curvature[np.ix_(free, free)], True)
        return NumericDensity(lambda vs: self.values(fixed + vs @ embedding), guess=guess)

    @property
    def next_guess(self) -> HessianGuess | None:
        """Return the latest point and curvature, as a first estimate of the Hessian of a similar density."""
        previous: tuple[np.ndarray, LocalModel] | None = self._last
        return self._guess if previous is None else HessianGuess(previous[0], previous[1].curvature)

    def value(self, v: Float[np.ndarray, "d"]) -> float:
        # Most line searches accept the first step: evaluate its gradient at once.
        value = self.evaluate(v)
        return float(self.values(v[None])[0]) if value is None else value.log_density

    def evaluate(self, v: Float[np.ndarray, "d"], exact: bool = False) -> LocalModel | None:
        """Return value, gradient and curvature at v, None if undefined; exact: cross terms by differences, not BFGS."""
        previous, guess = self._last, self.next_guess  # `previous`: the latest point and its result
        if previous is not None and (self._exact or not exact) and np.array_equal(previous[0], v):
            return previous[1]
        scale = np.broadcast_to(self.scale, v.shape)
        steps = FIRST_STEP_PRIOR_SD * scale
        if guess is not None:
            curvatures = np.maximum(np.diag(guess.curvature) * scale**2, MIN_CURVATURE)
            steps = STEP_SD * scale / np.sqrt(curvatures)
        expansion, mask = None, np.False_ if self._guess is None else self._guess.reliable
        if guess is not None and not exact and (np.all(mask) or (previous and np.any(mask))):
            expansion = self._expand_forward(v, FORWARD_RATIO * steps, np.diag(guess.curvature))
        expansion = expansion or self._expand_centrally(v, steps, exact)
        if guess is not None and expansion is not None and not exact:
            floor = MIN_CURVATURE / scale**2
            curvature = _update_bfgs(guess.curvature, previous, v, expansion, floor)
            expansion = expansion._replace(curvature=curvature)
        if expansion is not None:
            self._last, self._exact = (v.copy(), expansion), exact
        return expansion

    def _expand_forward(
        self, v: Float[np.ndarray, "d"], steps: Float[np.ndarray, "d"], curvatures: np.ndarray
    ) -> LocalModel | None:
        """Return the quadratic model at v by forward differences, with a given diagonal curvature."""
        value, *shifted_values = self.values(np.concatenate([v[None], v + np.diag(steps)]))
        if not min(value, *shifted_values) > LOG_ZERO:
            return None
        gradient = (np.array(shifted_values) - value) / steps + 0.5 * steps * curvatures
        return LocalModel(value, gradient, np.diag(curvatures))

    def _expand_centrally(
        self, v: Float[np.ndarray, "d"], steps: Float[np.ndarray, "d"], include_cross_terms: bool
    ) -> LocalModel | None:
        stencil = self._stencil if include_cross_terms else None
        stencil = stencil if stencil and np.array_equal(stencil[0], v) else None
        for _ in range(MAX_BACKTRACKS):
            # Steps along the axes reuse basis columns where only noise parameters change.
            delta = np.diag(steps if stencil is None else stencil[1])
            if stencil is None:
                points = np.concatenate([v[None], v + delta, v - delta])
                stencil = v.copy(), steps, self.values(points)
            (_, steps, (value, *values)), self._stencil, stencil = stencil, stencil, None
            if not value > LOG_ZERO:
                return None
            upper_values, lower_values = np.reshape(values, (2, len(v)))
            diagonal = 2 * value - upper_values - lower_values
            # Shorten steps that are too long for the density's own width, and repeat.
            if np.any(is_long := diagonal > 4 * STEP_SD**2):
                ratio = np.maximum(STEP_SD / np.sqrt(np.where(is_long, diagonal, 1.0)), MIN_FACTOR)
                steps = steps * np.where(is_long, ratio, 1.0)
                continue
            hessian = self._fill_hessian(v, diagonal) if include_cross_terms else np.diag(diagonal)
            i, j = np.nonzero(np.triu(np.isnan(hessian)))
            if len(i):
                shift = delta[i] + delta[j]
                values = self.values(np.concatenate([v + shift, v - shift]))
                if not np.min(values) > LOG_ZERO:
                    steps = BACKTRACK_FACTOR * steps
                    continue
                cross = 2 * value - values.reshape(2, -1).sum(axis=0)
                hessian[i, j] = hessian[j, i] = 0.5 * (cross - diagonal[i] - diagonal[j])
            gradient = 0.5 * (upper_values - lower_values) / steps
            return LocalModel(value, gradient, hessian / np.outer(steps, steps))
        return None

    def _fill_hessian(self, v: np.ndarray, diagonal: Float[np.ndarray, "d"]) -> np.ndarray:
        """Return a Hessian with this diagonal; other terms by the first estimate's correlations, NaN if unreliable."""
        hessian, guess = np.full((len(v), len(v)), np.nan), self._guess
        if guess is not None:
            scale = np.sqrt(np.maximum(np.diag(guess.curvature), np.finfo(float).tiny))
            curvature = guess.curvature / np.outer(scale, scale)
            is_reliable = guess.reliable & (diagonal > 0)
            is_close = np.abs(v - guess.v) * scale < MAX_REUSE_DISTANCE_SD
            mask = (np.abs(curvature) < MAX_REUSED_CORRELATION) | np.outer(is_close, is_close)
            mask &= np.outer(is_reliable, is_reliable)
            hessian[mask] = (curvature * np.sqrt(np.abs(np.outer(diagonal, diagonal))))[mask]
        np.fill_diagonal(hessian, diagonal)
        return hessian


def _update_bfgs(
    curvature: Float[np.ndarray, "d d"],
    previous: tuple[np.ndarray, LocalModel] | None,
    v: Float[np.ndarray, "d"],
    local_model: LocalModel,
    floor: Float[np.ndarray, "d"],
) -> Float[np.ndarray, "d d"]:
    """Update a curvature to v: rescale it to the new diagonal, then apply a BFGS update."""
    old_diagonal, new_diag = np.diag(curvature), np.diag(local_model.curvature)
    is_positive = (new_diag > floor) & (old_diagonal > 0)
    ratio = np.sqrt(np.where(is_positive, new_diag, 1.0) / np.where(is_positive, old_diagonal, 1.0))
    curvature = ratio[:, None] * curvature * ratio
    if previous is None:
        return curvature
    step, y = v - previous[0], previous[1].gradient - local_model.gradient
    bs = curvature @ step
    sy, sbs = float(step @ y), float(step @ bs)
    if not sy > 1e-12 or not sbs > 1e-12:
        return curvature
    return curvature + np.outer(y, y) / sy - np.outer(bs, bs) / sbs
