"""A population over partitions against one process, and how often its 95 % intervals hold the truth."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._annexes.fleet.population import chosen, estimates, learn
from bayescal._model.effect import CENTRAL_95 as WIDE
from bayescal_models import mems_gyro
from benchmarks.fleet.simulated import T0, write_partition

MODEL = mems_gyro.INSTRUMENT.baseline()
NUMBERS = ["mean", "mean_sd", "group_sd", "group_sd_sd"]
PARTITIONS, DEVICES, SEED = 64, 50, 11
FLEETS, EACH = 200, 60  # simulated fleets, and the devices of each


def against_one_process(work: Path) -> dict[str, Any]:
    """Largest relative difference of a population over 64 partitions from one process."""
    folder, out = work / "pooled", work / "pooled_out"
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(PARTITIONS):
        write_partition(folder, number, DEVICES, SEED)
    shutil.rmtree(out, ignore_errors=True)
    shared: dict[str, Any] = {"population": True, "reference": {"T0": T0}}
    parts = bc.fit_batch(MODEL, folder, out=out, partition_rows=DEVICES * 60, **shared)
    one = bc.fit_batch(MODEL, sorted(folder.glob("*.parquet")), **shared)
    assert parts.population is not None and one.population is not None
    ours = parts.population.table[NUMBERS].to_numpy()
    apart = np.abs(ours / one.population.table[NUMBERS].to_numpy() - 1)
    return {
        "partitions": parts.about["partitions"],
        "devices": parts.devices,
        "largest_relative_difference": float(apart.max()),
    }


def coverage() -> dict[str, Any]:
    """Of simulated fleets, drawn from the prior of the spreads' order: shares whose intervals hold the truth."""
    named, rng = chosen(MODEL, True), np.random.default_rng(SEED)
    size = np.array([c.size for c, _ in named.values()])
    held = np.zeros((FLEETS, 2, len(size)), dtype=bool)
    for fleet in range(FLEETS):
        mean = 0.3 * size * rng.standard_normal(len(size))
        spread = 0.2 * size * np.exp(0.5 * rng.standard_normal(len(size)))
        truth = mean + spread * rng.standard_normal((EACH, len(size)))
        sd = 0.1 * size * rng.uniform(0.3, 2.0, (EACH, len(size)))
        read = truth + sd * rng.standard_normal(truth.shape)
        # What a device's own fit would say: its readings and its own prior N(0, size²).
        own = 1 / (1 / sd**2 + 1 / size**2)
        covariance = own[:, :, None] * np.eye(len(size))
        alone = estimates(own * read / sd**2, covariance, named)
        found = learn(alone, named, fleet).population.table
        held[fleet, 0] = np.abs(found["mean"] - mean) < WIDE * found["mean_sd"]
        # A spread is positive, and its logarithm nearly normal.
        width = np.log1p((found["group_sd_sd"] / found["group_sd"]) ** 2) ** 0.5
        held[fleet, 1] = np.abs(np.log(found["group_sd"] / spread) - width**2 * 0.5) < WIDE * width
    return {
        "fleets": FLEETS,
        "devices": EACH,
        "mean": held[:, 0].mean(axis=0).tolist(),
        "spread": held[:, 1].mean(axis=0).tolist(),
        "coefficients": list(named),
    }
