"""Does `calibrate` end at one structure, whichever model on the way it begins at?

    python -m benchmarks starts

Three effects are hidden. From the baseline, and from the baseline with each subset of what was added then, at random
five starts in all. A line a campaign in results/starts.jsonl.
"""

from __future__ import annotations

import itertools
import time
from typing import Any

import numpy as np

import bayescal as bc
from benchmarks.hidden_effects.resume import go_on_by_seed
from benchmarks.record import RESULTS
from benchmarks.wrong_model import page
from benchmarks.wrong_model.coverage import WORLDS
from benchmarks.wrong_model.worlds import HIDDEN_IN

COUNT = 40  # campaigns, half of them of each instrument
STARTS = 5
EFFECTS = 3
SIZES = (0.3, 5.0)
PATH = RESULTS / "starts.jsonl"


def main() -> None:
    """Run what is missing, and render the page."""
    go_on_by_seed(PATH, range(COUNT), campaign)
    page.write()


def campaign(seed: int) -> tuple[dict[str, Any], str]:
    """One campaign from its starts: what each ends at, and its log evidence."""
    name = sorted(HIDDEN_IN)[seed % 2]
    instrument, made, _ = WORLDS[name]
    rng = np.random.default_rng([39, seed])
    names = rng.choice(HIDDEN_IN[name], size=EFFECTS, replace=False)
    world = made(1000 + seed, {str(n): float(np.exp(rng.uniform(*np.log(SIZES)))) for n in names})
    begun = time.perf_counter()
    baseline = instrument.baseline()
    first = bc.calibrate(baseline, world.readings, method=bc.LeastSquares())
    added = [e for e in first.final.calibration.model.effects if e.name not in baseline.names]
    subsets = [s for k in range(1, len(added) + 1) for s in itertools.combinations(added, k)]
    rng.shuffle(subsets)  # type: ignore[arg-type]
    ends = [_end(first, ())]
    for subset in subsets[: STARTS - 1]:
        path = bc.calibrate(baseline + subset, world.readings, method=bc.LeastSquares())
        ends.append(_end(path, [e.name for e in subset]))
    row = {
        "seed": seed,
        "instrument": name,
        "hidden": world.hidden,
        "ends": ends,
        "same": len({tuple(e["final"]) for e in ends}) == 1,
        "seconds": time.perf_counter() - begun,
    }
    return row, f"{name} {seed} same {row['same']}"


def _end(path: bc.SearchPath, start: Any) -> dict[str, Any]:
    last = path.final
    return {
        "start": list(start),
        "final": sorted(last.calibration.model.names),
        "log_evidence": last.calibration.log_evidence,
        "complete": last.discovery.nothing_missing if last.discovery else None,
        "open": path.gate.ok,
    }
