"""Leave-one-group-out: each group predicted as new, φ re-estimated in each fold, x in closed form.

The model is linearised once, at the full fit; a fold is the same linear model without the group's readings. Deviations
of the left-out group then come from their prior, as those of any group not yet seen.
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
from bayescal._core.parallel import on_one_thread
from bayescal._data.measurements import Measurements
from bayescal._inference.density import Density
from bayescal._inference.gaussian import Gram, Prior, condition
from bayescal._inference.laplace import Mode
from bayescal._inference.newton import Nearby, climb
from bayescal._inference.problem import Problem
from bayescal._inference.record import Arrays, Record
from bayescal._model.terms import ColumnSpec

# Readings, below which a group's error is a matter of chance: it is three times too large once in 10⁷ groups of 5.
FEW_IN_GROUP = 5
BLOCKS = 5  # of neighbouring readings, where there is no group to leave out


@dataclass(frozen=True)
class LeaveOneGroupOut:
    """Predictions of each group from the others."""

    group: str  # what a group is: device, run, cell, "time block" or "block of rows"
    members: tuple[str, ...]  # names of the groups
    log_score: np.ndarray  # joint log predictive density of each group (g,)
    residual: np.ndarray  # of each reading, predicted from the other groups, output unit
    # Rms of each group's whitened residuals over its expectation from the other groups, model uncertainty and a new
    # group's deviations included (g,): about 1 if the model is right, NaN of fewer than 5 readings.
    surprise: np.ndarray
    by_chance: np.ndarray  # probability of so large a surprise, if the model is right (g,)
    variance: np.ndarray  # of each reading: noise, and its expectation as the other groups leave it

    @property
    def rmse(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))

    def error(self, variance: np.ndarray) -> float:
        """Return the rms error, output unit, weighted by each reading's inverse variance."""
        return float(np.sqrt(np.mean(self.residual**2 / variance) / np.mean(1 / variance)))

    @property
    def count(self) -> int:
        return len(self.members)


class Part(Record):
    """A subset of a record's readings, by rows; columns keep what happened between them (lags, rates)."""

    def __init__(self, whole: Record, rows: np.ndarray) -> None:
        # In time order; each step is the sum of the steps of the readings in between.
        order, step = whole.in_time
        place = np.full(whole.size, -1)
        place[rows] = np.arange(len(rows))
        in_time = np.flatnonzero(place[order] >= 0)
        steps = np.diff(np.cumsum(np.maximum(step, 0.0))[in_time], prepend=0.0)
        steps[np.diff(np.cumsum(step < 0)[in_time], prepend=-1) != 0] = -1.0
        frame = whole.frame.reordered(rows, place[order[in_time]], steps)
        super().__init__(whole.instrument, frame, whole.y[rows])
        self.whole, self.rows = whole, rows

    def _compute_columns(self, effect: ColumnSpec, values: Sequence[np.ndarray], shifts) -> Any:
        return self.whole._compute_columns(effect, values, self._fill(shifts))[:, self.rows]

    def differentiate_columns(self, effect: ColumnSpec, values: Sequence[Any], shifts) -> Any:
        rows, slopes = self.whole.differentiate_columns(effect, values, self._fill(shifts))
        return rows[..., self.rows, :], {name: s[..., self.rows, :] for name, s in slopes.items()}

    @cached_property
    def affine(self) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
        return self.whole.affine and self._select_rows(self.whole.affine)

    def respond(
        self, slots: Arrays, shifts: Arrays, with_grad: bool = True
    ) -> tuple[Float[np.ndarray, "*b n"], dict[str, Any]]:
        whole = self.whole.respond(self._fill(slots), self._fill(shifts), with_grad)
        return self._select_rows(whole)

    def _select_rows(self, values_and_slopes: tuple[np.ndarray, Mapping[str, np.ndarray]]):
        values, slopes = values_and_slopes
        return values[..., self.rows], {name: s[..., self.rows] for name, s in slopes.items()}

    def _fill(self, values: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Return values on the whole record, zero outside the subset."""
        scattered = {}
        for name, value in values.items():
            broadcast = np.broadcast_to(value, (*np.shape(value)[:-1], self.size))
            scattered[name] = np.zeros((*broadcast.shape[:-1], self.whole.size))
            scattered[name][..., self.rows] = broadcast
        return scattered


def scheme(group: str) -> str:
    """Return the scheme's name: "leave-one-run-out"."""
    return f"leave-one-{group.replace(' ', '-')}-out"


def groups_of(readings: Measurements) -> tuple[str, tuple[str, ...], np.ndarray]:
    """Choose the groups to leave out: devices if there are two, else runs, cells, or blocks in time or order."""
    for name in ("device", "run", "cell"):
        levels, codes = readings.groups(name)
        if len(levels) >= 2 and (codes >= 0).all():
            return name, levels, codes
    position = readings["time"] if readings.has("time") else np.arange(len(readings))
    rank = np.argsort(np.argsort(position, kind="stable"))
    count = min(BLOCKS, len(readings))
    codes = rank * count // len(readings)
    kind = "time block" if readings.has("time") else "block of rows"
    return kind, tuple(str(i + 1) for i in range(count)), codes


@on_one_thread
def leave_one_group_out(calibration: Fitted) -> LeaveOneGroupOut | None:
    """Predict every group from the others; None where the noise is not Gaussian."""
    if not calibration.model.noise.gaussian:
        return None
    kind, members, codes = groups_of(calibration.readings)
    mode, whole = calibration.mode, calibration.problem
    scores, surprise, by_chance = np.full((3, len(members)), np.nan)
    residual, model = np.full((2, len(codes)), np.nan)
    for i in range(len(members)):
        out = np.flatnonzero(codes == i)
        fold = _fold(whole, mode, np.flatnonzero(codes != i), out)
        if fold is None:
            continue
        scores[i], residual[out], model[out], squares, spectrum = fold
        if len(out) >= FEW_IN_GROUP:
            counts = len(codes) - len(out), len(members) - 1
            surprise[i] = math.sqrt(squares / spectrum.sum())
            by_chance[i] = _surprise_p_value(squares, spectrum, *counts)
    variance = calibration.linear.variance + model
    return LeaveOneGroupOut(kind, members, scores, residual, surprise, by_chance, variance)


def _surprise_p_value(squares: float, spectrum: np.ndarray, readings: int, groups: int) -> float:
    """Return the probability of rᵀr as large, under a model estimated from so many readings and groups.

    rᵀr/Σλ is about χ²(ν)/ν with ν = (Σλ)²/Σλ² (F. Satterthwaite, Biometrics Bull. 2 (1946) 110); Σλ was itself
    estimated, its part of the noise from the readings kept, the rest at worst from a standard deviation between as
    many groups less one: so an F distribution.
    """
    # Relative to Σλ, whose square may overflow.
    trace = float(spectrum.sum())
    spectrum_freedom = 1 / float(np.sum((spectrum / trace) ** 2))
    noise = len(spectrum) / trace
    estimate_freedom = 1 / (noise**2 / readings + (1 - noise) ** 2 / max(groups - 1, 1))
    return float(fdtrc(spectrum_freedom, estimate_freedom, squares / trace))


def _fold(
    whole: Problem, mode: Mode, training: np.ndarray, left_out: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray, float, np.ndarray] | None:
    """Predict the left-out readings from the others: return joint log predictive density, errors, variance of the
    expectation, whitened residual sum of squares and the eigenvalues of its covariance; None if either fails."""
    parts = (Part(whole.record, rows) for rows in (training, left_out))
    problems = (Problem(whole.layout, part, whole.size_factors) for part in parts)
    near = Nearby(mode.v, np.linalg.pinv(mode.covariance), True)
    fitted, predicted = (Density(p, mode.x, mode.flat, mode.v, like=near) for p in problems)
    v = climb(fitted, mode.v, ftol=1e-3)  # φ to 0.05 standard deviations
    kinds = np.array(whole.kinds)
    # A noise law along a column keeps its full fit: the training readings may not cover the left-out range.
    v = np.where((kinds == "noise") & bool(whole.noise.covariates), mode.v, v)
    predicted_moments = _held_out_moments(fitted, predicted, v)
    # The expected variance uses the full fit's standard deviation between groups: a few groups alike by chance would
    # make it zero.
    between = kinds == "group_sd"
    conservative = _held_out_moments(fitted, predicted, np.where(between, np.maximum(v, mode.v), v))
    if predicted_moments is None or conservative is None:
        return None
    size = len(mode.x)
    unit = Prior(np.zeros(size), np.ones(size), np.ones(size))
    joint = condition(predicted_moments[1], len(left_out), unit, np.zeros(size))
    # I + A·C·Aᵀ, A the whitened columns and C = L·Lᵀ the covariance of x: of its n eigenvalues those of Lᵀ·Aᵀ·A·L are
    # what it has above one.
    spectrum = np.ones(len(left_out))
    above = np.sort(np.linalg.eigvalsh(conservative[1].jtj))[::-1][: len(left_out)]
    spectrum[: len(above)] += np.maximum(above, 0.0)
    score = np.nan if joint is None else joint.log_marginal
    return score, predicted_moments[0], conservative[2], conservative[1].rtr, spectrum


def _held_out_moments(
    fitted: Density, predicted: Density, v: np.ndarray
) -> tuple[np.ndarray, Gram, np.ndarray] | None:
    """Return errors of the left-out readings, their Gram matrix in the training posterior's coordinates, variance."""
    posterior = fitted.condition_at(v)[1]
    if posterior is None:
        return None
    centred, table, logdet = predicted.whiten_at(v, posterior.mean)
    turned = table[:, :-1] @ posterior.root
    score = turned.T @ table[:, -1]
    gram = Gram(turned.T @ turned, score, float(table[:, -1] @ table[:, -1]), logdet)
    line = predicted.problem.linearise(predicted.x, predicted.problem.hyper(v))
    return centred, gram, np.sum((line.jacobian @ posterior.root) ** 2, axis=1)
