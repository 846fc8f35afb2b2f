"""One verb for many devices of one type: `fit_batch`, in this process or on a cluster.

Files are cut into parts that one process can hold; each is read and fitted, and what comes of all is put together.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa

from bayescal import BayescalError, InputError, Measurements, Model, Settings, use_settings
from bayescal._annexes.fleet.batch_result import (
    BatchResult,
    first_few,
    pooled,
    rows_of,
    without_repeated,
)
from bayescal._annexes.fleet.device_files import Piece, files_of, parts_of, read_part
from bayescal._annexes.fleet.devices import DEVICE, Devices, gathered
from bayescal._annexes.fleet.engine import run_tasks
from bayescal._annexes.fleet.find_devices import (
    DeviceStructure,
    Find,
    common_model,
    effects_table,
    search_device,
)
from bayescal._annexes.fleet.fit_devices import (
    CHUNK,
    FitOptions,
    Method,
    Reference,
    fit_devices,
    tailored,
    temperature_sums,
)
from bayescal._annexes.fleet.odd_devices import odd_devices
from bayescal._annexes.fleet.population import AskedPopulation, chosen
from bayescal._core import deadline
from bayescal._core.settings import settings
from bayescal.workshop import ReadOptions, note, refuse_missing, stage, tell

if TYPE_CHECKING:
    from distributed import Client

ROWS = 500_000  # readings in a part, which with JAX takes 0.6 GB of a worker
FIND_ROWS = 5_000  # where each device is searched: so that no more than a minute or two is lost
PROGRESS_SECONDS = 9.0  # between two lines about how far it is
HOLDS_PART = threading.Lock()  # a worker of several threads holds one part at a time all the same

Readings = (
    Devices
    | Sequence[Measurements]
    | Mapping[str, Measurements]
    | str
    | Path
    | Sequence[str | Path]
)


class FilesRead(NamedTuple):
    """What was read of a part: devices by file, and why files cannot be used."""

    devices: dict[str, Devices]
    unreadable: dict[str, str]


Part = tuple[Piece, ...] | FilesRead  # files to read, or what was read


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

    def read(self, part: Part) -> FilesRead:
        """Read a part, unless it was."""
        if isinstance(part, FilesRead):
            return part
        return FilesRead(*read_part(part, self.model, self.read_options))

    def measurements(self, part: Part) -> list[Measurements]:
        """Return the readings of a part's devices."""
        return [one for devices in self.read(part).devices.values() for one in devices]


@dataclass
class Fits:
    """What came of some parts.

    Attributes:
        rows: of their devices, as `BatchResult` has them.
        structures: of the devices that were searched.
        missing: file → why its devices have no results.
    """

    rows: pa.Table
    structures: dict[str, DeviceStructure] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)

    @classmethod
    def together(cls, some: Sequence[Fits]) -> Fits:
        """Put parts together, in their order."""
        found = cls(
            without_repeated(pa.concat_tables([rows_of((), (), (), ()), *(f.rows for f in some)]))
        )
        for own in some:
            found.structures |= own.structures
            found.missing |= own.missing
        return found


def fit_part(request: Request, part: Part) -> Fits:
    """Read and fit the devices of a part."""
    with HOLDS_PART, use_settings(request.settings):
        read, options = request.read(part), request.fit_options
        every = [(file, own, name) for file, own in read.devices.items() for name in own.names]
        reasons = {i: own.refused.get(name, "") for i, (_, own, name) in enumerate(every)}
        good = {i: every[i][1][every[i][2]] for i, why in reasons.items() if not why}
        structures, models = dict[str, DeviceStructure](), dict.fromkeys(good, request.model)
        for i in good if request.find else ():
            try:
                found = search_device(request.model, good[i], request.find, options.reference)
            except (BayescalError, deadline.TimeIsUp) as error:
                reasons[i] = str(error)
            else:
                structures[every[i][2]], models[i] = found
        good = {i: own for i, own in good.items() if not reasons[i]}
        with deadline.finishing() if request.find else nullcontext():
            fitted, against = fit_devices(models, good, options)
        files, _, names = zip(*every, strict=True) if every else ((), (), ())
        rows = rows_of(names, files, [*(reasons | against).values()], fitted)
        return Fits(rows, structures, read.unreadable)


def _temperature_sums(request: Request, part: Part) -> dict[str, np.ndarray]:
    with use_settings(request.settings):
        return temperature_sums(request.measurements(part))


@dataclass(frozen=True)
class _Run:
    """Parts of a batch, and where they are fitted."""

    request: Request
    parts: Sequence[Part]
    client: Client | None

    def with_reference(self) -> _Run:
        """The same with T0 and its like over all devices, so that offsets mean the same for each.

        Raises:
            InputError: a part cannot be read.
        """
        if not isinstance(self.parts[0], FilesRead):
            if "T0" in self.request.fit_options.reference:
                return self
            tell("reading all temperatures, for a common T0 (a reference given spares that)")
        with deadline.finishing():
            outcomes = sorted(run_tasks(self.client, _temperature_sums, self._tasks))
        if why := "; ".join(outcome.error for outcome in outcomes if outcome.error):
            raise InputError(why)
        total: dict[str, np.ndarray] = {}
        for outcome in outcomes:
            for name, own in outcome.value.items():
                total[name] = total.get(name, 0.0) + own
        common: Reference = {name: float(np.round(s / n)) for name, (s, n) in total.items()}
        return self.asking(fit_options=self.request.fit_options.with_common(common))

    def tailored(self) -> _Run:
        """The same with the model tailored to the first device that it can be tailored to.

        Raises:
            InputError: no device has what the instrument takes from readings: why, of the first.
        """
        if (model := self.request.model).instrument.tailor is None:
            return self
        refusals = list[str]()
        for part in self.parts:
            for readings in self.request.measurements(part):
                try:
                    return self.asking(model=tailored(model, readings))
                except InputError as error:
                    refusals.append(str(error))
        if refusals:
            raise InputError(f"none of the devices can be used; {refusals[0]}")
        return self

    def asking(self, **changed: Any) -> _Run:
        """The same of a request in which something is another."""
        return replace(self, request=replace(self.request, **changed))

    def fitted(self) -> Fits:
        """Fit all parts, and put them together in their order."""
        values, missing = dict[int, Fits](), dict[str, str]()
        begun = last = time.monotonic()
        for count, outcome in enumerate(run_tasks(self.client, fit_part, self._tasks), 1):
            if outcome.error:
                part = self.parts[outcome.index]
                files = part.devices if isinstance(part, FilesRead) else [p.name for p in part]
                missing |= dict.fromkeys(files, outcome.error)
            else:
                values[outcome.index] = outcome.value
            if time.monotonic() > last + PROGRESS_SECONDS:
                last = time.monotonic()
                share = count / len(self.parts)
                rest = (last - begun) * (1 - share) / share
                tell(f"{share:.0%} of the readings, about {rest:,.0f} s left")
        together = Fits.together([own for _, own in sorted(values.items())])
        return replace(together, missing=missing | together.missing)

    @property
    def _tasks(self) -> list[tuple[Request, Part]]:
        return [(self.request, part) for part in self.parts]


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
) -> BatchResult:
    """Fit one model to many devices of one type, each by itself, in a few compiled programs.

        result = bc.fit_batch(mems_gyro.INSTRUMENT.baseline(), "lot.parquet", population=True)
        result["A17"], result.table()  # device, coefficient, mean, sd, unit, ok, reason
        bc.fit_batch(model, "fleet/", out="fleet.parquet", client=distributed.Client("tcp://10.0.0.5:8786"))

    Estimates, uncertainties and objections are those of `fit` with the same method and seed. A device whose readings
    cannot be used, or against whose fit something stands, gets a reason and changes nothing for the others.
    **Population.** Coefficients named there are drawn from a normal distribution over the devices, whose mean and
    standard deviation are learned; every device moves toward it by as much as its own readings leave open. Exact for a
    linear model with Gaussian noise that is known; else each device is represented by its mean and covariance.

    **Files** are read and fitted some at a time, here or by the workers of a Dask `client`, with the same numbers. One
    that cannot be read is named in `missing`; a device that stands in several files is refused.

    Args:
        model: what is fitted; what its instrument takes from readings (unit, sizes) is taken from the first device.
        readings: `split_devices(…)`; paths of files with a column `device` and of folders of files; or measurements,
            one a device (a mapping names them).
        method: `LeastSquares()` if not given. `Marginal()` samples without chains: a device that needs them is told.
        population: True for all coefficients that a device has one of, or names, or names with priors of their standard
            deviations between devices.
        seed: of every random number.
        chunk: devices fitted at once at most, which bounds memory.
        reference: constants of the bases, in place of each device's own; a population sets T0 to that of all readings.
        time_limit: seconds, after which devices that were not reached are refused with that reason, as at Ctrl-C.
        client: of a Dask cluster whose workers see the files under the same paths.
        out: where the result is saved, as by `BatchResult.save`.
        partition_rows: readings that a process holds at once, about.
        columns: how files are read: arguments of `split_devices`, such as {"units": {"rate": "rad/s"}}.
        find: whether each device's missing effects are searched (about a second a device), or how.

    Raises:
        InputError: no device that can be used, paths that are not there, a result that cannot be written.
        ModelError: a population of something that is no coefficient.
    """
    options = FitOptions.of(method, seed, chunk, reference)
    chosen(model, population)  # a wrong name is refused before anything is read
    search = Find() if find is True else find or None
    read_options = ReadOptions.of(model.instrument, **(columns or {}))
    request = Request(model, options, read_options, search, settings())
    paths, unread, parts = _paths(readings), dict[str, str](), list[Part]()
    if paths:
        refuse_missing([path for path in paths if not path.is_dir()])
        files, unread = files_of([p.resolve() for p in paths])
        for line in first_few(unread, len(unread), "not read: "):
            note(line.strip())
        device = read_options.columns.get(DEVICE, DEVICE)
        usual = FIND_ROWS if search else ROWS
        parts += parts_of(files, usual if partition_rows is None else partition_rows, device)
        if len(parts) == 1 and client is None:  # several of the steps below see its readings
            parts = [request.read(parts[0])]
    else:
        parts = [FilesRead({"": _given(readings)}, {})]
    if client is not None and client.cluster is None and client.dashboard_link:
        tell(f"the cluster's dashboard: {client.dashboard_link}")
    with deadline.until(time_limit):
        run = _Run(request, parts, client)
        run = run.with_reference() if population else run
        result = _fit(run.tailored(), population)
    result = replace(result, left_out=unread)
    if out is not None:
        result.save(out)
    return result


def _fit(run: _Run, population: AskedPopulation) -> BatchResult:
    """Fit all devices, compare them with each other, and put a population to them.

    Raises:
        InputError: none can be used.
    """
    model, options, find = run.request.model, run.request.fit_options, run.request.find
    named = chosen(model, population)
    with stage("fitting devices"):
        fitted = run.fitted()
    rows = fitted.rows
    result = BatchResult(rows, options.data(model))
    if not rows["coefficient"].null_count < len(rows):
        reasons = result.doubted | fitted.missing
        lines = "\n".join(first_few(reasons, len(reasons))).strip()
        raise InputError(f"none of the devices can be used; {lines or 'there is none'}")
    structures = [fitted.structures[name] for name in result.devices if name in fitted.structures]
    effects = effects_table(structures, options.seed)
    common = common_model(model, structures, effects, find.effects if find else ())
    alike, compared = options.compared_at(result.facts), rows
    if alike or common is not model:
        again = {"model": common, "fit_options": alike or options, "find": None}
        compared = run.asking(**again).fitted().rows
    rows, learned = pooled(rows, named, options.seed) if named else (rows, None)
    return replace(
        result,
        rows=rows,
        population=learned,
        odd=odd_devices(compared, result.facts["T0"], common.noise.parameters()),
        checked=len(structures),
        missing=fitted.missing,
        effects=effects,
    )


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
    if not len(given):
        raise InputError("there is no device to fit: give at least one")
    for i, one in enumerate(given.values() if isinstance(given, Mapping) else given):
        if not isinstance(one, Measurements):
            raise InputError(
                f"fit_batch: entry {i + 1} of the readings is of type {type(one).__name__}; measurements were "
                "expected, or paths"
            )
    return gathered(given)
