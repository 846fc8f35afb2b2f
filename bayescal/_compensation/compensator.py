"""Compensation: from a reading and its covariates back to the stimulus, with standard uncertainty.

From posterior draws, or by first-order propagation of mean and covariance (what firmware does).
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from bayescal._calibration.calibration import Calibration
from bayescal._compensation import inversion, operating_equation
from bayescal._compensation.firmware import Input, Program, from_data, program_of
from bayescal._compensation.provenance import about_of, input_of
from bayescal._core.errors import InputError
from bayescal._model.frame import Frame, build_frame
from bayescal._readings.column import ROW, Column
from bayescal._readings.measurements import Measurements

UNCERTAINTY = "output_uncertainty"
LARGEST = 50_000_000  # bytes of an exported compensator that is read back
Method = Literal["draws", "first order"]


class OutsideCalibration(UserWarning):
    """A reading was compensated outside the range in which the instrument was calibrated."""


@dataclass(frozen=True)
class Compensated:
    """Compensated readings.

    Attributes:
        value: the stimulus, (n,); NaN where the equation has no solution.
        uncertainty: its standard uncertainty, (n,).
        unit: of both.
        outside: name → where that covariate (or the stimulus) is outside its calibrated range, (n,); only those
            that are outside somewhere.
    """

    value: np.ndarray
    uncertainty: np.ndarray
    unit: str
    outside: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Compensator:
    """Turns readings back into the stimulus: call it with readings, or export it.

        compensate = bc.compensator(calibration)
        found = compensate(readings)                      # or compensate(output=1.2, temperature=40.0)
        compensate.export("calibration.h")                # or .json, .py

    Attributes:
        calibration: that it is of; None for one loaded from an export, which knows mean and covariance only.
        equation: of the calibrated instrument in use; None for a loaded one.
        draws: posterior draws to average over, at most.
        loaded: the program of a loaded one.
    """

    calibration: Calibration | None
    equation: operating_equation.InUse | None = None
    draws: int = 400
    loaded: Program | None = None

    def __call__(
        self,
        readings: Measurements | None = None,
        /,
        *,
        noise: bool = True,
        method: Method | None = None,
        warn: bool = True,
        **columns: ArrayLike,
    ) -> Compensated:
        """Compensate readings.

        Args:
            readings: with the output and the covariates needed; or give these as `columns`.
            noise: count the noise of each reading in its uncertainty, by the noise law (its correlated part too)
                and by the column `output_uncertainty` where there is one; False leaves what the calibration itself
                is uncertain by.
            method: "draws" solves the equation for every posterior draw; "first order" propagates mean and
                covariance, as exports do. Default: draws where there are any.
            warn: give an `OutsideCalibration` warning for what is outside its calibrated range.
            **columns: one value per reading or one for all, in fixed units. The past of a record can be given too
                (`temperature_rate`, `temperature_lag`, `elapsed`), in place of `time`.

        Raises:
            InputError: a column that is needed is missing, or the method needs draws and there are none.
        """
        method = method or ("draws" if self.calibration is not None else "first order")
        if method == "draws" and self.calibration is None:
            raise InputError(
                "a loaded compensator has no draws: use method='first order', or the calibration itself"
            )
        given, record = self._gathered(readings, columns)
        if self.calibration is None:
            value, own, inclination = self.program.run(given["output"], given)
            variance, inclination = own**2, inclination**2
        else:
            value, variance, inclination = self._solved(given, record, method)
        if noise:
            spread = self.noise**2 + given.get(UNCERTAINTY, np.zeros(1)) ** 2
            variance = variance + inclination * spread
        outside = self._outside(given, value)
        if warn and outside:
            self._warn(outside, len(value))
        return Compensated(value, np.sqrt(variance), self.unit, outside)

    # What it is.

    @property
    def stimulus(self) -> str:
        """Name of what is compensated for."""
        return self.loaded.about.stimulus if self.loaded else self._use.stimulus

    @property
    def unit(self) -> str:
        """Its fixed unit."""
        return self.loaded.about.unit if self.loaded else self._use.unit

    @property
    def output_unit(self) -> str:
        return self.loaded.about.output_unit if self.loaded else self._calibration.unit

    @cached_property
    def noise(self) -> float:
        """Standard deviation of the noise of one reading, output unit."""
        return (
            self.loaded.noise if self.loaded else inversion.noise_variance(self._calibration) ** 0.5
        )

    @cached_property
    def inputs(self) -> tuple[Input, ...]:
        """Covariates that are needed, with their calibrated ranges."""
        if self.loaded:
            return self.loaded.inputs
        columns = self._calibration_inputs
        return tuple(
            input_of(self._calibration, self._equation, name, columns[name])
            for name in self._inverse.inputs
            if name in columns
        )

    @property
    def history(self) -> bool:
        """Whether the past of a record is needed, so that it cannot be taken apart."""
        return any(i.kind in ("rate", "lag", "elapsed") for i in self.inputs)

    @property
    def columns(self) -> tuple[Column, ...]:
        """What a file to compensate must hold, in the form in which an instrument says it."""
        needed = dict.fromkeys(i.column for i in self.inputs)
        if self.history:
            needed["time"] = None
        found = [Column("output", self.output_unit, "reading"), Column("run", None, required=False)]
        if self.loaded:
            units = {i.column: i.unit for i in self.inputs if i.kind == "column"}
            past = {i.column: "degC" for i in self.inputs if i.kind in ("rate", "lag")}
            return (*found, *(Column(n, {"time": "s", **past, **units}[n]) for n in needed))
        own = {c.name: c for c in self._calibration.model.instrument.columns}
        for name in needed:
            unit = self._calibration.readings.unit(name)
            found.append(replace(own[name], required=True) if name in own else Column(name, unit))
        return tuple(found)

    @cached_property
    def program(self) -> Program:
        """Mean, covariance and equation, as exports hold them.

        Raises:
            ModelError: an effect cannot be exported; says which and what to do.
        """
        if self.loaded:
            return self.loaded
        about = about_of(self._calibration, self._equation, self.stimulus_range)
        return program_of(
            self._inverse, self._known, self.inputs, self.stimulus_range, self.noise, about
        )

    def export(self, path: str | Path, format: str | None = None) -> Path:
        """Write for firmware or elsewhere: .h (C99), .py (Python) or .json, by suffix or `format`.

        Raises:
            ModelError: an effect cannot be exported.
            InputError: another format, or a place that cannot be written to.
        """
        return self.program.export(path, format)

    # How it does it.

    @property
    def _calibration(self) -> Calibration:
        assert self.calibration is not None
        return self.calibration

    @property
    def _equation(self) -> operating_equation.InUse:
        assert self.equation is not None
        return self.equation

    @property
    def _use(self):
        return self._equation.use

    @cached_property
    def _inverse(self) -> inversion.Inverse:
        frame = self._calibration.frame
        names = operating_equation.input_names(self._equation, frame)
        return inversion.Inverse(self._equation, frame.reference, tuple(names))

    @cached_property
    def _known(self) -> operating_equation.Known:
        return operating_equation.known(
            self._equation, self._calibration, self.draws, self._calibration.seed
        )

    @cached_property
    def _calibration_inputs(self) -> dict[str, np.ndarray]:
        """All inputs at the readings of the fit, lags at the mean of their time constants."""
        frame = self._calibration.frame
        found = {n: np.asarray(frame.columns[n]) for n in self._equation.known}
        found |= {f"{n}_rate": np.asarray(v) for n, v in frame.rates.items()}
        for lag in self._equation.lags:
            found[lag.name] = np.asarray(frame.lag(jnp.asarray(lag.tau), lag.column))
        return found

    @cached_property
    def stimulus_range(self) -> tuple[float, float] | None:
        """Of the stimulus in the calibration; None where it was not varied, or is no column."""
        if self.loaded:
            return self.loaded.stimulus_range
        readings, name = self._calibration.readings, self._use.stimulus
        if self._use.equation is not None or not readings.has(name):
            return None
        low, high = float(readings[name].min()), float(readings[name].max())
        return (low, high) if high > low else None

    def _gathered(
        self, readings: Measurements | None, columns: Mapping[str, ArrayLike]
    ) -> tuple[dict[str, np.ndarray], Frame | None]:
        """Output, inputs and known uncertainties, (n,) each; and the record, where its past is needed."""
        if readings is not None:
            columns = {n: readings[n] for n in readings.columns if readings.unit(n)} | dict(columns)
        if "output" not in columns:
            raise InputError("the column 'output' is missing: give the readings to compensate")
        arrays = {n: np.atleast_1d(np.asarray(v, dtype=float)) for n, v in columns.items()}
        try:
            shape = np.broadcast_shapes(*(a.shape for a in arrays.values()))
        except ValueError:
            shapes = ", ".join(f"{n} {a.shape}" for n, a in arrays.items())
            raise InputError(
                f"columns must be vectors of one length, these are: {shapes}"
            ) from None
        given = {n: np.broadcast_to(a, shape) for n, a in arrays.items()}
        record = None
        if any(i.name not in given and i.kind != "column" for i in self.inputs):
            record = self._record(readings, given)
            for i in self.inputs:
                if i.name not in given and i.kind != "column":
                    given[i.name] = _from_record(record, i)
        for i in self.inputs:
            if i.name not in given:
                raise InputError(
                    f"the column {i.name!r} [{i.unit}] is missing, which this calibration needs (there are: "
                    f"{', '.join(sorted(arrays))}). Record it, or fit a model without the effects that need it"
                )
        return given, record

    def _record(self, readings: Measurements | None, given: Mapping[str, np.ndarray]) -> Frame:
        needed = [i for i in self.inputs if i.kind != "column" and i.name not in given]
        for name in ("time", *(i.column for i in needed)):
            if name not in given:
                raise InputError(
                    f"the column {name!r} is missing: {needed[0].name!r} follows from the past of a record. "
                    f"Record it, or give {needed[0].name!r} itself"
                )
        if readings is None:
            units = {i.column: "degC" for i in needed if i.kind in ("rate", "lag")} | {"time": "s"}
            data = {n: (ROW, np.array(given[n]), {"units": u}) for n, u in units.items()}
            readings = Measurements(xr.Dataset(data))
        return build_frame(readings, {"run_starts": {}})

    def _solved(
        self, given: dict[str, np.ndarray], record: Frame | None, method: Method
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stimulus, variance from the calibration, and squared slope by the output."""
        known, own = self._known, self._inverse
        lags = [lag.name for lag in self._equation.lags] if record is not None else []
        inputs = {i.name: jnp.asarray(given[i.name]) for i in self.inputs if i.name not in lags}
        for name in own.names:  # of which the equation makes no use
            if name not in inputs and name not in lags:
                inputs[name] = jnp.zeros(len(given["output"]))
        output = jnp.asarray(given["output"])
        start = self._equation, own.reference, own.affine
        if method == "draws":
            found = inversion.over_draws(*start, jnp.asarray(known.draws), output, inputs, record)
        else:
            mean, covariance = jnp.asarray(known.mean), jnp.asarray(known.covariance)
            found = inversion.first_order(*start, mean, covariance, output, inputs, record)
        value, variance, inclination = (np.asarray(f) for f in found)
        return value, variance, inclination

    def _outside(self, given: dict[str, np.ndarray], value: np.ndarray) -> dict[str, np.ndarray]:
        ranges = {i.name: (i.low, i.high) for i in self.inputs}
        if self.calibration is not None:
            for (
                name
            ) in self._equation.known:  # what the equation does not use was held in a range too
                values = self._calibration_inputs[name]
                if name not in ("time", "elapsed") and np.ptp(values) > 0:
                    ranges.setdefault(name, (float(values.min()), float(values.max())))
        values = dict(given)
        if self.stimulus_range:
            low, high = self.stimulus_range
            margin = 0.01 * (high - low)  # a reading at the end of the range scatters about it
            ranges[self.stimulus], values[self.stimulus] = (low - margin, high + margin), value
        found = {
            name: (values[name] < low) | (values[name] > high)
            for name, (low, high) in ranges.items()
            if name in values
        }
        return {name: mask for name, mask in found.items() if mask.any()}

    def _warn(self, outside: Mapping[str, np.ndarray], rows: int) -> None:
        ranges = {i.name: f"{i.low:.6g} to {i.high:.6g} {i.unit}" for i in self.inputs}
        if self.stimulus_range:
            low, high = self.stimulus_range
            ranges[self.stimulus] = f"{low:.6g} to {high:.6g} {self.unit}"
        parts = [
            f"{name} in {int(mask.sum())} of {rows} readings"
            + (f" (calibrated: {ranges[name]})" if name in ranges else "")
            for name, mask in outside.items()
        ]
        warnings.warn(
            f"outside the calibrated range: {'; '.join(parts)}. There the result is an extrapolation, and its "
            "uncertainty does not say by how much the equation itself may fail",
            OutsideCalibration,
            stacklevel=3,
        )


def compensator(
    calibration: Calibration, *, draws: int = 400, members: Mapping[str, str] | None = None
) -> Compensator:
    """The compensator of a calibrated instrument.

    Args:
        calibration: a fit.
        draws: posterior draws to average over, at most.
        members: which member of a group is used, such as {"device": "A17"}; every other run, cell or device counts
            as a new one, whose deviation is drawn from its spread.

    Raises:
        ModelError: the instrument does not say what it measures (`Instrument.use`).
        InputError: a member that the calibration did not see.
    """
    if draws < 2:
        raise InputError(f"draws={draws}: an uncertainty needs at least 2")
    return Compensator(calibration, operating_equation.in_use(calibration, members), draws)


def load_compensator(path: str | Path) -> Compensator:
    """A compensator from a JSON export. Nothing in the file is evaluated as code.

    Raises:
        InputError: there is no such file, it is no compensator, of another version, or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no file {path}: give a compensator exported as JSON")
    if path.stat().st_size > LARGEST:
        raise InputError(
            f"{path.name} is larger than a compensator can be ({LARGEST / 1e6:.0f} MB)"
        )
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path.name} is not JSON ({error}): is it a compensator?") from None
    return Compensator(None, loaded=from_data(data, path.name))


def _from_record(record: Frame, wanted: Input) -> np.ndarray:
    if wanted.kind == "rate":
        return np.asarray(record.rates[wanted.column])
    if wanted.kind == "elapsed":
        return np.asarray(record.elapsed)
    return np.asarray(record.lag(jnp.asarray(wanted.tau), wanted.column))
