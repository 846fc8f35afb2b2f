"""Readings cut into partitions: files, runs of small files, stretches of row groups of a large Parquet file.

Only names, sizes and the footers of Parquet files are looked at here; the readings are read by whoever fits them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from bayescal._core.errors import InputError
from bayescal._tables.open_table import READ

ROWS = 500_000  # readings in a partition, which with JAX takes 0.6 GB of a worker
FIND_ROWS = 5_000  # where each device is searched: so that no more than a minute or two is lost
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
    """Files, and those in folders and the folders in these, in order of their names; hidden ones are left out.

    Raises:
        InputError: a path is not there, is given twice, or holds no file of readings.
    """
    found: list[Path] = []
    for path in paths:
        if not path.exists():
            raise InputError(f"{str(path)!r} is not there: check the name and the folder")
        found += sorted(_inside(path)) if path.is_dir() else [path]
    if not found:
        raise InputError(
            f"no file of readings in {', '.join(map(str, paths))}: one of {', '.join(READ)} was expected"
        )
    if len({p.resolve() for p in found}) < len(found):
        raise InputError("a file of readings was given twice: give each file once")
    return found


def _inside(folder: Path) -> Iterator[Path]:
    for path in folder.rglob("*"):
        hidden = any(part[0] in "._" for part in path.relative_to(folder).parts)
        if path.suffix.lower() in READ and path.is_file() and not hidden:
            yield path


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
