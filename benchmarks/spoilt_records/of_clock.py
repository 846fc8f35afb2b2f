"""Kinds of faulty times and run labels."""

from __future__ import annotations

import numpy as np

from benchmarks.spoilt_records.kinds import changed, kind, records, rows, step
from benchmarks.spoilt_records.subject import Columns, Subject

Generator = np.random.Generator
TICK = 3  # readings on one tick
UTC = 37.0  # s, between two clocks
CLOCK = "time|clock"


def _ticks(columns: Columns, subject: Subject) -> np.ndarray:
    tick = TICK * step(columns, subject)
    return tick * np.floor(columns["time"] / tick)


@kind("several readings on one tick of the clock", CLOCK)
def ticking(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Coarsen the clock so that three readings have the same time. True: the unit as it was."""
    return changed(columns, time=_ticks(columns, subject))


@kind("rows out of order within a tick", CLOCK)
def shuffled(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Coarsen the clock and shuffle the rows of a tick, as a database does. True: the unit as it was."""
    ticked = changed(columns, time=_ticks(columns, subject))
    order = [
        record[np.lexsort((rng.random(len(record)), ticked["time"][record]))]
        for record in records(ticked, subject)
    ]
    return rows(ticked, np.concatenate(order))


@kind("time corrected during the record", CLOCK)
def corrected(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Set the clock 37 s forward or back in the middle of a run. True: the unit as it was."""
    rows = records(columns, subject)[len(records(columns, subject)) // 2]
    by = UTC if rng.random() < 0.5 else -UTC
    after = np.arange(len(columns["time"])) >= rows[len(rows) // 2]
    if subject.one_unit:  # one clock for each record
        after &= np.isin(np.arange(len(after)), rows)
    return changed(columns, time=columns["time"] + np.where(after, by, 0.0))


@kind("clock running fast, with jitter", CLOCK)
def fast_clock(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Stretch time by 0.1 % and delay each stamp by up to a fifth of a step. True: the unit as it was."""
    late = 0.2 * step(columns, subject) * rng.random(len(columns["time"]))
    return changed(columns, time=columns["time"] * 1.001 + late)


@kind("time in minutes under a header in seconds", CLOCK, alike=True)
def minutes(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """State a wrong unit of time. True: the unit as it was; its laws in time are sixty times slower than stated."""
    return changed(columns, time=columns["time"] / 60.0)


@kind("one label for two runs", "run|gap|time", fits=lambda s: s.group == "run")
def one_label(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Label the second run as the first. True: the unit as it was."""
    first, second = records(columns, subject)[:2]
    labels = columns[subject.group].copy()
    labels[second] = labels[first[0]]
    return changed(columns, **{subject.group: labels})


@kind(
    "one run of another unit",
    "run|group|left-out",
    finds=r"\.run$",
    fits=lambda s: s.group == "run",
)
def another_unit(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Take the last run from a unit with another constant and slope. True: the unit of the other runs."""
    return changed(columns, output=columns["output"] + _of_another(columns, subject, -1))


@kind(
    "the hold-out of another unit",
    "hold-out|held|kept apart",
    fits=lambda s: s.group == "run",
    of_holdout=True,
    must_say=True,
)
def other_holdout(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Take the hold-out data from a unit with another constant and slope. True: the record's unit; a sentence must
    state the difference, since hold-out data are given to be relied on.
    """
    return changed(columns, output=columns["output"] + _of_another(columns, subject, None))


def _of_another(columns: Columns, subject: Subject, run: int | None) -> np.ndarray:
    """Return the additional output of another unit, a fifth of a prior standard deviation each, in one run or all."""
    zero, slope = subject.zero, subject.slope
    added = 0.2 * (zero.size * zero.column(columns) + slope.size * slope.column(columns))
    if run is None:
        return added
    chosen = np.zeros(len(added), bool)
    chosen[records(columns, subject)[run]] = True
    return np.where(chosen, added, 0.0)
