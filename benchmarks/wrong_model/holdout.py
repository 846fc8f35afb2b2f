"""The tests of hold-out data: how often they refuse a right result, and one that meets another device.

    python -m benchmarks holdout

A gyro whose runs are offset, beside one further effect or none; hold-out data of two runs of the same device, and of
another one. A line a campaign in results/holdout.jsonl.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import bayescal as bc
from bayescal_models import mems_gyro
from benchmarks.hidden_effects.resume import go_on
from benchmarks.record import RESULTS, read_lines
from benchmarks.wrong_model.worlds import gyro

COUNT = 200  # campaigns of each kind
PATH = RESULTS / "holdout.jsonl"
BESIDE = (None, "bias.temperature_quadratic", "bias.thermal_lag", "bias.drift")


def main() -> None:
    """Run what is missing."""
    done = {(row["seed"], row["other"]) for row in read_lines(PATH)}
    cases = [(seed, other) for seed in range(COUNT) for other in (False, True)]
    go_on(PATH, (case for case in cases if case not in done), campaign)


def campaign(case: tuple[int, bool]) -> tuple[dict[str, Any], str]:
    """One campaign as `calibrate` leaves it."""
    seed, other = case
    rng = np.random.default_rng([36, seed])
    hidden = {"bias.run": float(np.exp(rng.uniform(0.0, np.log(5.0))))}
    if (beside := BESIDE[seed % len(BESIDE)]) is not None:
        hidden[beside] = float(np.exp(rng.uniform(np.log(0.3), np.log(5.0))))
    world = gyro(seed, hidden, other=other)
    begun = time.perf_counter()
    path = bc.calibrate(
        mems_gyro.INSTRUMENT.baseline(), world.readings, holdout=world.later, method=bc.Marginal()
    )
    against = path.final.holdout_test.against if path.final.holdout_test else None
    row = {
        "seed": seed,
        "other": other,
        "hidden": hidden,
        "final": sorted(
            set(path.final.calibration.model.names) - {"bias.constant", "bias.temperature"}
        ),
        "open": path.gate.ok,
        "reason": "" if path.gate.ok else path.gate.reason,
        "p": None if against is None else against.p,
        "share": None if against is None else against.share,
        "scatter": None if against is None else against.scatter,
        "holdout_rmse": [s.holdout_rmse for s in path.steps],
        "seconds": time.perf_counter() - begun,
    }
    return (
        row,
        f"{seed} {'other' if other else 'same'} {row['final']} {row['open']} {row['reason']}",
    )
