"""Readings cut into partitions, each of which is read, fitted, written.

A partition is a file, a run of small files, or a stretch of whole devices of a large Parquet file. By the digest of
what its results are made from it is known whether they are written already.

To cut, only names, sizes and the footers of Parquet files are looked at, and the labels of devices where a large one is
cut; the readings are read where they are fitted.
"""

from __future__ import annotations

import hashlib
import os
import resource
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from bayescal._core.atomic_file import sha256_of
from bayescal._core.errors import InputError
from bayescal._core.quoting import one_line
from bayescal._core.settings_in_force import OutcomeSettings, use_settings
from bayescal._core.version import __version__
from bayescal._data.header_matching import ReadOptions
from bayescal._fleet.batch_result import BatchResult, load_batch
from bayescal._fleet.devices import DEVICE, Devices, open_readings, split_table
from bayescal._fleet.find_devices import DeviceStructure, Find, find_and_fit
from bayescal._fleet.fit_devices import FitOptions, fit_together
from bayescal._inference.checkpoint import model_texts, shown
from bayescal._model.model import Model
from bayescal._tables.cells import Cells
from bayescal._tables.open_table import MAX_BYTES, READ
from bayescal._tables.parquet_netcdf import arrow_cells, arrow_headers
from bayescal._tables.raw_table import Table, after, as_format, refuse_large

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


ONE = threading.Lock()  # a worker of several threads holds one partition at a time all the same
SHOWN = 10  # devices of a partition whose refusal is reported
PARTITION = "partition"  # what a file of results says of where it comes from


@dataclass(frozen=True)
class Request:
    """What is fitted to every device, and how its file is read.

    Attributes:
        model: what is fitted.
        fit_options: of every fit.
        read_options: how columns are understood.
        find: what is looked for in each device, if anything is.
        settings: that hold where this was asked, and are to hold on the workers.
    """

    model: Model
    fit_options: FitOptions
    read_options: ReadOptions
    find: Find | None
    settings: tuple[OutcomeSettings, ...]

    @property
    def device_column(self) -> str:
        """The files' name of the column of devices."""
        return self.read_options.columns.get(DEVICE, DEVICE)

    @cached_property
    def digest(self) -> str:
        """SHA-256 over all that results depend on, but the readings."""
        candidates = self.find.effects if self.find else ()
        search = self.find and (self.find.max_effects, self.find.widen_noise)
        own = (*vars(self.fit_options).values(), search, *vars(self.read_options).values())
        texts = [
            __version__,
            *model_texts(self.model, candidates),
            *map(shown, (*own, *self.settings)),
        ]
        return hashlib.sha256("\n".join(texts).encode()).hexdigest()


@dataclass(frozen=True)
class PartitionSummary:
    """What the client gets of a partition: never more than a few lines, but for searched structures.

    Attributes:
        number: of the partition.
        devices, trusted, readings: how many.
        doubted: some devices whose result is not reliable, and why.
        unreadable: file → why it cannot be used.
        structures: of the devices that were searched.
        elsewhere: devices that stand in other partitions too, as of `fit_partition`.
        again: whether its results stood there before.
        seconds: of the processor.
        memory: most that its process has held so far, bytes.
    """

    number: int
    devices: int
    trusted: int
    readings: int
    doubted: dict[str, str]
    unreadable: dict[str, str]
    structures: tuple[DeviceStructure, ...]
    elsewhere: dict[str, str]
    again: bool = False
    seconds: float = 0.0
    memory: int = 0


def fit_partition(
    request: Request, partition: Partition, folder: Path, elsewhere: Mapping[str, str] | None = None
) -> PartitionSummary:
    """Fit the devices of a partition and write their results, unless they are there.

    Args:
        request: what is fitted.
        partition: whose devices.
        folder: that results are written to.
        elsewhere: devices that stand in other partitions too → why they are refused here, or "" where an earlier
            partition says so and they are left out; None where that is not known yet, and results that stand there are
            taken as they are.

    Raises:
        InputError: the results cannot be written.
    """
    begun = time.process_time()
    with ONE, use_settings(*request.settings):
        path = folder / partition.file
        digest = content_digest(partition, request)
        result = _written(path, digest, elsewhere)
        again = result is not None
        if result is None:
            path.unlink(missing_ok=True)  # of other readings, or of another request
            result = _fitted(request, partition, digest, dict(elsewhere or {}))
            result.save(path)
        summary = _summary(partition, result)
    return replace(summary, again=again, seconds=time.process_time() - begun, memory=peak_memory())


def _written(path: Path, digest: str, elsewhere: Mapping[str, str] | None) -> BatchResult | None:
    """The results that stand there, if they are whole and of these readings."""
    if not digest or not path.is_file():
        return None
    try:
        result = load_batch(path)
    except InputError:
        return None
    own = result.about.get(PARTITION, {})
    same = own.get("digest") == digest and not own["unreadable"]
    return result if same and elsewhere in (None, own["elsewhere"]) else None


def _fitted(
    request: Request, partition: Partition, digest: str, elsewhere: dict[str, str]
) -> BatchResult:
    devices, unreadable = read_partition(partition, request, elsewhere)
    model, options = request.model, request.fit_options
    structures: dict[str, DeviceStructure] = {}
    if request.find is None:
        result = fit_together(devices.names, devices.refused, [(model, devices)], options)
    else:
        result, structures = find_and_fit(model, devices, request.find, options)
    own = {
        "digest": digest,
        "files": [piece.name for piece in partition.pieces],
        "readings": devices.readings,
        "unreadable": unreadable,
        "elsewhere": elsewhere,
        "structures": {name: asdict(one) for name, one in structures.items()},
    }
    return replace(result, about={**result.about, PARTITION: own})


def _summary(partition: Partition, result: BatchResult) -> PartitionSummary:
    own, bad = result.about[PARTITION], np.flatnonzero(~result.ok)
    return PartitionSummary(
        partition.number,
        devices=len(result),
        trusted=len(result) - len(bad),
        readings=own["readings"],
        doubted={result.devices[i]: result.reasons[i] for i in bad[:SHOWN]},
        unreadable=own["unreadable"],
        structures=tuple(DeviceStructure(**held) for held in own["structures"].values()),
        elsewhere=own["elsewhere"],
    )


def peak_memory() -> int:
    """Most that this process has held, bytes."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


def read_partition(
    partition: Partition, request: Request, elsewhere: Mapping[str, str] | None = None
) -> tuple[Devices, dict[str, str]]:
    """The devices of a partition, and its files that cannot be read → why; `elsewhere` as of `fit_partition`."""
    files: list[Devices] = []
    unreadable: dict[str, str] = {}
    needs = tuple(dict.fromkeys(c for e in request.model.effects for c in e.columns))
    for piece in partition.pieces:
        try:
            table = _open(piece, request.read_options)
            stem, instrument = piece.path.stem, request.model.instrument
            files.append(split_table(table, stem, instrument, request.read_options, needs))
        except (InputError, OSError) as error:
            unreadable[piece.name] = str(error)
    names = Counter(name for devices in files for name in devices.names)
    twice = {
        name: f"device {name!r} stands in several files of {partition.name!r}: put its readings into one"
        for name, count in names.items()
        if count > 1
    }
    elsewhere = elsewhere or {}
    refused = twice | {name: why for name, why in elsewhere.items() if why}
    whole = Devices.together(files).refusing(refused)
    return whole.without({name for name, why in elsewhere.items() if not why}), unreadable


def content_digest(partition: Partition, request: Request) -> str:
    """SHA-256 over a partition's bytes and what is done with them; empty where it cannot be read."""
    digest = hashlib.sha256(request.digest.encode())
    for piece in partition.pieces:
        try:
            own = sha256_of(piece.path) if piece.rows is None else _stretch_digest(piece)
        except (OSError, pa.ArrowException):
            return ""
        digest.update(f"\n{piece.name} {own}".encode())
    return digest.hexdigest()


def _open(piece: Piece, options: ReadOptions) -> Table:
    """A file, or a stretch of rows of a large Parquet file, as a table; refused if it is too large once unpacked."""
    if piece.rows is None:
        return open_readings(piece.path, options)
    file, begin, groups = piece.path.name, piece.rows[0], piece.groups
    with as_format(file, "Parquet"), pq.ParquetFile(piece.path) as opened:
        schema = opened.schema_arrow
    refuse_large(file, piece.readings, len(schema), MAX_BYTES)

    def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
        cells = {}
        with as_format(file, "Parquet"), pq.ParquetFile(piece.path) as opened:
            for position, number in wanted.items():
                name = schema.names[position]
                column = opened.read_row_groups(groups, columns=[name]).column(name)
                own = column.slice(begin - piece.before, piece.readings)
                cells[position] = arrow_cells(own, number)
        pa.default_memory_pool().release_unused()
        return cells

    return Table(
        file=file,
        headers=arrow_headers(schema),
        rows=piece.readings,
        sha256=_stretch_digest(piece),
        load=load,
        place=after(begin),
    )


def _stretch_digest(piece: Piece) -> str:
    """SHA-256 of the bytes of the row groups that hold a stretch of rows, and of which rows they are."""
    digest = hashlib.sha256(repr(piece.rows).encode())
    with pq.ParquetFile(piece.path) as opened, piece.path.open("rb") as file:
        for group in map(opened.metadata.row_group, piece.groups):
            for column in map(group.column, range(group.num_columns)):
                at = [column.dictionary_page_offset, column.data_page_offset]
                file.seek(min(offset for offset in at if offset))
                digest.update(file.read(column.total_compressed_size))
    return digest.hexdigest()
