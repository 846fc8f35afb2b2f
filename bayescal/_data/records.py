"""Records in time: which readings make one, and which follow each other without a pause."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

Columns = Mapping[str, np.ndarray]

RECORD = ("device", "axis", "run")  # columns of labels that tell one record in time from another
# Usual steps between readings, beyond which the next one is no neighbour; a logger that loses four readings in a row
# has not paused.
PAUSE_STEPS = 5.0


def distinct(columns: Sequence[np.ndarray]) -> tuple[list[tuple[Any, ...]], np.ndarray]:
    """The different rows of some columns, in the order in which they first appear, and which of them each row is.

    By a dictionary of the first rows of stretches, since labels stay the same for long, and pandas takes half a second
    to load.
    """
    begins = np.ones(len(columns[0]), bool)
    begins[1:] = np.any([values[1:] != values[:-1] for values in columns], axis=0)
    first, codes = np.flatnonzero(begins), dict[tuple[Any, ...], int]()
    rows = zip(*(values[first].tolist() for values in columns), strict=True)
    found = np.fromiter((codes.setdefault(row, len(codes)) for row in rows), np.int64, len(first))
    return list(codes), np.repeat(found, np.diff(first, append=len(begins)))


def label_codes(columns: Columns, names: Collection[str]) -> np.ndarray:
    """A number for each combination of labels, in the order in which they first appear; NaN is one of them."""
    every = [columns[n] for n in names]
    every = [np.where(v == v, v.astype(object), "") if v.dtype.kind == "f" else v for v in every]
    return distinct(every)[1] if every else np.zeros(len(next(iter(columns.values()))), np.int64)


def record_codes(columns: Columns) -> np.ndarray:
    """A number for each run of each device and axis."""
    return label_codes(columns, [n for n in RECORD if n in columns])


def members(codes: np.ndarray) -> list[np.ndarray]:
    """Rows of each code, in the order of the file."""
    order = np.argsort(codes, kind="stable")
    return np.split(order, 1 + np.flatnonzero(np.diff(codes[order]))) if codes.size else []


def stretches(time: np.ndarray, codes: np.ndarray, fewest: int) -> list[np.ndarray]:
    """Return rows of each stretch of a record without a pause, of `fewest` readings or more, in order of time, s."""
    found = []
    for own in members(codes):
        rows = own[np.argsort(time[own], kind="stable")]
        steps = np.diff(time[rows])
        usual = np.median(steps) if steps.size else 0.0
        found += np.split(rows, 1 + np.flatnonzero(steps > PAUSE_STEPS * usual))
    return [rows for rows in found if len(rows) >= fewest]


def pieces(columns: Columns) -> list[np.ndarray]:
    """Rows of each stretch of a run without a pause, in time; three readings at least."""
    return stretches(columns["time"], record_codes(columns), 3)


def runs_of(columns: Columns) -> dict[str, np.ndarray]:
    """Rows of each run of each device and axis, by its labels, in the order of the file."""
    names = [n for n in RECORD if n in columns]
    records = members(record_codes(columns))
    return {" ".join(str(columns[n][rows[0]]) for n in names): rows for rows in records}


def equal_runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where each stretch of equal values begins, and how many there are."""
    begins = np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]]))
    return begins, np.diff(begins, append=len(values))
