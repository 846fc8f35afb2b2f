"""Readings cut into partitions: files, runs of small files, stretches of row groups of a large Parquet file.

Only names, sizes and the footers of Parquet files are looked at here; the readings are read by whoever fits them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from bayescal._core.errors import InputError
from bayescal._core.quoting import one_line
from bayescal._tables.open_table import READ

ROWS = 500_000  # readings in a partition, which with JAX takes 0.6 GB of a worker
FIND_ROWS = 5_000  # where each device is searched: so that no more than a minute or two is lost
PACKED = (".gz", ".bz2", ".xz", ".zst", ".zip", ".7z", ".tar", ".tgz", ".rar")
BYTES_A_ROW = 30  # of a text file, a log


@dataclass(frozen=True)
class Piece:
    """A file, or some row groups of a Parquet file.

    Attributes:
        path: of the file.
        groups: first row group and the one past the last; None for a whole file.
        rows: readings in it, estimated for what is no Parquet.
    """

    path: Path
    groups: tuple[int, int] | None
    rows: int

    @property
    def name(self) -> str:
        """What messages call it."""
        if self.groups is None:
            return self.path.name
        return f"{self.path.name}, row groups {self.groups[0]} to {self.groups[1] - 1}"


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
    def rows(self) -> int:
        return sum(piece.rows for piece in self.pieces)

    @property
    def name(self) -> str:
        """What messages call it."""
        first, more = self.pieces[0].name, len(self.pieces) - 1
        return f"{first} and {more} more" if more else first


def partitions_of(paths: Sequence[Path], rows: int = ROWS) -> tuple[Partition, ...]:
    """Cut files, and all files in folders, into partitions of about so many readings.

    Raises:
        InputError: a path is not there, or there is no file of readings in them.
    """
    if rows < 1:
        raise InputError(f"partition_rows is {rows}: give at least 1")
    made: list[Partition] = []
    held: list[Piece] = []
    for piece in (piece for path in files_of(paths) for piece in _pieces(path, rows)):
        if held and sum(p.rows for p in held) + piece.rows > rows:
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
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise InputError(f"{str(path)!r} is not there: check the name and the folder")
        found += sorted(p for p, why in _inside(path) if not why) if path.is_dir() else [path]
    if not found:
        left = "".join(f"; {name}: {why}" for name, why in list(left_out(paths).items())[:3])
        raise InputError(
            f"no file of readings in {', '.join(map(str, paths))}: one of {', '.join(READ)} was expected{left}"
        )
    if len({p.resolve() for p in found}) < len(found):
        raise InputError("a file of readings was given twice: give each file once")
    return found


def left_out(paths: Sequence[Path]) -> dict[str, str]:
    """What stands in folders and is not read, by its place in them, and why: every file, link and pipe that is not."""
    return {
        one_line(found.relative_to(path)): why
        for path in paths
        if path.is_dir()
        for found, why in sorted(_inside(path))
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


def _pieces(path: Path, rows: int) -> Iterator[Piece]:
    size = path.stat().st_size
    if path.suffix.lower() != ".parquet":
        yield Piece(path, None, max(1, size // BYTES_A_ROW))
        return
    try:
        footer = pq.read_metadata(path)
    except (OSError, pa.ArrowException):  # damaged: whoever reads it says how
        yield Piece(path, None, max(1, size // BYTES_A_ROW))
        return
    if footer.num_rows <= rows or footer.num_row_groups < 2:
        yield Piece(path, None, max(1, footer.num_rows))
        return
    begin = held = 0
    for group in range(footer.num_row_groups):
        own = footer.row_group(group).num_rows
        if held and held + own > rows:
            yield Piece(path, (begin, group), held)
            begin, held = group, 0
        held += own
    yield Piece(path, (begin, footer.num_row_groups), held)
