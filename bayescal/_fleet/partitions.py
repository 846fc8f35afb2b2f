"""Readings cut into partitions: files, runs of small files, stretches of whole devices of a large Parquet file.

Only names, sizes and the footers of Parquet files are looked at here, and the labels of devices where a large one is
cut; the readings are read by whoever fits them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from bayescal._core.errors import InputError
from bayescal._core.quoting import one_line
from bayescal._fleet.devices import DEVICE
from bayescal._tables.open_table import READ
from bayescal._tables.parquet_netcdf import arrow_headers

ROWS = 500_000  # readings in a partition, which with JAX takes 0.6 GB of a worker
FIND_ROWS = 5_000  # where each device is searched: so that no more than a minute or two is lost
PACKED = (".gz", ".bz2", ".xz", ".zst", ".zip", ".7z", ".tar", ".tgz", ".rar")
BYTES_A_ROW = 30  # of a text file, a log


@dataclass(frozen=True)
class Piece:
    """A file, or a stretch of whole devices of a large Parquet file.

    Attributes:
        path: of the file.
        readings: in it, estimated for what is no Parquet.
        rows: first row and the one past the last; None for a whole file.
        groups: row groups that hold them.
        before: rows of the file before the first of these.
    """

    path: Path
    readings: int
    rows: tuple[int, int] | None = None
    groups: tuple[int, ...] = ()
    before: int = 0

    @property
    def name(self) -> str:
        """What messages call it."""
        if self.rows is None:
            return self.path.name
        return f"{self.path.name}, rows {self.rows[0] + 1} to {self.rows[1]}"


@dataclass(frozen=True)
class Partition:
    """What is read, fitted and written at once.

    Attributes:
        number: its place among all.
        pieces: what it is read from.
    """

    number: int
    pieces: tuple[Piece, ...]

    @property
    def file(self) -> str:
        """Name of its file of results."""
        return f"part-{self.number:06d}.parquet"

    @property
    def readings(self) -> int:
        return sum(piece.readings for piece in self.pieces)

    @property
    def name(self) -> str:
        """What messages call it."""
        first, more = self.pieces[0].name, len(self.pieces) - 1
        return f"{first} and {more} more" if more else first


def partitions_of(
    paths: Sequence[Path], rows: int = ROWS, device: str = DEVICE
) -> tuple[Partition, ...]:
    """Cut files, and all files in folders, into partitions of about so many readings.

    Args:
        paths: of files and folders.
        rows: readings in a partition.
        device: the files' name of the column of devices.

    Raises:
        InputError: a path is not there, or there is no file of readings in them.
    """
    if rows < 1:
        raise InputError(f"partition_rows is {rows}: give at least 1")
    made: list[Partition] = []
    held: list[Piece] = []
    for piece in (piece for path in files_of(paths) for piece in _pieces(path, rows, device)):
        if held and sum(p.readings for p in held) + piece.readings > rows:
            made.append(Partition(len(made), tuple(held)))
            held = []
        held.append(piece)
    made.append(Partition(len(made), tuple(held)))
    return tuple(made)


def files_of(paths: Sequence[Path]) -> list[Path]:
    """Files, and those in folders and the folders in these, in order of their names.

    Raises:
        InputError: a path is not there, is given twice, or holds no file of readings.
    """
    files: list[Path] = []
    for path in paths:
        if not path.exists():
            raise InputError(f"{str(path)!r} is not there: check the name and the folder")
        files += sorted(p for p, why in _inside(path) if not why) if path.is_dir() else [path]
    if not files:
        left = "".join(f"; {name}: {why}" for name, why in list(left_out(paths).items())[:3])
        raise InputError(
            f"no file of readings in {', '.join(map(str, paths))}: one of {', '.join(READ)} was expected{left}"
        )
    if len({p.resolve() for p in files}) < len(files):
        raise InputError("a file of readings was given twice: give each file once")
    return files


def left_out(paths: Sequence[Path]) -> dict[str, str]:
    """What stands in folders and is not read, by its place in them, and why: every file, link and pipe that is not."""
    return {
        one_line(place.relative_to(path)): why
        for path in paths
        if path.is_dir()
        for place, why in sorted(_inside(path))
        if why
    }


def _inside(folder: Path) -> Iterator[tuple[Path, str]]:
    """All that stands in a folder and in those below it, and why it is not read; empty for a file of readings."""
    unread: list[tuple[Path, str]] = []

    def refused(error: OSError) -> None:
        unread.append((Path(error.filename), f"cannot be looked into: {error.strerror}"))

    for place, folders, files in os.walk(folder, onerror=refused):
        for name in (*folders, *files):
            path = Path(place, name)
            why = _why_not(path)
            if why or not path.is_dir():
                yield path, why
        folders[:] = [name for name in folders if not _why_not(Path(place, name))]
    yield from unread


def _why_not(path: Path) -> str:
    """Why something in a folder is not read; empty for folders and files of readings."""
    if path.name[0] in "._":
        return "its name begins with . or _, as of what programs keep for themselves"
    if path.is_dir():
        return "a link to a folder, which is not followed" if path.is_symlink() else ""
    if not path.is_file():
        return "a link to nothing" if path.is_symlink() else "a pipe or a device, no file"
    suffix = path.suffix.lower()
    if suffix in READ:
        return ""
    if suffix in PACKED:
        return f"packed ({suffix}): unpack it first"
    return f"{suffix or 'no suffix'} is none of the formats that are read"


def _pieces(path: Path, rows: int, device: str) -> Iterator[Piece]:
    size = path.stat().st_size
    whole = Piece(path, max(1, size // BYTES_A_ROW))
    if path.suffix.lower() != ".parquet":
        yield whole
        return
    try:
        with pq.ParquetFile(path) as file:
            yield from _stretches(path, file, rows, device)
    except (OSError, pa.ArrowException):  # damaged: whoever reads it says how
        yield whole


def _stretches(path: Path, file: pq.ParquetFile, rows: int, device: str) -> list[Piece]:
    """A Parquet file, or stretches of whole devices of it, each of about so many rows.

    A stretch ends where the first device begins behind a row group with which it would be longer. So devices stand
    together in such a file, as they do where it was written by device.
    """
    groups = [file.metadata.row_group(g).num_rows for g in range(file.num_row_groups)]
    starts = np.cumsum([0, *groups])
    fields = zip(file.schema_arrow.names, arrow_headers(file.schema_arrow), strict=True)
    column = next((name for name, header in fields if header.name == device), None)
    ends, last = [0], int(starts[-1])
    for group in range(1, len(groups)) if column else ():
        if starts[group] > ends[-1] and starts[group + 1] - ends[-1] > rows:
            ends.append(_next_device(file, str(column), group, starts))
    ends = [*(end for end in ends if end < last), last]
    if len(ends) < 3:
        return [Piece(path, max(1, last))]
    pieces = []
    for begin, end in pairwise(ends):
        first, final = np.searchsorted(starts, [begin, end - 1], side="right") - 1
        own = tuple(range(first, final + 1))
        pieces.append(Piece(path, end - begin, (begin, end), own, int(starts[first])))
    return pieces


def _next_device(file: pq.ParquetFile, column: str, group: int, starts: np.ndarray) -> int:
    """The row, from the first of a row group on, at which a device begins."""

    def labels(group: int) -> pa.ChunkedArray:
        return file.read_row_group(group, columns=[column]).column(column).cast(pa.string())

    last = labels(group - 1)[-1]
    for later in range(group, len(starts) - 1):
        another = pc.index(pc.not_equal(labels(later), last), True).as_py()  # pyright: ignore
        if another >= 0:
            return int(starts[later]) + another
    return int(starts[-1])
