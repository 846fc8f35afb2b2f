"""A fleet from its files to its results: partitions, the run over them, what the devices have in common."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bayescal._core.errors import InputError
from bayescal._core.progress import note, tell
from bayescal._core.version import __version__
from bayescal._data.read_options import ReadOptions
from bayescal._fleet.engine import Engine, LocalEngine, OnDask
from bayescal._fleet.find_devices import Find
from bayescal._fleet.fit_devices import sized_for
from bayescal._fleet.fleet_request import Request
from bayescal._fleet.fleet_result import ALONE, POOLED, SHOWN, WHOLE, FleetResult
from bayescal._fleet.fleet_table import effects_table
from bayescal._fleet.partitions import FIND_ROWS, ROWS, Partition, left_out, partitions_of
from bayescal._fleet.population import AskedPopulation, Population, chosen
from bayescal._fleet.population_tree import learn_population
from bayescal._fleet.read_partition import read_partition
from bayescal._fleet.run import Run
from bayescal._fleet.tailored import tailored_to_first
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.marginal import Marginal
from bayescal._model.frame import Reference, reference_name
from bayescal._model.model import Model

if TYPE_CHECKING:
    from distributed import Client

DOUBTED = 100  # devices whose result is not reliable, of which the whole says why


def fit_fleet(
    model: Model,
    paths: Sequence[Path],
    out: Path,
    method: LeastSquares | Marginal,
    population: AskedPopulation,
    *,
    seed: int,
    chunk: int,
    reference: Reference | None,
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
    engine: Engine = LocalEngine() if client is None else OnDask(client)
    if client is not None and client.cluster is None and client.dashboard_link:
        tell(f"the cluster's dashboard: {client.dashboard_link}")
    unread = left_out(paths)
    for name, why in list(unread.items())[:SHOWN]:
        note(f"not read: {name}: {why}")
    if len(unread) > SHOWN:
        note(f"not read: {len(unread) - SHOWN} more, all in {WHOLE}")
    partitions = partitions_of(paths, rows or (FIND_ROWS if find else ROWS))
    options = ReadOptions.of(model.instrument, **(columns or {}))
    request = Request(model, method, seed, chunk, dict(reference or {}), options, find=find)
    request = _with_common(request, partitions, engine, bool(population))
    named = chosen(request.model, population)
    folder = out.resolve()
    run = Run(request, partitions, folder / ALONE, engine)
    run.fit()
    if not any(done.trusted for done in run.in_order):
        raise InputError(f"none of the devices can be used; {_first_reason(run)}")
    learned, apart = None, dict[str, float]()
    if named:
        files = [folder / ALONE / partitions[done.number].file for done in run.in_order]
        learned, apart = learn_population(files, folder / POOLED, named, seed, engine)
    found = replace(_whole(run, out, learned, apart, time.monotonic() - begun), left_out=unread)
    found.save()
    return found


def _first_reason(run: Run) -> str:
    doubted = (item for done in run.in_order for item in done.doubted.items())
    name, why = next(doubted, None) or next(iter(run.missing.items()), ("", "there is none"))
    return f"{name}: {why}"


@dataclass(frozen=True)
class TemperatureSums:
    """Sums over readings from which a common T0 and its like follow: column → sum, number."""

    of: dict[str, tuple[float, int]]

    def __add__(self, other: TemperatureSums) -> TemperatureSums:
        names = {**self.of, **other.of}
        none = (0.0, 0)
        both = {n: (self.of.get(n, none), other.of.get(n, none)) for n in names}
        return TemperatureSums({n: (a[0] + b[0], a[1] + b[1]) for n, (a, b) in both.items()})


def temperature_sums(request: Request, partition: Partition) -> TemperatureSums:
    """Of the readings of one partition."""
    sums: dict[str, tuple[float, int]] = {}
    for block in read_partition(partition, request, {}).devices.blocks:
        for name, unit in block.units.items():
            if unit == "degC" and name != "temperature_point":
                total, count = sums.get(name, (0.0, 0))
                values = block.values[name]
                sums[name] = total + float(np.sum(values)), count + len(values)
    return TemperatureSums(sums)


def sized_model(request: Request, partition: Partition) -> Model | None:
    """The model, with what it takes from readings taken from the partition's first device that tells it."""
    model, first = tailored_to_first(request.model, read_partition(partition, request, {}).devices)
    return None if first is None else sized_for(model, first, request.reference)


def _with_common(
    request: Request, partitions: Sequence[Partition], engine: Engine, pooled: bool
) -> Request:
    """The request with what has to be the same in all partitions: T0 of a population, unit, open sizes."""
    known = {"T0"} <= set(request.reference)
    if pooled and not known:
        tell("reading all temperatures, for a common T0 (a reference given spares that)")
        sums = engine.tree(temperature_sums, [(request, p) for p in partitions])
        common = {reference_name(n): float(np.round(s / c)) for n, (s, c) in sums.of.items() if c}
        request = replace(request, reference={**common, **request.reference})
    model = request.model
    reason = ""
    if model.instrument.tailor is not None or any(e.open for e in model.effects):
        for partition in partitions:
            for outcome in engine.each(sized_model, [(request, partition)]):
                if outcome.value is not None:
                    return replace(request, model=outcome.value)
                reason = reason or outcome.error
    if reason and model.instrument.tailor is not None:
        raise InputError(f"none of the devices can be used; {reason}")
    return request


def _whole(
    run: Run, out: Path, population: Population | None, apart: dict[str, float], seconds: float
) -> FleetResult:
    done, model = list(run.in_order), run.request.model
    doubted = {n: why for one in done for n, why in one.doubted.items()}
    about = {
        "instrument": model.instrument.name,
        "effects": list(model.names),
        "noise": model.noise.law,
        "method": run.request.method.name,
        "seed": run.request.seed,
        "reference": {k: v for k, v in run.request.reference.items() if not isinstance(v, dict)},
        "version": __version__,
        "partitions": len(run.partitions),
        "found_done": sum(one.again for one in done),
        "seconds": seconds,
        "processor_seconds": sum(one.seconds for one in done),
        "peak_memory": max((one.memory for one in done), default=0),
    }
    return FleetResult(
        out,
        devices=sum(one.devices for one in done),
        trusted=sum(one.trusted for one in done),
        readings=sum(one.readings for one in done),
        doubted=dict(list(doubted.items())[:DOUBTED]),
        missing=run.missing,
        table=run.table(),
        population=population,
        apart=apart,
        effects=effects_table(run.effects, run.request.seed),
        about=about,
    )
