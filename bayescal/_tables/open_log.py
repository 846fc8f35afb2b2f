"""A log by its suffix: which library reads it, and what is said where that fails."""

from __future__ import annotations

import contextlib
import importlib
import io
from collections.abc import Callable, Collection
from pathlib import Path
from typing import NamedTuple

from bayescal._core.atomic_file import sha256_of
from bayescal._core.errors import InputError
from bayescal._tables.ardupilot_bin import read_dataflash
from bayescal._tables.px4_ulog import read_ulog
from bayescal._tables.raw_table import Header, Table, loads, unreadable
from bayescal._tables.recorded import Sensor, columns_of
from bayescal._tables.ros_bag import read_bag


class LogFormat(NamedTuple):
    """A format: what people call it, the package that reads it, and how."""

    title: str
    package: str
    read: Callable[[Path], tuple[list[Sensor], list[str]]]


_ROS_2 = LogFormat("ROS 2 bag", "rosbags", read_bag)
LOG_FORMATS = {
    ".ulg": LogFormat("PX4 ULog", "pyulog", read_ulog),
    ".bin": LogFormat("ArduPilot log", "pymavlink", read_dataflash),
    ".bag": LogFormat("ROS 1 bag", "rosbags", read_bag),
    ".mcap": _ROS_2,
    ".db3": _ROS_2,
}


def open_log(path: Path, file: str, chosen: Collection[str]) -> Table:
    """The chosen channels of a log as a table.

    Args:
        path: of a file whose suffix is one of `LOG_FORMATS`.
        file: its name in messages.
        chosen: names of channels, such as "gyro_x"; names of no channel are passed over.

    Raises:
        InputError: the package that reads it is not installed, the file is not what its suffix says, or
            none of its channels is chosen.
    """
    title, package, read = LOG_FORMATS[path.suffix.lower()]
    try:
        importlib.import_module(package)
    except ModuleNotFoundError:
        raise InputError(
            f"{file!r} is a {title}, which the package {package} reads, and that is not installed: "
            "pip install 'bayescal[logs]'"
        ) from None
    said = io.StringIO()  # libraries print; standard output is the command's own
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            sensors, notes = read(path)
    except OSError:
        raise
    except Exception as error:
        raise unreadable(file, title, error) from None
    told = [line for line in said.getvalue().splitlines() if "dfindexer" not in line.lower()]
    notes += [f"{package} says: {line[:200]}" for line in told[:1]]
    columns, more = columns_of(sensors, chosen, file)
    arrays = list(columns.values())
    return Table(
        file=file,
        headers=tuple(map(Header.parse, columns)),
        rows=len(arrays[0]),
        sha256=sha256_of(path),
        load=loads(arrays.__getitem__),
        place=lambda index: f"sample {index + 1}",
        notes=(*(f"{file}: {note}" for note in notes), *more),
    )
