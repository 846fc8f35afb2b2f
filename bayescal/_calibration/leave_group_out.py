"""Leave one group out: the left-out group predicted as new, φ estimated again in each fold, x in closed form.

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
from bayescal._inference.record import Record
from bayescal._model.terms import ColumnsOf

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
    # Of each group, rms of its whitened residuals over what the other groups expect of it, their uncertainty of the
    # model and of a new group's deviations included (g,): about 1 if the model is right, NaN of fewer than 5 readings.
    surprise: np.ndarray
    by_chance: np.ndarray  # probability of so large a surprise, if the model is right (g,)
    variance: np.ndarray  # of each reading: noise, and its expectation as the other groups leave it

    @property
    def rmse(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))

    def error(self, variance: np.ndarray) -> float:
        """Return the rms error, output unit, weighted by the inverse of a variance of each reading."""
        return float(np.sqrt(np.mean(self.residual**2 / variance) / np.mean(1 / variance)))

    @property
    def count(self) -> int:
        return len(self.members)


class Part(Record):
    """Some readings of a record, by their rows; what happened between them stays in their columns."""

    def __init__(self, whole: Record, rows: np.ndarray) -> None:
        # In the order of time, the steps between them those of all readings in between, summed.
        order, step = whole.in_time
        place = np.full(whole.size, -1)
        place[rows] = np.arange(len(rows))
        kept = np.flatnonzero(place[order] >= 0)
        steps = np.diff(np.cumsum(np.maximum(step, 0.0))[kept], prepend=0.0)
        steps[np.diff(np.cumsum(step < 0)[kept], prepend=-1) != 0] = -1.0
        frame = whole.frame.reordered(rows, place[order[kept]], steps)
        super().__init__(whole.instrument, frame, whole.y[rows])
        self.whole, self.rows = whole, rows

    def _computed(self, effect: ColumnsOf, values: Sequence[np.ndarray], moves) -> Any:
        return self.whole._computed(effect, values, self._spread(moves))[:, self.rows]

    def moved_columns_of_draws(self, effect: ColumnsOf, values: Sequence[Any], moves) -> Any:
        found, slopes = self.whole.moved_columns_of_draws(effect, values, self._spread(moves))
        return found[..., self.rows, :], {name: s[..., self.rows, :] for name, s in slopes.items()}

    @cached_property
    def affine(self) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
        return self.whole.affine and self._kept(self.whole.affine)

    def respond(
        self, slots: Mapping[str, np.ndarray], moves: Mapping[str, np.ndarray], sloped: bool = True
    ) -> tuple[Float[np.ndarray, "*b n"], dict[str, Any]]:
        return self._kept(self.whole.respond(self._spread(slots), self._spread(moves), sloped))

    def _kept(self, of_all: tuple[np.ndarray, Mapping[str, np.ndarray]]):
        values, slopes = of_all
        return values[..., self.rows], {name: s[..., self.rows] for name, s in slopes.items()}

    def _spread(self, values: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """The same on the whole record, zero where a reading is not kept."""
        found = {}
        for name, value in values.items():
            kept = np.broadcast_to(value, (*np.shape(value)[:-1], self.size))
            found[name] = np.zeros((*kept.shape[:-1], self.whole.size))
            found[name][..., self.rows] = kept
        return found


def scheme(group: str) -> str:
    """What the scheme is called where these are the groups: "leave-one-run-out"."""
    return f"leave-one-{group.replace(' ', '-')}-out"


def groups_of(readings: Measurements) -> tuple[str, tuple[str, ...], np.ndarray]:
    """What to leave out: device if there are two, else run, else cell, else blocks in time or in order."""
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
        found = _fold(whole, mode, np.flatnonzero(codes != i), out)
        if found is None:
            continue
        scores[i], residual[out], model[out], squares, spectrum = found
        if len(out) >= FEW_IN_GROUP:
            kept = len(codes) - len(out), len(members) - 1
            surprise[i] = math.sqrt(squares / spectrum.sum())
            by_chance[i] = _by_chance(squares, spectrum, *kept)
    variance = calibration.linear.variance + model
    return LeaveOneGroupOut(kind, members, scores, residual, surprise, by_chance, variance)


def _by_chance(squares: float, spectrum: np.ndarray, readings: int, groups: int) -> float:
    """Probability of squares rᵀr as large, if what was learnt of so many readings and groups is right.

    rᵀr/Σλ is about χ²(ν)/ν with ν = (Σλ)²/Σλ² (F. Satterthwaite, Biometrics Bull. 2 (1946) 110); Σλ was itself
    estimated, its part of the noise from the readings kept, the rest at worst from a standard deviation between as
    many groups less one: so an F distribution.
    """
    # In parts of Σλ, whose square may be no number.
    whole = float(spectrum.sum())
    own = 1 / float(np.sum((spectrum / whole) ** 2))
    noise = len(spectrum) / whole
    known = 1 / (noise**2 / readings + (1 - noise) ** 2 / max(groups - 1, 1))
    return float(fdtrc(own, known, squares / whole))


def _fold(
    whole: Problem, mode: Mode, kept: np.ndarray, out: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray, float, np.ndarray] | None:
    """Of readings left out, as the kept ones predict them, the joint log predictive density, errors, variance of what
    is expected, sum of squares of the whitened errors, and the eigenvalues of their covariance; None of nothing."""
    parts = (Part(whole.record, rows) for rows in (kept, out))
    problems = (Problem(whole.layout, part, whole.size_factors) for part in parts)
    near = Nearby(mode.v, np.linalg.pinv(mode.covariance), True)
    fitted, predicted = (Density(p, mode.x, mode.flat, mode.v, like=near) for p in problems)
    v = climb(fitted, mode.v, ftol=1e-3)  # φ to 0.05 standard deviations
    kinds = np.array(whole.kinds)
    # A law that follows a column is that of all readings: where it lies for these, the kept may have none.
    v = np.where((kinds == "noise") & bool(whole.noise.covariates), mode.v, v)
    given = _given(fitted, predicted, v)
    # What is expected of a group has the standard deviation between groups of them all: a few that are alike by chance
    # would say that there is none.
    between = kinds == "group_sd"
    of_all = _given(fitted, predicted, np.where(between, np.maximum(v, mode.v), v))
    if given is None or of_all is None:
        return None
    size = len(mode.x)
    unit = Prior(np.zeros(size), np.ones(size), np.ones(size))
    joint = condition(given[1], len(out), unit, np.zeros(size))
    # I + A·C·Aᵀ, A the whitened columns and C = L·Lᵀ the covariance of x: of its n eigenvalues those of Lᵀ·Aᵀ·A·L are
    # what it has above one.
    spectrum = np.ones(len(out))
    above = np.sort(np.linalg.eigvalsh(of_all[1].jtj))[::-1][: len(out)]
    spectrum[: len(above)] += np.maximum(above, 0.0)
    score = np.nan if joint is None else joint.log_marginal
    return score, given[0], of_all[2], of_all[1].rtr, spectrum


def _given(
    fitted: Density, predicted: Density, v: np.ndarray
) -> tuple[np.ndarray, Gram, np.ndarray] | None:
    """Errors of the readings left out, output unit, their products with the posterior of x from the kept readings as a
    prior of unit normals, and the variance of what these expect."""
    found = fitted.at(v)[1]
    if found is None:
        return None
    centred, table, logdet = predicted.whitened(v, found.mean)
    turned = table[:, :-1] @ found.root
    pull = turned.T @ table[:, -1]
    gram = Gram(turned.T @ turned, pull, float(table[:, -1] @ table[:, -1]), logdet)
    line = predicted.problem.linearise(predicted.x, predicted.problem.hyper(v))
    return centred, gram, np.sum((line.jacobian @ found.root) ** 2, axis=1)
