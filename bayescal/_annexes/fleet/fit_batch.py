"""Fits of many devices of one type (`fit_batch`), in this process or as tasks of a Dask cluster."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.fleet import batch_result, find_devices
from bayescal._annexes.fleet.batch_result import BatchResult, DeviceResult, format_reasons
from bayescal._annexes.fleet.devices import Devices, list_files, read_devices
from bayescal._annexes.fleet.engine import run_tasks
from bayescal._annexes.fleet.find_devices import search_device, tabulate_effects
from bayescal._annexes.fleet.fit_devices import Reference, Request, fit_devices
from bayescal._annexes.fleet.odd_devices import find_outlying_devices

if TYPE_CHECKING:
    from distributed import Client

REVISED = "its own readings favour {}, improbable in the fleet; it was fitted with effects of the fleet instead: {}"
MAX_READINGS_PER_FIT_TASK = 500_000  # they take 0.6 GB of a worker's memory, JAX included
MAX_READINGS_PER_SEARCH_TASK = 5_000  # so that a worker's death costs no more than a minute or two

Paths = str | Path | Sequence[str | Path]
Readings = Devices | Sequence[bc.Measurements] | Mapping[str, bc.Measurements] | Paths


def fit_device_batch(request: Request, devices: Devices) -> list[DeviceResult]:
    """Fit one batch of devices, each after a search for missing effects if requested; return the results in order."""
    results = {n: DeviceResult(reason=e) for n, e in devices.rejection_reasons.items()}
    measurements, starts = dict(devices.measurements), dict[str, Mapping[str, float]]()
    models, structures = dict.fromkeys(measurements, request.model), {}
    for name in [*measurements] if request.find else ():
        try:
            arguments = measurements[name], request.candidates, request.reference
            result = search_device(request.model, *arguments)
            structures[name], models[name], starts[name] = result
        except (bc.BayescalError, ws.deadline.TimeIsUp) as error:
            results[name] = DeviceResult(reason=str(error))
            del measurements[name]
    with ws.deadline.suspend() if request.find else nullcontext():
        results |= fit_devices(models, measurements, request, starts)
    return [
        replace(results[name], device=name, structure=structures.get(name))
        for name in devices.names
    ]


def read_files(
    files: Sequence[Path], model: bc.Model, options: ws.ReadOptions, client: Client | None
) -> tuple[Devices, dict[str, str]]:
    """Read files of devices; return the devices, and file name → error message of each unreadable file."""
    needed_columns = tuple(dict.fromkeys(c for e in model.effects for c in e.columns))
    tasks = [(path, model.instrument, options, needed_columns) for path in files]
    outcomes = [*zip(files, run_tasks(client, read_devices, tasks, "files"), strict=True)]
    errors = {path.name: error for path, (_, error) in outcomes if error}
    return Devices.of_files({path: found for path, (found, e) in outcomes if not e}), errors


def fit_all(client: Client | None, request: Request, devices: Devices) -> tuple[DeviceResult, ...]:
    """Fit all devices in batches; reject those that are not processed before the deadline."""
    sizes = [len(devices.measurements.get(name, ())) for name in devices.names]
    max_readings = MAX_READINGS_PER_SEARCH_TASK if request.find else MAX_READINGS_PER_FIT_TASK
    starts = np.flatnonzero(np.diff(np.cumsum(sizes) // max_readings)) + 1
    batches = [devices.select(b.tolist()) for b in np.split(np.array(devices.names), starts)]
    tasks, results = [(request, batch) for batch in batches], list[DeviceResult]()
    outcomes = run_tasks(client, fit_device_batch, tasks, "batches of devices")
    for batch, (fits, error) in zip(batches, outcomes, strict=True):
        results += [DeviceResult(name, error) for name in batch.names] if error else fits
    return tuple(results)


def tailor_to_fleet(model: bc.Model, devices: Devices) -> bc.Model:
    """Adapt a model's instrument to the first device that allows it, with its own effects and noise in the model."""
    instrument = tailored = model.instrument
    for readings in devices if instrument.tailor is not None else ():
        with suppress(bc.InputError):
            tailored = instrument.for_readings(readings)
            break
    old, new = ({e.name: e for e in (*i.effects, *i.candidates)} for i in (instrument, tailored))
    effects = (new.get(e.name, e) if e == old.get(e.name) else e for e in model.effects)
    noise = tailored.noise if model.noise == instrument.noise else model.noise
    return bc.Model(tailored, tuple(effects), noise, model.fixed)


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
    """Fit one model to each of many devices of one type; find outlying devices.

        result = bc.fit_batch(mems_gyro.INSTRUMENT.baseline(), "lot.parquet")
        result["A17"], result.table()  # device, coefficient, mean, sd, unit, ok, reason
        bc.fit_batch(model, "fleet/", out="fleet.parquet", client=distributed.Client("tcp://10.0.0.5:8786"))

    Estimates, uncertainties and failed checks are those of `fit` with the same method and seed. The result of a device
    with unusable readings or an unreliable fit states the reason; the other devices are not affected.

    Files are read and devices are fitted in this process, or by the workers of a Dask `client` with the same results. A
    file that cannot be read is listed in `missing`; a device that is in several files is rejected.

    Args:
        model: model to fit. An instrument that adapts to readings (unit, plausible sizes) adapts to the first device.
        readings: `split_devices(…)`; paths of files with a column `device` and of folders of files; or one
            Measurements per device, named by the keys of a mapping.
        method: method of inference, default `LeastSquares()`. `Marginal()` runs no chains: the fit of a device that
            needs them is unreliable.
        seed: seed of the random numbers, or a NumPy generator to draw it from.
        reference: reference constants of basis functions; default: those of each device's readings.
        time_limit: time limit, s; devices not fitted by then, or before Ctrl-C, are rejected with that reason.
        client: client of a Dask cluster whose workers find the files under the same paths.
        out: file to save the result to, as in `BatchResult.save`.
        columns: options for reading files: arguments of `split_devices`, such as {"units": {"rate": "rad/s"}}.
        find: whether to search each device for missing effects (about a second per device).
        effects: user-defined candidate effects for that search.

    Raises:
        InputError: no device is usable, a path does not exist, or the result cannot be written.
    """
    # An invalid name of the file is refused before the fits.
    out = None if out is None else batch_result.require_parquet(Path(out))
    method = method or bc.LeastSquares()
    if isinstance(method, bc.Marginal):  # without chains, which take minutes per device
        method = replace(method, chains=False)
    read_options = ws.ReadOptions.of(model.instrument, **(columns or {}))
    paths, file_errors, skip_reasons = _list_paths(readings), dict[str, str](), dict[str, str]()
    ws.check_files_exist([path for path in paths if not path.is_dir()])
    if client is not None and client.cluster is None and client.dashboard_link:
        ws.notify(f"the cluster's dashboard: {client.dashboard_link}")
    with ws.deadline.limit(time_limit):
        if paths:
            files, skip_reasons = list_files([path.resolve() for path in paths])
            ws.print_notes(line.strip() for line in format_reasons(skip_reasons, "not read: "))
            devices, file_errors = read_files(files, model, read_options, client)
        else:
            devices = (
                readings if isinstance(readings, Devices) else Devices.of_measurements(readings)  # pyright: ignore[reportArgumentType]
            )
        model = tailor_to_fleet(model, devices)
        options = method, ws.to_seed(seed), dict(reference or {}), find, tuple(effects)
        request = Request(model, *options)
        result = _fit_and_compare(client, request, devices, file_errors)
    result = replace(result, file_errors=file_errors, skip_reasons=skip_reasons)
    if out is not None:
        result.save(out)
    return result


def _fit_and_compare(
    client: Client | None, request: Request, devices: Devices, file_errors: dict[str, str]
) -> BatchResult:
    """Fit all devices, refit those with improbable effects, find outliers; raise InputError if no device is usable."""
    model, reference, method = request.model, request.reference, request.method.name
    with ws.track("fitting devices"):
        results = fit_all(client, request, devices)
    configuration = {"instrument": model.instrument.name, "effects": list(model.names)}
    configuration |= {"noise": model.noise.law, "method": method, "seed": request.seed}
    configuration["reference"] = {k: v for k, v in reference.items() if not isinstance(v, dict)}
    configuration |= {"settings": settings} if (settings := ws.list_changed_settings()) else {}
    if not any(fit.names for fit in results):
        reasons = BatchResult(results, configuration).unreliable | file_errors
        lines = "\n".join(format_reasons(reasons)).strip()
        raise bc.InputError(f"no device can be used: {lines or 'there are no devices'}")
    structures = {fit.device: fit.structure for fit in results if fit.structure is not None}
    device_structures, revisions = [*structures.values()], dict[str, str]()
    add_effects = partial(find_devices.add_effects, model, device_structures, request.candidates)
    effects = tabulate_effects(device_structures, request.seed)
    probable_effects = {*effects.query("`in fleet` >= 0.5 and devices > 0")["effect"]}
    devices_by_effects = dict[tuple[str, ...], list[str]]()
    for name, structure in structures.items():
        if not structure.families <= probable_effects:
            effect_set = find_devices.find_favoured_effects(structure, effects)
            devices_by_effects.setdefault(effect_set, []).append(name)
    for effect_set, names in devices_by_effects.items():
        refit = replace(request, model=add_effects(effect_set), find=False)
        text = ", ".join(added_names := refit.model.names[len(model.names) :]) or "none"
        if probable_effects >= {*effect_set} and len(added_names) == len(effect_set):
            fits = {f.device: f for f in fit_all(client, refit, devices.select(names)) if f.ok}
            results = tuple(fits.get(fit.device, fit) for fit in results)
            revisions |= {n: REVISED.format(", ".join(structures[n].effects), text) for n in fits}
    is_found = effects["in fleet"] >= ws.settings().found_probability
    common_model = add_effects([*effects["effect"][is_found]])
    if median_shapes := _compute_median_shapes(common_model, model, results):
        common_model = common_model.fix(median_shapes)
    t0, comparable_fits = pd.Series({fit.device: fit.t0 for fit in results}, dtype=float), results
    t0_differs = "T0" not in reference and t0.dropna().nunique() > 1
    if t0_differs:  # offsets are compared at one temperature
        reference = {**reference, "T0": float(t0.median().round())}
        request = replace(request, reference=reference, method=bc.LeastSquares())
    if t0_differs or common_model is not model:
        request = replace(request, model=common_model, find=False)
        comparable_fits = fit_all(client, request, devices)
    outliers = find_outlying_devices(comparable_fits, t0, common_model.noise.parameters())
    return BatchResult(
        results, configuration, outliers, len(structures), {}, {}, effects, revisions
    )


def _compute_median_shapes(
    common_model: bc.Model, model: bc.Model, results: Sequence[DeviceResult]
) -> dict[str, float]:
    """Return the medians of the shape parameters of effects added to `model`, over the devices that have the effect."""
    added_effects = (e for e in common_model.effects if e.name not in model.names)
    names = [e.shape_name(s) for e in added_effects for s in e.shapes]
    means = {n: [fit[n][0] for fit in results if fit.ok and n in fit.names] for n in names}
    return {name: float(np.median(values)) for name, values in means.items() if values}


def _list_paths(readings: Any) -> list[Path]:
    """Return the paths of files, if `readings` are paths; else an empty list."""
    entries = [readings] if isinstance(readings, str | Path) else [*readings]
    is_path = (isinstance(entry, str | Path) for entry in entries)
    return [Path(e) for e in entries] if all(is_path) and not isinstance(readings, Mapping) else []
