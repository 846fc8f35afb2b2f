"""Files of many devices: those in folders, in parts of about so many readings, each read by itself.

A part is a few files, or some of the devices of a large Parquet file.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.fleet.devices import Devices, open_readings, split_table

BYTES_A_ROW = 30  # of a text file, a log


@dataclass(frozen=True)
class Piece:
    """A file, or some of the devices of a Parquet file."""

    path: Path  # of the file
    readings: int  # in it, estimated for what is no Parquet
    column: str = ""  # name of the column of devices, of some of which this is; "" of a whole file
    devices: pa.Array | None = None  # their labels

    @property
    def name(self) -> str:
        """What messages call it."""
        if self.devices is None:
            return self.path.name
        return f"{self.path.name}, devices {self.devices[0]} to {self.devices[-1]}"

    def read(self, model: bc.Model, options: ws.ReadOptions) -> Devices:
        """Read its devices, and of a large file these alone, a column at a time; refuse what cannot be read."""
        whole = self.devices is None
        table = open_readings(self.path, options, ws.MAX_BYTES if whole else sys.maxsize)
        if not whole:
            labels = pq.read_table(self.path, columns=[self.column]).column(0)
            table = table.take(np.flatnonzero(pc.is_in(labels, self.devices).to_numpy()))
        needs = tuple(dict.fromkeys(c for e in model.effects for c in e.columns))
        return split_table(table, self.path.stem, model.instrument, options, needs)


@dataclass(frozen=True)
class ReadPiece:
    """Devices that were read already, or given."""

    name: str
    devices: Devices

    def read(self, model: bc.Model, options: ws.ReadOptions) -> Devices:
        return self.devices


def parts_of(files: Sequence[Path], rows: int, device: str) -> list[tuple[Piece, ...]]:
    """Cut files into parts of about so many readings.

    Args:
        files: of readings.
        rows: readings in a part.
        device: the files' name of the column of devices.

    Raises:
        InputError: `rows` is none.
    """
    if rows < 1:
        raise bc.InputError(f"partition_rows is {rows}: give at least 1")
    parts: list[list[Piece]] = [[]]
    for piece in (piece for path in files for piece in _pieces(path, rows, device)):
        if parts[-1] and sum(p.readings for p in parts[-1]) + piece.readings > rows:
            parts.append([])
        parts[-1].append(piece)
    return [*map(tuple, parts)]


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
        own = list[Path]()
        for place, folders, names in os.walk(path):
            whys = {name: _why_not(Path(place, name)) for name in sorted((*folders, *names))}
            folders[:] = [name for name in folders if not whys[name]]
            own += [Path(place, name) for name in names if not whys[name]]
            here = Path(place).relative_to(path)
            left_out |= {ws.one_line(here / name): why for name, why in whys.items() if why}
        files += sorted(own)
    if not files:
        unread = "".join(f"; {name}: {why}" for name, why in list(left_out.items())[:3])
        raise bc.InputError(
            f"no file of readings in {', '.join(map(str, paths))}: one of {', '.join(ws.READ)} was expected{unread}"
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


def _pieces(path: Path, rows: int, device: str) -> Iterator[Piece]:
    """A file; of a Parquet file that holds more rows, so many at a time, by device."""
    whole = Piece(path, max(1, path.stat().st_size // BYTES_A_ROW))
    if path.suffix.lower() != ".parquet":
        yield whole
        return
    try:
        with pq.ParquetFile(path) as file:
            count, names = file.metadata.num_rows, file.schema_arrow.names
            headers = zip(names, ws.arrow_headers(file.schema_arrow), strict=True)
            column = next((name for name, header in headers if header.name == device), None)
            if column is None or count <= rows:
                yield Piece(path, max(1, count))
                return
            labels, counts = file.read(columns=[column]).column(column).value_counts().flatten()
    except (OSError, pa.ArrowException):  # damaged: whoever reads it says how
        yield whole
        return
    ends = np.cumsum(counts.to_numpy())
    for part in np.split(np.arange(len(ends)), np.flatnonzero(np.diff((ends - 1) // rows)) + 1):
        readings = int(ends[part[-1]] - ends[part[0]]) + counts[int(part[0])].as_py()
        yield Piece(path, readings, column, labels.slice(part[0], len(part)))
