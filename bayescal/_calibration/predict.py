"""Expected output of a calibrated model on readings, with its uncertainty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fitted import moments, replicate
from bayescal._data.measurements import Measurements
from bayescal._data.time_in_runs import going_on, run_codes
from bayescal._inference.noise_on_record import variance
from bayescal._model.frame import Frame
from bayescal._model.noise_law import Noise

ROUNDING = 1e-12  # of a variance: what is left of it as white noise, if a law has none


@dataclass(frozen=True)
class Prediction:
    """Expected output per reading.

    Attributes:
        mean: posterior mean of the expected output, output unit, (n,).
        model_sd: standard uncertainty of the expected output, from coefficients and, for groups that the fit
            has not seen, from their spread.
        sd: standard uncertainty of a reading: with noise.
        residual: output − mean.
        correlated_noise: posterior mean of the correlated (Ornstein–Uhlenbeck) noise, for readings between those of the
            fit in the same record; NaN beyond them, None where it was not asked for or the noise is not correlated.
        correlated_noise_sd: its standard deviation.
    """

    mean: np.ndarray
    model_sd: np.ndarray
    sd: np.ndarray
    residual: np.ndarray
    correlated_noise: np.ndarray | None = None
    correlated_noise_sd: np.ndarray | None = None

    @property
    def rmse(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))


def predict(
    calibration: Calibration,
    readings: Measurements | None = None,
    *,
    new_groups: bool = True,
    same_record: bool = False,
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
        same_record: the readings belong to the very record that was fitted, on its clock and with its labels: groups
            are known, and between fitted readings `correlated_noise` is what these say of the correlated noise.
        draws: posterior draws to average over, at most.

    Raises:
        ModelError: the readings lack a column that an effect needs.
        InputError: they have dates and the calibration has none, or the other way round, and an effect changes with
            the date.
    """
    known = readings is None
    readings = calibration.readings if readings is None else readings
    new_groups = new_groups and not same_record
    if calibration.readings.has("run") and not readings.has("run") and new_groups:
        readings = readings.with_column("run", np.full(len(readings), "new"))
    calibration = calibration.with_columns(readings.columns)
    calibration.model.require(readings)
    readings = calibration.on_clock(readings)
    correlated = not calibration.model.noise.independent

    def moments_of(some: Measurements, frame: Frame, on: _GoingOn | None) -> np.ndarray:
        """Return residual, standard uncertainties of the expected output and of a reading (3, n)."""
        noise, spread = None, 0.0
        if on is not None and correlated:
            noise = _CarriedOn.of(calibration, on.past, on.later, beyond=True)
            spread = np.append(np.zeros(len(on.past)), noise.found(np.zeros((len(on.past), 1)))[1])
        found = moments(calibration.problem_on(frame), calibration.draws(draws), noise)
        model = found.variance + found.beside
        residual = np.asarray(frame["output"]) - found.mean
        return np.stack([residual, np.sqrt(model), np.sqrt(model + found.noise + spread)])

    if new_groups and not known:
        residual, model_sd, sd = _with_past(calibration, readings, moments_of)
    else:
        frame = calibration.frame_of(readings)
        frame = _of_new_groups(frame) if new_groups else frame
        residual, model_sd, sd = moments_of(readings, frame, None)
    made = Prediction(readings["output"] - residual, model_sd, sd, residual)
    if not (same_record and correlated):
        return made
    past = np.arange(len(calibration.readings))
    noise = _CarriedOn.of(calibration, past, readings, beyond=False)
    mean, spread = noise.found(predict(calibration, new_groups=False).residual[:, None])
    return replace(made, correlated_noise=mean[:, 0], correlated_noise_sd=np.sqrt(spread))


def replicates(
    calibration: Calibration, readings: Measurements, draws: int, seed: int
) -> Float[np.ndarray, "draws n"]:
    """Readings as a calibration expects them, simulated once from each draw: new runs, cells and devices as `predict`
    has them, with deviations of their own; readings that go on with a fitted run have its deviation, and correlated
    noise that is not told by its past."""
    calibration, random = calibration.with_columns(readings.columns), np.random.default_rng(seed)

    def made(some: Measurements, frame: Frame, _: _GoingOn | None) -> np.ndarray:
        members = {per: some.groups(per)[1] for per in frame.codes}
        found = replicate(calibration.problem_on(frame), calibration.draws(draws), random, members)
        return found + (some["output"] - frame["output"])

    return _with_past(calibration, calibration.on_clock(readings), made)


class _GoingOn(NamedTuple):
    """Readings of which some go on with fitted runs."""

    past: np.ndarray  # which of the fitted readings are of these runs
    later: Measurements  # readings that go on


def _with_past(
    calibration: Calibration,
    readings: Measurements,
    made: Callable[[Measurements, Frame, _GoingOn | None], np.ndarray],
) -> Float[np.ndarray, "k n"]:
    """What is made of readings: of those that go on with fitted runs behind their past, of others as of new runs."""
    fitted = calibration.readings
    runs = going_on(fitted, readings)
    if not runs:
        return made(readings, _of_new_groups(calibration.frame_of(readings)), None)
    rows = np.sort(np.concatenate([*runs.values()]))
    names, codes = run_codes(fitted)
    past = np.flatnonzero(np.isin(codes, [names.index(name) for name in runs]))
    later = readings.select(rows)
    whole = fitted.select(past).followed_by(later)
    behind = made(whole, calibration.frame_of(whole), _GoingOn(past, later))[:, len(past) :]
    found = np.empty((len(behind), len(readings)))
    found[:, rows] = behind
    if len(others := np.setdiff1d(np.arange(len(readings)), rows)):
        alone = readings.select(others)
        found[:, others] = made(alone, _of_new_groups(calibration.frame_of(alone)), None)
    return found


def _of_new_groups(frame: Frame) -> Frame:
    """Every run, cell and device one that the fit has not seen; an axis is part of its instrument."""
    codes = {k: c if k == "axis" else -np.ones_like(c) for k, c in frame.codes.items()}
    return replace(frame, codes=codes)


class _CarriedOn(NamedTuple):
    """What fitted readings say of the correlated noise at others of their runs, at the mode of the law's parameters.

    Its mean is linear in what a model leaves of the fitted readings. Each draw of the coefficients leaves its own, so
    that a level that the noise and a coefficient may both hold is uncertain in either, and not in their sum.
    """

    law: Noise
    values: dict[str, Any]  # its parameters
    # Of each run: which of the fitted readings are its own, their times, the variance of their own noise, of the others
    # which, and their times; and what the law follows, at both.
    parts: list[tuple[Any, ...]]
    output: np.ndarray  # of the fitted readings, counted from the fit's origin (n,)
    count: int  # of the others

    @classmethod
    def of(
        cls, calibration: Calibration, past: np.ndarray, readings: Measurements, beyond: bool
    ) -> _CarriedOn:
        """Of a fit's readings `past`, at others; `beyond`: also before and after a run's fitted readings."""
        fitted, record = calibration.readings.select(past), calibration.problem.record
        law, values = calibration.model.noise, calibration.problem.hyper(calibration.mode.v)
        total = variance(law, values, record)
        white = np.maximum(total - law.slow_variance(values), ROUNDING * total)[past]
        (names, known), (asked, codes) = run_codes(fitted), run_codes(readings)
        time, at, parts = fitted["time"], readings["time"], []
        frames = calibration.frame_of(fitted), calibration.frame_of(readings)
        before, after = (law.followed(frame) for frame in frames)
        for code, name in enumerate(asked):
            if name not in names:
                continue
            rows = np.flatnonzero(known == names.index(name))
            inside = (at >= time[rows].min()) & (at <= time[rows].max())
            others = np.flatnonzero((codes == code) & (beyond | inside))
            both = None
            if before is not None and after is not None:
                both = np.asarray(before)[rows], np.asarray(after)[others]
            parts.append((rows, time[rows], white[rows], others, at[others], both))
        return cls(law, values, parts, np.asarray(frames[0]["output"]), len(readings))

    def found(self, left: Float[np.ndarray, "n b"]) -> tuple[np.ndarray, np.ndarray]:
        """Mean (m, b) and variance (m,), given what is left of the fitted readings; NaN where nothing is said."""
        mean = np.full((self.count, left.shape[1]), np.nan)
        spread = np.full(self.count, np.nan)
        for rows, time, white, others, at, both in self.parts:
            found = self.law.slow_part(self.values, time, left[rows], white, at, both)
            mean[others], spread[others] = found
        return mean, spread

    def __call__(self, expected: Float[np.ndarray, "b n"]) -> Float[np.ndarray, "b n"]:
        """Its mean at all readings, the fitted ones first: zero at these, whose noise is not asked for."""
        known = len(self.output)
        found = np.zeros_like(expected)
        found[:, known:] = self.found((self.output - expected[:, :known]).T)[0].T
        return found
