"""Kinds of records with rows left out, repeated or out of order: the cells that are there are right."""

from __future__ import annotations

import numpy as np

from benchmarks.spoilt_records.kinds import kind, records, rows
from benchmarks.spoilt_records.subject import Columns, Subject

Generator = np.random.Generator
BAND = 0.5  # °C, about a temperature
FEW = "few|fewer|readings|temperature"


def _no_change(subject: Subject) -> dict[str, float]:
    """So few rows could not show a hidden effect, and no sentence has to say so: none is hidden."""
    return {}


@kind("every row twice", "repeat")
def twice(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """A file joined with itself, row by row. True: the unit as it was, known no better."""
    return rows(columns, np.repeat(np.arange(len(columns["output"])), 2))


@kind("a tenth of the rows twice", "repeat")
def some_twice(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """A logger that sends again. True: the unit as it was."""
    n = len(columns["output"])
    return rows(columns, np.repeat(np.arange(n), 1 + (rng.random(n) < 0.1)))


@kind("two to four readings", FEW, keeps_rows=False, hides=_no_change)
def hardly_any(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Two, three or four rows from all over the record. True: the unit as it was, known hardly better than before."""
    n = len(columns["output"])
    return rows(columns, np.sort(rng.choice(n, int(rng.integers(2, 5)), replace=False)))


@kind("eight readings", FEW, keeps_rows=False, hides=_no_change)
def eight(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Eight rows from all over the record. True: the unit as it was."""
    return rows(columns, np.sort(rng.choice(len(columns["output"]), 8, replace=False)))


@kind("gaps", "gap", keeps_rows=False)
def gaps(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Three stretches of a tenth of the rows each are missing. True: the unit as it was."""
    n = len(columns["output"])
    mask = np.ones(n, bool)
    for begin in rng.integers(0, n - n // 10, 3):
        mask[begin : begin + n // 10] = False
    return rows(columns, mask)


@kind("unequal runs", "run", keeps_rows=False)
def unequal(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """The last run (or device) was broken off after a fifth. True: the unit as it was."""
    last = records(columns, subject)[-1]
    mask = np.ones(len(columns["output"]), bool)
    mask[last[len(last) // 5 :]] = False
    return rows(columns, mask)


@kind("the first rows of every run cut", "run", keeps_rows=False)
def warm_up_cut(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """The first sixth of every run was thrown away, warming up. True: the unit as it was."""
    mask = np.ones(len(columns["output"]), bool)
    for record in records(columns, subject):
        mask[record[: len(record) // 6]] = False
    return rows(columns, mask)


@kind("one temperature", "temperature", keeps_rows=False, hides=_no_change)
def one_temperature(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """The rows of one set point. True: the unit as it was; what needs temperature stays as the prior has it."""
    return rows(columns, _near(columns[subject.thermometer], 0.5))


@kind("two temperatures", "temperature", keeps_rows=False, hides=_no_change)
def two_temperatures(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """The rows of two set points, cold and hot. True: the unit as it was; curvature cannot be told."""
    warm = columns[subject.thermometer]
    return rows(columns, _near(warm, 0.1) | _near(warm, 0.9))


def _near(warm: np.ndarray, part: float) -> np.ndarray:
    """Rows within a narrow band about a quantile of the temperature, widened until it holds ten."""
    away = np.abs(warm - np.quantile(warm, part))
    return away <= max(BAND, float(np.sort(away)[min(9, len(away) - 1)]))
