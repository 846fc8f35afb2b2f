"""Three runs of one temperature profile: is each hidden effect found, and does a departure stand for a named one?

    python -m benchmarks one_profile

A line a campaign in results/one_profile.jsonl.
"""

from __future__ import annotations

import time
from typing import Any

import bayescal as bc
from bayescal_models import mems_gyro
from benchmarks.hidden_effects.resume import go_on_by_seed
from benchmarks.record import RESULTS
from benchmarks.wrong_model import page
from benchmarks.wrong_model.worlds import one_profile

COUNT = 20
PATH = RESULTS / "one_profile.jsonl"
HIDDEN = ("bias.run", "bias.thermal_lag", "bias.warm_up", "bias.temperature_quadratic")


def main() -> None:
    """Run what is missing, and render the page."""
    go_on_by_seed(PATH, range(COUNT), campaign)
    page.write()


def campaign(seed: int) -> tuple[dict[str, Any], str]:
    """One campaign as `calibrate` leaves it."""
    begun = time.perf_counter()
    path = bc.calibrate(
        mems_gyro.INSTRUMENT.baseline(), one_profile(seed), method=bc.LeastSquares()
    )
    sets = [s.effects for step in path.steps if step.discovery for s in step.discovery.sets]
    names = path.final.calibration.model.names
    lost = [n for n in HIDDEN if n not in names and not any(n in members for members in sets)]
    row = {
        "seed": seed,
        "final": list(names),
        "sets": [list(s) for s in sets],
        "lost": lost,
        "departures": [n for n in names if n.startswith("departure(")],
        "complete": path.final.discovery.nothing_missing if path.final.discovery else None,
        "open": path.gate.ok,
        "seconds": time.perf_counter() - begun,
    }
    return row, f"{seed} lost {lost} departures {row['departures']} {path.gate.reason}"
