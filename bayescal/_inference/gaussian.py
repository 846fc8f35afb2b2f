"""Conjugate Gaussian linear model: integrate coefficients out in closed form, or draw them from their conditional.

With y − μ(x̂) = r ≈ J(x − x̂) + noise of covariance Σ and x ~ N(m, diag(s²)), JᵀΣ⁻¹J, JᵀΣ⁻¹r and rᵀΣ⁻¹r are sufficient
statistics. The system is solved for the standardised z = (x − m)/s, so that s = 0 fixes a coefficient exactly. The
residual sum of squares is evaluated at the posterior mean, against cancellation.

Small dense matrices are factorised by LAPACK on the host, one call each, without compilation. A flat prior has weight 0
and, in place of s, the reciprocal of its column's rms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dpotrf, dtrtri, dtrtrs  # pyright: ignore[reportAttributeAccessIssue]

LOG_2PI = math.log(2 * math.pi)


class Gram(NamedTuple):
    """Gram matrix of [J r] (Jacobian, residuals) weighted by Σ⁻¹, and log|Σ|: sufficient for a Gaussian likelihood."""

    jtj: Float[np.ndarray, "*b p p"]
    jtr: Float[np.ndarray, "*b p"]
    rtr: Any
    logdet: Any

    @classmethod
    def split(cls, gram: Float[np.ndarray, "*b q q"], logdet: Any) -> Gram:
        """Split the Gram matrix of the whitened table [J r] into its blocks."""
        return cls(gram[..., :-1, :-1], gram[..., :-1, -1], gram[..., -1, -1], logdet)


class Prior(NamedTuple):
    """Independent normal priors of the coefficients: mean, standard deviation, and weight (1 proper, 0 flat)."""

    mean: Float[np.ndarray, "p"]
    sd: Float[np.ndarray, "*b p"]
    weight: Float[np.ndarray, "p"]

    def offset_from(self, point: Any, information: Any) -> tuple[Any, Any]:
        """Return the offset of the prior mean from a point as two arrays (p,), one of them zero for each coefficient.

        The first is in units of x, where the prior is narrower than the likelihood (`information`: diagonal of JᵀΣ⁻¹J),
        so that a prior of zero width is exact; the second in prior standard deviations, against cancellation.
        """
        offset = self.weight * (self.mean - point)
        is_tight = self.sd**2 * information > 1
        return np.where(is_tight, 0.0, offset), np.where(
            is_tight, offset / np.where(is_tight, self.sd, 1.0), 0.0
        )

    @property
    def flat_volume(self) -> Any:
        """Return the sum of log s + ½·log 2π over flat priors of density one, their part of the log evidence."""
        # A density of one per unit of x is one of s per unit of z = x/s, and lacks the 1/√(2π) of the standard normal
        # density that the closed form counts for every z.
        log_sd = np.where(self.weight > 0, 0.0, np.log(np.where(self.weight > 0, 1.0, self.sd)))
        return np.sum(log_sd + 0.5 * LOG_2PI * (1 - self.weight), axis=-1)


@dataclass(eq=False)
class Conditional:
    """Conditional posterior x = mean + sd·L⁻ᵀ·ε given φ, ε ~ N(0, 1), and the log density of the readings given φ."""

    log_marginal: float  # of the readings, x integrated out
    mean: Float[np.ndarray, "p"]
    sd: Float[np.ndarray, "p"]  # of the prior
    chol: Float[np.ndarray, "p p"]  # L, the lower factor of the precision of z
    z: Float[np.ndarray, "p"]  # posterior minus prior mean, in prior standard deviations
    penalised_rss: float  # whitened residual sum of squares at the mean, plus Σ z²
    squares: float  # whitened residual sum of squares at the mean

    @cached_property
    def root_of_z(self) -> Float[np.ndarray, "p p"]:
        """Return L⁻ᵀ, a square root of the covariance of z."""
        return dtrtri(self.chol, lower=1)[0].T if len(self.z) else self.chol

    @property
    def root(self) -> Float[np.ndarray, "p p"]:
        """Return a square root of the covariance of x."""
        return self.sd[:, None] * self.root_of_z

    @property
    def covariance(self) -> Float[np.ndarray, "p p"]:
        return self.root @ self.root.T


def condition(
    gram: Gram, size: int, prior: Prior, origin: Float[np.ndarray, "p"]
) -> Conditional | None:
    """Return the conditional posterior of x; None if its precision is singular or the sum of squares cancels to zero.

    size: number of readings. origin: the x at which `gram` was evaluated (p,), x̂ below.
    """
    sd, weight = prior.sd, prior.weight
    # With x = x̂ + offset + S·t, S = diag(s), the residual is (r − J·offset) − J·S·t, and the prior is t ~ N(f, W⁻¹)
    # (W: 1 proper, 0 flat). The mean of t solves A·t = rhs, A = S·JᵀΣ⁻¹J·S + W, rhs = S·(JᵀΣ⁻¹r − JᵀΣ⁻¹J·offset) + W·f.
    # A flat prior is centred at x̂ itself; `prior_rhs` is W·f.
    p = len(sd)
    if not p:
        log_marginal, squares = -0.5 * (size * LOG_2PI + gram.logdet + gram.rtr), float(gram.rtr)
        return Conditional(float(log_marginal), origin, sd, np.zeros((0, 0)), sd, squares, squares)
    offset, prior_rhs = prior.offset_from(origin, gram.jtj.diagonal())
    rhs = sd * (gram.jtr - gram.jtj @ offset) + prior_rhs
    precision = sd[:, None] * gram.jtj * sd
    precision.flat[:: p + 1] += weight
    # LAPACK is column-major: the transpose of a symmetric C-ordered matrix is passed without a copy.
    chol, status = dpotrf(precision.T, lower=1, clean=1, overwrite_a=1)
    if status:
        return None
    t = dtrtrs(chol, dtrtrs(chol, rhs, lower=1)[0], lower=1, trans=1)[0]
    # Completed square: whitened squares of r − J·displacement at the posterior mean, plus zᵀWz of the prior.
    displacement, z = offset + sd * t, t - prior_rhs
    squares = gram.rtr - displacement @ (2 * gram.jtr - gram.jtj @ displacement)
    penalised_rss = squares + weight @ (z * z)
    if not penalised_rss > 0:  # no digits left: noise far below any residual
        return None
    # |Σ + J·S²·Jᵀ| = |Σ|·|A| (Sylvester's determinant identity), and |A| is the squared product of L's diagonal.
    log_det = gram.logdet + 2 * float(np.log(chol.diagonal()).sum())
    flat_log_volume = 0.0 if weight.all() else float(prior.flat_volume)
    log_marginal = flat_log_volume - 0.5 * (size * LOG_2PI + log_det + penalised_rss)
    if not math.isfinite(log_marginal):
        return None
    square_sums = float(penalised_rss), float(squares)
    return Conditional(float(log_marginal), origin + displacement, sd, chol, z, *square_sums)


class XDraws(NamedTuple):
    """A draw of the coefficients x given each of several φ, and the log density of the readings given φ."""

    log_marginal: Float[np.ndarray, "b"]  # −∞ if undefined
    x: Float[np.ndarray, "b p"]
    squares: Float[np.ndarray, "b"]  # Σ z², over coefficients with a proper prior
    # Log determinant of the map from normal deviates to x, in prior standard deviations if the prior is proper.
    log_volume: Float[np.ndarray, "b"]

    def select(self, rows: np.ndarray) -> XDraws:
        """Return the draws of the selected φ."""
        return XDraws(*(a[rows] for a in self))


def draw_x(
    grams: Gram, size: int, prior: Prior, origin: Float[np.ndarray, "p"], deviates: np.ndarray
) -> XDraws:
    """Return a draw of x given each of b values of φ, from standard normal deviates (b, p)."""
    sd, weight = prior.sd, prior.weight
    offset, prior_rhs = prior.offset_from(origin, np.diagonal(grams.jtj, axis1=1, axis2=2))
    rhs = sd * (grams.jtr - np.einsum("bij,bj->bi", grams.jtj, offset)) + prior_rhs
    precision = sd[:, :, None] * grams.jtj * sd[:, None, :]
    indices = np.arange(len(origin))
    precision[:, indices, indices] += weight
    chol = cholesky(precision)
    mean = solve_tri(chol, solve_tri(chol, rhs), is_upper=True)
    displacement, z = offset + sd * mean, mean - prior_rhs
    jtj_displacement = np.einsum("bij,bj->bi", grams.jtj, displacement)
    squares = grams.rtr - np.sum(displacement * (2 * grams.jtr - jtj_displacement), axis=1)
    penalised_rss = squares + z**2 @ weight
    # Half of log|A|; L⁻ᵀε below has the covariance A⁻¹ = (L·Lᵀ)⁻¹.
    half_logdet = np.sum(np.log(np.diagonal(chol, axis1=1, axis2=2)), axis=1)
    volume = np.broadcast_to(prior.flat_volume, len(sd))
    log_marginal = volume - 0.5 * (size * LOG_2PI + grams.logdet + 2 * half_logdet + penalised_rss)
    deviations = solve_tri(chol, deviates, is_upper=True)
    log_sd = np.sum(np.log(np.where(weight > 0, 1.0, sd)), axis=1)
    return XDraws(
        np.where(np.isfinite(log_marginal) & (penalised_rss > 0), log_marginal, -np.inf),
        origin + displacement + sd * deviations,
        (z + deviations) ** 2 @ weight,
        log_sd - half_logdet,
    )


def cholesky(matrices: Float[np.ndarray, "*b p p"]) -> Float[np.ndarray, "*b p p"]:
    """Return lower Cholesky factors of matrices; NaN for one that is not positive definite."""
    try:
        return np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        if matrices.ndim == 2:
            return np.full_like(matrices, np.nan)
        return np.stack([cholesky(block) for block in matrices])


def solve_tri(
    chol: Float[np.ndarray, "b p p"], rhs: Float[np.ndarray, "b p"], is_upper: bool = False
) -> Float[np.ndarray, "b p"]:
    """Return the solutions z of L·z = rhs, or of Lᵀ·z = rhs if `is_upper`, for b lower triangular matrices L."""
    z, order = np.empty_like(rhs), range(rhs.shape[1])
    if len(rhs) <= 2 * len(
        order
    ):  # one LAPACK call per φ is then faster; the transpose needs no copy
        for k in range(len(rhs)):
            z[k] = dtrtrs(chol[k].T, rhs[k], lower=0, trans=0 if is_upper else 1)[0]
        return z
    for i in reversed(order) if is_upper else order:
        solved_rows = slice(i + 1, None) if is_upper else slice(i)
        row = chol[:, solved_rows, i] if is_upper else chol[:, i, solved_rows]
        z[:, i] = (rhs[:, i] - np.einsum("bj,bj->b", row, z[:, solved_rows])) / chol[:, i, i]
    return z


def compute_column_scales(jacobian: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "p"]:
    """Return the reciprocal rms of each Jacobian column, the scale of a coefficient with a flat prior (p,)."""
    norm = np.sqrt(np.mean(jacobian**2, axis=0))
    return np.where(norm > 0, 1 / np.where(norm > 0, norm, 1.0), 1.0)
