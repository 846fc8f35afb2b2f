"""Joint draws: x given each of many φ, and the true density of both against what they were drawn from."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from bayescal._inference.gaussian import LOG_2PI, Drawn
from bayescal._inference.noise_on_record import Batch, total_log_density
from bayescal._inference.problem import Problem

FREEDOM = 5  # of the Student-t proposals


def correction(
    problem: Problem,
    drawn: Drawn,
    normal: Float[np.ndarray, "b p"],
    hyper: Batch,
    exact: bool,
    heavy: bool,
) -> Float[np.ndarray, "b"]:
    """Return the log ratio of true joint density to proposal density of x, times the closed form.

    x was drawn by these normal numbers, Student-t if `heavy`; `exact`: the closed form was that of φ itself.
    """
    if problem.affine and exact:
        return np.zeros(len(drawn.x))
    # x = shift + S·L⁻ᵀ·ε has the density of ε over |S·L⁻ᵀ|, the volume of the map.
    squares = np.sum(normal**2, axis=1)
    log_drawn = _log_density(squares, normal.shape[1], heavy) - drawn.log_volume
    expected, extra = problem.expected_and_extra(drawn.x, hyper)
    prior = -0.5 * (drawn.squares + LOG_2PI * np.sum(problem.weight_of_x))
    # The weight of φ holds p(y|φ) of the linearised model already: it is divided out, with the density that x was
    # drawn from, and the true likelihood and prior of x put in its place.
    residual = problem.record.y - expected
    true = total_log_density(problem.noise, problem.record, residual, hyper, extra)
    return true + prior - log_drawn - drawn.log_marginal


def normal_numbers(size: int, count: int, heavy: bool, random: np.random.Generator) -> np.ndarray:
    """Draw the numbers (b, p) that x is proposed by: standard normal, or Student-t if `heavy`."""
    normal = random.standard_normal((count, size))
    if heavy:
        normal *= np.sqrt(FREEDOM / random.chisquare(FREEDOM, count))[:, None]
    return normal


def _log_density(squares: Float[np.ndarray, "b"], dim: int, heavy: bool) -> np.ndarray:
    """Return the log density of standard normal, or Student-t, numbers."""
    if not heavy:
        return -0.5 * (squares + dim * LOG_2PI)
    # The multivariate t of `normal_numbers`: one χ² for all coordinates, hence the sum of all squares.
    half = 0.5 * (FREEDOM + dim)
    norm = gammaln(half) - gammaln(0.5 * FREEDOM) - 0.5 * dim * math.log(FREEDOM * math.pi)
    return norm - half * np.log1p(squares / FREEDOM)
