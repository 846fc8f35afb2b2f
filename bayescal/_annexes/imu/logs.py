"""Readers of ArduPilot's and PX4's logs of inertial sensors, each of which has channels and its own sampling times.

ArduPilot's .bin (DataFlash), by pymavlink's DFReader: messages IMU; fields and units (libraries/
AP_InertialSensor/LogStructure.h): TimeUS in µs since start, I the instance, GyrX…Z in rad/s, AccX…Z in m/s², T in °C.

PX4's ULog, by pyulog: sensor_gyro, sensor_accel and sensor_mag, uncorrected, in every instance. Fields and units:
PX4-Autopilot, msg/SensorGyro.msg, SensorAccel.msg and SensorMag.msg (timestamp in µs since start; x, y, z in rad/s,
m/s² and gauss in the board's axes; temperature in °C; device_id).
"""

from __future__ import annotations

import importlib
import io
import re
from collections.abc import Collection, Iterable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal import workshop as ws

RATE_UNIT, FORCE_UNIT = "rad/s", "m/s^2"  # in all these formats
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Sensor:
    """Channels of one sensor, which are sampled simultaneously, and its temperature."""

    time: np.ndarray  # of the samples, s, (n,)
    # name ("gyro_x", of a second gyroscope "gyro_x_1") → values (n,) and their unit
    channels: dict[str, tuple[np.ndarray, str]]
    temperature: np.ndarray | None = None  # °C, (m,); None if the log has none for this sensor
    # sampling times of the temperature, s, (m,); None if those of the channels
    temperature_time: np.ndarray | None = None
    device: str | None = None  # identifier of the device in the log


def build_channels(
    kind: str, unit: str, values: Iterable[np.ndarray], instance: int
) -> dict[str, tuple[np.ndarray, str]]:
    """Build the channels of three axes of sensor `instance` (from 0) of a kind ("gyro", "acc" or "mag")."""
    number = f"_{instance}" if instance else ""
    return {
        f"{kind}_{axis}{number}": (np.asarray(samples, float), unit)
        for axis, samples in zip(AXES, values, strict=True)
    }


def align_channels(
    sensors: Collection[Sensor], channel_names: Collection[str], file: str
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Align channels on one time base; return columns with temperature and labels, and notes on the conversion.

    Rows are the samples of the sensor with the lowest sampling rate. The other sensors contribute the sample nearest in
    time, which preserves their noise; a temperature with other sampling times is interpolated. `channel_names` are
    names of channels, or of their columns; all channels are read if none of them is in the log.

    Raises:
        InputError: the log has no channels.
    """
    sensor_by_channel = {name: sensor for sensor in sensors for name in sensor.channels}
    if not sensor_by_channel:
        raise bc.InputError(f"the log {file!r} has no messages of a supported sensor")
    headers = {f"{n} [{sensor.channels[n][1]}]": n for n, sensor in sensor_by_channel.items()}
    names = dict.fromkeys(headers.get(name, name) for name in channel_names)
    names = [name for name in names if name in sensor_by_channel] or list(sensor_by_channel)
    read_sensors = list({id(s): s for s in (sensor_by_channel[n] for n in names)}.values())
    slowest = max(read_sensors, key=lambda sensor: _compute_median_step(sensor.time))
    times = [sensor.time for sensor in read_sensors]
    times += [] if slowest.temperature_time is None else [slowest.temperature_time]
    start = max(t.min(initial=np.inf) for t in times)
    end = min(t.max(initial=-np.inf) for t in times)
    rows, notes = np.flatnonzero((slowest.time >= start) & (slowest.time <= end)), list[str]()
    time = slowest.time[rows]
    columns: dict[str, np.ndarray] = {"time [s]": time}
    if slowest.temperature is not None and (t := slowest.temperature_time) is not None:
        columns["temperature [degC]"] = np.interp(time, t, slowest.temperature)
        notes.append(
            f"{file}: the temperature was sampled every {_compute_median_step(t):.3g} s, and is interpolated to the "
            f"times of {names[0]} (every {_compute_median_step(slowest.time):.3g} s)"
        )
    elif slowest.temperature is not None:
        columns["temperature [degC]"] = slowest.temperature[rows]
    if n_omitted := len(slowest.time) - len(time):
        notes.append(f"{file}: {n_omitted} samples omitted, when not all channels were logged")
    for name in names:
        sensor = sensor_by_channel[name]
        midpoints = 0.5 * (sensor.time[1:] + sensor.time[:-1])
        nearest_rows = rows if sensor is slowest else np.searchsorted(midpoints, time)
        values, unit = sensor.channels[name]
        columns[f"{name} [{unit}]"] = values[nearest_rows]
    if len(names) == 1:
        labels = {"axis": names[0], "device": slowest.device}
        columns |= {k: np.full(len(time), v, object) for k, v in labels.items() if v is not None}
    return columns, notes


def _compute_median_step(time: np.ndarray) -> float:
    """Return the median time between samples, s."""
    return float(np.median(np.diff(time))) if len(time) > 1 else np.inf


MESSAGE_HEADER = b"\xa3\x95"  # first bytes of each DataFlash message


def read_dataflash(path: Path) -> tuple[list[Sensor], list[str]]:
    """Return the sensors of a DataFlash log, and notes on it; raise ValueError, or any exception of pymavlink."""
    from pymavlink.DFReader import DFReader_binary

    class ClocklessReader(DFReader_binary):
        def init_clock(self) -> None:
            """Skip the search for the time of day, which reads a log without GPS to its end; TimeUS suffices."""

    with path.open("rb") as file:
        if file.read(2) != MESSAGE_HEADER:
            raise ValueError("it does not begin with the bytes A3 95 of a DataFlash log")
    sensors = []
    with ClocklessReader(str(path)) as log:
        messages = _read_messages(log, "IMU")
        while log.recv_match(type=["PARM"], strict=True) is not None:
            pass  # the reader stores the parameters
        corrected_imus = [n for n in range(1, 4) if log.params.get(f"INS_TCAL{n}_ENABLE") == 1]
    for i in np.unique(messages["I"]):
        samples = messages[messages["I"] == i]
        channels = build_channels("gyro", RATE_UNIT, (samples[f"Gyr{a}"] for a in "XYZ"), int(i))
        channels |= build_channels("acc", FORCE_UNIT, (samples[f"Acc{a}"] for a in "XYZ"), int(i))
        sensors.append(Sensor(samples["TimeUS"] * 1e-6, channels, samples["T"].astype(float)))
    return sensors, [
        f"INS_TCAL{n}_ENABLE was 1: IMU {n} was logged with its temperature correction on; effects found are those "
        "that remain after it"
        for n in corrected_imus
    ]


def _read_messages(log: Any, name: str) -> np.ndarray:
    """Return all messages called `name` as a structured array (n,); raise KeyError if the log does not define them."""
    message_id = log.name_to_id[name]
    layout = log.formats[message_id]
    offsets = np.asarray(log.offsets[message_id], np.int64)
    offsets = offsets[offsets + layout.len <= log.data_len]  # the last message may be truncated
    # format characters of a `struct` layout: "<QB64s" as Q, B, 64s
    codes = re.findall(r"\d*[a-zA-Z]", layout.msg_struct)
    dtypes = [f"V{code[:-1]}" if code.endswith("s") else f"<{code}" for code in codes]
    row_type = np.dtype(list(zip(layout.columns, dtypes, strict=True)))
    content = np.frombuffer(log.data_map, np.uint8)
    header_size = len(MESSAGE_HEADER) + 1
    raw_bytes = content[offsets[:, None] + np.arange(header_size, header_size + row_type.itemsize)]
    del content  # else the map of the file cannot be closed
    return raw_bytes.view(row_type)[:, 0]


TOPICS = {
    "sensor_gyro": ("gyro", RATE_UNIT),
    "sensor_accel": ("acc", FORCE_UNIT),
    "sensor_mag": ("mag", "gauss"),
}


def read_ulog(path: Path) -> tuple[list[Sensor], list[str]]:
    """Return the sensors of a ULog, and notes on it; raise any exception of pyulog."""
    from pyulog import ULog

    with path.open("rb") as file:
        log = ULog(file, list(TOPICS))
    topics = sorted(log.data_list, key=lambda d: (list(TOPICS).index(d.name), d.multi_id))
    sensors = {
        f"{topic.name} {topic.multi_id}": _build_sensor(topic)
        for topic in topics
        if len(topic.data["timestamp"])
    }
    notes = ["damaged parts of the log were skipped"] * bool(log.file_corruption)
    if dropouts := [dropout.duration / 1000 for dropout in log.dropouts]:
        notes.append(f"{len(dropouts)} dropouts in the log, the longest of {max(dropouts):g} s")
    return [_add_temperature(name, sensors, notes) for name in sensors], notes


def _build_sensor(topic: Any) -> Sensor:
    """Build a sensor from an instance of a topic, with the topic's temperature if it has one."""
    kind, unit = TOPICS[topic.name]
    temperature = np.asarray(topic.data.get("temperature", np.nan), float)
    device = int(topic.data["device_id"][0]) if "device_id" in topic.data else 0
    return Sensor(
        time=np.asarray(topic.data["timestamp"], float) * 1e-6,
        channels=build_channels(kind, unit, (topic.data[axis] for axis in AXES), topic.multi_id),
        temperature=temperature if np.isfinite(temperature).any() else None,
        device=str(device) if device else None,
    )


def _add_temperature(name: str, sensors: Mapping[str, Sensor], notes: list[str]) -> Sensor:
    """Add the temperature of another sensor on the same device to a sensor that logs none; return the sensor."""
    sensor = sensors[name]
    if sensor.temperature is not None or sensor.device is None:
        return sensor
    for peer, peer_sensor in sensors.items():
        if peer_sensor.device == sensor.device and peer_sensor.temperature is not None:
            is_finite = np.isfinite(peer_sensor.temperature)
            notes.append(f"{name} logs no temperature; that of {peer}, on the same device, is used")
            temperature, time = peer_sensor.temperature[is_finite], peer_sensor.time[is_finite]
            return replace(sensor, temperature=temperature, temperature_time=time)
    return sensor


# Suffix → title of the format, the package that reads it, the reader.
LOG_FORMATS = {
    ".ulg": ("PX4 ULog", "pyulog", read_ulog),
    ".bin": ("ArduPilot log", "pymavlink", read_dataflash),
}


def open_log(path: Path, file: str, channel_names: Collection[str]) -> ws.Table:
    """Read the named channels of a log as a table, or all channels if none of them is in the log.

    Raises:
        InputError: the package that reads the format is not installed, or the file is not in its suffix's format.
    """
    title, package, read_log = LOG_FORMATS[path.suffix.lower()]
    try:
        importlib.import_module(package)
    except ModuleNotFoundError:
        reason = f"is a {title}: install the package {package} to read it"
        raise ws.unusable(file, reason, "pip install 'bayescal[logs]'") from None
    output = io.StringIO()  # libraries print; standard output is the command's own
    with ws.as_format(file, title), redirect_stdout(output), redirect_stderr(output):
        sensors, notes = read_log(path)
    lines = [x for x in output.getvalue().splitlines() if "dfindexer" not in x.lower()]
    notes += [f"{package} says: {line[:200]}" for line in lines[:1]]
    columns, column_notes = align_channels(sensors, channel_names, file)
    notes = (*(f"{file}: {note}" for note in notes), *column_notes)
    return ws.Table.from_columns(file, columns, place=lambda i: f"sample {i + 1}", notes=notes)
