"""Two firmwares' thermal parameters: their names, units, reference temperatures, and which constants they hold.

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

from collections.abc import Callable, Mapping
from typing import NamedTuple

from bayescal._core.errors import InputError
from bayescal._use.thermal_polynomial import ThermalPolynomial

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
    """A firmware.

    Attributes:
        title: of it.
        sensors: how many of a kind it has parameters for.
        together: what has one range of temperatures: the key of an axis.
        reference: T_ref of a range (low, high), °C.
        values: the parameters, from the polynomials and the device of each ("gyro", 0).
        line: of a parameter file.
        head: its first lines.
        afterwards: what to do once it is loaded.
    """

    title: str
    sensors: int
    together: Callable[[Axis], tuple]
    reference: Callable[[float, float], float]
    values: Callable[[Polynomials, Mapping[tuple[str, int], int]], Values]
    line: Callable[[str, float | int], str]
    head: tuple[str, ...]
    afterwards: str


def _px4_values(found: Polynomials, devices: Mapping[tuple[str, int], int]) -> Values:
    values: Values = {}
    for kind, letter in (("acc", "A"), ("gyro", "G")):
        sensors = sorted({a.sensor for a in found if a.kind == kind})
        if sensors:
            values[f"TC_{letter}_ENABLE"] = 1
        for n in sensors:
            own = {a.axis: p for a, p in found.items() if (a.kind, a.sensor) == (kind, n)}
            if (kind, n) not in devices:
                raise InputError(
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


def _px4_line(name: str, value: float | int) -> str:
    kind = INTEGER if isinstance(value, int) else REAL
    return f"1\t1\t{name}\t{value if isinstance(value, int) else f'{value:.9g}'}\t{kind}"


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
        line=lambda name, value: f"{name},{value if isinstance(value, int) else f'{value:.9g}'}",
        head=("Parameters, for Mission Planner, MAVProxy or QGroundControl",),
        afterwards="Restart, then calibrate gyroscopes and accelerometers again: their offsets hold for the "
        "temperature INS_GYR*_CALTEMP and INS_ACC*_CALTEMP at which they were found.",
    ),
}  # fmt: skip
