"""Checks of a whole data set: what makes it unusable, and what its owner should know of.

Refused: one temperature only, time running backwards, a thermometer whose counter wrapped. Flagged: what the list
`CHECKS` finds. Thresholds stand above the check that they are of; what they are set against ("good records") are the
campaigns that the six instruments simulate, as they are, rounded as displays do, and noisy.

Thermometers are checked against time and against each other: a thermometer is a measurement too. A body's temperature
goes at a pace. What departs from it is an error value, a spike, or another level; a logger that asks its thermometer
seldom repeats a value between two leaps; a converter at its end stays there while the body goes on; and two
thermometers on one body do in a run what they do in the others. What departs from that is said by name, row and run:
nothing in a fit shows it where profiles repeat.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from bayescal._core.settings import settings
from bayescal._data.column import ARRAYS, ASSUMED_GRAVITY, ConvertedColumns, Place, file_names
from bayescal._data.pose_rows import MAGNITUDE
from bayescal._data.records import (
    PAUSE_STEPS,
    Columns,
    distinct,
    equal_runs,
    pieces,
    record_codes,
    runs_of,
)
from bayescal._data.unit_conversion import base_unit, convert, unit_label
from bayescal._tables.raw_table import Objection, Objections, option

Where = Callable[[int], Place]  # by the index of a reading


def problems_of_whole(
    converted: ConvertedColumns, instrument: Any, one_temperature: bool
) -> Objections:
    """Return what is wrong with readings as a whole: one temperature only, time that runs backwards.

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
    problems += _wrapped(converted)
    return problems


def _objection(
    where: Where, rows: Sequence[int], column: str, came: str, cure: str, option: str = ""
) -> Objection:
    """An objection to rows, of which the first names the file."""
    places = [where(int(row)) for row in rows]
    at = tuple(place.row for place in places)
    return Objection(places[0].file, came, "", cure, option, column, places=at)


def _wrapped(converted: ConvertedColumns) -> Iterator[Objection]:
    """Find thermometers whose counter began anew, each with the option that undoes it."""
    columns = converted.values
    for name in converted.thermometers if "time" in columns else ():
        if period := wrap_period(columns, columns[name]):
            came = f"leaps by {period:g} °C, as a counter that began anew"
            undo = option("--unwrap", f"{name}={period:g}degC")
            rows = [1 + int(np.argmax(np.abs(np.diff(columns[name]))))]
            yield _objection(converted.where, rows, name, came, "Undo it, if that is so", undo)


def same_temperature(columns: Columns, names: str) -> Iterator[Objection]:
    """Object where temperatures, °C, span less than `Settings.temperature_span`."""
    temperature = columns["temperature"]
    low, high = float(temperature.min()), float(temperature.max())
    if high - low < settings().temperature_span:
        seen = f"{low:g}" if low == high else f"{low:g} … {high:g}"
        cure = (
            "At least two are needed, or nothing that depends on temperature can be calibrated: add readings at "
            "another (files given together are read together)"
        )
        came = f"reads {seen} °C, one temperature only"
        yield Objection(names, came, cure=cure, column="temperature")  # of files, or of a device


# What clocks hold when they begin anew, s: counters of 32, 24 and 16 bits, a GPS week, a day.
PERIODS = {
    f"2^{bits}{unit}": 2.0**bits * size
    for bits in (32, 24, 16)
    for unit, size in (("ns", 1e-9), ("us", 1e-6), ("ms", 1e-3))
} | {"604800s": 604_800.0, "86400s": 86_400.0}
# Within a run: a pause that no test makes, s (ten years); a clock was set there.
CLOCK_SET = 3.2e8
# Usual steps that such a pause is at the least: yearly readings have not paused.
CLOCK_SET_STEPS = 1e4


def backward_time(columns: Columns, where: Where) -> Iterator[Objection]:
    """Object where time, s, runs backwards, or leaps by years, within a run of a device and axis.

    `where` names a reading's file and row.
    """
    if "time" not in columns:
        return
    record = record_codes(columns)
    order = np.argsort(record, kind="stable")
    values, time = columns["time"], columns["time"][order]
    step = np.where(np.diff(record[order]) == 0, np.diff(time), np.nan)  # within a record
    size = abs(step[step != 0])
    usual = float(np.nanmedian(size)) if np.isfinite(size).any() else 0.0
    far, back = abs(step) > max(CLOCK_SET, CLOCK_SET_STEPS * usual), step < 0
    rows = np.sort(order[1:][far if far.any() else back])
    if not rows.size:
        return
    index, at = int(rows[0]), int(np.flatnonzero(order == rows[0])[0]) - 1
    before, undo = int(order[at]), ""
    if far.any():
        came = f"leaps by {step[at] / 3.156e7:.3g} years from {where(before)} on, within one run"
        came += ": the clock was set there"
        cure = (
            "Correct the times, or give what stands before and behind it labels of their own in a column 'run' (where "
            "no time is needed, leave it out: --ignore time)"
        )
        yield _objection(where, [index], "time", came, cure)
        return
    cure = "Put the rows in the order in which they were taken, or give each record its own label in a column 'run'"
    labels = [f"{n} {columns[n][index]!s}" for n in ("run", "device", "axis") if n in columns]
    inside = f" within {', '.join(labels)}" * bool(labels)
    came = f"reads {values[index]:.12g} s after {values[before]:.12g} s in {where(before)}: time runs backwards{inside}"
    usual = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    for name, period in PERIODS.items():
        after = step[back] + period
        if np.all((after > 0) & (after <= PAUSE_STEPS * usual)):
            came += f", as a clock does that begins anew at {name}"
            cure, undo = "Undo it, if that is so", option("--unwrap", f"time={name}")
            break
    yield _objection(where, rows.tolist(), "time", came, cure, undo)


@dataclass(frozen=True)
class CheckedRecord:
    """Readings as the checks of `CHECKS` take them.

    Attributes:
        columns, units: name → values (n,), and their unit; None for labels.
        output: name of the output column.
        thermometers: names of columns of measured temperatures, °C.
        given: names of the columns of numbers that were measured, and not filled in.
        oddities: of the thermometers.
        where: names a reading's file and row.
    """

    columns: Columns
    units: Mapping[str, str | None]
    output: str
    thermometers: Sequence[str]
    given: Sequence[str]
    oddities: Sequence[Oddity]
    where: Where


def flags_of(
    converted: ConvertedColumns, output: str, names: str, repeated: np.ndarray
) -> list[str]:
    """Return what is odd in the readings but no reason to refuse them; `names` of the files, `repeated` rows."""
    columns, warm, where = converted.values, converted.thermometers, converted.where
    no_reading = {*converted.filled, MAGNITUDE, ASSUMED_GRAVITY}
    given = [n for n, v in columns.items() if v.dtype.kind == "f" and n not in no_reading]
    odd = oddities(columns, warm, output)
    record = CheckedRecord(columns, converted.units, output, warm, given, odd, where)
    flags = [f"{names}: {said}" for check in CHECKS for said in check(record)]
    if many := len(repeated):
        said = "rows repeat" if many > 1 else "row repeats"
        end = f": {'they are' if many > 1 else 'it is'} dropped" * ("time" in columns)
        said += f" an earlier one in every column, first at {where(int(repeated[0]))}{end}"
        flags.insert(0, f"{many} {said}")
    return flags


# Readings at the very end of an output's range, below which that may be chance; also as a share, in a long record.
CLIPPED_READINGS, CLIPPED_SHARE = 5, 0.01
# Share of the range, between an end and the next level, beyond which the end is a set-up of its own, such as one
# position.
CLIPPED_GAP = 0.1
# Times the readings at the next level, below which an end is that of a rounded output.
CLIPPED_RATIO = 3.0


def clip_levels(values: np.ndarray) -> list[tuple[str, float]]:
    """Return the ends of the range at which an output was cut off, each with the level; empty if it looks natural."""
    levels, counts = np.unique(values, return_counts=True)
    if len(levels) < 3:
        return []
    found, enough = [], max(CLIPPED_READINGS, CLIPPED_SHARE * len(values))
    for end, beside, name in ((-1, -2, "maximum"), (0, 1, "minimum")):
        with np.errstate(over="ignore"):
            near = abs(levels[end] - levels[beside]) < CLIPPED_GAP * (levels[-1] - levels[0])
        if near and counts[end] >= enough and counts[end] > CLIPPED_RATIO * counts[beside]:
            found.append((name, float(levels[end])))
    return found


def _of_saturation(record: CheckedRecord) -> Iterator[str]:
    values = record.columns.get(record.output, np.zeros(0))
    for end, level in clip_levels(values):
        count = int((values == level).sum())
        yield f"column {record.output!r} may be saturated: {count} readings stand exactly at its {end} {level:g}"


# Standard deviations within runs, that the temperatures of runs are apart at the least where each has one of its own:
# a slope within runs then has a hundredth of the information.
PLATEAU_SD = 10.0


def _of_plateaus(record: CheckedRecord) -> Iterator[str]:
    """Thermometers that stand at one temperature in each run, another in each: run and slope are confounded."""
    if "run" not in record.columns:
        return
    _, codes = distinct([record.columns["run"]])
    count = np.bincount(codes)
    for name in record.thermometers if len(count) > 1 else ():
        values = record.columns[name]
        means = np.bincount(codes, values) / count
        within = float(np.sqrt(np.mean((values - means[codes]) ** 2)))
        if np.diff(np.sort(means)).min() > max(PLATEAU_SD * within, settings().temperature_span):
            yield (
                f"each run has one {name} of its own: differences between runs and a dependence on it are confounded, "
                "parted by their plausible sizes alone. Let it change within a run, or repeat one in another run"
            )


# Share of a record's outputs that are those of another, number for number: far beyond chance, and half of it is a copy.
COPIED_SHARE = 0.5


def _of_copied_records(record: CheckedRecord) -> Iterator[str]:
    """Records that hold the outputs of an earlier one, number for number: noise does not repeat.

    Of an output so rounded that most numbers occur again, nothing can be said.
    """
    runs, values = runs_of(record.columns), record.columns.get(record.output)
    if values is None or len(runs) < 2 or rounding_step(values):
        return
    names, of = list(runs), record_codes(record.columns)
    _, first, same = np.unique(values, return_index=True, return_inverse=True)
    for last, rows in enumerate(runs.values()):
        counts = np.bincount(of[first[same[rows]]], minlength=len(names))
        counts[last] = 0
        if (share := counts.max() / len(rows)) > COPIED_SHARE:
            yield (
                f"{share:.0%} of {record.output!r} in record {names[last]!r} are the very numbers of record "
                f"{names[counts.argmax()]!r}: one record under two labels? Leave one out: copied readings count twice"
            )


def _of_thermometers(record: CheckedRecord) -> Iterator[str]:
    for odd in record.oddities:
        yield f"column {odd.column!r} {odd.said} (first at {record.where(int(odd.rows[0]))})"


STUCK_READINGS = 8  # readings in a row without a change, below which that may be chance
STUCK_SHARE = 0.5  # of a record, from which a stretch is no plateau of a rounded thermometer


def stuck_rows(values: np.ndarray, thermometer: bool = False) -> tuple[int, int] | None:
    """Return first and last row of a stretch, far longer than any other, in which a column that else changes does not.

    Of a thermometer half of all readings in one stretch suffice, however often the others repeat.
    """
    begins, lengths = equal_runs(values)
    worst = int(np.argmax(lengths))
    length, others = int(lengths[worst]), np.delete(lengths, worst)
    if not others.size:
        return None
    most = REPEATED_SHARE * np.sum(others)  # that repeat the one before, outside
    rounded = np.sum(others - 1) > most and not (
        thermometer and length >= STUCK_SHARE * len(values)
    )
    if rounded or length < max(STUCK_READINGS, STUCK_RATIO * np.max(others)):
        return None
    return int(begins[worst]), int(begins[worst]) + length - 1


def _of_standstills(record: CheckedRecord) -> Iterator[str]:
    """Columns that do not change, at all or for long."""
    for name in record.given:
        values = record.columns[name]
        if len(values) > 1 and (values == values[0]).all():
            yield f"column {name!r} is constant ({values[0]:g})"
        elif (stuck := stuck_rows(values, name in record.thermometers)) is not None:
            if any(odd.column == name and stuck[1] in odd.rows for odd in record.oddities):
                continue
            first, last = map(record.where, stuck)
            share = (stuck[1] - stuck[0] + 1) / len(values)
            much = f", {100 * share:.0f} % of all readings" * (share > STUCK_SHARE)
            yield f"column {name!r} stands still at {values[stuck[0]]:g} from {first} to {last}{much}: was it stuck?"


# Unit, least and largest range of an output that any sensor resolves and measures. Least: a superconducting gravimeter
# resolves 1e-12 m/s², a large ring laser 1e-13 rad/s, an interferometer on a lever 1e-12 rad. Most: gauges of impacts
# end at 2e6 m/s², rotors of any kind at 1e5 rad/s, and an angle beyond 1e4 rad has been counted in turns.
OUTPUT_RANGES = (("m/s^2", 1e-12, 1e7), ("rad/s", 1e-13, 1e5), ("rad", 1e-12, 1e4))


def _of_size(record: CheckedRecord) -> Iterator[str]:
    name = record.output
    values, unit = record.columns.get(name, np.zeros(1)), record.units.get(name) or "1"
    for base, least, most in OUTPUT_RANGES:
        if unit == "any" or base_unit(unit) != base_unit(base):
            continue
        with np.errstate(over="ignore"):
            reach = float(np.ptp(values))
            size = float(abs(convert([reach], unit, base)[0]))
        if reach > 0 and not least <= size <= most:
            small = size < least
            yield (
                f"column {name!r} covers {reach:.2g} {unit_label(unit)} in all, {'less' if small else 'more'} than any "
                f"sensor {'resolves' if small else 'measures'} ({least if small else most:g} {base}): check its unit "
                "and its scale (--unit, --nominal-scale)"
            )


# Share of the readings that have the time of the one before, from which a clock is too coarse or has too few digits:
# most changes are lost.
SAME_TICK_SHARE = 0.5


def _of_clocks(record: CheckedRecord) -> Iterator[str]:
    time, codes = record.columns.get("time", np.zeros(0)), record_codes(record.columns)
    same = (time[1:] == time[:-1]) & (codes[1:] == codes[:-1]) if time.size > 1 else np.zeros(1)
    if (share := float(np.mean(same))) >= SAME_TICK_SHARE:
        steps = np.diff(np.unique(time))
        step = f" Its values are {np.min(steps):.3g} s apart at the least." if len(steps) else ""
        yield (
            f"column 'time' has too few digits, or a coarse clock: {share:.0%} of the readings have the time of the "
            f"one before.{step} Rates and lags within that are lost: record it with more digits"
        )


def _of_pauses(record: CheckedRecord) -> Iterator[str]:
    """A pause in one record that no other of as many readings, hence of one plan, makes there: the clock was set."""
    if (time := record.columns.get("time")) is None:
        return
    records = {n: r[np.argsort(time[r], kind="stable")] for n, r in runs_of(record.columns).items()}
    pauses = {}
    for name, rows in records.items():
        steps = np.diff(time[rows])
        usual = float(np.median(steps)) if len(steps) else 0.0
        pauses[name] = set(np.flatnonzero(steps > PAUSE_STEPS * usual).tolist())
    for name, rows in records.items():
        alike = [pauses[n] for n, own in records.items() if n != name and len(own) == len(rows)]
        alone = pauses[name].difference(*alike) if alike else set()
        if len(alone) == 1:
            last, following = time[rows[(at := alone.pop()) : at + 2]]
            yield (
                f"column 'time' makes a pause of {following - last:.3g} s in {name!r}, after {last:.12g} s, and in no "
                "other record of as many readings: was the clock set there? Lags, rates and drifts hang on it"
            )


COUNTED_RUNS = 8  # runs of one reading each, below which that may be the plan of a test


def _of_runs(record: CheckedRecord) -> Iterator[str]:
    """Runs that are a counter; or each begins with one and the same output, exactly, that hardly occurs elsewhere."""
    runs, values = record.columns.get("run", np.zeros(0)), record.columns.get(record.output)
    if len(runs) < COUNTED_RUNS:
        return
    _, first = np.unique(runs, return_index=True)
    if len(first) == len(runs):
        yield (
            f"column 'run' gives each of the {len(runs)} readings a run of its own: nothing goes on from one to the "
            "next, and no rate, lag or correlation is seen. Is it a counter? Leave it out, or label the runs"
        )
    elif values is not None and len(first) > 1 and np.all(values[first] == values[first[0]]):
        level = values[first[0]]
        if np.count_nonzero(values == level) <= len(first):
            yield (
                f"column {record.output!r} reads exactly {level:g} at the first reading of every run: was it set "
                "there, or does a filter in the logger (a high-pass) begin so? What the output was before that filter "
                "is not known"
            )


CHECKS: tuple[Callable[[CheckedRecord], Iterator[str]], ...] = (
    *(_of_saturation, _of_plateaus, _of_copied_records, _of_thermometers, _of_standstills),
    *(_of_size, _of_clocks, _of_pauses, _of_runs),
)

# Share of all readings that distinct values are at most where values occur again by rounding.
ROUNDED_SHARE = 0.5
# Of a step, by which values on a grid may be off it; numbers are written with two digits more.
OFF_GRID_STEPS = 0.01


def rounding_step(values: np.ndarray) -> float:
    """Return the step that a column is rounded to where rounding makes values occur again, in its unit; else 0."""
    return resolution(values) if len(np.unique(values)) <= ROUNDED_SHARE * len(values) else 0.0


def resolution(values: np.ndarray, fewest: int = 3) -> float:
    """Return the step of the grid on which all values of a column lie, in its unit; 0 where there is none.

    Found by Euclid's algorithm: what a step leaves of the gaps between values is the next one. Of less than `fewest`
    different values nothing is said.
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
    """Return the rows that repeat an earlier one in every column, NaN equal to NaN; few columns tell most apart."""
    codes = np.zeros(len(next(iter(columns.values()))), np.int64)
    for name in sorted(columns, key=lambda name: (name != "time", columns[name].dtype.kind != "f")):
        values = columns[name]
        number = values.dtype.kind == "f"
        own = np.unique(values, return_inverse=True)[1] if number else distinct([values])[1]
        _, first, codes = np.unique(
            codes * (int(own.max()) + 1) + own, return_index=True, return_inverse=True
        )
        if len(first) == len(codes):
            break
    return np.setdiff1d(np.arange(len(codes)), first)


FEW_CHANGES = 20  # changes of a column, below which nothing is usual in it
# Share of a thermometer's changes that are usual ones: a rounded corner of a profile is among the rest.
USUAL_CHANGES_SHARE = 0.9
# Times every other change of a stretch, above which its first or last reading stands apart.
END_RATIO = 3.0
# °C: what a thermometer good to 0.5 °C (uniform) differs by from one time to another.
UNLIKE_DEGREES = 0.3
# Steps of a rounded column, above which a change is a leap: noise toggles by one or two.
HELD_STEPS = 3.0
BESIDE = 3  # readings on either side of a change, by which its pace is known
SHOWN_VALUES = 3  # of a column, that a message names


class Oddity(NamedTuple):
    """An anomaly in a thermometer's column.

    Attributes:
        code: its kind: "held", "saturated", "leap", "level" or "run".
        said: what is odd, in words.
        rows: at which it is.
        wrong: of these, where the temperature was surely another than the column says; none where that is not known.
    """

    code: str
    column: str
    said: str
    rows: np.ndarray
    wrong: np.ndarray


def oddities(
    columns: Columns, thermometers: Collection[str], output: str = "output"
) -> list[Oddity]:
    """Return what is odd in the columns of `thermometers`, °C; without a column `time` nothing can be said."""
    if "time" not in columns:
        return []
    found, names = list[Oddity](), sorted(n for n in thermometers if np.ptp(columns[n]) > 0)
    with np.errstate(all="ignore"):  # of numbers that no temperature is
        own, beside = pieces(columns), {*thermometers, output, "time"}
        given = [n for n, v in columns.items() if n not in beside and v.dtype.kind == "f"]
        for name in names:
            odd = _off_pace(name, columns, output, given, own)
            gone = np.concatenate([np.zeros(0, int), *(one.wrong for one in odd)])
            rest = [piece[~np.isin(piece, gone)] for piece in own]
            if len(rows := held_rows(columns[name], rest)):
                said = "repeats a value until the next leap: it was held, or asked seldom"
                wrong = repeats(columns[name], rest, rows)
                found.append(Oddity("held", name, said, rows, wrong))
            found += [*_at_an_end(name, columns[name], rest), *odd]
        return [*found, *_unlike(columns, names)]


# Standard deviations of a column's noise, beyond which a change is none.
LEAP_NOISE_SD = 8.0
LEAP_SHARE = 0.05  # of all changes; more leaps there and back are a thermometer's noise, or its way


def _off_pace(
    name: str, columns: Columns, output: str, given: Collection[str], own: Sequence[np.ndarray]
) -> list[Oddity]:
    """Find readings that are no temperature of the body that the others are of: it goes at a pace, and does not leap.

    Leaps cut a stretch into parts, and so does a standstill that ends in one. The longest chain of parts that join at
    the record's pace is the temperature. Another part is not, if it is one number throughout (a power-on value, a bus
    error, a stuck value, a spike), or short. A longer one may have been right: another level, and the file does not say
    which. A leap that the output takes part in, where no input (`given`) was set, was the body's.
    """
    values, time = columns[name], columns["time"]
    every = np.concatenate([np.zeros(0), *(np.abs(np.diff(values[piece])) for piece in own)])
    if (moves := np.count_nonzero(every)) < FEW_CHANGES:
        return []
    usual = float(np.quantile(every, USUAL_CHANGES_SHARE))
    least = max(UNLIKE_DEGREES, HELD_STEPS * float(np.diff(np.unique(values)).min()), usual)
    noise = np.array([scatter(values[piece]) for piece in own])
    noise[[len(piece) <= 2 * BESIDE for piece in own]] = np.median(noise)
    allowed = np.maximum(least, LEAP_NOISE_SD * noise)
    leaps = [_beyond_pace(values[p], time[p]) > most for p, most in zip(own, allowed, strict=True)]
    if not 0 < sum(map(np.count_nonzero, leaps)) <= 2 * LEAP_SHARE * moves:  # there and back
        return []
    seen = _bends(columns.get(output, np.zeros(len(values))), own)
    for other in given:
        seen &= ~_bends(columns[other], own)
    ends = np.cumsum([len(piece) for piece in own])[:-1]
    codes, others = list[np.ndarray](), list[np.ndarray]()
    for piece, leap, real, most in zip(own, leaps, np.split(seen, ends), allowed, strict=True):
        for one_number, begin, end in _parts_off_path(values[piece], leap, real, most):
            (codes if one_number else others).append(piece[begin:end])
    if sum(map(len, others)) <= LEAP_SHARE * len(values):
        codes, others = [*codes, *others], []
    found = list[Oddity]()
    if codes:
        rows = np.sort(np.concatenate(codes))
        read = ", ".join(f"{v:g}" for v in dict.fromkeys(values[rows][:SHOWN_VALUES].tolist()))
        said = f"reads {read} °C where its own pace does not lead, in {len(rows)} reading(s): an error value, or stuck?"
        found.append(Oddity("leap", name, said, rows, rows))
    if others:
        rows = np.sort(np.concatenate(others))
        said = (
            f"goes on from another level in {len(rows)} readings, and nothing else does: re-seated, exchanged, or a "
            "counter that wrapped?"
        )
        found.append(Oddity("level", name, said, rows, rows[:0]))
    return found


def _parts_off_path(
    values: np.ndarray, leap: np.ndarray, seen: np.ndarray, most: float
) -> list[tuple[bool, int, int]]:
    """Find the parts of a stretch outside the longest chain of parts that join: whether one number, begin, end.

    Two parts join where the later begins within what the column goes over as many readings, at the end of the earlier
    or the beginning of the later. `leap` (n − 1,) marks changes that are leaps, `seen` (n,) those in which the output
    takes part: between several readings on both sides these join. `most` is what noise and rounding make, °C.
    """
    cuts = 1 + np.flatnonzero(leap)
    still = np.repeat(*equal_runs(values))[cuts - 1]
    begins = np.unique(np.concatenate([[0], still[cuts - still > BESIDE], cuts]))
    ends = np.append(begins[1:], len(values))
    one_number = np.maximum.reduceat(values, begins) == np.minimum.reduceat(values, begins)
    lengths = ends - begins
    best = np.where(one_number, 0.5 * lengths, lengths)  # one number may be no temperature
    before = np.full(len(begins), -1)
    for j in range(1, len(begins)):
        last, first = ends[:j] - 1, begins[j]
        over = first - last
        back, on = np.maximum(last - over, begins[:j]), np.minimum(first + over, ends[j] - 1)
        change = values[first] - values[last]
        goes = [
            np.zeros(j),
            (values[last] - values[back]) * over / np.maximum(last - back, 1),
            (values[on] - values[first]) * over / np.maximum(on - first, 1),
        ]
        joined = (np.min(goes, axis=0) - most <= change) & (change <= np.max(goes, axis=0) + most)
        lasting = min(lengths[j - 1 : j + 1]) > BESIDE
        joined[-1] = not leap[first - 1] or (seen[first - 1] and lasting)
        if joined.any():
            before[j] = int(np.argmax(np.where(joined, best[:j], -1.0)))
            best[j] += best[before[j]]
    off, at = np.ones(len(begins), bool), int(np.argmax(best))
    while at >= 0:
        off[at], at = False, int(before[at])
    edge = np.concatenate([[False], leap & ~seen[:-1], [False]])
    # Else the output, or a standstill, ends it.
    off &= edge[begins] | edge[ends] | (lengths <= BESIDE)
    return [(bool(one_number[k]), int(begins[k]), int(ends[k])) for k in np.flatnonzero(off)]


def _beyond_pace(values: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return what neither the rate before a change nor that after it explains of it (n − 1,).

    These rates are medians of three changes, so that a corner of a profile, from one rate to another, is explained; and
    a third of it in a change next to it, so that a chamber's step that takes few readings is; at an end, with a rate on
    one side alone, three times the fastest.
    """
    step, (rate, around, fastest) = np.diff(time), _rates(values, time)
    next_to, at = END_RATIO * np.pad(rate, 1, mode="reflect"), np.arange(len(rate))
    at_end = np.where(np.minimum(at, at[::-1]) < BESIDE, END_RATIO * fastest, 0.0)
    rates = [around[: len(rate)], around[BESIDE + 1 :], next_to[:-2], next_to[2:], at_end, -at_end]
    low, high = np.min(rates, axis=0) * step, np.max(rates, axis=0) * step
    change = np.diff(values)
    return np.maximum(np.maximum(change - high, low - change), 0.0)


def _rates(values: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the rate of each change (n − 1,), medians of three from three before the first on, and the fastest."""
    step = np.diff(time)
    rate = np.where(step > 0, np.diff(values) / np.where(step > 0, step, 1.0), 0.0)
    wide = np.pad(rate, BESIDE, mode="symmetric")
    around = np.median(sliding_window_view(wide, BESIDE), axis=1)
    return rate, around, float(np.max(np.abs(around[BESIDE : len(rate) + 1]), initial=0.0))


def scatter(values: np.ndarray) -> float:
    """Return the standard deviation of white noise in values, by the median of their second differences."""
    return 1.4826 * float(np.median(np.abs(np.diff(values, 2)))) / math.sqrt(6.0)


def _bends(values: np.ndarray, own: Sequence[np.ndarray]) -> np.ndarray:
    """Find where a column has a step or a corner within a reading, beyond its noise and what is usual in it (n,)."""
    at = np.arange(2 * BESIDE) - BESIDE + 0.5
    basis = np.linalg.qr(np.stack([np.ones_like(at), at, np.sign(at), np.abs(at)]).T)[0][:, 2:]
    found, noise = [np.zeros(len(piece)) for piece in own], [0.0]
    for piece, sizes in zip(own, found, strict=True):
        if len(piece) >= 2 * BESIDE:
            windows = sliding_window_view(values[piece], 2 * BESIDE)
            sizes[BESIDE - 1 : -BESIDE] = np.linalg.norm(windows @ basis, axis=1)
            noise.append(scatter(values[piece]))
    every = np.concatenate(found)
    usual = max(LEAP_NOISE_SD * max(noise), END_RATIO * float(np.median(every)))
    bend = np.pad(every > max(usual, 1e-9 * float(np.ptp(values))), 1)
    return bend[:-2] | bend[1:-1] | bend[2:]


HELD_LEAPS = 6  # leaps there and back, below which that may be chance; good records have none
HELD_SHARE = 0.05  # the same as a share of a stretch's changes


def held_rows(values: np.ndarray, own: Sequence[np.ndarray]) -> np.ndarray:
    """Return rows of stretches in which values are repeated until the next leap, again and again: asked seldom.

    Rounded values repeat too, and then change by a step of their rounding, the smallest gap between any two of them.
    """
    held, pairs = [np.zeros(0, int)], 0
    some = np.unique(values[np.concatenate([held[0], *own])])
    leap = HELD_STEPS * float(np.diff(some).min(initial=np.inf))
    for piece in own:
        begins, counts = equal_runs(values[piece])
        repeated, change = counts > 1, np.abs(np.diff(values[piece][begins]))
        pair = repeated[:-1] & repeated[1:] & (change > leap)
        if pair.any() and pair.mean() > HELD_SHARE:
            held.append(piece)
            pairs += int(np.count_nonzero(pair))
    return np.concatenate(held) if pairs >= HELD_LEAPS else held[0]


def repeats(values: np.ndarray, own: Sequence[np.ndarray], rows: np.ndarray) -> np.ndarray:
    """Those of some rows that repeat the value before them in their stretch."""
    again = [piece[1:][values[piece[1:]] == values[piece[:-1]]] for piece in own]
    return np.intersect1d(rows, np.concatenate([np.zeros(0, int), *again]))


STUCK_RATIO = 4.0  # times the next longest stretch without a change, below which it is like others
# Share of the other readings that repeat the one before, above which all are rounded, or set.
REPEATED_SHARE = 0.1
# Readings in a row at a thermometer's extreme, up to which that may be chance; and steps of a rounded one by which its
# pace beside them would have led on: a rounded peak stands for less than four.
SATURATED_READINGS, SATURATED_STEPS = 5, 8.0


def _at_an_end(name: str, values: np.ndarray, own: Sequence[np.ndarray]) -> list[Oddity]:
    """Find readings in a row exactly at an extreme, where a column's pace would have led on: a converter at its end.

    It stands there far longer than anywhere else, and hardly repeats elsewhere.
    """
    step, runs = float(np.diff(np.unique(values)).min()), [np.zeros((3, 0))]
    for v in (values[piece] for piece in own):
        begins, count = equal_runs(v)
        lasts = begins + count - 1
        before = np.abs(v[begins] - v[np.maximum(begins - BESIDE, 0)])
        after = np.abs(v[np.minimum(lasts + BESIDE, len(v) - 1)] - v[lasts])
        runs.append(np.stack([v[begins], count, count * np.maximum(before, after) / BESIDE]))
    level, count, led = np.concatenate(runs, axis=1)
    found = []
    for end, extreme in (("maximum", values.max()), ("minimum", values.min())):
        at, others = level == extreme, count[level != extreme]
        far = at & (count > SATURATED_READINGS) & (led > SATURATED_STEPS * step)
        far &= count >= STUCK_RATIO * np.max(others, initial=1.0)
        if np.any(far) and np.sum(others - 1) <= REPEATED_SHARE * np.sum(others):
            rows = np.flatnonzero(values == extreme)
            said = f"stands exactly at its {end} {extreme:g} in {len(rows)} readings, and hardly elsewhere: saturated?"
            found.append(Oddity("saturated", name, said, rows, rows))
    return found


MOST_RUNS, MOST_SIBLINGS = 30, 8  # compared two by two: 435 pairs of runs, 56 of thermometers
# Share of two runs' readings that have the same times, from which the runs can be compared.
SAME_TIMES_SHARE = 0.5
# Share of a thermometer's range to which it repeats from run to run where a profile does.
REPEATS_RANGE = 0.02
# Correlation of two thermometers in a run, from which they are on one body: that of a lag of an eighth of a wave (cos
# 45°).
TOGETHER_CORRELATION = 0.7
# Times the range of the other, beyond which one is in the laboratory and one in the chamber.
AS_WIDE_RATIO = 3.0
# Times what its sibling repeats to, beyond which a thermometer was different in a run.
UNLIKE_RATIO = 5.0


def _unlike(columns: Columns, names: Collection[str]) -> list[Oddity]:
    """Find runs in which a thermometer does not repeat what it did in another run, although its sibling does.

    Or each does what the other did: they are exchanged there. Siblings are thermometers that go together: on one body,
    or in one chamber, with whatever lag.
    """
    runs, found = runs_of(columns), []
    if not 2 <= len(names) <= MOST_SIBLINGS or len(runs) > MOST_RUNS:
        return []
    alike = {
        (a, b): rows
        for a, b in combinations(runs, 2)
        if len((rows := _same_moments(columns["time"], runs[a], runs[b]))[0])
        >= max(FEW_CHANGES, SAME_TIMES_SHARE * min(len(runs[a]), len(runs[b])))
    }
    for one, other in permutations(names, 2):
        odd, exchanged = dict[tuple[str, str], float](), False
        for pair, (here, there) in alike.items():
            apart, its, crossed, back = (
                _rms(columns[m][here] - columns[n][there])
                for m, n in ((one, one), (other, other), (one, other), (other, one))
            )
            crossed = max(crossed, back)
            repeats_to = min(its, crossed)
            if repeats_to < REPEATS_RANGE * float(np.ptp(columns[other])):
                far = apart > max(UNLIKE_RATIO * repeats_to, UNLIKE_DEGREES)
                odd[pair] = apart if far else 0.0
                exchanged |= far and crossed < its
        if not any(odd.values()) or not _siblings(columns, one, other, runs.values()):
            continue
        of_run = {run: [apart for pair, apart in odd.items() if run in pair] for run in runs}
        alone = [run for run, own in of_run.items() if own and all(own)]
        told = _odd_run(columns, one, other, runs)
        alone = [told] if told in alone else alone
        if alone:
            how = "does it there: they are exchanged"
            how = how if exchanged else "does: one of the two was different there"
            said = (
                f"does not repeat in run {' or '.join(alone)} what it did in the others, {max(odd.values()):.2g} °C "
                f"rms apart, where {other!r} {how}"
            )
            rows = np.concatenate([runs[run] for run in alone])
            known = len(alone) == 1 and (
                told in alone
                or all(own for run, own in of_run.items() if run not in alone)
                or not _changed_within(columns[one], alone[0], alike, odd)
            )
            found.append(Oddity("run", one, said, rows, rows if known else rows[:0]))
    return found


def _changed_within(
    values: np.ndarray,
    run: str,
    alike: Mapping[tuple[str, str], tuple[np.ndarray, np.ndarray]],
    pairs: Collection[tuple[str, str]],
) -> bool:
    """Return whether a run begins or ends as those like it: changed in its midst, and runs unlike it may be wrong."""
    for here, there in (alike[pair] for pair in pairs if run in pair):
        apart, part = values[here] - values[there], max(1, len(here) // 4)
        if UNLIKE_RATIO * min(_rms(apart[:part]), _rms(apart[-part:])) < _rms(apart):
            return True
    return False


def _odd_run(columns: Columns, one: str, other: str, runs: Mapping[str, np.ndarray]) -> str | None:
    """Return the run without which a thermometer follows its sibling in all others alike; None for none.

    Of the sibling and its rate the thermometer is the same function in all runs that are right.
    """
    time, sibling, left = columns["time"], columns[other], dict[str, float]()
    if len(runs) < 3 or any(len(r) < 3 or np.any(np.diff(time[r]) <= 0) for r in runs.values()):
        return None
    basis = np.column_stack([np.ones(len(time)), sibling, np.zeros(len(time))])
    for rows in runs.values():
        basis[rows, 2] = np.gradient(sibling[rows], time[rows])
    basis /= np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny)
    for run, rows in runs.items():
        own, rest = np.delete(columns[one], rows), np.delete(basis, rows, axis=0)
        left[run] = _rms(own - rest @ np.linalg.lstsq(rest, own)[0])
    best, second, *_ = sorted(left, key=left.__getitem__)
    return best if left[second] > UNLIKE_RATIO * left[best] else None


def _siblings(columns: Columns, one: str, other: str, runs: Iterable[np.ndarray]) -> bool:
    """Whether two thermometers go together, over ranges alike, in half of the runs at least."""
    pairs = [(columns[one][r], columns[other][r]) for r in runs if len(r) > 2]
    pairs = [(a, b) for a, b in pairs if np.ptp(a) and np.ptp(b)]
    if not pairs:
        return False
    together = float(np.median([np.corrcoef(a, b)[0, 1] for a, b in pairs])) > TOGETHER_CORRELATION
    wide = float(np.median([np.ptp(a) / np.ptp(b) for a, b in pairs]))
    return together and 1 / AS_WIDE_RATIO < wide < AS_WIDE_RATIO


def _same_moments(time: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of two runs at the same time since their first readings, within half a usual step."""
    a, b = (rows[np.argsort(time[rows], kind="stable")] for rows in (a, b))
    of_a, of_b = time[a] - time[a[0]], time[b] - time[b[0]]
    nearest = np.searchsorted(0.5 * (of_b[1:] + of_b[:-1]), of_a)
    step = float(np.median(np.diff(of_a))) if len(a) > 1 else 0.0
    near = np.abs(of_b[nearest] - of_a) <= 0.5 * step
    return a[near], b[nearest[near]]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def allowed_changes(columns: Columns, values: np.ndarray) -> np.ndarray:
    """Return what a thermometer's column, °C (n,), may change by from each reading of a file to the next (n − 1,)."""
    change = np.abs(np.diff(values))
    usual = END_RATIO * float(np.quantile(change, USUAL_CHANGES_SHARE)) if change.size else 0.0
    least = UNLIKE_DEGREES + np.full(len(change), usual)
    if "time" not in columns:
        return least
    time = columns["time"]
    pace = max((_rates(values[p], time[p])[2] for p in pieces(columns)), default=0.0)
    return np.maximum(least, UNLIKE_DEGREES + pace * np.abs(np.diff(time)))


ROOM = 20.0  # °C, near which a record begins where its counter leaves open which of its periods it is in
# What a thermometer's counter of some bits holds, °C: in whole degrees and parts of them by two, and in decimals.
COUNTER_PERIODS = sorted(
    {2.0**bits * size for bits in range(4, 21) for size in (1.0, 0.1, 0.01, 0.001)}
)
LEAST_PERIOD = 50.0  # °C; steps of less are other faults'
# °C, of counters that may go on from their largest value at the smallest: ±64, ±128
SIGNED = (128.0, 256.0)
PART = 0.25  # of a period, that a column may change by at the most where a change tells that it began anew
LEAST_LEVELS = 3  # values beyond a wrap; fewer are an error value


def unwrap(values: np.ndarray, codes: np.ndarray, period: float, start: float) -> np.ndarray:
    """Return a column, in the order of the file (n,), as of a counter that went on, whose `codes` are its records.

    In a record it goes on from one reading to the next. The first record begins near `start` (20 °C, or 0); the mean of
    a later one is as near as may be to that of the first. The counter begins anew at `period`.
    """
    found, middle = values.copy(), None
    for code in np.unique(codes):
        rows = np.flatnonzero((codes == code) & np.isfinite(values))
        if rows.size:
            own = np.unwrap(values[rows], period=period)
            near = own[0] - start if middle is None else own.mean() - middle
            found[rows] = own - period * np.round(near / period)
            middle = found[rows].mean() if middle is None else middle
    return found


def wrap_period(columns: Columns, values: np.ndarray) -> float | None:
    """Return the period, °C, at which a thermometer's counter began anew; None where it did not.

    Within a record each change by more than half of it is one of a period, to what the column may change by; all values
    (n,) lie in one period, from 0 or (of signed bytes) about 0; and those beyond the others are more than an error
    value. `columns` are of the time and labels.
    """
    allowed = allowed_changes(columns, values)
    codes = record_codes({**columns, "": values})
    low, high = float(values.min()), float(values.max())
    change = np.where(np.diff(codes) == 0, np.abs(np.diff(values)), 0.0)
    for period in (p for p in COUNTER_PERIODS if p >= max(LEAST_PERIOD, high - low)):
        begin = 0.0 if period not in SIGNED or low >= 0 else -0.5 * period
        wraps = (change > 0.5 * period) & (allowed < PART * period)
        inside = begin <= low and high <= begin + period
        if inside and wraps.any() and np.all(period - change[wraps] <= allowed[wraps]):
            beyond = np.round((unwrap(values, codes, period, ROOM) - values) / period)
            levels, counts = np.unique(beyond, return_counts=True)
            if len(np.unique(values[beyond != levels[np.argmax(counts)]])) >= LEAST_LEVELS:
                return period
    return None
