"""The page of speeds, from the results that stand: samplers, readings, start-up, many devices.

python -m benchmarks.speed.page
"""

from __future__ import annotations

import json
from typing import Any

from benchmarks.record import ROOT

PAGE = ROOT / "docs" / "speed.md"
HEAD = """# Speed

Rendered from `benchmarks/results/*.json`; `make bench-samplers`, `bench-scaling`, `bench-start-up` and
`bench-batches` measure each table anew, peers and ours in one run on one machine, and check every answer before they
state a speed. Machines differ and are busy: read the ratios. No graphics processor was used.
"""
SAMPLERS = """## Effective draws per second

The least effective sample size over all unknowns, coefficients and φ, by the seconds of everything after compilation:
Laplace fit, choice of what is sampled, adaptation, warm-up and draws. All samplers get the same log density, compiled
by JAX. *Plain* is the NumPyro program as anyone would write it; *whitened* and *marginal* are our programs of the same
posterior, handed to the samplers of others. *Means* and *sds*: the largest distance of a mean from those of the
reference chains, in their standard deviations, and the range of ratios of standard deviations. A row with R̂ above
1.01 has not converged, and its effective draws are not to be believed. A row that had not ended was given up after
the seconds stated, with other work on the machine: it bounds that sampler's speed, and measures none.

| model | sampler | least ESS | seconds | a second | compiling, s | k̂ or R̂ | means | sds |
|---|---|---|---|---|---|---|---|---|
"""
SCALING = """## Readings, candidates, single fits

One core.

| what | found |
|---|---|
"""
START_UP = """## From a command to its answer

`bayescal calibrate` on the gyroscope's table of 18 rows, a fresh process; beside it a script of PyMC and nutpie that
fits a line and a quadratic and compares them. `calibrate` also checks the line and weighs every candidate effect.

| start | bayescal, s | PyMC + nutpie cold, s | ratio by the clock | ratio by the processor | goal |
|---|---|---|---|---|---|
"""
BATCHES = """## Ten thousand devices by least squares

| peer, on both cores | its seconds over ours | by the processor | with reading the file | goal |
|---|---|---|---|---|
"""


def render() -> None:
    """Write `docs/speed.md` from the tables that have been measured."""
    parts = [HEAD]
    for name, head, rows in (
        ("samplers", SAMPLERS, _samplers),
        ("scaling", SCALING, _scaling),
        ("start_up", START_UP, _start_up),
        ("batches", BATCHES, _batches),
    ):
        path = ROOT / "benchmarks" / "results" / f"{name}.json"
        if path.is_file():
            lines = rows(json.loads(path.read_text("utf-8")))
            parts.append(head + "\n".join(lines) + "\n")
    PAGE.write_text("\n".join(parts), encoding="utf-8")


def _samplers(found: dict[str, Any]) -> list[str]:
    rows = sorted(
        found["rows"], key=lambda r: (r["row"].partition(":")[0], -r.get("per_second", 0.0))
    )
    lines = []
    for r in rows:
        model, _, sampler = r["row"].partition(": ")
        if "ended_after" in r:
            lines.append(
                f"| {model} | {sampler} | – | > {r['ended_after']:.0f} | – | – | not ended | – | – |"
            )
            continue
        health = f"k̂ {r['pareto_k']:.2f}" if "pareto_k" in r else f"R̂ {r['max_r_hat']:.2f}"
        apart, ratio = r.get("largest_distance_of_a_mean_sd"), r.get("sd_ratio")
        cells = (
            model,
            sampler,
            f"{r['least_ess']:.0f}",
            f"{r['seconds']:.2f}",
            f"{r['per_second']:.3g}",
            f"{r['compiling']:.0f}",
            health,
            "reference" if apart is None else f"{apart:.2f}",
            "–" if ratio is None else f"{ratio[0]:.2f} … {ratio[1]:.2f}",
        )
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _scaling(found: dict[str, Any]) -> list[str]:
    return [f"| {r['row']} | {r['told']} |" for r in found["rows"]]


def _start_up(found: dict[str, Any]) -> list[str]:
    peer = found["rows"]["cold"]["peer"]
    lines = []
    for start, r in found["rows"].items():
        ratio = r["times_the_peer_cold"]
        lines.append(
            f"| {start} | {r['bayescal']['clock']:.1f} | {peer['clock']:.1f} | {ratio['clock']:.1f} × "
            f"| {ratio['processor']:.1f} × | {r['goal']:.0f} × |"
        )
    return lines


def _batches(found: dict[str, Any]) -> list[str]:
    lines = []
    for name, r in found["times"].items():
        if name == "bayescal":
            continue
        ratio, goal = r["ratio"], r["goal"]
        lines.append(
            f"| {name} | {ratio['fit']:.0f} × | {ratio['fit, processor']:.0f} × | {ratio['from the file']:.0f} × "
            f"| {'–' if goal is None else f'{goal} ×'} |"
        )
    return lines


if __name__ == "__main__":
    render()
