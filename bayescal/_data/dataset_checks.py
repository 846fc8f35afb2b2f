"""Checks of a whole data set: problems that make it unusable, and warnings.

Refused: one temperature only, time running backwards. Flagged: findings of `flags_of`. Thresholds stand above
their check; the "good records" against which they are set are the campaigns that the six instruments simulate, as
they are, rounded as displays do, and noisy.

A thermometer is a measurement too: a reading of it may be an error value or a spike, a repeated value of a logger that
asks seldom, or that of a converter that is stuck or at its end. Such readings are reported by name and row.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from bayescal._core.settings import settings
from bayescal._data.column import ARRAYS, ConvertedColumns, Place, file_names
from bayescal._data.records import PAUSE_STEPS, RECORD, Columns, Records, distinct, equal_runs
from bayescal._tables.cells import format_date
from bayescal._tables.raw_table import Objection, Objections, option

Where = Callable[[int], Place]  # by the index of a reading


def problems_of_whole(
    converted: ConvertedColumns, instrument: Any, one_temperature: bool
) -> Objections:
    """Return the problems of a whole record: one temperature only, time that runs backwards.

    The temperature need not change where `one_temperature` accepts it, or where the instrument says which effects its
    baseline has, and none of them needs that.
    """
    problems, columns = Objections(), converted.values
    effects = getattr(instrument, "effects", None)
    needed = effects is None or any("temperature" in effect.varies for effect in effects)
    required = any(c.name == "temperature" and c.required for c in instrument.columns)
    if needed and required and not one_temperature and "temperature" in columns:
        files = [table.file for table in converted.tables if table.file != ARRAYS]
        problems += same_temperature(columns, file_names(files))
    problems += backward_time(columns, converted.where)
    return problems


def same_temperature(columns: Columns, names: str) -> Iterator[Objection]:
    """Yield an objection where temperatures, °C, span less than `Settings.temperature_span`."""
    temperature = columns["temperature"]
    low, high = float(temperature.min()), float(temperature.max())
    if high - low < settings().temperature_span:
        span = f"{low:g}" if low == high else f"{low:g} … {high:g}"
        cure = (
            "At least two are needed, or nothing that depends on temperature can be calibrated: add readings at "
            "another (files given together are read together)"
        )
        came = f"reads {span} °C, one temperature only"
        yield Objection(names, came, cure=cure, column="temperature")  # of files, or of a device


# Periods after which clocks wrap, s: counters of 32, 24 and 16 bits, a GPS week, a day.
CLOCK_PERIODS = {
    f"2^{bits}{unit}": 2.0**bits * size
    for bits in (32, 24, 16)
    for unit, size in (("ns", 1e-9), ("us", 1e-6), ("ms", 1e-3))
} | {"604800s": 604_800.0, "86400s": 86_400.0}
# s (ten years): no test pauses that long within a run; beyond, the clock was set.
MAX_PAUSE_SECONDS = 3.2e8
# In usual steps, which such a pause exceeds too: yearly readings have not paused.
MAX_PAUSE_STEPS = 1e4


def backward_time(columns: Columns, where: Where) -> Iterator[Objection]:
    """Yield an objection where time, s, runs backwards, or jumps by years, within a run of a device and axis.

    `where` names a reading's file and row.
    """
    if "time" not in columns:
        return
    record = Records.of(columns).codes
    order = np.argsort(record, kind="stable")
    values, time = columns["time"], columns["time"][order]
    step = np.where(np.diff(record[order]) == 0, np.diff(time), np.nan)  # within a record
    size = abs(step[step != 0])
    usual = float(np.nanmedian(size)) if np.isfinite(size).any() else 0.0
    far, back = abs(step) > max(MAX_PAUSE_SECONDS, MAX_PAUSE_STEPS * usual), step < 0
    rows = np.sort(order[1:][far if far.any() else back])
    if not rows.size:
        return
    index, at = int(rows[0]), int(np.flatnonzero(order == rows[0])[0]) - 1
    before, undo = int(order[at]), ""
    if far.any():
        rows = rows[:1]
        came = f"jumps by {step[at] / 3.156e7:.3g} years from {where(before)} on, within one run"
        came += ": the clock was set there"
        cure = (
            "Correct the times, or give what stands before and behind it labels of their own in a column 'run' (where "
            "no time is needed, leave it out: --ignore time)"
        )
    else:
        cure = "Put the rows in the order in which they were taken, or give each record its own label in a column 'run'"
        labels = [f"{n} {columns[n][index]!s}" for n in ("run", "device", "axis") if n in columns]
        inside = f" within {', '.join(labels)}" * bool(labels)
        came = f"falls to {values[index]:.12g} s from {values[before]:.12g} s in {where(before)}: "
        came += f"time runs backwards{inside}"
        usual = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
        for name, period in CLOCK_PERIODS.items():
            after = step[back] + period
            if np.all((after > 0) & (after <= PAUSE_STEPS * usual)):
                came += f", as a clock does that begins anew at {name}"
                cure, undo = "Undo it, if that is so", option("--unwrap", f"time={name}")
                break
    places = [where(int(row)) for row in rows]
    at_rows = tuple(place.row for place in places)
    yield Objection(places[0].file, came, "", cure, undo, "time", places=at_rows)


def flags_of(
    converted: ConvertedColumns, output: str, names: str, repeated: np.ndarray
) -> tuple[str, ...]:
    """Return what is odd or was interpreted of accepted readings; `names` of the files, `repeated` rows."""
    columns, records = converted.values, Records.of(converted.values)
    flags = [*converted.flags]
    if converted.origin is not None:
        date = format_date(converted.origin)
        flags.append(f"{names}: time is in s since {date} (dates without a zone count as UTC)")
    if len(repeated):
        where, dropped = converted.where(int(repeated[0])), ": dropped" * ("time" in columns)
        message = "row(s) repeat an earlier one in every column, first at"
        flags.append(f"{len(repeated)} {message} {where}{dropped}")
    anomalies = find_anomalies(columns, records, converted.thermometers, output)
    messages = [
        *_find_saturation(columns, output),
        *(
            f"column {a.column!r} {a.description} (first at {converted.where(int(a.rows[0]))})"
            for a in anomalies
        ),
        *_find_leaps(converted, records, anomalies),
    ]
    return (*flags, *(f"{names}: {message}" for message in messages))


# Fewest readings at the very end of an output's range that are no chance; also as a share, in a long record.
MIN_CLIPPED_READINGS, MIN_CLIPPED_SHARE = 5, 0.01
# Share of the range, between an end and the next level, beyond which the end is a set-up of its own, such as one
# position.
CLIPPED_GAP = 0.1
# Times the readings at the next level, below which an end is that of a rounded output.
CLIPPED_RATIO = 3.0


def clip_levels(values: np.ndarray) -> list[tuple[str, float]]:
    """Return the ends of the range at which an output is clipped, each with its level; empty where none is."""
    levels, counts = np.unique(values, return_counts=True)
    if len(levels) < 3:
        return []
    clipped, enough = [], max(MIN_CLIPPED_READINGS, MIN_CLIPPED_SHARE * len(values))
    for end, next_level, name in ((-1, -2, "maximum"), (0, 1, "minimum")):
        with np.errstate(over="ignore"):
            near = abs(levels[end] - levels[next_level]) < CLIPPED_GAP * (levels[-1] - levels[0])
        if near and counts[end] >= enough and counts[end] > CLIPPED_RATIO * counts[next_level]:
            clipped.append((name, float(levels[end])))
    return clipped


def _find_saturation(columns: Columns, output: str) -> Iterator[str]:
    values = columns.get(output, np.zeros(0))
    for end, level in clip_levels(values):
        count = int((values == level).sum())
        yield f"column {output!r} may be saturated: {count} readings stand exactly at its {end} {level:g}"


MAX_STEP_DEGREES = 40.0  # °C, between neighbours: no body changes by more


def _find_leaps(
    converted: ConvertedColumns, records: Records, anomalies: Sequence[Anomaly]
) -> Iterator[str]:
    """Yield a warning of jumps other than error values and gaps: mostly wrap-around of a counter."""
    errors = {a.column: a.rows for a in anomalies if a.code == "leap"}
    for name in converted.thermometers:
        for rows in records.in_time if records.time.size else ():
            rows = rows[~np.isin(rows, errors.get(name, ()))]
            is_near = np.diff(records.time[rows]) <= records.silence
            leap = np.abs(np.diff(converted.values[name][rows])) * is_near
            if np.any(leap > MAX_STEP_DEGREES):
                at = int(np.argmax(leap))
                place, undo = converted.where(int(rows[at + 1])), f"{name}=PERIODdegC"
                yield (
                    f"column {name!r} jumps by {leap[at]:.4g} °C at {place}: wrap-around of a counter? "
                    f"{option('--unwrap', undo)} undoes it"
                )
                break


# Share of all readings that distinct values are at most where values occur again by rounding.
ROUNDED_SHARE = 0.5
# Of a step, by which values on a grid may be off it; numbers are written with two digits more.
OFF_GRID_STEPS = 0.01


def rounding_step(values: np.ndarray) -> float:
    """Return the step that a column is rounded to where rounding makes values recur, in its unit; else 0."""
    return resolution(values) if len(np.unique(values)) <= ROUNDED_SHARE * len(values) else 0.0


def resolution(values: np.ndarray, fewest: int = 3) -> float:
    """Return the step of the grid on which all values of a column lie, in its unit; 0 where there is none.

    Found by Euclid's algorithm: the remainder of the gaps between values divided by a step is the next step. For fewer
    than `fewest` different values, 0 is returned.
    """
    levels = np.unique(values)
    if len(levels) < max(fewest, 2):
        return 0.0
    gaps = np.diff(levels)
    gaps = gaps[gaps > OFF_GRID_STEPS * np.median(gaps)]
    step, digits = float(gaps.min()), 1e3 * np.spacing(np.max(np.abs(levels)))
    while step > digits:
        off = np.abs((levels - levels[0]) / step - np.round((levels - levels[0]) / step))
        if np.all(off < OFF_GRID_STEPS):
            return step
        step = float(step * off[off >= OFF_GRID_STEPS].min())
    return 0.0


def repeated_rows(columns: Columns) -> np.ndarray:
    """Return the rows that repeat an earlier one in every column, NaN equal to NaN."""
    codes = np.zeros(len(next(iter(columns.values()))), np.int64)
    for name in sorted(columns, key=lambda name: (name != "time", columns[name].dtype.kind != "f")):
        values = columns[name]
        number = values.dtype.kind == "f"
        levels = np.unique(values, return_inverse=True)[1] if number else distinct([values])[1]
        both = codes * (int(levels.max()) + 1) + levels
        _, first, codes = np.unique(both, return_index=True, return_inverse=True)
        if len(first) == len(codes):
            break
    return np.setdiff1d(np.arange(len(codes)), first)


MIN_CHANGES = 20  # of a column, below which no change is usual in it
# Share of a thermometer's changes that are usual ones: a rounded corner of a profile is among the rest.
USUAL_CHANGES_SHARE = 0.9
# °C: what a thermometer good to 0.5 °C (uniform) differs by from one time to another.
MIN_ANOMALY_DEGREES = 0.3
# Steps of a rounded column, above which a change is a leap: noise toggles by one or two.
MIN_LEAP_STEPS = 3.0
# Standard deviations of a column's noise, beyond which a reading is off its path.
LEAP_NOISE_SD = 8.0
# Share of all readings, that different values off the path are at most; more are a thermometer's noise, or its way.
LEAP_SHARE = 0.05
HALF_WIDTH = 3  # readings on either side, whose median is the path
MAX_SHOWN_VALUES = 3  # of a column, that a message names


class Anomaly(NamedTuple):
    """Readings at which a thermometer was wrong.

    Attributes:
        code: "leap", "held", "stuck" or "run".
        description: in words, behind the name of the column.
        rows: at which the column is certainly not the temperature; of a run, where it or another column is not.
    """

    code: str
    column: str
    description: str
    rows: np.ndarray


def find_anomalies(
    columns: Columns, records: Records, thermometers: Collection[str], output: str
) -> list[Anomaly]:
    """Find the anomalies of the columns of `thermometers`, °C; none without a column `time`.

    A jump that the output follows is a real change of temperature, hence no anomaly.
    """
    if "time" not in columns or not (whole := records.stretches()):
        return []
    anomalies = list[Anomaly]()
    names = sorted(n for n in thermometers if np.ptp(columns[n]) > 0)  # false of NaN
    with np.errstate(all="ignore"):  # of numbers that no temperature is
        body = off_path(columns.get(output, np.zeros(len(columns["time"]))), whole)
        for name in names:
            values, pieces = columns[name], whole
            if np.count_nonzero(np.diff(values)) < MIN_CHANGES:
                continue
            leaps = np.setdiff1d(off_path(values, pieces, MIN_ANOMALY_DEGREES), body)
            if 0 < len(np.unique(values[leaps])) <= LEAP_SHARE * len(values):
                clean = (piece[~np.isin(piece, leaps)] for piece in pieces)
                pieces = [piece for piece in clean if len(piece)]
                some = dict.fromkeys(values[leaps][:MAX_SHOWN_VALUES].tolist())
                read = ", ".join(map("{:g}".format, some))
                text = f"reads {read} °C, far from the readings about it, in {len(leaps)} reading(s): an error value?"
                anomalies.append(Anomaly("leap", name, text, leaps))
            if len(rows := held_rows(values, pieces)):
                text = "repeats a value until the next jump: held, or sampled seldom?"
                anomalies.append(Anomaly("held", name, text, repeats(values, pieces, rows)))
            elif len(rows := standing_rows(values, pieces)):
                level = values[rows[0]]
                text = f"stands at {level:g} in {len(rows)} readings, and seldom repeats elsewhere: saturated, stuck?"
                anomalies.append(Anomaly("stuck", name, text, rows))
        return [*anomalies, *_find_differing_run(columns, records, names)]


MIN_RMS_RATIO = 5.0  # of the residuals with a run to those without it, above which the run differs


def _find_differing_run(
    columns: Columns, records: Records, names: Sequence[str]
) -> Iterator[Anomaly]:
    """Find the run without which a thermometer is one function of another and its rate: one of both differed there."""
    time, runs = records.time, records.rows
    if len(runs) < 3 or any(len(r) < 3 or np.any(np.diff(time[r]) <= 0) for r in runs):
        return
    for name, other in permutations(names, 2):
        table = np.column_stack([np.ones(len(time)), columns[other], time, columns[name]])
        for rows in runs:
            table[rows, 2] = np.gradient(columns[other][rows], time[rows])
        table[:, 1:] -= table[:, 1:].mean(axis=0)
        sizes, rms = np.maximum(np.abs(table).max(axis=0), np.finfo(float).tiny), list[float]()
        table /= sizes
        # Without a run, by its share of the products: as fast for many runs as for a few.
        products = np.array([table[rows].T @ table[rows] for rows in runs])
        for rows, p in zip(runs, products.sum(axis=0) - products, strict=True):
            rest = p[3, 3] - p[:3, 3] @ np.linalg.pinv(p[:3, :3], hermitian=True) @ p[:3, 3]
            rms.append(float(sizes[3] * np.sqrt(max(rest, 0.0) / (len(time) - len(rows)))))
        run, second = np.argsort(rms)[:2]
        if rms[second] > max(MIN_RMS_RATIO * rms[run], MIN_ANOMALY_DEGREES):
            label = " ".join(str(columns[n][runs[run][0]]) for n in RECORD if n in columns)
            text = f"does not follow {other!r} in run {label} as it does in the others: one of both was different there"
            yield Anomaly("run", name, text, runs[run])


def off_path(values: np.ndarray, stretches: Sequence[np.ndarray], least: float = 0.0) -> np.ndarray:
    """Return the rows off the median of their neighbours by more than pace, noise and rounding explain.

    On a ramp, and on both sides of a step, a reading is that median itself. A value that repeats counts once.
    """
    outliers = [np.zeros(0, int)]
    step = float(np.diff(np.unique(values)).min(initial=np.inf))
    for piece in stretches:
        begins, counts = equal_runs(values[piece])
        level = values[piece][begins]
        if len(level) <= 2 * HALF_WIDTH:
            continue
        about = sliding_window_view(np.pad(level, HALF_WIDTH, mode="reflect"), 2 * HALF_WIDTH + 1)
        pace = float(np.quantile(np.abs(np.diff(level)), USUAL_CHANGES_SHARE))
        tolerance = max(least, MIN_LEAP_STEPS * step, LEAP_NOISE_SD * scatter(level))
        off = np.abs(level - np.median(about, axis=1)) > tolerance + HALF_WIDTH * pace
        outliers.append(piece[np.repeat(off, counts)])
    return np.sort(np.concatenate(outliers))


def scatter(values: np.ndarray) -> float:
    """Return the standard deviation of white noise in values, by the median of their second differences."""
    return 1.4826 * float(np.median(np.abs(np.diff(values, 2)))) / math.sqrt(6.0)


MIN_HELD_LEAPS = 6  # leaps there and back, below which that may be chance; good records have none
MIN_HELD_SHARE = 0.05  # the same as a share of a stretch's changes


def held_rows(values: np.ndarray, stretches: Sequence[np.ndarray]) -> np.ndarray:
    """Return the rows of stretches in which values are held until the next leap: the sensor was polled seldom.

    Rounded values repeat too, and then change by a step of their rounding, the smallest gap between any two of them.
    """
    held_stretches, pairs = [np.zeros(0, int)], 0
    some = np.unique(values[np.concatenate([held_stretches[0], *stretches])])
    leap = MIN_LEAP_STEPS * float(np.diff(some).min(initial=np.inf))
    for piece in stretches:
        begins, counts = equal_runs(values[piece])
        repeated, change = counts > 1, np.abs(np.diff(values[piece][begins]))
        pair = repeated[:-1] & repeated[1:] & (change > leap)
        if pair.any() and pair.mean() > MIN_HELD_SHARE:
            held_stretches.append(piece)
            pairs += int(np.count_nonzero(pair))
    return np.concatenate(held_stretches) if pairs >= MIN_HELD_LEAPS else held_stretches[0]


def repeats(values: np.ndarray, stretches: Sequence[np.ndarray], rows: np.ndarray) -> np.ndarray:
    """Return those of `rows` that repeat the value before them in their stretch."""
    again = [piece[1:][values[piece[1:]] == values[piece[:-1]]] for piece in stretches]
    return np.intersect1d(rows, np.concatenate([np.zeros(0, int), *again]))


MIN_STUCK_READINGS = 8  # readings in a row without a change, below which that may be chance
MIN_STUCK_RATIO = 4.0  # to the next longest stretch without a change; below, it is like others
# Largest share of the other readings that repeat the one before: above, all are rounded, or set.
MAX_REPEATED_SHARE = 0.1


def standing_rows(values: np.ndarray, stretches: Sequence[np.ndarray]) -> np.ndarray:
    """Return the rows of the one level at which a column stays for far longer than at any other, if there is one."""
    begins, lengths = zip(*(equal_runs(values[piece]) for piece in stretches), strict=True)
    levels = np.concatenate([values[p[first]] for p, first in zip(stretches, begins, strict=True)])
    rows, lengths = np.concatenate(stretches), np.concatenate(lengths)
    worst = levels[np.argmax(lengths)]
    others = lengths[levels != worst]
    least = max(MIN_STUCK_READINGS, MIN_STUCK_RATIO * np.max(others, initial=1))
    by_rounding = np.sum(others - 1) > MAX_REPEATED_SHARE * np.sum(others)
    far = others.size and np.max(lengths) >= least and not by_rounding
    return np.sort(rows[values[rows] == worst]) if far else rows[:0]


ROOM_DEGREES = 20.0  # °C, near which a record begins where its counter leaves open which of its periods it is in


def unwrap(values: np.ndarray, records: Records, period: float, start: float) -> np.ndarray:
    """Unwrap a counter that wraps at `period`; return the column in the order of the file (n,).

    Each record is unwrapped from one reading to the next. The first begins near `start` (20 °C, or 0); the mean of
    a later one is as near as may be to that of the first.
    """
    unwrapped, middle = values.copy(), None
    for rows in (record[np.isfinite(values[record])] for record in records.rows):
        if rows.size:
            piece = np.unwrap(values[rows], period=period)
            near = piece[0] - start if middle is None else piece.mean() - middle
            unwrapped[rows] = piece - period * np.round(near / period)
            middle = unwrapped[rows].mean() if middle is None else middle
    return unwrapped
