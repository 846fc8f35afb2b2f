"""Calibrations, one for each axis, as an autopilot's thermal parameters: cubics, and what these leave out.

The posterior mean of the reading at rest, b(T, rate, lag, …), is projected by least squares, over the readings of the
calibration, on a cubic p(T). Where b is a cubic of the temperature alone, p is b to rounding; else b − p is the cost of
firmware that knows no more than the temperature.

PX4 (PX4-Autopilot, src/modules/temperature_compensation/TemperatureCompensation.cpp,
calc_thermal_offsets_3D, and temp_comp_params_gyro_0.yaml and its like): for sensor n of its kind
(TC_Gn_… gyroscope in rad/s, TC_An_… accelerometer in m/s²) and axis a = 0, 1, 2

    corrected = raw − (X0_a + X1_a·d + X2_a·d² + X3_a·d³),   d = clip(T, TMIN, TMAX) − TREF,

applied where TC_Gn_ID is the sensor's device_id and TC_G_ENABLE is 1. An accelerometer's X0 is 0, as in
PX4's own calibration (temperature_calibration/accel.cpp): at rest its constant is not told from gravity.

ArduPilot (ardupilot, libraries/AP_InertialSensor/AP_InertialSensor_tempcal.cpp, polynomial_eval and
correct_sensor): for IMU n = 1, 2, 3, in rad/s and m/s² with coefficients in millionths,

    P(T) = 10⁻⁶·(c1·d + c2·d² + c3·d³),   d = T − 35 °C,
    corrected = raw − P(clip(T, TMIN, TMAX)) + P(clip(T_cal, TMIN, TMAX)),

c1 … c3 being INS_TCALn_GYR1_X … GYR3_X and ACC1_X … ACC3_X, and T_cal the temperature at which its
offsets were calibrated (INS_GYR_CALTEMP, INS_ACC_CALTEMP); the constant is part of these offsets. Range
and reference are shared by gyroscope and accelerometer.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

import bayescal as bc
from bayescal import workshop as ws

ORDER = 3  # of the temperature, the highest that an autopilot takes


@dataclass(frozen=True)
class AtRest:
    """Posterior mean of the readings at rest, at the conditions of a calibration."""

    temperature: np.ndarray  # °C, (n,)
    offset: np.ndarray  # of the reading, in `unit`, (n,)
    unit: str  # "rad/s" or "m/s^2"
    noise: float  # standard deviation of one reading, in `unit`
    uncertainty: float  # root mean square over the readings of the standard uncertainty of `offset`, in `unit`
    has_scale: bool  # whether a scale factor was calibrated, too

    @property
    def low(self) -> float:
        return float(self.temperature.min())

    @property
    def high(self) -> float:
        return float(self.temperature.max())


@dataclass(frozen=True)
class ThermalPolynomial:
    """The offset of one axis as a cubic of the temperature, in single precision as firmware stores it."""

    coefficients: tuple[float, ...]  # c0 … c3, in `unit`/°C^k
    reference: float  # T_ref, °C
    low: float  # low, high: the temperatures between which it holds; firmware stops there, °C
    high: float
    rms: float  # rms, largest: of what it leaves out of the calibration, over its readings in that range, in `unit`
    largest: float
    of: AtRest  # what it was projected from

    @property
    def expected_error(self) -> float:
        """Return the expected rms error of a corrected reading under calibration conditions, in the unit of `of`."""
        return float(np.sqrt(self.of.noise**2 + self.of.uncertainty**2 + self.rms**2))


def project(of: AtRest, reference: float, low: float, high: float) -> ThermalPolynomial:
    """Fit a cubic to the offsets of a calibration between two temperatures, by least squares.

    Args:
        of: the calibration's readings at rest.
        reference: T_ref, °C.
        low, high: °C; readings outside count for nothing.

    Raises:
        InputError: the readings in that range are all at one temperature.
    """
    inside = (of.temperature >= low) & (of.temperature <= high)
    d, offset = of.temperature[inside] - reference, of.offset[inside]
    distinct = len(np.unique(d))
    if distinct < 2:
        raise bc.InputError(
            f"between {low:.4g} and {high:.4g} °C the calibration has fewer than two temperatures, and a polynomial "
            "needs several: calibrate over a range"
        )
    fitted = np.polynomial.Polynomial.fit(d, offset, min(ORDER, distinct - 1)).convert()
    coefficients = np.zeros(ORDER + 1, np.float32)
    coefficients[: len(fitted.coef)] = fitted.coef
    residuals = offset - np.polynomial.Polynomial(coefficients.astype(float))(d)
    rms, largest = float(np.sqrt(np.mean(residuals**2))), float(np.abs(residuals).max())
    return ThermalPolynomial(
        tuple(map(float, coefficients)), reference, low, high, rms, largest, of
    )


AXES = "xyz"
ARDUPILOT_REFERENCE, ARDUPILOT_SCALE = 35.0, 1e6  # TEMP_REFERENCE, °C; SCALE_FACTOR
INTEGER, REAL = 6, 9  # MAV_PARAM_TYPE_INT32, MAV_PARAM_TYPE_REAL32 (MAVLink, common.xml)
_NAME = re.compile(r"(gyro|acc)_([xyz])(?:_(\d))?")


class Axis(NamedTuple):
    """One axis of one sensor: kind "gyro" or "acc", axis "x", "y" or "z", number 0, 1, … of its sensor."""

    kind: str
    axis: str
    number: int

    def __str__(self) -> str:
        return f"{self.kind}_{self.axis}" + f"_{self.number}" * bool(self.number)

    @property
    def sensor(self) -> str:
        """Return the name of its sensor: "gyro", and "gyro_1" of a second one."""
        return self.kind + f"_{self.number}" * bool(self.number)

    @property
    def unit(self) -> str:
        return {"gyro": "rad/s", "acc": "m/s^2"}[self.kind]


Polynomials = Mapping[Axis, ThermalPolynomial]
Values = dict[str, float | int]


class Autopilot(NamedTuple):
    """Parameters of one autopilot firmware: their names, limits and file format."""

    title: str  # of it
    sensors: int  # how many of a kind it has parameters for
    together: Callable[[Axis], tuple]  # what has one range of temperatures: the key of an axis
    reference: Callable[[float, float], float]  # T_ref of a range (low, high), °C
    # the parameters of axes that have one range, with the device_id of each sensor
    values: Callable[[Polynomials, Mapping[str, int]], Values]
    line: Callable[[str, float | int], str]  # of a parameter file
    head: tuple[str, ...]  # its first lines
    afterwards: str  # what to do once it is loaded

    def text(self, comments: Iterable[str], values: Values) -> str:
        """Format a parameter file with comments at its head."""
        lines = [f"# {line}".rstrip() for line in (*comments, *self.head)]
        return "\n".join([*lines, *(self.line(n, v) for n, v in values.items()), ""])


def _px4_values(polynomials: Polynomials, devices: Mapping[str, int]) -> Values:
    (first, polynomial), *_ = polynomials.items()
    letter, called = ("G", "GYRO") if first.kind == "gyro" else ("A", "ACC")
    if first.sensor not in devices:
        raise bc.InputError(
            f"{first}: PX4 corrects a sensor whose device_id it is given, and the calibration does not say it: "
            f"--device-id {first.sensor}=NUMBER (param show CAL_{called}{first.number}_ID on the autopilot)"
        )
    name = f"TC_{letter}{first.number}"
    values: Values = {f"TC_{letter}_ENABLE": 1, f"{name}_ID": devices[first.sensor]}
    values |= {f"{name}_TREF": polynomial.reference}
    values |= {f"{name}_TMIN": polynomial.low, f"{name}_TMAX": polynomial.high}
    by_axis = {a.axis: p.coefficients for a, p in polynomials.items()}
    for order in range(ORDER + 1):
        for place, axis in enumerate(AXES):
            has_value = axis in by_axis and (letter, order) != ("A", 0)
            values[f"{name}_X{order}_{place}"] = by_axis[axis][order] if has_value else 0.0
    return values


def _ardupilot_values(polynomials: Polynomials, devices: Mapping[str, int]) -> Values:
    (first, polynomial), *_ = polynomials.items()
    name = f"INS_TCAL{first.number + 1}"
    values: Values = {f"{name}_ENABLE": 1}
    values |= {f"{name}_TMIN": polynomial.low, f"{name}_TMAX": polynomial.high}
    by_axis = {(a.kind, a.axis): p.coefficients for a, p in polynomials.items()}
    for kind, word in (("acc", "ACC"), ("gyro", "GYR")):
        for order in range(1, ORDER + 1):
            for axis in AXES:
                value = by_axis[kind, axis][order] if (kind, axis) in by_axis else 0.0
                values[f"{name}_{word}{order}_{axis.upper()}"] = ARDUPILOT_SCALE * value
    return values


def _px4_line(name: str, value: float | int) -> str:
    return f"1\t1\t{name}\t{value:.13g}\t{INTEGER if isinstance(value, int) else REAL}"


AUTOPILOTS = {
    "px4-params": Autopilot(
        title="PX4",
        sensors=4,  # GYRO_COUNT_MAX
        together=lambda a: (a.kind, a.number),
        reference=lambda low, high: round(0.5 * (low + high)),
        values=_px4_values,
        line=_px4_line,
        head=("Onboard parameters, for QGroundControl or `param load`", "Vehicle-Id Component-Id Name Value Type"),
        afterwards="Restart, then calibrate gyroscopes and accelerometers again: CAL_GYRO*_*OFF and CAL_ACC*_*OFF "
        "come on top of this.",
    ),
    "ardupilot-params": Autopilot(
        title="ArduPilot",
        sensors=3,  # INS_TCAL1 … INS_TCAL3
        together=lambda a: (a.number,),
        reference=lambda low, high: ARDUPILOT_REFERENCE,
        values=_ardupilot_values,
        line=lambda name, value: f"{name},{value:.13g}",
        head=("Parameters, for Mission Planner, MAVProxy or QGroundControl",),
        afterwards="Restart, then calibrate gyroscopes and accelerometers again: their offsets hold for the "
        "temperature INS_GYR*_CALTEMP and INS_ACC*_CALTEMP at which they were found.",
    ),
}  # fmt: skip


def read_at_rest(chosen: bc.Compensator, axis: Axis, local_gravity: float) -> AtRest:
    """Evaluate a calibrated instrument at rest, at the conditions of the readings of its calibration.

    Args:
        chosen: the instrument in use.
        axis: of which it is.
        local_gravity: m/s², that the calibration's local g stands for.

    Raises:
        InputError: the output is no such quantity, or the calibration has no temperature.
        ModelError: an effect cannot be evaluated outside Python.
    """
    calibration, inputs = chosen.calibration, chosen.equation.at_fit
    if "temperature" not in inputs:
        raise bc.InputError(
            f"{axis}: firmware corrects over temperature, and the calibration has no column 'temperature'"
        )
    program, no_stimulus = chosen.program, np.zeros(len(calibration.readings))
    (expected,) = program.graph.evaluate(
        (program.equation.expected,), {**inputs, ws.STIMULUS: no_stimulus}
    )
    expected = np.broadcast_to(expected, no_stimulus.shape)
    _, sd, slope = program.run(expected, inputs)
    sd = sd / np.where(slope > 0, slope, 1.0)  # of the reading, not of the stimulus

    def converted(values: np.ndarray) -> np.ndarray:
        try:
            return ws.convert(values, calibration.unit, axis.unit, local_gravity=local_gravity)
        except bc.InputError:
            raise bc.InputError(
                f"{axis}: the calibration's output is in {ws.unit_label(calibration.unit)}, firmware's "
                f"parameter for {axis} is in {ws.unit_label(axis.unit)}: give the calibration of such a sensor"
            ) from None

    def rms(variances: np.ndarray) -> float:
        return float(converted(np.sqrt(np.mean(variances, keepdims=True)))[0])

    return AtRest(
        temperature=np.asarray(inputs["temperature"], float),
        offset=converted(expected),
        unit=axis.unit,
        noise=rms(chosen.noise_variance({**inputs, chosen.stimulus: no_stimulus})),
        uncertainty=rms(sd**2),
        has_scale=chosen.equation.slope_calibrated,
    )


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
        head = ["axis", "unit", "from °C", "to °C", "u(calibration)", "noise"]
        head += ["not in the cubic, rms", "largest", "error to expect, rms"]
        rows = [
            [
                *(name, ws.unit_label(p.of.unit), f"{p.low:.1f}", f"{p.high:.1f}"),
                *map(ws.number, (p.of.uncertainty, p.of.noise)),
                *(ws.number(v if v > 1e-3 * p.of.noise else 0.0) for v in (p.rms, p.largest)),
                ws.number(p.expected_error),
            ]
            for name, p in self.axes.items()
        ]
        return "\n".join([str(ws.plain_table(head, rows)), *self.notes])

    def text(self) -> str:
        """Return the parameter file, in ASCII."""
        autopilot = AUTOPILOTS[self.format]
        comments = [
            f"Thermal parameters of {autopilot.title}, made by bayescal {bc.__version__}",
            *(f"{name}: calibration {identity}" for name, identity in self.sources.items()),
            *(ws.ascii_text(ws.one_line(x)) for x in str(self).replace("─", "-").splitlines()),
        ]
        return autopilot.text(comments, self.values)

    def write(self, path: str | Path) -> Path:
        """Write the parameter file atomically; raise InputError for a place that cannot be written to."""
        return ws.write_text(self.text(), path)


def firmware_parameters(
    calibrations: Mapping[str, bc.Calibration | bc.Compensator],
    format: str,
    *,
    devices: Mapping[str, int] | None = None,
    local_gravity: float = ws.STANDARD_GRAVITY,
) -> FirmwareParameters:
    """Convert calibrations at rest to thermal parameters of PX4 or ArduPilot.

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
    compensators = {
        _axis(name, autopilot): c if isinstance(c, bc.Compensator) else bc.compensator(c)
        for name, c in calibrations.items()
    }
    chosen = dict(sorted(compensators.items()))
    at_rest = {a: read_at_rest(c, a, local_gravity) for a, c in chosen.items()}
    device_ids = _device_ids(chosen, devices or {})
    polynomials, values = dict[Axis, ThermalPolynomial](), Values()
    for key in dict.fromkeys(map(autopilot.together, at_rest)):
        group = {a: r for a, r in at_rest.items() if autopilot.together(a) == key}
        low, high = _common_range(group)
        reference = float(autopilot.reference(low, high))
        projected = {a: project(r, reference, low, high) for a, r in group.items()}
        polynomials |= projected
        values |= autopilot.values(projected, device_ids)
    sources = {str(a): ws.identity(c.calibration) for a, c in chosen.items()}
    axes = {str(a): p for a, p in polynomials.items()}
    notes = (*_notes(polynomials, chosen), autopilot.afterwards)
    return FirmwareParameters(format, values, axes, sources, notes)


def axis_of(calibration: bc.Calibration) -> str | None:
    """Return the axis of a calibration by the label `axis` of its readings, else by the column read, or None."""
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


def _common_range(axes: Mapping[Axis, AtRest]) -> tuple[float, float]:
    """Return the range of temperatures in which all axes of a sensor were calibrated, °C."""
    low, high = max(r.low for r in axes.values()), min(r.high for r in axes.values())
    if not low < high:
        ranges = ", ".join(f"{a} {r.low:.4g} to {r.high:.4g} °C" for a, r in axes.items())
        raise bc.InputError(
            f"these axes share no range of temperatures: {ranges}. Calibrate them over one, or leave one out"
        )
    return low, high


def _device_ids(chosen: Mapping[Axis, bc.Compensator], stated: Mapping[str, int]) -> dict[str, int]:
    """Return the device_id of each sensor: as stated, else as in its log."""
    device_ids = dict[str, int]()
    for a, c in chosen.items():
        readings = c.calibration.readings
        named = readings.groups("device")[0] if readings.has("device") else ()
        if len(named) > 1:
            raise bc.InputError(
                f"{a}: the calibration is of several devices ({', '.join(named)}), firmware's parameters of one"
            )
        device = int(named[0]) if named and named[0].isdecimal() else None
        if device is not None and device_ids.setdefault(a.sensor, device) != device:
            raise bc.InputError(
                f"{a} is of the device {device}, another axis of its sensor of {device_ids[a.sensor]}: give "
                "calibrations of one sensor"
            )
    sensors = dict.fromkeys(a.sensor for a in chosen)
    if unknown := stated.keys() - sensors:
        raise bc.InputError(
            f"device {min(unknown)!r} is none of the sensors given: {', '.join(sensors)}"
        )
    return device_ids | dict(stated)


def _notes(polynomials: Polynomials, chosen: Mapping[Axis, bc.Compensator]) -> list[str]:
    sensors = dict.fromkeys((a.kind, a.number) for a in polynomials)
    all_axes = [Axis(kind, x, number) for kind, number in sensors for x in AXES]
    missing = ", ".join(str(a) for a in all_axes if a not in polynomials)
    notes = [f"Not calibrated, and written without a correction: {missing}."] * bool(missing)
    for a, p in polynomials.items():
        if p.low - p.of.low > 1e-3 or p.of.high - p.high > 1e-3:
            notes.append(
                f"{a} was calibrated from {p.of.low:.1f} to {p.of.high:.1f} °C, its sensor from {p.low:.1f} to "
                f"{p.high:.1f} °C."
            )
        if p.of.has_scale:
            notes.append(f"{a}: these parameters have no scale factor; it is left out.")
        if why_not := chosen[a].why_not:
            notes.append(f"{a}: {ws.NOT_RELIABLE}{why_not}")
    return [*notes, "Beyond these temperatures the correction stays as at their ends."]


def export_parameters(cmd: ws.ExportCommand) -> ws.Answer:
    """Export parameters of an autopilot, from calibrations of single axes or of a triad."""
    loaded = cmd.loaded(ws.of_units(cmd.calibrations, ws.CALIBRATION))
    if loaded and not isinstance(loaded[0][1], bc.Compensator):
        return cmd.written([compensator for _, compensator in loaded])
    compensators = _by_axis(loaded, cmd)
    devices = dict[str, int]()
    for name, value in ws.parse_pairs(cmd.device_id, "--device-id").items():
        if not value.isdecimal():
            raise bc.InputError(f"--device-id {name}={value}: {value!r} is not a whole number")
        devices[name] = int(value)
    options = {"devices": devices, "local_gravity": cmd.gravity}
    file = firmware_parameters(compensators, str(cmd.format_), **options)
    text = file.text() if cmd.out is None else f"{file}\n\nwritten: {file.write(cmd.out)}"
    return ws.Answer(text.removesuffix("\n"), **ws.reliable(compensators))


def _by_axis(
    loaded: Sequence[tuple[Path, bc.Compensator]], cmd: ws.ExportCommand
) -> dict[str, bc.Compensator]:
    """Return calibrations by axis, as their readings or the user name it."""
    compensators = dict[str, bc.Compensator]()
    candidates = [(axis_of(c.calibration), p, c) for p, c in loaded]
    pairs = ws.parse_pairs(cmd.axis, "--axis").items()
    candidates += [(name, Path(p), ws.load_compensator(Path(p), cmd)) for name, p in pairs]
    for name, path, compensator in candidates:
        if name is None:
            raise bc.InputError(
                f"{path}: its readings do not say of which axis it is: --axis gyro_x={path} in its place"
            )
        if name in compensators:
            raise bc.InputError(
                f"{path} is of {name}, as another file is: give one, or its axis (--axis gyro_y={path})"
            )
        compensators[name] = compensator
    return compensators


def export_writers() -> dict[str, Callable[[ws.ExportCommand], ws.Answer]]:
    """Return the writers of `bayescal export`, by format."""
    return dict.fromkeys(AUTOPILOTS, export_parameters)
