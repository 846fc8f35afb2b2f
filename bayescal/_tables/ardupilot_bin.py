"""ArduPilot's .bin (DataFlash), by pymavlink's DFReader: the messages IMU, with the temperature T.

Fields and units: ardupilot, libraries/AP_InertialSensor/LogStructure.h (TimeUS in µs since start, I
the instance, GyrX…Z in rad/s, AccX…Z in m/s², T in °C). Earlier versions log IMU, IMU2 and IMU3 in
place of the instance.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from bayescal._tables.recorded import ACCELERATION, RATE, Sensor, triad

HEAD = b"\xa3\x95"  # every message begins so
MESSAGES = ("IMU", "IMU2", "IMU3")


def read_dataflash(path: Path) -> tuple[list[Sensor], list[str]]:
    """Sensors of a DataFlash log, and what is odd about it.

    Raises:
        ValueError: it does not begin as such a log does.
        Exception: whatever pymavlink raises.
    """
    from pymavlink.DFReader import DFReader_binary

    class WithoutClock(DFReader_binary):
        def init_clock(self) -> None:
            """Leave the time of day, for which a log without GPS is read to its end; TimeUS is enough here."""

    with path.open("rb") as file:
        if file.read(2) != HEAD:
            raise ValueError("it does not begin with the bytes A3 95 of a DataFlash log")
    with WithoutClock(str(path)) as log:
        sensors = [
            sensor for place, name in enumerate(MESSAGES) for sensor in _of(log, name, place)
        ]
        while log.recv_match(type=["PARM"], strict=True) is not None:
            pass  # the reader keeps the parameters
        corrected = [n for n in range(1, 4) if log.params.get(f"INS_TCAL{n}_ENABLE") == 1]
        notes = [
            f"INS_TCAL{n}_ENABLE was 1: IMU {n} was logged with its temperature correction, and what is "
            "found here is what that left"
            for n in corrected
        ]
    return sensors, notes


def _of(log: Any, name: str, place: int) -> list[Sensor]:
    """The sensors that one kind of message holds, one for each instance."""
    if not log.counts[log.name_to_id.get(name, 0)]:
        return []
    fields = _fields(log, log.name_to_id[name])
    instance = fields.get("I", np.full(len(fields["TimeUS"]), place))
    return [_sensor(fields, instance == i, int(i)) for i in np.unique(instance)]


def _sensor(fields: dict[str, np.ndarray], own: np.ndarray, instance: int) -> Sensor:
    channels = {}
    for kind, prefix, unit in (("gyro", "Gyr", RATE), ("acc", "Acc", ACCELERATION)):
        channels |= triad(kind, unit, (fields[prefix + axis][own] for axis in "XYZ"), instance)
    temperature = fields["T"][own].astype(float) if "T" in fields else None
    return Sensor(fields["TimeUS"][own] * 1e-6, channels, temperature)


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
