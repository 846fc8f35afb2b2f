"""One verb for many devices of one type: `fit_batch`, in this process or on a cluster.

A fleet goes from its files to its results: partitions are cut and fitted, what is wrong is named, the whole summed up.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack, overload

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as pads
import pyarrow.parquet as pq

from bayescal._core.errors import InputError
from bayescal._core.json_shape import parsed_json
from bayescal._core.progress import note, tell
from bayescal._core.settings_in_force import given_settings, use_settings
from bayescal._core.version import __version__
from bayescal._data.header_matching import ReadOptions
from bayescal._data.measurements import Measurements
from bayescal._fleet.batch_result import BatchResult, first_few
from bayescal._fleet.devices import Devices, gathered, split_devices
from bayescal._fleet.engine import Engine
from bayescal._fleet.find_devices import Find, effects_table
from bayescal._fleet.fit_devices import (
    CHUNK,
    FitOptions,
    common_reference,
    fit_devices,
    sized_for,
    tailored_to_first,
    temperature_sums,
)
from bayescal._fleet.fleet_result import ALONE, POOLED, WHOLE, FleetResult
from bayescal._fleet.partial_pooling import learn_population
from bayescal._fleet.partitions import (
    FIND_ROWS,
    PARTITION,
    ROWS,
    Partition,
    PartitionSummary,
    Request,
    fit_partition,
    left_out,
    partitions_of,
    read_partition,
)
from bayescal._fleet.population import AskedPopulation, chosen
from bayescal._inference.method import Method
from bayescal._model.frame import Reference
from bayescal._model.model import Model

if TYPE_CHECKING:
    from distributed import Client

DOUBTED = 100  # devices whose result is not reliable, of which the whole says why
EVERY = 2.0  # seconds between two lines of progress


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
    request = Request(model, fit_options, read_options, find, given_settings())
    rows = rows or (FIND_ROWS if find else ROWS)
    partitions = partitions_of(paths, rows, request.device_column)
    request = _with_common(request, partitions, engine, bool(population))
    named = chosen(request.model, population)
    folder = out.resolve()
    run = _Run(request, partitions, folder / ALONE, engine)
    run.fit()
    done = run.in_order
    if not any(one.trusted for one in done):
        raise InputError(f"none of the devices can be used; {run.first_reason}")
    learned, apart = None, dict[str, float]()
    files = [folder / ALONE / partitions[one.number].file for one in done]
    if named:
        learned, apart = learn_population(files, folder / POOLED, named, fit_options.seed, engine)
    doubted = {name: why for one in done for name, why in one.doubted.items()}
    fleet = FleetResult(
        out,
        devices=sum(one.devices for one in done),
        trusted=sum(one.trusted for one in done),
        readings=sum(one.readings for one in done),
        doubted=dict(list(doubted.items())[:DOUBTED]),
        missing=run.missing,
        table=_table(files),
        population=learned,
        apart=apart,
        effects=effects_table([each for one in done for each in one.structures], fit_options.seed),
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


def _temperature_sums(request: Request, partition: Partition) -> list[tuple[str, float, int]]:
    with use_settings(*request.settings):
        return temperature_sums(read_partition(partition, request)[0])


def _sized_model(request: Request, partition: Partition) -> Model | None:
    """The model, with what it takes from readings taken from the partition's first device that has it."""
    with use_settings(*request.settings):
        model, first = tailored_to_first(request.model, read_partition(partition, request)[0])
        return None if first is None else sized_for(model, first, request.fit_options.reference)


def _with_common(
    request: Request, partitions: Sequence[Partition], engine: Engine, pooled: bool
) -> Request:
    """The request with what has to be the same in all partitions: T0 of a population, unit, open sizes."""
    if pooled and "T0" not in request.fit_options.reference:
        tell("reading all temperatures, for a common T0 (a reference given spares that)")
        sums = engine.every(_temperature_sums, [(request, p) for p in partitions])
        common = common_reference([one for some in sums for one in some])
        request = replace(request, fit_options=request.fit_options.with_common(common))
    model = request.model
    if model.instrument.tailor is None and not any(e.open for e in model.effects):
        return request
    reason = ""
    for partition in partitions:
        for outcome in engine.each(_sized_model, [(request, partition)]):
            if outcome.value is not None:
                return replace(request, model=outcome.value)
            reason = reason or outcome.error
    if reason and model.instrument.tailor is not None:
        raise InputError(f"none of the devices can be used; {reason}")
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
    def first_reason(self) -> str:
        """Why nothing can be used, of the first."""
        reasons = [item for done in self.in_order for item in done.doubted.items()]
        name, why = [*reasons, *self.missing.items(), ("", "there is none")][0]
        return f"{name}: {why}"

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

    Estimates and uncertainties are those of `fit` with the same method. A device whose readings cannot be used, or
    whose fit does not converge, gets a reason and changes nothing for the others.
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
        method: `LeastSquares()` if not given; or `Marginal()`, by importance sampling alone.
        population: True for all coefficients that a device has one of, or names, or names with priors of their standard
            deviations between devices.
        seed: of every random number.
        chunk: devices fitted at once at most, which bounds memory.
        reference: constants of the bases, in place of each device's own; a population sets T0 to that of all readings.
        client: of a Dask cluster whose workers see the files and `out` under the same paths.
        out: folder for the results of partitions. What follows goes with it.
        partition_rows: readings in a partition, about; a process holds one at a time.
        columns: how files are read: arguments of `split_devices`, such as {"units": {"rate": "rad/s"}}.
        find: whether each device's missing effects are searched (about a second a device), or how.

    Raises:
        InputError: no device that can be used, files that cannot be read, a client without `out`, a cluster gone.
        ModelError: a method that cannot be mapped, or a population of something that is no coefficient.
    """
    options = FitOptions.of(model, method, seed, chunk, reference)
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
        return fit_fleet(model, resolved, Path(out), options, population, **how)
    if client is not None or find:
        raise InputError("workers and searches write by partition: give out=, a folder")
    needs = tuple(dict.fromkeys(c for e in model.effects for c in e.columns))
    devices = split_devices(paths, model.instrument, needs=needs) if paths else _given(readings)
    model, _ = tailored_to_first(model, devices)
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
