"""One verb for many devices of one type: `fit_batch`, in this process or on a cluster."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack, overload

from bayescal._core.errors import InputError
from bayescal._data.measurements import Measurements
from bayescal._fleet.batch_result import BatchResult
from bayescal._fleet.devices import Devices, gathered
from bayescal._fleet.find_devices import Find
from bayescal._fleet.fit_devices import CHUNK, FitOptions, fit_devices, tailored_to_first
from bayescal._fleet.fit_fleet import fit_fleet
from bayescal._fleet.fleet_result import FleetResult
from bayescal._fleet.population import AskedPopulation, chosen
from bayescal._fleet.split_devices import split_devices
from bayescal._inference.method import Method
from bayescal._model.frame import Reference
from bayescal._model.model import Model

if TYPE_CHECKING:
    from distributed import Client

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
