"""Effects hidden in gyroscope campaigns under sums of noise terms, and in the same campaigns under white noise.

    python -m benchmarks under_noise

Three runs over temperature, 528 readings a minute apart. Every other campaign hides one effect at a size drawn
log-uniformly. The same readings are searched as the simulator gives them and with two Ornstein–Uhlenbeck processes or
a flicker added, of the white noise's own size in each run. The oracle is the log evidence of the true structure less
that of the baseline, both under the noise law of the most probable structure. One JSON line a campaign in
results/under_noise.jsonl: stopped, it goes on where it was.
"""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._data.time_in_runs import run_codes
from bayescal._search.structures import Structure
from bayescal_models import mems_gyro
from benchmarks.hidden_effects.bank import instrument_named
from benchmarks.hidden_effects.outcomes import CLEAR, said
from benchmarks.hidden_effects.resume import go_on_by_seed
from benchmarks.hidden_effects.searched import Searched, noise_of
from benchmarks.intervals import proportion
from benchmarks.record import RESULTS, read_lines, write

CAMPAIGNS = 400
CAMPAIGN = mems_gyro.Campaign(temperatures=tuple(range(10, 81, 10)), dwell=1320.0, average=60.0)
# Correlation times of the processes that are added, in parts of a run, each with the same variance. Five of them at
# equal ratios are a flicker between the shortest and the longest.
ADDED = {"two": (0.2, 0.02), "flicker": (0.5, 0.17, 0.055, 0.018, 0.006)}
SIZES = {  # least and largest, in the unit of each effect's coefficient
    "bias.thermal_lag": (0.01, 0.5),
    "bias.temperature_quadratic": (2e-5, 1e-3),
    "bias.warm_up": (0.02, 1.0),
    "bias.drift": (0.02, 0.5),
}


def main() -> None:
    """Run what is missing of the campaigns, then write and print the counts."""
    go_on_by_seed(RESULTS / "under_noise.jsonl", range(CAMPAIGNS), measure)
    summarise()


def measure(seed: int) -> tuple[dict[str, Any], str]:
    """One campaign, under white noise and under more; and what is told of it."""
    instrument, hidden = instrument_named("mems_gyro"), dict[str, float]()
    turn = seed // 2
    if seed % 2:
        name = tuple(SIZES)[turn % len(SIZES)]
        low, high = np.log(SIZES[name])
        hidden[name] = float(np.exp(np.random.default_rng([seed, 2]).uniform(low, high)))
    assert instrument.simulate is not None
    readings = instrument.simulate(hidden, seed=seed, campaign=CAMPAIGN)
    model = instrument.for_readings(readings).baseline()
    kind = tuple(ADDED)[turn // len(SIZES) % len(ADDED)]
    slow = noise_of(model, readings) * _slow(readings, ADDED[kind], seed)
    noisy = readings.with_column("output", readings["output"] + slow)
    row: dict[str, Any] = {"seed": seed, "hidden": hidden, "added": kind}
    row |= {"white": _searched(model, readings, hidden), "noisy": _searched(model, noisy, hidden)}
    ends = " | ".join(f"{row[one]['final']} {row[one]['noise']}" for one in ("white", "noisy"))
    return row, f"{seed} {hidden} {kind} -> {ends}"


def _slow(readings: bc.Measurements, parts: tuple[float, ...], seed: int) -> np.ndarray:
    """Ornstein–Uhlenbeck processes in each run, together of unit variance."""
    random, (runs, at) = np.random.default_rng([seed, 3]), run_codes(readings)
    made = np.zeros(len(readings))
    for one in range(len(runs)):
        rows = np.flatnonzero(at == one)
        since = readings["time"][rows]
        for part in parts:
            value, memory = random.standard_normal(), part * float(np.ptp(since))
            made[rows[0]] += value
            for (_, before), (row, now) in pairwise(zip(rows, since, strict=True)):
                kept = np.exp(-(now - before) / memory)
                value = kept * value + np.sqrt(1 - kept**2) * random.standard_normal()
                made[row] += value
    return made / np.sqrt(len(parts))


def _searched(
    model: bc.Model, readings: bc.Measurements, hidden: dict[str, float]
) -> dict[str, Any]:
    begun = time.perf_counter()
    found = Searched.of(model, readings)
    row = {
        "final": sorted(found.chosen.effects),
        "noise": found.structures.noise(found.chosen).in_words,
        "nothing": found.posterior.complete(found.structures),
        "sets": [[list(s.effects), s.probability] for s in found.sets],
        "seconds": time.perf_counter() - begun,
    }
    if hidden:
        without = Structure(noise=found.chosen.noise)
        base = found.structures.weigh(without, found.base)
        truth = found.structures.weigh(without.plus(*hidden), base)
        row["oracle"] = truth.log_evidence - base.log_evidence
    return row


def summarise() -> None:
    """Write and print the counts of the campaigns that stand."""
    rows = read_lines(RESULTS / "under_noise.jsonl")
    summary = {one: _counts(rows, one) for one in ("white", "noisy")}
    write("under_noise", summary)
    for name, counts in summary.items():
        print(f"{name:6s} {counts}")


def _stated_and_true(rows: list[dict[str, Any]], which: str) -> list[str]:
    """By stated probability that nothing is missing: its mean, the share where nothing was hidden, and campaigns."""
    stated = np.array([row[which]["nothing"] for row in rows])
    true = np.array([not row["hidden"] for row in rows])
    made = []
    for low, high in pairwise((0.0, 0.05, 0.5, 0.8, 1.0)):
        among = (stated > low) & (stated <= high)
        if among.any():
            made.append(f"{stated[among].mean():.2f}: {true[among].mean():.2f} of {among.sum()}")
    return made


def _counts(rows: list[dict[str, Any]], which: str) -> dict[str, Any]:
    empty = [row[which] for row in rows if not row["hidden"]]
    hidden = [(set(row["hidden"]), row[which]) for row in rows if row["hidden"]]
    visible = [(names, row) for names, row in hidden if row["oracle"] > CLEAR]
    return {
        "campaigns": len(rows),
        f"found where the oracle is above {CLEAR:g}": proportion(
            sum(names <= {*row["final"]} for names, row in visible), len(visible)
        ),
        "named, alone or as one of a set": proportion(
            sum(names <= said(row) for names, row in visible), len(visible)
        ),
        "something else beside it or in its place": proportion(
            sum(bool({*row["final"]} - names) for names, row in hidden), len(hidden)
        ),
        "in the likeliest model where nothing was hidden": proportion(
            sum(bool(row["final"]) for row in empty), len(empty)
        ),
        "said to be missing where nothing was hidden": proportion(
            sum(bool(row["sets"]) for row in empty), len(empty)
        ),
        "stated and true share of nothing hidden": _stated_and_true(rows, which),
        "noise law": {
            law: [row["noise"] for row in empty].count(law)
            for law in sorted({row["noise"] for row in empty})
        },
    }
