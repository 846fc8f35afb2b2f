"""Readings that follow each other: records by their labels, stretches of these without a pause, steps of rounding."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from bayescal._data.record_settings import recording

RECORD = ("device", "axis", "run")  # columns of labels that tell one record in time from another

Columns = Mapping[str, np.ndarray]


def label_codes(columns: Columns, names: Collection[str]) -> np.ndarray:
    """A number for each combination of labels, in the order in which they first appear; NaN is one of them.

    By a dictionary, since pandas takes half a second to load and files are refused before it is needed.
    """
    count = len(next(iter(columns.values())))
    every = [columns[n] for n in names]
    every = [np.where(v == v, v.astype(object), "") if v.dtype.kind == "f" else v for v in every]
    if not every:
        return np.zeros(count, np.int64)
    codes: dict[object, int] = {}
    labels = zip(*(v.tolist() for v in every), strict=True)
    return np.fromiter((codes.setdefault(one, len(codes)) for one in labels), np.int64, count)


def record_codes(columns: Columns) -> np.ndarray:
    """A number for each run of each device and axis."""
    return label_codes(columns, [n for n in RECORD if n in columns])


def members(codes: np.ndarray) -> list[np.ndarray]:
    """Rows of each code, in the order of the file."""
    order = np.argsort(codes, kind="stable")
    return np.split(order, 1 + np.flatnonzero(np.diff(codes[order]))) if codes.size else []


def stretches(time: np.ndarray, codes: np.ndarray, fewest: int) -> list[np.ndarray]:
    """Rows of each stretch of a record without a pause, in the order of time.

    Args:
        time: of the readings, s (n,).
        codes: of their records (n,).
        fewest: readings that a stretch has.
    """
    found = []
    for own in members(codes):
        rows = own[np.argsort(time[own], kind="stable")]
        steps = np.diff(time[rows])
        usual = np.median(steps) if steps.size else 0.0
        found += np.split(rows, 1 + np.flatnonzero(steps > recording().pause * usual))
    return [rows for rows in found if len(rows) >= fewest]


def rounding_step(values: np.ndarray) -> float:
    """The step that an output is rounded to, in its unit; 0 where most values occur once, or lie on no grid."""
    levels = np.unique(values)
    if not 3 <= len(levels) <= recording().rounded * len(values):
        return 0.0
    gaps, off = np.diff(levels), recording().off_grid
    step = float(gaps[gaps > off * np.median(gaps)].min())
    places = (levels - levels[0]) / step
    return step if np.all(np.abs(places - np.round(places)) < off) else 0.0
