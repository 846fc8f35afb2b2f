"""Kinds of faulty records, as files from a laboratory have them: how many are silently answered wrongly?

A campaign is simulated, with an effect hidden in every second one, changed by a fault, written to a file, read and
calibrated as by a user; a second campaign, which the search never uses, tests the result (`judge.py`). Forty-five kinds
are in `of_*.py`; sixty further kinds, listed before any check for them was written, are in `covariates.toml`.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import pages
from benchmarks.bank import Bank
from benchmarks.pages import Rows, proportion
from benchmarks.spoilt_records.judge import AWAY, MAX_SD, WORSE, judged
from benchmarks.spoilt_records.kinds import KINDS, Kind
from benchmarks.spoilt_records.of_file import kinds_of
from benchmarks.spoilt_records.subjects import SUBJECTS

SEEDS = 5  # of each kind for each instrument
SAMPLE = 6  # records of each file that a release measures anew
NOTHING = "nothing"  # the kind that is not spoilt
VERDICTS = ("right", "said", "wrong", "crash")
FURTHER = kinds_of(Path(__file__).with_name("covariates.toml"))
# Seeds, and records of each instrument, drawn at random.
FURTHER_SEEDS, FURTHER_RECORDS = (range(101, 106), 20)
ABOUT = f"""
Each record is a simulated campaign, three of five with a hidden effect, with a fault that files from a laboratory have,
written to a CSV file, read by `bc.read` and searched by `bc.calibrate` (least squares, at most three effects).
A second campaign, which the search does not use, tests the result. *Right*: every true coefficient in the final model
is within {AWAY:g} posterior standard deviations, and the error of the second campaign is at most {WORSE:g} times the
root sum of squares of two: the error of the true structure, fitted to the record before the fault, and the model's own
standard uncertainty (at most {MAX_SD:g} times that structure's). *Said*: refused, or the verdict fails, or a flag or an
added effect names the cause. *Wrong*: neither, or an error that is not a refusal. Cells: right/said/wrong.
"""


def cases(name: str, kinds: Mapping[str, Kind], seeds: range) -> Iterator[Any]:
    """Yield kinds and seeds, one seed of all kinds before the next, so that any initial part is representative."""
    fitting = [kind for kind in kinds.values() if kind.fits(SUBJECTS[name])]
    return (((k.name, seed), (name, k, seed)) for seed in seeds for k in fitting)


def further_cases(name: str) -> list[Any]:
    """Return a random sample of the records of further kinds."""
    listed = list(cases(name, FURTHER, FURTHER_SEEDS))
    return random.Random(name).sample(listed, FURTHER_RECORDS)


def measure(case: tuple[str, Kind, int]) -> dict[str, Any]:
    """Return the row of a record."""
    name, kind, seed = case
    return judged(SUBJECTS[name], kind, seed)


def _bank(label: str, name: str, measured: Any) -> Bank:
    return Bank(f"{label}_{name}", measured, measure, ("kind", "seed"))


SPOILT = tuple(
    _bank("gauntlet", n, partial(cases, n, KINDS, range(1, SEEDS + 1))) for n in SUBJECTS
)
SIXTY = tuple(_bank("covariates", n, partial(further_cases, n)) for n in SUBJECTS)
BANKS = (*SPOILT, *SIXTY)


def results(banks: tuple[Bank, ...] = SPOILT) -> dict[str, Rows]:
    """Return the rows of each instrument."""
    return dict(zip(SUBJECTS, (bank.rows for bank in banks), strict=True))


def verdicts(rows: Rows) -> Counter[str]:
    """Return the numbers of records that were right, said and wrong; crashes count as wrong."""
    count = Counter(r.get("verdict", "crash") for r in rows if r["kind"] != NOTHING)
    count["wrong"] += count.pop("crash", 0)
    return count


def _cell(rows: Rows, kind: str) -> str:
    kind_rows = [{**r, "kind": ""} for r in rows if r["kind"] == kind]
    count = verdicts(kind_rows)
    return f"{count['right']}/{count['said']}/{count['wrong']}" if kind_rows else "–"


def _total(rows: Rows) -> str:
    count = verdicts(rows)
    return " / ".join(proportion(count[v], count.total()) for v in VERDICTS[:3])


def furthest(row: dict[str, Any]) -> str:
    """Return the coefficient furthest from its truth, as text."""
    if not row.get("away"):  # nothing came out, or nothing has a truth
        return ""
    name = max(row["away"], key=lambda n: abs(row["away"][n]))
    return f"`{name}` {row['away'][name]:+.1f}"


def render() -> pages.Texts:
    """Render the page from the stored results."""
    groups, further = results(), results(SIXTY)
    days = [row["day"] for rows in (*groups.values(), *further.values()) for row in rows]
    claims = [(kind, partial(_cell, kind=kind)) for kind in KINDS]
    totals = pages.claims_table(groups, [("all with faults", _total)], "records")
    text = "Sixty more kinds: faults of thermometer, clock, hold-out and logger; a random sample."
    sixty = pages.claims_table(further, [("right/said/wrong", _total)], "records")
    together = {"all instruments": [row for rows in groups.values() for row in rows]}
    parts = (totals, text, sixty, "By kind:", pages.claims_table(together, claims, "records"))
    return pages.page("gauntlet", "Corrupted records", "gauntlet", days, ABOUT, *parts)
