"""Devices per core-second of a whole fleet, from files to files, against loops of scipy and lmfit in the same run."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._annexes.fleet.engine import open_cluster
from bayescal_models import mems_gyro
from benchmarks.fleet.simulated import T0, arrays, write_partition
from benchmarks.speed.batches_peers import Part, by_lmfit, by_scipy

MODEL = mems_gyro.INSTRUMENT.baseline()
SEED = 2026
SAMPLE = 300  # devices that the peers fit
SHARE = 5  # of the partitions, on which one worker is compared with two


def made(folder: Path, partitions: int, devices: int) -> float:
    """The fleet's files; seconds of the processor."""
    begun = time.process_time()
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(partitions):
        write_partition(folder, number, devices, SEED)
    return time.process_time() - begun


def fitted(folder: Any, out: Path, workers: int, warm: Any = None) -> tuple[bc.FleetResult, float]:
    """The fleet, and seconds by the clock once its workers are warm."""
    with open_cluster(workers) as client:
        if warm is not None:
            client.wait_for_workers(workers)
            threads: Any = client.nthreads()
            for name in threads:
                client.submit(_warm, warm, workers=[name], pure=False).result()
        shutil.rmtree(out, ignore_errors=True)
        begun = time.perf_counter()
        found = bc.fit_batch(MODEL, folder, out=out, client=client, reference={"T0": T0})
        return found, time.perf_counter() - begun


def _warm(path: Path) -> int:
    devices = bc.split_devices(path, mems_gyro.INSTRUMENT)
    return len(bc.fit_batch(MODEL, devices, reference={"T0": T0}))


def peers() -> dict[str, float]:
    """Devices per second of the processor, one call each."""
    temperature, output = arrays([SEED, 0], SAMPLE)
    parts: list[Part] = list(zip(temperature, output, strict=True))
    sizes = np.array([e.coefficients[0].size for e in MODEL.effects])
    rates = {}
    for name, peer in {"scipy.optimize.least_squares": by_scipy, "lmfit": by_lmfit}.items():
        begun = time.process_time()
        peer(parts, sizes)
        rates[name] = SAMPLE / (time.process_time() - begun)
    return rates


def measured(work: Path, partitions: int, devices: int) -> dict[str, Any]:
    """All figures of a fleet of so many partitions of so many devices."""
    readings = work / "fleet"
    simulated = made(readings, partitions, devices)
    files = sorted(readings.glob("*.parquet"))
    rates = peers()
    whole, clock = fitted(readings, work / "out", 2, files[0])
    some = files[: max(partitions // SHARE, 2)]
    clocks = {1: [], 2: []}
    for _ in range(2):
        for workers, found in clocks.items():
            found.append(fitted(some, work / "some", workers, files[0])[1])
    own = whole.devices / whole.about["processor_seconds"]
    return {
        "devices": whole.devices,
        "trusted": whole.fitted,
        "readings": whole.readings,
        "partitions": partitions,
        "simulated_s": simulated,
        "clock_s": clock,
        "processor_s": whole.about["processor_seconds"],
        "devices_per_core_second": own,
        "peers": {n: {"devices_per_core_second": r, "ratio": own / r} for n, r in rates.items()},
        "peak_memory_mb": whole.about["peak_memory"] / 1e6,
        "one_to_two_workers": {
            "devices": len(some) * devices,
            "clock_s": {str(n): min(c) for n, c in clocks.items()},
            "ratio": min(clocks[1]) / min(clocks[2]),
        },
    }
