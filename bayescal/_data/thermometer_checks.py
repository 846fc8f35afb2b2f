"""Thermometers are checked against time and against each other: a thermometer is a measurement too.

A body's temperature goes at a pace. What departs from it is an error value, a spike, or another level; a logger that
asks its thermometer seldom repeats a value between two leaps; a converter at its end stays there while the body goes
on; and two thermometers on one body do in a run what they do in the others. What departs from that is said by name, row
and run: nothing in a fit shows it where profiles repeat.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from bayescal._data.records import RECORD, Columns, equal_runs, pieces, record_codes, runs_of

# "Good records" are the campaigns that the six instruments simulate, as they are, rounded as displays do, and noisy
# (tests/readings/test_thermometers.py).
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
    off &= (
        edge[begins] | edge[ends] | (lengths <= BESIDE)
    )  # else the output, or a standstill, ends it
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
    for run in runs:
        rest = [rows for r, rows in runs.items() if r != run]
        rate = np.concatenate([np.gradient(sibling[rows], time[rows]) for rows in rest])
        rows = np.concatenate(rest)
        basis = np.column_stack([np.ones(len(rows)), sibling[rows], rate])
        basis /= np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny)
        left[run] = _rms(columns[one][rows] - basis @ np.linalg.lstsq(basis, columns[one][rows])[0])
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
PERIODS = sorted({2.0**bits * size for bits in range(4, 21) for size in (1.0, 0.1, 0.01, 0.001)})
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
    codes = record_codes({n: columns[n] for n in RECORD if n in columns} or {"": 0.0 * values})
    low, high = float(values.min()), float(values.max())
    change = np.where(np.diff(codes) == 0, np.abs(np.diff(values)), 0.0)
    for period in (p for p in PERIODS if p >= max(LEAST_PERIOD, high - low)):
        begin = 0.0 if period not in SIGNED or low >= 0 else -0.5 * period
        wraps = (change > 0.5 * period) & (allowed < PART * period)
        inside = begin <= low and high <= begin + period
        if inside and wraps.any() and np.all(period - change[wraps] <= allowed[wraps]):
            beyond = np.round((unwrap(values, codes, period, ROOM) - values) / period)
            levels, counts = np.unique(beyond, return_counts=True)
            if len(np.unique(values[beyond != levels[np.argmax(counts)]])) >= LEAST_LEVELS:
                return period
    return None
