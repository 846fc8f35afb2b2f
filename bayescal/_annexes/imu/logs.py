"""What a log holds, whatever its format: sensors with channels, each sampled at times of its own.

ArduPilot's .bin (DataFlash), by pymavlink's DFReader: the messages IMU, with the temperature T. Fields and units:
ardupilot, libraries/AP_InertialSensor/LogStructure.h (TimeUS in µs since start, I the instance, GyrX…Z in rad/s,
AccX…Z in m/s², T in °C). Earlier versions log IMU, IMU2 and IMU3 in place of the instance.

PX4's ULog, by pyulog: sensor_gyro, sensor_accel, sensor_mag and sensor_baro, uncorrected, in every instance. Fields and
units: PX4-Autopilot, msg/SensorGyro.msg, SensorAccel.msg, SensorMag.msg and SensorBaro.msg (timestamp in µs since
start; x, y, z in rad/s, m/s² and gauss in the board's axes; pressure in Pa, in logs of releases before 1.14 in mbar;
temperature in °C; device_id).

ROS bags, by rosbags: sensor_msgs/Imu and sensor_msgs/Temperature of ROS 1 (.bag) and 2 (.mcap, .db3). Fields and units:
ROS common_interfaces, sensor_msgs/msg/Imu.msg (angular_velocity in rad/s, linear_acceleration in m/s²) and
Temperature.msg (temperature in °C); the time is that of the header.
"""

from __future__ import annotations

import importlib
import io
import re
import sqlite3
from collections.abc import Collection, Iterable
from contextlib import closing, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
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
        f"{kind}_{axis}{number}": (np.asarray(own, float), unit)
        for axis, own in zip(AXES, values, strict=True)
    }


def columns_of(
    sensors: Collection[Sensor], chosen: Collection[str], file: str
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the chosen channels as columns, with time, temperature and what they are of, and what was done to it.

    The rows are the samples of the chosen sensor that is sampled most slowly. Other sensors give their sample nearest
    in time, so that noise stays as it is; the temperature, where it was sampled at other times, is interpolated between
    its own. All channels are taken if `chosen` names none that the log has.

    Raises:
        InputError: the log has no channels, or no row has all that is asked for.
    """
    holder = {name: sensor for sensor in sensors for name in sensor.channels}
    if not holder:
        raise bc.InputError(f"{file!r} is a log without messages of a sensor that is read")
    headers = {f"{name} [{one.channels[name][1]}]": name for name, one in holder.items()}
    wanted = [headers.get(name, name) for name in dict.fromkeys(chosen)]
    wanted = [name for name in dict.fromkeys(wanted) if name in holder] or list(holder)
    used = list({id(holder[name]): holder[name] for name in wanted}.values())
    base = max(used, key=lambda sensor: _step(sensor.time))
    spans = [sensor.time for sensor in used]
    spans += [] if base.temperature_time is None else [base.temperature_time]
    low = max(t.min(initial=np.inf) for t in spans)
    high = min(t.max(initial=-np.inf) for t in spans)
    kept, notes = np.flatnonzero((base.time >= low) & (base.time <= high)), list[str]()
    if not len(kept):
        raise bc.InputError(
            f"{file!r}: the channels chosen and their temperature were not logged at one time: choose others, or log "
            "them together"
        )
    time = base.time[kept]
    columns: dict[str, np.ndarray] = {"time [s]": time}
    if base.temperature is not None and (known := base.temperature_time) is not None:
        columns["temperature [degC]"] = np.interp(time, known, base.temperature)
        notes.append(
            f"{file}: the temperature was sampled every {_step(known):.3g} s, and is "
            f"interpolated to the times of {wanted[0]} (every {_step(base.time):.3g} s)"
        )
    elif base.temperature is not None:
        columns["temperature [degC]"] = base.temperature[kept]
    if lost := len(base.time) - len(time):
        notes.append(f"{file}: {lost} samples left out: not all that was asked for was logged then")
    for name in wanted:
        sensor = holder[name]
        halfway = 0.5 * (sensor.time[1:] + sensor.time[:-1])  # from one sample to the next
        at = kept if sensor is base else np.searchsorted(halfway, time)
        values, unit = sensor.channels[name]
        columns[f"{name} [{unit}]"] = values[at]
    if len(used) > 1:
        notes.append(f"{file}: rows at the times of {next(n for n in wanted if holder[n] is base)}")
    if len(wanted) == 1:
        labels = {"axis": wanted[0], "device": base.device}
        columns |= {k: np.full(len(time), v, object) for k, v in labels.items() if v is not None}
    return columns, notes


def _step(time: np.ndarray) -> float:
    """The usual time between samples, s."""
    return float(np.median(np.diff(time))) if len(time) > 1 else np.inf


HEAD = b"\xa3\x95"  # every message begins so
MESSAGES = ("IMU", "IMU2", "IMU3")


def read_dataflash(path: Path) -> tuple[list[Sensor], list[str]]:
    """Read the sensors of a DataFlash log, and what is odd about it; raises ValueError, and whatever pymavlink does."""
    from pymavlink.DFReader import DFReader_binary

    class WithoutClock(DFReader_binary):
        def init_clock(self) -> None:
            """Leave the time of day, for which a log without GPS is read to its end; TimeUS is enough here."""

    with path.open("rb") as file:
        if file.read(2) != HEAD:
            raise ValueError("it does not begin with the bytes A3 95 of a DataFlash log")
    with WithoutClock(str(path)) as log:
        sensors = [s for place, name in enumerate(MESSAGES) for s in _of(log, name, place)]
        while log.recv_match(type=["PARM"], strict=True) is not None:
            pass  # the reader keeps the parameters
        corrected = [n for n in range(1, 4) if log.params.get(f"INS_TCAL{n}_ENABLE") == 1]
    return sensors, [
        f"INS_TCAL{n}_ENABLE was 1: IMU {n} was logged with its temperature correction, and what is found here is "
        "what that left"
        for n in corrected
    ]


def _of(log: Any, name: str, place: int) -> list[Sensor]:
    """Return the sensors that one kind of message holds, one for each instance."""
    if not log.counts[log.name_to_id.get(name, 0)]:
        return []
    fields, sensors = _fields(log, log.name_to_id[name]), []
    instance = fields.get("I", np.full(len(fields["TimeUS"]), place))
    for i in np.unique(instance):
        own = instance == i
        channels = {}
        for kind, prefix, unit in (("gyro", "Gyr", RATE), ("acc", "Acc", ACCELERATION)):
            channels |= triad(kind, unit, (fields[prefix + axis][own] for axis in "XYZ"), int(i))
        temperature = fields["T"][own].astype(float) if "T" in fields else None
        sensors.append(Sensor(fields["TimeUS"][own] * 1e-6, channels, temperature))
    return sensors


def _fields(log: Any, kind: int) -> dict[str, np.ndarray]:
    """All messages of a kind as arrays, (n,) each: taken from the file at once, not one by one."""
    layout = log.formats[kind]
    places = np.asarray(log.offsets[kind], np.int64)
    places = places[places + layout.len <= log.data_len]  # the last may be cut short
    # of a `struct` layout: "<QB64s" as Q, B, 64s
    codes = re.findall(r"\d*[a-zA-Z]", layout.msg_struct)
    kinds = [f"V{code[:-1]}" if code.endswith("s") else f"<{code}" for code in codes]
    row = np.dtype(list(zip(layout.columns, kinds, strict=True)))
    content = np.frombuffer(log.data_map, np.uint8)
    begin = len(HEAD) + 1
    taken = content[places[:, None] + np.arange(begin, begin + row.itemsize)]
    del content  # else the map of the file cannot be closed
    messages = taken.view(row)[:, 0]
    return {name: messages[name] for name in layout.columns}


TOPICS = {
    "sensor_gyro": ("gyro", RATE),
    "sensor_accel": ("acc", ACCELERATION),
    "sensor_mag": ("mag", "gauss"),
    "sensor_baro": ("baro_pressure", "Pa"),
}
IN_MBAR = 2000.0  # a median pressure below this is one in mbar: in Pa, it would be that of 27 km


def read_ulog(path: Path) -> tuple[list[Sensor], list[str]]:
    """Read the sensors of a ULog, and what is odd about the log; raises whatever pyulog does."""
    from pyulog import ULog

    with path.open("rb") as file:
        log = ULog(file, list(TOPICS))
    topics = sorted(log.data_list, key=lambda d: (list(TOPICS).index(d.name), d.multi_id))
    found = [(topic, *_topic_sensor(topic)) for topic in topics if len(topic.data["timestamp"])]
    notes = ["parts of it are damaged and were skipped"] * bool(log.file_corruption)
    if lost := [dropout.duration / 1000 for dropout in log.dropouts]:
        notes.append(f"{len(lost)} dropouts while it was logged, the longest of {max(lost):g} s")
    return [_with_temperature(t, s, d, found, notes) for t, s, d in found], notes


def _topic_sensor(topic: Any) -> tuple[Sensor, int]:
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


IMU, TEMPERATURE = "sensor_msgs/msg/Imu", "sensor_msgs/msg/Temperature"


def read_bag(path: Path) -> tuple[list[Sensor], list[str]]:
    """Sensors of a bag, one for each topic of IMU messages; raises whatever rosbags does."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if path.suffix.lower() == ".db3":
        _refuse_views(path)
    types = get_typestore(Stores.LATEST)  # where the bag does not hold its own
    with AnyReader([path], default_typestore=types) as bag:
        topics = {c.topic: c.msgtype for c in bag.connections}
        units = sorted(t for t, kind in topics.items() if kind == IMU)
        thermometers = sorted(t for t, kind in topics.items() if kind == TEMPERATURE)
        rows: dict[str, list[tuple[float, ...]]] = {t: [] for t in (*units, *thermometers)}
        wanted = [c for c in bag.connections if c.topic in rows]
        for connection, at, raw in bag.messages(wanted) if wanted else ():
            message: Any = bag.deserialize(raw, connection.msgtype)
            rows[connection.topic].append(_row(message, connection.msgtype, at))
    sensors, notes = [], []
    for number, topic in enumerate(t for t in units if rows[t]):
        near = max((t for t in thermometers if rows[t]), key=partial(_shared, topic), default=None)
        sensors.append(_bag_sensor(np.array(rows[topic]), number, rows.get(near or "")))
        name = f"gyro_x{f'_{number}' if number else ''} and its like"
        notes.append(f"{name} are of the topic {topic}" + (f", temperature of {near}" * bool(near)))
    return sensors, notes


def _refuse_views(path: Path) -> None:
    """Refuse a data base in which something else than a table stands where messages do: a view may never end."""
    uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    views = "SELECT name FROM sqlite_master WHERE type IN ('view', 'trigger') OR sql LIKE 'CREATE VIRTUAL%'"
    with closing(sqlite3.connect(uri, uri=True)) as base:
        for (name,) in base.execute(views):
            first = ws.one_line(str(name))
            raise ValueError(f"{first} in it is no table of messages, as a recorder writes")


def _shared(topic: str, other: str) -> int:
    """How many parts of their names two topics share."""
    return sum(a == b for a, b in zip(topic.split("/"), other.split("/"), strict=False))


def _row(message: Any, kind: str, at: int) -> tuple[float, ...]:
    """Time and values of one message; where its header has no time, the time at which it was logged."""
    stamp = message.header.stamp
    time = stamp.sec + stamp.nanosec * 1e-9 or at * 1e-9
    if kind == TEMPERATURE:
        return time, message.temperature
    vectors = (message.angular_velocity, message.linear_acceleration)
    return time, *(getattr(vector, axis) for vector in vectors for axis in AXES)


def _bag_sensor(
    rows: np.ndarray, number: int, temperature: list[tuple[float, ...]] | None
) -> Sensor:
    rows = rows[np.argsort(rows[:, 0], kind="stable")]  # the order of the headers, not of arrival
    time, *values = rows.T
    channels = triad("gyro", RATE, values[:3], number)
    channels |= triad("acc", ACCELERATION, values[3:], number)
    known = np.array(sorted(temperature)).T[::-1] if temperature else ()
    return Sensor(time, channels, *known)


# Suffix → what people call the format, the package that reads it, and how.
LOG_FORMATS = {
    ".ulg": ("PX4 ULog", "pyulog", read_ulog),
    ".bin": ("ArduPilot log", "pymavlink", read_dataflash),
    ".bag": ("ROS 1 bag", "rosbags", read_bag),
    ".mcap": ("ROS 2 bag", "rosbags", read_bag),
    ".db3": ("ROS 2 bag", "rosbags", read_bag),
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
        came = f"is a {title}, which the package {package} reads, and that is not installed"
        raise ws.unusable(file, came, "pip install 'bayescal[logs]'") from None
    printed = io.StringIO()  # libraries print; standard output is the command's own
    with ws.as_format(file, title), redirect_stdout(printed), redirect_stderr(printed):
        sensors, notes = read(path)
    lines = [x for x in printed.getvalue().splitlines() if "dfindexer" not in x.lower()]
    notes += [f"{package} says: {line[:200]}" for line in lines[:1]]
    columns, more = columns_of(sensors, chosen, file)
    notes = (*(f"{file}: {note}" for note in notes), *more)
    return ws.Table.of_columns(file, columns, place=lambda i: f"sample {i + 1}", notes=notes)
