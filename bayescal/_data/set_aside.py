"""Readings that say nothing of the sensor are set aside before a calibration: clipped or stuck ones, and spikes.

Spikes of the output, single readings far from both of their neighbours, are faults of the record and not of the sensor,
and one of them can outweigh thousands of readings. At spikes of a thermometer it is not known what the output belongs
to; nor where one that the model needs repeats an old value, is stuck, or stands at its end. Hold-out data that are
fitted already say nothing of new readings.
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
SPIKE_SD = 8.0
# Readings of a stretch, below which its scatter is not known well enough to call one a spike.
SPIKE_FEWEST = 50
# Share of all readings; where more stand out, the noise may be heavy-tailed, and its law takes them.
SPIKE_SHARE = 0.005
SPIKE_NEIGHBOURS = 3  # readings on either side, whose distances a spike's own exceeds
# Share of the hold-out data that are readings of the fit: what rounding makes equal by chance is less.
NOT_NEW_SHARE = 0.9


class Fault(NamedTuple):
    """Readings that say nothing of the sensor (rows; none where there is no such fault), and why, in words."""

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
    for find in (_clipped, _stuck):
        readings = _without(readings, find(readings))
    if keep_spikes or not readings.has("time"):  # both are known by their neighbours in time
        return readings
    begun = len(readings)
    while len((fault := _wrong(readings, needed, begun)).rows):
        readings = _without(readings, fault)
    rows = find_spikes(readings)
    shown = _listed(rows, readings["output"])
    said = f"{len(rows)} reading(s) set aside as spikes, far from both neighbours: {shown}"
    return _without(readings, Fault(rows, f"{said}; keep_spikes keeps them"))


def _without(readings: Measurements, fault: Fault) -> Measurements:
    """The other readings, with a flag; where no other is left, they stay."""
    kept = np.setdiff1d(np.arange(len(readings)), fault.rows)
    if not len(fault.rows) or not len(kept):
        return readings
    flag = f"{readings.file}: {fault.reason}"
    return replace(readings.select(kept), flags=(*readings.flags, flag))


def _listed(rows: np.ndarray, values: np.ndarray, unit: str = "") -> str:
    """The first rows, as people count them, with what they read."""
    shown = ", ".join(f"{row + 1} ({values[row]:.6g}{unit})" for row in rows[:5])
    return f"row {shown}{' …' * (len(rows) > 5)}"


def _clipped(readings: Measurements) -> Fault:
    """What stands exactly at an end where the output was cut off: such a reading only says "beyond"."""
    output = readings["output"]
    ends = [] if checks.rounding_step(output) else checks.clip_levels(output)
    rows = np.flatnonzero(np.isin(output, [level for _, level in ends]))
    each = " and ".join(f"{np.sum(output == v)} at its {end} {v:.6g}" for end, v in ends)
    cure = "what lies beyond was not measured, and no calibration holds there"
    return Fault(rows, f"{len(rows)} clipped reading(s) of the output set aside, {each}: {cure}")


def _stuck(readings: Measurements) -> Fault:
    """Repeats of one reading by an output that stood still: only the first was measured."""
    output = readings["output"]
    if np.ptp(output) == 0 or checks.rounding_step(output):
        return Fault()
    rows = checks.standing_rows(output, [np.arange(len(output))])[1:]
    if len(rows):
        said = f"stands still at {output[rows[0]]:.6g} (rows {rows[0] + 1} to {rows[-1] + 1})"
    elif readings.has("time"):
        own = readings.records.stretches()
        rows = checks.repeats(output, own, checks.held_rows(output, own))
        at = rows[0] + 1 if len(rows) else 0
        said = f"repeats a value until the next leap, first in row {at}: a logger asked it seldom"
    else:
        return Fault()
    return Fault(rows, f"{len(rows)} reading(s) set aside: the output {said}")


def _wrong(readings: Measurements, needed: Collection[str], begun: int) -> Fault:
    """Readings at which a thermometer was surely wrong, by one kind of fault.

    Of a thermometer that the model does not need, where they are few. Where too much would go, or a device's readings
    or all temperatures but one, they stay, and the fault is a reason not to believe the result.
    """
    for odd in readings.oddities:
        few = odd.code == "leap" and len(odd.wrong) <= checks.LEAP_SHARE * begun
        if (few or odd.column in needed) and _can_go(readings.values, odd, begun):
            rows = _listed(odd.wrong, readings[odd.column], " °C")
            said = f"{len(odd.wrong)} reading(s) set aside, column {odd.column!r} {odd.said}"
            return Fault(odd.wrong, f"{said}: {rows}; keep_spikes keeps them")
    return Fault()


def _can_go(columns: Columns, odd: checks.Oddity, begun: int) -> bool:
    """Whether enough is left without what is wrong: half of the readings; of a held column, each value once."""
    count = len(columns[odd.column])
    kept = np.setdiff1d(np.arange(count), odd.wrong)
    least = checks.FEW_CHANGES if odd.code == "held" and count == begun else 0.5 * begun
    if not len(odd.wrong) or len(kept) < least:
        return False
    labels = [n for n in RECORD if n != "run" and n in columns]
    whole = all(set(columns[n][kept]) == set(columns[n]) for n in labels)
    return whole and bool(np.ptp(columns[odd.column][kept]) > settings().temperature_span)


def find_spikes(readings: Measurements) -> np.ndarray:
    """Rows of spikes, found by each reading's distance from the line through its neighbours in its run.

    A smooth signal, however large, has small distances; a step has two large ones side by side and is kept.
    Only records in time have neighbours: without a column `time` there are no spikes. Where more readings stand out
    than spikes would, there are none: the noise may have heavy tails.
    """
    none = np.zeros(0, dtype=int)
    if not readings.has("time"):
        return none
    most, own = max(1.0, SPIKE_SHARE * len(readings)), readings.records.stretches(SPIKE_FEWEST)
    found = [piece[_standing_out(readings["output"][piece], most)] for piece in own]
    rows = np.sort(np.concatenate([none, *found]))
    return rows if len(rows) <= most else none


def _standing_out(y: np.ndarray, most: float) -> np.ndarray:
    """Return readings that stand out from the line through their neighbours, until they are more than `most`.

    Those that stand out the most among their neighbours are taken out and the others are judged anew, until none does.
    A spike at an end and its neighbour stand out alike: then it is the end.
    """
    left, found, scale = np.arange(len(y)), np.zeros(0, int), 0.0
    while True:
        rest = y[left]
        inner = np.abs(rest[1:-1] - 0.5 * (rest[:-2] + rest[2:]))
        heights = np.concatenate([inner[:1], inner, inner[-1:] * (1.0 + 1e-12)])
        scale = scale or 1.4826 * float(np.median(heights))
        worst = (heights > 0) & (heights >= SPIKE_SD * scale)
        if scale == 0 or len(found) > most or not worst.any() or len(left) < SPIKE_NEIGHBOURS:
            return found
        around = sliding_window_view(np.pad(heights, SPIKE_NEIGHBOURS), 2 * SPIKE_NEIGHBOURS + 1)
        before, after = around[:, :SPIKE_NEIGHBOURS], around[:, SPIKE_NEIGHBOURS + 1 :]
        worst &= (heights > before.max(axis=1)) & (heights >= after.max(axis=1))
        found, left = np.concatenate([found, left[worst]]), left[~worst]


def said_of(readings: Measurements, holdout: Measurements) -> str:
    """Return the flag that hold-out data are readings that are fitted, whatever their time and labels say; or "".

    A reading is known by its numbers but for the time: output, temperatures, inputs. Where these are so rounded that
    most occur again, nothing is said.
    """
    numbers = (n for n, unit in readings.units.items() if n != "time" and unit is not None)
    shared = [n for n in numbers if holdout.has(n)]
    rows = [np.column_stack([np.nan_to_num(r[n]) for n in shared]) for r in (readings, holdout)]
    codes = np.unique(np.round(np.concatenate(rows), 12), axis=0, return_inverse=True)[1].ravel()
    mine, theirs = np.split(codes, [len(readings)])
    many = int(np.isin(theirs, mine).sum())
    rounded = len(np.unique(mine)) <= checks.ROUNDED_SHARE * len(mine)
    if rounded or many <= NOT_NEW_SHARE * len(theirs):
        return ""
    said = (
        f"{holdout.file}: {many} of the {len(holdout)} readings of the hold-out data are readings that are fitted "
        "(equal output, temperature and inputs; times and labels apart): the hold-out error says nothing of new "
        "readings. Take readings of another run"
    )
    return Flag(said, "holdout.not_new")
