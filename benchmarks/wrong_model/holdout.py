"""The tests of hold-out data: how often they refuse a right result, and one that meets another device.

    python -m benchmarks holdout

A gyro whose runs are offset, beside a quadratic or nothing; hold-out data of two runs of the same device, and of
another one. A line a campaign in results/holdout.jsonl.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._calibration.holdout_contradiction import HoldoutTest
from bayescal._search.gate import gate
from bayescal._search.search_path import Step
from bayescal_models import mems_gyro
from benchmarks.hidden_effects.resume import go_on_by_seed
from benchmarks.record import RESULTS
from benchmarks.wrong_model import page
from benchmarks.wrong_model.worlds import gyro

COUNT = 200  # campaigns
PATH = RESULTS / "holdout.jsonl"
RUNS = (0.5, 2.0)  # of the plausible standard deviation between runs
BESIDE = (None, "bias.temperature_quadratic")
OWN = {"bias.constant", "bias.temperature"}


def main() -> None:
    """Run what is missing, and render the page."""
    go_on_by_seed(PATH, range(COUNT), campaign)
    page.write()


def campaign(seed: int) -> tuple[dict[str, Any], str]:
    """One campaign as `calibrate` leaves it, with hold-out data of the device and of another one."""
    rng = np.random.default_rng([36, seed])
    hidden = {"bias.run": float(np.exp(rng.uniform(*np.log(RUNS))))}
    if (beside := BESIDE[seed % len(BESIDE)]) is not None:
        hidden[beside] = float(np.exp(rng.uniform(np.log(0.3), np.log(5.0))))
    begun = time.perf_counter()
    worlds = {kind: gyro(seed, hidden, other=kind == "other") for kind in ("same", "other")}
    path = bc.calibrate(
        mems_gyro.INSTRUMENT.baseline(), worlds["same"].readings, method=bc.Marginal()
    )
    names = set(path.final.calibration.model.names) - OWN
    row: dict[str, Any] = {"seed": seed, "hidden": hidden, "final": sorted(names)}
    row["right"] = names == set(hidden)
    for kind, world in worlds.items():
        row[kind] = judged_by(path.steps, world.later)
    row["seconds"] = time.perf_counter() - begun
    shut = {kind: row[kind]["reason"] for kind in worlds}
    return row, f"{seed} {row['final']} {shut}"


def judged_by(steps: Sequence[Step], later: bc.Measurements) -> dict[str, Any]:
    """What the gate says of steps with these hold-out data."""
    kept = [(s, bc.predict(s.calibration, later)) for s in steps]
    steps = [
        replace(s, holdout_rmse=p.rmse, holdout_test=HoldoutTest(s.calibration, later, p))
        for s, p in kept
    ]
    found, last = gate(steps), steps[-1].holdout_test
    return {
        "open": found.ok,
        "reason": "" if found.ok else found.reason,
        "p": None if last is None else last.against.p,
        "share": None if last is None else last.against.share,
        "scatter": None if last is None else last.against.scatter,
    }
