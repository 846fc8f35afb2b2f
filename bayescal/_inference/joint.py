"""Importance weights of joint draws (x, φ): exact joint density over that of the linearised proposal."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from bayescal._inference.gaussian import LOG_2PI, Drawn
from bayescal._inference.noise_on_record import Batch, total_log_density
from bayescal._inference.problem import Problem

FREEDOM = 5  # degrees of freedom of the Student-t proposals


def log_correction(
    problem: Problem,
    drawn: Drawn,
    normal: Float[np.ndarray, "b p"],
    hyper: Batch,
    exact: bool,
    heavy: bool,
) -> Float[np.ndarray, "b"]:
    """Return log p(y, x | φ) − log proposal(x) − log p̂(y | φ) of each draw, p̂ the marginal of the linearised model.

    x was drawn with `normal`, Student-t if `heavy`; `exact`: p̂ is exact for an affine output.
    """
    if problem.affine and exact:
        return np.zeros(len(drawn.x))
    # x = shift + S·L⁻ᵀ·ε has the density of ε over |S·L⁻ᵀ|, the volume of the map.
    squares = np.sum(normal**2, axis=1)
    log_proposal = _log_density(squares, normal.shape[1], heavy) - drawn.log_volume
    expected, extra = problem.expected_and_extra(drawn.x, hyper)
    prior = -0.5 * (drawn.squares + LOG_2PI * np.sum(problem.weight_of_x))
    # The weight of φ contains p̂(y|φ) already: it is replaced by likelihood × prior of x over the proposal density of x.
    residual = problem.record.y - expected
    log_likelihood = total_log_density(problem.noise, problem.record, residual, hyper, extra)
    return log_likelihood + prior - log_proposal - drawn.log_marginal


def draw_normals(size: int, count: int, heavy: bool, random: np.random.Generator) -> np.ndarray:
    """Draw standard normal numbers (b, p) for proposals of x, or multivariate Student-t if `heavy`."""
    normal = random.standard_normal((count, size))
    if heavy:
        normal *= np.sqrt(FREEDOM / random.chisquare(FREEDOM, count))[:, None]
    return normal


def _log_density(squares: Float[np.ndarray, "b"], dim: int, heavy: bool) -> np.ndarray:
    """Return the log density of standard normal (or Student-t) vectors with the given sums of squares (b,)."""
    if not heavy:
        return -0.5 * (squares + dim * LOG_2PI)
    # The multivariate t of `normal_numbers`: one χ² for all coordinates, hence the sum of all squares.
    half_order = 0.5 * (FREEDOM + dim)
    norm = gammaln(half_order) - gammaln(0.5 * FREEDOM) - 0.5 * dim * math.log(FREEDOM * math.pi)
    return norm - half_order * np.log1p(squares / FREEDOM)
