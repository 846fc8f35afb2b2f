"""Conjugate Gaussian linear model: coefficients integrated out in closed form, and drawn from their conditional.

With y − μ(x̂) = r ≈ J(x − x̂) + noise and x ~ N(m, diag(s²)), everything follows from JᵀΣ⁻¹J, JᵀΣ⁻¹r and rᵀΣ⁻¹r. The
system is solved for the standardised z = (x − m)/s, so that s = 0 fixes a coefficient exactly. The residual sum of
squares is evaluated at the posterior mean, against cancellation.

These are small dense matrices, thousands of them in a search: LAPACK on the host, one call each, nothing to compile. A
flat prior has weight 0 and the scale of its column in place of s.
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
    """Gram matrix of [J r] weighted by Σ⁻¹, and log|Σ|: sufficient statistics of a Gaussian likelihood."""

    jtj: Float[np.ndarray, "*b p p"]
    jtr: Float[np.ndarray, "*b p"]
    rtr: Any
    logdet: Any

    @classmethod
    def of(cls, whole: Float[np.ndarray, "*b q q"], logdet: Any) -> Gram:
        """Split the Gram matrix of the whitened table [J r] into its blocks."""
        return cls(whole[..., :-1, :-1], whole[..., :-1, -1], whole[..., -1, -1], logdet)


class Prior(NamedTuple):
    """Prior of a Gaussian vector: mean, scale, and weight (1 proper, 0 flat)."""

    mean: Float[np.ndarray, "p"]
    sd: Float[np.ndarray, "*b p"]
    weight: Float[np.ndarray, "p"]

    def offset_from(self, at: Any, information: Any) -> tuple[Any, Any]:
        """Return the offset of the prior mean from a point in two parts: in units of x, and in prior deviations.

        In units of x where the prior is narrower than the likelihood (`information`, the diagonal of JᵀΣ⁻¹J), so that a
        prior of zero width is exact; otherwise in standard deviations, against cancellation for a distant prior mean.
        """
        offset = self.weight * (self.mean - at)
        is_tight = self.sd**2 * information > 1
        return np.where(is_tight, 0.0, offset), np.where(
            is_tight, offset / np.where(is_tight, self.sd, 1.0), 0.0
        )

    @property
    def flat_volume(self) -> Any:
        """Return the flat priors' contribution to the log evidence, for density one: log s + ½·log 2π each."""
        # A density of one per unit of x is one of s per unit of z = x/s, and lacks the 1/√(2π) of the standard normal
        # density that the closed form counts for every z.
        log_sd = np.where(self.weight > 0, 0.0, np.log(np.where(self.weight > 0, 1.0, self.sd)))
        return np.sum(log_sd + 0.5 * LOG_2PI * (1 - self.weight), axis=-1)


@dataclass(eq=False)
class Conditional:
    """Conditional posterior of x given φ, x = mean + sd·L⁻ᵀ·ε, and the log density of the readings given φ."""

    log_marginal: float  # of the readings, x integrated out
    mean: Float[np.ndarray, "p"]
    sd: Float[np.ndarray, "p"]  # of the prior
    chol: Float[np.ndarray, "p p"]  # L, the lower factor of the precision of z
    z: Float[np.ndarray, "p"]  # the mean, in standard deviations from that of the prior
    penalised_rss: float  # whitened residual sum of squares at the mean, plus that of z
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
    gram: Gram, size: int, prior: Prior, at: Float[np.ndarray, "p"]
) -> Conditional | None:
    """Integrate x out; None if the precision is not positive definite, or the sum of squares cancels to zero.

    `gram` was evaluated at x = `at`, x̂ below.
    """
    sd, weight = prior.sd, prior.weight
    # With x = x̂ + offset + S·t, S = diag(s), what is left is (r − J·offset) − J·S·t, and the prior is t ~ N(f, W⁻¹)
    # (W: 1 proper, 0 flat). So t has the precision A = S·JᵀΣ⁻¹J·S + W and the pull S·(JᵀΣ⁻¹r − JᵀΣ⁻¹J·offset) + W·f.
    # A flat prior is centred at x̂ itself; `prior_pull` is W·f.
    p = len(sd)
    if not p:
        log_marginal, squares = -0.5 * (size * LOG_2PI + gram.logdet + gram.rtr), float(gram.rtr)
        return Conditional(float(log_marginal), at, sd, np.zeros((0, 0)), sd, squares, squares)
    offset, prior_pull = prior.offset_from(at, gram.jtj.diagonal())
    pull = sd * (gram.jtr - gram.jtj @ offset) + prior_pull
    precision = sd[:, None] * gram.jtj * sd
    precision.flat[:: p + 1] += weight
    # LAPACK is column-major: the transpose of a symmetric C-ordered matrix is passed without a copy.
    chol, failed = dpotrf(precision.T, lower=1, clean=1, overwrite_a=1)
    if failed:
        return None
    t = dtrtrs(chol, dtrtrs(chol, pull, lower=1)[0], lower=1, trans=1)[0]
    # Completed square: at the posterior mean rᵀΣ⁻¹r has become the square of r − J·displacement; zᵀWz is the prior's.
    displacement, z = offset + sd * t, t - prior_pull
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
    sums = float(penalised_rss), float(squares)
    return Conditional(float(log_marginal), at + displacement, sd, chol, z, *sums)


class Drawn(NamedTuple):
    """Draws of x given each of several φ, and the log density of the readings given φ."""

    log_marginal: Float[np.ndarray, "b"]  # −∞ where there is none
    x: Float[np.ndarray, "b p"]  # drawn
    squares: Float[np.ndarray, "b"]  # Σ z², over coefficients with a proper prior
    # log determinant of the map from normal numbers to x, coefficients with a proper prior in units of its sd

    log_volume: Float[np.ndarray, "b"]

    def select(self, rows: np.ndarray) -> Drawn:
        """Select the draws of some φ."""
        return Drawn(*(a[rows] for a in self))


def draw(
    grams: Gram, size: int, prior: Prior, at: Float[np.ndarray, "p"], normal: np.ndarray
) -> Drawn:
    """Condition on many φ at once (b, …), and map standard normal numbers (b, p) to draws of x."""
    sd, weight = prior.sd, prior.weight
    offset, prior_pull = prior.offset_from(at, np.diagonal(grams.jtj, axis1=1, axis2=2))
    pull = sd * (grams.jtr - np.einsum("bij,bj->bi", grams.jtj, offset)) + prior_pull
    precision = sd[:, :, None] * grams.jtj * sd[:, None, :]
    diagonal = np.arange(len(at))
    precision[:, diagonal, diagonal] += weight
    chol = cholesky(precision)
    mean = solve_tri(chol, solve_tri(chol, pull), upper=True)
    displacement, z = offset + sd * mean, mean - prior_pull
    jtj_displacement = np.einsum("bij,bj->bi", grams.jtj, displacement)
    squares = grams.rtr - np.sum(displacement * (2 * grams.jtr - jtj_displacement), axis=1)
    penalised_rss = squares + z**2 @ weight
    # Half of log|A|; L⁻ᵀε below has the covariance A⁻¹ = (L·Lᵀ)⁻¹.
    half_log_det = np.sum(np.log(np.diagonal(chol, axis1=1, axis2=2)), axis=1)
    flat = np.broadcast_to(prior.flat_volume, len(sd))
    log_marginal = flat - 0.5 * (size * LOG_2PI + grams.logdet + 2 * half_log_det + penalised_rss)
    scatter = solve_tri(chol, normal, upper=True)
    log_sd = np.sum(np.log(np.where(weight > 0, 1.0, sd)), axis=1)
    return Drawn(
        np.where(np.isfinite(log_marginal) & (penalised_rss > 0), log_marginal, -np.inf),
        at + displacement + sd * scatter,
        (z + scatter) ** 2 @ weight,
        log_sd - half_log_det,
    )


def cholesky(matrices: Float[np.ndarray, "*b p p"]) -> Float[np.ndarray, "*b p p"]:
    """Return lower Cholesky factors; NaN for a matrix that is not positive definite."""
    try:
        return np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        if matrices.ndim == 2:
            return np.full_like(matrices, np.nan)
        return np.stack([cholesky(matrix) for matrix in matrices])


def solve_tri(
    chol: Float[np.ndarray, "b p p"], right: Float[np.ndarray, "b p"], upper: bool = False
) -> Float[np.ndarray, "b p"]:
    """Solve L·z = right, or Lᵀ·z = right if `upper`, for many triangular matrices L at once."""
    # A loop over the few coefficients, vectorised over φ, is faster than one LAPACK call per φ.
    z, order = np.empty_like(right), range(right.shape[1])
    for i in reversed(order) if upper else order:
        solved = slice(i + 1, None) if upper else slice(i)
        row = chol[:, solved, i] if upper else chol[:, i, solved]
        z[:, i] = (right[:, i] - np.einsum("bj,bj->b", row, z[:, solved])) / chol[:, i, i]
    return z


def column_scale(jacobian: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "p"]:
    """Return the scale of each coefficient with a flat prior: the change that changes the output's rms by one unit."""
    norm = np.sqrt(np.mean(jacobian**2, axis=0))
    return np.where(norm > 0, 1 / np.where(norm > 0, norm, 1.0), 1.0)
