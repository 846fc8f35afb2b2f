"""Effective draws per second of three models: ours beside the samplers of today.

    python -m benchmarks samplers        one row after another; stopped, it goes on where it was
    BAYESCAL_ONLY="fleet: nutpie;bayescal" python -m benchmarks samplers      rows whose name holds one of these

The models are in `problems.py`. Every unknown counts: coefficients, deviations of cells or devices, learned
spreads, noise. All get the same log density, compiled by JAX: plain, marginal or whitened (`targets.py`).

Effective draws are the least over all unknowns: for weighted draws the variance over the squared Monte-Carlo error,
both from the joint corrected weights; for chains ArviZ's bulk effective sample size. The time is everything after
compilation: for ours the Laplace fit, the search for what to sample, the rounds of adaptation and the draws; for
chains the warm-up too. Every row's posterior is compared with the best chains on an exact target: see `reference`.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from benchmarks.record import RESULTS, add_line, read_lines, write
from benchmarks.speed.own_process import measured
from benchmarks.speed.samplers.measured_row import rows as rows_of_a_model
from benchmarks.speed.samplers.peers import CHAINS, DRAWS
from benchmarks.speed.samplers.problems import PROBLEMS
from benchmarks.speed.samplers.targets import bound

LINES = RESULTS / "samplers.jsonl"
SECONDS = 3300.0  # of one row, after which it is ended; one that was ended is tried again where more are given
ROWS = rows_of_a_model()


def main() -> None:
    """Run the rows that are missing, each in a process of its own; write and print the table."""
    limit = float(os.environ.get("BAYESCAL_SECONDS", SECONDS))
    done = {line["row"]: line for line in read_lines(LINES)}
    only = [part for part in os.environ.get("BAYESCAL_ONLY", "").split(";") if part]
    for name in (f"{problem}: {row}" for problem in PROBLEMS for row in ROWS):
        ended = done.get(name, {}).get("ended_after", 0.0 if name not in done else np.inf)
        if ended >= limit or (only and not any(part in name for part in only)):
            continue
        found = measured(__name__, name, limit)
        if found is None:
            continue
        done[name] = {"row": name, **found}
        add_line(LINES, done[name])
        print(_told(done[name], done), flush=True)
    rows = [_short(r, done) for r in done.values()]
    write("samplers", {"draws": DRAWS, "chains": CHAINS, "rows": rows})
    print("\n".join(_told(r, done) for r in done.values()))


def measure(name: str) -> dict[str, Any]:
    """One row, in this process."""
    problem, _, row = name.partition(": ")
    return ROWS[row](bound(*PROBLEMS[problem]()))


def reference(row: dict[str, Any], done: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    """The row of chains on an exact target of the same problem with most effective draws, R̂ below 1.01."""
    problem = row["row"].partition(":")[0]
    good = [
        r for n, r in done.items() if n.startswith(f"{problem}:") and r.get("max_r_hat", 2) < 1.01
    ]
    return max(good, key=lambda r: r["least_ess"], default=None)


def _short(row: dict[str, Any], done: dict[str, dict[str, Any]]) -> dict[str, Any]:
    kept = {k: v for k, v in row.items() if k not in ("mean", "sd")}
    if "ended_after" in row:
        return kept
    against = reference(row, done)
    if against is None or against is row:
        return kept
    sd = np.array(against["sd"], float)
    distance = np.abs(np.array(row["mean"], float) - np.array(against["mean"], float)) / sd
    ratio = np.array(row["sd"], float) / sd
    return {
        **kept,
        "largest_distance_of_a_mean_sd": float(np.nanmax(distance)),
        "sd_ratio": [float(np.nanmin(ratio)), float(np.nanmax(ratio))],
    }


def _told(row: dict[str, Any], done: dict[str, dict[str, Any]]) -> str:
    own = _short(row, done)
    if "ended_after" in own:
        return f"{own['row']:62s} not ended in {own['ended_after']:.0f} s"
    health = f"k̂ {own['pareto_k']:.2f}" if "pareto_k" in own else f"R̂ {own['max_r_hat']:.2f}"
    apart = own.get("largest_distance_of_a_mean_sd")
    return (
        f"{own['row']:62s} {own['per_second']:9.3g} a second, least ESS {own['least_ess']:6.0f} in "
        f"{own['seconds']:6.2f} s, compiling {own['compiling']:5.1f} s, {health}"
        + ("" if apart is None else f", means within {apart:.2f} sd")
    )
