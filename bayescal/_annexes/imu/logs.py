"""Logs of inertial sensors in their formats: sensors with channels, each sampled at its own times.

ArduPilot's .bin (DataFlash), by pymavlink's DFReader: the messages IMU, with the temperature T. Fields and units:
ardupilot, libraries/AP_InertialSensor/LogStructure.h (TimeUS in µs since start, I the instance, GyrX…Z in rad/s,
AccX…Z in m/s², T in °C).

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

RATE, ACCELERATION = "rad/s", "m/s^2"  # units in which all these formats log
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Sensor:
    """Channels of one sensor that are sampled together."""

    time: np.ndarray  # of the samples, s, (n,)
    # name, such as "gyro_x", and "gyro_x_1" of a second one → values, (n,), and their unit
    channels: dict[str, tuple[np.ndarray, str]]
    temperature: np.ndarray | None = None  # °C, (m,); None where the log has none for this sensor
    # when the temperature was sampled, s, (m,); None where with the channels
    temperature_time: np.ndarray | None = None
    device: str | None = None  # identifier of the device, as the log states it


def triad(
    kind: str, unit: str, values: Iterable[np.ndarray], instance: int
) -> dict[str, tuple[np.ndarray, str]]:
    """Return the channels of three axes, of the `instance`-th sensor of its kind ("gyro", "acc" or "mag"), from 0."""
    number = f"_{instance}" if instance else ""
    return {
        f"{kind}_{axis}{number}": (np.asarray(samples, float), unit)
        for axis, samples in zip(AXES, values, strict=True)
    }


def columns_of(
    sensors: Collection[Sensor], chosen: Collection[str], file: str
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the chosen channels as columns on one time base with temperature and labels, and notes on the conversion.

    The rows are the samples of the chosen sensor that is sampled most slowly. Other sensors give their sample nearest
    in time, so that noise stays as it is; the temperature, where it was sampled at other times, is interpolated between
    its own. All channels are taken if `chosen` names none that the log has.

    Raises:
        InputError: the log has no channels, or no row has all that is asked for.
    """
    holder = {name: sensor for sensor in sensors for name in sensor.channels}
    if not holder:
        raise bc.InputError(f"{file!r} is a log without messages of a sensor that is read")
    headers = {f"{name} [{source.channels[name][1]}]": name for name, source in holder.items()}
    names = [headers.get(name, name) for name in dict.fromkeys(chosen)]
    names = [name for name in dict.fromkeys(names) if name in holder] or list(holder)
    used = list({id(holder[name]): holder[name] for name in names}.values())
    base = max(used, key=lambda sensor: _median_step(sensor.time))
    spans = [sensor.time for sensor in used]
    spans += [] if base.temperature_time is None else [base.temperature_time]
    low = max(t.min(initial=np.inf) for t in spans)
    high = min(t.max(initial=-np.inf) for t in spans)
    rows, notes = np.flatnonzero((base.time >= low) & (base.time <= high)), list[str]()
    time = base.time[rows]
    columns: dict[str, np.ndarray] = {"time [s]": time}
    if base.temperature is not None and (sampled_at := base.temperature_time) is not None:
        columns["temperature [degC]"] = np.interp(time, sampled_at, base.temperature)
        notes.append(
            f"{file}: the temperature was sampled every {_median_step(sampled_at):.3g} s, and is "
            f"interpolated to the times of {names[0]} (every {_median_step(base.time):.3g} s)"
        )
    elif base.temperature is not None:
        columns["temperature [degC]"] = base.temperature[rows]
    if lost := len(base.time) - len(time):
        notes.append(f"{file}: {lost} samples left out: not all that was asked for was logged then")
    for name in names:
        sensor = holder[name]
        halfway = 0.5 * (sensor.time[1:] + sensor.time[:-1])  # from one sample to the next
        at = rows if sensor is base else np.searchsorted(halfway, time)
        values, unit = sensor.channels[name]
        columns[f"{name} [{unit}]"] = values[at]
    if len(names) == 1:
        labels = {"axis": names[0], "device": base.device}
        columns |= {k: np.full(len(time), v, object) for k, v in labels.items() if v is not None}
    return columns, notes


def _median_step(time: np.ndarray) -> float:
    """Return the median time between samples, s."""
    return float(np.median(np.diff(time))) if len(time) > 1 else np.inf


HEAD = b"\xa3\x95"  # every message begins so


def read_dataflash(path: Path) -> tuple[list[Sensor], list[str]]:
    """Read the sensors of a DataFlash log, and notes on it; raises ValueError and any exception of pymavlink."""
    from pymavlink.DFReader import DFReader_binary

    class WithoutClock(DFReader_binary):
        def init_clock(self) -> None:
            """Skip the time of day, for which a log without GPS is read to its end; TimeUS suffices."""

    with path.open("rb") as file:
        if file.read(2) != HEAD:
            raise ValueError("it does not begin with the bytes A3 95 of a DataFlash log")
    sensors = []
    with WithoutClock(str(path)) as log:
        messages = _read_messages(log, "IMU")
        while log.recv_match(type=["PARM"], strict=True) is not None:
            pass  # the reader keeps the parameters
        corrected = [n for n in range(1, 4) if log.params.get(f"INS_TCAL{n}_ENABLE") == 1]
    for i in np.unique(messages["I"]):
        samples = messages[messages["I"] == i]
        channels = triad("gyro", RATE, (samples[f"Gyr{axis}"] for axis in "XYZ"), int(i))
        channels |= triad("acc", ACCELERATION, (samples[f"Acc{axis}"] for axis in "XYZ"), int(i))
        sensors.append(Sensor(samples["TimeUS"] * 1e-6, channels, samples["T"].astype(float)))
    return sensors, [
        f"INS_TCAL{n}_ENABLE was 1: IMU {n} was logged with its temperature correction on: the effects found are those "
        "that it left"
        for n in corrected
    ]


def _read_messages(log: Any, name: str) -> np.ndarray:
    """Read all messages of a kind at once, as a structured array (n,); raise KeyError if the log describes none."""
    kind = log.name_to_id[name]
    layout = log.formats[kind]
    places = np.asarray(log.offsets[kind], np.int64)
    places = places[places + layout.len <= log.data_len]  # the last may be cut short
    # of a `struct` layout: "<QB64s" as Q, B, 64s
    codes = re.findall(r"\d*[a-zA-Z]", layout.msg_struct)
    dtypes = [f"V{code[:-1]}" if code.endswith("s") else f"<{code}" for code in codes]
    row = np.dtype(list(zip(layout.columns, dtypes, strict=True)))
    content = np.frombuffer(log.data_map, np.uint8)
    begin = len(HEAD) + 1
    raw_bytes = content[places[:, None] + np.arange(begin, begin + row.itemsize)]
    del content  # else the map of the file cannot be closed
    return raw_bytes.view(row)[:, 0]


TOPICS = {
    "sensor_gyro": ("gyro", RATE),
    "sensor_accel": ("acc", ACCELERATION),
    "sensor_mag": ("mag", "gauss"),
}


def read_ulog(path: Path) -> tuple[list[Sensor], list[str]]:
    """Read the sensors of a ULog, and notes on it; raises any exception of pyulog."""
    from pyulog import ULog

    with path.open("rb") as file:
        log = ULog(file, list(TOPICS))
    topics = sorted(log.data_list, key=lambda d: (list(TOPICS).index(d.name), d.multi_id))
    sensors = {
        f"{topic.name} {topic.multi_id}": _topic_sensor(topic)
        for topic in topics
        if len(topic.data["timestamp"])
    }
    notes = ["parts of it are damaged and were skipped"] * bool(log.file_corruption)
    if lost := [dropout.duration / 1000 for dropout in log.dropouts]:
        notes.append(f"{len(lost)} dropouts while it was logged, the longest of {max(lost):g} s")
    return [_with_temperature(name, sensors, notes) for name in sensors], notes


def _topic_sensor(topic: Any) -> Sensor:
    """Return an instance of a topic as a sensor with its own temperature."""
    kind, unit = TOPICS[topic.name]
    temperature = np.asarray(topic.data.get("temperature", np.nan), float)
    device = int(topic.data["device_id"][0]) if "device_id" in topic.data else 0
    return Sensor(
        time=np.asarray(topic.data["timestamp"], float) * 1e-6,
        channels=triad(kind, unit, (topic.data[axis] for axis in AXES), topic.multi_id),
        temperature=temperature if np.isfinite(temperature).any() else None,
        device=str(device) if device else None,
    )


def _with_temperature(name: str, sensors: Mapping[str, Sensor], notes: list[str]) -> Sensor:
    """Return a sensor with the temperature of another sensor in its device where it logs none."""
    sensor = sensors[name]
    if sensor.temperature is not None or sensor.device is None:
        return sensor
    for other_name, other in sensors.items():
        if other.device == sensor.device and other.temperature is not None:
            is_finite = np.isfinite(other.temperature)
            notes.append(
                f"{name} logs no temperature; that of {other_name}, of the same device, stands for it"
            )
            values, at = other.temperature[is_finite], other.time[is_finite]
            return replace(sensor, temperature=values, temperature_time=at)
    return sensor


# Suffix → title of the format, the package that reads it, the reader.
LOG_FORMATS = {
    ".ulg": ("PX4 ULog", "pyulog", read_ulog),
    ".bin": ("ArduPilot log", "pymavlink", read_dataflash),
}


def open_log(path: Path, file: str, chosen: Collection[str]) -> ws.Table:
    """Open the chosen channels of a log; all, if `chosen` names none that it has.

    Raises:
        InputError: the package that reads it is not installed, or the file is not what its suffix says.
    """
    title, package, read = LOG_FORMATS[path.suffix.lower()]
    try:
        importlib.import_module(package)
    except ModuleNotFoundError:
        reason = f"is a {title}, which the package {package} reads, and that is not installed"
        raise ws.unusable(file, reason, "pip install 'bayescal[logs]'") from None
    printed = io.StringIO()  # libraries print; standard output is the command's own
    with ws.as_format(file, title), redirect_stdout(printed), redirect_stderr(printed):
        sensors, notes = read(path)
    lines = [x for x in printed.getvalue().splitlines() if "dfindexer" not in x.lower()]
    notes += [f"{package} says: {line[:200]}" for line in lines[:1]]
    columns, column_notes = columns_of(sensors, chosen, file)
    notes = (*(f"{file}: {note}" for note in notes), *column_notes)
    return ws.Table.of_columns(file, columns, place=lambda i: f"sample {i + 1}", notes=notes)
