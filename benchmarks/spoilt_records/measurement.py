"""The gauntlet: forty kinds of spoilt record, as files from a laboratory are; which are silently answered wrongly.

    python -m benchmarks gauntlet                 every instrument
    BAYESCAL_ONLY=mems_gyro BAYESCAL_KINDS="gaps;clipped at one end" python -m benchmarks gauntlet
    BAYESCAL_SEEDS=1 BAYESCAL_SECONDS=600 python -m benchmarks gauntlet
    BAYESCAL_FIRST_SEED=21 BAYESCAL_SEEDS=3 python -m benchmarks gauntlet                fresh seeds
    BAYESCAL_KINDS_FILE=mine.toml python -m benchmarks gauntlet        kinds of a table (`of_file.py`) alone

A campaign is simulated, with an effect hidden in every second one, spoilt, written to a file, read and calibrated as a
user would; a second campaign, which the search never sees, judges what came out (`judge.py`). One JSON line a record
in results/gauntlet_NAME.jsonl: stopped, it goes on where it was. Those of a table stand in results/TABLE_NAME.jsonl,
and are counted at the end.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.hidden_effects.resume import chosen, go_on
from benchmarks.record import DOCS, RESULTS, lines_of, read_lines
from benchmarks.spoilt_records import page
from benchmarks.spoilt_records.judge import judged
from benchmarks.spoilt_records.kinds import KINDS, Kind
from benchmarks.spoilt_records.of_file import kinds_of
from benchmarks.spoilt_records.subjects import SUBJECTS

FAR = 5.0  # posterior standard deviations: a coefficient there is wrong by any measure
SEEDS = 5  # of each kind for each instrument


def main() -> None:
    """Run what is missing of each instrument's part, then render the page; or count what came of a table's kinds."""
    table = os.environ.get("BAYESCAL_KINDS_FILE", "")
    kinds, label = (kinds_of(Path(table)), Path(table).stem) if table else (KINDS, "gauntlet")
    for name in chosen(SUBJECTS):
        run(name, kinds, label)
    if table:
        print(counted(label))
    else:
        render()


def counted(label: str) -> str:
    """What came of a table's kinds, an instrument a line; how many wrong ones have a coefficient beyond 5 of its sd."""
    lines = []
    for path in sorted(RESULTS.glob(f"{label}_*.jsonl")):
        rows = read_lines(path)
        count = Counter(row["verdict"] for row in rows)
        far = sum(row["verdict"] == "wrong" and beyond(row) for row in rows)
        said = ", ".join(f"{count[v]} {v}" for v in ("right", "said", "wrong", "crash"))
        lines.append(f"{path.stem}: {said}; {far} of the wrong beyond {FAR:g} standard deviations")
    return "\n".join(lines)


def beyond(row: dict[str, Any]) -> bool:
    """Whether a coefficient of a record's result is far from its truth."""
    return any(abs(z) > FAR for z in row.get("away", {}).values())


def render() -> None:
    """Render the page from the results that stand."""
    results, further = lines_of("gauntlet"), lines_of("covariates")
    page.write(results, further, DOCS / "gauntlet.md")


def run(name: str, kinds: Mapping[str, Kind] = KINDS, label: str = "gauntlet") -> None:
    """One instrument's part, resumed."""
    subject, path = SUBJECTS[name], RESULTS / f"{label}_{name}.jsonl"

    def measure(case: tuple[Kind, int]) -> tuple[dict[str, Any], str]:
        row = judged(subject, *case)
        what = f"{row['verdict']} {row.get('added', '')} {' '.join(row['says'])[:100]}"
        return row, f"{row['kind']}, {row['seed']}: {row['seconds']:.1f} s {what}"

    cases = (((kind.name, seed), (kind, seed)) for kind, seed in plan(name, kinds))
    go_on(path, ("kind", "seed"), cases, measure)


def plan(name: str, kinds: Mapping[str, Kind] = KINDS) -> Iterator[tuple[Kind, int]]:
    """Kinds and seeds, a seed of every kind before the next, so that a part of them is a fair sample."""
    asked = [k for k in os.environ.get("BAYESCAL_KINDS", "").split(";") if k]
    first = int(os.environ.get("BAYESCAL_FIRST_SEED", 1))
    for seed in range(first, first + int(os.environ.get("BAYESCAL_SEEDS", SEEDS))):
        for kind in kinds.values():
            if kind.fits(SUBJECTS[name]) and (not asked or kind.name in asked):
                yield kind, seed
