"""Autopilots' thermal parameters correct as the calibration does, and promise what they keep.

The two functions `px4` and `ardupilot` are written from the firmwares' sources, in their single precision.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import still_sensor
from tests.support.command_line import needs_installation, run
from tests.support.log_files import write_dataflash, write_ulog

INSTRUMENT = still_sensor.INSTRUMENT
QUICK = bc.LeastSquares(draws=400)
F = np.float32


def px4(values, sensor: str, axis: int, temperature: Any) -> np.ndarray:
    """PX4-Autopilot, TemperatureCompensation.cpp, calc_thermal_offsets_3D: what is taken from a reading."""
    own = {
        k: F(values[f"TC_{sensor}_{k}"])
        for k in ("TREF", "TMIN", "TMAX", *(f"X{n}_{axis}" for n in range(4)))
    }
    delta = np.clip(F(temperature), own["TMIN"], own["TMAX"]) - own["TREF"]
    square = delta * delta
    return np.asarray(
        own[f"X0_{axis}"]
        + own[f"X1_{axis}"] * delta
        + own[f"X2_{axis}"] * square
        + own[f"X3_{axis}"] * (square * delta)
    )


def ardupilot(
    values, imu: int, word: str, axis: str, temperature: Any, calibrated_at
) -> np.ndarray:
    """ardupilot, AP_InertialSensor_tempcal.cpp, correct_sensor: what is taken from a reading."""
    low, high = F(values[f"INS_TCAL{imu}_TMIN"]), F(values[f"INS_TCAL{imu}_TMAX"])
    c = [F(values[f"INS_TCAL{imu}_{word}{n}_{axis}"]) for n in (1, 2, 3)]

    def polynomial(t):
        d = np.clip(F(t), low, high) - F(35.0)
        return (c[0] + (c[1] + c[2] * d) * d) * d * F(1e-6)

    return np.asarray(polynomial(temperature) - polynomial(calibrated_at))


def loaded(text: str) -> dict[str, float]:
    """A parameter file as a ground station loads it: lines of # passed over."""
    rows = [re.split(r"[\t,]", line) for line in text.splitlines() if not line.startswith("#")]
    return {
        row[-2] if len(row) == 2 else row[2]: float(row[1 if len(row) == 2 else 3]) for row in rows
    }


def warming(rows: int = 400, low: float = 15.0, high: float = 60.0):
    """Time, s, and temperature, °C, of a unit that warms up."""
    time = 10.0 + 5.0 * np.arange(rows)
    return time, high - (high - low) * np.exp(-(time - time[0]) / 700)


def bias(temperature, scale: float = 1.0) -> np.ndarray:
    d = temperature - 40.0
    return scale * (0.01 + 2e-4 * d - 3e-6 * d**2 + 4e-8 * d**3)


def fitted(unit: str, values, temperature, time, *more: str, **labels) -> bc.Calibration:
    given = {"time": time, "temperature": temperature, "output": values, **labels}
    readings = bc.Measurements.from_arrays(INSTRUMENT, units={"output": unit}, **given)
    model = INSTRUMENT.for_readings(readings).baseline()
    for name in ("bias.temperature_quadratic", "bias.temperature_cubic", *more):
        model = model + name
    return bc.fit(model, readings, QUICK)


@pytest.fixture(scope="module")
def axes() -> dict[str, bc.Calibration]:
    """A gyroscope's x, and an accelerometer's x and z under gravity, over another range."""
    random, (time, temperature) = np.random.default_rng(5), warming()
    noise = 1e-4 * random.standard_normal((3, len(time)))
    warmer = warming(low=22.0, high=66.0)[1]
    return {
        "gyro_x": fitted("rad/s", bias(temperature) + noise[0], temperature, time, axis="gyro_x"),
        "acc_x": fitted("m/s^2", 0.3 + bias(warmer, 5.0) + noise[1], warmer, time),
        "acc_z": fitted("m/s^2", -9.81 + bias(temperature, -9.0) + noise[2], temperature, time),
    }


def at_rest(calibration: bc.Calibration, unit: str, temperature) -> np.ndarray:
    """What the calibration itself says of a reading at rest, by its own compensation."""
    found = bc.compensator(calibration)(
        output=0.0, temperature=temperature, method="first order", noise=False, warn=False
    )
    factor = {"rad/s": np.pi / 180, "m/s^2": 9.80665e-6}[unit]
    return -factor * found.value


def test_px4_takes_away_what_the_calibration_found(axes) -> None:
    made = bc.firmware_parameters(axes, "px4-params", devices={"gyro": 11, "acc": 12})
    values = loaded(made.text())
    assert (values["TC_G_ENABLE"], values["TC_G0_ID"], values["TC_A0_ID"]) == (1, 11, 12)
    temperature = np.linspace(22.5, 57.0, 50)
    gyro = at_rest(axes["gyro_x"], "rad/s", temperature)
    np.testing.assert_allclose(px4(values, "G0", 0, temperature), gyro, rtol=2e-6)
    for place, name in ((0, "acc_x"), (2, "acc_z")):  # the constant is not told from gravity
        reference, acc = values["TC_A0_TREF"], at_rest(axes[name], "m/s^2", temperature)
        acc = acc - at_rest(axes[name], "m/s^2", np.array([reference]))
        np.testing.assert_allclose(px4(values, "A0", place, temperature), acc, atol=2e-7)
        assert px4(values, "A0", place, reference) == 0
    assert not px4(values, "G0", 1, temperature).any()


def test_ardupilot_takes_away_what_the_calibration_found(axes) -> None:
    made = bc.firmware_parameters(axes, "ardupilot-params")
    values = loaded(made.text())
    temperature, calibrated_at = np.linspace(22.5, 57.0, 50), 31.0
    for name, word, unit in (
        ("gyro_x", "GYR", "rad/s"),
        ("acc_x", "ACC", "m/s^2"),
        ("acc_z", "ACC", "m/s^2"),
    ):
        wanted = at_rest(axes[name], unit, temperature)
        wanted = wanted - at_rest(axes[name], unit, np.array([calibrated_at]))
        taken = ardupilot(values, 1, word, name[-1].upper(), temperature, calibrated_at)
        np.testing.assert_allclose(taken, wanted, atol=2e-7)


def test_one_range_holds_for_all_axes_of_a_sensor_and_ends_the_correction(axes) -> None:
    devices = {"gyro": 11, "acc": 12}
    values = loaded(bc.firmware_parameters(axes, "px4-params", devices=devices).text())
    assert (values["TC_G0_TMIN"], values["TC_A0_TMIN"]) == pytest.approx((15.0, 22.0), abs=1e-3)
    assert values["TC_A0_TMAX"] < 60.0
    ends = px4(values, "A0", 0, np.array([-40.0, 22.0001, 90.0]))
    assert ends[0] == pytest.approx(ends[1], abs=1e-6) and np.isfinite(ends).all()
    shared = loaded(bc.firmware_parameters(axes, "ardupilot-params").text())
    # Of gyroscope and accelerometer together.
    assert shared["INS_TCAL1_TMIN"] == pytest.approx(22.0, abs=1e-3)
    time, hot = warming(low=90.0, high=139.0)
    noise = 1e-4 * np.random.default_rng(8).standard_normal(len(time))
    apart = fitted("m/s^2", bias(hot) + noise, hot, time)
    with pytest.raises(bc.InputError):
        bc.firmware_parameters({"acc_x": axes["acc_x"], "acc_y": apart}, "ardupilot-params")


@pytest.mark.slow
def test_what_a_cubic_cannot_hold_is_projected_and_said() -> None:
    """A sensor that lags behind its thermometer: the nearest cubic, and what it leaves out."""
    random, (time, temperature) = np.random.default_rng(6), warming()
    behind = 8.0 * np.exp(-(time - time[0]) / 700) * (1 - np.exp(-(time - time[0]) / 200))
    values = bias(temperature) + 3e-4 * behind * np.cos(time / 300)
    values = values + 2e-5 * random.standard_normal(len(time))
    calibration = fitted("rad/s", values, temperature, time, "unknown(time)")
    made = bc.firmware_parameters({"gyro_x": calibration}, "ardupilot-params")
    polynomial = made.axes["gyro_x"]
    offset = polynomial.offsets.offset
    assert np.abs(offset - values).max() < 1e-4  # the richer model, as it was fitted
    own = np.polyval(np.polyfit(temperature - 35.0, offset, 3), temperature - 35.0)
    assert polynomial.rms == pytest.approx(np.sqrt(np.mean((offset - own) ** 2)), rel=1e-3)
    assert polynomial.rms > 10 * polynomial.offsets.uncertainty
    assert polynomial.expected_error > polynomial.rms
    assert f"{polynomial.rms:.3g}" in made.text()
    assert made.text().isascii()


@needs_installation
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["px4-params", "ardupilot-params"])
def test_a_corrected_log_has_the_error_that_was_promised(kind, tmp_path) -> None:
    """Log, calibration, parameters, another log: in it, later and cooling, the correction holds what it said."""
    random, noise = np.random.default_rng(7), {"gyro_y": 2e-4, "acc_z": 4e-3}
    still = {"gyro_y": 0.0, "acc_z": -9.80665}
    size = {"gyro_y": 1.0, "acc_z": 6.0}
    write = write_ulog if kind == "px4-params" else write_dataflash

    def made(name: str, time, temperature):
        unit = {
            n: still[n] + bias(temperature, size[n]) + noise[n] * random.standard_normal(len(time))
            for n in noise
        }
        return write(tmp_path / name, time, temperature, [unit]), unit

    suffix = ".ulg" if kind == "px4-params" else ".bin"
    time = 10.0 + np.arange(3600.0)
    # Heated and cooled, so that neither lag nor time stands for temperature.
    temperature = np.interp(time, [10, 1000, 2000, 2700, 3610], [18.0, 58.0, 22.0, 55.0, 20.0])
    log, _ = made(f"one{suffix}", time, temperature)
    for channel in noise:
        ran = run(
            *("calibrate", log, "--instrument", "still_sensor", "--columns", f"output={channel}"),
            *("--average", "10s", "--out", tmp_path / channel),
        )
        assert ran.status == 0, ran.err
    parameters = tmp_path / "x.params"
    calibrations = [tmp_path / channel / "calibration.nc" for channel in noise]
    ran = run("export", *calibrations, "--format", kind, "--out", parameters)
    assert ran.status == 0, ran.err
    values = loaded(parameters.read_text())
    promised = bc.firmware_parameters(
        {n: bc.compensator(bc.load(p)) for n, p in zip(noise, calibrations, strict=True)}, kind
    ).axes

    cooling = 55.0 - 30.0 * (1 - np.exp(-time / 2500))
    _, held_out = made(f"two{suffix}", time + 50_000.0, cooling)
    for name, (word, short, place) in {
        "gyro_y": ("GYR", "G0", 1),
        "acc_z": ("ACC", "A0", 2),
    }.items():
        if kind == "px4-params":
            left = held_out[name] - px4(values, short, place, cooling)
        else:
            left = held_out[name] - ardupilot(values, 1, word, name[-1].upper(), cooling, 30.0)
        free = not (kind == "px4-params" and name == "gyro_y")
        left = left - left.mean() if free else left  # the offset that is calibrated anew
        means = left.reshape(-1, 10).mean(axis=1)
        rms = float(np.sqrt(np.mean(means**2)))
        uncorrected = float(np.std(held_out[name]))
        assert rms == pytest.approx(promised[name].expected_error, rel=0.12), name
        assert rms < 0.2 * uncorrected
