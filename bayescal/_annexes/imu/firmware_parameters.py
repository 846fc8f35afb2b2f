"""Calibrations, one for each axis, as an autopilot's thermal parameters: cubics, and what these leave out.

The posterior mean of the reading at rest, b(T, rate, lag, …), is projected by least squares, over the readings of the
calibration, on a cubic p(T) (`autopilot.py`). Where b is a cubic of the temperature alone, p is b to rounding; else
b − p is the cost of firmware that knows no more than the temperature.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.imu.autopilot import (
    AUTOPILOTS,
    AXES,
    AtRest,
    Autopilot,
    Axis,
    ThermalPolynomial,
    Values,
    project,
)


def at_rest(
    chosen: bc.Compensator, unit: str, name: str, local_gravity: float = ws.STANDARD_GRAVITY
) -> AtRest:
    """What a calibrated instrument reads at rest, over the readings of its calibration.

    Args:
        chosen: the instrument in use.
        unit: wanted, "rad/s" or "m/s^2".
        name: of the axis, for messages.
        local_gravity: m/s², that the calibration's local g stands for.

    Raises:
        InputError: the output is no such quantity, or the calibration has no temperature.
        ModelError: an effect cannot be evaluated outside Python.
    """
    if chosen.calibration is None or chosen.equation is None:
        raise bc.InputError(
            f"{name}: an export has no readings to project on a polynomial: give the saved calibration (.nc)"
        )
    calibration = chosen.calibration
    inputs = ws.inputs_at_fit(calibration, chosen.equation)
    if "temperature" not in inputs:
        raise bc.InputError(
            f"{name}: the calibration has no column 'temperature', over which firmware corrects: calibrate "
            "with one"
        )
    program, rest = chosen.program, np.zeros(len(calibration.readings))
    (expected,) = program.graph.evaluate(
        (program.equation.expected,), {**inputs, ws.STIMULUS: rest}
    )
    expected = np.broadcast_to(expected, rest.shape)
    _, own, slope = program.run(expected, inputs)
    own = own / np.where(slope > 0, slope, 1.0)  # of the reading, not of the stimulus
    scale = np.zeros(1)
    if chosen.equation.slope_calibrated:
        like = {"local_gravity": local_gravity, "difference": True}
        scale = 1 / slope / float(ws.convert(1.0, chosen.unit, calibration.unit, **like)) - 1

    def converted(values: np.ndarray) -> np.ndarray:
        try:
            return ws.convert(values, calibration.unit, unit, local_gravity=local_gravity)
        except bc.InputError:
            raise bc.InputError(
                f"{name}: the calibration's output is in {ws.unit_label(calibration.unit)}, firmware's "
                f"parameter for {name} is in {ws.unit_label(unit)}: give the calibration of such a sensor"
            ) from None

    def rms(variances: np.ndarray) -> float:
        return float(converted(np.sqrt(np.mean(variances, keepdims=True)))[0])

    return AtRest(
        temperature=np.asarray(inputs["temperature"], float),
        offset=converted(expected),
        unit=unit,
        noise=rms(chosen.noise_variance({**inputs, chosen.stimulus: rest})),
        uncertainty=rms(own**2),
        scale=(float(scale.min()), float(scale.max())),
    )


_NAME = re.compile(r"(gyro|acc)_([xyz])(?:_(\d))?")
_SENSOR = re.compile(r"(gyro|acc)(?:_(\d))?")


@dataclass(frozen=True)
class FirmwareParameters:
    """Thermal parameters of an autopilot.

    Attributes:
        format: "px4-params" or "ardupilot-params".
        values: parameter → value, as it is loaded.
        axes: "gyro_x" and its like → the polynomial behind its parameters.
        sources: axis → identity of the calibration.
        notes: what to know, each a sentence.
    """

    format: str
    values: Values
    axes: dict[str, ThermalPolynomial]
    sources: dict[str, str]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        return "\n".join(self._said(str))

    def _said(self, spelled: Callable[[str], str]) -> list[str]:
        """Lines of the table and the notes; `spelled` is done to each cell before columns are laid out."""
        head = ["axis", "unit", "from °C", "to °C", "u(calibration)", "noise"]
        head += ["not in the cubic, rms", "largest", "error to expect, rms"]
        rows = [
            [
                *(name, ws.unit_label(p.unit), f"{p.low:.1f}", f"{p.high:.1f}"),
                *map(ws.number, (p.of.uncertainty, p.of.noise)),
                *(ws.number(v if v > 1e-3 * p.of.noise else 0.0) for v in (p.rms, p.largest)),
                ws.number(p.expected_error),
            ]
            for name, p in self.axes.items()
        ]
        laid_out = ws.plain_table([*map(spelled, head)], [[*map(spelled, row)] for row in rows])
        return [*str(laid_out).splitlines(), *map(spelled, self.notes)]

    def text(self) -> str:
        """The parameter file, ASCII."""
        autopilot = AUTOPILOTS[self.format]
        said = [
            f"Thermal parameters of {autopilot.title}, made by bayescal {bc.__version__}",
            *(f"{name}: calibration {identity}" for name, identity in self.sources.items()),
            *(
                line.replace("─", "-")
                for line in self._said(lambda t: ws.ascii_text(ws.one_line(t)))
            ),
        ]
        return autopilot.text(said, self.values)

    def write(self, path: str | Path) -> Path:
        """Write the parameter file, beside and then renamed.

        Raises:
            InputError: a place that cannot be written to.
        """
        return ws.write_text(self.text(), path)


def firmware_parameters(
    calibrations: Mapping[str, bc.Calibration | bc.Compensator],
    format: str,
    *,
    devices: Mapping[str, int] | None = None,
    local_gravity: float = ws.STANDARD_GRAVITY,
) -> FirmwareParameters:
    """The thermal parameters of PX4 or ArduPilot that calibrations at rest come to.

    A model that is no cubic of the temperature is projected on one, by least squares over the readings of
    its calibration; what that leaves out stands in the result and in its file. Formulas and their sources
    stand at the top of this file.

    Args:
        calibrations: axis → its calibration: "gyro_x", "acc_z", and "gyro_x_1" of a second sensor. Axes
            of a sensor that are not given have no correction.
        format: "px4-params" or "ardupilot-params".
        devices: device_id of each sensor ("gyro", "acc_1"), for PX4; that of a PX4 log is known.
        local_gravity: m/s², that was taken where the readings were read.

    Raises:
        InputError: no such format, axis or sensor; a calibration of another quantity or of several
            devices; no temperature that all axes of a sensor were calibrated at; for PX4, no device_id.
        ModelError: an effect that cannot be evaluated outside Python.
    """
    if format not in AUTOPILOTS:
        raise bc.InputError(f"format {format!r} is not one of {', '.join(AUTOPILOTS)}")
    autopilot = AUTOPILOTS[format]
    if not calibrations:
        raise bc.InputError(f"{autopilot.title}: give at least one calibration")
    chosen = {
        _axis(name, autopilot): c if isinstance(c, bc.Compensator) else bc.compensator(c)
        for name, c in calibrations.items()
    }
    rest = {a: at_rest(c, a.unit, str(a), local_gravity) for a, c in sorted(chosen.items())}
    found: dict[Axis, ThermalPolynomial] = {}
    for key in dict.fromkeys(map(autopilot.together, rest)):
        own = {a: r for a, r in rest.items() if autopilot.together(a) == key}
        low, high = _range(own)
        reference = float(autopilot.reference(low, high))
        found |= {a: project(r, reference, low, high) for a, r in own.items()}
    values = autopilot.values(found, _devices(chosen, devices or {}))
    sources = {
        str(a): ws.identity(c.calibration) for a, c in sorted(chosen.items()) if c.calibration
    }
    axes = {str(a): p for a, p in found.items()}
    return FirmwareParameters(
        format, values, axes, sources, tuple(_notes(found, chosen, autopilot))
    )


def axis_of(calibration: bc.Calibration) -> str | None:
    """The axis that a calibration is of, by the label `axis` of its readings or the column read; None if by neither."""
    readings = calibration.readings
    labels = readings.groups("axis")[0] if readings.has("axis") else ()
    named = set(labels) or {source.output for source in readings.sources}
    name = next(iter(named), "")
    return name if len(named) == 1 and _NAME.fullmatch(name) else None


def _axis(name: str, autopilot: Autopilot) -> Axis:
    match = _NAME.fullmatch(name)
    if match is None or int(match[3] or 0) >= autopilot.sensors:
        raise bc.InputError(
            f"{name!r} is no axis of {autopilot.title}: gyro_x, gyro_y, gyro_z, acc_x, acc_y, acc_z, and "
            f"gyro_x_1 … gyro_x_{autopilot.sensors - 1} of further sensors"
        )
    return Axis(match[1], match[2], int(match[3] or 0))


def _range(own: Mapping[Axis, AtRest]) -> tuple[float, float]:
    """The temperatures that all axes of a sensor were calibrated at."""
    low, high = max(r.low for r in own.values()), min(r.high for r in own.values())
    if not low < high:
        ranges = ", ".join(f"{a} {r.low:.4g} to {r.high:.4g} °C" for a, r in own.items())
        raise bc.InputError(
            f"one range of temperatures holds for these axes, and they share none: {ranges}. Calibrate them "
            "over one range, or leave one out"
        )
    return low, high


def _devices(
    chosen: Mapping[Axis, bc.Compensator], said: Mapping[str, int]
) -> dict[tuple[str, int], int]:
    """device_id of each sensor: what is said, else what its log named."""
    found: dict[tuple[str, int], int] = {}
    for a, c in chosen.items():
        readings = c.calibration.readings if c.calibration else None
        named = readings.groups("device")[0] if readings and readings.has("device") else ()
        if len(named) > 1:
            raise bc.InputError(
                f"{a}: the calibration is of several devices ({', '.join(named)}), firmware's parameters of one"
            )
        if named and named[0].isdecimal():
            device = int(named[0])
            if found.setdefault((a.kind, a.sensor), device) != device:
                raise bc.InputError(
                    f"{a} is of the device {device}, another axis of its sensor of "
                    f"{found[a.kind, a.sensor]}: give calibrations of one sensor"
                )
    for name, device in said.items():
        match = _SENSOR.fullmatch(name)
        key = (match[1], int(match[2] or 0)) if match else ("", 0)
        if not any((a.kind, a.sensor) == key for a in chosen):
            sensors = dict.fromkeys(f"{a.kind}{f'_{a.sensor}' if a.sensor else ''}" for a in chosen)
            raise bc.InputError(
                f"device {name!r} is none of the sensors given: {', '.join(sensors)}"
            )
        found[key] = device
    return found


def _notes(
    found: Mapping[Axis, ThermalPolynomial],
    chosen: Mapping[Axis, bc.Compensator],
    autopilot: Autopilot,
) -> list[str]:
    sensors = dict.fromkeys((a.kind, a.sensor) for a in found)
    every = [Axis(kind, x, sensor) for kind, sensor in sensors for x in AXES]
    missing = ", ".join(str(a) for a in every if a not in found)
    notes = [f"Not calibrated, and written without a correction: {missing}."] * bool(missing)
    for a, p in found.items():
        narrower = p.low - p.of.low > 1e-3 or p.of.high - p.high > 1e-3
        if narrower:
            notes.append(
                f"{a} was calibrated from {p.of.low:.1f} to {p.of.high:.1f} °C, its sensor from {p.low:.1f} to "
                f"{p.high:.1f} °C."
            )
        if any(p.of.scale):
            by = " to ".join(dict.fromkeys(f"{ws.number(100 * one)} %" for one in p.of.scale))
            notes.append(
                f"{a}: the scale factor differs from nominal by {by}, has no place here, and is left out."
            )
        if why_not := chosen[a].why_not:
            notes.append(f"{a}: {ws.NOT_RELIABLE}{why_not}")
    return [
        *notes,
        "Beyond these temperatures the correction stays as at their ends.",
        autopilot.afterwards,
    ]
