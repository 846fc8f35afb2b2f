"""Kinds of faulty columns other than the output: thermometers, known inputs, units."""

from __future__ import annotations

import numpy as np

from benchmarks.spoilt_records.kinds import changed, kind
from benchmarks.spoilt_records.subject import Columns, Subject

Generator = np.random.Generator


@kind("nothing", "^$")
def unchanged(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Return the file unchanged: a sentence on this record would appear on any."""
    return columns


@kind(
    "two columns exchanged",
    "temperature|time|range|column",
    fits=lambda s: bool(s.partner),
    alike=True,
    renamed=True,
)
def exchanged(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Exchange the headers of the thermometer and another column.

    If the other is also a thermometer, the file does not show it. True: the unit's output as a function of the columns
    as named, in both campaigns.
    """
    first, second = subject.thermometer, subject.partner
    return changed(columns, **{first: columns[second], second: columns[first]})


@kind(
    "wrong unit of the known input",
    "prior's mean|nominal|unit|range",
    fits=lambda s: s.wrong_unit != 1.0,
)
def wrong_unit(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Give radians under a header in degrees (or the reverse), or m/s² for g. True: the unit as it was."""
    return changed(columns, **{subject.input: subject.wrong_unit * columns[subject.input]})


@kind("a thermometer stuck for a while", "stuck|constant|thermometer|temperature")
def stuck(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Hold the thermometer's value for a sixth of the record. True: the unit as it was."""
    warm = columns[subject.thermometer].copy()
    begin = int(rng.integers(len(warm) // 4, len(warm) // 2))
    warm[begin : begin + len(warm) // 6] = warm[begin]
    return changed(columns, **{subject.thermometer: warm})


@kind("a second thermometer like the first", "temperature", alike=True)
def collinear(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Add a column that differs from the thermometer by a hundredth of a degree. True: the unit as it was."""
    warm = columns[subject.thermometer]
    return changed(columns, case_temperature=warm + 0.01 * rng.standard_normal(len(warm)))


@kind("thermometer rounded to 0.5 °C", "round|quanti|resolution|thermometer|temperature")
def coarse_thermometer(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Round the temperature to a coarse display. True: the unit as it was, at the true temperatures."""
    warm = columns[subject.thermometer]
    return changed(columns, **{subject.thermometer: 0.5 * np.rint(2.0 * warm)})


@kind("−999 in a few rows of the temperature", "temperature|-999|−999")
def missing_temperature(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Put a logger's mark for a missing value in three rows. True: the unit as it was."""
    warm = columns[subject.thermometer].copy()
    warm[rng.choice(len(warm), 3, replace=False)] = -999.0
    return changed(columns, **{subject.thermometer: warm})
