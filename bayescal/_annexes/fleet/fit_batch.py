"""Fit many devices of one type with `fit_batch`, in this process or on a cluster.

A task reads one file, or fits one batch of devices.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.fleet.batch_result import BatchResult, DeviceResult, first_few, refuse_suffix
from bayescal._annexes.fleet.devices import Devices, devices_of, files_of
from bayescal._annexes.fleet.engine import run_tasks
from bayescal._annexes.fleet.find_devices import common_model, effects_table, search_device
from bayescal._annexes.fleet.fit_devices import FitOptions, Reference, fit_devices, tailored
from bayescal._annexes.fleet.odd_devices import odd_devices

if TYPE_CHECKING:
    from distributed import Client

READINGS_PER_TASK = 500_000  # which with JAX take 0.6 GB of a worker
READINGS_PER_SEARCH = 5_000  # so that no more than a minute or two is lost with a worker
PROGRESS_SECONDS = 9.0  # between two lines about how far it is

Paths = str | Path | Sequence[str | Path]
Readings = Devices | Sequence[bc.Measurements] | Mapping[str, bc.Measurements] | Paths


@dataclass(frozen=True)
class Request:
    """The model and options that are fitted to every device."""

    model: bc.Model  # what is fitted
    fit_options: FitOptions  # of every fit
    find: bool  # whether each device's missing effects are searched
    candidates: tuple[bc.Effect, ...]  # of the user's own, which are searched too
    settings: bc.Settings  # that hold where this was asked, and are to hold on the workers


def fit_device_batch(request: Request, devices: Devices) -> list[DeviceResult]:
    """Search and fit one batch of devices."""
    with bc.use_settings(request.settings):
        results = {name: DeviceResult(reason=why) for name, why in devices.refused.items()}
        good, structures, starts = dict(devices.measurements), {}, dict[str, Mapping[str, float]]()
        models, options = dict.fromkeys(good, request.model), request.fit_options
        for name in [*good] if request.find else ():
            try:
                arguments = good[name], request.candidates, options.reference
                searched = search_device(request.model, *arguments)
                structures[name], models[name], starts[name] = searched
            except (bc.BayescalError, ws.deadline.TimeIsUp) as error:
                results[name] = DeviceResult(reason=str(error))
                del good[name]
        with ws.deadline.finishing() if request.find else nullcontext():
            results |= fit_devices(models, good, options, starts)
        return [
            replace(results[name], device=name, structure=structures.get(name))
            for name in devices.names
        ]


def read_file(
    path: Path, model: bc.Model, options: ws.ReadOptions, settings: bc.Settings
) -> Devices:
    """Read the devices of a file, with the columns that a model needs."""
    needs = tuple(dict.fromkeys(c for e in model.effects for c in e.columns))
    with bc.use_settings(settings):
        return devices_of(path, model.instrument, options, needs)


def run_each(
    client: Client | None, function: Callable[..., Any], tasks: Sequence[tuple], what: str
) -> Iterator[tuple[int, Any, str]]:
    """Yield what a function gives of tasks as it comes, as `run_tasks`, and say how many of `what` are done."""
    start = last = time.monotonic()
    for count, outcome in enumerate(run_tasks(client, function, tasks), start=1):
        yield outcome
        if time.monotonic() > last + PROGRESS_SECONDS and count < len(tasks):
            last, share = time.monotonic(), count / len(tasks)
            seconds = (last - start) * (1 / share - 1)
            ws.tell(f"{count:,} of {len(tasks):,} {what}, about {seconds:,.0f} s left", share)


def read_files(
    files: Sequence[Path], model: bc.Model, options: ws.ReadOptions, client: Client | None
) -> tuple[Devices, dict[str, str]]:
    """Read files of devices; return these, and of files that cannot be read why."""
    by_file, errors = dict[int, Devices](), dict[str, str]()
    tasks = [(path, model, options, ws.settings()) for path in files]
    for i, devices, error in run_each(client, read_file, tasks, "files"):
        if error:
            errors[files[i].name] = error
        else:
            by_file[i] = devices
    return Devices.of_files({files[i]: by_file[i] for i in sorted(by_file)}), errors


def fit_all(client: Client | None, request: Request, devices: Devices) -> tuple[DeviceResult, ...]:
    """Fit all devices, some at a time; those that are not reached have that reason."""
    sizes = [len(devices.measurements.get(name, ())) for name in devices.names]
    most = READINGS_PER_SEARCH if request.find else READINGS_PER_TASK
    cuts = np.flatnonzero(np.diff(np.cumsum(sizes) // most)) + 1
    parts = [devices.some(part.tolist()) for part in np.split(np.array(devices.names), cuts)]
    tasks, results = [(request, part) for part in parts], dict[str, DeviceResult]()
    for i, fitted, error in run_each(client, fit_device_batch, tasks, "parts of the devices"):
        refused = {name: DeviceResult(name, error) for name in parts[i].names}
        results |= refused if error else {fit.device: fit for fit in fitted}
    return tuple(results[name] for name in devices.names)


def tailored_to_any(model: bc.Model, devices: Devices) -> bc.Model:
    """Return the model tailored to the first device that it can be tailored to, if it can be at all."""
    for readings in devices if model.instrument.tailor is not None else ():
        with suppress(bc.InputError):
            return tailored(model, readings)
    return model


def fit_batch(
    model: bc.Model,
    readings: Readings,
    *,
    method: ws.Method | None = None,
    seed: int | np.random.Generator = 0,
    reference: Reference | None = None,
    time_limit: float | None = None,
    client: Client | None = None,
    out: str | Path | None = None,
    columns: Mapping[str, Any] | None = None,
    find: bool = False,
    effects: Sequence[bc.Effect] = (),
) -> BatchResult:
    """Fit one model to many devices of one type, each by itself, in a few compiled programs.

        result = bc.fit_batch(mems_gyro.INSTRUMENT.baseline(), "lot.parquet")
        result["A17"], result.table()  # device, coefficient, mean, sd, unit, ok, reason
        bc.fit_batch(model, "fleet/", out="fleet.parquet", client=distributed.Client("tcp://10.0.0.5:8786"))

    Estimates, uncertainties and objections are those of `fit` with the same method and seed. A device whose readings
    cannot be used, or against whose fit something stands, gets a reason and changes nothing for the others.

    Files are read and devices are fitted here or by the workers of a Dask `client`, with the same numbers. A file that
    cannot be read is named in `missing`; a device that stands in several files is refused.

    Args:
        model: what is fitted; what its instrument takes from readings (unit, sizes) is taken from the first device.
        readings: `split_devices(…)`; paths of files with a column `device` and of folders of files; or measurements,
            one a device (a mapping names them).
        method: `LeastSquares()` if not given. `Marginal()` samples without chains: a device that needs them is told.
        seed: of every random number, or NumPy's generator, which draws it.
        reference: constants of the bases, in place of each device's own.
        time_limit: seconds, after which devices that were not reached are refused with that reason, as at Ctrl-C.
        client: of a Dask cluster whose workers see the files under the same paths.
        out: where the result is saved, as by `BatchResult.save`.
        columns: how files are read: arguments of `split_devices`, such as {"units": {"rate": "rad/s"}}.
        find: whether each device's missing effects are searched (about a second a device).
        effects: candidates of one's own for that search.

    Raises:
        InputError: no device that can be used, paths that are not there, a result that cannot be written.
    """
    out = None if out is None else refuse_suffix(Path(out))  # before anything is fitted
    method = method or bc.LeastSquares()
    if isinstance(method, bc.Marginal):  # chains of single devices, minutes each, are left to `fit`
        method = replace(method, chains=False)
    options = FitOptions(method, ws.seed_of(seed), dict(reference or {}))
    read_options = ws.ReadOptions.of(model.instrument, **(columns or {}))
    paths, missing, left_out = _paths(readings), dict[str, str](), dict[str, str]()
    ws.check_files_exist([path for path in paths if not path.is_dir()])
    if client is not None and client.cluster is None and client.dashboard_link:
        ws.tell(f"the cluster's dashboard: {client.dashboard_link}")
    with ws.deadline.until(time_limit):
        if paths:
            files, left_out = files_of([path.resolve() for path in paths])
            lines = first_few(left_out, "not read: ")
            ws.print_notes(line.strip() for line in lines)
            devices, missing = read_files(files, model, read_options, client)
        else:
            devices = (
                readings if isinstance(readings, Devices) else Devices.of_measurements(readings)  # pyright: ignore[reportArgumentType]
            )
        model = tailored_to_any(model, devices)
        request = Request(model, options, find, tuple(effects), ws.settings())
        result = _fit(client, request, devices, missing)
    result = replace(result, missing=missing, left_out=left_out)
    if out is not None:
        result.save(out)
    return result


def _fit(
    client: Client | None,
    request: Request,
    devices: Devices,
    missing: dict[str, str],
) -> BatchResult:
    """Fit all devices, and compare them; raise InputError if none can be used."""
    model, options = request.model, request.fit_options
    with ws.stage("fitting devices"):
        results = fit_all(client, request, devices)
    about = {
        "instrument": model.instrument.name,
        "effects": list(model.names),
        "noise": model.noise.law,
        "method": options.method.name,
        "seed": options.seed,
        "reference": {k: v for k, v in options.reference.items() if not isinstance(v, dict)},
    }
    about |= {"settings": settings} if (settings := ws.unusual()) else {}
    result = BatchResult(results, about)
    if not any(fit.names for fit in result):
        reasons = result.unreliable | missing
        lines = "\n".join(first_few(reasons)).strip()
        raise bc.InputError(f"none of the devices can be used; {lines or 'there is none'}")
    structures = [fit.structure for fit in results if fit.structure is not None]
    effects = effects_table(structures, options.seed)
    common = common_model(model, structures, effects, request.candidates)
    if shapes := _usual_shapes(common, model, results):
        common = common.fix(shapes)
    t0, compared = pd.Series({fit.device: fit.t0 for fit in results}, dtype=float), results
    t0_differs = "T0" not in options.reference and t0.dropna().nunique() > 1
    if t0_differs:  # offsets are compared at one temperature
        reference = {**options.reference, "T0": float(t0.median().round())}
        options = replace(options, reference=reference, method=bc.LeastSquares())
    if t0_differs or common is not model:
        request = replace(request, model=common, fit_options=options, find=False)
        compared = fit_all(client, request, devices)
    odd = odd_devices(compared, t0, common.noise.parameters())
    return replace(result, odd=odd, checked=len(structures), effects=effects)


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
