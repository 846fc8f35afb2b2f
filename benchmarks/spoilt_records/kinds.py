"""Kinds of faults: the change of a file's columns, and what is true of the record then; the list of all kinds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from benchmarks.spoilt_records.subject import Columns, Subject

Spoil = Callable[[Columns, Subject, np.random.Generator], Columns]
NOTHING: Mapping[str, float] = {}


@dataclass(frozen=True)
class Kind:
    """One kind of fault. What is true of such a record is in the docstring of its function.

    Attributes:
        name: name in the results and on the page.
        spoil: function from the columns of a record to those of the faulty file.
        fits: whether it can occur for an instrument.
        says: regular expression for words that name the cause; without them a sentence is about something else.
        finds: the same for the name of an added effect, which then names the cause.
        keeps_rows: False if it only removes rows: the oracle is fitted to the remaining ones.
        alike: whether the second campaign has the same fault, because unit or set-up are unusual.
        changed: change of the true coefficients.
        hides: effects hidden in the campaign in place of the subject's; None: the subject's.
        noise: additional noise of a second campaign with the same fault, in units of its own noise.
        of_holdout: whether the record is unchanged, and the hold-out data have the fault.
        of_training: whether the hold-out data are made from the record, in place of a second campaign.
        renamed: whether columns have other names, in both campaigns, so that no coefficient keeps its meaning.
        must_say: whether a right answer counts only with a sentence that names the cause.
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
    """Register a function as a kind; arguments as the attributes of `Kind`."""

    def enter(spoil: Spoil) -> Spoil:
        assert name not in KINDS, f"two kinds are called {name!r}"
        KINDS[name] = Kind(name, spoil, fits, says, **fields)  # pyright: ignore[reportArgumentType]
        return spoil

    return enter


def rows(columns: Columns, chosen: np.ndarray) -> Columns:
    """Select rows of a file, by a mask or by indices."""
    return {name: cells[chosen] for name, cells in columns.items()}


def records(columns: Columns, subject: Subject) -> list[np.ndarray]:
    """Return the rows of each record in time, in file order."""
    if subject.group not in columns:
        return [np.arange(len(columns["output"]))]
    labels = columns[subject.group]
    return [np.flatnonzero(labels == label) for label in dict.fromkeys(labels)]


def step(columns: Columns, subject: Subject) -> float:
    """Return the usual time between readings, s."""
    return float(np.median(np.diff(columns["time"][records(columns, subject)[0]])))


def changed(columns: Columns, **new: np.ndarray) -> Columns:
    """Return a file with some columns replaced or added."""
    return {**columns, **new}
