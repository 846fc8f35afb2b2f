"""Thermal parameters of autopilots from single-axis calibrations: cubic polynomials, and their approximation error.

The posterior mean of the reading at rest, b(T, rate, lag, …), is approximated by a cubic p(T), by least squares over
the readings of the calibration. If b is a cubic in temperature alone, p equals b to rounding; otherwise b − p is the
error of firmware that corrects by temperature only.

PX4 (PX4-Autopilot, src/modules/temperature_compensation/TemperatureCompensation.cpp,
calc_thermal_offsets_3D, and temp_comp_params_gyro_0.yaml and similar files): for sensor n of its kind
(TC_Gn_… gyroscope in rad/s, TC_An_… accelerometer in m/s²) and axis a = 0, 1, 2

    corrected = raw − (X0_a + X1_a·d + X2_a·d² + X3_a·d³),   d = clip(T, TMIN, TMAX) − TREF,

applied where TC_Gn_ID is the sensor's device_id and TC_G_ENABLE is 1. An accelerometer's X0 is 0, as in
PX4's own calibration (temperature_calibration/accel.cpp): at rest its constant is an alias of gravity.

ArduPilot (ardupilot, libraries/AP_InertialSensor/AP_InertialSensor_tempcal.cpp, polynomial_eval and
correct_sensor): for IMU n = 1, 2, 3, in rad/s and m/s² with coefficients in millionths,

    P(T) = 10⁻⁶·(c1·d + c2·d² + c3·d³),   d = T − 35 °C,
    corrected = raw − P(clip(T, TMIN, TMAX)) + P(clip(T_cal, TMIN, TMAX)),

c1 … c3 being INS_TCALn_GYR1_X … GYR3_X and ACC1_X … ACC3_X, and T_cal the temperature at which its
offsets were calibrated (INS_GYR_CALTEMP, INS_ACC_CALTEMP); the constant c0 is part of these offsets. Gyroscope and
accelerometer share the temperature range and the reference temperature.
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

MAX_DEGREE = 3  # of a polynomial in temperature, the highest that autopilots support


@dataclass(frozen=True)
class RestOffsets:
    """Offsets (posterior mean of the readings at rest) under the conditions of a calibration's readings."""

    temperature: np.ndarray  # °C, (n,)
    offset: np.ndarray  # of the reading, in `unit`, (n,)
    unit: str  # "rad/s" or "m/s^2"
    noise: float  # standard deviation of one reading, in `unit`
    uncertainty: float  # root mean square over the readings of the standard uncertainty of `offset`, in `unit`
    has_scale: bool  # whether a scale factor was calibrated as well

    @property
    def low(self) -> float:
        return float(self.temperature.min())

    @property
    def high(self) -> float:
        return float(self.temperature.max())


@ws.renamed(of="offsets", largest="max_error")
@dataclass(frozen=True)
class ThermalPolynomial:
    """Cubic polynomial in temperature for the offset of one axis, in single precision as firmware stores it."""

    coefficients: tuple[float, ...]  # c0 … c3, in `unit`/°C^k
    reference: float  # T_ref, °C
    low: float  # low, high: calibrated range, to which firmware clamps the temperature, °C
    high: float
    rms: float  # rms, max_error: approximation error, over the readings in that range, in `unit`
    max_error: float
    offsets: RestOffsets  # the offsets that it approximates

    @property
    def expected_error(self) -> float:
        """Return the expected rms error of a corrected reading under calibration conditions, unit of the offsets."""
        return float(np.sqrt(self.offsets.noise**2 + self.offsets.uncertainty**2 + self.rms**2))


def fit_cubic(offsets: RestOffsets, reference: float, low: float, high: float) -> ThermalPolynomial:
    """Fit a cubic to a calibration's offsets in a temperature range, by least squares.

    Args:
        offsets: offsets of the calibration.
        reference: T_ref, °C.
        low, high: temperature range, °C; readings outside it are ignored.

    Raises:
        InputError: all readings in the range have one temperature.
    """
    is_in_range = (offsets.temperature >= low) & (offsets.temperature <= high)
    d, offset = offsets.temperature[is_in_range] - reference, offsets.offset[is_in_range]
    n_distinct = len(np.unique(d))
    if n_distinct < 2:
        raise bc.InputError(
            f"between {low:.4g} and {high:.4g} °C the calibration has fewer than two temperatures, too few for a "
            "polynomial: calibrate over a temperature range"
        )
    polynomial = np.polynomial.Polynomial.fit(d, offset, min(MAX_DEGREE, n_distinct - 1)).convert()
    coefficients = np.zeros(MAX_DEGREE + 1, np.float32)
    coefficients[: len(polynomial.coef)] = polynomial.coef
    residuals = offset - np.polynomial.Polynomial(coefficients.astype(float))(d)
    errors = float(np.sqrt(np.mean(residuals**2))), float(np.abs(residuals).max())
    values = tuple(map(float, coefficients))
    return ThermalPolynomial(values, reference, low, high, *errors, offsets)


AXES = "xyz"
ARDUPILOT_REFERENCE, ARDUPILOT_SCALE = 35.0, 1e6  # TEMP_REFERENCE, °C; SCALE_FACTOR
TYPE_INT32, TYPE_REAL32 = 6, 9  # MAV_PARAM_TYPE_INT32, MAV_PARAM_TYPE_REAL32 (MAVLink, common.xml)
_AXIS_NAME = re.compile(r"(gyro|acc)_([xyz])(?:_(\d))?")


class Axis(NamedTuple):
    """One axis of one sensor: kind "gyro" or "acc", axis "x", "y" or "z", number 0, 1, … of its sensor."""

    kind: str
    axis: str
    number: int

    def __str__(self) -> str:
        return f"{self.kind}_{self.axis}" + f"_{self.number}" * bool(self.number)

    @property
    def sensor(self) -> str:
        """Return the name of the axis's sensor: "gyro", or "gyro_1" for the second gyroscope."""
        return self.kind + f"_{self.number}" * bool(self.number)

    @property
    def unit(self) -> str:
        return {"gyro": "rad/s", "acc": "m/s^2"}[self.kind]


Polynomials = Mapping[Axis, ThermalPolynomial]
Values = dict[str, float | int]


class Autopilot(NamedTuple):
    """Definition of the thermal parameters of an autopilot: names, limits and file format."""

    title: str  # name of the firmware
    max_sensors: int  # of one kind, with parameters
    range_key: Callable[[Axis], tuple]  # key of the axes that share one temperature range
    choose_reference: Callable[[float, float], float]  # T_ref of a range (low, high), °C
    # parameters of axes that share a range, given the device_id of each sensor
    make_values: Callable[[Polynomials, Mapping[str, int]], Values]
    format_line: Callable[[str, float | int], str]  # line of a parameter file
    header: tuple[str, ...]  # comment lines of a parameter file
    instructions: str  # for the user, after loading the file

    def format_file(self, comments: Iterable[str], values: Values) -> str:
        """Format a parameter file, with comments at its beginning."""
        lines = [f"# {line}".rstrip() for line in (*comments, *self.header)]
        return "\n".join([*lines, *(self.format_line(n, v) for n, v in values.items()), ""])


def _make_px4_values(polynomials: Polynomials, devices: Mapping[str, int]) -> Values:
    (first, polynomial), *_ = polynomials.items()
    letter, word = ("G", "GYRO") if first.kind == "gyro" else ("A", "ACC")
    if first.sensor not in devices:
        raise bc.InputError(
            f"{first}: PX4 needs the sensor's device_id, which the calibration does not contain: give "
            f"--device-id {first.sensor}=NUMBER (param show CAL_{word}{first.number}_ID on the autopilot)"
        )
    prefix = f"TC_{letter}{first.number}"
    values: Values = {f"TC_{letter}_ENABLE": 1, f"{prefix}_ID": devices[first.sensor]}
    values |= {f"{prefix}_TREF": polynomial.reference}
    values |= {f"{prefix}_TMIN": polynomial.low, f"{prefix}_TMAX": polynomial.high}
    by_axis = {a.axis: p.coefficients for a, p in polynomials.items()}
    for power in range(MAX_DEGREE + 1):
        for index, axis in enumerate(AXES):
            has_value = axis in by_axis and (letter, power) != ("A", 0)
            values[f"{prefix}_X{power}_{index}"] = by_axis[axis][power] if has_value else 0.0
    return values


def _make_ardupilot_values(polynomials: Polynomials, devices: Mapping[str, int]) -> Values:
    (first, polynomial), *_ = polynomials.items()
    prefix = f"INS_TCAL{first.number + 1}"
    values: Values = {f"{prefix}_ENABLE": 1}
    values |= {f"{prefix}_TMIN": polynomial.low, f"{prefix}_TMAX": polynomial.high}
    by_axis = {(a.kind, a.axis): p.coefficients for a, p in polynomials.items()}
    for kind, word in (("acc", "ACC"), ("gyro", "GYR")):
        for power in range(1, MAX_DEGREE + 1):
            for axis in AXES:
                value = by_axis[kind, axis][power] if (kind, axis) in by_axis else 0.0
                values[f"{prefix}_{word}{power}_{axis.upper()}"] = ARDUPILOT_SCALE * value
    return values


AUTOPILOTS = {
    "px4-params": Autopilot(
        title="PX4",
        max_sensors=4,  # GYRO_COUNT_MAX
        range_key=lambda a: (a.kind, a.number),
        choose_reference=lambda low, high: round(0.5 * (low + high)),
        make_values=_make_px4_values,
        format_line=lambda name, value: (
            f"1\t1\t{name}\t{value:.13g}\t{TYPE_INT32 if isinstance(value, int) else TYPE_REAL32}"
        ),
        header=("Onboard parameters, for QGroundControl or `param load`", "Vehicle-Id Component-Id Name Value Type"),
        instructions="Restart, then calibrate gyroscopes and accelerometers again: CAL_GYRO*_*OFF and CAL_ACC*_*OFF "
        "are applied in addition to these parameters.",
    ),
    "ardupilot-params": Autopilot(
        title="ArduPilot",
        max_sensors=3,  # INS_TCAL1 … INS_TCAL3
        range_key=lambda a: (a.number,),
        choose_reference=lambda low, high: ARDUPILOT_REFERENCE,
        make_values=_make_ardupilot_values,
        format_line=lambda name, value: f"{name},{value:.13g}",
        header=("Parameters, for Mission Planner, MAVProxy or QGroundControl",),
        instructions="Restart, then calibrate gyroscopes and accelerometers again: their offsets are valid at the "
        "temperatures INS_GYR*_CALTEMP and INS_ACC*_CALTEMP of that calibration.",
    ),
}  # fmt: skip


def evaluate_offsets(compensator: bc.Compensator, axis: Axis, local_gravity: float) -> RestOffsets:
    """Evaluate the offsets of a calibrated instrument under the conditions of its calibration's readings.

    Args:
        compensator: compensator of the instrument.
        axis: axis that the instrument measures.
        local_gravity: value of the calibration's unit g, m/s².

    Raises:
        InputError: the output has another dimension than the axis, or the calibration has no temperature.
        ModelError: an effect cannot be evaluated outside Python.
    """
    calibration, inputs = compensator.calibration, compensator.equation.at_fit
    if "temperature" not in inputs:
        message = f"{axis}: firmware corrects by temperature, but the calibration has no column 'temperature'"
        raise bc.InputError(message)
    program, zero_input = compensator.program, np.zeros(len(calibration.readings))
    (offset,) = program.graph.evaluate(
        (program.equation.expected,), {**inputs, ws.STIMULUS: zero_input}
    )
    offset = np.broadcast_to(offset, zero_input.shape)
    _, sd, slope = program.run(offset, inputs)
    sd = sd / np.where(slope > 0, slope, 1.0)  # of the reading, not of the stimulus
    noise_variance = compensator.in_use.noise_variance(zero_input, inputs)
    try:
        factor = ws.convert(1.0, calibration.unit, axis.unit, local_gravity=local_gravity)
    except bc.InputError:
        raise bc.InputError(
            f"{axis}: the calibration's output is in {ws.unit_label(calibration.unit)}, but the firmware's "
            f"parameter is in {ws.unit_label(axis.unit)}: give a calibration whose output has that dimension"
        ) from None
    return RestOffsets(
        temperature=np.asarray(inputs["temperature"], float),
        offset=factor * offset,
        unit=axis.unit,
        noise=float(factor * np.sqrt(np.mean(noise_variance))),
        uncertainty=float(factor * np.sqrt(np.mean(sd**2))),
        has_scale=compensator.equation.is_slope_calibrated,
    )


@dataclass(frozen=True)
class FirmwareParameters:
    """Thermal parameters of an autopilot.

    Attributes:
        format: "px4-params" or "ardupilot-params".
        values: parameter → value, as in the file.
        axes: name of an axis, such as "gyro_x" → polynomial of its offset.
        sources: name of an axis → identity of its calibration (SHA-256).
        notes: notes on use, one sentence each.
    """

    format: str
    values: Values
    axes: dict[str, ThermalPolynomial]
    sources: dict[str, str]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        headers = ["axis", "unit", "from °C", "to °C", "u(calibration)", "noise"]
        headers += ["error of the cubic, rms", "largest", "expected error, rms"]
        rows = [
            [
                *(name, ws.unit_label(p.offsets.unit), f"{p.low:.1f}", f"{p.high:.1f}"),
                *map(ws.number, (p.offsets.uncertainty, p.offsets.noise)),
                *(ws.number(v * (v > 1e-3 * p.offsets.noise)) for v in (p.rms, p.max_error)),
                ws.number(p.expected_error),
            ]
            for name, p in self.axes.items()
        ]
        return "\n".join([str(ws.make_table(headers, rows)), *self.notes])

    def text(self) -> str:
        """Return the content of the parameter file, in ASCII."""
        autopilot = AUTOPILOTS[self.format]
        comments = [
            f"Thermal parameters of {autopilot.title}, made by bayescal {bc.__version__}",
            *(f"{name}: calibration {identity}" for name, identity in self.sources.items()),
            *(ws.to_ascii(ws.to_printable(x)) for x in str(self).replace("─", "-").splitlines()),
        ]
        return autopilot.format_file(comments, self.values)

    def write(self, path: str | Path) -> Path:
        """Write the parameter file atomically; raise InputError if it cannot be written."""
        return ws.write_text(self.text(), path)


def firmware_parameters(
    calibrations: Mapping[str, bc.Calibration | bc.Compensator],
    format: str,
    *,
    devices: Mapping[str, int] | None = None,
    local_gravity: float = ws.STANDARD_GRAVITY,
) -> FirmwareParameters:
    """Convert calibrations at rest to thermal parameters of PX4 or ArduPilot.

    A model that is not a cubic in temperature is approximated by one, by least squares over the readings of its
    calibration; the result and its file state the approximation error. The module's docstring has formulas and sources.

    Args:
        calibrations: axis ("gyro_x", "acc_z", or "gyro_x_1" of a second sensor) → its calibration.
        format: "px4-params" or "ardupilot-params".
        devices: sensor ("gyro", "acc_1") → its device_id for PX4; default: that in the calibration's PX4 log.
        local_gravity: local gravity that was given when the readings were read, m/s².

    Raises:
        InputError: an unknown format, axis or sensor; a calibration of another quantity or of several devices; axes of
            a sensor without a common temperature range; a sensor without device_id for PX4.
        ModelError: an effect that cannot be evaluated outside Python.
    """
    if format not in AUTOPILOTS:
        raise bc.InputError(f"format {format!r} is not one of {', '.join(AUTOPILOTS)}")
    autopilot = AUTOPILOTS[format]
    if not calibrations:
        raise bc.InputError(f"{autopilot.title}: give at least one calibration")
    compensators = {
        _parse_axis(name, autopilot): c if isinstance(c, bc.Compensator) else bc.compensator(c)
        for name, c in calibrations.items()
    }
    by_axis = dict(sorted(compensators.items()))
    offsets = {a: evaluate_offsets(c, a, local_gravity) for a, c in by_axis.items()}
    device_ids = _find_device_ids(by_axis, devices or {})
    polynomials, values = dict[Axis, ThermalPolynomial](), Values()
    for key in dict.fromkeys(map(autopilot.range_key, offsets)):
        group = {a: r for a, r in offsets.items() if autopilot.range_key(a) == key}
        low, high = _find_common_range(group)
        reference = float(autopilot.choose_reference(low, high))
        group_polynomials = {a: fit_cubic(r, reference, low, high) for a, r in group.items()}
        polynomials |= group_polynomials
        values |= autopilot.make_values(group_polynomials, device_ids)
    sources = {str(a): ws.identity(c.calibration) for a, c in by_axis.items()}
    axes = {str(a): p for a, p in polynomials.items()}
    notes = (*_list_notes(polynomials, by_axis), autopilot.instructions)
    return FirmwareParameters(format, values, axes, sources, notes)


def find_axis(calibration: bc.Calibration) -> str | None:
    """Return the axis of a calibration from the label `axis` of its readings or the output's column, or None."""
    readings = calibration.readings
    labels = readings.groups("axis")[0] if readings.has("axis") else ()
    names = set(labels) or {source.output for source in readings.sources}
    name = next(iter(names), "")
    return name if len(names) == 1 and _AXIS_NAME.fullmatch(name) else None


def _parse_axis(name: str, autopilot: Autopilot) -> Axis:
    match = _AXIS_NAME.fullmatch(name)
    if match is None or int(match[3] or 0) >= autopilot.max_sensors:
        raise bc.InputError(
            f"{name!r} is not an axis of {autopilot.title}: choose gyro_x, gyro_y, gyro_z, acc_x, acc_y, acc_z, or "
            f"gyro_x_1 … gyro_x_{autopilot.max_sensors - 1} for additional sensors"
        )
    return Axis(match[1], match[2], int(match[3] or 0))


def _find_common_range(axes: Mapping[Axis, RestOffsets]) -> tuple[float, float]:
    """Return the temperature range in which all of these axes were calibrated, °C; raise InputError if it is empty."""
    low, high = max(r.low for r in axes.values()), min(r.high for r in axes.values())
    if not low < high:
        ranges = ", ".join(f"{a} {r.low:.4g} to {r.high:.4g} °C" for a, r in axes.items())
        raise bc.InputError(
            f"these axes have no common temperature range: {ranges}: calibrate them over one range, or omit an axis"
        )
    return low, high


def _find_device_ids(
    by_axis: Mapping[Axis, bc.Compensator], stated_ids: Mapping[str, int]
) -> dict[str, int]:
    """Return sensor → device_id, stated or of the calibration's log; raise InputError if they are contradictory."""
    device_ids = dict[str, int]()
    for a, c in by_axis.items():
        readings = c.calibration.readings
        labels = readings.groups("device")[0] if readings.has("device") else ()
        if len(labels) > 1:
            raise bc.InputError(
                f"{a}: the calibration has several devices ({', '.join(labels)}), but firmware parameters apply to one"
            )
        device = int(labels[0]) if labels and labels[0].isdecimal() else None
        if device is not None and device_ids.setdefault(a.sensor, device) != device:
            raise bc.InputError(
                f"{a} has the device_id {device}, but another axis of that sensor has {device_ids[a.sensor]}: give "
                "calibrations of one sensor"
            )
    sensors = dict.fromkeys(a.sensor for a in by_axis)
    if unknown_names := stated_ids.keys() - sensors:
        message = f"a device_id is given for {min(unknown_names)!r}, which is not a sensor: {', '.join(sensors)}"
        raise bc.InputError(message)
    return device_ids | dict(stated_ids)


def _list_notes(polynomials: Polynomials, compensators: Mapping[Axis, bc.Compensator]) -> list[str]:
    sensors = dict.fromkeys((a.kind, a.number) for a in polynomials)
    all_axes = [Axis(kind, x, number) for kind, number in sensors for x in AXES]
    missing = ", ".join(str(a) for a in all_axes if a not in polynomials)
    notes = [f"Not calibrated, hence written without a correction: {missing}."] * bool(missing)
    for a, p in polynomials.items():
        if p.low - p.offsets.low > 1e-3 or p.offsets.high - p.high > 1e-3:
            notes.append(
                f"{a} was calibrated from {p.offsets.low:.1f} to {p.offsets.high:.1f} °C, all axes of its sensor only "
                f"from {p.low:.1f} to {p.high:.1f} °C."
            )
        if p.offsets.has_scale:
            notes.append(f"{a}: the calibrated scale factor is omitted for lack of a parameter.")
        if reason := compensators[a].why_not:
            notes.append(f"{a}: {ws.NOT_RELIABLE}{reason}")
    return [*notes, "Outside its range, a correction keeps its value at the nearest limit."]


def export_parameters(cmd: ws.ExportCommand) -> ws.Answer:
    """Export parameters of an autopilot, from calibrations of single axes or of a triad."""
    corrections = cmd.load_corrections(ws.expand_channels(cmd.calibrations, ws.CALIBRATION))
    if corrections and not isinstance(corrections[0][1], bc.Compensator):
        cmd.refuse_unused("axis", "device_id", "local_gravity", subject=" of three axes")
        return cmd.write_corrections([compensator for _, compensator in corrections])
    if cmd.format_ == "ardupilot-params":
        cmd.refuse_unused("device_id")
    compensators = _map_by_axis(corrections, cmd)
    devices = dict[str, int]()
    for name, value in ws.parse_pairs(cmd.device_id, "--device-id").items():
        if not value.isdecimal():
            raise bc.InputError(f"--device-id {name}={value}: expected a non-negative integer")
        devices[name] = int(value)
    options = {"devices": devices, "local_gravity": cmd.gravity}
    result = firmware_parameters(compensators, str(cmd.format_), **options)
    text = result.text() if cmd.out is None else f"{result}\n\nwritten: {result.write(cmd.out)}"
    return ws.Answer(text.removesuffix("\n"), why=ws.describe_reliability(compensators))


def _map_by_axis(
    loaded: Sequence[tuple[Path, bc.Compensator]], cmd: ws.ExportCommand
) -> dict[str, bc.Compensator]:
    """Return axis → compensator; raise InputError if readings and --axis name no axis, or one axis is given twice."""
    compensators = dict[str, bc.Compensator]()
    candidates = [(find_axis(c.calibration), p, c) for p, c in loaded]
    pairs = ws.parse_pairs(cmd.axis, "--axis").items()
    candidates += [(name, Path(p), ws.load_compensator(Path(p), cmd)) for name, p in pairs]
    for name, path, compensator in candidates:
        if name is None:
            advice = f"give --axis gyro_x={path} instead"
            raise bc.InputError(f"{path}: the readings do not name the axis: {advice}")
        if name in compensators:
            raise bc.InputError(
                f"{path} and another file calibrate {name}: give one of them, or name the axis (--axis gyro_y={path})"
            )
        compensators[name] = compensator
    return compensators


def export_writers() -> dict[str, Callable[[ws.ExportCommand], ws.Answer]]:
    """Return the writers of `bayescal export`, by format."""
    return dict.fromkeys(AUTOPILOTS, export_parameters)
