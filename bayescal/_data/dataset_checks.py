"""Checks of a whole data set: what makes it unusable, and what its owner should know of.

Refused: one temperature only, time running backwards. Flagged: repeated rows (with a time they are dropped), a
saturated output, a constant column, an output of an absurd size, a time of too few digits, runs of one reading each.

Thermometers are checked against time and against each other: a thermometer is a measurement too. A body's temperature
goes smoothly, and does not leap there and back from one reading to the next. A logger that asks its thermometer seldom
repeats a value between two leaps; a converter at its end stays there while the body goes on; and two thermometers on
one body do in a run what they do in the others. What departs from that is said by name, row and run: nothing in a fit
shows it where profiles repeat.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import combinations, permutations
from typing import Any, NamedTuple

import numpy as np

from bayescal._core.errors import InputError
from bayescal._core.settings import settings
from bayescal._data.column import (
    ARRAYS,
    ASSUMED_GRAVITY,
    MAY_BE_EMPTY,
    ConvertedColumns,
    file_names,
)
from bayescal._data.pose_rows import MAGNITUDE
from bayescal._data.unit_conversion import base_unit, convert, unit_label
from bayescal._tables.raw_table import Objection, Objections, Table, option

# What a record may not be, and what of it is no reading of the sensor. "Good records" are the campaigns that the six
# instruments simulate, as they are, rounded as displays do, and noisy (tests/readings/test_thermometers.py).

# Usual steps between readings, beyond which the next one is no neighbour; a logger that loses four readings in a row
# has not paused.
PAUSE_STEPS = 5.0
# Standard deviations within runs, that the temperatures of runs are apart at the least where each has one of its own:
# a slope within runs then has a hundredth of the information.
PLATEAU_SD = 10.0
# Readings at the very end of an output's range, below which that may be chance.
CLIPPED_READINGS = 5
CLIPPED_SHARE = 0.01  # the same as a share of all readings, in a long record
# Share of the range, between an end and the next level, beyond which the end is a set-up of its own, such as one
# position.
CLIPPED_GAP = 0.1
# Times the readings at the next level, below which an end is that of a rounded output.
CLIPPED_RATIO = 3.0
STUCK_READINGS = 8  # readings in a row without a change, below which that may be chance
STUCK_RATIO = 4.0  # times the next longest stretch without a change, below which it is like others
STUCK_SHARE = 0.5  # of a record, from which a stretch is no plateau of a rounded thermometer
# Share of the other readings that repeat the one before, above which all are rounded, or set.
REPEATED_SHARE = 0.1
FEW_CHANGES = 20  # changes of a column, below which nothing is usual in it
LEAP_RANGE = 0.02  # of a thermometer's range: less is no leap
# Robust standard deviations of a thermometer's own leaps there and back, beyond which one is no noise: of normal noise
# not one in 10¹⁴ readings.
LEAP_NOISE_SD = 8.0
# Times the change that nine tenths of a thermometer's changes stay below: a body does not go five times as fast for
# one reading.
LEAP_RATIO = 5.0
LEAP_SHARE = 0.05  # of all readings; more leaps are a thermometer's noise, or its way
# Times every other change of a stretch, above which its first or last reading stands apart.
END_RATIO = 3.0
# Steps of a rounded column, above which a change is a leap: noise toggles by one or two.
HELD_STEPS = 3.0
HELD_LEAPS = 6  # leaps there and back, below which that may be chance; good records have none
HELD_SHARE = 0.05  # the same as a share of a stretch's changes
# Readings in a row at a thermometer's extreme, below which that may be chance.
SATURATED_READINGS = 5
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
# °C: what a thermometer good to 0.5 °C (uniform) differs by from one time to another.
UNLIKE_DEGREES = 0.3
# Share of all readings that distinct values are at most where values occur again by rounding.
ROUNDED_SHARE = 0.5
# Share of a record's outputs that are those of another, number for number: far beyond chance, and half of it is a copy.
COPIED_SHARE = 0.5
# Of a step, by which values on a grid may be off it; numbers are written with two digits more.
OFF_GRID_STEPS = 0.01
# Share of the readings that have the time of the one before, from which a clock is too coarse or has too few digits:
# most changes are lost.
SAME_TICK_SHARE = 0.5
COUNTED_RUNS = 8  # runs of one reading each, below which that may be the plan of a test
# Different values of a thermometer, of fewer of which each change is as large as its range.
FEWEST_LEVELS = 3
# Share of a thermometer's changes that are usual ones: a rounded corner of a profile is among the rest.
USUAL_CHANGES_SHARE = 0.9
# Of readings at even distances in the file that lie apart: robust standard deviations beyond which one does, fewest of
# them, the distances, and the share of the places at such a distance that they hold. Of so many rows, at most.
PERIODIC_SD, PERIODIC_READINGS, PERIODIC_ROWS, PERIODIC_SHARE, PERIODIC_LOOKED = (
    8.0,
    6,
    (4, 200),
    0.8,
    20_000,
)
# Unit, least and largest range of an output that any sensor resolves and measures. Least: a superconducting gravimeter
# resolves 1e-12 m/s², a large ring laser 1e-13 rad/s, an interferometer on a lever 1e-12 rad. Most: gauges of impacts
# end at 2e6 m/s², rotors of any kind at 1e5 rad/s, and an angle beyond 1e4 rad has been counted in turns.
OUTPUT_RANGES = (
    ("m/s^2", 1e-12, 1e7),
    ("rad/s", 1e-13, 1e5),
    ("rad", 1e-12, 1e4),
)

# What clocks hold when they begin anew: counters of 32, 24 and 16 bits, a GPS week, a day.
PERIODS = {
    **{
        f"2^{bits}{unit}": 2.0**bits * size
        for bits in (32, 24, 16)
        for unit, size in (("ns", 1e-9), ("us", 1e-6), ("ms", 1e-3))
    },
    "604800s": 604_800.0,
    "86400s": 86_400.0,
}
# Within a run: a pause that no test makes, s (ten years); a clock was set there.
CLOCK_SET = 3.2e8
# Usual steps that such a pause is at the least: yearly readings have not paused.
CLOCK_SET_STEPS = 1e4

RECORD = ("device", "axis", "run")  # columns of labels that tell one record in time from another

Columns = Mapping[str, np.ndarray]


def distinct(columns: Sequence[np.ndarray]) -> tuple[list[tuple[Any, ...]], np.ndarray]:
    """The different rows of some columns, in the order in which they first appear, and which of them each row is.

    By a dictionary of the first rows of stretches, since labels stay the same for long, and pandas takes half a second
    to load.
    """
    begins = np.ones(len(columns[0]), bool)
    begins[1:] = np.any([values[1:] != values[:-1] for values in columns], axis=0)
    first, codes = np.flatnonzero(begins), dict[tuple[Any, ...], int]()
    rows = zip(*(values[first].tolist() for values in columns), strict=True)
    found = np.fromiter((codes.setdefault(row, len(codes)) for row in rows), np.int64, len(first))
    return list(codes), np.repeat(found, np.diff(first, append=len(begins)))


def label_codes(columns: Columns, names: Collection[str]) -> np.ndarray:
    """A number for each combination of labels, in the order in which they first appear; NaN is one of them."""
    every = [columns[n] for n in names]
    every = [np.where(v == v, v.astype(object), "") if v.dtype.kind == "f" else v for v in every]
    return distinct(every)[1] if every else np.zeros(len(next(iter(columns.values()))), np.int64)


def record_codes(columns: Columns) -> np.ndarray:
    """A number for each run of each device and axis."""
    return label_codes(columns, [n for n in RECORD if n in columns])


def members(codes: np.ndarray) -> list[np.ndarray]:
    """Rows of each code, in the order of the file."""
    order = np.argsort(codes, kind="stable")
    return np.split(order, 1 + np.flatnonzero(np.diff(codes[order]))) if codes.size else []


def stretches(time: np.ndarray, codes: np.ndarray, fewest: int) -> list[np.ndarray]:
    """Rows of each stretch of a record without a pause, in the order of time.

    Args:
        time: of the readings, s (n,).
        codes: of their records (n,).
        fewest: readings that a stretch has.
    """
    found = []
    for own in members(codes):
        rows = own[np.argsort(time[own], kind="stable")]
        steps = np.diff(time[rows])
        usual = np.median(steps) if steps.size else 0.0
        found += np.split(rows, 1 + np.flatnonzero(steps > PAUSE_STEPS * usual))
    return [rows for rows in found if len(rows) >= fewest]


def rounding_step(values: np.ndarray) -> float:
    """The step that an output is rounded to, in its unit; 0 where most values occur once, or lie on no grid."""
    levels = np.unique(values)
    if not 3 <= len(levels) <= ROUNDED_SHARE * len(values):
        return 0.0
    gaps, off = np.diff(levels), OFF_GRID_STEPS
    step = float(gaps[gaps > off * np.median(gaps)].min())
    places = (levels - levels[0]) / step
    return step if np.all(np.abs(places - np.round(places)) < off) else 0.0


BESIDE = 3  # changes on either side of one, of which the median is the rate there: one of them may be odd
MOST_RUNS, MOST_SIBLINGS = 30, 8  # compared two by two: 435 pairs of runs, 56 of thermometers


class Oddity(NamedTuple):
    """What is odd in a thermometer's column.

    Attributes:
        column: the thermometer's.
        said: what is odd, in words.
        rows: in which it is.
        wrong: of these, where the temperature was surely another than the column says; none where that is not known.
        jumped: whether the column goes on from another level at these rows, which the output may confirm.
    """

    column: str
    said: str
    rows: np.ndarray
    wrong: np.ndarray
    jumped: bool = False


def oddities(
    columns: Columns, thermometers: Collection[str], output: str = "output"
) -> list[Oddity]:
    """What is odd in the columns of thermometers.

    Args:
        columns: readings by name; without `time` nothing can be said.
        thermometers: columns of measured temperatures, °C.
        output: name of the output column, if it is there.
    """
    if "time" not in columns:
        return []
    found, names = list[Oddity](), sorted(n for n in thermometers if np.ptp(columns[n]) > 0)
    with np.errstate(all="ignore"):  # of numbers that no temperature is
        own = pieces(columns)
        for name in names:
            if len(rows := held_rows(columns[name], own)):
                said = "repeats a value until the next leap: it was held, or asked seldom"
                found.append(Oddity(name, said, rows, repeats(columns[name], own, rows)))
            if len(rows := leaps(columns[name], own)):
                said = f"leaps faster than a body can follow at {len(rows)} reading(s)"
                found.append(Oddity(name, said, rows, rows))
            found += _at_an_end(name, columns[name], own)
            found += _jumps(name, columns, {*thermometers, output}, own)
        return [*found, *_unlike(columns, names)]


def leaps(values: np.ndarray, own: Sequence[np.ndarray]) -> np.ndarray:
    """Rows at which a column leaps there and back, or begins or ends a run elsewhere: faster than a body can follow.

    Args:
        values: of the column (n,).
        own: rows of each stretch without a pause, by `pieces`.
    """
    jumps = [np.diff(values[piece]) for piece in own]
    if sum(map(len, jumps)) < FEW_CHANGES or len(np.unique(values)) < FEWEST_LEVELS:
        return np.zeros(0, int)
    back = [_there_and_back(jump) for jump in jumps]
    size = np.abs(np.concatenate(jumps))
    usual = max(
        LEAP_RANGE * float(np.ptp(values)),
        LEAP_NOISE_SD * 1.4826 * float(np.median(np.concatenate(back))),
        LEAP_RATIO * float(np.quantile(size, USUAL_CHANGES_SHARE)),
        HELD_STEPS * rounding_step(values),
    )
    rows = []
    for piece, jump, both in zip(own, jumps, back, strict=True):
        spike = np.pad(_highest(both, usual), 1)
        rows.append(piece[spike])
        inner = np.abs(jump[1:-1])[~(spike[1:-2] | spike[2:-1])]
        apart = np.abs(jump[[0, -1]]) > max(usual, END_RATIO * float(inner.max(initial=0.0)))
        rows.append(piece[[0, -1]][apart & ~spike[[1, -2]]])
    found = np.unique(np.concatenate(rows))
    return found if len(found) <= LEAP_SHARE * len(values) else found[:0]


def _there_and_back(jump: np.ndarray) -> np.ndarray:
    """The smaller of a reading's two changes, where they are of opposite sign."""
    there, back = jump[:-1], jump[1:]
    return np.where(there * back < 0, np.minimum(np.abs(there), np.abs(back)), 0.0)


def _highest(both: np.ndarray, usual: float) -> np.ndarray:
    """Where leaps stand above what is usual, the higher of neighbours: beside a spike its neighbours leap too."""
    padded = np.pad(both, 1)
    return (both > usual) & (both >= padded[:-2]) & (both >= padded[2:])


def pieces(columns: Columns) -> list[np.ndarray]:
    """Rows of each stretch of a run without a pause, in time; three readings at least."""
    return stretches(columns["time"], record_codes(columns), 3)


def _runs(columns: Columns) -> dict[str, np.ndarray]:
    """Rows of each run of each device and axis, by its labels, in the order of the file."""
    names = [n for n in RECORD if n in columns]
    return {
        " ".join(str(columns[n][rows[0]]) for n in names): rows
        for rows in members(record_codes(columns))
    }


def held_rows(values: np.ndarray, own: Sequence[np.ndarray]) -> np.ndarray:
    """Rows of stretches in which values are repeated until the next leap, again and again: they were asked seldom.

    Rounded values repeat too, and then change by a step of their rounding, the smallest gap between any two of them.

    Args:
        values: of a column that is not constant (n,).
        own: rows of each stretch without a pause, by `pieces`.
    """
    held, pairs = [np.zeros(0, int)], 0
    leap = HELD_STEPS * float(np.diff(np.unique(values)).min())
    for piece in own:
        cells = values[piece]
        ends = np.append(np.flatnonzero(cells[1:] != cells[:-1]), len(cells) - 1)
        repeated = np.diff(ends, prepend=-1) > 1
        pair = repeated[:-1] & repeated[1:] & (np.abs(np.diff(cells[ends])) > leap)
        if pair.any() and pair.mean() > HELD_SHARE:
            held.append(piece)
            pairs += int(np.count_nonzero(pair))
    return np.concatenate(held) if pairs >= HELD_LEAPS else held[0]


def repeats(values: np.ndarray, own: Sequence[np.ndarray], rows: np.ndarray) -> np.ndarray:
    """Those of some rows that repeat the value before them in their stretch."""
    again = [piece[1:][values[piece[1:]] == values[piece[:-1]]] for piece in own]
    return np.intersect1d(rows, np.concatenate([np.zeros(0, int), *again]))


def _jumps(
    name: str, columns: Columns, follow: Collection[str], own: Sequence[np.ndarray]
) -> list[Oddity]:
    """Where a column goes on from another level at once: no body does, but a thermometer that was set there.

    Where the output, or another thermometer, goes on from another level too, it was the body, and readings are far
    apart; unless an input was set anew there. Values that stand still before and after are set-points, written down as
    they were set. `follow` are the columns that follow a body, this one among them.
    """
    values = columns[name]
    own = [piece for piece in own if len(piece) > 2 * BESIDE + 1]
    changes = [np.diff(values[piece]) for piece in own]
    if sum(map(len, changes)) < FEW_CHANGES or len(np.unique(values)) < FEWEST_LEVELS:
        return []
    time, at = columns["time"], np.concatenate([piece[1:] for piece in own])
    flat = [np.pad(change == 0, 1, constant_values=True) for change in changes]
    still = np.concatenate([one[:-2] & one[2:] for one in flat])
    jump = _unexplained(values, time, own)
    # a rounded corner leaves less
    usual = float(np.quantile(np.abs(np.concatenate(changes)), USUAL_CHANGES_SHARE))
    parts = np.split(jump, np.cumsum([len(change) for change in changes])[:-1])
    noise = np.concatenate([np.full(len(part), _usual(part)) for part in parts])  # of each stretch
    least = max(UNLIKE_DEGREES, HELD_STEPS * rounding_step(values), _usual(jump), usual)
    chosen = (jump > np.maximum(least, noise)) & ~still
    if chosen.any():
        others = {
            n: v for n, v in columns.items() if n not in (name, "time") and v.dtype.kind == "f"
        }
        sizes = {n: _unexplained(v, time, own) for n, v in others.items()}
        leapt = {n: size > _usual(size) for n, size in sizes.items()}
        followed, set_anew = (
            np.any(
                [v for n, v in leapt.items() if (n in follow) == asked]
                or [np.zeros(len(at), bool)],
                axis=0,
            )
            for asked in (True, False)
        )
        chosen &= ~followed | set_anew
    rows = np.setdiff1d(at[chosen], leaps(values, own))
    if not len(rows) or len(rows) > LEAP_SHARE * len(values):
        return []
    said = (
        f"goes on from another level, {jump[np.isin(at, rows)].max():.2g} °C away, from one reading to the next, and "
        "nothing else does: re-seated, exchanged, or a counter that wrapped?"
    )
    return [Oddity(name, said, np.sort(rows), rows[:0], True)]  # on which side of it, is not known


def _unexplained(values: np.ndarray, time: np.ndarray, own: Sequence[np.ndarray]) -> np.ndarray:
    """Of each change from one reading to the next, what neither the rate before it nor the rate after it explains.

    These rates are medians of three changes, so that a corner of a profile, from one rate to another, is explained; and
    a third of it in a change next to it, so that a chamber's step that takes few readings is.
    """
    found = []
    for piece in own:
        change, step = np.diff(values[piece]), np.diff(time[piece])
        rate = np.where(step > 0, change / np.where(step > 0, step, 1.0), 0.0)
        wide = np.pad(rate, BESIDE, mode="edge")
        around = np.median(np.lib.stride_tricks.sliding_window_view(wide, BESIDE), axis=1)
        next_to = END_RATIO * np.pad(rate, 1, mode="edge")
        rates = [around[: len(rate)], around[BESIDE + 1 :], next_to[:-2], next_to[2:]]
        low, high = np.min(rates, axis=0) * step, np.max(rates, axis=0) * step
        found.append(np.maximum(np.maximum(change - high, low - change), 0.0))
    return np.concatenate(found)


def _usual(sizes: np.ndarray) -> float:
    """What noise makes of sizes, at the most."""
    noise = LEAP_NOISE_SD * 1.4826 * float(np.median(sizes))
    return max(noise, END_RATIO * float(np.quantile(sizes, USUAL_CHANGES_SHARE)))


def _at_an_end(name: str, values: np.ndarray, own: Sequence[np.ndarray]) -> list[Oddity]:
    """Readings in a row exactly at an extreme, of a column that hardly repeats elsewhere: a converter at its end."""
    found = []
    same = np.zeros(len(values), bool)
    for piece in own:
        same[piece[1:]] = values[piece[1:]] == values[piece[:-1]]
    for end, level in (("maximum", values.max()), ("minimum", values.min())):
        at = values == level
        there, elsewhere = (_longest(same & chosen, own) for chosen in (at, ~at))
        if there < max(SATURATED_READINGS, STUCK_RATIO * elsewhere):
            continue
        if np.mean(same[~at]) > REPEATED_SHARE:
            continue
        rows = np.flatnonzero(at)
        said = f"stands exactly at its {end} {level:g} in {len(rows)} readings, and hardly still elsewhere: saturated?"
        found.append(Oddity(name, said, rows, rows))
    return found


def _longest(same: np.ndarray, own: Sequence[np.ndarray]) -> int:
    """The most readings in a row that repeat the one before."""
    lengths = [np.diff(np.flatnonzero(np.r_[True, ~same[piece], True])) - 1 for piece in own]
    return int(max((one.max() for one in lengths), default=0))


def _unlike(columns: Columns, names: Collection[str]) -> list[Oddity]:
    """Runs in which one thermometer does not repeat what it did in another run, although its sibling does.

    Or each does what the other did: they are exchanged there. Siblings are thermometers that go together: on one body,
    or in one chamber, with whatever lag.
    """
    runs, found = _runs(columns), []
    if not 2 <= len(names) <= MOST_SIBLINGS or len(runs) > MOST_RUNS:
        return []
    pairs = [
        (a, b, _same_moments(columns["time"], runs[a], runs[b])) for a, b in combinations(runs, 2)
    ]
    for one, other in permutations(names, 2):
        odd, exchanged = {}, False
        for a, b, (here, there) in pairs:
            if len(here) < max(FEW_CHANGES, SAME_TIMES_SHARE * min(len(runs[a]), len(runs[b]))):
                continue
            apart, its = (_rms(columns[n][here] - columns[n][there]) for n in (one, other))
            pair = (one, other), (other, one)
            crossed = max(_rms(columns[m][here] - columns[n][there]) for m, n in pair)
            repeats_to = min(its, crossed)
            if repeats_to < REPEATS_RANGE * float(np.ptp(columns[other])):
                far = apart > max(UNLIKE_RATIO * repeats_to, UNLIKE_DEGREES)
                odd[a, b] = apart if far else 0.0
                exchanged |= far and crossed < its
        if not any(odd.values()) or not _siblings(columns, one, other, runs.values()):
            continue
        alone = [
            r for r in runs if (own := [v for pair, v in odd.items() if r in pair]) and all(own)
        ]
        if alone := _told_apart(columns, one, other, runs, alone):
            named = " or ".join(alone)
            how = "does: one of the two was different there"
            if exchanged:
                how = "does it there: they are exchanged"
            said = (
                f"does not repeat in run {named} what it did in the others, {max(odd.values()):.2g} °C rms apart, "
                f"where {other!r} {how}"
            )
            rows = np.concatenate([runs[run] for run in alone])
            known = len(alone) == 1 and _of_that_run_alone(columns, one, alone[0], pairs, odd, runs)
            found.append(Oddity(one, said, rows, rows if known else rows[:0]))
    return found


def _of_that_run_alone(
    columns: Columns,
    name: str,
    run: str,
    pairs: Iterable[tuple[str, str, tuple[np.ndarray, np.ndarray]]],
    odd: Collection[tuple[str, str]],
    runs: Mapping[str, np.ndarray],
) -> bool:
    """Whether a column that does not repeat in a run may be trusted in the others.

    If it does after a while what it does in a later run, it was changed in the midst of this one, and before it it may
    never have been right; likewise after it, if it did so at first. Runs that were compared are known to be alike.
    """
    compared = [(a, b, rows) for a, b, rows in pairs if (a, b) in odd and run in (a, b)]
    known = {r for a, b, _ in compared for r in (a, b)}
    begins = {r: float(columns["time"][rows].min()) for r, rows in runs.items()}
    before = any(begins[r] < begins[run] for r in runs if r not in known)
    after = any(begins[r] > begins[run] for r in runs if r not in known)
    for _, _, (here, there) in compared:
        apart, part = columns[name][here] - columns[name][there], max(1, len(here) // 4)
        quiet = [_rms(end) * UNLIKE_RATIO < _rms(apart) for end in (apart[:part], apart[-part:])]
        if quiet[0] != quiet[1] and (after if quiet[0] else before):
            return False
    return True


def _told_apart(
    columns: Columns, one: str, other: str, runs: Mapping[str, np.ndarray], suspects: list[str]
) -> list[str]:
    """That one of some runs without which a thermometer follows its sibling in all others alike; else all of them.

    Of two runs of one profile that differ, a third run of another profile tells which is right: of the sibling and its
    rate the thermometer is the same function in all that are.
    """
    if len(suspects) < 2 or len(runs) < 3:
        return suspects
    bases, values = {}, columns[one]
    for run, rows in runs.items():
        beside, since = columns[other][rows], columns["time"][rows]
        if len(rows) < 3 or np.any(np.diff(since) <= 0):
            return suspects
        bases[run] = np.column_stack([np.ones(len(rows)), beside, np.gradient(beside, since)])
    left = {}
    for run in suspects:
        rest = [r for r in runs if r != run]
        basis = np.concatenate([bases[r] for r in rest])
        scale = np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny)
        found = np.concatenate([values[runs[r]] for r in rest])
        left[run] = _rms(found - basis / scale @ np.linalg.lstsq(basis / scale, found)[0])
    best, second, *_ = sorted(left, key=left.__getitem__)
    return [best] if left[second] > UNLIKE_RATIO * left[best] else suspects


def _siblings(columns: Columns, one: str, other: str, runs: Iterable[np.ndarray]) -> bool:
    """Whether two thermometers go together, over ranges alike, in half of the runs at least."""
    moving = [
        r for r in runs if len(r) > 2 and np.ptp(columns[one][r]) and np.ptp(columns[other][r])
    ]
    found = [float(np.corrcoef(columns[one][r], columns[other][r])[0, 1]) for r in moving]
    wide = [float(np.ptp(columns[one][r]) / np.ptp(columns[other][r])) for r in moving]
    most = AS_WIDE_RATIO
    together = bool(found) and float(np.median(found)) > TOGETHER_CORRELATION
    return together and 1 / most < float(np.median(wide)) < most


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


Where = Callable[[int], str]  # index of a reading → "row 12 of 'tilt.csv'"


def problems_of_whole(
    converted: ConvertedColumns, instrument: Any, one_temperature: bool
) -> Objections:
    """What is wrong with readings as a whole: one temperature only, time that runs backwards.

    Args:
        converted: their columns.
        instrument: whose readings they are. Where it says which effects its baseline has, and none of them needs the
            temperature to change, it need not.
        one_temperature: accept one temperature all the same.
    """
    problems, files = Objections(), [table.file for table in converted.tables]
    effects = getattr(instrument, "effects", None)
    needed = effects is None or any("temperature" in effect.varies for effect in effects)
    required = any(c.name == "temperature" and c.required for c in instrument.columns)
    if needed and required and not one_temperature and "temperature" in converted.values:
        with problems.collecting(files[0]):
            refuse_one_temperature(converted.values, file_names([f for f in files if f != ARRAYS]))
    with problems.collecting(files[0]):
        refuse_backward_time(converted.values, row_namer(converted.tables))
    return problems


def row_namer(tables: Sequence[Table]) -> Where:
    """What names the file and row of a reading, of several tables one after the other."""
    ends = np.cumsum([table.rows for table in tables])

    def where(index: int) -> str:
        which = int(np.searchsorted(ends, index, side="right"))
        table = tables[which]
        return f"{table.place(index - int(ends[which]) + table.rows)} of {table.file!r}"

    return where


def refuse_one_temperature(columns: Columns, names: str) -> None:
    """Refuse readings that hold one temperature only.

    Args:
        columns: readings; `temperature` in °C.
        names: the files, for the message.

    Raises:
        InputError: the temperatures span less than `Settings.temperature_span`.
    """
    temperature = columns["temperature"]
    low, high = float(temperature.min()), float(temperature.max())
    if high - low < settings().temperature_span:
        seen = f"{low:g}" if low == high else f"{low:g} … {high:g}"
        cure = (
            "At least two are needed, or nothing that depends on temperature can be calibrated: add readings at "
            "another (files given together are read together)"
        )
        came = f"reads {seen} °C, one temperature only"
        said = f"{names}, column 'temperature': {came}. {cure}"  # of files, or of a device
        problem = Objection(names, came, cure=cure, column="temperature", sentence=said)
        raise InputError(said, (problem,))


def refuse_backward_time(columns: Columns, where: Where) -> None:
    """Refuse time that runs backwards within a run of a device and axis.

    Args:
        columns: readings; `time` in s.
        where: names a reading's file and row.

    Raises:
        InputError: it does, and where.
    """
    if "time" not in columns:
        return
    time = columns["time"]
    record = record_codes(columns)
    order = np.argsort(record, kind="stable")
    inner, step = np.diff(record[order]) == 0, np.diff(time[order])
    _refuse_clock_set(columns, order, inner, where)
    back = (step < 0) & inner
    if back.any():
        usual = float(np.median(step[inner & (step > 0)])) if (inner & (step > 0)).any() else 0.0
        period = next(
            (
                name
                for name, size in PERIODS.items()
                if np.all((step[back] + size > 0) & (step[back] + size <= PAUSE_STEPS * usual))
            ),
            "",
        )
        later = order[1:][back]
        index = int(later.min())
        before = int(order[np.flatnonzero(order == index)[0] - 1])
        labels = [f"{n} {columns[n][index]!s}" for n in ("run", "device", "axis") if n in columns]
        inside = f" within {', '.join(labels)}" if labels else ""
        cure = "Put the rows in the order in which they were taken, or give each record its own label in a column 'run'"
        came = f"reads {time[index]:.12g} s after {time[before]:.12g} s in {where(before)}: time runs backwards{inside}"
        places = tuple(where(int(i)).partition(" of ")[0] for i in np.sort(order[1:][back]))
        file = where(index).partition(" of ")[2].strip("'")
        undo = ""
        if period:
            came += f", as a clock does that begins anew at {period}"
            cure, undo = "Undo it, if that is so", option("--unwrap", f"time={period}")
        problem = Objection(file, came, cure=cure, option=undo, column="time", places=places)
        raise InputError(str(problem), (problem,))


def _refuse_clock_set(columns: Columns, order: np.ndarray, inner: np.ndarray, where: Where) -> None:
    """Refuse a record in which the time leaps by years: its clock was set, and no drift or lag over that is one."""
    time = columns["time"][order]
    step = np.where(inner, np.diff(time), 0.0)
    known = abs(step[step != 0])
    far = abs(step) > max(
        CLOCK_SET, CLOCK_SET_STEPS * float(np.median(known)) if known.size else 0.0
    )
    if not far.any():
        return
    at = int(np.argmax(far))
    row, years = int(order[1:][at]), step[at] / 3.156e7
    came = f"leaps by {years:.3g} years from {where(int(order[at]))} on, within one run: the clock was set there"
    cure = (
        "Correct the times, or give what stands before and behind it labels of their own in a column 'run' (where no "
        "time is needed, leave it out: --ignore time)"
    )
    place, _, file = where(row).partition(" of ")
    problem = Objection(file.strip("'"), came, cure=cure, column="time", places=(place,))
    raise InputError(str(problem), (problem,))


def flags_of(
    converted: ConvertedColumns, output: str, names: str, repeated: np.ndarray
) -> list[str]:
    """What is odd in the readings but no reason to refuse them.

    Args:
        converted: the readings.
        output: name of the output column.
        names: the files, for the flags.
        repeated: rows that repeat an earlier one.
    """
    columns, units, where = converted.values, converted.units, row_namer(converted.tables)
    thermometers = {name for name, unit in units.items() if unit == "degC"} - {MAY_BE_EMPTY}
    flags = []
    if count := len(repeated):
        first = int(repeated[0])
        many, dropped = count > 1, "time" in columns
        said = f"{count} row{'s repeat' if many else ' repeats'} an earlier one in every column"
        end = f": {'they are' if many else 'it is'} dropped" if dropped else ""
        flags.append(f"{said}, first at {where(first)}{end}")
    for end, level in clip_levels(columns[output]) if output in columns else ():
        count = int((columns[output] == level).sum())
        flags.append(
            f"{names}: column {output!r} may be saturated: {count} readings stand exactly at its {end} {level:g}"
        )
    flags += [
        f"{names}: each run has one {name} of its own: differences between runs and a dependence on it are confounded, "
        "parted by their plausible sizes alone. Let it change within a run, or repeat one in another run"
        for name in one_plateau_a_run(columns, thermometers)
    ]
    flags += [
        f"{names}: {share:.0%} of {output!r} in record {last!r} are the very numbers of record {first!r}: one record "
        "under two labels? Leave one out: copied readings count twice"
        for first, last, share in copied_records(columns, output)
    ]
    flags += [
        f"{names}: column {one.column!r} {one.said} (first at {where(int(one.rows[0]))})"
        for one in oddities(columns, thermometers, output)
    ]
    for name, values in columns.items():
        number = values.dtype.kind == "f" and name not in (
            *converted.filled,
            MAGNITUDE,
            ASSUMED_GRAVITY,
        )
        if number and len(values) > 1 and (values == values[0]).all():
            flags.append(f"{names}: column {name!r} is constant ({values[0]:g})")
        elif number and (stuck := stuck_rows(values, name in thermometers)) is not None:
            first, last = (where(row) for row in stuck)
            share = (stuck[1] - stuck[0] + 1) / len(values)
            much = f", {100 * share:.0f} % of all readings" if share > STUCK_SHARE else ""
            flags.append(
                f"{names}: column {name!r} stands still at {values[stuck[0]]:g} from {first} to {last}{much}: was it "
                "stuck?"
            )
    return flags + [f"{names}: {said}" for said in odd_numbers(columns, units, output)]


def one_plateau_a_run(columns: Columns, thermometers: Collection[str]) -> list[str]:
    """Thermometers that stand at one temperature in each run, another in each: run and slope are confounded."""
    if "run" not in columns:
        return []
    codes = label_codes(columns, ["run"])
    count = np.bincount(codes)
    found = []
    for name in thermometers if len(count) > 1 else ():
        values = columns[name]
        means = np.bincount(codes, values) / count
        within = float(np.sqrt(np.mean((values - means[codes]) ** 2)))
        apart = float(np.diff(np.sort(means)).min())
        if apart > max(PLATEAU_SD * within, settings().temperature_span):
            found.append(name)
    return found


def copied_records(columns: Columns, output: str) -> list[tuple[str, str, float]]:
    """Records that hold the outputs of an earlier one, number for number: which it is, which they are, what share.

    Noise does not repeat. Of an output so rounded that most numbers occur again, nothing can be said.
    """
    runs, values = _runs(columns), columns.get(output)
    if values is None or len(runs) < 2 or rounding_step(values):
        return []
    names, of = list(runs), record_codes(columns)
    _, first, same = np.unique(values, return_index=True, return_inverse=True)
    found = []
    for last, rows in enumerate(runs.values()):
        counts = np.bincount(of[first[same[rows]]], minlength=len(names))
        counts[last] = 0
        if (share := counts.max() / len(rows)) > COPIED_SHARE:
            found.append((names[counts.argmax()], names[last], share))
    return found


def stuck_rows(values: np.ndarray, thermometer: bool = False) -> tuple[int, int] | None:
    """First and last row of a stretch, far longer than any other, in which a column that else changes does not.

    Args:
        values: one for each reading.
        thermometer: whether half of all readings in one stretch suffice, however often the others repeat.
    """
    ends = np.append(np.flatnonzero(values[1:] != values[:-1]), len(values) - 1)
    lengths = np.diff(ends, prepend=-1)
    worst = int(np.argmax(lengths))
    length, others = int(lengths[worst]), np.delete(lengths, worst)
    if not others.size:
        return None
    again = int(np.sum(others - 1))  # readings outside that repeat the one before
    longest = int(np.max(others, initial=1))
    rounded = again > REPEATED_SHARE * int(np.sum(others))
    if rounded and thermometer and length >= STUCK_SHARE * len(values):
        rounded = False
    if rounded or length < max(STUCK_READINGS, STUCK_RATIO * longest):
        return None
    return int(ends[worst]) - length + 1, int(ends[worst])


def repeated_rows(columns: Columns) -> np.ndarray:
    """Rows that repeat an earlier one in every column: looked for among those whose hashes agree, to save memory."""
    bits = [_bits(values) for values in columns.values()]
    hashes = np.zeros(len(bits[0]), np.uint64)
    for own in bits:  # of SplitMix64 (G. Steele, D. Lea and C. Flood, OOPSLA 2014): its mixer
        hashes += own + np.uint64(0x9E3779B97F4A7C15)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            hashes = (hashes ^ (hashes >> np.uint64(shift))) * np.uint64(factor)
        hashes ^= hashes >> np.uint64(31)
    ordered = np.sort(hashes)
    alike = np.flatnonzero(np.isin(hashes, ordered[1:][ordered[1:] == ordered[:-1]]))
    rows = np.stack([own[alike] for own in bits], axis=1)
    return np.delete(alike, np.unique(rows, axis=0, return_index=True)[1])


def _bits(values: np.ndarray) -> np.ndarray:
    """Numbers as whole ones that are equal where these are, NaN and NaN too; labels as their numbers (n,)."""
    if values.dtype.kind != "f":
        return distinct([values])[1].astype(np.uint64)
    plain = np.where(values == values, values + 0.0, np.nan)  # −0 is 0
    return plain.astype(np.float64).view(np.uint64)


def clip_levels(values: np.ndarray) -> list[tuple[str, float]]:
    """Ends of the range at which an output was cut off, each with the level; empty where it looks natural."""
    levels, counts = np.unique(values, return_counts=True)
    if len(levels) < 3:
        return []
    found = []
    for end, beside, name in ((-1, -2, "maximum"), (0, 1, "minimum")):
        enough = max(CLIPPED_READINGS, CLIPPED_SHARE * len(values))
        with np.errstate(over="ignore"):
            near = abs(levels[end] - levels[beside]) < CLIPPED_GAP * (levels[-1] - levels[0])
        if near and counts[end] >= enough and counts[end] > CLIPPED_RATIO * counts[beside]:
            found.append((name, float(levels[end])))
    return found


def odd_numbers(columns: Columns, units: Mapping[str, str | None], output: str) -> list[str]:
    """What is odd in a record's numbers though each is a number, in words that begin with the column.

    Args:
        columns: readings by name.
        units: of the columns of numbers.
        output: name of the output column.
    """
    found = _of_size(columns[output], units[output] or "1", output) if output in columns else []
    if output in columns:
        found += _in_turn(columns, units, output)
    if "time" in columns:
        found += [*_of_time(columns), *_of_pauses(columns)]
    if "run" in columns and len(columns["run"]) >= COUNTED_RUNS:
        runs = columns["run"]
        if len(set(runs.tolist())) == len(runs):
            found.append(
                f"column 'run' gives each of the {len(runs)} readings a run of its own: nothing goes on from one to "
                "the next, and no rate, lag or correlation is seen. Is it a counter? Leave it out, or label the runs"
            )
        elif output in columns:
            found += _of_first_readings(columns, output)
    return found


def _of_size(values: np.ndarray, unit: str, name: str) -> list[str]:
    with np.errstate(over="ignore"):
        reach = float(np.ptp(values))
    for base, least, most in OUTPUT_RANGES:
        if unit == "any" or base_unit(unit) != base_unit(base):
            continue
        with np.errstate(over="ignore"):
            size = float(abs(convert([reach], unit, base)[0]))
        if reach > 0 and not least <= size <= most:
            small = size < least
            return [
                f"column {name!r} covers {reach:.2g} {unit_label(unit)} in all, {'less' if small else 'more'} than any "
                f"sensor {'resolves' if small else 'measures'} ({least if small else most:g} {base}): check its unit "
                "and its scale (--unit, --nominal-scale)"
            ]
    return []


def _in_turn(columns: Columns, units: Mapping[str, str | None], output: str) -> list[str]:
    """Readings at even distances that lie apart from their neighbours; none where a column was set as often."""
    values = columns[output][:PERIODIC_LOOKED]
    if len(values) < PERIODIC_READINGS * PERIODIC_ROWS[0]:
        return []

    def apart(column: np.ndarray) -> np.ndarray:
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(column, 2, mode="reflect"), 5)
        return np.abs(column - np.median(windows, axis=1))

    off = apart(values)
    # of normal noise seven tenths lie within about one standard deviation of the median of five
    rows = np.flatnonzero(off > PERIODIC_SD * max(float(np.quantile(off, 0.7)), 1e-300))
    if len(rows) < PERIODIC_READINGS:
        return []
    period = int(np.median(np.diff(rows)))
    places = np.arange(int(np.median(rows % period)) if period else 0, len(values), max(period, 1))
    held, low, high = np.isin(rows, places), *PERIODIC_ROWS
    if not low <= period <= high or min(held.mean(), held.sum() / len(places)) < PERIODIC_SHARE:
        return []
    for name in columns.keys() - {output, "time"}:
        own = columns[name] if units.get(name) else label_codes(columns, [name])
        changes = np.count_nonzero(own[1:] != own[:-1])
        if (
            units.get(name) != "degC"
            and len(np.unique(own)) < len(own) / 2
            and changes * 2 * period > len(own)
        ):
            return []  # something was set as often
    return [
        f"column {output!r}: every {period}th reading lies {np.median(off[rows[held]]):.3g} from its neighbours, "
        f"{int(held.sum())} in all: another channel of the logger, or read while it switched? Leave these rows out"
    ]


def _of_time(columns: Columns) -> list[str]:
    time, codes = columns["time"], record_codes(columns)
    same = (time[1:] == time[:-1]) & (codes[1:] == codes[:-1])
    share = float(np.mean(same)) if len(same) else 0.0
    if share < SAME_TICK_SHARE:
        return []
    steps = np.diff(np.unique(time))
    step = f" Its values are {np.min(steps):.3g} s apart at the least." if len(steps) else ""
    return [
        f"column 'time' has too few digits, or a coarse clock: {share:.0%} of the readings have the time of the one "
        f"before.{step} Rates and lags within that are lost: record it with more digits"
    ]


def _of_pauses(columns: Columns) -> list[str]:
    """A pause in one record that no other of as many readings, hence of one plan, makes there: the clock was set."""
    time, found = columns["time"], list[str]()
    records = {n: r[np.argsort(time[r], kind="stable")] for n, r in _runs(columns).items()}
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
            found.append(
                f"column 'time' makes a pause of {following - last:.3g} s in {name!r}, after {last:.12g} s, and in no "
                "other record of as many readings: was the clock set there? Lags, rates and drifts hang on it"
            )
    return found


def _of_first_readings(columns: Columns, output: str) -> list[str]:
    """Where every run begins with one and the same output, exactly, that hardly occurs elsewhere."""
    runs, values = columns["run"], columns[output]
    _, first = np.unique(runs, return_index=True)
    level = values[first[0]]
    count = int(np.count_nonzero(values == level))
    if len(first) < 2 or not np.all(values[first] == level) or count > len(first):
        return []
    return [
        f"column {output!r} reads exactly {level:g} at the first reading of every run: was it set there, or does a "
        "filter in the logger (a high-pass) begin so? What the output was before that filter is not known"
    ]
