"""Small logs of a sensor unit at rest, written as their formats are documented: what the tests of logs share.

A unit is a mapping from a channel, "gyro_x", to its values, (n,); channels that are not given read zero.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

AXES = ("x", "y", "z")
Unit = Mapping[str, np.ndarray]


def _of(unit: Unit, kind: str, rows: int) -> list[np.ndarray]:
    return [np.asarray(unit.get(f"{kind}_{axis}", np.zeros(rows))) for axis in AXES]


def _message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def _write_ulog(
    path: Path,
    fields: Mapping[str, Sequence[str]],
    streams: Sequence[tuple[str, int, int, np.ndarray, Sequence[np.ndarray]]],
) -> Path:
    """A PX4 ULog: header, flag bits (B), formats (F), subscriptions (A), data (D).

    PX4 user guide, "ULog file format".

    Args:
        fields: of each topic behind its time and device, all of them float.
        streams: topic, instance, device, times, µs, (n,), and the values of each field, (n,).
    """
    begun = int(streams[0][3][0])
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", begun), _message("B", bytes(40))]
    for topic, names in fields.items():
        listed = "".join(f"float {name};" for name in names)
        text = f"{topic}:uint64_t timestamp;uint32_t device_id;{listed}"
        parts.append(_message("F", text.encode()))
    data: list[tuple[int, bytes]] = []
    for key, (topic, instance, device, times, columns) in enumerate(streams):
        parts.append(_message("A", struct.pack("<BH", instance, key) + topic.encode()))
        for at, *row in zip(times.tolist(), *columns, strict=True):
            packed = struct.pack(f"<HQI{len(row)}f", key, at, device, *row)
            data.append((at, _message("D", packed)))
    path.write_bytes(b"".join(parts + [body for _, body in sorted(data, key=lambda d: d[0])]))
    return path


def _microseconds(time: np.ndarray) -> np.ndarray:
    return np.rint(1e6 * time).astype(int)


def write_ulog(
    path: Path,
    time: np.ndarray,
    temperature: np.ndarray,
    units: list[Unit],
    *,
    gyro_temperature: bool = True,
    devices: tuple[int, ...] = (3670026, 3670034),
) -> Path:
    """A PX4 ULog: sensor_gyro at `time`, s, and sensor_accel 2 ms later, one instance for each unit."""
    rows, streams = len(time), []
    for number, unit in enumerate(units):
        for topic, kind, delay in (("sensor_gyro", "gyro", 0), ("sensor_accel", "acc", 2000)):
            known = temperature if gyro_temperature or kind == "acc" else np.full(rows, np.nan)
            columns = (known, *_of(unit, kind, rows))
            times = _microseconds(time) + delay
            streams.append((topic, number, devices[number], times, columns))
    fields = ("temperature", *AXES)
    return _write_ulog(path, {"sensor_gyro": fields, "sensor_accel": fields}, streams)


def write_ulog_topics(
    path: Path, time: np.ndarray, topics: Mapping[str, Mapping[str, np.ndarray]]
) -> Path:
    """A PX4 ULog with one instance of each topic, whose fields but timestamp and device_id are float."""
    times = _microseconds(time)
    streams = [
        (topic, 0, 7 + key, times, [*columns.values()])
        for key, (topic, columns) in enumerate(topics.items())
    ]
    return _write_ulog(path, {topic: [*columns] for topic, columns in topics.items()}, streams)


def write_dataflash(
    path: Path, time: np.ndarray, temperature: np.ndarray, units: list[Unit]
) -> Path:
    """An ArduPilot .bin: IMU messages of each unit at `time`, s.

    ardupilot, libraries/AP_Logger/LogStructure.h (FMT), libraries/AP_InertialSensor/LogStructure.h (IMU).
    """

    def described(kind: int, name: str, layout: str, columns: str) -> bytes:
        sizes = {"Q": 8, "B": 1, "f": 4, "I": 4, "H": 2, "N": 16, "n": 4, "Z": 64}
        length = 3 + sum(sizes[c] for c in layout)
        body = (kind, length, name.encode(), layout.encode(), columns.encode())
        return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", *body)

    columns = "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"
    parts = [
        described(0x80, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns"),
        described(0x81, "IMU", "QBffffffIIfBBHH", columns),
    ]
    values = [[*_of(u, "gyro", len(time)), *_of(u, "acc", len(time))] for u in units]
    for i, t in enumerate(time):
        for number, own in enumerate(values):
            row = (round(1e6 * t), number, *(v[i] for v in own), 0, 0, temperature[i], 1, 1)
            row = (*row, 400, 400)
            parts.append(b"\xa3\x95\x81" + struct.pack("<QBffffffIIfBBHH", *row))
    path.write_bytes(b"".join(parts))
    return path
