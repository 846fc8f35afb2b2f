"""The gauntlet as a page: kind by instrument, totals, and every record that was silently answered wrongly."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.intervals import proportion
from benchmarks.markdown import table
from benchmarks.record import cores_of
from benchmarks.spoilt_records.judge import AWAY, WIDE, WORSE
from benchmarks.spoilt_records.kinds import KINDS

Rows = list[dict[str, Any]]
NOTHING = "nothing"  # the kind that is not spoilt
VERDICTS = ("right", "said", "wrong", "crash")
LONGEST = 160  # characters of a sentence on the page


def write(results: dict[str, Rows], further: dict[str, Rows], path: Path) -> None:
    """Render `docs/gauntlet.md`.

    Args:
        results: rows of each instrument.
        further: rows of each instrument of the kinds of a table.
        path: of the page.
    """
    spoilt = [r for rows in results.values() for r in rows if r["kind"] != NOTHING]
    parts = [
        "# Spoilt records: right, said, or silently wrong\n",
        "Rendered by `python -m benchmarks gauntlet` from `benchmarks/results/gauntlet_*.jsonl`. Each record is a "
        "simulated campaign, in three of five with an effect hidden in it, spoilt as files from a laboratory are, "
        "written to a CSV file, read by `bc.read` and searched by `bc.calibrate` (least squares, at most three "
        "effects). A second campaign, which the search does not see, judges the result.\n",
        f"*Right*: every true coefficient that the final model holds lies within {AWAY:g} posterior standard "
        f"deviations, and the error of the second campaign is at most {WORSE:g} times what it should be: the error "
        "of the true structure fitted to the record before it was spoilt (of the rows that are left), and the "
        f"model's own stated standard uncertainty (at most {WIDE:g} times that one's), in squares. "
        "*Said*: refused, or the gate is shut, or a flag or an effect that was added names "
        "the cause. *Wrong*: neither. *Crash*: an error that is no refusal, or whose sentence is of something else. "
        "What is true of each kind stands in `benchmarks/spoilt_records/`.\n",
        _in_short(spoilt),
        *_further(further),
        "## By instrument\n",
        _by_instrument(results),
        "## By kind\n",
        "Right / said / wrong; a dash where the kind cannot happen to the instrument, or was not measured yet.\n",
        _by_kind(results),
        "## Silently wrong\n",
        "What was added, the coefficient furthest from its truth in posterior standard deviations, the error of the "
        "second campaign and what it should be.\n",
        _wrong(results),
        "## What is said\n",
        "Of each kind, the sentence heard most often, in short, and how many of those said name the cause.\n",
        _said(spoilt),
    ]
    every = (row for some in (*results.values(), *further.values()) for row in some)
    path.write_text("\n".join([*parts, cores_of(every)]), encoding="utf-8")


def _in_short(rows: Rows) -> str:
    count = Counter(r["verdict"] for r in rows)
    n = len(rows)
    return (
        f"Of {n} spoilt records {proportion(count['right'], n)} were answered rightly and "
        f"{proportion(count['said'], n)} said to be spoilt; {proportion(count['wrong'], n)} silently wrong, "
        f"{count['crash']} ended in an error that is no refusal.\n"
    )


def _counted(rows: Rows) -> list[str]:
    """Cells of how many were answered rightly, said, wrong, or ended in a crash."""
    count = Counter(r["verdict"] for r in rows)
    return [proportion(count[v], len(rows)) for v in VERDICTS]


def _further(further: dict[str, Rows]) -> list[str]:
    """Sixty further kinds."""
    rows = [r for own in further.values() for r in own]
    if not rows:
        return []
    wrong = [
        [r["kind"], name, r["seed"], *_what_came(r)]
        for name, own in further.items()
        for r in own
        if r["verdict"] in ("wrong", "crash")
    ]
    counts = [[name, len(own), *_counted(own)] for name, own in further.items()]
    return [
        "## Sixty further kinds\n",
        "Faults of thermometer, clock, hold-out and logger, `benchmarks/spoilt_records/covariates.toml`, listed before "
        f"any check of them was written: {len(rows)} records, a random sample of kinds, instruments and seeds. A "
        "hold-out that is training data counts as right where the calibration is right and the sentence is there.\n",
        table(["instrument", "records", *VERDICTS], [*counts, ["all", len(rows), *_counted(rows)]]),
        *(
            [
                "Silently wrong:\n",
                table(["kind", "instrument", "seed", "added", "furthest", "error", "due"], wrong),
            ]
            if wrong
            else []
        ),
    ]


def _by_instrument(results: dict[str, Rows]) -> str:
    lines = []
    for name, rows in results.items():
        own = [r for r in rows if r["kind"] != NOTHING]
        count = Counter(r["verdict"] for r in own)
        seconds = np.median([r["seconds"] for r in rows])
        lines.append([name, len(own), *(count[v] for v in VERDICTS), f"{seconds:.1f}"])
    return table(["instrument", "records", *VERDICTS, "median s"], lines)


def _by_kind(results: dict[str, Rows]) -> str:
    lines = []
    for kind in (NOTHING, *(k for k in KINDS if k != NOTHING)):
        own = [[r for r in rows if r["kind"] == kind] for rows in results.values()]
        lines.append([kind, *map(_counts, own), _counts([r for rows in own for r in rows])])
    return table(["kind", *results, "all"], lines)


def _counts(rows: Rows) -> str:
    """Right / said / wrong, a crash counting as wrong."""
    if not rows:
        return "–"
    count = Counter(r["verdict"] for r in rows)
    made = f"{count['right']} / {count['said']} / {count['wrong'] + count['crash']}"
    return f"**{made}**" if count["wrong"] + count["crash"] else made


def _wrong(results: dict[str, Rows]) -> str:
    lines = [
        [r["kind"], name, r["seed"], *_what_came(r)]
        for kind in KINDS
        for name, rows in results.items()
        for r in rows
        if r["kind"] == kind and r["verdict"] in ("wrong", "crash")
    ]
    head = ["kind", "instrument", "seed", "added", "furthest", "error", "due"]
    return table(head, lines) if lines else "None.\n"


def _what_came(row: dict[str, Any]) -> list[str]:
    """Cells of what came out of a record."""
    if row["verdict"] == "crash":
        return [row["says"][0][:LONGEST], "", "", ""]
    error = f"{row['error']:.3g} {row['unit']}"
    return [_added(row), furthest(row), error, f"{row['due']:.3g}"]


def _added(row: dict[str, Any]) -> str:
    """Effects added, and the noise law if it is not white."""
    wide = ["correlated noise"] if row["noise"] != "white" else []
    return ", ".join([*row["added"], *wide]) or "nothing"


def furthest(row: dict[str, Any]) -> str:
    """The coefficient furthest from its truth, in words."""
    if not row.get("away"):  # nothing came out, or nothing has a truth
        return ""
    name = max(row["away"], key=lambda n: abs(row["away"][n]))
    return f"`{name}` {row['away'][name]:+.1f}"


def _said(rows: Rows) -> str:
    lines = []
    for kind in KINDS:
        told = [r for r in rows if r["kind"] == kind and r["verdict"] != "crash" and r["says"]]
        if not told:
            continue
        named = sum(bool(r["refused"]) or r["names_cause"] for r in told)
        often = Counter(" ".join(r["says"])[:LONGEST] for r in told).most_common(1)[0][0]
        lines.append([kind, f"{named}/{len(told)}", often.replace("|", "/")])
    return table(["kind", "names the cause", "for instance"], lines)
