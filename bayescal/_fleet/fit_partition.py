"""One partition: read, fitted, written; or found written already, by the digest of what it is made from."""

from __future__ import annotations

import resource
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bayescal._core.errors import InputError
from bayescal._fleet.batch_result import BatchResult, load_batch
from bayescal._fleet.find_devices import DeviceStructure, EffectCounts, find_and_fit
from bayescal._fleet.fit_devices import fit_devices
from bayescal._fleet.fleet_request import Request
from bayescal._fleet.partitions import Partition
from bayescal._fleet.read_partition import content_digest, read_partition

ONE = threading.Lock()  # a worker of several threads holds one partition at a time all the same
SHOWN = 10  # devices whose refusal is told
PARTITION = "partition"  # what a file of results says of where it comes from


@dataclass(frozen=True)
class PartitionMoments:
    """Of one coefficient over devices: their number, mean, sum of squares about it, sum of their variances."""

    count: int
    mean: float
    square: float
    variance: float

    def __add__(self, other: PartitionMoments) -> PartitionMoments:
        count = self.count + other.count
        apart = other.mean - self.mean
        return PartitionMoments(
            count,
            self.mean + apart * other.count / count,
            self.square + other.square + apart**2 * self.count * other.count / count,
            self.variance + other.variance,
        )


@dataclass(frozen=True)
class PartitionDone:
    """What the client hears of a partition: never more than a few lines.

    Attributes:
        number: of the partition.
        devices, trusted, readings: how many.
        doubted: some devices whose result is not reliable, and why.
        unreadable: file → why it cannot be used.
        moments: (coefficient, unit) → over the devices that are trusted.
        effects: what was found missing, over the devices that were searched.
        doubled, dropped: devices refused or left out because they stand in other partitions too.
        again: whether its results stood there before.
        seconds: of the processor.
        memory: most that its process has held so far, bytes.
    """

    number: int
    devices: int
    trusted: int
    readings: int
    doubted: dict[str, str] = field(default_factory=dict)
    unreadable: dict[str, str] = field(default_factory=dict)
    moments: dict[tuple[str, str], PartitionMoments] = field(default_factory=dict)
    effects: EffectCounts = field(default_factory=EffectCounts)
    doubled: dict[str, str] = field(default_factory=dict)
    dropped: tuple[str, ...] = ()
    again: bool = False
    seconds: float = 0.0
    memory: int = 0


def fit_partition(
    request: Request,
    partition: Partition,
    folder: Path,
    doubled: Mapping[str, str] | None = None,
    dropped: Sequence[str] = (),
) -> PartitionDone:
    """Fit the devices of a partition and write their results, unless they are there.

    Args:
        request: what is fitted.
        partition: whose devices.
        folder: that results are written to.
        doubled: devices that stand in several partitions, refused here with these reasons; None where that is not
            known yet, and results that stand there are taken as they are.
        dropped: devices that are refused in another partition, and left out here.

    Raises:
        InputError: the results cannot be written.
    """
    begun = time.process_time()
    with ONE:
        path = folder / partition.file
        digest = content_digest(partition, request)
        found = _complete(path, digest, doubled, dropped)
        again = found is not None
        if found is None:
            path.unlink(missing_ok=True)  # of other readings, or of another request
            found = _fitted(request, partition, digest, doubled or {}, dropped)
            found.save(path)
        done = _told(partition, found)
    return replace(done, again=again, seconds=time.process_time() - begun, memory=peak_memory())


def _complete(
    path: Path, digest: str, doubled: Mapping[str, str] | None, dropped: Sequence[str]
) -> BatchResult | None:
    """The results that stand there, if they are whole and of these readings."""
    if not digest or not path.is_file():
        return None
    try:
        found = load_batch(path)
    except InputError:
        return None
    own = found.about.get(PARTITION, {})
    if own.get("digest") != digest or own.get("unreadable"):
        return None
    if doubled is not None and (own["doubled"], own["dropped"]) != (dict(doubled), list(dropped)):
        return None
    return found


def _fitted(
    request: Request,
    partition: Partition,
    digest: str,
    doubled: Mapping[str, str],
    dropped: Sequence[str],
) -> BatchResult:
    read = read_partition(partition, request, doubled, dropped)
    shared: dict[str, Any] = {
        "seed": request.seed,
        "chunk": request.chunk,
        "reference": request.reference,
    }
    told: dict[str, DeviceStructure] = {}
    if request.find is None:
        found = fit_devices(request.model, read.devices, request.method, each=True, **shared)
    else:
        found, told = find_and_fit(
            request.model, read.devices, request.find, request.method, **shared
        )
    own = {
        "digest": digest,
        "files": [piece.name for piece in partition.pieces],
        "readings": read.readings,
        "unreadable": read.unreadable,
        "doubled": dict(doubled),
        "dropped": list(dropped),
        "structures": {name: asdict(one) for name, one in told.items()},
    }
    return replace(found, about={**found.about, PARTITION: own})


def _told(partition: Partition, found: BatchResult) -> PartitionDone:
    own, bad = found.about[PARTITION], np.flatnonzero(~found.ok)
    moments: dict[tuple[str, str], PartitionMoments] = {}
    for part in found.parts:
        good = found.ok[part.devices]
        if not good.any():
            continue
        mean, sd = part.mean[good], part.sd[good]
        for i, key in enumerate(zip(part.names, part.units, strict=True)):
            centre = float(mean[:, i].mean())
            square, variance = (
                float(np.sum((mean[:, i] - centre) ** 2)),
                float(np.sum(sd[:, i] ** 2)),
            )
            one = PartitionMoments(int(good.sum()), centre, square, variance)
            moments[key] = moments[key] + one if key in moments else one
    return PartitionDone(
        partition.number,
        devices=len(found),
        trusted=len(found) - len(bad),
        readings=own["readings"],
        doubted={found.devices[i]: found.reasons[i] for i in bad[:SHOWN]},
        unreadable=own["unreadable"],
        moments=moments,
        effects=EffectCounts.of([structure_from(s) for s in own["structures"].values()]),
        doubled=own["doubled"],
        dropped=tuple(own["dropped"]),
    )


def structure_from(held: dict[str, Any]) -> DeviceStructure:
    """A device's structure as a file of results holds it."""
    sets = tuple(tuple(one) for one in held["sets"])
    weighed = tuple((tuple(effects), value) for effects, value in held["weighed"])
    own = {**held, "effects": tuple(held["effects"]), "sets": sets, "weighed": weighed}
    return DeviceStructure(**own)


def peak_memory() -> int:
    """Most that this process has held, bytes."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024
