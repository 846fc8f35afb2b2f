"""Exclusion of faulty readings before a calibration: outliers (spikes), clipped or stuck ones, wrong temperatures.

Spikes of the output, single readings far from both neighbours, are faults of the record and not of the sensor; one can
outweigh thousands of readings. Where a thermometer that the model needs has a spike, repeats a value, is stuck or
saturated, the temperature is unknown. Hold-out data that were also fitted do not test the prediction of new readings.
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

# Distance of a spike from the line through its neighbours, robust standard deviations; not exceeded by normal noise.
MIN_SPIKE_SD = 8.0
# Minimum number of readings of a segment, to estimate its noise well enough for the detection of spikes.
MIN_SPIKE_READINGS = 50
# Largest share of spikes in all readings; more outliers indicate heavy-tailed noise, which a noise law describes.
MAX_SPIKE_SHARE = 0.005
SPIKE_NEIGHBOURS = 3  # readings on either side, from whose lines they deviate less than the spike
# Share of hold-out readings equal to fitted ones, above which the data are not new; rounding alone causes less.
MIN_FITTED_SHARE = 0.9


class Fault(NamedTuple):
    """Rows of readings to exclude (empty if there is no fault), and the reason in words."""

    rows: np.ndarray = np.zeros(0, int)
    reason: str = ""


def exclude_faults(
    readings: Measurements, keep_spikes: bool = False, needed: Collection[str] = ()
) -> Measurements:
    """Return the readings without clipped and stuck ones and spikes; flags report the excluded rows.

    Args:
        readings: readings as recorded.
        keep_spikes: keep spikes, and readings with wrong temperatures.
        needed: columns that a model needs; readings with a wrong temperature in one of these are excluded too.
    """
    for search in (_find_clipped, _find_stuck):
        readings = _exclude(readings, search(readings))
    if keep_spikes or not readings.has("time"):  # both are detected from adjacent readings in time
        return readings
    initial_count = len(readings)
    while len((fault := _find_wrong_temperatures(readings, needed, initial_count)).rows):
        readings = _exclude(readings, fault)
    return _exclude(readings, _find_spikes(readings))


def _exclude(readings: Measurements, fault: Fault) -> Measurements:
    """Exclude the rows of a fault, with a flag; return the readings unchanged if none would remain."""
    kept_rows = np.setdiff1d(np.arange(len(readings)), fault.rows)
    if not len(fault.rows) or not len(kept_rows):
        return readings
    flag = f"{readings.file}: {fault.reason}"
    return replace(readings.select(kept_rows), flags=(*readings.flags, flag))


def _format_rows_read(rows: np.ndarray, values: np.ndarray, unit: str = "") -> str:
    """Format the first five row numbers, from 1, with their values."""
    listing = ", ".join(f"{row + 1} ({values[row]:.6g}{unit})" for row in rows[:5])
    return f"row {listing}{' …' * (len(rows) > 5)}"


def _find_clipped(readings: Measurements) -> Fault:
    """Find the readings at a clipped end of the output's range: each is only a bound of the true output."""
    output = readings["output"]
    ends = [] if checks.find_rounding_step(output) else checks.find_clip_levels(output)
    rows = np.flatnonzero(np.isin(output, [level for _, level in ends]))
    counts = " and ".join(f"{np.sum(output == v)} at its {end} {v:.6g}" for end, v in ends)
    counts += ": the calibration does not apply beyond these values"
    return Fault(rows, f"{len(rows)} clipped reading(s) of the output set aside, {counts}")


def _find_stuck(readings: Measurements) -> Fault:
    """Find the repeated readings of a stuck or rarely sampled output; only the first of each was measured."""
    output = readings["output"]
    if np.ptp(output) == 0 or checks.find_rounding_step(output):
        return Fault()
    rows = checks.find_stuck_rows(output, [np.arange(len(output))])[1:]
    if len(rows):
        fault = f"is constant at {output[rows[0]]:.6g} (rows {rows[0] + 1} to {rows[-1] + 1})"
    elif readings.has("time"):
        segments = readings.records.stretches()
        rows = checks.select_repeats(output, segments, checks.find_held_rows(output, segments))
        first_row = rows[0] + 1 if len(rows) else 0
        fault = f"repeats values between jumps, first in row {first_row}: a low sampling rate"
    else:
        return Fault()
    return Fault(rows, f"{len(rows)} reading(s) set aside: the output {fault}")


def _find_wrong_temperatures(readings: Measurements, needed: Collection[str], total: int) -> Fault:
    """Find the readings of one anomaly of a thermometer.

    If the model does not need the thermometer, only a few readings may be excluded. No reading is excluded if too few,
    none of a device or only one temperature would remain; the anomaly then counts against the result.
    """
    # a differing run has no known faulty column
    for fault in (anomaly for anomaly in readings.anomalies if anomaly.code != "run"):
        is_rare = fault.code == "leap" and len(fault.rows) <= checks.MAX_JUMP_SHARE * total
        if (is_rare or fault.column in needed) and _leaves_enough(readings.values, fault, total):
            rows = _format_rows_read(fault.rows, readings[fault.column], " °C")
            heading = f"{len(fault.rows)} reading(s) set aside, column {fault.column!r}"
            return Fault(
                fault.rows, f"{heading} {fault.description}: {rows}; keep_spikes keeps them"
            )
    return Fault()


def _leaves_enough(columns: Columns, fault: checks.Anomaly, total: int) -> bool:
    """Return whether enough readings remain without those of an anomaly, of every device and several temperatures."""
    count = len(columns[fault.column])
    remaining = np.setdiff1d(np.arange(count), fault.rows)
    min_count = checks.MIN_CHANGES if fault.code == "held" and count == total else 0.5 * total
    if len(remaining) < min_count:
        return False
    labels = [n for n in RECORD if n != "run" and n in columns]
    is_complete = all(set(columns[n][remaining]) == set(columns[n]) for n in labels)
    span = float(np.ptp(columns[fault.column][remaining]))
    return is_complete and span > settings().temperature_span


def _find_spikes(readings: Measurements) -> Fault:
    """Find spikes: single outliers from the line through their neighbours in the run.

    A smooth signal deviates little from this line; a step deviates in two adjacent readings and is kept. If there are
    more outliers than `MAX_SPIKE_SHARE`, none is a spike: the noise may have heavy tails.
    """
    max_count, output = max(1.0, MAX_SPIKE_SHARE * len(readings)), readings["output"]
    segments = readings.records.stretches(MIN_SPIKE_READINGS)
    spikes = (segment[_find_outliers(output[segment], max_count)] for segment in segments)
    rows = np.sort(np.concatenate([np.zeros(0, int), *spikes]))
    if len(rows) > max_count:
        return Fault()
    listing = f"far from both neighbours: {_format_rows_read(rows, output)}; keep_spikes keeps them"
    return Fault(rows, f"{len(rows)} reading(s) set aside as spikes, {listing}")


def _find_outliers(y: np.ndarray, max_count: float) -> np.ndarray:
    """Return the indices of outliers from the line through their neighbours; stop at more than `max_count`.

    The largest local outliers are removed and the remaining readings reassessed until there is none. If the last
    reading and its neighbour deviate equally, the last one is the outlier.
    """
    remaining, outliers, scale = np.arange(len(y)), np.zeros(0, int), 0.0
    while True:
        values = y[remaining]
        inner = np.abs(values[1:-1] - 0.5 * (values[:-2] + values[2:]))
        heights = np.concatenate([inner[:1], inner, inner[-1:] * (1.0 + 1e-12)])
        scale = scale or 1.4826 * float(np.median(heights))
        is_spike = (heights > 0) & (heights >= MIN_SPIKE_SD * scale)
        is_short = len(remaining) < SPIKE_NEIGHBOURS
        if is_short or scale == 0 or len(outliers) > max_count or not is_spike.any():
            return outliers
        windows = sliding_window_view(np.pad(heights, SPIKE_NEIGHBOURS), 2 * SPIKE_NEIGHBOURS + 1)
        preceding, following = windows[:, :SPIKE_NEIGHBOURS], windows[:, SPIKE_NEIGHBOURS + 1 :]
        is_spike &= (heights > preceding.max(axis=1)) & (heights >= following.max(axis=1))
        outliers, remaining = np.concatenate([outliers, remaining[is_spike]]), remaining[~is_spike]


def flag_fitted_holdout(readings: Measurements, holdout: Measurements) -> str:
    """Return a flag if hold-out readings were also fitted, with any times and labels; else "".

    Readings are compared by all numbers except the time: output, temperatures, inputs. There is no flag if rounding
    makes most of these recur.
    """
    numbers = (n for n, unit in readings.units.items() if n != "time" and unit is not None)
    names = [n for n in numbers if holdout.has(n)]
    rows = [np.column_stack([np.nan_to_num(r[n]) for n in names]) for r in (readings, holdout)]
    codes = np.unique(np.round(np.concatenate(rows), 12), axis=0, return_inverse=True)[1].ravel()
    fitted_codes, holdout_codes = np.split(codes, [len(readings)])
    count = int(np.isin(holdout_codes, fitted_codes).sum())
    is_rounded = len(np.unique(fitted_codes)) <= checks.MAX_DISTINCT_SHARE * len(fitted_codes)
    if is_rounded or count <= MIN_FITTED_SHARE * len(holdout_codes):
        return ""
    message = (
        f"{holdout.file}: {count} of the {len(holdout)} hold-out readings were also fitted "
        "(same output, temperature and inputs, ignoring times and labels): the hold-out error does not apply to new "
        "readings. Use readings of another run"
    )
    return Flag(message, "holdout.not_new")
