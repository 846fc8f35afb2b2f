"""Counts that several pages state, each from the committed rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from functools import cache
from typing import Any

from benchmarks.hidden_effects.outcomes import (
    CLEAR,
    FATES,
    Banks,
    Rows,
    fate,
    hidden_in,
    of_kind,
    strong_outside,
)
from benchmarks.hidden_effects.page import ALIKE, explained_away_by_one
from benchmarks.intervals import proportion
from benchmarks.record import RESULTS, lines_of, read, read_lines


@cache
def bank() -> Banks:
    return lines_of("hidden_effects")


def share(flags: Iterable[bool]) -> str:
    """k/n with its interval, as tables have it."""
    found = list(flags)
    return proportion(sum(found), len(found))


def interval(flags: Iterable[bool]) -> str:
    """Its interval alone."""
    return share(flags).partition("(")[2].removesuffix(")")


def outside(*shapes: str) -> Rows:
    return [r for shape in shapes for r in strong_outside(bank(), shape)]


def explained_away() -> tuple[int, int]:
    """Of those that looked like a listed effect: how many, and how many were explained by it."""
    alike = [r for r in outside("column", "periodic", "step", "shock") if r["likeness"] >= ALIKE]
    return len(alike), sum(map(explained_away_by_one, alike))


def taken_for_noise(shape: str) -> int:
    return sum(fate(r) in FATES[2:4] for r in outside(shape))


def in_false_discoveries(*spoilt_by: str) -> list[dict[str, Any]]:
    """Campaigns with nothing hidden whose noise is not as the model takes it."""
    rows = (row for own in lines_of("false_discoveries").values() for row in own)
    return [row for row in rows if row["how"] in spoilt_by]


def verdicts(kind: str) -> Counter[str]:
    """Of spoilt records, how many were right, said and wrong."""
    rows = (r for own in lines_of(kind).values() for r in own if r["kind"] != "nothing")
    return Counter(r["verdict"] for r in rows)


def whole(name: str) -> Rows:
    """Rows of a file that did not end in an error."""
    return [r for r in read_lines(RESULTS / f"{name}.jsonl") if "crash" not in r]


def coefficients(repeats: bool) -> list[bool]:
    """Of the ordinary test: whether intervals of 95 % held the truth."""
    own = (
        c
        for r in whole("ordinary_test")
        if r["repeats"] == repeats
        for c in r["coefficients"].values()
    )
    return [c["inside"] for c in own if c["stated"]]


def clear() -> Rows:
    return [r for r in of_kind(bank(), "single") if r["oracle"] >= CLEAR]


def otherwise(row: dict[str, Any]) -> bool:
    return bool(set(row["final"]) - {hidden_in(row)})


def faint() -> Rows:
    return [r for r in of_kind(bank(), "single") if r["oracle"] < 5.0]


def fleet() -> dict[str, Any]:
    return read("fleet")["finding"]
