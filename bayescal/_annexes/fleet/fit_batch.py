"""One verb for many devices of one type: `fit_batch`, in this process or on a cluster.

Files are cut into parts that one process can hold; each is read and fitted, and what comes of all is put together.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.fleet.batch_result import (
    BatchResult,
    DeviceResult,
    first_few,
    once_each,
    pooled,
)
from bayescal._annexes.fleet.device_files import cut, files_of, parts_of
from bayescal._annexes.fleet.devices import Devices, devices_of, gathered
from bayescal._annexes.fleet.engine import run_tasks
from bayescal._annexes.fleet.find_devices import (
    DeviceStructure,
    Find,
    common_model,
    effects_table,
    search_device,
)
from bayescal._annexes.fleet.fit_devices import (
    FitOptions,
    Reference,
    fit_devices,
    tailored,
)
from bayescal._annexes.fleet.odd_devices import odd_devices
from bayescal._annexes.fleet.population import AskedPopulation, chosen

if TYPE_CHECKING:
    from distributed import Client

ROWS = 500_000  # readings in a part, which with JAX takes 0.6 GB of a worker
FIND_ROWS = 5_000  # where each device is searched: so that no more than a minute or two is lost
PROGRESS_SECONDS = 9.0  # between two lines about how far it is

Readings = (
    Devices
    | Sequence[bc.Measurements]
    | Mapping[str, bc.Measurements]
    | str
    | Path
    | Sequence[str | Path]
)
Part = Sequence[Path | Devices]


@dataclass(frozen=True)
class Request:
    """What is fitted to every device, and how its file is read."""

    model: bc.Model  # what is fitted
    fit_options: FitOptions  # of every fit
    read_options: ws.ReadOptions  # how columns are understood
    find: Find | None  # what is looked for in each device, if anything is
    settings: bc.Settings  # that hold where this was asked, and are to hold on the workers

    def read(self, part: Part) -> tuple[list[Devices], dict[str, str]]:
        """Read a part; and why files of it cannot be used."""
        pieces, unreadable = list[Devices](), dict[str, str]()
        model = self.model
        needs = tuple(dict.fromkeys(c for e in model.effects for c in e.columns))
        for entry in part:
            if isinstance(entry, Devices):
                pieces.append(entry)
                continue
            try:
                pieces.append(devices_of(entry, model.instrument, self.read_options, needs))
            except (bc.InputError, OSError) as error:
                unreadable[entry.name] = str(error)
        return pieces, unreadable


class Fits(NamedTuple):
    """What came of some parts."""

    results: tuple[DeviceResult, ...]  # of their devices
    structures: dict[str, DeviceStructure]  # of the devices that were searched
    missing: dict[str, str]  # file → why its devices have no results


def fit_part(request: Request, part: Part) -> Fits:
    """Read and fit the devices of a part."""
    with bc.use_settings(request.settings):
        (pieces, unreadable), options = request.read(part), request.fit_options
        devices = [(piece, name) for piece in pieces for name in piece.names]
        refused = [piece.refused.get(name) for piece, name in devices]
        fitted = {i: DeviceResult(reason=why) for i, why in enumerate(refused) if why}
        good = {i: p[name] for i, (p, name) in enumerate(devices) if i not in fitted}
        structures, models = dict[str, DeviceStructure](), dict.fromkeys(good, request.model)
        starts = dict[int, Mapping[str, float]]()
        for i, find in ((i, request.find) for i in [*good] if request.find):
            try:
                args = request.model, good[i], find, options.reference
                structures[devices[i][1]], models[i], starts[i] = search_device(*args)
            except (bc.BayescalError, ws.deadline.TimeIsUp) as error:
                fitted[i] = DeviceResult(reason=str(error))
                del good[i]
        with ws.deadline.finishing() if request.find else nullcontext():
            fitted |= fit_devices(models, good, options, starts)
        results = [
            replace(fitted[i], device=name, file=piece.file)
            for i, (piece, name) in enumerate(devices)
        ]
        return Fits(tuple(results), structures, unreadable)


def _refused(part: Part, why: str) -> Fits:
    """Return a part that nothing came of: devices of what was read have that reason, of files nothing is known."""
    results = tuple(
        DeviceResult(name, piece.refused.get(name, why), file=piece.file)
        for piece in part
        if isinstance(piece, Devices)
        for name in piece.names
    )
    return Fits(results, {}, {piece.name: why for piece in part if isinstance(piece, Path)})


def sum_temperatures(request: Request, part: Part) -> dict[str, np.ndarray]:
    """Return sum and number of a part's temperatures, by the name of each column's reference."""
    total: dict[str, np.ndarray] = {}
    with bc.use_settings(request.settings):
        for device in (device for piece in request.read(part)[0] for device in piece):
            for name in (n for n in device.columns if device.unit(n) == "degC"):
                sums = total.setdefault(ws.reference_name(name), np.zeros(2))
                sums += np.sum(device[name]), len(device)
    total.pop(ws.reference_name("temperature_point"), None)
    return total


@dataclass(frozen=True)
class _Run:
    """Parts of a batch, and where they are fitted."""

    request: Request
    parts: Sequence[Part]
    client: Client | None

    def run_each(self, function: Callable[..., Any]) -> tuple[list[Any], dict[int, str]]:
        """Return what a function gives of the parts, in their order, and why it gives nothing of others."""
        values, errors = dict[int, Any](), dict[int, str]()
        start = last = time.monotonic()
        tasks = [(self.request, part) for part in self.parts]
        read = all(isinstance(piece, Devices) for part in self.parts for piece in part)
        sizes = [sum(len(getattr(p, "names", "1")) for p in part) for part in self.parts]
        count, total, what = 0, sum(sizes), "devices" if read else "files"
        for i, value, error in run_tasks(self.client, function, tasks):
            (errors if error else values)[i] = error or value
            count += sizes[i]
            if time.monotonic() > last + PROGRESS_SECONDS and count < total:
                last = time.monotonic()
                remaining = (last - start) * (total / count - 1)
                ws.tell(
                    f"{count:,} of {total:,} {what}, about {remaining:,.0f} s left", count / total
                )
        return [value_of_part for _, value_of_part in sorted(values.items())], errors

    def with_request(self, **changed: Any) -> _Run:
        """Return the run with a changed request."""
        return replace(self, request=replace(self.request, **changed))

    def with_reference(self) -> _Run:
        """Return the run with one T0 over all devices; raise InputError if a part is unreadable."""
        options = self.request.fit_options
        if not isinstance(self.parts[-1][0], Devices):
            if "T0" in options.reference:
                return self
            ws.tell("reading all temperatures, for a common T0 (a reference given spares that)")
        with ws.deadline.finishing():
            sums, errors = self.run_each(sum_temperatures)
        if errors:
            raise bc.InputError("; ".join(errors.values()))
        names = dict.fromkeys(name for part in sums for name in part)
        total = {name: sum(part.get(name, np.zeros(2)) for part in sums) for name in names}
        common: Reference = {name: float(np.round(s / n)) for name, (s, n) in total.items()}
        return self.with_request(fit_options=replace(options, reference=common | options.reference))

    def tailored(self) -> _Run:
        """Return the run with the model tailored to the first device that it can be tailored to.

        Raises:
            InputError: no device has what the instrument takes from readings: why, of the first.
        """
        model, refusals = self.request.model, list[str]()
        for part in self.parts if model.instrument.tailor is not None else ():
            for readings in (d for piece in self.request.read(part)[0] for d in piece):
                try:
                    return self.with_request(model=tailored(model, readings))
                except bc.InputError as error:
                    refusals.append(str(error))
        if refusals:
            raise bc.InputError(f"none of the devices can be used; {refusals[0]}")
        return self

    def fitted(self) -> Fits:
        """Fit all parts, and put them together."""
        fits, errors = self.run_each(fit_part)
        fits += [_refused(self.parts[i], why) for i, why in errors.items()]
        structures, missing = dict[str, DeviceStructure](), dict[str, str]()
        for part in fits:
            structures |= part.structures
            missing |= part.missing
        results = once_each(fit for part in fits for fit in part.results)
        return Fits(results, structures, missing)


def fit_batch(
    model: bc.Model,
    readings: Readings,
    *,
    method: ws.Method | None = None,
    population: AskedPopulation = False,
    seed: int | np.random.Generator = 0,
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
        seed: of every random number, or NumPy's generator, which draws it.
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
    method = method or bc.LeastSquares()
    if isinstance(method, bc.Marginal):  # chains of single devices, minutes each, are left to `fit`
        method = replace(method, chains=False)
    options = FitOptions(method, ws.seed_of(seed), dict(reference or {}))
    chosen(model, population)  # a wrong name is refused before anything is read
    search = Find() if find is True else find or None
    read_options = ws.ReadOptions.of(model.instrument, **(columns or {}))
    request = Request(model, options, read_options, search, ws.settings())
    paths, unread, parts = _paths(readings), dict[str, str](), list[Part]()
    rows = (FIND_ROWS if search else ROWS) if partition_rows is None else partition_rows
    if rows < 1:
        raise bc.InputError(f"partition_rows is {rows}: give at least 1")
    if paths:
        ws.refuse_missing([path for path in paths if not path.is_dir()])
        files, unread = files_of([p.resolve() for p in paths])
        ws.print_notes(line.strip() for line in first_few(unread, len(unread), "not read: "))
        parts += parts_of(files, rows)
        if len(parts) == 1:  # several of the steps below see its readings
            by_file = {path: request.read([path])[0] for path in files}
            lost = [path for path, devices in by_file.items() if not devices]
            pieces = cut((piece for devices in by_file.values() for piece in devices), rows)
            parts = [part for part in (lost, *pieces) if part]
    else:
        parts += cut([_gather(readings)], rows)
    if client is not None and client.cluster is None and client.dashboard_link:
        ws.tell(f"the cluster's dashboard: {client.dashboard_link}")
    with ws.deadline.until(time_limit):
        run = _Run(request, parts, client)
        run = run.with_reference() if population else run
        result = _fit(run.tailored(), population)
    result = replace(result, left_out=unread)
    if out is not None:
        result.save(out)
    return result


def _fit(run: _Run, population: AskedPopulation) -> BatchResult:
    """Fit all devices, compare them, and put a population to them; raise InputError if none can be used."""
    model, options, find = run.request.model, run.request.fit_options, run.request.find
    named = chosen(model, population)
    with ws.stage("fitting devices"):
        fitted = run.fitted()
    about = {
        "instrument": model.instrument.name,
        "effects": list(model.names),
        "noise": model.noise.law,
        "method": options.method.name,
        "seed": options.seed,
        "reference": {k: v for k, v in options.reference.items() if not isinstance(v, dict)},
    }
    result = BatchResult(
        fitted.results, about | ({"settings": settings} if (settings := ws.unusual()) else {})
    )
    if not any(fit.names for fit in result):
        reasons = result.unreliable | fitted.missing
        lines = "\n".join(first_few(reasons, len(reasons))).strip()
        raise bc.InputError(f"none of the devices can be used; {lines or 'there is none'}")
    structures = [fitted.structures[name] for name in result.devices if name in fitted.structures]
    effects = effects_table(structures, options.seed)
    common = common_model(model, structures, effects, find.effects if find else ())
    if shapes := _usual_shapes(common, model, fitted.results):
        common = common.fix(shapes)
    t0, compared = result.facts["T0"], result.results
    t0_differs = "T0" not in options.reference and t0.dropna().nunique() > 1
    if t0_differs:  # offsets are compared at one temperature
        reference = {**options.reference, "T0": float(t0.median().round())}
        options = replace(options, reference=reference, method=bc.LeastSquares())
    if t0_differs or common is not model:
        compared = run.with_request(model=common, fit_options=options, find=None).fitted().results
    results, learned = result.results, None
    if named:
        results, learned = pooled(results, named, options.seed)
    return replace(
        result,
        results=results,
        population=learned,
        odd=odd_devices(compared, t0, common.noise.parameters()),
        checked=len(structures),
        missing=fitted.missing,
        effects=effects,
    )


def _usual_shapes(
    common: bc.Model, model: bc.Model, results: Sequence[DeviceResult]
) -> dict[str, float]:
    """Return the medians of shapes over the devices that have them: of the others these would be the priors'."""
    added = (e for e in common.effects if e.name not in model.names)
    names = [e.shape_name(s) for e in added for s in e.shapes]
    means = {n: [fit[n][0] for fit in results if fit.ok and n in fit.names] for n in names}
    return {name: float(np.median(values)) for name, values in means.items() if values}


def _paths(readings: Any) -> list[Path]:
    """Return paths of files, where they are given; else none."""
    if isinstance(readings, str | Path):
        return [Path(readings)]
    if isinstance(readings, Devices | Mapping):
        return []
    return [Path(p) for p in readings] if all(isinstance(p, str | Path) for p in readings) else []


def _gather(readings: Any) -> Devices:
    """Return devices as they were given, or of measurements."""
    if isinstance(readings, Devices):
        return readings
    entries = readings if isinstance(readings, Mapping) else list(readings)
    if not len(entries):
        raise bc.InputError("there is no device to fit: give at least one")
    for i, entry in enumerate(entries.values() if isinstance(entries, Mapping) else entries):
        if not isinstance(entry, bc.Measurements):
            raise bc.InputError(
                f"fit_batch: entry {i + 1} of the readings is of type {type(entry).__name__}; measurements were "
                "expected, or paths"
            )
    return gathered(entries)
