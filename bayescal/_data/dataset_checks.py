"""Checks of a whole data set: problems that make it unusable, and warnings.

Errors are a single temperature and decreasing times; warnings are those of `flags_of`. Each threshold is defined above
its check; thresholds were set on good records: simulated campaigns of six instruments, unaltered, rounded and noisy.

Temperature readings may be error values or spikes, values repeated by a slow logger, or those of a stuck or saturated
converter. They are reported by column and row.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from bayescal._core.settings import settings
from bayescal._data.column import ARRAYS, ConvertedColumns, Place, format_files
from bayescal._data.records import RECORD, Columns, Records, distinct, equal_runs
from bayescal._tables.cells import format_date
from bayescal._tables.raw_table import Objection, Objections, option

Segments = Sequence[np.ndarray]  # row indices of each segment, in time order
Locate = Callable[[int], Place]  # index of a reading → its file and row


def find_problems(
    converted: ConvertedColumns, instrument: Any, allow_one_temperature: bool
) -> Objections:
    """Return the problems of a data set: a single temperature, times that decrease or jump by years.

    A single temperature is accepted with `allow_one_temperature`, or if no baseline effect depends on the temperature.
    """
    problems, columns = Objections(), converted.values
    effects = getattr(instrument, "effects", None)
    is_used = effects is None or any("temperature" in effect.varies for effect in effects)
    is_required = any(c.name == "temperature" and c.required for c in instrument.columns)
    if is_used and is_required and not allow_one_temperature and "temperature" in columns:
        files = [table.file for table in converted.tables if table.file != ARRAYS]
        problems += find_single_temperature(columns, format_files(files))
    problems += find_time_reversals(columns, converted.locate)
    return problems


def find_single_temperature(columns: Columns, names: str) -> Iterator[Objection]:
    """Yield an objection to files `names` if their temperatures span less than `Settings.temperature_span`, °C."""
    temperature = columns["temperature"]
    low, high = float(temperature.min()), float(temperature.max())
    if high - low < settings().temperature_span:
        span = f"{low:g}" if low == high else f"{low:g} … {high:g}"
        cure = (
            "Calibration of temperature effects needs two temperatures or more: add readings at another temperature "
            "(several files can be read together)"
        )
        fault = f"reads {span} °C, a single temperature"
        yield Objection(names, fault, cure=cure, column="temperature")  # of files, or of a device


# Periods after which clocks wrap around, s: counters of 32, 24 and 16 bits, a GPS week, a day.
CLOCK_PERIODS = {
    f"2^{bits}{unit}": 2.0**bits * size
    for bits in (32, 24, 16)
    for unit, size in (("ns", 1e-9), ("us", 1e-6), ("ms", 1e-3))
} | {"604800s": 604_800.0, "86400s": 86_400.0}
# Longest gap within a run, s (ten years) and median steps; after a gap longer than both, the clock was set.
MAX_PAUSE_SECONDS, MAX_PAUSE_STEPS = 3.2e8, 1e4


def find_time_reversals(columns: Columns, locate: Locate) -> Iterator[Objection]:
    """Yield an objection if times, s, decrease or jump by years within a record; `locate` returns a reading's place."""
    if "time" not in columns:
        return
    record_codes = Records.of(columns).codes
    order = np.argsort(record_codes, kind="stable")
    values, time = columns["time"], columns["time"][order]
    step = np.where(np.diff(record_codes[order]) == 0, np.diff(time), np.nan)  # within a record
    step_sizes = abs(step[step != 0])
    median_step = float(np.nanmedian(step_sizes)) if np.isfinite(step_sizes).any() else 0.0
    is_jump = abs(step) > max(MAX_PAUSE_SECONDS, MAX_PAUSE_STEPS * median_step)
    is_backward = step < 0
    rows = np.sort(order[1:][is_jump if is_jump.any() else is_backward])
    if not rows.size:
        return
    index, index_before = int(rows[0]), int(np.flatnonzero(order == rows[0])[0]) - 1
    previous_row, suggestion = int(order[index_before]), ""
    if is_jump.any():
        rows = rows[:1]
        fault = f"jumps by {step[index_before] / 3.156e7:.3g} years after {locate(previous_row)}, within one run"
        fault += ": was the clock set there?"
        cure = (
            "Correct the times, or label the readings before and after the jump as two runs in a column 'run' (if the "
            "time is not needed, --ignore time)"
        )
    else:
        cure = "Sort the rows by time of measurement, or label each record separately in a column 'run'"
        labels = [f"{n} {columns[n][index]!s}" for n in ("run", "device", "axis") if n in columns]
        place_text = f" within {', '.join(labels)}" * bool(labels)
        fault = f"falls to {values[index]:.12g} s from {values[previous_row]:.12g} s in {locate(previous_row)}: "
        fault += f"time decreases{place_text}"
        median_step = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
        for name, period in CLOCK_PERIODS.items():
            unwrapped_step = step[is_backward] + period
            if np.all((unwrapped_step > 0) & (unwrapped_step <= 2.0 * median_step)):
                fault += f", as a clock that wraps around at {name}"
                cure, suggestion = "If so, unwrap it", option("--unwrap", f"time={name}")
                break
    places = [locate(int(row)) for row in rows]
    row_labels = tuple(place.row for place in places)
    yield Objection(places[0].file, fault, "", cure, suggestion, "time", places=row_labels)


def flags_of(
    converted: ConvertedColumns, output: str, names: str, repeated_rows: np.ndarray
) -> tuple[str, ...]:
    """Return warnings about accepted readings; `names`: file names; `repeated_rows`: rows that duplicate another."""
    columns, records = converted.values, Records.of(converted.values)
    flags = [*converted.flags]
    if converted.origin is not None:
        date = format_date(converted.origin)
        flags.append(f"{names}: time is in s since {date} (dates without time zone are UTC)")
    if len(repeated_rows):
        place, suffix = converted.locate(int(repeated_rows[0])), ": dropped" * ("time" in columns)
        message = "row(s) repeat an earlier row in every column, first at"
        flags.append(f"{len(repeated_rows)} {message} {place}{suffix}")
    anomalies = find_anomalies(columns, records, converted.thermometers, output)
    messages = [
        *_find_saturation(columns, output),
        *(
            f"column {a.column!r} {a.description} (first at {converted.locate(int(a.rows[0]))})"
            for a in anomalies
        ),
        *_find_wraparounds(converted, records, anomalies),
    ]
    return (*flags, *(f"{names}: {message}" for message in messages))


# Minimum number, and share in a long record, of readings exactly at an end of the output's range.
MIN_CLIPPED_READINGS, MIN_CLIPPED_SHARE = 5, 0.01
# Largest gap from an end to the next level, share of the range; above it, the end is a separate position of the test.
MAX_CLIPPED_GAP = 0.1
# Minimum ratio of the readings at an end to those at the next level; rounded outputs have a lower one.
MIN_CLIPPED_RATIO = 3.0


def find_clip_levels(values: np.ndarray) -> list[tuple[str, float]]:
    """Return the ends of the range ("maximum", "minimum") at which an output is clipped, with their levels."""
    levels, counts = np.unique(values, return_counts=True)
    if len(levels) < 3:
        return []
    clip_levels, min_count = [], max(MIN_CLIPPED_READINGS, MIN_CLIPPED_SHARE * len(values))
    for end, next_level, name in ((-1, -2, "maximum"), (0, 1, "minimum")):
        with np.errstate(over="ignore"):
            max_gap = MAX_CLIPPED_GAP * (levels[-1] - levels[0])
            is_near = abs(levels[end] - levels[next_level]) < max_gap
        is_frequent = counts[end] > MIN_CLIPPED_RATIO * counts[next_level]
        if is_near and is_frequent and counts[end] >= min_count:
            clip_levels.append((name, float(levels[end])))
    return clip_levels


def _find_saturation(columns: Columns, output: str) -> Iterator[str]:
    values = columns.get(output, np.zeros(0))
    for extremum, level in find_clip_levels(values):
        count = int((values == level).sum())
        yield f"column {output!r} may be saturated: {count} readings equal its {extremum} {level:g}"


MAX_STEP_DEGREES = 40.0  # °C, largest credible change between consecutive readings


def _find_wraparounds(
    converted: ConvertedColumns, records: Records, anomalies: Sequence[Anomaly]
) -> Iterator[str]:
    """Yield a warning for each temperature column that jumps, except to error values: usually a wrap-around."""
    error_rows = {a.column: a.rows for a in anomalies if a.code == "leap"}
    for name in converted.thermometers:
        for rows in records.in_time if records.time.size else ():
            rows = rows[~np.isin(rows, error_rows.get(name, ()))]
            is_near = np.diff(records.time[rows]) <= records.max_gap
            jump = np.abs(np.diff(converted.values[name][rows])) * is_near
            if np.any(jump > MAX_STEP_DEGREES):
                largest = int(np.argmax(jump))
                place, period = converted.locate(int(rows[largest + 1])), f"{name}=PERIODdegC"
                yield (
                    f"column {name!r} jumps by {jump[largest]:.4g} °C at {place}: wrap-around of a counter? "
                    f"Unwrap it with {option('--unwrap', period)}"
                )
                break


# Largest number of distinct values, share of all readings, of a column whose values recur by rounding.
MAX_DISTINCT_SHARE = 0.5
# Largest deviation of a rounded value from its grid, in steps, as numbers are written with two more digits.
OFF_GRID_STEPS = 0.01


def find_rounding_step(values: np.ndarray) -> float:
    """Return the rounding step of a column whose values recur by rounding, in its unit; 0 for other columns."""
    is_rounded = len(np.unique(values)) <= MAX_DISTINCT_SHARE * len(values)
    return find_grid_step(values) if is_rounded else 0.0


def find_grid_step(values: np.ndarray, min_levels: int = 3) -> float:
    """Return the step of the grid that contains all values of a column, in its unit; 0 without such a grid.

    Euclid's algorithm: the next step is the smallest remainder of the values modulo the step. Fewer than `min_levels`
    distinct values have no grid.
    """
    levels = np.unique(values)
    if len(levels) < max(min_levels, 2):
        return 0.0
    gaps = np.diff(levels)
    gaps = gaps[gaps > OFF_GRID_STEPS * np.median(gaps)]
    step, resolution = float(gaps.min()), 1e3 * np.spacing(np.max(np.abs(levels)))
    while step > resolution:
        remainders = np.abs((levels - levels[0]) / step - np.round((levels - levels[0]) / step))
        if np.all(remainders < OFF_GRID_STEPS):
            return step
        step = float(step * remainders[remainders >= OFF_GRID_STEPS].min())
    return 0.0


def find_repeated_rows(columns: Columns) -> np.ndarray:
    """Return the indices of rows that equal an earlier row in every column; NaN counts as equal to NaN."""
    codes = np.zeros(len(next(iter(columns.values()))), np.int64)
    for name in sorted(columns, key=lambda name: (name != "time", columns[name].dtype.kind != "f")):
        values = columns[name]
        is_number = values.dtype.kind == "f"
        levels = np.unique(values, return_inverse=True)[1] if is_number else distinct([values])[1]
        pair_codes = codes * (int(levels.max()) + 1) + levels
        _, first_rows, codes = np.unique(pair_codes, return_index=True, return_inverse=True)
        if len(first_rows) == len(codes):
            break
    return np.setdiff1d(np.arange(len(codes)), first_rows)


MIN_CHANGES = 20  # changes of a column needed to determine their distribution
# Quantile of a thermometer's changes that is taken as its typical rate; corners of a profile may exceed it.
TYPICAL_CHANGE_QUANTILE = 0.9
# °C: repeatability of a thermometer with an error limit of 0.5 °C (uniform distribution).
MIN_ANOMALY_DEGREES = 0.3
# Rounding steps above which a change is a jump; noise toggles by one or two.
MIN_JUMP_STEPS = 3.0
# Standard deviations of a column's noise, above which a deviation from the running median is a jump.
MIN_JUMP_SD = 8.0
# Largest number of distinct outlying values, share of all readings; more are noise, or the signal itself.
MAX_JUMP_SHARE = 0.05
HALF_WIDTH = 3  # readings on either side of the running median
MAX_SHOWN_VALUES = 3  # values of a column quoted in a message


class Anomaly(NamedTuple):
    """Faulty readings of a temperature column.

    Attributes:
        code: "leap" (error value or spike), "held" (repeated value), "stuck" (constant) or "run" (differing run).
        description: text that follows the name of the column.
        rows: rows in which the column does not give the temperature; for "run", in which it or another one does not.
    """

    code: str
    column: str
    description: str
    rows: np.ndarray


def find_anomalies(
    columns: Columns, records: Records, thermometers: Collection[str], output: str
) -> list[Anomaly]:
    """Find the anomalies of the temperature columns `thermometers`, °C; none without a column `time`.

    A jump that also occurs in the output is a real change of temperature, hence no anomaly.
    """
    if "time" not in columns or not (segments := records.stretches()):
        return []
    anomalies = list[Anomaly]()
    names = sorted(n for n in thermometers if np.ptp(columns[n]) > 0)  # NaN columns are excluded
    with np.errstate(all="ignore"):  # overflow of absurd values
        output_jumps = find_jumps(columns.get(output, np.zeros(len(columns["time"]))), segments)
        for name in names:
            values, blocks = columns[name], segments
            if np.count_nonzero(np.diff(values)) < MIN_CHANGES:
                continue
            jumps = find_jumps(values, blocks, MIN_ANOMALY_DEGREES)
            jumps = np.setdiff1d(jumps, output_jumps)
            if 0 < len(np.unique(values[jumps])) <= MAX_JUMP_SHARE * len(values):
                segments_left = (segment[~np.isin(segment, jumps)] for segment in blocks)
                blocks = [segment for segment in segments_left if len(segment)]
                examples = dict.fromkeys(values[jumps][:MAX_SHOWN_VALUES].tolist())
                listing = ", ".join(map("{:g}".format, examples))
                text = f"reads {listing} °C, far from adjacent readings, in {len(jumps)} reading(s): an error value?"
                anomalies.append(Anomaly("leap", name, text, jumps))
            if len(rows := find_held_rows(values, blocks)):
                text = "repeats values between jumps: held values, or a low sampling rate?"
                anomalies.append(Anomaly("held", name, text, select_repeats(values, blocks, rows)))
            elif len(rows := find_stuck_rows(values, blocks)):
                level = values[rows[0]]
                text = f"is constant at {level:g} in {len(rows)} readings, but rarely elsewhere: saturated or stuck?"
                anomalies.append(Anomaly("stuck", name, text, rows))
        return [*anomalies, *_find_differing_run(columns, records, names)]


MIN_RMS_RATIO = 5.0  # minimum ratio of rms residuals with and without a differing run


def _find_differing_run(
    columns: Columns, records: Records, names: Sequence[str]
) -> Iterator[Anomaly]:
    """Yield an anomaly for the run in which a column's linear relation to another and its rate of change differs."""
    time, runs = records.time, records.rows
    if len(runs) < 3 or any(len(r) < 3 or np.any(np.diff(time[r]) <= 0) for r in runs):
        return
    for name, other in permutations(names, 2):
        table = np.column_stack([np.ones(len(time)), columns[other], time, columns[name]])
        for rows in runs:
            table[rows, 2] = np.gradient(columns[other][rows], time[rows])
        table[:, 1:] -= table[:, 1:].mean(axis=0)
        scales, rms = np.maximum(np.abs(table).max(axis=0), np.finfo(float).tiny), list[float]()
        table /= scales
        # Leave-one-run-out by subtraction of its sums of products: as fast for many runs as for a few.
        products = np.array([table[rows].T @ table[rows] for rows in runs])
        for rows, p in zip(runs, products.sum(axis=0) - products, strict=True):
            rss = p[3, 3] - p[:3, 3] @ np.linalg.pinv(p[:3, :3], hermitian=True) @ p[:3, 3]
            rms.append(float(scales[3] * np.sqrt(max(rss, 0.0) / (len(time) - len(rows)))))
        run, next_run = np.argsort(rms)[:2]
        if rms[next_run] > max(MIN_RMS_RATIO * rms[run], MIN_ANOMALY_DEGREES):
            label = " ".join(str(columns[n][runs[run][0]]) for n in RECORD if n in columns)
            text = f"deviates in run {label} from its relation to {other!r} in other runs: is one of the two faulty?"
            yield Anomaly("run", name, text, runs[run])


def find_jumps(values: np.ndarray, segments: Segments, min_jump: float = 0.0) -> np.ndarray:
    """Return the rows that deviate from the running median by more than rate of change, noise and rounding explain.

    On a ramp, and on both sides of a step, a reading equals the running median. Equal consecutive values count as one.
    """
    outliers = [np.zeros(0, int)]
    step = float(np.diff(np.unique(values)).min(initial=np.inf))
    for segment in segments:
        starts, counts = equal_runs(values[segment])
        levels = values[segment][starts]
        if len(levels) <= 2 * HALF_WIDTH:
            continue
        padded_levels = np.pad(levels, HALF_WIDTH, mode="reflect")
        medians = np.median(sliding_window_view(padded_levels, 2 * HALF_WIDTH + 1), axis=1)
        typical_change = float(np.quantile(np.abs(np.diff(levels)), TYPICAL_CHANGE_QUANTILE))
        tolerance = max(min_jump, MIN_JUMP_STEPS * step, MIN_JUMP_SD * estimate_noise_sd(levels))
        is_outlier = np.abs(levels - medians) > tolerance + HALF_WIDTH * typical_change
        outliers.append(segment[np.repeat(is_outlier, counts)])
    return np.sort(np.concatenate(outliers))


def estimate_noise_sd(values: np.ndarray) -> float:
    """Estimate the white-noise standard deviation of values from the median absolute second difference."""
    return 1.4826 * float(np.median(np.abs(np.diff(values, 2)))) / math.sqrt(6.0)


MIN_HELD_JUMPS = 6  # minimum number of jumps between held values; good records have none
MIN_HELD_SHARE = 0.05  # minimum share of these jumps in the changes of a segment


def find_held_rows(values: np.ndarray, segments: Segments) -> np.ndarray:
    """Return the rows of the segments with held values, constant until the next jump, as of a rarely polled sensor.

    Rounded values repeat too, but change by a rounding step, the smallest difference of distinct values.
    """
    held_rows, jump_count = [np.zeros(0, int)], 0
    levels = np.unique(values[np.concatenate([held_rows[0], *segments])])
    min_jump = MIN_JUMP_STEPS * float(np.diff(levels).min(initial=np.inf))
    for segment in segments:
        starts, counts = equal_runs(values[segment])
        is_repeated, change = counts > 1, np.abs(np.diff(values[segment][starts]))
        is_jump = is_repeated[:-1] & is_repeated[1:] & (change > min_jump)
        if is_jump.any() and is_jump.mean() > MIN_HELD_SHARE:
            held_rows.append(segment)
            jump_count += int(np.count_nonzero(is_jump))
    return np.concatenate(held_rows) if jump_count >= MIN_HELD_JUMPS else held_rows[0]


def select_repeats(values: np.ndarray, segments: Segments, rows: np.ndarray) -> np.ndarray:
    """Return those of `rows` whose value equals that of the preceding reading of their segment."""
    repeats = [segment[1:][values[segment[1:]] == values[segment[:-1]]] for segment in segments]
    return np.intersect1d(rows, np.concatenate([np.zeros(0, int), *repeats]))


MIN_STUCK_READINGS = 8  # minimum number of consecutive equal readings of a stuck column
MIN_STUCK_RATIO = 4.0  # minimum ratio to the longest constant segment at another level
# Largest share of other readings that equal the preceding one; above it, the column is rounded or a setting.
MAX_REPEATED_SHARE = 0.1


def find_stuck_rows(values: np.ndarray, segments: Segments) -> np.ndarray:
    """Return the rows of the value at which a column is constant for far longer than at others; empty if none."""
    begins, lengths = zip(*(equal_runs(values[segment]) for segment in segments), strict=True)
    starts = [segment[indices] for segment, indices in zip(segments, begins, strict=True)]
    levels = values[np.concatenate(starts)]
    rows, lengths = np.concatenate(segments), np.concatenate(lengths)
    longest = levels[np.argmax(lengths)]
    other_lengths = lengths[levels != longest]
    min_length = max(MIN_STUCK_READINGS, MIN_STUCK_RATIO * np.max(other_lengths, initial=1))
    is_rounded = np.sum(other_lengths - 1) > MAX_REPEATED_SHARE * np.sum(other_lengths)
    is_stuck = other_lengths.size and np.max(lengths) >= min_length and not is_rounded
    return np.sort(rows[values[rows] == longest]) if is_stuck else rows[:0]


ROOM_DEGREES = 20.0  # °C, assumed start temperature of a record with a wrapping counter


def unwrap(values: np.ndarray, records: Records, period: float, start: float) -> np.ndarray:
    """Unwrap the values (n,) of a counter that wraps around at `period`, in the unit of the values.

    Each record is unwrapped separately. The first begins near `start` (20 °C, or 0); later ones are
    shifted by multiples of the period so that their means are closest to that of the first.
    """
    unwrapped, mean = values.copy(), None
    for rows in (record[np.isfinite(values[record])] for record in records.rows):
        if rows.size:
            segment = np.unwrap(values[rows], period=period)
            offset = segment[0] - start if mean is None else segment.mean() - mean
            unwrapped[rows] = segment - period * np.round(offset / period)
            mean = unwrapped[rows].mean() if mean is None else mean
    return unwrapped
