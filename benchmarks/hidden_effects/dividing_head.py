"""An accelerometer on a dividing head: do intervals cover, and are K2, K3 and a fixture that tilts found?

    python -m benchmarks dividing_head

Campaigns of 24 positions at five temperatures. In every other one K2, K3 or a tilt of the fixture that changes with the
temperature is hidden, in turn, at a size drawn log-uniformly from hardly visible to plain. Each is calibrated as
`calibrate` does it; what is judged is what is delivered, the posterior averaged over structures. The oracle is the log
evidence of the true structure less the baseline's. One JSON line a campaign in results/dividing_head.jsonl: stopped, it
goes on where it was.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._search.structures import Structure
from bayescal_models import accelerometer_dividing_head as head
from bayescal_models.accelerometer_dividing_head.simulator import BASELINE
from benchmarks.hidden_effects.resume import go_on_by_seed
from benchmarks.hidden_effects.searched import Searched
from benchmarks.hidden_effects.triads import counts
from benchmarks.intervals import credible_interval, proportion
from benchmarks.record import RESULTS, read_lines, write

CAMPAIGNS = 200
SIZES = {  # least and largest, in the unit of the coefficient
    "second_order.constant": (2.0, 40.0),
    "third_order.constant": (4.0, 80.0),
    "zero.temperature": (0.03, 0.6),
}


def main() -> None:
    """Run what is missing of the campaigns, then write and print the counts."""
    go_on_by_seed(RESULTS / "dividing_head.jsonl", range(CAMPAIGNS), measure)
    summarise()


def measure(seed: int) -> tuple[dict[str, Any], str]:
    """One campaign: what was hidden, what was found, and which intervals hold the truth."""
    hidden = {}
    if seed % 2:
        name = tuple(SIZES)[seed // 2 % len(SIZES)]
        low, high = np.log(SIZES[name])
        random = np.random.default_rng([seed, 2])
        hidden = {name: float(np.exp(random.uniform(low, high)) * random.choice([-1.0, 1.0]))}
    readings, model = head.simulate(hidden, seed=seed), head.INSTRUMENT.baseline()
    begun = time.process_time()
    path = bc.calibrate(model, readings, seed=seed)
    seconds = time.process_time() - begun
    sets = path.steps[0].discovery.sets if path.steps[0].discovery else ()
    row: dict[str, Any] = {
        "seed": seed,
        "hidden": hidden,
        "final": sorted(path.added),
        "sets": [[list(s.effects), s.probability] for s in sets],
        "covered": {},
        "seconds": seconds,
    }
    for name, true in {**BASELINE, **hidden}.items():
        if name in path.calibration.posterior:
            low, high = credible_interval(path.calibration.samples(name))
            row["covered"][name] = low < true < high
    if hidden:
        found = Searched.of(model, readings)
        truth = found.structures.weigh(Structure(frozenset(hidden)), found.base)
        row["oracle"] = truth.log_evidence - found.base.log_evidence
    return row, f"{seed} {seconds:.1f} s {hidden} -> {row['final']}"


def summarise() -> None:
    """Write and print the counts of the campaigns that stand."""
    rows = read_lines(RESULTS / "dividing_head.jsonl")
    inside = [
        held
        for row in rows
        for name, held in row["covered"].items()
        if name in BASELINE or name in row["final"]
    ]
    found = {**counts(rows), "intervals that hold the truth": proportion(sum(inside), len(inside))}
    write("dividing_head", found)
    print(found)
