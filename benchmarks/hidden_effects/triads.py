"""Effects hidden in campaigns of three axes: found where they can be, and none invented.

    python -m benchmarks triads

Accelerometers in 14 poses at each of five temperatures and gyroscopes on a rate table at the same temperatures, in
turn. In every other campaign one effect is hidden: K2, misalignment over temperature, a thermal lag of one axis or, of
gyroscopes, g-sensitivity, at a size drawn log-uniformly; nothing in the others. Each is searched as `calibrate` does,
without its fits and checks. The oracle is the log evidence of the true structure less the baseline's: where it is
small no search can find the effect. One JSON line a campaign in results/triads.jsonl: stopped, it goes on where it was.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from bayescal._search.structures import Structure
from bayescal_models.accelerometer_triad.campaign import Campaign as Poses
from bayescal_models.gyro_triad.campaign import Campaign as Rates
from benchmarks.hidden_effects.bank import instrument_named
from benchmarks.hidden_effects.outcomes import CLEAR, said
from benchmarks.hidden_effects.resume import go_on_by_seed
from benchmarks.hidden_effects.searched import Searched
from benchmarks.intervals import proportion
from benchmarks.record import RESULTS, read_lines, write

CAMPAIGNS = 800  # half of them with an effect, as many of each instrument
TEMPERATURES = (-20.0, 0.0, 25.0, 50.0, 70.0)  # °C
PLANS: dict[str, Poses | Rates] = {
    "accelerometer_triad": Poses(poses=14, temperatures=TEMPERATURES),
    "gyro_triad": Rates(temperatures=TEMPERATURES),
}
# Least and largest size, in the unit of the effect's coefficients: from hardly visible to plain at these campaigns.
SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "accelerometer_triad": {
        "square.constant": (1.0, 15.0),
        "misalignment.temperature": (0.01, 0.1),
        "bias.thermal_lag": (0.05, 1.0),
    },
    "gyro_triad": {
        "bias.g_sensitivity": (0.01, 0.2),
        "square.constant": (0.3, 10.0),
        "misalignment.temperature": (0.003, 0.06),
        "bias.thermal_lag": (5e-4, 0.03),
    },
}


def main() -> None:
    """Run what is missing of the campaigns, then write and print the counts."""
    go_on_by_seed(RESULTS / "triads.jsonl", range(CAMPAIGNS), measure)
    summarise()


def measure(seed: int) -> tuple[dict[str, Any], str]:
    """One campaign: what was hidden, what was found, and what is told of it."""
    name = tuple(PLANS)[seed // 2 % len(PLANS)]
    kind: str | None = None
    hidden: dict[str, Any] = {}
    if seed % 2:
        turn = seed // (2 * len(PLANS))
        kind = tuple(SIZES[name])[turn % len(SIZES[name])]
        low, high = SIZES[name][kind]
        size = float(np.exp(np.random.default_rng([seed, 2]).uniform(np.log(low), np.log(high))))
        one_axis = tuple(size * np.roll([1.0, 0.0, 0.0], turn))
        hidden = {kind: one_axis if kind == "bias.thermal_lag" else size}
    instrument = instrument_named(name)
    assert instrument.simulate is not None
    readings = instrument.simulate(hidden, seed=seed, campaign=PLANS[name])
    begun = time.perf_counter()
    found = Searched.of(instrument.for_readings(readings).baseline(), readings)
    chosen, taken = sorted(found.chosen.effects), time.perf_counter() - begun
    row = {
        "seed": seed,
        "instrument": name,
        "hidden": hidden,
        "final": chosen,
        "noise": found.structures.noise(found.chosen).in_words,
        "nothing": found.posterior.complete(found.structures),
        "sets": [[list(s.effects), s.probability] for s in found.sets],
        "seconds": taken,
    }
    if kind is not None:
        truth = found.structures.weigh(Structure(frozenset({kind})), found.base)
        row["oracle"] = truth.log_evidence - found.base.log_evidence
    return row, f"{seed} {taken:.1f} s {hidden} -> {chosen}"


def summarise() -> None:
    """Write and print the counts of the campaigns that stand."""
    rows = read_lines(RESULTS / "triads.jsonl")
    summary = {
        name: counts([row for row in rows if name in (row["instrument"], "all")])
        for name in (*PLANS, "all")
    }
    write("triads", summary)
    for name, count in summary.items():
        print(f"{name:20s} {count}")


def counts(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What became of campaigns with one hidden effect, and of those with none."""
    empty = [row for row in rows if not row["hidden"]]
    hidden = [row for row in rows if row["hidden"]]
    visible = [row for row in hidden if row["oracle"] > CLEAR]
    return {
        "campaigns": len(rows),
        "hidden": len(hidden),
        f"found where the oracle is above {CLEAR:g}": proportion(
            sum({*row["hidden"]} <= {*row["final"]} for row in visible), len(visible)
        ),
        "named, alone or as one of a set": proportion(
            sum({*row["hidden"]} <= said(row) for row in visible), len(visible)
        ),
        "something else beside it": proportion(
            sum(bool({*row["final"]} - {*row["hidden"]}) for row in hidden), len(hidden)
        ),
        "invented where nothing was hidden": proportion(
            sum(bool(row["final"]) for row in empty), len(empty)
        ),
        "median seconds": float(np.median([row["seconds"] for row in rows])) if rows else None,
    }
