"""One verb for many devices of one type: `fit_batch`, in this process or on a cluster.

A fleet goes from its files to its results: it is cut into partitions, each of which is read, fitted, written; what is
wrong is named, the whole summed up. A partition is a file, a run of small files, or a stretch of whole devices of a
large Parquet file. By the digest of what its results are made from it is known whether they are written already.
"""

from __future__ import annotations

import hashlib
import os
import resource
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack, overload

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as pads
import pyarrow.parquet as pq

from bayescal import InputError, Measurements, Model, Settings, __version__, use_settings
from bayescal._annexes.fleet.batch_result import (
    ALONE,
    POOLED,
    WHOLE,
    BatchResult,
    FleetResult,
    facts_of,
    first_few,
    load_batch,
)
from bayescal._annexes.fleet.devices import (
    DEVICE,
    Devices,
    gathered,
    open_readings,
    split_devices,
    split_table,
)
from bayescal._annexes.fleet.engine import Engine
from bayescal._annexes.fleet.find_devices import (
    DeviceStructure,
    Find,
    common_model,
    effects_table,
    find_and_fit,
)
from bayescal._annexes.fleet.fit_devices import (
    CHUNK,
    FitOptions,
    common_reference,
    fit_devices,
    fit_together,
    tailored_to_first,
    temperature_sums,
)
from bayescal._annexes.fleet.model_texts import model_texts, shown
from bayescal._annexes.fleet.odd_devices import odd_devices
from bayescal._annexes.fleet.partial_pooling import learn_population
from bayescal._annexes.fleet.population import AskedPopulation, chosen
from bayescal._core import deadline
from bayescal._core.progress import EVERY
from bayescal._core.settings import settings
from bayescal._inference.method import Method
from bayescal._model.frame import Reference
from bayescal._tables.cells import Cells
from bayescal._tables.open_table import MAX_BYTES, READ
from bayescal._tables.parquet_netcdf import arrow_cells, arrow_headers
from bayescal._tables.raw_table import Table, after, as_format, refuse_large
from bayescal.workshop import (
    ReadOptions,
    note,
    one_line,
    parsed_json,
    sha256_of,
    stage,
    tell,
)

if TYPE_CHECKING:
    from distributed import Client

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
SHOWN_REFUSALS = 10  # devices of a partition whose refusal is reported
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
    settings: Settings

    @cached_property
    def digest(self) -> str:
        """SHA-256 over all that results depend on, but the readings."""
        candidates = self.find.effects if self.find else ()
        search = self.find and (self.find.max_effects, self.find.widen_noise)
        own = (*vars(self.fit_options).values(), search, *vars(self.read_options).values())
        texts = [
            __version__,
            *model_texts(self.model, candidates),
            *map(shown, (*own, self.settings)),
        ]
        return hashlib.sha256("\n".join(texts).encode()).hexdigest()


@dataclass(frozen=True)
class PartitionSummary:
    """What the client gets of a partition: never more than a few lines, but for searched structures.

    Attributes:
        number: of the partition.
        devices, fitted, readings: how many.
        doubted: some devices whose fit is not to be relied on, and why.
        unreadable: file → why it cannot be used.
        structures: of the devices that were searched, by name.
        elsewhere: devices that stand in other partitions too, as of `fit_partition`.
        again: whether its results stood there before.
        seconds: of the processor.
        memory: most that its process has held so far, bytes.
    """

    number: int
    devices: int
    fitted: int
    readings: int
    doubted: dict[str, str]
    unreadable: dict[str, str]
    structures: dict[str, DeviceStructure]
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
    with ONE, use_settings(request.settings):
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
        "digest": "" if deadline.current().over else digest,  # not all were reached
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
        fitted=len(result) - len(bad),
        readings=own["readings"],
        doubted={result.devices[i]: result.reasons[i] for i in bad[:SHOWN_REFUSALS]},
        unreadable=own["unreadable"],
        structures={n: DeviceStructure(**held) for n, held in own["structures"].items()},
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


_NONE = "none of the devices can be used; "
DOUBTED = 100  # devices whose result is not reliable, of which the whole says why


def fit_fleet(
    model: Model,
    paths: Sequence[Path],
    out: Path,
    fit_options: FitOptions,
    population: AskedPopulation,
    *,
    client: Client | None,
    rows: int | None,
    columns: Mapping[str, Any] | None,
    find: Find | None = None,
) -> FleetResult:
    """Fit the devices of files, partition by partition: see `fit_batch`.

    Raises:
        InputError: there are no such files, none of their devices can be used, or the cluster is gone.
    """
    begun = time.monotonic()
    engine = Engine(client)
    if client is not None and client.cluster is None and client.dashboard_link:
        tell(f"the cluster's dashboard: {client.dashboard_link}")
    unread = left_out(paths)
    for line in first_few(unread, len(unread), "not read: ", f", all in {WHOLE}"):
        note(line.strip())
    read_options = ReadOptions.of(model.instrument, **(columns or {}))
    request = Request(model, fit_options, read_options, find, settings())
    rows = rows or (FIND_ROWS if find else ROWS)
    partitions = partitions_of(paths, rows, read_options.columns.get(DEVICE, DEVICE))
    request = _with_common(request, partitions, engine, bool(population))
    named = chosen(request.model, population)
    folder = out.resolve()
    run = _Run(request, partitions, folder / ALONE, engine)
    run.fit()
    done = run.in_order
    if not any(one.fitted for one in done):
        raise InputError(_NONE + run.reasons)
    learned = None
    files = [folder / ALONE / partitions[one.number].file for one in done]
    if named:
        learned = learn_population(files, folder / POOLED, named, fit_options.seed, engine)
    doubted = {name: why for one in done for name, why in one.doubted.items()}
    structures = {name: each for one in done for name, each in one.structures.items()}
    effects = effects_table([*structures.values()], fit_options.seed)
    fitted, facts = sum(one.fitted for one in done), _facts(files)
    odd = _odd(
        run,
        files,
        facts,
        common_model(request.model, [*structures.values()], effects, find.effects if find else ()),
    )
    fleet = FleetResult(
        out,
        devices=sum(one.devices for one in done),
        fitted=fitted,
        checked=len(structures),
        readings=sum(one.readings for one in done),
        doubted=dict(list(doubted.items())[:DOUBTED]),
        missing=run.missing,
        odd=odd,
        table=_table(files),
        population=learned,
        effects=effects,
        about={
            **request.fit_options.data(request.model),
            "version": __version__,
            "partitions": len(partitions),
            "found_done": sum(one.again for one in done),
            "seconds": time.monotonic() - begun,
            "processor_seconds": sum(one.seconds for one in done),
            "peak_memory": max(one.memory for one in done),
        },
        left_out=unread,
    )
    fleet.save()
    return fleet


def _table(files: Sequence[Path]) -> pd.DataFrame:
    """One row a coefficient, over the devices that are reliable."""
    columns: dict[str, Any] = {n: pads.field(n) for n in ("coefficient", "unit", "mean")}
    columns["variance"] = pads.field("sd") * pads.field("sd")
    # In one thread, so that the sums do not depend on which file was first.
    once = {"use_threads": False}
    rows = pads.dataset(files).to_table(columns=columns, filter=pads.field("ok"), **once)
    asked = [("mean", "mean"), ("mean", "stddev"), ("variance", "mean"), ("mean", "count")]
    found = rows.group_by(["coefficient", "unit"], **once).aggregate(asked).to_pandas()
    return pd.DataFrame(
        {
            "coefficient": found["coefficient"],
            "mean": found["mean_mean"],
            "between devices": found["mean_stddev"],
            "typical sd": np.sqrt(found["variance_mean"]),
            "unit": found["unit"],
            "devices": found["mean_count"],
        }
    )


def _facts(files: Sequence[Path]) -> pd.DataFrame:
    """Return how many readings the devices of some partitions have, and about which temperature."""
    facts = list[pd.DataFrame]()
    for file in files:
        head = parsed_json((pq.read_schema(file).metadata or {})[b"bayescal"])
        order = pq.read_table(file, columns=["device"])["device"].unique().to_pylist()
        facts.append(facts_of(order, head.get("facts", {})))
    return pd.concat(facts)


def _odd(
    run: _Run, files: Sequence[Path], facts: pd.DataFrame, model: Model
) -> dict[str, list[str]]:
    """Return the devices that are not like the others, by one model at one temperature.

    Where results are of other models or temperatures, partitions are fitted once more.
    """
    request, options = run.request, run.request.fit_options.compared_at(facts)
    dataset: pads.Dataset = pads.dataset(files)
    if options or model is not request.model:
        request = replace(request, model=model, fit_options=options or request.fit_options)
        each = [(request, run.partitions[one.number], one.elsewhere) for one in run.in_order]
        dataset = pads.dataset(pa.concat_tables(run.engine.every(_rows_to_compare, each)))
    return odd_devices(dataset, facts)


def _rows_to_compare(
    request: Request, partition: Partition, elsewhere: Mapping[str, str]
) -> pa.Table:
    """Fit the devices of a partition to be compared with those of others."""
    with ONE, use_settings(request.settings):
        devices, _ = read_partition(partition, request, elsewhere)
        groups = [(request.model, devices)]
        result = fit_together(devices.names, devices.refused, groups, request.fit_options)
        return result.rows().drop_columns(["covariance"])


def _temperature_sums(request: Request, partition: Partition) -> list[tuple[str, float, int]]:
    with use_settings(request.settings):
        return temperature_sums(read_partition(partition, request)[0])


def _tailored_model(request: Request, partition: Partition) -> Model | None:
    """The model tailored to the partition's first device that it can be tailored to; None where there is none."""
    with use_settings(request.settings):
        devices = read_partition(partition, request)[0]
        return tailored_to_first(request.model, devices) if len(devices.blocks) else None


def _with_common(
    request: Request, partitions: Sequence[Partition], engine: Engine, pooled: bool
) -> Request:
    """The request with what has to be the same in all partitions: T0 of a population, the unit."""
    if pooled and "T0" not in request.fit_options.reference:
        tell("reading all temperatures, for a common T0 (a reference given spares that)")
        sums = engine.every(_temperature_sums, [(request, p) for p in partitions])
        common = common_reference([one for some in sums for one in some])
        request = replace(request, fit_options=request.fit_options.with_common(common))
    model = request.model
    if model.instrument.tailor is None:
        return request
    reason = ""
    for partition in partitions:
        for outcome in engine.each(_tailored_model, [(request, partition)]):
            if outcome.value is not None:
                return replace(request, model=outcome.value)
            reason = reason or outcome.error
    if reason:
        raise InputError(_NONE + reason)
    return request


@dataclass
class _Run:
    """Partitions as they are done, by number; of those that have no results, why."""

    request: Request
    partitions: Sequence[Partition]
    folder: Path  # that each writes its file to
    engine: Engine
    done: dict[int, PartitionSummary] = field(default_factory=dict)
    failed: dict[int, str] = field(default_factory=dict)

    @property
    def in_order(self) -> list[PartitionSummary]:
        """What was done, in the order of the partitions: so that sums do not depend on which was first."""
        return [self.done[number] for number in sorted(self.done)]

    @property
    def missing(self) -> dict[str, str]:
        """File → why its devices have no results."""
        files = {name: why for done in self.in_order for name, why in done.unreadable.items()}
        return files | {self.partitions[n].name: why for n, why in sorted(self.failed.items())}

    @property
    def reasons(self) -> str:
        """Why nothing can be used: what is said of the most first."""
        doubted = {name: why for done in self.in_order for name, why in done.doubted.items()}
        said = doubted | self.missing or {"": "there is none"}
        return "\n".join(first_few(said, len(said))).strip()

    def fit(self) -> None:
        """Fit every partition that has no results, and refuse devices that stand in several.

        Raises:
            InputError: the folder holds results of other partitions, or the engine is gone.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        own = {p.file for p in self.partitions}
        others = sorted(f.name for f in self.folder.glob("part-*.parquet") if f.name not in own)
        if others:
            raise InputError(
                f"{self.folder} holds results of more partitions ({others[0]} …) than these readings make: they are "
                "of other readings. Choose another folder, or remove them"
            )
        with stage("fitting devices"):
            self._each({p.number: None for p in self.partitions})
        elsewhere = self._elsewhere()
        again = {
            number: own
            for number, done in self.done.items()
            if (own := elsewhere.get(number, {})) != done.elsewhere
        }
        if again:
            tell(f"devices that stand in several partitions: {len(again)} of these fitted again")
            self._each(again)

    def _each(self, wanted: Mapping[int, dict[str, str] | None]) -> None:
        some = [self.partitions[number] for number in wanted]
        tasks = [(self.request, p, self.folder, wanted[p.number]) for p in some]
        begun = last = time.monotonic()
        passed, readings = 0, sum(p.readings for p in some)
        for count, outcome in enumerate(self.engine.each(fit_partition, tasks), 1):
            number = some[outcome.index].number
            self.done.pop(number, None)
            if outcome.error:
                self.failed[number] = outcome.error
            else:
                self.done[number] = outcome.value
            passed += some[outcome.index].readings
            if time.monotonic() > last + EVERY or (count == len(tasks) and last > begun):
                last = time.monotonic()
                self._tell(wanted, last - begun, passed / max(readings, 1))

    def _tell(self, wanted: Iterable[int], seconds: float, share: float) -> None:
        """Say how many devices are done, their rate, and what is left."""
        done = [self.done[number] for number in wanted if number in self.done]
        devices, before = sum(d.devices for d in done), sum(d.devices for d in done if d.again)
        found = f", {before:,} of them found done" if before else ""
        rate, left = (devices - before) / seconds, seconds * (1 / max(share, 1e-9) - 1)
        tell(f"{devices:,} devices{found}, {rate:,.0f} a second, about {left:,.0f} s left")

    def _elsewhere(self) -> dict[int, dict[str, str]]:
        """Partition → its devices that stand in others too, as `fit_partition` takes them, after all were fitted.

        Their readings belong into one file: which of them count, and from where their time runs, cannot be known.
        """
        names = [_names_in(self.folder / partition.file) for partition in self.partitions]
        numbers = np.repeat(np.arange(len(names)), [len(some) for some in names])
        table = pa.table({"device": pa.chunked_array(names, pa.string()), "at": numbers})
        found = table.group_by("device").aggregate([("at", "list"), ("at", "count")])
        twice = found.filter(pc.greater(found["at_count"], 1)).to_pydict()  # pyright: ignore
        places = {d: sorted(at) for d, at in zip(twice["device"], twice["at_list"], strict=True)}
        elsewhere: dict[int, dict[str, str]] = {}
        for device, (first, *others) in sorted(places.items()):
            shown = " and ".join(repr(self.partitions[n].name) for n in (first, others[0]))
            elsewhere.setdefault(first, {})[device] = (
                f"device {device!r} stands in {1 + len(others)} partitions, {shown}: put its readings into one file"
            )
            for number in others:
                elsewhere.setdefault(number, {})[device] = ""
        return elsewhere


def _names_in(path: Path) -> pa.Array:
    """The devices of a partition's results, and those that are left out of them."""
    if not path.is_file():
        return pa.array([], pa.string())
    with pq.ParquetFile(path) as file:
        column = file.read(columns=["device"])["device"].unique()
        head = parsed_json((file.schema_arrow.metadata or {})[b"bayescal"])
    elsewhere = head["about"][PARTITION]["elsewhere"]
    left_out = pa.array([name for name, why in elsewhere.items() if not why], pa.string())
    return pa.concat_arrays([column.cast(pa.string()), left_out])


Readings = (
    Devices
    | Sequence[Measurements]
    | Mapping[str, Measurements]
    | str
    | Path
    | Sequence[str | Path]
)


class _FitKeywords(TypedDict, total=False):
    """Keywords of `fit_batch` that batches and fleets share."""

    method: Method | None
    population: AskedPopulation
    seed: int
    chunk: int
    reference: Reference | None
    time_limit: float | None


@overload
def fit_batch(
    model: Model,
    readings: Readings,
    *,
    client: None = None,
    out: None = None,
    **how: Unpack[_FitKeywords],
) -> BatchResult: ...
@overload
def fit_batch(
    model: Model,
    readings: str | Path | Sequence[str | Path],
    *,
    client: Client | None = None,
    out: str | Path,
    partition_rows: int | None = None,
    columns: Mapping[str, Any] | None = None,
    find: bool | Find = False,
    **how: Unpack[_FitKeywords],
) -> FleetResult: ...
def fit_batch(
    model: Model,
    readings: Readings,
    *,
    method: Method | None = None,
    population: AskedPopulation = False,
    seed: int = 0,
    chunk: int = CHUNK,
    reference: Reference | None = None,
    time_limit: float | None = None,
    client: Client | None = None,
    out: str | Path | None = None,
    partition_rows: int | None = None,
    columns: Mapping[str, Any] | None = None,
    find: bool | Find = False,
) -> BatchResult | FleetResult:
    """Fit one model to many devices of one type, each by itself, in a few compiled programs.

        result = bc.fit_batch(mems_gyro.INSTRUMENT.baseline(), "lot.parquet", population=True)
        result["A17"], result.table()  # device, coefficient, mean, sd, unit, ok, reason
        fleet = bc.fit_batch(model, "fleet/", out="fleet_result", client=distributed.Client("tcp://10.0.0.5:8786"))

    Estimates, uncertainties and objections are those of `fit` with the same method and seed. A device whose readings
    cannot be used, or against whose fit something stands, gets a reason and changes nothing for the others.
    **Population.** Coefficients named there are drawn from a normal distribution over the devices, whose mean and
    standard deviation are learned; every device moves toward it by as much as its own readings leave open. Exact for a
    linear model with Gaussian noise that is known; else each device is represented by its mean and covariance.

    **With `out`** files are cut into partitions that are read, fitted and written one by one, here or by the workers of
    a Dask `client`. A partition leaves one Parquet file, whole or not at all: a run that was ended in any way goes on
    with the same call, and ends with the same numbers. A device that is met in several partitions is refused.

    Args:
        model: what is fitted; what its instrument takes from readings (unit, sizes) is taken from the first device.
        readings: `split_devices(…)`, paths of files with a column `device`, or measurements, one a device (a mapping
            names them). With `out`: paths, of folders too.
        method: `LeastSquares()` if not given. `Marginal()` samples without chains: a device that needs them is told.
        population: True for all coefficients that a device has one of, or names, or names with priors of their standard
            deviations between devices.
        seed: of every random number.
        chunk: devices fitted at once at most, which bounds memory.
        reference: constants of the bases, in place of each device's own; a population sets T0 to that of all readings.
        time_limit: seconds, after which devices that were not reached are refused with that reason, as at Ctrl-C.
        client: of a Dask cluster whose workers see the files and `out` under the same paths.
        out: folder for the results of partitions. What follows goes with it.
        partition_rows: readings in a partition, about; a process holds one at a time.
        columns: how files are read: arguments of `split_devices`, such as {"units": {"rate": "rad/s"}}.
        find: whether each device's missing effects are searched (about a second a device), or how.

    Raises:
        InputError: no device that can be used, files that cannot be read, a client without `out`, a cluster gone.
        ModelError: a population of something that is no coefficient.
    """
    options = FitOptions.of(method, seed, chunk, reference)
    chosen(model, population)  # a wrong name is refused before anything is read
    paths = _paths(readings)
    if out is not None:
        if not paths:
            raise InputError(
                "fit_batch with out= reads its files itself, partition by partition: give paths, not readings"
            )
        search = Find() if find is True else find or None
        how = {"client": client, "rows": partition_rows, "columns": columns, "find": search}
        resolved = [path.resolve() for path in paths]
        with deadline.until(time_limit):
            return fit_fleet(model, resolved, Path(out), options, population, **how)
    if client is not None or find:
        raise InputError("workers and searches write by partition: give out=, a folder")
    needs = tuple(dict.fromkeys(c for e in model.effects for c in e.columns))
    devices = split_devices(paths, model.instrument, needs=needs) if paths else _given(readings)
    model = tailored_to_first(model, devices)
    with deadline.until(time_limit):
        return fit_devices(model, devices, options, chosen(model, population))


def _paths(readings: Any) -> list[Path]:
    """Paths of files, where they are given; else none."""
    if isinstance(readings, str | Path):
        return [Path(readings)]
    if isinstance(readings, Devices | Mapping):
        return []
    return [Path(p) for p in readings] if all(isinstance(p, str | Path) for p in readings) else []


def _given(readings: Any) -> Devices:
    """Devices as they were given, or of measurements."""
    if isinstance(readings, Devices):
        return readings
    given = readings if isinstance(readings, Mapping) else list(readings)
    for i, one in enumerate(given.values() if isinstance(given, Mapping) else given):
        if not isinstance(one, Measurements):
            raise InputError(
                f"fit_batch: entry {i + 1} of the readings is of type {type(one).__name__}; measurements were "
                "expected, or paths"
            )
    return gathered(given)
