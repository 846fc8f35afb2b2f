"""Compensation: from a reading to the stimulus, by posterior draws or, as in firmware, to first order."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import why_not
from bayescal._calibration.storage import identity
from bayescal._core.atomic_file import write_text
from bayescal._core.errors import InputError
from bayescal._data.column import UNCERTAINTY, Column
from bayescal._data.measurements import Measurements
from bayescal._model.composition import find_response_columns
from bayescal._use.compensation_program import (
    HISTORY_KINDS,
    NOT_RELIABLE,
    CompensationProgram,
    Input,
    OutsideCalibration,
    Provenance,
    build_program,
    gather_inputs,
    list_needed_inputs,
    list_use_claims,
)
from bayescal._use.correction_files import as_text, choose_format
from bayescal._use.operating_equation import (
    OperatingEquation,
    PosteriorMoments,
    equation_in_use,
    solve_over_draws,
)

Method = Literal["draws", "first order"]


@dataclass(frozen=True)
class Compensated:
    """Compensated readings: the result of calling a `Compensator`.

    Attributes:
        value: the stimulus, (n,); NaN where the equation has no solution.
        uncertainty: standard uncertainty of `value`, (n,).
        unit: unit of both.
        outside: mask (n,) of readings outside the calibrated range, by name of the input or stimulus, if there are any.
    """

    value: np.ndarray
    uncertainty: np.ndarray
    unit: str
    outside: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Compensator:
    """A compensator from readings to the stimulus: call it with readings, or export it.

        compensate = bc.compensator(calibration)
        compensated = compensate(readings)                # or compensate(output=1.2, temperature=40.0)
        compensate.export("calibration.h")                # or .json, .py

    Attributes:
        calibration: the calibrated model.
        equation: the model's equation for the instrument in use.
        draws: maximum number of posterior draws to average over.
    """

    calibration: Calibration
    equation: OperatingEquation
    draws: int = 400

    def __call__(
        self,
        readings: Measurements | None = None,
        /,
        *,
        noise: bool = True,
        method: Method = "draws",
        warn: bool = True,
        **columns: ArrayLike,
    ) -> Compensated:
        """Return the stimulus of readings, with its standard uncertainty.

        Args:
            readings: output and needed covariates, with dates on the calibration's clock; or give these as `columns`.
            noise: include each reading's noise in its uncertainty, from the noise model (correlated noise too) and the
                column `output_uncertainty` if there is one; False for the calibration's uncertainty alone.
            method: "draws": solve the equation for every draw; "first order": propagate the covariance, as exports do.
            warn: issue an `OutsideCalibration` warning for values outside their calibrated range.
            **columns: one value per reading or one for all, in fixed units; `time` in s since the epoch, or dates
                (`datetime64`); in its place also `temperature_rate`, `temperature_lag` or `elapsed`.

        Raises:
            InputError: a needed column is missing, or needed dates are only in the readings or only in the calibration.
        """
        epoch = self.about.epoch
        if readings is not None:
            readings = readings.align_clock(epoch, lambda: self.dated)
        inputs, frame = gather_inputs(self.inputs, readings, columns, epoch)
        if method == "first order":
            value, uncertainty, slope = self.in_use.run(inputs["output"], inputs)
            variance, square_slope = uncertainty**2, slope**2
        else:
            value, variance, square_slope = solve_over_draws(
                self.equation, self._moments.draws, inputs["output"], inputs, frame
            )
        values = {**inputs, self.stimulus: value}
        if noise:
            stated_variance = inputs.get(UNCERTAINTY, np.zeros(1)) ** 2
            noise_variance = self.in_use.noise_variance(value, inputs) + stated_variance
            variance = variance + square_slope * noise_variance
        limits = {n: span for n, span in self._ranges.items() if n in values}
        outside = {n: (values[n] < low) | (values[n] > high) for n, (low, high) in limits.items()}
        outside = {name: mask for name, mask in outside.items() if mask.any()}
        if warn and outside:
            ranges = self.calibrated.items()
            limits = {n: " (calibrated: {:.6g} to {:.6g} {})".format(*span) for n, span in ranges}
            rows = ((n, mask.sum(), limits.get(n, "")) for n, mask in outside.items())
            messages = (f"{n} in {count} of {len(value)} readings{text}" for n, count, text in rows)
            warnings.warn(
                f"outside the calibrated range: {'; '.join(messages)}. The result there is an extrapolation, whose "
                "uncertainty does not include the error of the equation outside that range",
                OutsideCalibration,
                stacklevel=2,
            )
        return Compensated(value, np.sqrt(variance), self.unit, outside)

    @cached_property
    def in_use(self) -> CompensationProgram:
        """Return the program (equation, mean and covariance of θ), without notes and results of acceptance checks."""
        return build_program(self.equation, self._moments)

    @cached_property
    def program(self) -> CompensationProgram:
        """Return the program to export, with notes and the acceptance checks that failed.

        Raises:
            ModelError: an effect cannot be exported.
        """
        reason = self.why_not
        notes = (*self.notes, *[f"{NOT_RELIABLE}{reason}"] * bool(reason))
        changes = {"calibration": identity(self.calibration), "why_not": reason, "notes": notes}
        return replace(self.in_use, about=replace(self.about, **changes)).require_exportable()

    @property
    def about(self) -> Provenance:
        """Return the provenance of the compensator, without notes and acceptance checks."""
        return self.in_use.about

    @property
    def stimulus(self) -> str:
        """Return the name of the stimulus."""
        return self.about.stimulus

    @property
    def unit(self) -> str:
        """Return the fixed unit of the stimulus."""
        return self.about.unit

    @property
    def inputs(self) -> tuple[Input, ...]:
        """Return the covariates that a compensation needs, with their calibrated ranges."""
        return self.in_use.inputs

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the notes on the compensation, one sentence each."""
        return list_use_claims(self.equation, self.in_use.stimulus_range is not None)

    @property
    def why_not(self) -> str:
        """Return why the result must not be used; empty if it may. Runs the residual checks of an unchecked fit."""
        return why_not(self.calibration)

    @property
    def dated(self) -> str:
        """Return the names of effects that depend on the date ("it" for the noise); empty if time is not an input."""
        if all(i.name != "time" for i in self.inputs):
            return ""
        return ", ".join(self.calibration.dated_effects) or "it"

    @property
    def calibrated(self) -> dict[str, tuple[float, float, str]]:
        """Return the calibrated range and unit of each input, and of the stimulus if it was varied."""
        ranges = {i.name: (i.low, i.high, i.unit) for i in self.inputs}
        if (span := self.in_use.stimulus_range) is not None:
            ranges[self.stimulus] = (*span, self.unit)
        return ranges

    @property
    def middle(self) -> dict[str, float]:
        """Return the default operating point: stimulus and inputs by name, in fixed units."""
        low, high = self.in_use.stimulus_range or (0.0, 0.0)
        return {self.stimulus: 0.5 * (low + high), **{i.name: i.middle for i in self.inputs}}

    @property
    def history(self) -> bool:
        """Return whether the compensation of a reading needs earlier readings of its record."""
        return any(i.kind != "column" for i in self.inputs)

    @property
    def columns(self) -> tuple[Column, ...]:
        """Return declarations of the columns that a file to compensate must have."""
        needed = dict.fromkeys(i.column for i in self.inputs)
        if self.history:
            needed["time"] = None
        units = {"time": "s", **{i.column: "degC" for i in self.inputs if i.kind in HISTORY_KINDS}}
        units |= {i.column: i.unit for i in self.inputs if i.kind == "column"}
        declared_columns = self.calibration.model.instrument.columns
        by_name = {c.name: replace(c, required=True) for c in declared_columns}
        return (
            Column("output", self.about.output_unit, "reading"),
            Column("run", None, required=False),
            *(by_name[name] if name in by_name else Column(name, units[name]) for name in needed),
        )

    def export(
        self,
        path: str | Path,
        format: str | None = None,
        *,
        name: str | None = None,
        uncertainty: bool = True,
    ) -> Path:
        """Write the correction as source code or data: .h (C99), .py (Python) or .json.

        Args:
            path: file to write, whose suffix gives the format.
            format: "c", "python" or "json"; overrides the suffix.
            name: name of the sensor, the prefix of all names in the C header; default: the instrument's name.
            uncertainty: False for C and Python that give the value alone, without the covariance of the coefficients.

        Raises:
            ModelError: an effect cannot be exported.
            InputError: another format, an invalid C name, or a file that cannot be written.
        """
        form = choose_format(path, format)
        return write_text(as_text(self.program, form, name=name, uncertainty=uncertainty), path)

    @cached_property
    def _moments(self) -> PosteriorMoments:
        return self.equation.moments(self.draws)

    @cached_property
    def _ranges(self) -> dict[str, tuple[float, float]]:
        """Return limits outside which a reading is flagged, by name of the input or of a stimulus that was varied."""
        ranges = {i.name: (i.low, i.end) for i in self.inputs}
        # Columns without influence on the output have calibrated ranges too.
        for name in self.equation.columns:
            values = self.equation.at_fit[name]
            if name not in ("time", "elapsed") and np.ptp(values) > 0:
                ranges.setdefault(name, (float(values.min()), float(values.max())))
        if span := self.in_use.stimulus_limits:
            ranges[self.stimulus] = span
        return ranges


def compensator(
    calibration: Calibration, *, draws: int = 400, members: Mapping[str, str] | None = None
) -> Compensator:
    """Build the compensator of a calibrated instrument.

    Args:
        calibration: a fit, or an average over structures. Inputs that no probable effect needs are fixed at the middle
            of their calibrated range; `notes` state the rms error due to this.
        draws: maximum number of posterior draws to average over.
        members: group → member in use, such as {"device": "A17"}. The members of all other groups are unseen, with
            deviations drawn from the between-group standard deviation.

    Raises:
        ModelError: the instrument has no stimulus (`Instrument.use`).
        InputError: a group member is not in the calibration, or `draws` is below two.
    """
    if draws < 2:
        raise InputError(f"draws={draws}: an uncertainty needs at least 2")
    unrestricted = Compensator(calibration, equation_in_use(calibration, members), draws)
    model = calibration.model
    response_columns = find_response_columns(model.instrument, calibration.frame)
    needed_columns = calibration.usual_columns.union(model.noise.needs, response_columns)
    if all(needed_columns.issuperset(e.columns) for e in model.effects):
        return unrestricted
    held_inputs = tuple(
        (i.name, float(i.middle), i.unit)
        for i in list_needed_inputs(unrestricted.equation)
        if not needed_columns.issuperset({i.column} if i.kind == "column" else {i.column, "time"})
    )
    return replace(unrestricted, equation=replace(unrestricted.equation, held_inputs=held_inputs))
