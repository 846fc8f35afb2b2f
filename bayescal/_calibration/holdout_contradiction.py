"""Do hold-out data contradict a fit beyond chance? Tests against readings replicated as the fit expects them.

A replicate has its own draw of the coefficients, deviations of its own for runs that the fit has not seen, and noise:
whatever makes hold-out errors large by right is in its errors too (posterior predictive p-values: A. Gelman, X.-L. Meng
and H. Stern, Statistica Sinica 6 (1996) 733).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.predict import Prediction, replicates
from bayescal._core.parallel import on_one_thread
from bayescal._data.measurements import Measurements
from bayescal._inference.problem import Problem
from bayescal._model.effect import Effect
from bayescal._model.instrument import factor_of
from bayescal._model.terms import ColumnsOf

DRAWS = 1000  # replicates, fewer of many readings: p-values to a thousandth
CELLS = 10_000_000  # replicates × readings, held together
TINY_SQUARE = 1e-300  # squares of an error that is none
SEEN_SHARE = 1e-8  # of the longest direction's length, below which a direction is rounding


@dataclass(frozen=True)
class HoldoutContradiction:
    """What hold-out data say against a fit."""

    p: float  # probability of coefficients that the data pull as far, if the fit is right
    share: float  # hold-out error over what it would be, did coefficients and deviations suit these data
    scatter: float  # of what neither explains, the rms over its expected one
    most: str  # the coefficient that they pull the farthest, by itself; empty where there is none


@dataclass(frozen=True, eq=False)
class HoldoutTest:
    """A fit's prediction of hold-out data, and what these say against it."""

    calibration: Calibration
    readings: Measurements  # the hold-out data
    prediction: Prediction  # of them
    # Deviations of groups that the fit holds none of, and their plausible standard deviation: a single run does not
    # show how far runs are apart, and a few do not show it where it is small.
    unseen: tuple[tuple[Effect, float], ...] = ()

    @cached_property
    def against(self) -> HoldoutContradiction:
        """Whether the data contradict the fit: the score test of its coefficients, and the scatter beside them.

        With e the errors over the noise and Q a basis of the coefficients' columns, t = Qᵀe has mean zero and the
        covariance C of the replicates' own Qᵀe; tᵀC⁻¹t is compared with theirs (C. R. Rao, Proc. Camb. Phil. Soc. 44
        (1948) 50). A free number for each direction is what another device or condition differs in.
        """
        errors, expected = self._errors
        # Columns of the coefficients that all readings share, and of the deviations of each group's members.
        columns = self._columns
        shared = [column for _, per, column in columns if per is None]
        groups = [(self.readings.groups(per)[1], column) for _, per, column in columns if per]
        own = [np.where(codes == k, c, 0.0) for codes, c in groups for k in np.unique(codes)]
        basis, whole = _orthonormal(shared, len(errors)), _orthonormal([*shared, *own], len(errors))
        pulled, by_right = basis.T @ errors, expected @ basis
        covariance = np.atleast_2d(np.cov(by_right.T)) if basis.shape[1] else np.zeros((0, 0))
        inverse = np.linalg.pinv(covariance, rcond=1e-12, hermitian=True)
        far = np.einsum("bi,ij,bj->b", by_right, inverse, by_right)
        p = _share(far >= pulled @ inverse @ pulled)
        left = max(_squares(errors - whole @ (whole.T @ errors)), TINY_SQUARE)
        usual = np.median(_squares(expected - (expected @ whole) @ whole.T))
        scatter = math.sqrt(left / max(float(usual), TINY_SQUARE))
        share = math.sqrt(float(_squares(errors)) / left)
        away = {
            name: abs(float(column @ errors)) / max(float(np.std(expected @ column)), TINY_SQUARE)
            for name, per, column in columns
            if per is None
        }
        return HoldoutContradiction(p, share, scatter, max(away, key=lambda n: away[n], default=""))

    def worse_than(self, other: HoldoutTest) -> float:
        """Probability that hold-out errors stand as much for another fit as they do, if this fit is right.

        A paired test: with δ = μ₁ − μ₀ the difference of the two predictions, the other's squared errors over the noise
        exceed this one's by δᵀδ + 2δᵀe, whose only part of chance is δᵀe.
        """
        errors, expected = self._errors
        moved = (self.prediction.mean - other.prediction.mean) / self._noise
        return _share(expected @ moved <= errors @ moved)

    @cached_property
    def _noise(self) -> Float[np.ndarray, "n"]:
        """Standard deviation of the noise, or of what stands for it, output unit."""
        found = self.prediction
        return np.sqrt(np.maximum(found.sd**2 - found.model_sd**2, 1e-12 * found.sd**2))

    @cached_property
    def _problem(self) -> tuple[Calibration, Problem]:
        """Those structures of the fit that need no other columns, on the hold-out data."""
        used = self.calibration.with_columns(self.readings.columns)
        return used, used.problem_on(used.frame_of(self.readings))

    @cached_property
    def _errors(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "draws n"]]:
        """Errors over the noise, and those of replicates."""
        count = max(100, min(DRAWS, CELLS // max(len(self.readings), 1)))
        made = replicates(self.calibration, self.readings, count, self.calibration.seed)
        (used, problem), random = self._problem, np.random.default_rng(0)
        # What deviations of groups that the fit holds none of would add.
        slopes = problem.slopes(used.mode.x, problem.hyper(used.mode.v)) if self.unseen else {}
        for effect, size in self.unseen:
            c = effect.coefficients[0]
            column = problem.record.columns(ColumnsOf.of(effect), ())[:, 0]
            column = column * factor_of(used.model.instrument, effect, c)
            codes = self.readings.groups(str(c.per))[1]
            drawn = size * random.standard_normal((len(made), int(codes.max()) + 2))[:, codes]
            made += slopes[c.slot or effect.slot] * column * drawn
        made -= made.mean(axis=0)
        return self.prediction.residual / self._noise, made / self._noise

    @property
    @on_one_thread
    def _columns(self) -> list[tuple[str, str | None, Float[np.ndarray, "n"]]]:
        """Of each coefficient its name, its group, and its column over the noise, at the mean of the draws."""
        used, problem = self._problem
        x, v = used.draws()
        terms = [t for t in problem.terms if t.place == "x"]
        slopes = problem.expected_with_slopes(
            x.mean(axis=0)[None], problem.hyper(v.mean(axis=0)), terms
        )[1]
        each = (np.broadcast_to(slope, (1, len(self._noise)))[0] / self._noise for slope in slopes)
        names = (t.known.effect.coefficient_name(t.index) for t in terms)
        return [(n, t.known.per, c) for n, t, c in zip(names, terms, each, strict=True)]


def _orthonormal(columns: Sequence[np.ndarray], size: int) -> Float[np.ndarray, "n k"]:
    """A basis of what columns span."""
    each = [c / length for c in columns if (length := float(np.linalg.norm(c))) > 0]
    if not each:
        return np.zeros((size, 0))
    left, values, _ = np.linalg.svd(np.array(each).T, full_matrices=False)
    return left[:, values > SEEN_SHARE * values[0]]


def _squares(rows: np.ndarray) -> np.ndarray:
    """Sum of squares of each row."""
    return np.sum(rows**2, axis=-1)


def _share(hits: np.ndarray) -> float:
    """Of replicates, itself among them: no p-value is zero."""
    return float((1 + np.count_nonzero(hits)) / (1 + len(hits)))
