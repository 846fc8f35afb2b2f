"""Campaigns of the banks by kind and strength, and what became of the effects hidden in them."""

from __future__ import annotations

from typing import Any

from benchmarks.hidden_effects.bank import OUTSIDE

Rows = list[dict[str, Any]]
Banks = dict[str, Rows]  # by instrument

STRONG = 8.0  # oracle
CLEAR = 15.0  # oracle
FATES = (
    "the right column in the final model",
    "a catalogue effect of the same set in its place",
    "said to be correlated noise, the column nearly as probable",
    "said to be correlated noise, and no more",
    "something else",
)


def of_kind(banks: Banks, kind: str) -> Rows:
    """All instruments' campaigns of a kind."""
    return [row for rows in banks.values() for row in rows if row["kind"] == kind]


def strong_pairs(banks: Banks) -> Rows:
    """Campaigns with two hidden effects, each of which the readings show."""
    return [r for r in of_kind(banks, "pair") if min(r["oracle_of_each"]) >= STRONG]


def strong_outside(banks: Banks, shape: str) -> Rows:
    """Campaigns with something of this shape that no catalogue has, and that the readings show."""
    return [r for r in of_kind(banks, "outside") if r["shape"] == shape and r["oracle"] >= STRONG]


def hidden_in(row: dict[str, Any]) -> str:
    """The effect of a campaign with one."""
    return next(iter(row["hidden"]))


def said(row: dict[str, Any]) -> set[str]:
    """Effects that stand in the final model or in a set beside one of it."""
    return set(row["final"]) | {name for effects, _ in row["sets"] for name in effects}


def names_outside(row: dict[str, Any], where: str) -> bool:
    """Whether the column outside the catalogue is named there, in whatever form."""
    column = OUTSIDE[row["shape"]].removesuffix(")").split(",")[0]
    return any(n.removesuffix(")").split(",")[0] == column for n in row[where])


def fate(row: dict[str, Any]) -> str:
    """What became of something outside the catalogue."""
    if names_outside(row, "final"):
        return FATES[0]
    if names_outside(row, "first_set") and set(row["final"]) & set(row["first_set"]):
        return FATES[1]
    if row["noise"] == "wandering":
        return FATES[2] if names_outside(row, "undecided") else FATES[3]
    return FATES[4]
