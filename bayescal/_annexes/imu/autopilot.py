"""What autopilots read: cubics of the temperature, their parameters' names, and the files these stand in.

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

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

import bayescal as bc

ORDER = 3  # of the temperature, the highest that an autopilot takes


@dataclass(frozen=True)
class AtRest:
    """Readings of a calibration as its posterior mean says they would be at rest."""

    temperature: np.ndarray  # °C, (n,)
    offset: np.ndarray  # of the reading, in `unit`, (n,)
    unit: str  # "rad/s" or "m/s^2"
    noise: float  # standard deviation of one reading, in `unit`
    uncertainty: float  # root mean square over the readings of the standard uncertainty of `offset`, in `unit`
    # smallest and largest scale factor there, less one; zeros where none was calibrated
    scale: tuple[float, float]

    @property
    def low(self) -> float:
        return float(self.temperature.min())

    @property
    def high(self) -> float:
        return float(self.temperature.max())


@dataclass(frozen=True)
class ThermalPolynomial:
    """One axis as firmware has it; single precision, as firmware stores it."""

    coefficients: tuple[float, float, float, float]  # c0 … c3, in `unit`/°C^k
    reference: float  # T_ref, °C
    low: float  # low, high: the temperatures between which it holds; firmware stops there, °C
    high: float
    rms: float  # rms, largest: of what it leaves out of the calibration, over its readings in that range, in `unit`
    largest: float
    of: AtRest  # what it was projected from

    @property
    def unit(self) -> str:
        return self.of.unit

    @property
    def expected_error(self) -> float:
        """Root mean square to expect of a corrected reading like those of the calibration, in `unit`."""
        return float(np.sqrt(self.of.noise**2 + self.of.uncertainty**2 + self.rms**2))

    def __call__(self, temperature: np.ndarray) -> np.ndarray:
        """The offset at these temperatures, °C, held at its ends beyond the range."""
        d = np.clip(temperature, self.low, self.high) - self.reference
        c0, c1, c2, c3 = self.coefficients
        return c0 + d * (c1 + d * (c2 + d * c3))


def project(of: AtRest, reference: float, low: float, high: float) -> ThermalPolynomial:
    """The cubic nearest to a calibration between two temperatures.

    Args:
        of: the calibration's readings at rest.
        reference: T_ref, °C.
        low, high: °C; readings outside count for nothing.

    Raises:
        InputError: the readings in that range are all at one temperature.
    """
    inside = (of.temperature >= low) & (of.temperature <= high)
    temperature, offset = of.temperature[inside], of.offset[inside]
    distinct = len(np.unique(temperature))
    if distinct < 2:
        raise bc.InputError(
            f"between {low:.4g} and {high:.4g} °C the calibration has {distinct} temperature"
            f"{'s' * (distinct != 1)}, and a polynomial needs several: calibrate over a range"
        )
    fitted = np.polynomial.Polynomial.fit(
        temperature - reference, offset, min(ORDER, distinct - 1)
    ).convert()
    rounded = np.zeros(ORDER + 1, np.float32)
    rounded[: len(fitted.coef)] = fitted.coef
    c0, c1, c2, c3 = map(float, rounded)
    made = ThermalPolynomial((c0, c1, c2, c3), reference, low, high, 0.0, 0.0, of)
    left = offset - made(temperature)
    rms, largest = float(np.sqrt(np.mean(left**2))), float(np.abs(left).max())
    return replace(made, rms=rms, largest=largest)


AXES = "xyz"
PX4_SENSORS, ARDUPILOT_SENSORS = 4, 3  # GYRO_COUNT_MAX; INS_TCAL1 … INS_TCAL3
ARDUPILOT_REFERENCE, ARDUPILOT_SCALE = 35.0, 1e6  # TEMP_REFERENCE, °C; SCALE_FACTOR
INTEGER, REAL = 6, 9  # MAV_PARAM_TYPE_INT32, MAV_PARAM_TYPE_REAL32 (MAVLink, common.xml)


class Axis(NamedTuple):
    """One axis of one sensor: kind "gyro" or "acc", axis "x", "y" or "z", sensor 0, 1, …"""

    kind: str
    axis: str
    sensor: int

    def __str__(self) -> str:
        return f"{self.kind}_{self.axis}" + (f"_{self.sensor}" if self.sensor else "")

    @property
    def unit(self) -> str:
        return {"gyro": "rad/s", "acc": "m/s^2"}[self.kind]


Polynomials = Mapping[Axis, ThermalPolynomial]
Values = dict[str, float | int]


class Autopilot(NamedTuple):
    """A firmware."""

    title: str  # of it
    sensors: int  # how many of a kind it has parameters for
    together: Callable[[Axis], tuple]  # what has one range of temperatures: the key of an axis
    reference: Callable[[float, float], float]  # T_ref of a range (low, high), °C
    # the parameters, from the polynomials and the device of each ("gyro", 0)
    values: Callable[[Polynomials, Mapping[tuple[str, int], int]], Values]
    line: Callable[[str, float | int], str]  # of a parameter file
    head: tuple[str, ...]  # its first lines
    afterwards: str  # what to do once it is loaded

    def text(self, said: Iterable[str], values: Values) -> str:
        """A parameter file, with what is said of it in comments."""
        lines = [f"# {line}".rstrip() for line in (*said, *self.head)]
        return "\n".join([*lines, *(self.line(n, v) for n, v in values.items()), ""])


def _px4_values(found: Polynomials, devices: Mapping[tuple[str, int], int]) -> Values:
    values: Values = {}
    for kind, letter in (("acc", "A"), ("gyro", "G")):
        sensors = sorted({a.sensor for a in found if a.kind == kind})
        if sensors:
            values[f"TC_{letter}_ENABLE"] = 1
        for n in sensors:
            own = {a.axis: p for a, p in found.items() if (a.kind, a.sensor) == (kind, n)}
            if (kind, n) not in devices:
                raise bc.InputError(
                    f"{next(iter(own))} of {kind} {n}: PX4 corrects a sensor whose device_id it is given, and the "
                    f"calibration does not say it: --device-id {kind}{f'_{n}' if n else ''}=NUMBER (param show "
                    f"CAL_{'GYRO' if kind == 'gyro' else 'ACC'}{n}_ID on the autopilot)"
                )
            some = next(iter(own.values()))
            values[f"TC_{letter}{n}_ID"] = devices[kind, n]
            values[f"TC_{letter}{n}_TREF"] = some.reference
            values[f"TC_{letter}{n}_TMIN"], values[f"TC_{letter}{n}_TMAX"] = some.low, some.high
            for order in range(4):
                for place, axis in enumerate(AXES):
                    kept = axis in own and not (kind == "acc" and order == 0)
                    value = own[axis].coefficients[order] if kept else 0.0
                    values[f"TC_{letter}{n}_X{order}_{place}"] = value
    return values


def _ardupilot_values(found: Polynomials, devices: Mapping[tuple[str, int], int]) -> Values:
    values: Values = {}
    for n in sorted({a.sensor for a in found}):
        own = {(a.kind, a.axis): p for a, p in found.items() if a.sensor == n}
        some, name = next(iter(own.values())), f"INS_TCAL{n + 1}"
        values |= {f"{name}_ENABLE": 1, f"{name}_TMIN": some.low, f"{name}_TMAX": some.high}
        for kind, word in (("acc", "ACC"), ("gyro", "GYR")):
            for order in (1, 2, 3):
                for axis in AXES:
                    one = own.get((kind, axis))
                    value = ARDUPILOT_SCALE * one.coefficients[order] if one else 0.0
                    values[f"{name}_{word}{order}_{axis.upper()}"] = value
    return values


def _written(value: float | int) -> str:
    """A parameter as text: nine digits are all that a number of single precision has, others have more."""
    if isinstance(value, int):
        return str(value)
    return f"{value:.9g}" if float(np.float32(value)) == value else f"{value:.13g}"


def _px4_line(name: str, value: float | int) -> str:
    return f"1\t1\t{name}\t{_written(value)}\t{INTEGER if isinstance(value, int) else REAL}"


AUTOPILOTS = {
    "px4-params": Autopilot(
        title="PX4",
        sensors=PX4_SENSORS,
        together=lambda a: (a.kind, a.sensor),
        reference=lambda low, high: round(0.5 * (low + high)),
        values=_px4_values,
        line=_px4_line,
        head=("Onboard parameters, for QGroundControl or `param load`", "Vehicle-Id Component-Id Name Value Type"),
        afterwards="Restart, then calibrate gyroscopes and accelerometers again: CAL_GYRO*_*OFF and CAL_ACC*_*OFF "
        "come on top of this.",
    ),
    "ardupilot-params": Autopilot(
        title="ArduPilot",
        sensors=ARDUPILOT_SENSORS,
        together=lambda a: (a.sensor,),
        reference=lambda low, high: ARDUPILOT_REFERENCE,
        values=_ardupilot_values,
        line=lambda name, value: f"{name},{_written(value)}",
        head=("Parameters, for Mission Planner, MAVProxy or QGroundControl",),
        afterwards="Restart, then calibrate gyroscopes and accelerometers again: their offsets hold for the "
        "temperature INS_GYR*_CALTEMP and INS_ACC*_CALTEMP at which they were found.",
    ),
}  # fmt: skip
