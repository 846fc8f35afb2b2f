"""Kinds of records with rows omitted, repeated or out of order; the remaining values are correct."""

from __future__ import annotations

import numpy as np

from benchmarks.spoilt_records.kinds import kind, records, rows
from benchmarks.spoilt_records.subject import Columns, Subject

Generator = np.random.Generator
BAND = 0.5  # °C, about a temperature
FEW = "few|fewer|readings|temperature"


def _no_change(subject: Subject) -> dict[str, float]:
    """Return no hidden effect: so few rows could not show one, and no sentence has to say so."""
    return {}


@kind("every row twice", "repeat")
def twice(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Join a file with itself, row by row. True: the unit as it was, no better known."""
    return rows(columns, np.repeat(np.arange(len(columns["output"])), 2))


@kind("a tenth of the rows twice", "repeat")
def some_twice(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Repeat some rows, as a logger that sends again. True: the unit as it was."""
    n = len(columns["output"])
    return rows(columns, np.repeat(np.arange(n), 1 + (rng.random(n) < 0.1)))


@kind("two to four readings", FEW, keeps_rows=False, hides=_no_change)
def hardly_any(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Keep two, three or four rows from all over the record. True: the unit as it was, hardly known better."""
    n = len(columns["output"])
    return rows(columns, np.sort(rng.choice(n, int(rng.integers(2, 5)), replace=False)))


@kind("eight readings", FEW, keeps_rows=False, hides=_no_change)
def eight(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Keep eight rows from all over the record. True: the unit as it was."""
    return rows(columns, np.sort(rng.choice(len(columns["output"]), 8, replace=False)))


@kind("gaps", "gap", keeps_rows=False)
def gaps(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Remove three stretches of a tenth of the rows each. True: the unit as it was."""
    n = len(columns["output"])
    mask = np.ones(n, bool)
    for begin in rng.integers(0, n - n // 10, 3):
        mask[begin : begin + n // 10] = False
    return rows(columns, mask)


@kind("unequal runs", "run", keeps_rows=False)
def unequal(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Break off the last run (or device) after a fifth. True: the unit as it was."""
    last = records(columns, subject)[-1]
    mask = np.ones(len(columns["output"]), bool)
    mask[last[len(last) // 5 :]] = False
    return rows(columns, mask)


@kind("the first rows of every run cut", "run", keeps_rows=False)
def warm_up_cut(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Remove the first sixth of every run, its warm-up. True: the unit as it was."""
    mask = np.ones(len(columns["output"]), bool)
    for record in records(columns, subject):
        mask[record[: len(record) // 6]] = False
    return rows(columns, mask)


@kind("one temperature", "temperature", keeps_rows=False, hides=_no_change)
def one_temperature(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Keep the rows of one set point. True: the unit as it was; coefficients over temperature keep their priors."""
    return rows(columns, _near(columns[subject.thermometer], 0.5))


@kind("two temperatures", "temperature", keeps_rows=False, hides=_no_change)
def two_temperatures(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Keep the rows of two set points, cold and hot. True: the unit as it was; curvature is not identified."""
    warm = columns[subject.thermometer]
    return rows(columns, _near(warm, 0.1) | _near(warm, 0.9))


def _near(warm: np.ndarray, part: float) -> np.ndarray:
    """Return the rows in a narrow band about a quantile of the temperature, widened until it has ten."""
    away = np.abs(warm - np.quantile(warm, part))
    return away <= max(BAND, float(np.sort(away)[min(9, len(away) - 1)]))
