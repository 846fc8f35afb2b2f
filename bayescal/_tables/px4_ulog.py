"""PX4's ULog, by pyulog: sensor_gyro, sensor_accel, sensor_mag and sensor_baro, uncorrected, in every instance.

Fields and units: PX4-Autopilot, msg/SensorGyro.msg, SensorAccel.msg, SensorMag.msg and SensorBaro.msg (timestamp in µs
since start; x, y, z in rad/s, m/s² and gauss in the board's axes; pressure in Pa, in logs of releases before 1.14 in
mbar; temperature in °C; device_id).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bayescal._tables.recorded import ACCELERATION, AXES, RATE, Sensor, triad

TOPICS = {
    "sensor_gyro": ("gyro", RATE),
    "sensor_accel": ("acc", ACCELERATION),
    "sensor_mag": ("mag", "gauss"),
    "sensor_baro": ("baro_pressure", "Pa"),
}
IN_MBAR = 2000.0  # a median pressure below this is one in mbar: in Pa, it would be that of 27 km


def read_ulog(path: Path) -> tuple[list[Sensor], list[str]]:
    """Sensors of a ULog, and what is odd about the log; raises whatever pyulog does."""
    from pyulog import ULog

    with path.open("rb") as file:
        log = ULog(file, list(TOPICS))
    topics = sorted(log.data_list, key=lambda d: (list(TOPICS).index(d.name), d.multi_id))
    found = [(topic, *_sensor(topic)) for topic in topics if len(topic.data["timestamp"])]
    notes = ["parts of it are damaged and were skipped"] * bool(log.file_corruption)
    if log.dropouts:
        longest = max(dropout.duration for dropout in log.dropouts) / 1000
        notes.append(
            f"{len(log.dropouts)} dropouts while it was logged, the longest of {longest:g} s"
        )
    return [_with_temperature(t, s, d, found, notes) for t, s, d in found], notes


def _sensor(topic: Any) -> tuple[Sensor, int]:
    """A topic's instance as a sensor with its own temperature, and the number of its device."""
    kind, unit = TOPICS[topic.name]
    if topic.name == "sensor_baro":
        pressure = np.asarray(topic.data["pressure"], float)
        name = f"{kind}_{topic.multi_id}" if topic.multi_id else kind
        channels = {name: (pressure, "mbar" if np.nanmedian(pressure) < IN_MBAR else unit)}
    else:
        channels = triad(kind, unit, (topic.data[axis] for axis in AXES), topic.multi_id)
    temperature = np.asarray(topic.data.get("temperature", np.nan), float)
    device = int(topic.data["device_id"][0]) if "device_id" in topic.data else 0
    return Sensor(
        time=np.asarray(topic.data["timestamp"], float) * 1e-6,
        channels=channels,
        temperature=temperature if np.isfinite(temperature).any() else None,
        device=str(device) if device else None,
    ), device


def _with_temperature(
    topic: Any, sensor: Sensor, device: int, all_of_them: list, notes: list[str]
) -> Sensor:
    """A sensor that logs no temperature takes that of the other sensor in its device."""
    if sensor.temperature is not None:
        return sensor
    for other_topic, other, other_device in all_of_them:
        same = device == other_device if device else topic.multi_id == other_topic.multi_id
        if same and other.temperature is not None:
            known = np.isfinite(other.temperature)
            notes.append(
                f"{topic.name} {topic.multi_id} logs no temperature; that of {other_topic.name} "
                f"{other_topic.multi_id}, of the same device, stands for it"
            )
            taken, at = other.temperature[known], other.time[known]
            return replace(sensor, temperature=taken, temperature_time=at)
    return sensor
