"""One verb for many devices of one type: `fit_batch`, in this process or on a cluster.

Files are cut into parts that one process can hold; each is read and fitted, and what comes of all is put together.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow.dataset as pads

from bayescal import InputError, Measurements, Model, Settings, use_settings
from bayescal._annexes.fleet.batch_result import BatchResult, first_few
from bayescal._annexes.fleet.device_files import (
    DevicePart,
    Piece,
    files_of,
    parts_of,
    read_part,
    repeated,
)
from bayescal._annexes.fleet.devices import DEVICE, Devices, gathered
from bayescal._annexes.fleet.engine import run_tasks
from bayescal._annexes.fleet.find_devices import (
    Find,
    common_model,
    effects_table,
    search_devices,
)
from bayescal._annexes.fleet.fit_devices import (
    CHUNK,
    FitOptions,
    Fits,
    Method,
    Reference,
    common_reference,
    tailored_to_first,
    temperature_sums,
)
from bayescal._annexes.fleet.odd_devices import odd_devices
from bayescal._annexes.fleet.partial_pooling import pooled
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
Part = tuple[Piece, ...] | DevicePart  # files to read, or what was read


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

    def read(self, part: Part) -> DevicePart:
        """Read a part, unless it was."""
        if isinstance(part, DevicePart):
            return part
        return read_part(part, self.model, self.read_options)


def fit_part(request: Request, part: Part) -> Fits:
    """Read and fit the devices of a part."""
    with HOLDS_PART, use_settings(request.settings):
        read = request.read(part)
        devices, options = read.devices, request.fit_options
        fits = Fits(options, [*devices.names], dict(devices.refused))
        fits.places, fits.missing = read.places, read.unreadable
        if request.find is None:
            fits.fit_groups([(request.model, devices)])
            return fits
        fits.structures, groups, refused = search_devices(
            request.model, devices, request.find, options.reference
        )
        fits.reasons |= refused
        with deadline.finishing():
            fits.fit_groups(groups)
        return fits


def _temperature_sums(request: Request, part: Part) -> list[tuple[str, float, int]]:
    with use_settings(request.settings):
        return temperature_sums(request.read(part).devices)


@dataclass(frozen=True)
class _Run:
    """Parts of a batch, and where they are fitted."""

    request: Request
    parts: Sequence[Part]
    client: Client | None

    def with_common(self, pooled: bool) -> _Run:
        """The same with what has to be one for all devices: constants of a population, the unit.

        Raises:
            InputError: a part cannot be read, or no device has what the instrument takes from readings.
        """
        request, options = self.request, self.request.fit_options
        whole = isinstance(self.parts[0], DevicePart)
        if pooled and (whole or "T0" not in options.reference):
            if not whole:
                tell("reading all temperatures, for a common T0 (a reference given spares that)")
            with deadline.finishing():
                outcomes = [*run_tasks(self.client, _temperature_sums, self._tasks(request))]
            if why := "; ".join(outcome.error for outcome in outcomes if outcome.error):
                raise InputError(why)
            sums = [own for o in sorted(outcomes, key=lambda o: o.index) for own in o.value]
            request = replace(request, fit_options=options.with_common(common_reference(sums)))
        if request.model.instrument.tailor is None:
            return replace(self, request=request)
        errors = list[str]()
        for part in self.parts:
            try:
                model = tailored_to_first(request.model, request.read(part).devices)
            except InputError as error:
                errors.append(str(error))
            else:
                if model is not request.model:
                    return replace(self, request=replace(request, model=model))
        if errors:
            raise InputError(f"none of the devices can be used; {errors[0]}")
        return replace(self, request=request)

    def fitted(self) -> Fits:
        """Fit all parts, and put them together in their order."""
        values, missing = dict[int, Fits](), dict[str, str]()
        begun = last = time.monotonic()
        tasks = self._tasks(self.request)
        for count, outcome in enumerate(run_tasks(self.client, fit_part, tasks), 1):
            if outcome.error:
                part = self.parts[outcome.index]
                files = part.places if isinstance(part, DevicePart) else [p.name for p in part]
                missing |= dict.fromkeys(files, outcome.error)
            else:
                values[outcome.index] = outcome.value
            if time.monotonic() > last + PROGRESS_SECONDS:
                last = time.monotonic()
                devices = sum(len(own.names) for own in values.values())
                rest = (last - begun) * (len(tasks) / count - 1)
                tell(f"{devices:,} devices, about {rest:,.0f} s left")
        together = Fits(self.request.fit_options, missing=missing)
        for _, own in sorted(values.items()):
            together.extend(own)
        together.refuse(repeated(together.places))
        return together

    def _tasks(self, request: Request) -> list[tuple[Request, Part]]:
        return [(request, part) for part in self.parts]


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
        parts = [DevicePart(_given(readings), {}, {})]
    if client is not None and client.cluster is None and client.dashboard_link:
        tell(f"the cluster's dashboard: {client.dashboard_link}")
    with deadline.until(time_limit):
        run = _Run(request, parts, client).with_common(bool(population))
        result = _fit(run, population)
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
    result = fitted.result(model)
    if not result.parts:
        reasons = fitted.reasons | fitted.missing
        lines = "\n".join(first_few(reasons, len(reasons))).strip()
        raise InputError(f"none of the devices can be used; {lines or 'there is none'}")
    structures = [fitted.structures[name] for name in result.devices if name in fitted.structures]
    effects = effects_table(structures, options.seed)
    common = common_model(model, structures, effects, find.effects if find else ())
    alike, compared = options.compared_at(result.facts), result
    if alike or common is not model:
        again = replace(run.request, model=common, fit_options=alike or options, find=None)
        compared = replace(run, request=again).fitted().result(common)
    return replace(
        pooled(result, named, options.seed) if named else result,
        odd=odd_devices(pads.dataset(compared.rows()), result.facts, common.noise.parameters()),
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
