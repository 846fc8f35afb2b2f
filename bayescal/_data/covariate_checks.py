"""Checks of thermometers against time and against each other: a thermometer is a measurement too.

A body's temperature goes smoothly, and does not leap there and back from one reading to the next. A logger that asks
its thermometer seldom repeats a value between two leaps; a converter at its end stays there while the body goes on; and
two thermometers on one body do in a run what they do in the others. What departs from that is said by name, row and
run: nothing in a fit shows it where profiles repeat.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from bayescal._data.record_settings import recording
from bayescal._data.stretches import (
    RECORD,
    Columns,
    members,
    record_codes,
    rounding_step,
    stretches,
)

BESIDE = 3  # changes on either side of one, of which the median is the rate there: one of them may be odd
MOST_RUNS, MOST_SIBLINGS = 30, 8  # compared two by two: 435 pairs of runs, 56 of thermometers


class Oddity(NamedTuple):
    """What is odd in a thermometer's column, in words, and in which rows."""

    column: str
    said: str
    rows: np.ndarray


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
            for find, said in _RECORDED.items():
                if len(rows := find(columns[name], own)):
                    found.append(Oddity(name, said.format(len(rows)), rows))
            found += _at_an_end(name, columns[name], own)
            found += _jumps(name, columns, {*thermometers, output}, own)
        return [*found, *_unlike(columns, names)]


def leaps(values: np.ndarray, own: Sequence[np.ndarray]) -> np.ndarray:
    """Rows at which a column leaps there and back, or begins or ends a run elsewhere: faster than a body can follow.

    Args:
        values: of the column (n,).
        own: rows of each stretch without a pause, by `pieces`.
    """
    given, jumps = recording(), [np.diff(values[piece]) for piece in own]
    if sum(map(len, jumps)) < given.few_changes or len(np.unique(values)) < given.levels:
        return np.zeros(0, int)
    back = [_there_and_back(jump) for jump in jumps]
    size = np.abs(np.concatenate(jumps))
    usual = max(
        given.leap * float(np.ptp(values)),
        given.leap_noise * 1.4826 * float(np.median(np.concatenate(back))),
        given.leap_excess * float(np.quantile(size, given.most)),
        given.held_step * rounding_step(values),
    )
    rows = []
    for piece, jump, both in zip(own, jumps, back, strict=True):
        spike = np.pad(_highest(both, usual), 1)
        rows.append(piece[spike])
        inner = np.abs(jump[1:-1])[~(spike[1:-2] | spike[2:-1])]
        apart = np.abs(jump[[0, -1]]) > max(usual, given.end_excess * float(inner.max(initial=0.0)))
        rows.append(piece[[0, -1]][apart & ~spike[[1, -2]]])
    found = np.unique(np.concatenate(rows))
    return found if len(found) <= given.leap_share * len(values) else found[:0]


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
    given, held, pairs = recording(), [np.zeros(0, int)], 0
    leap = given.held_step * float(np.diff(np.unique(values)).min())
    for piece in own:
        cells = values[piece]
        ends = np.append(np.flatnonzero(cells[1:] != cells[:-1]), len(cells) - 1)
        repeated = np.diff(ends, prepend=-1) > 1
        pair = repeated[:-1] & repeated[1:] & (np.abs(np.diff(cells[ends])) > leap)
        if pair.any() and pair.mean() > given.held_share:
            held.append(piece)
            pairs += int(np.count_nonzero(pair))
    return np.concatenate(held) if pairs >= given.held_times else held[0]


_RECORDED = {
    leaps: "leaps faster than a body can follow at {} reading(s)",
    held_rows: "repeats a value until the next leap: it was held, or asked seldom",
}


def _jumps(
    name: str, columns: Columns, follow: Collection[str], own: Sequence[np.ndarray]
) -> list[Oddity]:
    """Where a column goes on from another level at once: no body does, but a thermometer that was set there.

    Where the output, or another thermometer, goes on from another level too, it was the body, and readings are far
    apart; unless an input was set anew there. Values that stand still before and after are set-points, written down as
    they were set. `follow` are the columns that follow a body, this one among them.
    """
    given, values = recording(), columns[name]
    own = [piece for piece in own if len(piece) > 2 * BESIDE + 1]
    changes = [np.diff(values[piece]) for piece in own]
    if sum(map(len, changes)) < given.few_changes or len(np.unique(values)) < given.levels:
        return []
    time, at = columns["time"], np.concatenate([piece[1:] for piece in own])
    flat = [np.pad(change == 0, 1, constant_values=True) for change in changes]
    still = np.concatenate([one[:-2] & one[2:] for one in flat])
    jump = _unexplained(values, time, own)
    # a rounded corner leaves less
    usual = float(np.quantile(np.abs(np.concatenate(changes)), given.most))
    parts = np.split(jump, np.cumsum([len(change) for change in changes])[:-1])
    noise = np.concatenate([np.full(len(part), _usual(part)) for part in parts])  # of each stretch
    least = max(given.unlike_least, given.held_step * rounding_step(values), _usual(jump), usual)
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
    if not len(rows) or len(rows) > given.leap_share * len(values):
        return []
    said = (
        f"goes on from another level, {jump[np.isin(at, rows)].max():.2g} °C away, from one reading to the next, and "
        "nothing else does: re-seated, exchanged, or a counter that wrapped?"
    )
    return [Oddity(name, said, np.sort(rows))]


def _unexplained(values: np.ndarray, time: np.ndarray, own: Sequence[np.ndarray]) -> np.ndarray:
    """Of each change from one reading to the next, what neither the rate before it nor the rate after it explains.

    These rates are medians of three changes, so that a corner of a profile, from one rate to another, is explained.
    """
    found = []
    for piece in own:
        change, step = np.diff(values[piece]), np.diff(time[piece])
        rate = np.where(step > 0, change / np.where(step > 0, step, 1.0), 0.0)
        wide = np.pad(rate, BESIDE, mode="edge")
        around = np.median(np.lib.stride_tricks.sliding_window_view(wide, BESIDE), axis=1)
        before, after = around[: len(rate)], around[BESIDE + 1 :]
        found.append(np.minimum(abs(change - before * step), abs(change - after * step)))
    return np.concatenate(found)


def _usual(sizes: np.ndarray) -> float:
    """What noise makes of sizes, at the most."""
    given = recording()
    noise = given.leap_noise * 1.4826 * float(np.median(sizes))
    return max(noise, given.end_excess * float(np.quantile(sizes, given.most)))


def _at_an_end(name: str, values: np.ndarray, own: Sequence[np.ndarray]) -> list[Oddity]:
    """Readings in a row exactly at an extreme, of a column that hardly repeats elsewhere: a converter at its end."""
    given, found = recording(), []
    same = np.zeros(len(values), bool)
    for piece in own:
        same[piece[1:]] = values[piece[1:]] == values[piece[:-1]]
    for end, level in (("maximum", values.max()), ("minimum", values.min())):
        at = values == level
        there, elsewhere = (_longest(same & chosen, own) for chosen in (at, ~at))
        if there < max(given.saturated, given.stuck_excess * elsewhere):
            continue
        if np.mean(same[~at]) > given.repeated:
            continue
        rows = np.flatnonzero(at)
        said = f"stands exactly at its {end} {level:g} in {len(rows)} readings, and hardly still elsewhere: saturated?"
        found.append(Oddity(name, said, rows))
    return found


def _longest(same: np.ndarray, own: Sequence[np.ndarray]) -> int:
    """The most readings in a row that repeat the one before."""
    lengths = [np.diff(np.flatnonzero(np.r_[True, ~same[piece], True])) - 1 for piece in own]
    return int(max((one.max() for one in lengths), default=0))


def _unlike(columns: Columns, names: Collection[str]) -> list[Oddity]:
    """Runs in which one thermometer does not repeat what it did in another run, although its sibling does.

    Siblings are thermometers that go together: on one body, or in one chamber, with whatever lag.
    """
    runs, found, given = _runs(columns), [], recording()
    if not 2 <= len(names) <= MOST_SIBLINGS or len(runs) > MOST_RUNS:
        return []
    pairs = [
        (a, b, _same_moments(columns["time"], runs[a], runs[b])) for a, b in combinations(runs, 2)
    ]
    for one, other in permutations(names, 2):
        odd = {}
        for a, b, (here, there) in pairs:
            if len(here) < max(
                given.few_changes, given.same_times * min(len(runs[a]), len(runs[b]))
            ):
                continue
            apart, its = (_rms(columns[n][here] - columns[n][there]) for n in (one, other))
            if its < given.repeats * float(np.ptp(columns[other])):
                odd[a, b] = apart if apart > max(given.unlike * its, given.unlike_least) else 0.0
        if not any(odd.values()) or not _siblings(columns, one, other, runs.values()):
            continue
        alone = [
            r for r in runs if (own := [v for pair, v in odd.items() if r in pair]) and all(own)
        ]
        if alone:
            named = " or ".join(alone)
            said = (
                f"does not repeat in run {named} what it did in the others, {max(odd.values()):.2g} °C rms apart, "
                f"where {other!r} does: one of the two was different there"
            )
            found.append(Oddity(one, said, np.concatenate([runs[run] for run in alone])))
    return found


def _siblings(columns: Columns, one: str, other: str, runs: Iterable[np.ndarray]) -> bool:
    """Whether two thermometers go together, over ranges alike, in half of the runs at least."""
    moving = [
        r for r in runs if len(r) > 2 and np.ptp(columns[one][r]) and np.ptp(columns[other][r])
    ]
    found = [float(np.corrcoef(columns[one][r], columns[other][r])[0, 1]) for r in moving]
    wide = [float(np.ptp(columns[one][r]) / np.ptp(columns[other][r])) for r in moving]
    most = recording().as_wide
    together = bool(found) and float(np.median(found)) > recording().together
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
