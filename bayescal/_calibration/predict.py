"""Expected output of a calibrated model on readings, with its uncertainty; and what hold-out data say against it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.linalg import orth

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fitted import moments, replicate
from bayescal._core.parallel import on_one_thread
from bayescal._data.measurements import Measurements
from bayescal._inference.noise_on_record import variance
from bayescal._inference.problem import Problem
from bayescal._model.effect import Effect
from bayescal._model.frame import Frame
from bayescal._model.instrument import factor_of
from bayescal._model.terms import ColumnsOf

ROUNDING = 1e-12  # of a variance: what is left of it as white noise, if a law has none
DRAWS = 1000  # replicates, fewer of many readings: p-values to a thousandth
REPLICATED_CELLS = 10_000_000  # replicates × readings, held together
TINY_SQUARE = 1e-300  # squares of an error that is none
NONE = np.zeros(0, dtype=int)  # of the fitted readings
SEEN_SHARE = 1e-8  # of the longest direction's length, below which a direction is rounding


@dataclass(frozen=True)
class Prediction:
    """Expected output per reading.

    Attributes:
        mean: posterior mean of the expected output, output unit, (n,).
        model_sd: standard uncertainty of the expected output, from coefficients, from the model's form (`form_factor`
            of the calibration) and, for groups that the fit has not seen, from their spread, found or not.
        sd: standard uncertainty of a reading: with noise.
        residual: output − mean.
    """

    mean: np.ndarray
    model_sd: np.ndarray
    sd: np.ndarray
    residual: np.ndarray

    @property
    def rmse(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))


def predict(
    calibration: Calibration,
    readings: Measurements | None = None,
    *,
    new_groups: bool = True,
    draws: int = 1000,
) -> Prediction:
    """Predict readings.

    Readings that go on with a run of the record that was fitted (its name, its clock, a time between or right after its
    readings) continue it: lags, hysteresis, the run's own deviation and correlated noise go on from there, as they
    would have had the file not been cut.

    Args:
        calibration: a fit, or an average over structures: over those that need no column which the readings lack.
        readings: to predict; the fitted ones if not given. Without a column `run` they are one new run. Dates are read
            on the calibration's clock.
        new_groups: take every run, cell or device as one that the fit has not seen: its deviation is zero,
            give or take its spread. False uses the deviations of members that the fit knows by name. An axis
            is part of its instrument: one that the fit knows is itself either way.
        draws: posterior draws to average over, at most.

    Raises:
        ModelError: the readings lack a column that an effect needs.
        InputError: they have dates and the calibration has none, or the other way round, and an effect changes with
            the date.
    """
    known = readings is None
    readings = calibration.readings if readings is None else readings
    if calibration.readings.has("run") and not readings.has("run") and new_groups:
        readings = readings.with_column("run", np.full(len(readings), "new"))
    calibration = calibration.with_columns(readings.columns)
    calibration.model.require(readings)
    readings = calibration.on_clock(readings)
    correlated = not calibration.model.noise.independent

    def moments_of(some: Measurements, frame: Frame, past: np.ndarray) -> np.ndarray:
        """Return residual, standard uncertainties of the expected output and of a reading (3, n)."""
        count, noise_of, spread = len(past), None, 0.0
        if count and correlated:
            later = some.select(np.arange(count, len(some)))
            noise = _noise_at(calibration, past, later)
            output = frame["output"][:count]
            spread = np.append(np.zeros(count), noise(np.zeros((count, 1)))[1])

            def carried(expected: np.ndarray) -> np.ndarray:
                # Each draw of the coefficients leaves its own, so that a level that the noise and a coefficient may
                # both hold is uncertain in either, and not in their sum. Of the past noise is not asked for.
                found = noise((np.asarray(output) - expected[:, :count]).T)[0].T
                return np.concatenate([np.zeros_like(expected[:, :count]), found], axis=1)

            noise_of = carried
        problem = calibration.problem_on(frame)
        found = moments(problem, calibration.draws(draws), noise_of)
        model = calibration.form_factor**2 * found.variance + found.beside
        model += _of_unfound_spreads(calibration, problem)
        residual = np.asarray(frame["output"]) - found.mean
        return np.stack([residual, np.sqrt(model), np.sqrt(model + found.noise + spread)])

    if new_groups and not known:
        residual, model_sd, sd = _with_past(calibration, readings, moments_of)
    else:
        frame = calibration.frame_of(readings)
        frame = _of_new_groups(frame) if new_groups else frame
        residual, model_sd, sd = moments_of(readings, frame, NONE)
    return Prediction(readings["output"] - residual, model_sd, sd, residual)


def _of_unfound_spreads(calibration: Calibration, problem: Problem) -> np.ndarray:
    """Return the variance of readings of members that the fit has not seen, by deviations that no draw has."""
    known, found = calibration.model.instrument.known, np.zeros(problem.record.size)
    for name, size in calibration.unfound_spreads.items():
        new = problem.record.codes[str(known[name].coefficients[0].per)] < 0
        if new.any():
            found += new * (size * _deviating(calibration, problem, known[name])) ** 2
    return found


def _deviating(calibration: Calibration, problem: Problem, effect: Effect) -> np.ndarray:
    """Return what a deviation moves each reading by, output unit over that of its coefficient (n,)."""
    slopes = problem.slopes(calibration.mode.x, problem.hyper(calibration.mode.v))
    c, column = effect.coefficients[0], problem.record.columns(ColumnsOf.of(effect), ())[:, 0]
    factor = factor_of(calibration.model.instrument, effect, c)
    return slopes[c.slot or effect.slot] * factor * column


def replicates(
    calibration: Calibration, readings: Measurements, draws: int, seed: int
) -> Float[np.ndarray, "draws n"]:
    """Readings as a calibration expects them, simulated once from each draw: new runs, cells and devices as `predict`
    has them, with deviations of their own; readings that go on with a fitted run have its deviation, and correlated
    noise that is not told by its past."""
    calibration, random = calibration.with_columns(readings.columns), np.random.default_rng(seed)

    def made(some: Measurements, frame: Frame, _: np.ndarray) -> np.ndarray:
        members = {per: some.groups(per)[1] for per in frame.codes}
        found = replicate(calibration.problem_on(frame), calibration.draws(draws), random, members)
        return found + (some["output"] - frame["output"])

    return _with_past(calibration, calibration.on_clock(readings), made)


def _with_past(
    calibration: Calibration,
    readings: Measurements,
    made: Callable[[Measurements, Frame, np.ndarray], np.ndarray],
) -> Float[np.ndarray, "k n"]:
    """What is made of readings, their frame, and the fitted readings before them that their runs begin with: of those
    that go on with fitted runs behind their past, of others as of new runs."""
    fitted = calibration.readings
    runs = fitted.continued_in(readings)
    if not runs:
        return made(readings, _of_new_groups(calibration.frame_of(readings)), NONE)
    rows = np.sort(np.concatenate([*runs.values()]))
    codes = [fitted.records.names.index(name) for name in runs]
    past = np.flatnonzero(np.isin(fitted.records.codes, codes))
    whole = fitted.select(past).followed_by(readings.select(rows))
    behind = made(whole, calibration.frame_of(whole), past)[:, len(past) :]
    found = np.empty((len(behind), len(readings)))
    found[:, rows] = behind
    if len(others := np.setdiff1d(np.arange(len(readings)), rows)):
        alone = readings.select(others)
        found[:, others] = made(alone, _of_new_groups(calibration.frame_of(alone)), NONE)
    return found


def _of_new_groups(frame: Frame) -> Frame:
    """Every run, cell and device one that the fit has not seen; an axis is part of its instrument."""
    codes = {k: c if k == "axis" else -np.ones_like(c) for k, c in frame.codes.items()}
    return replace(frame, codes=codes)


def _noise_at(
    calibration: Calibration, past: np.ndarray, readings: Measurements
) -> Callable[[Float[np.ndarray, "n b"]], tuple[np.ndarray, np.ndarray]]:
    """What fitted readings `past` say of the correlated noise at others of their runs, at the mode of its parameters.

    Of what a model leaves of the fitted readings (n, b) it is the mean (m, b), which is linear in that, and variance
    (m,).
    """
    fitted, record = calibration.readings.select(past), calibration.problem.record
    law, values = calibration.model.noise, calibration.problem.hyper(calibration.mode.v)
    total = variance(law, values, record)
    white = np.maximum(total - law.slow_variance(values), ROUNDING * total)[past]
    before_them, asked = fitted.records, readings.records
    time, at = fitted["time"], readings["time"]
    before, after = (law.followed(calibration.frame_of(some)) for some in (fitted, readings))

    def noise(left: Float[np.ndarray, "n b"]) -> tuple[np.ndarray, np.ndarray]:
        mean, spread = np.empty((len(at), left.shape[1])), np.empty(len(at))
        for name, others in zip(asked.names, asked.rows, strict=True):
            rows = before_them.rows[before_them.names.index(name)]
            both = None
            if before is not None and after is not None:
                both = np.asarray(before)[rows], np.asarray(after)[others]
            mean[others], spread[others] = law.slow_part(
                values, time[rows], left[rows], white[rows], at[others], both
            )
        return mean, spread

    return noise


# hold-out data --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class HoldoutContradiction:
    """What hold-out data say against a fit."""

    p: float  # probability of coefficients that the data pull as far, if the fit is right
    share: float  # hold-out error over what it would be, did coefficients and deviations suit these data
    scatter: float  # of what neither explains, the rms over its expected one
    most: str  # the coefficient that they pull the farthest, by itself; empty where there is none


@dataclass(frozen=True, eq=False)
class HoldoutTest:
    """A fit's prediction of hold-out data, and what these say against it beside readings replicated as it expects them.

    A replicate has its own draw of the coefficients, deviations of its own for runs that the fit has not seen, and
    noise: whatever makes hold-out errors large by right is in its errors too (posterior predictive p-values: A. Gelman,
    X.-L. Meng and H. Stern, Statistica Sinica 6 (1996) 733).
    """

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
        count = max(100, min(DRAWS, REPLICATED_CELLS // max(len(self.readings), 1)))
        made = replicates(self.calibration, self.readings, count, self.calibration.seed)
        (used, problem), random = self._problem, np.random.default_rng(0)
        # What deviations of groups that the fit holds none of would add.
        for effect, size in self.unseen:
            codes = self.readings.groups(str(effect.coefficients[0].per))[1]
            drawn = size * random.standard_normal((len(made), int(codes.max()) + 2))[:, codes]
            made += _deviating(used, problem, effect) * drawn
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
        names = (t.effect.coefficient_name(t.index) for t in terms)
        return [(n, t.per, c) for n, t, c in zip(names, terms, each, strict=True)]


def _orthonormal(columns: Sequence[np.ndarray], size: int) -> Float[np.ndarray, "n k"]:
    """A basis of what columns span."""
    each = [c / length for c in columns if (length := float(np.linalg.norm(c))) > 0]
    if not each:
        return np.zeros((size, 0))
    return orth(np.array(each).T, rcond=SEEN_SHARE)


def _squares(rows: np.ndarray) -> np.ndarray:
    """Sum of squares of each row."""
    return np.sum(rows**2, axis=-1)


def _share(hits: np.ndarray) -> float:
    """Of replicates, itself among them: no p-value is zero."""
    return float((1 + np.count_nonzero(hits)) / (1 + len(hits)))
