"""Records whose noise wanders and in which nothing is missing: how often is an effect reported all the same?

    python -m benchmarks wandering_noise

Each record is a simulated gyroscope campaign with white noise and an Ornstein–Uhlenbeck wander in every run (the
simulator's own option), and no hidden effect. The loop chooses the noise law by itself in one column, and is told
to take the noise for white in the other. Resumable: a line per record in results/wandering_noise.jsonl.
"""

from __future__ import annotations

import json
import sys
import time

from scipy.stats import beta

import bayescal as bc
from bayescal_models import mems_gyro
from benchmarks.record import ROOT, write

RECORDS = 200
FIRST_SEED = 5000
LINES = ROOT / "benchmarks" / "results" / "wandering_noise.jsonl"


def one(seed: int) -> dict[str, object]:
    """Both loops on one record."""
    model = mems_gyro.INSTRUMENT.baseline()
    readings = mems_gyro.simulate({}, seed=seed, noise_law="ornstein_uhlenbeck")
    begun = time.perf_counter()
    chosen = bc.calibrate(model, readings)
    taken = time.perf_counter() - begun
    white = bc.discover(chosen.steps[0].calibration)
    return {
        "seed": seed,
        "added": [s.added for s in chosen.steps if s.added],
        "law": chosen.final.calibration.model.noise.law,
        "gate": chosen.gate.ok,
        "added_if_white": [e.name for e in white.best],
        "seconds": taken,
    }


def interval(count: int, total: int) -> tuple[float, float]:
    """Exact (Clopper–Pearson) 95 % interval of a proportion."""
    low = 0.0 if count == 0 else float(beta.ppf(0.025, count, total - count + 1))
    high = 1.0 if count == total else float(beta.ppf(0.975, count + 1, total - count))
    return low, high


def main() -> None:
    """Run what is missing of the records, then write the summary."""
    LINES.parent.mkdir(exist_ok=True)
    done = [json.loads(line) for line in LINES.read_text().splitlines()] if LINES.is_file() else []
    seeds = {row["seed"] for row in done}
    with LINES.open("a", encoding="utf-8") as out:
        for seed in range(FIRST_SEED, FIRST_SEED + RECORDS):
            if seed not in seeds:
                done.append(one(seed))
                out.write(json.dumps(done[-1]) + "\n")
                out.flush()
                print(f"{len(done)} of {RECORDS}", end="\r", file=sys.stderr)
    total = len(done)
    chosen = sum(bool(row["added"]) for row in done)
    white = sum(bool(row["added_if_white"]) for row in done)
    summary = {
        "records": total,
        "reported": chosen,
        "reported_interval95": interval(chosen, total),
        "reported_if_white": white,
        "reported_if_white_interval95": interval(white, total),
        "law_chosen": sum(row["law"] == "ornstein_uhlenbeck" for row in done),
    }
    write("wandering_noise", summary)
    print(json.dumps(summary, indent=1))
