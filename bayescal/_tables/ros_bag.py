"""ROS bags, by rosbags: sensor_msgs/Imu and sensor_msgs/Temperature of ROS 1 (.bag) and 2 (.mcap, .db3).

Fields and units: ROS common_interfaces, sensor_msgs/msg/Imu.msg (angular_velocity in rad/s,
linear_acceleration in m/s²) and Temperature.msg (temperature in °C); the time is that of the header.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayescal._core.quoting import one_line
from bayescal._tables.recorded import ACCELERATION, AXES, RATE, Sensor, triad

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
        sensors.append(_sensor(np.array(rows[topic]), number, rows.get(near or "")))
        name = f"gyro_x{f'_{number}' if number else ''} and its like"
        notes.append(f"{name} are of the topic {topic}" + (f", temperature of {near}" * bool(near)))
    return sensors, notes


def _refuse_views(path: Path) -> None:
    """Refuse a data base in which something else than a table stands where messages do: a view may never end."""
    with closing(
        sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
    ) as base:
        told = base.execute(
            "SELECT name FROM sqlite_master WHERE type IN ('view', 'trigger') OR sql LIKE 'CREATE VIRTUAL%'"
        )
        names = [str(name) for (name,) in told]
    if names:
        raise ValueError(
            f"{one_line(names[0])} in it is no table of messages, as a recorder writes"
        )


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


def _sensor(rows: np.ndarray, number: int, temperature: list[tuple[float, ...]] | None) -> Sensor:
    rows = rows[np.argsort(rows[:, 0], kind="stable")]  # the order of the headers, not of arrival
    time, *values = rows.T
    channels = triad("gyro", RATE, values[:3], number) | triad(
        "acc", ACCELERATION, values[3:], number
    )
    if not temperature:
        return Sensor(time, channels)
    known = np.array(sorted(temperature))
    return Sensor(time, channels, known[:, 1], known[:, 0])
