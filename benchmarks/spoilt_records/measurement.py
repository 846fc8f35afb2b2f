"""The gauntlet: forty kinds of spoilt record, as files from a laboratory are; which are silently answered wrongly.

    python -m benchmarks gauntlet                 every instrument
    BAYESCAL_ONLY=mems_gyro BAYESCAL_KINDS="gaps;clipped at one end" python -m benchmarks gauntlet
    BAYESCAL_SEEDS=1 BAYESCAL_SECONDS=600 python -m benchmarks gauntlet

A campaign is simulated, with an effect hidden in every second one, spoilt, written to a file, read and calibrated as a
user would; a second campaign, which the search never sees, judges what came out (`judge.py`). One JSON line a record
in results/gauntlet_NAME.jsonl: stopped, it goes on where it was.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

from benchmarks.hidden_effects.resume import chosen, go_on
from benchmarks.record import DOCS, RESULTS, read_lines
from benchmarks.spoilt_records import page
from benchmarks.spoilt_records.judge import judged
from benchmarks.spoilt_records.kinds import KINDS, Kind
from benchmarks.spoilt_records.subjects import SUBJECTS

SEEDS = 5  # of each kind for each instrument


def main() -> None:
    """Run what is missing of each instrument's part, then render the page."""
    for name in chosen(SUBJECTS):
        run(name)
    render()


def render() -> None:
    """Render the page from the results that stand."""
    files = sorted(RESULTS.glob("gauntlet_*.jsonl"))
    results = {path.stem.removeprefix("gauntlet_"): read_lines(path) for path in files}
    page.write(results, DOCS / "gauntlet.md")


def run(name: str) -> None:
    """One instrument's part, resumed."""
    subject, path = SUBJECTS[name], RESULTS / f"gauntlet_{name}.jsonl"
    done = {(row["kind"], row["seed"]) for row in read_lines(path)}

    def measure(case: tuple[Kind, int]) -> tuple[dict[str, Any], str]:
        row = judged(subject, *case)
        what = f"{row['verdict']} {row.get('added', '')} {' '.join(row['says'])[:100]}"
        return row, f"{row['kind']}, {row['seed']}: {row['seconds']:.1f} s {what}"

    missing = (case for case in plan(name) if (case[0].name, case[1]) not in done)
    go_on(path, missing, measure)


def plan(name: str) -> Iterator[tuple[Kind, int]]:
    """Kinds and seeds, a seed of every kind before the next, so that a part of them is a fair sample."""
    asked = [k for k in os.environ.get("BAYESCAL_KINDS", "").split(";") if k]
    for seed in range(1, 1 + int(os.environ.get("BAYESCAL_SEEDS", SEEDS))):
        for kind in KINDS.values():
            if kind.fits(SUBJECTS[name]) and (not asked or kind.name in asked):
                yield kind, seed
