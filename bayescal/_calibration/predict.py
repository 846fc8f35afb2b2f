"""Predictions of a calibrated model with their uncertainty; hold-out tests."""

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
from bayescal._model.terms import ColumnSpec

ROUNDING = 1e-12  # share of a variance kept as white noise, if a law has none
DRAWS = 1000  # replicates, fewer of many readings: p-values to a thousandth
REPLICATED_CELLS = 10_000_000  # replicates × readings, held together
TINY_SQUARE = 1e-300  # floor of a sum of squares
NO_PAST = np.zeros(0, dtype=int)  # rows of fitted readings
SEEN_SHARE = 1e-8  # of the longest direction's length, below which a direction is rounding


@dataclass(frozen=True)
class Prediction:
    """Expected output of each reading, and its uncertainty.

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
    is_fitted = readings is None
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
                # Conditional on each draw's residuals: a level shared by noise and a coefficient is uncertain in
                # either, not in their sum. Noise of the past is not used.
                noise_mean = noise((np.asarray(output) - expected[:, :count]).T)[0].T
                return np.concatenate([np.zeros_like(expected[:, :count]), noise_mean], axis=1)

            noise_of = carried
        problem = calibration.problem_on(frame)
        predicted = moments(problem, calibration.draws(draws), noise_of)
        model = calibration.form_factor**2 * predicted.variance + predicted.unknown
        model += _unfound_variance(calibration, problem)
        residual = np.asarray(frame["output"]) - predicted.mean
        return np.stack([residual, np.sqrt(model), np.sqrt(model + predicted.noise + spread)])

    if new_groups and not is_fitted:
        residual, model_sd, sd = _with_past(calibration, readings, moments_of)
    else:
        frame = calibration.frame_of(readings)
        frame = _as_new_groups(frame) if new_groups else frame
        residual, model_sd, sd = moments_of(readings, frame, NO_PAST)
    return Prediction(readings["output"] - residual, model_sd, sd, residual)


def _unfound_variance(calibration: Calibration, problem: Problem) -> np.ndarray:
    """Return the variance of readings of unseen members from deviations that no draw has."""
    named, variances = calibration.model.instrument.known, np.zeros(problem.record.size)
    for name, size in calibration.unfound_spreads.items():
        new = problem.record.codes[str(named[name].coefficients[0].per)] < 0
        if new.any():
            variances += new * (size * _slopes(calibration, problem, named[name])) ** 2
    return variances


def _slopes(calibration: Calibration, problem: Problem, effect: Effect) -> np.ndarray:
    """Return each reading's slope by an effect's deviation, output unit over the coefficient's (n,)."""
    slopes = problem.slopes(calibration.mode.x, problem.hyper(calibration.mode.v))
    c, spec = effect.coefficients[0], ColumnSpec.from_effect(effect)
    factor = factor_of(calibration.model.instrument, effect, c)
    return slopes[c.slot or effect.slot] * factor * problem.record.columns(spec, ())[:, 0]


def replicates(
    calibration: Calibration, readings: Measurements, draws: int, seed: int
) -> Float[np.ndarray, "draws n"]:
    """Simulate readings once from each draw: new runs, cells and devices with deviations of their own, as in `predict`;
    readings that continue a fitted run with its deviation, and correlated noise independent of its past."""
    calibration, random = calibration.with_columns(readings.columns), np.random.default_rng(seed)

    def evaluate(some: Measurements, frame: Frame, _: np.ndarray) -> np.ndarray:
        members = {per: some.groups(per)[1] for per in frame.codes}
        problem, sample = calibration.problem_on(frame), calibration.draws(draws)
        return replicate(problem, sample, random, members) + (some["output"] - frame["output"])

    return _with_past(calibration, calibration.on_clock(readings), evaluate)


def _with_past(
    calibration: Calibration,
    readings: Measurements,
    evaluate: Callable[[Measurements, Frame, np.ndarray], np.ndarray],
) -> Float[np.ndarray, "k n"]:
    """Evaluate a function of readings, their frame and their runs' fitted past: readings that continue fitted runs are
    evaluated behind that past, the others as new runs."""
    fitted = calibration.readings
    runs = fitted.continued_in(readings)
    if not runs:
        return evaluate(readings, _as_new_groups(calibration.frame_of(readings)), NO_PAST)
    rows = np.sort(np.concatenate([*runs.values()]))
    codes = [fitted.records.names.index(name) for name in runs]
    past = np.flatnonzero(np.isin(fitted.records.codes, codes))
    joined = fitted.select(past).followed_by(readings.select(rows))
    continued = evaluate(joined, calibration.frame_of(joined), past)[:, len(past) :]
    columns = np.empty((len(continued), len(readings)))
    columns[:, rows] = continued
    if len(others := np.setdiff1d(np.arange(len(readings)), rows)):
        new = readings.select(others)
        columns[:, others] = evaluate(new, _as_new_groups(calibration.frame_of(new)), NO_PAST)
    return columns


def _as_new_groups(frame: Frame) -> Frame:
    """Mark every run, cell and device as unseen by the fit; an axis is part of its instrument."""
    codes = {k: c if k == "axis" else -np.ones_like(c) for k, c in frame.codes.items()}
    return replace(frame, codes=codes)


def _noise_at(
    calibration: Calibration, past: np.ndarray, readings: Measurements
) -> Callable[[Float[np.ndarray, "n b"]], tuple[np.ndarray, np.ndarray]]:
    """Return the conditional distribution of correlated noise at `readings` given fitted readings `past` of their runs.

    It maps residuals of the past (n, b) to mean (m, b), linear in them, and variance (m,), at the parameters' mode.
    """
    fitted, record = calibration.readings.select(past), calibration.problem.record
    law, values = calibration.model.noise, calibration.problem.hyper(calibration.mode.v)
    total = variance(law, values, record)
    white = np.maximum(total - law.slow_variance(values), ROUNDING * total)[past]
    before_them, new_records = fitted.records, readings.records
    time, at = fitted["time"], readings["time"]
    before, after = (law.followed(calibration.frame_of(some)) for some in (fitted, readings))

    def noise(residuals: Float[np.ndarray, "n b"]) -> tuple[np.ndarray, np.ndarray]:
        mean, spread = np.empty((len(at), residuals.shape[1])), np.empty(len(at))
        for name, others in zip(new_records.names, new_records.rows, strict=True):
            rows = before_them.rows[before_them.names.index(name)]
            both = None
            if before is not None and after is not None:
                both = np.asarray(before)[rows], np.asarray(after)[others]
            mean[others], spread[others] = law.slow_part(
                values, time[rows], residuals[rows], white[rows], at[others], both
            )
        return mean, spread

    return noise


@dataclass(frozen=True)
class HoldoutContradiction:
    """Score test and scatter of a fit on hold-out data."""

    p: float  # p-value of the score test of the coefficients
    share: float  # hold-out error over that with coefficients and deviations refitted
    scatter: float  # rms of the unexplained part over its expectation
    most: str  # the coefficient of largest single score; empty where there is none


@dataclass(frozen=True, eq=False)
class HoldoutTest:
    """A fit's prediction of hold-out data, tested against readings replicated from the fit.

    A replicate has its own draw of the coefficients, deviations of its own for unseen runs, and noise (posterior
    predictive p-values: A. Gelman, X.-L. Meng and H. Stern, Statistica Sinica 6 (1996) 733).
    """

    calibration: Calibration
    readings: Measurements  # the hold-out data
    prediction: Prediction  # of them
    # Group deviations absent from the fit, with their plausible standard deviations: one run does not identify the
    # standard deviation between runs, nor do a few if it is small.
    unseen: tuple[tuple[Effect, float], ...] = ()

    @cached_property
    def against(self) -> HoldoutContradiction:
        """Compute the score test of the fit's coefficients, and the scatter that they do not explain.

        With e the errors over the noise and Q a basis of the coefficients' columns, t = Qᵀe has mean zero and the
        covariance C of the replicates' own Qᵀe; tᵀC⁻¹t is compared with theirs (C. R. Rao, Proc. Camb. Phil. Soc. 44
        (1948) 50).
        """
        errors, expected = self._errors
        # Columns of the coefficients that all readings share, and of the deviations of each group's members.
        columns = self._columns
        shared = [column for _, per, column in columns if per is None]
        groups = [(self.readings.groups(per)[1], column) for _, per, column in columns if per]
        of_groups = [np.where(codes == k, c, 0.0) for codes, c in groups for k in np.unique(codes)]
        basis = _orthonormal(shared, len(errors))
        whole = _orthonormal([*shared, *of_groups], len(errors))
        pulled, by_right = basis.T @ errors, expected @ basis
        covariance = np.atleast_2d(np.cov(by_right.T)) if basis.shape[1] else np.zeros((0, 0))
        inverse = np.linalg.pinv(covariance, rcond=1e-12, hermitian=True)
        far = np.einsum("bi,ij,bj->b", by_right, inverse, by_right)
        p = _p_value(far >= pulled @ inverse @ pulled)
        remainder = max(_squares(errors - whole @ (whole.T @ errors)), TINY_SQUARE)
        usual = np.median(_squares(expected - (expected @ whole) @ whole.T))
        scatter = math.sqrt(remainder / max(float(usual), TINY_SQUARE))
        share = math.sqrt(float(_squares(errors)) / remainder)
        pulls = {
            name: abs(float(column @ errors)) / max(float(np.std(expected @ column)), TINY_SQUARE)
            for name, per, column in columns
            if per is None
        }
        most = max(pulls, key=lambda n: pulls[n], default="")
        return HoldoutContradiction(p, share, scatter, most)

    def worse_than(self, other: HoldoutTest) -> float:
        """Return the p-value of the hold-out errors' preference for another fit, under this one.

        A paired test: with δ = μ₁ − μ₀ the difference of the two predictions, the other's squared errors over the noise
        exceed this one's by δᵀδ + 2δᵀe, of which only δᵀe is random.
        """
        errors, expected = self._errors
        moved = (self.prediction.mean - other.prediction.mean) / self._noise
        return _p_value(expected @ moved <= errors @ moved)

    @cached_property
    def _noise(self) -> Float[np.ndarray, "n"]:
        """Return the standard deviation of the noise, output unit."""
        p = self.prediction
        return np.sqrt(np.maximum(p.sd**2 - p.model_sd**2, 1e-12 * p.sd**2))

    @cached_property
    def _problem(self) -> tuple[Calibration, Problem]:
        """Return the fit, averaged over structures whose columns are there, and its problem on these data."""
        used = self.calibration.with_columns(self.readings.columns)
        return used, used.problem_on(used.frame_of(self.readings))

    @cached_property
    def _errors(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "draws n"]]:
        """Return the errors over the noise, and those of the replicates."""
        count = max(100, min(DRAWS, REPLICATED_CELLS // max(len(self.readings), 1)))
        replicated = replicates(self.calibration, self.readings, count, self.calibration.seed)
        (used, problem), random = self._problem, np.random.default_rng(0)
        # Contributions of group deviations that the fit lacks.
        for effect, size in self.unseen:
            codes = self.readings.groups(str(effect.coefficients[0].per))[1]
            drawn = size * random.standard_normal((len(replicated), int(codes.max()) + 2))[:, codes]
            replicated += _slopes(used, problem, effect) * drawn
        replicated -= replicated.mean(axis=0)
        return self.prediction.residual / self._noise, replicated / self._noise

    @property
    @on_one_thread
    def _columns(self) -> list[tuple[str, str | None, Float[np.ndarray, "n"]]]:
        """Return each coefficient's name, group, and column over the noise, at the draws' mean."""
        used, problem = self._problem
        x, v = used.draws()
        terms = [t for t in problem.terms if t.place == "x"]
        slopes = problem.expected_with_slopes(
            x.mean(axis=0)[None], problem.hyper(v.mean(axis=0)), terms
        )[1]
        rows = (np.broadcast_to(slope, (1, len(self._noise)))[0] / self._noise for slope in slopes)
        names = (t.effect.coefficient_name(t.index) for t in terms)
        return [(n, t.per, c) for n, t, c in zip(names, terms, rows, strict=True)]


def _orthonormal(columns: Sequence[np.ndarray], size: int) -> Float[np.ndarray, "n k"]:
    """Return an orthonormal basis of the columns' span."""
    unit_columns = [c / length for c in columns if (length := float(np.linalg.norm(c))) > 0]
    if not unit_columns:
        return np.zeros((size, 0))
    return orth(np.array(unit_columns).T, rcond=SEEN_SHARE)


def _squares(rows: np.ndarray) -> np.ndarray:
    """Return the sum of squares of each row."""
    return np.sum(rows**2, axis=-1)


def _p_value(hits: np.ndarray) -> float:
    """Return the replicates' p-value, the data counted among them, so that none is zero."""
    return float((1 + np.count_nonzero(hits)) / (1 + len(hits)))
