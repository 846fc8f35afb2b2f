"""Predictions of a calibrated model with their uncertainty; hold-out tests of these predictions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.linalg import orth

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fitted import compute_predictive_moments, replicate
from bayescal._core.parallel import run_on_one_thread
from bayescal._core.renamed import renamed
from bayescal._data.measurements import Measurements
from bayescal._inference.noise_on_record import variance
from bayescal._inference.problem import Problem
from bayescal._model.effect import Effect
from bayescal._model.frame import Frame
from bayescal._model.instrument import compute_factor
from bayescal._model.terms import ColumnSpec

MIN_WHITE_SHARE = 1e-12  # smallest white share of the noise variance
MAX_REPLICATES = 1000  # gives p-values a resolution of 0.001
MAX_REPLICATED_CELLS = 10_000_000  # replicates × readings in memory
MIN_SQUARES = 1e-300  # floor of a sum of squares
NO_PAST_ROWS = np.zeros(0, dtype=int)  # rows of fitted readings that precede a new run: none
RANK_TOLERANCE = 1e-8  # singular values below this share of the largest are rounding


@dataclass(frozen=True)
class Prediction:
    """Expected output of each reading, and its uncertainty.

    Attributes:
        mean: posterior mean of the expected output, output unit, (n,).
        model_sd: standard uncertainty of the expected output. It combines that of the coefficients, multiplied by the
            calibration's `form_factor`, noise on inputs and, for members unseen in the fit, the between-group standard
            deviations of effects in the model and of plausible effects that it lacks (`unfound_spreads`).
        sd: standard uncertainty of a reading, including its noise.
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
    """Predict readings with standard uncertainties.

    Readings that continue a fitted run (same name and clock, times between or right after its readings) are predicted
    conditional on it: lags, hysteresis, the run's deviation and correlated noise continue as if the file were not cut.

    Args:
        calibration: a fit, or an average over structures, of which those that need absent columns are omitted.
        readings: readings to predict; None for the fitted ones. Without a column `run` they are one new run. Dates are
            converted to the calibration's clock.
        new_groups: treat every run, cell or device as unseen by the fit: its deviation has mean zero and the
            between-group standard deviation. False uses the estimated deviations of members with the same name. An
            axis is part of its instrument, and is never treated as new.
        draws: maximum number of posterior draws to average over.

    Raises:
        ModelError: the readings lack a column that an effect needs.
        InputError: only one of readings and calibration has dates, and an effect depends on the date.
    """
    is_fitted = readings is None
    readings = calibration.readings if readings is None else readings
    if calibration.readings.has("run") and not readings.has("run") and new_groups:
        readings = readings.with_column("run", np.full(len(readings), "new"))
    calibration = calibration.with_columns(readings.columns)
    calibration.model.require(readings)
    readings = calibration.on_clock(readings)

    def predict_frame(part: Measurements, frame: Frame, past_rows: np.ndarray) -> np.ndarray:
        """Return rows (3, n), output unit: residual, standard uncertainty of the expected output, and of a reading."""
        problem, noise = calibration.problem_on(frame), None
        if len(past_rows) and not calibration.model.noise.independent:
            noise = _condition_noise(calibration, part, frame, past_rows)
        moments = compute_predictive_moments(problem, calibration.draws(draws), noise)
        model_var = calibration.form_factor**2 * moments.variance + moments.unknown
        model_var += _compute_unseen_member_variance(calibration, problem)
        residual = np.asarray(frame["output"]) - moments.mean
        return np.stack([residual, np.sqrt(model_var), np.sqrt(model_var + moments.noise)])

    if new_groups and not is_fitted:
        residual, model_sd, sd = _evaluate_with_past(calibration, readings, predict_frame)
    else:
        frame = calibration.frame_of(readings)
        frame = _mark_as_new(frame) if new_groups else frame
        residual, model_sd, sd = predict_frame(readings, frame, NO_PAST_ROWS)
    return Prediction(readings["output"] - residual, model_sd, sd, residual)


def _compute_unseen_member_variance(calibration: Calibration, problem: Problem) -> np.ndarray:
    """Return the variance (n,) of unseen members' readings due to plausible group deviations not in the model."""
    known_effects, variances = calibration.model.instrument.known, np.zeros(problem.record.size)
    for name, sd in calibration.unfound_spreads.items():
        new = problem.record.codes[str(known_effects[name].coefficients[0].per)] < 0
        if new.any():
            variances += new * (sd * _sensitivities(calibration, problem, known_effects[name])) ** 2
    return variances


def _sensitivities(calibration: Calibration, problem: Problem, effect: Effect) -> np.ndarray:
    """Return ∂output/∂coefficient of a group deviation (n,), output unit per unit of the coefficient."""
    gradients = problem.slopes(calibration.mode.x, problem.hyper(calibration.mode.v))
    c, spec = effect.coefficients[0], ColumnSpec.from_effect(effect)
    factor = compute_factor(calibration.model.instrument, effect, c)
    return gradients[c.slot or effect.slot] * factor * problem.record.columns(spec, ())[:, 0]


def _evaluate_with_past(
    calibration: Calibration,
    readings: Measurements,
    evaluate: Callable[[Measurements, Frame, np.ndarray], np.ndarray],
) -> Float[np.ndarray, "k n"]:
    """Evaluate a function at new readings, with the fitted readings that precede them; return its values (k, n).

    Readings that continue a fitted run are appended to it; others start new runs. `evaluate` takes readings, their
    frame, and the row numbers of the fitted readings among them.
    """
    fit_readings = calibration.readings
    runs = fit_readings.find_continuations(readings)
    if not runs:
        return evaluate(readings, _mark_as_new(calibration.frame_of(readings)), NO_PAST_ROWS)
    rows = np.sort(np.concatenate([*runs.values()]))
    codes = [fit_readings.records.names.index(name) for name in runs]
    past_rows = np.flatnonzero(np.isin(fit_readings.records.codes, codes))
    record = fit_readings.select(past_rows).concatenate(readings.select(rows))
    run_values = evaluate(record, calibration.frame_of(record), past_rows)[:, len(past_rows) :]
    columns = np.empty((len(run_values), len(readings)))
    columns[:, rows] = run_values
    if len(new_rows := np.setdiff1d(np.arange(len(readings)), rows)):
        new = readings.select(new_rows)
        columns[:, new_rows] = evaluate(new, _mark_as_new(calibration.frame_of(new)), NO_PAST_ROWS)
    return columns


def _mark_as_new(frame: Frame) -> Frame:
    """Mark every run, cell and device as unseen by the fit (code −1); an axis is part of its instrument."""
    codes = {k: c if k == "axis" else -np.ones_like(c) for k, c in frame.codes.items()}
    return replace(frame, codes=codes)


def _condition_noise(
    calibration: Calibration, record: Measurements, frame: Frame, past: np.ndarray
) -> Callable[[Float[np.ndarray, "b n"]], tuple[np.ndarray, np.ndarray]]:
    """Return the distribution of correlated noise in a record given its first readings, the fitted ones in rows `past`.

    The returned function maps residuals (b, n) to conditional mean (b, n) and variance (n,), at the mode; 0 in `past`.
    """
    fit_record, count = calibration.problem.record, len(past)
    model, parameters = calibration.model.noise, calibration.problem.hyper(calibration.mode.v)
    total = variance(model, parameters, fit_record)
    white = np.maximum(total - model.slow_variance(parameters), MIN_WHITE_SHARE * total)[past]
    x, time = model.covariate(frame), record["time"]

    def conditional_moments(residuals: Float[np.ndarray, "b n"]) -> tuple[np.ndarray, np.ndarray]:
        mean, variances = np.zeros_like(residuals), np.zeros(len(record))
        for rows in record.records.rows:
            old, new_rows = rows[rows < count], rows[rows >= count]
            covariates = None if x is None else (np.asarray(x)[old], np.asarray(x)[new_rows])
            mean_new, variances[new_rows] = model.slow_part(
                parameters, time[old], residuals[:, old].T, white[old], time[new_rows], covariates
            )
            mean[:, new_rows] = mean_new.T
        return mean, variances

    return conditional_moments


@renamed(share="ratio", most="coefficient")
@dataclass(frozen=True)
class HoldoutContradiction:
    """Score test and scatter of a fit on hold-out data."""

    p: float  # p-value of the score test of the coefficients
    ratio: float  # hold-out rms error over that after fitting coefficients and deviations to the hold-out data
    scatter: float  # rms error after that fit over its expectation
    coefficient: str  # the coefficient with the largest single score; empty if there is none


@renamed(against="contradiction", worse_than="paired_test", unseen="deviations")
@dataclass(frozen=True, eq=False)
class HoldoutTest:
    """A fit's prediction of hold-out data, tested against readings replicated from the fit.

    A replicate is simulated from one posterior draw of the coefficients, with random deviations of unseen runs and
    random noise (posterior predictive p-values: A. Gelman, X.-L. Meng and H. Stern, Statistica Sinica 6 (1996) 733).
    """

    calibration: Calibration
    readings: Measurements  # the hold-out data
    prediction: Prediction  # of the hold-out data
    # Group deviations absent from the fit, with plausible sd: few runs do not identify a small between-run sd.
    deviations: tuple[tuple[Effect, float], ...] = ()

    @cached_property
    def contradiction(self) -> HoldoutContradiction:
        """Compute the score test of the fit's coefficients, and the residual scatter after their adjustment.

        With e the errors in units of the noise sd and Q an orthonormal basis of the coefficients' columns, t = Qᵀe has
        mean zero and a covariance C that is estimated from the replicates; tᵀC⁻¹t is compared with its values in the
        replicates (C. R. Rao, Proc. Camb. Phil. Soc. 44 (1948) 50).
        """
        errors, expected = self._errors
        # Columns of coefficients common to all readings, and of the deviations of each group's members.
        columns = self._columns
        common_columns = [column for _, per, column in columns if per is None]
        groups = [(self.readings.groups(per)[1], column) for _, per, column in columns if per]
        members = [np.where(codes == k, c, 0.0) for codes, c in groups for k in np.unique(codes)]
        basis = _orthonormal_basis(common_columns, len(errors))
        full_basis = _orthonormal_basis([*common_columns, *members], len(errors))
        score, simulated = basis.T @ errors, expected @ basis
        covariance = np.atleast_2d(np.cov(simulated.T)) if basis.shape[1] else np.zeros((0, 0))
        precision = np.linalg.pinv(covariance, rcond=1e-12, hermitian=True)
        statistics = np.einsum("bi,ij,bj->b", simulated, precision, simulated)
        p = _compute_p_value(statistics >= score @ precision @ score)
        remainder = max(_sum_squares(errors - full_basis @ (full_basis.T @ errors)), MIN_SQUARES)
        median_square = np.median(_sum_squares(expected - (expected @ full_basis) @ full_basis.T))
        scatter = math.sqrt(remainder / max(float(median_square), MIN_SQUARES))
        ratio = math.sqrt(float(_sum_squares(errors)) / remainder)
        scores = {
            name: abs(float(column @ errors)) / max(float(np.std(expected @ column)), MIN_SQUARES)
            for name, per, column in columns
            if per is None
        }
        coefficient = max(scores, key=lambda n: scores[n], default="")
        return HoldoutContradiction(p, ratio, scatter, coefficient)

    def paired_test(self, other: HoldoutTest) -> float:
        """Return the p-value, under this fit, of a paired test of its hold-out errors against those of `other`.

        With δ = (μ₁ − μ₀)/σ the difference of the predictions in units of the noise sd, the other's sum of squared
        errors exceeds this one's by δᵀδ + 2δᵀe, of which only δᵀe is random.
        """
        errors, expected = self._errors
        difference = (self.prediction.mean - other.prediction.mean) / self._sd
        return _compute_p_value(expected @ difference <= errors @ difference)

    @cached_property
    def _sd(self) -> Float[np.ndarray, "n"]:
        """Return the standard deviation of the noise, output unit."""
        p = self.prediction
        return np.sqrt(np.maximum(p.sd**2 - p.model_sd**2, 1e-12 * p.sd**2))

    @cached_property
    def _problem(self) -> tuple[Calibration, Problem]:
        """Return the fit, averaged over structures that need no absent column, and its problem on the data."""
        average = self.calibration.with_columns(self.readings.columns)
        return average, average.problem_on(average.frame_of(self.readings))

    @cached_property
    def _errors(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "draws n"]]:
        """Return the prediction errors, and those of the replicates about their mean, in units of the noise sd.

        Replicates of readings that continue a fitted run include its estimated deviation; deviations of new groups are
        drawn from their prior. Correlated noise is independent of the fitted readings.
        """
        (average, problem), seed = self._problem, self.calibration.seed
        rng, member_rng = np.random.default_rng(seed), np.random.default_rng(0)
        count = max(100, min(MAX_REPLICATES, MAX_REPLICATED_CELLS // max(len(self.readings), 1)))
        draws = average.draws(count)

        def evaluate(part: Measurements, frame: Frame, _: np.ndarray) -> np.ndarray:
            members = {per: part.groups(per)[1] for per in frame.codes}
            outputs = replicate(average.problem_on(frame), draws, rng, members)
            return outputs + (part["output"] - frame["output"])

        outputs = _evaluate_with_past(average, average.on_clock(self.readings), evaluate)
        # Contributions of group deviations that the fit lacks.
        for effect, sd in self.deviations:
            codes = self.readings.groups(str(effect.coefficients[0].per))[1]
            deviates = member_rng.standard_normal((len(outputs), int(codes.max()) + 2))[:, codes]
            outputs += _sensitivities(average, problem, effect) * (sd * deviates)
        outputs -= outputs.mean(axis=0)
        return self.prediction.residual / self._sd, outputs / self._sd

    @property
    @run_on_one_thread
    def _columns(self) -> list[tuple[str, str | None, Float[np.ndarray, "n"]]]:
        """Return each coefficient's name, group, and Jacobian column (n,) at the posterior mean, in noise sd."""
        average, problem = self._problem
        x, v = average.draws()
        terms = [t for t in problem.terms if t.place == "x"]
        gradients = problem.expected_with_slopes(
            x.mean(axis=0)[None], problem.hyper(v.mean(axis=0)), terms
        )[1]
        columns = (np.broadcast_to(g, (1, len(self._sd)))[0] / self._sd for g in gradients)
        names = (t.effect.coefficient_name(t.index) for t in terms)
        return [(n, t.per, c) for n, t, c in zip(names, terms, columns, strict=True)]


def _orthonormal_basis(columns: Sequence[np.ndarray], size: int) -> Float[np.ndarray, "n k"]:
    """Return an orthonormal basis (size, k) of the columns' span."""
    unit_columns = [c / length for c in columns if (length := float(np.linalg.norm(c))) > 0]
    if not unit_columns:
        return np.zeros((size, 0))
    return orth(np.array(unit_columns).T, rcond=RANK_TOLERANCE)


def _sum_squares(rows: np.ndarray) -> np.ndarray:
    """Return the sum of squares of each row."""
    return np.sum(rows**2, axis=-1)


def _compute_p_value(is_as_extreme: np.ndarray) -> float:
    """Return the Monte Carlo p-value (1 + exceedances)/(1 + replicates), which is never zero."""
    return float((1 + np.count_nonzero(is_as_extreme)) / (1 + len(is_as_extreme)))
