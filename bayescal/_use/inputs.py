"""The inputs of a compensation: which there are, how they come from columns or the past of a record, their ranges."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from bayescal._calibration.calibration import Calibration
from bayescal._core.errors import InputError
from bayescal._data.measurements import Measurements, of_columns
from bayescal._data.time_in_runs import RATE_WINDOW, rate_window
from bayescal._model.frame import Frame, build_frame
from bayescal._use.operating_equation import OperatingEquation

PAST = ("rate", "lag", "lag slope")  # kinds of input that follow from a temperature's past
MARGIN = 0.01  # of the range of the stimulus: a reading at its end scatters about it


class OutsideCalibration(UserWarning):
    """A reading was compensated outside the range in which the instrument was calibrated."""


@dataclass(frozen=True)
class Input:
    """A covariate that compensation needs.

    Attributes:
        name, unit, meaning: for people and firmware.
        kind: "column"; or what is made of a record: "rate", "lag", "lag slope" (its change by its time constant,
            which carries the uncertainty of that; 0 leaves it out), "elapsed".
        column: the column that it is, or is made of.
        tau: time constant of a lag, s; of a rate, the time whose slope it is.
        silence: of a lag, the time without a reading beyond which the column counts as having changed at its beginning,
            s; None where it counts as linear always, as exports before 0.3.0 have it.
        low, high: range in the calibration, in `unit`.
    """

    name: str
    unit: str
    meaning: str
    kind: str
    column: str
    low: float
    high: float
    tau: float | None = None
    silence: float | None = None

    @property
    def middle(self) -> float:
        """Where an operating point is, where nothing is said of it: no rate and no lag."""
        return 0.5 * (self.low + self.high) if self.kind in ("column", "elapsed") else 0.0


def input_of(
    calibration: Calibration, equation: OperatingEquation, name: str, values: np.ndarray
) -> Input:
    """One input of the equation, as people and firmware are told of it; `values` are those of the fit."""
    described = partial(Input, name, low=float(values.min()), high=float(values.max()))
    silence = float(calibration.frame.silence)
    for lag in equation.lags:
        of_lag = partial(described, column=lag.column, tau=lag.tau, silence=silence)
        if lag.name == name:
            meaning = (
                f"lag of {lag.column} behind the thermometer, L, 0 at the start; dt after the last "
                f"reading, x = dt/{lag.tau!r} s: L = exp(-x)*L + expm1(-x)/x*(change of {lag.column}), "
                f"or exp(-x)*(L - change) where dt is longer than {silence:g} s"
            )
            return of_lag(unit="delta_degC", meaning=meaning, kind="lag")
        if name == lag.slope:
            meaning = (
                f"change of {lag.name} by its time {lag.tau!r} s, which carries the uncertainty of that (0 leaves it "
                f"out): M, 0 at the start; with L before the reading and x as for {lag.name}, "
                f"M = exp(-x)*(M + x*L/{lag.tau!r}) + (exp(-x) + expm1(-x)/x)*(change of {lag.column})/{lag.tau!r}, "
                f"or exp(-x)*(M + x*(L - change)/{lag.tau!r}) where dt is longer than {silence:g} s"
            )
            return of_lag(unit="delta_degC/s", meaning=meaning, kind="lag slope")
    if name not in equation.known:
        column = name.removesuffix("_rate")
        meaning = (
            f"rate of {column}: least-squares slope over the last {RATE_WINDOW:g} s (or the last two "
            "readings, if these are further apart), 0 at the start"
        )
        steps = np.asarray(calibration.frame.step)
        window = rate_window(steps)
        return described(unit="degC/s", meaning=meaning, kind="rate", column=column, tau=window)
    if name == "elapsed":
        meaning = "time since the start (of the run, of power)"
        return described(unit="s", meaning=meaning, kind="elapsed", column="time")
    own = {c.name: c.meaning for c in calibration.model.instrument.columns}
    meaning = "of the same origin as in the calibration" if name == "time" else own.get(name, "")
    unit = calibration.readings.unit(name) or "1"
    return described(unit=unit, meaning=meaning, kind="column", column=name)


def inputs_at_fit(calibration: Calibration, equation: OperatingEquation) -> dict[str, np.ndarray]:
    """All inputs at the readings of the fit, (n,) each; lags at the mean of their time constants."""
    frame = calibration.frame
    found = {n: np.asarray(frame.columns[n]) for n in equation.known}
    found |= {f"{n}_rate": np.asarray(v) for n, v in frame.rates.items()}
    for lag in equation.lags:
        found[lag.name], slope = _lag_and_slope(frame, lag.tau, lag.column)
        if lag.slope:
            found[lag.slope] = slope
    return found


def _lag_and_slope(frame: Frame, tau: float, column: str) -> tuple[np.ndarray, np.ndarray]:
    """T̃ − T of a record, °C, and its derivative by the time constant, °C/s, (n,) each."""
    at = jnp.asarray(tau), jnp.ones(())
    found, slope = jax.jvp(lambda tau: frame.lag(tau, column), at[:1], at[1:])
    return np.asarray(found), np.asarray(slope)


def gathered(
    inputs: Sequence[Input], readings: Measurements | None, columns: Mapping[str, ArrayLike]
) -> tuple[dict[str, np.ndarray], Frame | None]:
    """Output, inputs and known uncertainties, (n,) each; and the record, where its past is needed.

    Raises:
        InputError: a column that is needed is missing, or columns are of different lengths.
    """
    if readings is not None:
        columns = {n: readings[n] for n in readings.columns if readings.unit(n)} | dict(columns)
    if "output" not in columns:
        raise InputError("the column 'output' is missing: give the readings to compensate")
    given = _of_one_length(columns)
    for i in inputs:  # a lag that is given, and not its slope, is taken as it is
        if i.kind == "lag slope" and i.name.removesuffix("_by_tau") in given:
            given.setdefault(i.name, np.zeros_like(given["output"]))
    record, needed = None, [i for i in inputs if i.kind != "column" and i.name not in given]
    if needed:
        record = _record(needed, readings, given)
        given |= {i.name: _from_record(record, i) for i in needed}
    for i in inputs:
        if i.name not in given:
            raise InputError(
                f"the column {i.name!r} [{i.unit}] is missing, which this calibration needs (there are: "
                f"{', '.join(sorted(columns))}). Record it, or fit a model without the effects that need it"
            )
    return given, record


def _of_one_length(columns: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
    arrays = {n: np.atleast_1d(np.asarray(v, dtype=float)) for n, v in columns.items()}
    try:
        shape = np.broadcast_shapes(*(a.shape for a in arrays.values()))
    except ValueError:
        shapes = ", ".join(f"{n} {a.shape}" for n, a in arrays.items())
        raise InputError(f"columns must be vectors of one length, these are: {shapes}") from None
    return {n: np.broadcast_to(a, shape) for n, a in arrays.items()}


def _record(
    needed: Sequence[Input], readings: Measurements | None, given: Mapping[str, np.ndarray]
) -> Frame:
    """The record that the inputs `needed` follow from."""
    for name in ("time", *(i.column for i in needed)):
        if name not in given:
            raise InputError(
                f"the column {name!r} is missing: {needed[0].name!r} follows from the past of a record. "
                f"Record it, or give {needed[0].name!r} itself"
            )
    if readings is None:
        units = {i.column: "degC" for i in needed if i.kind in PAST} | {"time": "s"}
        readings = of_columns({n: np.array(given[n]) for n in units}, units)
    return build_frame(readings, {"run_starts": {}})


def _from_record(record: Frame, wanted: Input) -> np.ndarray:
    if wanted.kind == "rate":
        return np.asarray(record.rates[wanted.column])
    if wanted.kind == "elapsed":
        return np.asarray(record.elapsed)
    assert wanted.tau is not None
    lag, slope = _lag_and_slope(record, wanted.tau, wanted.column)
    return slope if wanted.kind == "lag slope" else lag


def limits(span: tuple[float, float]) -> tuple[float, float]:
    """Beyond which a compensated value is flagged: the calibrated range of the stimulus and its margin."""
    low, high = span
    return low - MARGIN * (high - low), high + MARGIN * (high - low)


def outside(
    ranges: Mapping[str, tuple[float, float]], values: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Name → where a value is outside its range, (n,); only those that are outside somewhere."""
    found = {
        name: (values[name] < low) | (values[name] > high)
        for name, (low, high) in ranges.items()
        if name in values
    }
    return {name: mask for name, mask in found.items() if mask.any()}


def warn_outside(
    masks: Mapping[str, np.ndarray], calibrated: Mapping[str, tuple[float, float, str]]
) -> None:
    """Warn the caller's caller of readings outside their range.

    Args:
        masks: where they are outside, of `outside`.
        calibrated: lowest and highest value and unit, for those that have a range of their own.
    """
    parts = [
        f"{name} in {int(mask.sum())} of {len(mask)} readings"
        + (_calibrated(*calibrated[name]) if name in calibrated else "")
        for name, mask in masks.items()
    ]
    warnings.warn(
        f"outside the calibrated range: {'; '.join(parts)}. There the result is an extrapolation, and its "
        "uncertainty does not say by how much the equation itself may fail",
        OutsideCalibration,
        stacklevel=3,
    )


def _calibrated(low: float, high: float, unit: str) -> str:
    return f" (calibrated: {low:.6g} to {high:.6g} {unit})"
