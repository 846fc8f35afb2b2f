"""Joint draws: x given each of many φ, and the true density of both against what they were drawn from."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from bayescal._inference.gaussian import LOG_2PI, Drawn
from bayescal._inference.laplace import Mode, of_single_readings
from bayescal._inference.noise_on_record import total_log_density
from bayescal._inference.problem import Problem

FREEDOM = 5  # of the Student-t proposals
Batch = Mapping[str, np.ndarray | float]  # φ by name, one value a draw, or one for all


def draw_joint(
    problem: Problem,
    mode: Mode,
    found: Drawn,
    normal: Float[np.ndarray, "b p"],
    hyper: Batch,
    exact: bool,
    heavy: bool,
    random: np.random.Generator,
):
    """x and the per-reading coefficients given each φ, and the log ratio of the true joint density to what they are
    drawn from times the closed form: that of true to linearised likelihood.

    Args:
        problem: the structure on its record.
        mode: its mode.
        found: x drawn given each φ,
        normal: by these numbers; see `normal_numbers`.
        hyper: φ by name, one value a draw.
        exact: whether the closed form was that of φ itself.
        heavy: whether these numbers are Student-t.
        random: for the per-reading coefficients.

    Returns:
        x (b, p), rows (b, n, k), log ratio (b,).
    """
    count, (size, width) = len(found.x), mode.point.rows.shape
    own = random.standard_normal((count, size, width))
    x = found.x
    rows = np.broadcast_to(mode.point.rows, (count, size, width))
    if not width and problem.affine and exact:
        return x, rows, np.zeros(count)
    log_volume, squares = found.log_volume, np.sum(normal**2, axis=1)
    if width:
        rows, volume = _draw_rows(problem, mode, x, hyper, own)
        log_volume, squares = log_volume + volume, squares + np.sum(own**2, axis=(1, 2))
    # x = shift + S·L⁻ᵀ·ε has the density of ε over |S·L⁻ᵀ|, the volume of the map.
    log_drawn = _log_density(squares, normal.shape[1] + size * width, heavy) - log_volume
    left = problem.record.y - problem.expected(x, rows, hyper)
    prior = -0.5 * (found.squares + LOG_2PI * np.sum(problem.weight_of_x))
    if width:
        spread = problem.row_sd
        prior -= 0.5 * np.sum((rows / spread) ** 2, axis=(1, 2))
        prior -= 0.5 * size * float(np.sum(2 * np.log(spread) + LOG_2PI))
    # The weight of φ holds p(y|φ) of the linearised model already: it is divided out, with the density that x was
    # drawn from, and the true likelihood and prior of x put in its place.
    true = total_log_density(problem.noise, problem.record, left, hyper)
    return x, rows, true + prior - log_drawn - found.log_marginal


def normal_numbers(size: int, count: int, heavy: bool, random: np.random.Generator) -> np.ndarray:
    """What x is drawn by (b, p): standard normal, or Student-t, where the posterior has heavier tails than its fit."""
    normal = random.standard_normal((count, size))
    if heavy:
        normal *= np.sqrt(FREEDOM / random.chisquare(FREEDOM, count))[:, None]
    return normal


def _log_density(squares: Float[np.ndarray, "b"], dim: int, heavy: bool) -> np.ndarray:
    """Of the numbers that x is placed by: standard normal, or Student-t."""
    if not heavy:
        return -0.5 * (squares + dim * LOG_2PI)
    # The multivariate t of `normal_numbers`: one χ² for all coordinates, hence the sum of all squares.
    half = 0.5 * (FREEDOM + dim)
    norm = gammaln(half) - gammaln(0.5 * FREEDOM) - 0.5 * dim * math.log(FREEDOM * math.pi)
    return norm - half * np.log1p(squares / FREEDOM)


def _draw_rows(problem: Problem, mode: Mode, x, hyper: Batch, own: Float[np.ndarray, "b n k"]):
    """Per-reading coefficients given all else in the linearised model, and the log volume of the map from `own`."""
    drawn, volumes = np.empty_like(own), np.empty(len(own))
    moving, line = bool(problem.moving), None
    for b in range(len(own)):
        one = {name: float(np.broadcast_to(v, len(own))[b]) for name, v in hyper.items()}
        if line is None or moving:
            line = problem.linearise(mode.point, one)
            known = line.mean - np.sum(line.rows * mode.point.rows, axis=1)
        left = problem.record.y - known - line.jacobian @ (x[b] - mode.point.x)
        precision, pull = of_single_readings(problem, line, left, one)
        chol = np.linalg.cholesky(precision)  # L⁻ᵀ of L·Lᵀ places what is drawn
        root = np.linalg.inv(chol).transpose(0, 2, 1)  # of the covariance of each reading's own
        placed = root @ (root.transpose(0, 2, 1) @ pull[..., None] + own[b][..., None])
        drawn[b] = placed[..., 0]
        volumes[b] = -np.sum(np.log(np.diagonal(chol, axis1=1, axis2=2)))
    return drawn, volumes
