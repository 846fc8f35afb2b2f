"""A population of a fleet: sums over partitions, added up as a tree, and each partition's devices under it.

Partitions keep what the readings alone say of their devices in a file of numbers (Λ, x̂ and e), which workers map into
memory; all that travels are sums of a few numbers for each draw of the spreads.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import stats

from bayescal._core.atomic_file import replacing_for_user
from bayescal._core.errors import InputError, ModelError
from bayescal._fleet import device_sums
from bayescal._fleet.batch_result import BatchResult, load_batch
from bayescal._fleet.device_sums import DeviceEstimates, DeviceMoments, Sums
from bayescal._fleet.engine import Engine
from bayescal._fleet.partial_pooling import put_to, summed_up
from bayescal._fleet.population import FEWEST, Learned, Named, Population, learn, sizes, told

KEPT = 100  # devices that stand out most, of which the whole keeps the p
BY_CHANCE = 0.01  # devices of so small a p, expected by chance in the whole fleet


def learn_population(
    files: Sequence[Path], pooled: Path, named: Named, seed: int, engine: Engine
) -> tuple[Population, dict[str, float]]:
    """Learn a population from the results of partitions, and write each partition's devices under it.

    Args:
        files: results of each device by itself.
        pooled: folder for those under the population.
        named: the population's coefficients.
        seed: of every random number.
        engine: where the sums are made.

    Returns:
        The population, and the devices that stand out from it with their posterior predictive p.

    Raises:
        ModelError: fewer than three devices that can be trusted.
        InputError: a partition cannot be read or written.
    """
    shutil.rmtree(
        pooled, ignore_errors=True
    )  # of another population: derived, and quickly made anew
    pooled.mkdir(parents=True)
    places = [pooled / f".{file.stem}.npy" for file in files]  # hidden: a dataset passes over it
    counts = engine.tree(write_told, [(f, p, named) for f, p in zip(files, places, strict=True)])
    if counts.devices < FEWEST:
        raise ModelError(
            f"a population is learned from at least {FEWEST} devices that converge; here {counts.devices} did"
        )
    devices = _InPartitions(tuple(places), counts.devices, counts.estimate / counts.devices, engine)
    learned = learn(devices, named, seed)
    tasks = [(f, p, pooled / f.name, named, learned) for f, p in zip(files, places, strict=True)]
    written = engine.tree(write_pooled, tasks)
    for place in places:
        place.unlink(missing_ok=True)
    least = [(p, name) for p, name in written.least if p * counts.devices < BY_CHANCE]
    return learned.population, {name: p for p, name in least}


@dataclass(frozen=True)
class Count:
    """A number of devices and the sum of their estimates, to be added up."""

    devices: int
    estimate: np.ndarray

    def __add__(self, other: Count) -> Count:
        return Count(self.devices + other.devices, self.estimate + other.estimate)


@dataclass(frozen=True)
class Least:
    """The devices of least posterior predictive p, (p, device); to be added up."""

    least: tuple[tuple[float, str], ...]

    def __add__(self, other: Least) -> Least:
        return Least(tuple(sorted((*self.least, *other.least))[:KEPT]))


@dataclass(frozen=True)
class _InPartitions:
    """Devices in partitions, as `learn` takes them."""

    places: tuple[Path, ...]
    count: int
    centre: np.ndarray
    engine: Engine

    def sums(self, scale: np.ndarray, v: np.ndarray) -> Sums:
        return self.engine.tree(sums_of, [(place, self.centre, scale, v) for place in self.places])

    def sums_and_slopes(self, scale: np.ndarray, v: np.ndarray) -> tuple[Sums, Sums]:
        tasks = [(place, self.centre, scale, v) for place in self.places]
        both = self.engine.tree(sums_and_slopes_of, tasks)
        return both.values, both.slopes


@dataclass(frozen=True)
class ValuesAndSlopes:
    """Sums and their slopes, to be added up."""

    values: Sums
    slopes: Sums

    def __add__(self, other: ValuesAndSlopes) -> ValuesAndSlopes:
        return ValuesAndSlopes(self.values + other.values, self.slopes + other.slopes)


def write_told(file: Path, place: Path, named: Named) -> Count:
    """Keep what a partition's readings alone say of its devices, as numbers (b, k, k + 2)."""
    found = load_batch(file)
    own = _told(found, named)
    with replacing_for_user(place) as partial, partial.open("wb") as out:
        columns = (own.precision, own.estimate[:, :, None], own.rest[:, :, None])
        np.save(out, np.concatenate(columns, axis=2))
    return Count(len(own.estimate), own.estimate.sum(axis=0))


def _told(found: BatchResult, named: Named) -> DeviceEstimates:
    k = len(named)
    mean, covariance = summed_up(found.parts, found.ok, named)
    return (
        told(mean, covariance, named)
        if len(mean)
        else DeviceEstimates(np.zeros((0, k, k)), mean, mean)
    )


def _mapped(place: Path) -> DeviceEstimates:
    try:
        held = np.load(place, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{place} cannot be read: {error}. Run the same command again") from None
    return DeviceEstimates(held[:, :, :-2], held[:, :, -2], held[:, :, -1])


def sums_of(place: Path, centre: np.ndarray, scale: np.ndarray, v: np.ndarray) -> Sums:
    """Sums over a partition's devices at several spreads."""
    return device_sums.sums(_mapped(place), centre, scale, v)


def sums_and_slopes_of(
    place: Path, centre: np.ndarray, scale: np.ndarray, v: np.ndarray
) -> ValuesAndSlopes:
    """The sums, and their slopes."""
    return ValuesAndSlopes(*device_sums.sums_and_slopes(_mapped(place), centre, scale, v))


def write_pooled(file: Path, place: Path, to: Path, named: Named, learned: Learned) -> Least:
    """Write a partition's devices under the population; those that stand out from it most."""
    found, own, size = load_batch(file), _mapped(place), sizes(named)
    moved = DeviceMoments(own.estimate, own.precision)
    if len(own.estimate):
        moved = device_sums.device_moments(own, *learned[1:])
    parts = put_to(
        found.parts, found.ok, named, moved.mean * size, moved.covariance * np.outer(size, size)
    )
    replace(found, parts=tuple(parts), population=learned.population).save(to)
    return _standing_out(found, own, named, learned.population)


def _standing_out(
    found: BatchResult, own: DeviceEstimates, named: Named, population: Population
) -> Least:
    """Posterior predictive p of what each device's readings alone say, as of a device drawn from the population anew.

    For a device of mean m and spread T, h − Λm has the covariance Λ + ΛTΛ; directions that its readings do not
    determine take no part.
    """
    if not len(own.estimate):
        return Least(())
    table, size = population.table, sizes(named)
    mean = table["mean"].to_numpy() / size
    spread = (table["spread"].to_numpy() ** 2 + table["mean_sd"].to_numpy() ** 2) / size**2
    apart = np.einsum("bij,bj->bi", own.precision, own.estimate - mean) + own.rest
    covariance = own.precision + (own.precision * spread) @ own.precision
    square = np.einsum("bi,bij,bj->b", apart, np.linalg.pinv(covariance, hermitian=True), apart)
    p = stats.chi2.sf(square, np.linalg.matrix_rank(covariance, hermitian=True))
    at = [int(d) for part in found.parts for d in part.devices[found.ok[part.devices]]]
    order = np.argsort(p)[:KEPT]
    return Least(tuple((float(p[i]), found.devices[at[i]]) for i in order))
