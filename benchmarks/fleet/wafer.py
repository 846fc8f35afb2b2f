"""Pairs of a wafer of 10,000 resonators by bounds: time, memory, what was excluded by what.

The draws are made up, not fitted: sensitivities and departures as the instrument's prior has them, each device known to
5 µg an order and 0.2 % of its sensitivity, as after a long record.
"""

from __future__ import annotations

import resource
import time
from typing import Any

import numpy as np

from bayescal_models.differential_pair.environment import (
    DISTURBANCE,
    ORDERS,
    RATIO,
    SENSITIVITY_SPREAD,
    order_sizes,
)
from bayescal_models.differential_pair.pairing.wafer import Wafer, best_pairs, expected_residual

DEVICES, DRAWS, SEED = 10_000, 100, 21
SHARE = 0.05  # of a device's own departure, in parts of the environment
KNOWN, RATIO_KNOWN = 5.0, 0.002  # µg an order; of the sensitivity
CHECKED = 1_000  # devices of which the full table is made too


def drawn(devices: int, seed: int) -> Wafer:
    """Draws of a wafer's devices, half of them outer ones."""
    rng = np.random.default_rng(seed)
    shared = order_sizes() * rng.standard_normal(ORDERS)
    own = RATIO ** np.arange(ORDERS)
    own = SHARE * DISTURBANCE * own / np.linalg.norm(own)
    sensitivity = np.exp(SENSITIVITY_SPREAD * rng.standard_normal(devices))
    departure = own * rng.standard_normal((devices, ORDERS))
    of_draws = sensitivity * (1 + RATIO_KNOWN * rng.standard_normal((DRAWS, devices)))
    errors = KNOWN * rng.standard_normal((DRAWS, devices, ORDERS))
    return Wafer(
        tuple(f"R{i:05d}" for i in range(devices)),
        devices // 2,
        np.full(DRAWS, 1 / DRAWS),
        1.0 + 1e-4 * rng.standard_normal((DRAWS, devices)),
        of_draws,
        (of_draws[..., None] * shared + departure + errors),
    )


def measured() -> dict[str, Any]:
    """The whole wafer, and a smaller one beside its full table."""
    small = drawn(CHECKED, SEED)
    half = CHECKED // 2
    outer, inner = np.divmod(np.arange(half * half), half)
    begun = time.process_time()
    parts = np.array_split(np.arange(half * half), half)
    every = np.concatenate([expected_residual(small, outer[p], inner[p])[0] for p in parts])
    full = time.process_time() - begun
    begun = time.process_time()
    checked = best_pairs(small)
    pruned = time.process_time() - begun
    order = np.argsort(every, kind="stable")[: len(checked.pairs)]
    names = [(small.names[outer[n]], small.names[half + inner[n]]) for n in order]
    same = names == [pair[:2] for pair in checked.pairs]
    wafer = drawn(DEVICES, SEED)
    begun = time.process_time()
    found = best_pairs(wafer)
    seconds = time.process_time() - begun
    return {
        "devices": DEVICES,
        "pairs": (DEVICES // 2) ** 2,
        "processor_s": seconds,
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
        "best": found.pairs[0],
        "last": found.pairs[-1],
        "bounded": found.bounded,
        "evaluated": found.evaluated,
        "least_excluded": found.least_excluded,
        "checked": {
            "devices": CHECKED,
            "same": same,
            "full_table_s": full,
            "by_bounds_s": pruned,
            "evaluated": checked.evaluated,
        },
    }
