"""Leave-one-group-out cross-validation: φ re-estimated in each fold, coefficients x in closed form.

The model is linearised once, at the full fit; a fold is that linear model without the left-out group's readings. The
left-out group's deviations have their prior, like those of any unseen group.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import fdtrc

from bayescal._calibration.fitted import Fitted
from bayescal._core.parallel import run_on_one_thread
from bayescal._core.renamed import renamed
from bayescal._data.measurements import Measurements
from bayescal._inference.density import Density
from bayescal._inference.gaussian import Gram, Prior, condition
from bayescal._inference.laplace import Mode
from bayescal._inference.newton import HessianGuess, maximise
from bayescal._inference.problem import Problem
from bayescal._inference.record import Arrays, Record
from bayescal._model.terms import ColumnSpec

# Readings of a group whose error is tested: the error of 5 is three times its expectation once in 10⁷ groups.
MIN_GROUP_READINGS = 5
MAX_BLOCKS = 5  # number of blocks of neighbouring readings, left out if there are no groups


@renamed(surprise="error_ratio", by_chance="p_value")
@dataclass(frozen=True)
class LeaveOneGroupOut:
    """Predictions of each group of readings from a fit to the other groups, and their log scores."""

    group: str  # what a group is: device, run, cell, "time block" or "block of rows"
    members: tuple[str, ...]  # names of the groups
    log_score: np.ndarray  # joint log predictive density of each group (g,)
    residual: np.ndarray  # of each reading, predicted from the other groups, output unit
    error_ratio: np.ndarray  # rms whitened error over its expectation (g,); NaN below 5 readings
    p_value: np.ndarray  # of the error ratio under the model (g,)
    variance: np.ndarray  # of each reading given the other groups: noise plus expected output

    @property
    def rmse(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))

    def error(self, variance: np.ndarray) -> float:
        """Return the rms error, output unit, weighted by each reading's inverse variance."""
        return float(np.sqrt(np.mean(self.residual**2 / variance) / np.mean(1 / variance)))

    @property
    def count(self) -> int:
        return len(self.members)


class RecordSubset(Record):
    """Selected readings of a record, with lags and rates computed from all readings of that record."""

    def __init__(self, parent: Record, rows: np.ndarray) -> None:
        # In time order; a time step sums those of the omitted readings in between.
        order, time_steps = parent.time_order
        row_number = np.full(parent.size, -1)
        row_number[rows] = np.arange(len(rows))
        positions = np.flatnonzero(row_number[order] >= 0)
        subset_steps = np.diff(np.cumsum(np.maximum(time_steps, 0.0))[positions], prepend=0.0)
        subset_steps[np.diff(np.cumsum(time_steps < 0)[positions], prepend=-1) != 0] = -1.0
        frame = parent.frame.reorder(rows, row_number[order[positions]], subset_steps)
        super().__init__(parent.instrument, frame, parent.y[rows])
        self.parent, self.rows = parent, rows

    def _compute_columns(self, effect: ColumnSpec, values: Sequence[np.ndarray], shifts) -> Any:
        return self.parent._compute_columns(effect, values, self._fill(shifts))[:, self.rows]

    def differentiate_columns(self, effect: ColumnSpec, values: Sequence[Any], shifts) -> Any:
        columns, grads = self.parent.differentiate_columns(effect, values, self._fill(shifts))
        return columns[..., self.rows, :], {name: g[..., self.rows, :] for name, g in grads.items()}

    @cached_property
    def affine_map(self) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
        return self.parent.affine_map and self._select_rows(self.parent.affine_map)

    def respond(
        self, slots: Arrays, shifts: Arrays, with_grad: bool = True
    ) -> tuple[Float[np.ndarray, "*b n"], dict[str, Any]]:
        response = self.parent.respond(self._fill(slots), self._fill(shifts), with_grad)
        return self._select_rows(response)

    def _select_rows(self, values_and_slopes: tuple[np.ndarray, Mapping[str, np.ndarray]]):
        values, grads = values_and_slopes
        return values[..., self.rows], {name: s[..., self.rows] for name, s in grads.items()}

    def _fill(self, values: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Return values on the full record, zero outside the subset."""
        full_values = {}
        for name, value in values.items():
            subset_values = np.broadcast_to(value, (*np.shape(value)[:-1], self.size))
            full_values[name] = np.zeros((*subset_values.shape[:-1], self.parent.size))
            full_values[name][..., self.rows] = subset_values
        return full_values


def scheme(group: str) -> str:
    """Name the cross-validation scheme of a kind of group: "leave-one-run-out"."""
    return f"leave-one-{group.replace(' ', '-')}-out"


def choose_groups(readings: Measurements) -> tuple[str, tuple[str, ...], np.ndarray]:
    """Choose groups to leave out (devices, runs, cells, or blocks in time or order); return kind, names, codes (n,)."""
    for name in ("device", "run", "cell"):
        levels, codes = readings.groups(name)
        if len(levels) >= 2 and (codes >= 0).all():
            return name, levels, codes
    position = readings["time"] if readings.has("time") else np.arange(len(readings))
    rank, count = np.argsort(np.argsort(position, kind="stable")), min(MAX_BLOCKS, len(readings))
    codes = rank * count // len(readings)
    kind = "time block" if readings.has("time") else "block of rows"
    return kind, tuple(str(i + 1) for i in range(count)), codes


@run_on_one_thread
def leave_one_group_out(calibration: Fitted) -> LeaveOneGroupOut | None:
    """Predict every group from the others; return None if the noise is not Gaussian."""
    if not calibration.model.noise.is_gaussian:
        return None
    kind, members, codes = choose_groups(calibration.readings)
    mode, problem = calibration.mode, calibration.problem
    scores, error_ratio, p_value = np.full((3, len(members)), np.nan)
    residual, output_variance = np.full((2, len(codes)), np.nan)
    for i in range(len(members)):
        test_rows = np.flatnonzero(codes == i)
        fold = _predict_fold(problem, mode, np.flatnonzero(codes != i), test_rows)
        if fold is None:
            continue
        scores[i], residual[test_rows], output_variance[test_rows], squares, spectrum = fold
        if len(test_rows) >= MIN_GROUP_READINGS:
            counts = len(codes) - len(test_rows), len(members) - 1
            error_ratio[i] = math.sqrt(squares / spectrum.sum())
            p_value[i] = _compute_p_value(squares, spectrum, *counts)
    variance = calibration.linear.variance + output_variance
    return LeaveOneGroupOut(kind, members, scores, residual, error_ratio, p_value, variance)


def _compute_p_value(squares: float, spectrum: np.ndarray, readings: int, groups: int) -> float:
    """Return P(rᵀr ≥ squares) for r whose covariance, with eigenvalues λ (`spectrum`), is itself an estimate.

    rᵀr/Σλ is about χ²(ν)/ν with ν = (Σλ)²/Σλ² (F. Satterthwaite, Biometrics Bull. 2 (1946) 110). The noise part of Σλ
    has `readings` degrees of freedom, the number of training readings; the other part at least those of a between-group
    standard deviation, groups − 1. The ratio therefore has an F distribution.
    """
    # Relative to Σλ, whose square may overflow.
    trace = float(spectrum.sum())
    spectrum_dof, noise_share = 1 / float(np.sum((spectrum / trace) ** 2)), len(spectrum) / trace
    estimate_dof = 1 / (noise_share**2 / readings + (1 - noise_share) ** 2 / max(groups - 1, 1))
    return float(fdtrc(spectrum_dof, estimate_dof, squares / trace))


def _predict_fold(
    problem: Problem, mode: Mode, training_rows: np.ndarray, test_rows: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray, float, np.ndarray] | None:
    """Predict the left-out readings from the others; return None if a posterior of the coefficients is undefined.

    Returns log predictive density, errors, variance of the expected outputs, and of the whitened errors the sum of
    squares and the eigenvalues of their covariance.
    """
    subsets = (RecordSubset(problem.record, rows) for rows in (training_rows, test_rows))
    problems = (Problem(problem.layout, subset, problem.size_factors) for subset in subsets)
    guess = HessianGuess(mode.v, np.linalg.pinv(mode.covariance), True)
    fitted, test_density = (Density(p, mode.x, mode.flat, mode.v, guess=guess) for p in problems)
    # Noise that depends on a column keeps the full fit's φ, as training may not cover the left-out range.
    kinds = np.array(problem.kinds)
    is_free, v = (kinds != "noise") | (not problem.noise.covariates), mode.v.copy()
    objective = fitted if is_free.all() else fitted.fix_others(guess, is_free)
    v[is_free] = maximise(objective, mode.v[is_free], ftol=1e-3)  # φ to 0.05 standard deviations
    predicted_moments = _compute_held_out_moments(fitted, test_density, v)
    # The expected variance uses the larger between-group sd of fold and full fit: it may be zero over few groups.
    max_sd_v = np.where(kinds == "group_sd", np.maximum(v, mode.v), v)
    max_sd_moments = _compute_held_out_moments(fitted, test_density, max_sd_v)
    if predicted_moments is None or max_sd_moments is None:
        return None
    zeros, ones = np.zeros(len(mode.x)), np.ones(len(mode.x))
    joint_normal = condition(predicted_moments[1], len(test_rows), Prior(zeros, ones, ones), zeros)
    # Eigenvalues of I + A·C·Aᵀ, A the whitened columns and C = L·Lᵀ the covariance of x: 1 plus those of Lᵀ·Aᵀ·A·L.
    spectrum = np.ones(len(test_rows))
    eigenvalues = np.sort(np.linalg.eigvalsh(max_sd_moments[1].jtj))[::-1][: len(test_rows)]
    spectrum[: len(eigenvalues)] += np.maximum(eigenvalues, 0.0)
    score = np.nan if joint_normal is None else joint_normal.log_marginal
    return score, predicted_moments[0], max_sd_moments[2], max_sd_moments[1].rtr, spectrum


def _compute_held_out_moments(
    training_density: Density, test_density: Density, v: np.ndarray
) -> tuple[np.ndarray, Gram, np.ndarray] | None:
    """Return left-out readings' errors, whitened Gram matrix, and variance of expected outputs; None if undefined."""
    posterior = training_density.condition_at(v)[1]
    if posterior is None:
        return None
    residuals, whitened, logdet = test_density.whiten_at(v, posterior.mean)
    jacobian = whitened[:, :-1] @ posterior.root
    score = jacobian.T @ whitened[:, -1]
    gram = Gram(jacobian.T @ jacobian, score, float(whitened[:, -1] @ whitened[:, -1]), logdet)
    linearisation = test_density.problem.linearise(test_density.x, test_density.problem.hyper(v))
    return residuals, gram, np.sum((linearisation.jacobian @ posterior.root) ** 2, axis=1)
