"""The page of speeds, from the results that stand: samplers, readings, start-up, many devices, the workbench.

python -m benchmarks.speed.page
"""

from __future__ import annotations

from typing import Any

from benchmarks.markdown import table
from benchmarks.record import DOCS, read

PAGE = DOCS / "speed.md"
HEAD = """# Speed

Rendered from `benchmarks/results/*.json`; `make bench-samplers`, `bench-scaling`, `bench-start-up` and
`bench-batches` measure each table anew, peers and ours in one run on one machine, and check every answer before they
state a speed. Machines differ and are busy: read the ratios. No graphics processor was used.

These tables were measured before the core became one (2026-11-25, [decisions](decisions.md)). Since then a search of
330 readings takes 1.4 to 1.5 times as long, one of 10⁵ rows 2.4 times, and *marginal* is no program of ours any more.
The log evidence of 1,600 or 16,000 readings under white noise takes 0.23 ms with its gradient.
"""
SAMPLERS = """## Effective draws per second

The least effective sample size over all unknowns, coefficients and φ, by the seconds of everything after compilation:
Laplace fit, choice of what is sampled, adaptation, warm-up and draws. Ours is what `bc.fit` runs, on the host; the
others get the same log density, compiled by JAX. *Plain* is the NumPyro program as anyone would write it; *whitened*
and *marginal* are our programs of the same posterior, handed to the samplers of others. *Means* and *sds*: the largest
distance of a mean from those of the reference chains, in their standard deviations, and the range of ratios of standard
deviations. A row with R̂ above 1.01 has not converged, and its effective draws are not to be believed. A row that had
not ended was given up after the seconds stated, with other work on the machine: it bounds that sampler's speed, and
measures none.

"""
SCALING = """## Readings, candidates, single fits

One core.

"""
START_UP = """## From a command to its answer

`bayescal calibrate` on the gyroscope's table of 18 rows, a fresh process; beside it a script of PyMC and nutpie that
fits a line and a quadratic and compares them. `calibrate` also checks the line and weighs every candidate effect.

"""
BATCHES = """## Ten thousand devices by least squares

"""

WORKBENCH = """## The workbench

In a headless Chromium, from the press to what it brings being on the page; beside it the CPU seconds of the server
alone, since other work on the machine lengthens wall-clock times. A page that says what is being done stands from the
first second; the whole page comes when Panel is loaded and the first model is fitted, a process with its compiled code
on the disk. Preview and *Add*: 2,000 readings, the median of four candidates, each pointed at for the first time.
Redraw: a further panel of 10⁵ readings, while the search for what is missing goes on beside it, whose CPU seconds are
in that row too.

"""
WORKBENCH_ROWS = {
    "first paint": "from the command to the first words on the page",
    "whole page": "from the command to the whole page, the first model fitted",
    "preview": "pointing → curve and error left",
    "add": "*Add* → new state",
    "redraw": "a column ticked → its panel, 10⁵ readings",
}


def render() -> None:
    """Write `docs/speed.md` from the tables that have been measured."""
    parts = [HEAD]
    for name, head, rows in (
        ("samplers", SAMPLERS, _samplers),
        ("scaling", SCALING, _scaling),
        ("start_up", START_UP, _start_up),
        ("batches", BATCHES, _batches),
        ("workbench", WORKBENCH, _workbench),
    ):
        if found := read(name):
            parts.append(head + rows(found))
    PAGE.write_text("\n".join(parts), encoding="utf-8")


def _samplers(found: dict[str, Any]) -> str:
    head = ("model", "sampler", "least ESS", "seconds", "a second", "compiling, s", "k̂ or R̂")
    rows = sorted(
        found["rows"], key=lambda r: (r["row"].partition(":")[0], -r.get("per_second", 0.0))
    )
    return table([*head, "means", "sds"], map(_sampler, rows))


def _sampler(r: dict[str, Any]) -> list[str]:
    model, _, sampler = r["row"].partition(": ")
    if "ended_after" in r:
        seconds = f"> {r['ended_after']:.0f}"
        return [model, sampler, "–", seconds, "–", "–", "not ended", "–", "–"]
    apart, ratio = r.get("largest_distance_of_a_mean_sd"), r.get("sd_ratio")
    return [
        model,
        sampler,
        f"{r['least_ess']:.0f}",
        f"{r['seconds']:.2f}",
        f"{r['per_second']:.3g}",
        f"{max(r['compiling'], 0.0):.0f}",
        f"k̂ {r['pareto_k']:.2f}" if "pareto_k" in r else f"R̂ {r['max_r_hat']:.2f}",
        "reference" if apart is None else f"{apart:.2f}",
        "–" if ratio is None else f"{ratio[0]:.2f} … {ratio[1]:.2f}",
    ]


def _scaling(found: dict[str, Any]) -> str:
    return table(["what", "found"], ([r["row"], r["told"]] for r in found["rows"]))


def _start_up(found: dict[str, Any]) -> str:
    head = ("start", "bayescal, s", "PyMC + nutpie cold, s", "ratio, wall-clock")
    peer = found["rows"]["cold"]["peer"]
    rows = [
        [
            start,
            f"{r['bayescal']['clock']:.1f}",
            f"{peer['clock']:.1f}",
            f"{r['times_the_peer_cold']['clock']:.1f} ×",
            f"{r['times_the_peer_cold']['processor']:.1f} ×",
            f"{r['goal']:.0f} ×",
        ]
        for start, r in found["rows"].items()
    ]
    return table([*head, "ratio, CPU", "goal"], rows)


def _batches(found: dict[str, Any]) -> str:
    head = ("peer, on both cores", "its seconds over ours", "by CPU seconds")
    rows = [
        [
            name,
            *(f"{r['ratio'][key]:.0f} ×" for key in ("fit", "fit, processor", "from the file")),
            "–" if r["goal"] is None else f"{r['goal']} ×",
        ]
        for name, r in found["times"].items()
        if name != "bayescal"
    ]
    return table([*head, "with reading the file", "goal"], rows)


def _workbench(found: dict[str, Any]) -> str:
    rows = [
        [
            words,
            f"{r['clock']:.2f}",
            f"{r['processor']:.2f}",
            f"{r['goal']:g}" if r["goal"] else "–",
        ]
        for name, words in WORKBENCH_ROWS.items()
        if (r := found["rows"].get(name))
    ]
    shown = table(["what", "wall-clock, s", "server, CPU s", "goal, s"], rows)
    return f"{shown}\nOver the last quarter of an hour {found['load']:.0f} processes wanted these cores.\n"


if __name__ == "__main__":
    render()
