"""One partition: read, fitted, written; or known to be written already, by the digest of what it is made from."""

from __future__ import annotations

import hashlib
import resource
import sys
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bayescal._core.atomic_file import sha256_of
from bayescal._core.errors import InputError
from bayescal._core.settings_in_force import OutcomeSettings, use_settings
from bayescal._core.version import __version__
from bayescal._data.read_options import ReadOptions
from bayescal._fleet.batch_result import BatchResult, load_batch
from bayescal._fleet.devices import DEVICE, Devices
from bayescal._fleet.find_devices import DeviceStructure, Find, find_and_fit
from bayescal._fleet.fit_devices import FitOptions, fit_together
from bayescal._fleet.partitions import Partition, Piece
from bayescal._fleet.split_devices import open_readings, split_table
from bayescal._inference.checkpoint import model_texts, shown
from bayescal._model.model import Model
from bayescal._tables.cells import Cells
from bayescal._tables.open_table import MAX_BYTES
from bayescal._tables.parquet_netcdf import arrow_cells, arrow_headers
from bayescal._tables.raw_table import Table, after, as_format, refuse_large

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
