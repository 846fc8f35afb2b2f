"""The open benchmark *find the missing effect*, on an edition that no entry was developed on, and its page.

It makes the tasks and lets every entry solve them in isolation, one after the other; an interrupted run resumes. 100
tasks take about 45 minutes of processor time. Another edition is a new number in `EDITION`: draw it once, at random.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks import pages
from benchmarks.record import REFERENCE_DATA, ROOT, read, write

EDITION = 113767  # drawn at random after the last change of any entry
SIZE = 100
ENTRIES = ("bayescal", "exhaustive", "bma", "bma_ar1", "bic", "mbic", "susie")
# The others in this process: quick, and a start counted for each task.
ISOLATED = ("bayescal", "exhaustive")
REAL = ("bayescal", "exhaustive", "bma", "bma_ar1", "bic")
PACKAGES = tuple(ROOT / "benchmarks" / p for p in ("missing_effect", "missing_effect/maker"))
OUTPUT = ROOT / "benchmarks" / "output" / "missing_effect"

ABOUT = """
An open benchmark, `benchmarks/missing_effect/`: a separate package, which needs numpy, pandas and scipy but not
bayescal, and which is open to all entries. A task is an instrument, its known model, its readings, and 7 to 10
candidate effects of which some, or none, are missing; an entry states the probability of each set of them, and predicts
hold-out readings. Its README describes how to enter; its data sheet how tasks are made, the scores, and the
benchmark's limitations, above all that its authors wrote two of the entries.

    pip install ./benchmarks/missing_effect ./benchmarks/missing_effect/maker
    python -m missing_effect generate tasks --size 10
    python -m missing_effect run bic exhaustive --tasks tasks
    python -m missing_effect leaderboard --tasks tasks

Below are {tasks} tasks of an edition whose number, {edition}, was drawn at random once, after the last change of
any entry; {fleets} have a hundred devices each. Every entry had 60 s of processor time per task, start-up included.
*Log score*: mean log probability of the true set, 0 at best. *False alarms*: tasks without a missing effect for which
one was stated with probability above 0.95. *CRPS*: of the hold-out readings, in standard deviations of their noise.
`oracle` knows the truth. *exhaustive* (all sets of at most two effects on grids) and *bayescal* use the data sheet
as prior. All entries were finished on the published edition. 48 of these tasks were then scored once
(bayescal −0.230, exhaustive −0.164); after that bayescal's entry used one more sentence of the data sheet, and two
fleets without an answer were solved again. Twelve tasks of public records (NIST's, and channels of a chamber ramp) are
in the last column.
"""


def main() -> None:
    """Make the tasks, solve and score them, and write results and page."""
    sys.path[:0] = [str(p) for p in PACKAGES if str(p) not in sys.path]
    from missing_effect.run import entry_file, run
    from missing_effect.score import ORACLE, scored
    from missing_effect_maker import generate, real

    tasks, answers = OUTPUT / f"edition_{EDITION}", OUTPUT / f"answers_{EDITION}"
    records = OUTPUT / "records"
    list(generate.generate(tasks, SIZE, EDITION))
    for name in ENTRIES:
        trusted = name not in ISOLATED
        for task, answer in run(entry_file(name), tasks, answers, SIZE, trusted=trusted):
            print(f"{name} {task} {answer['seconds']:.1f} s", flush=True)
    scores = {n: scored(tasks, answers, n, SIZE) for n in (*ENTRIES, ORACLE)}
    results: dict[str, Any] = {"edition": EDITION, "tasks": SIZE}
    results["entries"] = _plain(scores)
    results["real"] = read("missing_effect").get("real", {})
    if REFERENCE_DATA.is_dir():
        list(real.generate(REFERENCE_DATA, records))
        for name in REAL:
            list(run(entry_file(name), records, OUTPUT / "answers_records", None))
        scores = {n: scored(records, OUTPUT / "answers_records", n, None) for n in (*REAL, ORACLE)}
        results["real"] = _plain(scores)
    write("missing_effect", results)


def _plain(scores: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    return {entry: {task: vars(s) for task, s in of.items()} for entry, of in scores.items()}


def render() -> pages.Texts:
    """Render the page from the stored results."""
    results = read("missing_effect")
    entries, real = results["entries"], results["real"]
    body = []
    for name, of in sorted(entries.items(), key=lambda e: -_mean(e[1], "log")):
        empty = [s for s in of.values() if s["track"] == "empty"]
        alarms = sum(bool(s["alarm"]) for s in empty)
        records = f"{_mean(real[name], 'log'):.2f}" if name in real else "–"
        scores = (_mean(of, "log"), _mean(of, "crps"), _mean(of, "seconds"))
        log, crps, seconds = (f"{v + 0.0:.3f}" for v in scores)
        low, high = _bootstrap(of)
        body.append(
            [
                name,
                f"{log} ({low:.2f} to {high:.2f})",
                f"{alarms}/{len(empty)}",
                crps,
                seconds,
                records,
            ]
        )
    head = [
        "entry",
        "log score (95 %)",
        "false alarms",
        "CRPS",
        "processor, s a task",
        "public records",
    ]
    about = ABOUT.format(
        tasks=results["tasks"],
        edition=results["edition"],
        fleets=sum(s["fleet"] for s in entries["oracle"].values()),
    )
    day = [results["surroundings"]["day"]]
    table = pages.table(head, body)
    return pages.page(
        "missing_effect", "Find the missing effect", "open_benchmark", day, about, table
    )


def _mean(of: Mapping[str, Mapping[str, Any]], score: str) -> float:
    return float(np.mean([s[score] for s in of.values() if s[score] is not None]))


def _bootstrap(of: Mapping[str, Mapping[str, Any]]) -> tuple[float, float]:
    """Return the central 95 % of the mean log score over resampled tasks."""
    values = np.array([s["log"] for s in of.values()])
    means = np.random.default_rng(1).choice(values, (4000, len(values))).mean(axis=1)
    return tuple(np.quantile(means, [0.025, 0.975]).tolist())
