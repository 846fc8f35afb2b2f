"""Exclusion of faulty readings before a calibration: clipped or stuck ones, spikes, wrong temperatures.

Spikes of the output, single readings far from both of their neighbours, are faults of the record and not of the sensor,
and one of them can outweigh thousands of readings. At spikes of a thermometer the temperature of the output is not
known; nor where one that the model needs repeats an old value, is stuck, or stands at its end. Hold-out data that are
fitted already do not test the prediction of new readings.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from bayescal._core.flag import Flag
from bayescal._core.settings import settings
from bayescal._data import dataset_checks as checks
from bayescal._data.measurements import Measurements
from bayescal._data.records import RECORD, Columns

# Robust standard deviations of a reading's distance from the line through its neighbours; of a million normal readings
# none.
MIN_SPIKE_SD = 8.0
# Readings of a stretch, below which its scatter is not known well enough to call one a spike.
MIN_SPIKE_READINGS = 50
# Share of all readings; where more stand out, the noise may be heavy-tailed, and its law takes them.
MAX_SPIKE_SHARE = 0.005
SPIKE_NEIGHBOURS = 3  # readings on either side, whose distances that of a spike exceeds
# Share of the hold-out data that are readings of the fit: what rounding makes equal by chance is less.
MIN_NOT_NEW_SHARE = 0.9


class Fault(NamedTuple):
    """Rows of readings to exclude (none where there is no fault), and the reason, in words."""

    rows: np.ndarray = np.zeros(0, int)
    reason: str = ""


def set_aside(
    readings: Measurements, keep_spikes: bool = False, needed: Collection[str] = ()
) -> Measurements:
    """Return the readings without clipped and stuck ones and spikes, named in flags.

    Args:
        readings: as recorded.
        keep_spikes: leave spikes in, and wrong temperatures.
        needed: columns that a model needs: without readings, too, at which a thermometer among them was wrong.
    """
    for find in (_find_clipped, _find_stuck):
        readings = _without(readings, find(readings))
    if keep_spikes or not readings.has("time"):  # both are known by their neighbours in time
        return readings
    initial_count = len(readings)
    while len((fault := _find_wrong(readings, needed, initial_count)).rows):
        readings = _without(readings, fault)
    return _without(readings, _find_spikes(readings))


def _without(readings: Measurements, fault: Fault) -> Measurements:
    """Return the readings without a fault's rows, with a flag; unchanged if none would remain."""
    kept_rows = np.setdiff1d(np.arange(len(readings)), fault.rows)
    if not len(fault.rows) or not len(kept_rows):
        return readings
    flag = f"{readings.file}: {fault.reason}"
    return replace(readings.select(kept_rows), flags=(*readings.flags, flag))


def _format_rows_read(rows: np.ndarray, values: np.ndarray, unit: str = "") -> str:
    """Format the first five rows, counted from 1, with their values."""
    listing = ", ".join(f"{row + 1} ({values[row]:.6g}{unit})" for row in rows[:5])
    return f"row {listing}{' …' * (len(rows) > 5)}"


def _find_clipped(readings: Measurements) -> Fault:
    """Find the readings exactly at a clipped end of the output: such a reading is only a bound."""
    output = readings["output"]
    ends = [] if checks.rounding_step(output) else checks.clip_levels(output)
    rows = np.flatnonzero(np.isin(output, [level for _, level in ends]))
    counts = " and ".join(f"{np.sum(output == v)} at its {end} {v:.6g}" for end, v in ends)
    cure = "what lies beyond was not measured, and no calibration holds there"
    return Fault(rows, f"{len(rows)} clipped reading(s) of the output set aside, {counts}: {cure}")


def _find_stuck(readings: Measurements) -> Fault:
    """Find the repeats of one reading by a stuck output: only the first was measured."""
    output = readings["output"]
    if np.ptp(output) == 0 or checks.rounding_step(output):
        return Fault()
    rows = checks.standing_rows(output, [np.arange(len(output))])[1:]
    if len(rows):
        fault = f"stands still at {output[rows[0]]:.6g} (rows {rows[0] + 1} to {rows[-1] + 1})"
    elif readings.has("time"):
        stretches = readings.records.stretches()
        rows = checks.repeats(output, stretches, checks.held_rows(output, stretches))
        at = rows[0] + 1 if len(rows) else 0
        fault = f"repeats a value until the next leap, first in row {at}: a logger asked it seldom"
    else:
        return Fault()
    return Fault(rows, f"{len(rows)} reading(s) set aside: the output {fault}")


def _find_wrong(readings: Measurements, needed: Collection[str], total: int) -> Fault:
    """Find readings at which a thermometer was certainly wrong, by one kind of fault.

    For a thermometer that the model does not need, only where they are few. Where too many would go, or a device's
    readings or all temperatures but one, they stay, and the fault is a reason not to believe the result.
    """
    for odd in (o for o in readings.oddities if o.code != "run"):  # of which column is not known
        few = odd.code == "leap" and len(odd.rows) <= checks.LEAP_SHARE * total
        if (few or odd.column in needed) and _leaves_enough(readings.values, odd, total):
            rows = _format_rows_read(odd.rows, readings[odd.column], " °C")
            where = f"{len(odd.rows)} reading(s) set aside, column {odd.column!r}"
            return Fault(odd.rows, f"{where} {odd.description}: {rows}; keep_spikes keeps them")
    return Fault()


def _leaves_enough(columns: Columns, odd: checks.Anomaly, total: int) -> bool:
    """Return whether enough remains without the wrong rows: half of the readings; of a held column, each value once."""
    count = len(columns[odd.column])
    remaining = np.setdiff1d(np.arange(count), odd.rows)
    least = checks.MIN_CHANGES if odd.code == "held" and count == total else 0.5 * total
    if len(remaining) < least:
        return False
    labels = [n for n in RECORD if n != "run" and n in columns]
    complete = all(set(columns[n][remaining]) == set(columns[n]) for n in labels)
    return complete and bool(np.ptp(columns[odd.column][remaining]) > settings().temperature_span)


def _find_spikes(readings: Measurements) -> Fault:
    """Find spikes, each an outlier by its distance from the line through its neighbours in its run.

    A smooth signal, however large, has small distances; a step has two large ones side by side and is kept. Where more
    readings stand out than spikes would, there are none: the noise may have heavy tails.
    """
    most, output = max(1.0, MAX_SPIKE_SHARE * len(readings)), readings["output"]
    pieces = readings.records.stretches(MIN_SPIKE_READINGS)
    spikes = (p[_find_outliers(output[p], most)] for p in pieces)
    rows = np.sort(np.concatenate([np.zeros(0, int), *spikes]))
    if len(rows) > most:
        return Fault()
    listing = f"far from both neighbours: {_format_rows_read(rows, output)}; keep_spikes keeps them"
    return Fault(rows, f"{len(rows)} reading(s) set aside as spikes, {listing}")


def _find_outliers(y: np.ndarray, most: float) -> np.ndarray:
    """Return the indices of outliers from the line through their neighbours, until they are more than `most`.

    Those that stand out the most among their neighbours are taken out and the others are judged anew, until none does.
    A spike at an end and its neighbour stand out alike: then it is the end.
    """
    remaining, outliers, scale = np.arange(len(y)), np.zeros(0, int), 0.0
    while True:
        values = y[remaining]
        inner = np.abs(values[1:-1] - 0.5 * (values[:-2] + values[2:]))
        heights = np.concatenate([inner[:1], inner, inner[-1:] * (1.0 + 1e-12)])
        scale = scale or 1.4826 * float(np.median(heights))
        is_spike = (heights > 0) & (heights >= MIN_SPIKE_SD * scale)
        few = len(remaining) < SPIKE_NEIGHBOURS
        if few or scale == 0 or len(outliers) > most or not is_spike.any():
            return outliers
        windows = sliding_window_view(np.pad(heights, SPIKE_NEIGHBOURS), 2 * SPIKE_NEIGHBOURS + 1)
        before, after = windows[:, :SPIKE_NEIGHBOURS], windows[:, SPIKE_NEIGHBOURS + 1 :]
        is_spike &= (heights > before.max(axis=1)) & (heights >= after.max(axis=1))
        outliers, remaining = np.concatenate([outliers, remaining[is_spike]]), remaining[~is_spike]


def said_of(readings: Measurements, holdout: Measurements) -> str:
    """Return a flag if hold-out data are readings that are fitted, whatever their time and labels; else "".

    A reading is identified by its numbers except the time: output, temperatures, inputs. Where these are so rounded
    that most recur, there is no flag.
    """
    numbers = (n for n, unit in readings.units.items() if n != "time" and unit is not None)
    shared = [n for n in numbers if holdout.has(n)]
    rows = [np.column_stack([np.nan_to_num(r[n]) for n in shared]) for r in (readings, holdout)]
    codes = np.unique(np.round(np.concatenate(rows), 12), axis=0, return_inverse=True)[1].ravel()
    mine, theirs = np.split(codes, [len(readings)])
    many = int(np.isin(theirs, mine).sum())
    rounded = len(np.unique(mine)) <= checks.ROUNDED_SHARE * len(mine)
    if rounded or many <= MIN_NOT_NEW_SHARE * len(theirs):
        return ""
    message = (
        f"{holdout.file}: {many} of the {len(holdout)} hold-out readings were also fitted "
        "(same output, temperature and inputs, whatever their times and labels): the hold-out error says nothing about "
        "new readings. Take readings of another run"
    )
    return Flag(message, "holdout.not_new")
