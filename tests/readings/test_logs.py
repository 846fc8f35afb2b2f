"""Logs of PX4 and ArduPilot are read: channels, units, times, temperature, and what is said of them."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import still_sensor
from tests.support.log_files import write_dataflash, write_ulog, write_ulog_topics

for package in ("pyulog", "pymavlink"):
    pytest.importorskip(package, reason="pip install 'bayescal[logs]'")

ROWS = 60
TIME = 5.0 + 0.1 * np.arange(ROWS)
TEMPERATURE = 20.0 + np.linspace(0.0, 30.0, ROWS) ** 1.3
UNITS = [
    {"gyro_x": 0.01 + 1e-4 * TEMPERATURE, "gyro_z": np.sin(TIME), "acc_z": -9.8 + 1e-3 * TIME},
    {"gyro_x": 0.02 - 2e-4 * TEMPERATURE, "acc_y": 0.1 * np.cos(TIME)},
]
INSTRUMENT = still_sensor.INSTRUMENT
DEGREES = np.degrees(1.0)
WRITERS = {"t.ulg": write_ulog, "t.bin": write_dataflash}


@pytest.fixture(params=list(WRITERS))
def log(request, tmp_path):
    return WRITERS[request.param](tmp_path / request.param, TIME, TEMPERATURE, UNITS)


def test_a_gyroscope_comes_in_degrees_per_second_at_its_own_times(log) -> None:
    readings = bc.read(log, INSTRUMENT, columns={"output": "gyro_x"})
    assert readings.unit("output") == "deg/s" and len(readings) == ROWS
    np.testing.assert_allclose(readings["output"], DEGREES * UNITS[0]["gyro_x"], rtol=3e-7)
    np.testing.assert_allclose(readings["time"], TIME, rtol=0, atol=1e-6)
    assert set(readings["axis"]) == {"gyro_x"}
    assert "gyro_z" not in readings.columns  # what is not asked for is no covariate


def test_an_accelerometer_comes_in_local_g(log) -> None:
    columns = {"output": "acc_z"}
    readings = bc.read(log, INSTRUMENT, columns=columns, local_gravity=9.81)
    assert readings.unit("output") == "ug"
    np.testing.assert_allclose(readings["output"], UNITS[0]["acc_z"] / 9.81e-6, rtol=3e-7)


def test_the_temperature_is_the_sensor_s(log) -> None:
    readings = bc.read(log, INSTRUMENT, columns={"output": "gyro_x"})
    np.testing.assert_allclose(readings["temperature"], TEMPERATURE, rtol=1e-6)


def test_a_log_cut_short_or_another_file_is_refused(log, put) -> None:
    junk = put(b"time,temperature\n1,2\n" * 40, f"junk{log.suffix}")
    with pytest.raises(bc.InputError):
        bc.read(junk, INSTRUMENT, columns={"output": "gyro_x"})
    half = put(log.read_bytes()[: log.stat().st_size // 2], f"half{log.suffix}")
    try:
        readings = bc.read(half, INSTRUMENT, columns={"output": "gyro_x"})
    except bc.InputError:
        return
    assert 0 < len(readings) < ROWS  # or what is left of it is read, as its library does


def test_px4_names_the_device_and_borrows_its_temperature(tmp_path) -> None:
    log = write_ulog(tmp_path / "t.ulg", TIME, TEMPERATURE, UNITS, gyro_temperature=False)
    readings = bc.read(log, INSTRUMENT, columns={"output": "gyro_x_1"})
    assert set(readings["device"]) == {"3670034"}
    # The accelerometer's first sample is 2 ms late, so the gyroscope's first has no temperature.
    assert len(readings) == ROWS - 1
    wanted = np.interp(TIME[1:], TIME + 0.002, TEMPERATURE)
    np.testing.assert_allclose(readings["temperature"], wanted, rtol=1e-6)


def test_px4_magnetometers_are_read_in_their_unit(tmp_path) -> None:
    field, still = 0.4 + 1e-4 * TEMPERATURE, np.zeros(ROWS)
    topics = {"sensor_mag": {"x": field, "y": still, "z": -field, "temperature": TEMPERATURE}}
    log = write_ulog_topics(tmp_path / "t.ulg", TIME, topics)
    magnetic = bc.read(log, INSTRUMENT, columns={"output": "mag_z"})
    assert magnetic.unit("output") == "uT"
    np.testing.assert_allclose(magnetic["output"], -100.0 * field, rtol=3e-7)
