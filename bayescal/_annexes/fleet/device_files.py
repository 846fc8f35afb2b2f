"""Files of many devices: those in folders, and parts of about so many readings, of files or of devices."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.fleet.devices import Devices

T = TypeVar("T")
BYTES_A_ROW = 30  # of a text file, a log


def packed(sized: Iterable[tuple[T, int]], most: int) -> list[list[T]]:
    """Split items with sizes, in their order, into parts of at most so much, or of one item."""
    parts, count = list[list[T]]([[]]), 0
    for item, size in sized:
        if parts[-1] and count + size > most:
            parts.append([])
            count = 0
        parts[-1].append(item)
        count += size
    return parts


def parts_of(files: Iterable[Path], rows: int) -> list[list[Path]]:
    """Split files into parts of about so many readings."""
    return packed(((path, _readings_in(path)) for path in files), rows)


def cut(files: Iterable[Devices], rows: int) -> list[list[Devices]]:
    """Split devices that were read into parts of about so many readings."""
    pieces = list[Devices]()
    for devices in files:
        sizes = ((n, len(devices.measurements.get(n, ()))) for n in devices.names)
        pieces += map(devices.some, packed(sizes, rows))
    return packed(((piece, piece.readings) for piece in pieces), rows)


def _readings_in(path: Path) -> int:
    """Return how many readings a file holds, about."""
    if path.suffix.lower() == ".parquet":
        with suppress(OSError, pa.ArrowException):  # damaged: whoever reads it says how
            return pq.read_metadata(path).num_rows
    return path.stat().st_size // BYTES_A_ROW


def files_of(paths: Sequence[Path]) -> tuple[list[Path], dict[str, str]]:
    """Return files, with those in folders and the folders in these, in order of their names; and what is not read.

    Returns:
        The files; what stands in a folder and is not read, by its place there, with the reason.

    Raises:
        InputError: a path is given twice, or holds no file of readings.
    """
    files, left_out = list[Path](), dict[str, str]()
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        unread = set[Path]()
        for place in sorted(path.rglob("*")):
            if not unread.isdisjoint(place.parents):
                continue
            if why := _why_not(place):
                unread.add(place)
                left_out[ws.one_line(place.relative_to(path))] = why
            elif place.is_file():
                files.append(place)
    if not files:
        first = "".join(f"; {name}: {why}" for name, why in list(left_out.items())[:3])
        raise bc.InputError(
            f"no file of readings in {', '.join(map(str, paths))}: one of {', '.join(ws.READ)} was expected{first}"
        )
    if len({p.resolve() for p in files}) < len(files):
        raise bc.InputError("a file of readings was given twice: give each file once")
    return files, left_out


def _why_not(path: Path) -> str:
    """Return why something in a folder is not read; "" for folders and files of readings."""
    if path.name[0] in "._":
        return "its name begins with . or _, as of what programs keep for themselves"
    if path.is_dir():
        readable = os.access(path, os.R_OK | os.X_OK) and not path.is_symlink()
        return "" if readable else "a link to a folder, or one that cannot be looked into"
    if not path.is_file():
        return "a link to nothing, a pipe or a device"
    suffix = path.suffix.lower()
    return (
        "" if suffix in ws.READ else f"{suffix or 'no suffix'} is none of the formats that are read"
    )
