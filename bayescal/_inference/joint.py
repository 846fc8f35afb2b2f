"""Importance weights of joint draws (x, φ): ratio of the exact joint density to that of the linearised proposal."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from bayescal._inference.gaussian import LOG_2PI, XDraws
from bayescal._inference.noise_on_record import Batch, total_log_density
from bayescal._inference.problem import Problem

T_DOF = 5  # degrees of freedom of the Student-t proposals


def correct_weights(
    problem: Problem,
    draws: XDraws,
    deviates: Float[np.ndarray, "b p"],
    hyper: Batch,
    has_exact_marginal: bool,
    is_student_t: bool,
) -> Float[np.ndarray, "b"]:
    """Return the correction of each draw's log weight for nonlinearity, log p(y, x | φ) − log q(x) − log p̂(y | φ).

    q is the proposal of x, drawn with `deviates` (Student-t if `is_student_t`, else normal), p̂ the marginal
    likelihood of the linearised model. has_exact_marginal: p̂ is exact if the output is affine.
    """
    if problem.is_affine and has_exact_marginal:
        return np.zeros(len(draws.x))
    # x = shift + S·L⁻ᵀ·ε has the density of ε over |S·L⁻ᵀ|, the volume of the map.
    squares = np.sum(deviates**2, axis=1)
    log_proposal = _compute_log_density(squares, deviates.shape[1], is_student_t) - draws.log_volume
    expected, variance = problem.expected_and_extra(draws.x, hyper)
    log_prior = -0.5 * (draws.squares + LOG_2PI * np.sum(problem.weight_of_x))
    # The weight of φ contains p̂(y|φ) already: it is replaced by likelihood × prior of x over the proposal density of x.
    residual = problem.record.y - expected
    log_likelihood = total_log_density(problem.noise, problem.record, residual, hyper, variance)
    return log_likelihood + log_prior - log_proposal - draws.log_marginal


def draw_normals(size: int, count: int, is_student_t: bool, rng: np.random.Generator) -> np.ndarray:
    """Draw standard normal deviates (count, size), or multivariate Student-t ones, for proposals of x."""
    deviates = rng.standard_normal((count, size))
    if is_student_t:
        deviates *= np.sqrt(T_DOF / rng.chisquare(T_DOF, count))[:, None]
    return deviates


def _compute_log_density(
    squares: Float[np.ndarray, "b"], dim: int, is_student_t: bool
) -> np.ndarray:
    """Return the log density of standard normal (or Student-t) vectors with the given sums of squares (b,)."""
    if not is_student_t:
        return -0.5 * (squares + dim * LOG_2PI)
    # Multivariate t of `draw_normals`: one χ² for all coordinates, hence the sum of all squares.
    half_order = 0.5 * (T_DOF + dim)
    norm = gammaln(half_order) - gammaln(0.5 * T_DOF) - 0.5 * dim * math.log(T_DOF * math.pi)
    return norm - half_order * np.log1p(squares / T_DOF)
