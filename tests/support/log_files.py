"""Small logs of a sensor unit at rest, written as their formats are documented: what the tests of logs share.

A unit is a mapping from a channel, "gyro_x", to its values, (n,); channels that are not given read zero.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

AXES = ("x", "y", "z")
Unit = Mapping[str, np.ndarray]


def _of(unit: Unit, kind: str, rows: int) -> list[np.ndarray]:
    return [np.asarray(unit.get(f"{kind}_{axis}", np.zeros(rows))) for axis in AXES]


def write_ulog(
    path: Path,
    time: np.ndarray,
    temperature: np.ndarray,
    units: list[Unit],
    *,
    gyro_temperature: bool = True,
    devices: tuple[int, ...] = (3670026, 3670034),
) -> Path:
    """A PX4 ULog: sensor_gyro at `time`, s, and sensor_accel 2 ms later, one instance for each unit.

    PX4 user guide, "ULog file format": header, flag bits (B), formats (F), subscriptions (A), data (D).
    """

    def message(kind: str, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    fields = "uint64_t timestamp;uint32_t device_id;float temperature;float x;float y;float z;"
    parts = [
        b"ULog\x01\x12\x35\x01" + struct.pack("<Q", int(1e6 * time[0])),
        message("B", bytes(40)),
        *(message("F", f"{t}:{fields}".encode()) for t in ("sensor_gyro", "sensor_accel")),
    ]
    data: list[tuple[int, bytes]] = []
    for number, unit in enumerate(units):
        for topic, (name, kind, delay) in enumerate(
            (("sensor_gyro", "gyro", 0), ("sensor_accel", "acc", 2000))
        ):
            key = 2 * number + topic
            parts.append(message("A", struct.pack("<BH", number, key) + name.encode()))
            known = temperature if gyro_temperature or kind == "acc" else np.full(len(time), np.nan)
            values = _of(unit, kind, len(time))
            for i, t in enumerate(time):
                at = round(1e6 * t) + delay
                row = (known[i], *(v[i] for v in values))
                data.append(
                    (at, message("D", struct.pack("<HQI4f", key, at, devices[number], *row)))
                )
    path.write_bytes(b"".join(parts + [body for _, body in sorted(data, key=lambda d: d[0])]))
    return path


def write_ulog_topics(
    path: Path, time: np.ndarray, topics: Mapping[str, Mapping[str, np.ndarray]]
) -> Path:
    """A PX4 ULog with one instance of each topic, whose fields but timestamp and device_id are float."""

    def message(kind: str, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    parts = [
        b"ULog\x01\x12\x35\x01" + struct.pack("<Q", int(1e6 * time[0])),
        message("B", bytes(40)),
    ]
    for name, fields in topics.items():
        listed = "".join(f"float {field};" for field in fields)
        parts.append(
            message("F", f"{name}:uint64_t timestamp;uint32_t device_id;{listed}".encode())
        )
    for key, name in enumerate(topics):
        parts.append(message("A", struct.pack("<BH", 0, key) + name.encode()))
    for i, t in enumerate(time):
        for key, fields in enumerate(topics.values()):
            row = [float(values[i]) for values in fields.values()]
            packed = struct.pack(f"<HQI{len(row)}f", key, round(1e6 * t), 7 + key, *row)
            parts.append(message("D", packed))
    path.write_bytes(b"".join(parts))
    return path


def write_dataflash(
    path: Path,
    time: np.ndarray,
    temperature: np.ndarray,
    units: list[Unit],
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
            row = (
                round(1e6 * t),
                number,
                *(v[i] for v in own),
                0,
                0,
                temperature[i],
                1,
                1,
                400,
                400,
            )
            parts.append(b"\xa3\x95\x81" + struct.pack("<QBffffffIIfBBHH", *row))
    path.write_bytes(b"".join(parts))
    return path
