"""A kind of spoilt record: what is done to the columns of a file, and what is true of it then; the list of all."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from benchmarks.spoilt_records.subject import Columns, Subject

Spoil = Callable[[Columns, Subject, np.random.Generator], Columns]
NOTHING: Mapping[str, float] = {}


@dataclass(frozen=True)
class Kind:
    """One kind of spoilt record. What is true of it stands in the docstring of its function.

    Attributes:
        name: in the results and on the page.
        spoil: from the columns of a record to those of the file.
        fits: whether it can happen to an instrument.
        says: regular expression for words that name the cause; without them a sentence is of something else.
        finds: the same for the name of an effect that was added: one that names the cause says it.
        keeps_rows: False where it leaves rows out, and does nothing else: the oracle is fitted to what is left.
        alike: the second campaign is spoilt alike, for it is the unit or the set-up that is odd.
        changed: what it adds to true coefficients.
        hides: effects hidden in the campaign in place of the subject's own; None for these.
        noise: what the second campaign carries beside its own noise where it is spoilt alike, in parts of that noise.
        of_holdout: the record is as it was, and the file that is spoilt is the hold-out given beside it.
        of_training: that hold-out is made of the record itself, in place of a second campaign.
        renamed: columns are called by other names, alike in the second campaign: no coefficient keeps its meaning.
        must_say: a right answer counts only beside a sentence that names the cause.
    """

    name: str
    spoil: Spoil
    fits: Callable[[Subject], bool]
    says: str
    finds: str = "^$"
    keeps_rows: bool = True
    alike: bool = False
    changed: Callable[[Subject], Mapping[str, float]] = field(default=lambda _: NOTHING)
    hides: Callable[[Subject], dict[str, float]] | None = None
    noise: Callable[[Subject], float] = field(default=lambda _: 0.0)
    of_holdout: bool = False
    of_training: bool = False
    renamed: bool = False
    must_say: bool = False


KINDS: dict[str, Kind] = {}


def kind(
    name: str, says: str, fits: Callable[[Subject], bool] = lambda _: True, **fields: object
) -> Callable[[Spoil], Spoil]:
    """Enter a function into the list of kinds; arguments as the attributes of `Kind`."""

    def enter(spoil: Spoil) -> Spoil:
        assert name not in KINDS, f"two kinds are called {name!r}"
        KINDS[name] = Kind(name, spoil, fits, says, **fields)  # pyright: ignore[reportArgumentType]
        return spoil

    return enter


def rows(columns: Columns, chosen: np.ndarray) -> Columns:
    """Select rows of a file, by a mask or by indices."""
    return {name: cells[chosen] for name, cells in columns.items()}


def records(columns: Columns, subject: Subject) -> list[np.ndarray]:
    """Return the rows of each record in time, in the order of the file."""
    if subject.group not in columns:
        return [np.arange(len(columns["output"]))]
    labels = columns[subject.group]
    return [np.flatnonzero(labels == label) for label in dict.fromkeys(labels)]


def step(columns: Columns, subject: Subject) -> float:
    """Return the usual time between two readings, s."""
    return float(np.median(np.diff(columns["time"][records(columns, subject)[0]])))


def changed(columns: Columns, **new: np.ndarray) -> Columns:
    """Return a file with some columns replaced or added."""
    return {**columns, **new}
