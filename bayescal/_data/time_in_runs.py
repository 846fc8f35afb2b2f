"""Time: its zero for readings beside a calibration, which readings make a run, and a column's slope over a minute."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import InputError
from bayescal._data.measurements import Measurements
from bayescal._data.records import PAUSE_STEPS, distinct
from bayescal._tables.cells import date_text
from bayescal._tables.raw_table import option

# Changes from one record to the other, a reading, beyond which two lie in one time and neither goes on with the other.
INTERLEAVED_SHARE = 0.2
# Windows of a rate (a minute each) without a reading, after which a rate is not known: the change over hours, such as
# a soak before a tumble, says nothing of the rate now.
SILENCE_WINDOWS = 10.0
# Of the usual step, by which others may differ where steps are to be even: time stamps jitter.
EVEN_STEPS = 0.05
RATE_WINDOW = 60.0  # s
# Of a change, that those on both sides of a step that was set are at the most; and the share of all changes, in
# squares, that such steps are where a column was set.
ALONE_RATIO, SET_SHARE = 0.1, 0.9


def run_codes(readings: Measurements) -> tuple[tuple[str, ...], np.ndarray]:
    """Return records in time, one for each run of each device and axis, and which of them each reading is of."""
    names = [n for n in ("axis", "device") if readings.has(n)]
    runs, codes = readings.groups("run")
    levels, codes = distinct([*(readings[n] for n in names), np.array(runs)[codes]])
    return tuple("|".join(map(str, level)) for level in levels), codes


def sequence(time: np.ndarray, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The order of time within runs, and the time since the previous reading of the run, −1 at its first."""
    order = np.lexsort((time, codes))
    step = np.diff(time[order], prepend=time[order][:1])
    step[np.diff(codes[order], prepend=-1) != 0] = -1.0
    return order, step


def set_in_steps(values: np.ndarray, order: np.ndarray, step: np.ndarray) -> bool:
    """Return whether a column was set from time to time and stood between, as a load does, not measured on its way.

    Nearly all that it changes by, in squares, are changes beyond which and before which it hardly does. `order` and
    `step` as `sequence` returns them.
    """
    change = np.where(step[1:] < 0, 0.0, np.abs(np.diff(values[order])))
    padded = np.pad(change, 1)
    alone = np.maximum(padded[:-2], padded[2:]) < ALONE_RATIO * change
    whole = float(np.sum(change**2))
    return whole > 0 and float(np.sum(change[alone] ** 2)) > SET_SHARE * whole


def run_starts(readings: Measurements, record: Measurements | None = None) -> np.ndarray:
    """Return when each run of the readings began, s: at its first reading, or with the run of a record that it is of.

    A run is of the record where that has one of its name (and device and axis) whose readings, or the pause after
    them, hold its first reading; a run of the same name on another day is another run.
    """
    (names, codes), time = run_codes(readings), readings["time"]
    first = np.full(len(names), np.inf)
    np.minimum.at(first, codes, time)
    if record is not None and record.has("time"):
        for i, (_, known) in _known_runs(record, readings).items():
            pause = PAUSE_STEPS * _usual_step(known)
            if known[0] <= first[i] <= known[-1] + pause:
                first[i] = known[0]
    return first


def _known_runs(record: Measurements, readings: Measurements) -> dict[int, tuple[str, np.ndarray]]:
    """Return name and sorted times of the record's runs, by the index of the run of that name in the readings."""
    (names, codes), (asked, _) = run_codes(record), run_codes(readings)
    return {
        i: (name, np.sort(record["time"][codes == names.index(name)]))
        for i, name in enumerate(asked)
        if name in names
    }


def _usual_step(times: np.ndarray) -> float:
    return float(np.median(np.diff(times))) * (1 + 1e-9) if times.size > 1 else 0.0


def on_clock(
    readings: Measurements, epoch: float | None, changing: Callable[[], str]
) -> Measurements:
    """Return readings with their times counted from a calibration's `epoch`, s since 1970; None where it has no dates.

    Times without dates count from the calibration's zero where that has no date either: a column `time` has one origin
    over all runs. `changing` gives what changes with the date, for the message; empty for nothing.

    Raises:
        InputError: one has dates and the other has none, and something changes with the date.
    """
    if not readings.has("time") or readings.since == epoch:
        return readings
    if readings.since is not None and epoch is not None:
        time = np.round(readings["time"] + (readings.since - epoch), 6)
        return replace(readings.with_column("time", time), since=epoch)
    if not (names := changing()):
        return readings
    dated = f"counts time from {date_text(epoch)}" if epoch is not None else "has no dates"
    own, example = ("no dates", "2026-05-13 10:14:20") if epoch is not None else ("dates", "9 days")
    of = readings.sources[0].file if len(readings.sources) == 1 else "FILE"
    raise InputError(
        f"{readings.file}: its times have {own}, the calibration {dated}; with the date changes {names}. Say "
        f"when its first reading was taken{' on the clock of the calibration' * (epoch is None)}: "
        f"{option('--begin', f'{of}={example}')} (in Python, begin={example!r} where it is read)"
    )


def going_on(fitted: Measurements, later: Measurements) -> dict[str, np.ndarray]:
    """Return which readings of which runs go on with a record that is known: rows of `later` by run.

    They have the run's name (and device and axis), and follow its readings in blocks, the first of them at once. A file
    of another test, whose clock begins anew, has times that fall among all of the record's, or far from them.
    """
    if not (fitted.has("time") and later.has("time")) or fitted.since != later.since:
        return {}
    at, own, found = later["time"], run_codes(later)[1], {}
    for i, (name, known) in _known_runs(fitted, later).items():
        rows = np.flatnonzero(own == i)
        first = float(at[rows].min())
        before = known[known < first]
        if not before.size or known.size < 2 or np.isin(at[rows], known).any():
            continue
        merged = np.concatenate([np.zeros(known.size, bool), np.ones(rows.size, bool)])
        merged = merged[np.argsort(np.concatenate([known, at[rows]]), kind="stable")]
        most = max(2.0, INTERLEAVED_SHARE * min(known.size, rows.size))
        apart = np.count_nonzero(np.diff(merged)) <= most
        if apart and first - before[-1] <= PAUSE_STEPS * _usual_step(known):
            found[name] = rows
    return found


def rate_window(step: np.ndarray) -> float:
    """The time, s, whose slope a rate is: a minute, or the usual step between readings, if longer."""
    steps = step[step > 0]
    return max(RATE_WINDOW, float(np.median(steps)) if steps.size else 0.0)


def silence(step: np.ndarray) -> float:
    """Time without a reading, s, beyond which it is not known how a quantity went from one to the next."""
    return SILENCE_WINDOWS * rate_window(step)


def causal_slope(
    time: np.ndarray, values: np.ndarray, order: np.ndarray, step: np.ndarray
) -> np.ndarray:
    """Least-squares slope over the last minute (or the last step, if longer) within each run, unit/s.

    The first reading of a run has no past and gets 0; so does the first after a gap of ten windows, such as the
    soak before a tumble, for the change over hours says nothing of the rate now. Linear in the readings.
    """
    t, y, here = time[order], values[order], np.arange(time.size)
    window = rate_window(step) * (1 + 1e-9)
    first = np.empty(t.size, dtype=int)  # reading of each window, one of an earlier time at least
    for low, high in itertools.pairwise([*np.flatnonzero(step < 0), t.size]):
        own = t[low:high]
        earlier = np.searchsorted(own, own) - 1
        first[low:high] = low + np.clip(np.searchsorted(own, own - window), 0, earlier.clip(0))
    of_t, of_y, of_tt, of_ty = _window_sums(t, y, first)
    count = here - first + 1
    scatter = of_tt - of_t**2 / count
    known = (first < here) & (scatter > 0) & (t - t[first] <= silence(step) * (1 + 1e-9))
    slopes = np.zeros_like(y)
    slopes[order[known]] = (of_ty - of_t * of_y / count)[known] / scatter[known]
    return slopes


def recursion(
    share: Float[np.ndarray, "*s n"], push: Float[np.ndarray, "*s n"]
) -> Float[np.ndarray, "*s n"]:
    """Return x of xᵢ = shareᵢ·xᵢ₋₁ + pushᵢ, from zero: a unit bidiagonal matrix, LAPACK's banded solver."""
    from scipy.linalg.lapack import dtbtrs, ztbtrs  # only what computes loads SciPy

    share, push = np.broadcast_arrays(share, push)
    solve = ztbtrs if np.iscomplexobj(share) else dtbtrs
    # All recursions are one, which begins anew at the first element of each.
    band = np.ones((share.size, 2), share.dtype)
    np.negative(share.reshape(-1)[1:], out=band[:-1, 1])
    band[share.shape[-1] - 1 :: share.shape[-1], 1] = 0.0
    return solve(band.T, push.reshape(-1), uplo="L", diag="U")[0].reshape(push.shape)


def _window_sums(t: np.ndarray, y: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Sums of dt, dy, dt² and dt·dy over the readings first[i] … i, for each i; `first` rises.

    An anchor stands in each window: the sums grow away from it on either side, dt and dy are distances from it, and
    nothing is ever subtracted from a sum, so no digits are lost however long the record.
    """
    here = np.arange(t.size)
    beyond = np.searchsorted(first, here, side="right")  # the first window without this reading
    anchors = [0]
    while (after := int(beyond[anchors[-1]])) < t.size:
        anchors.append(after)
    stretch = np.searchsorted(anchors, here, side="right") - 1
    at, after = np.array(anchors)[stretch], np.array([*anchors[1:], t.size - 1])[stretch]

    def sums(origin: np.ndarray, rows: slice) -> np.ndarray:  # of each stretch, in this direction
        dt, dy = t - t[origin], y - y[origin]
        terms = np.stack([dt, dy, dt * dt, dt * dy])[:, rows]
        same = np.diff(stretch[rows], prepend=-1) == 0
        return recursion(same.astype(float), terms)[:, rows]

    since, until = sums(at, slice(None)), sums(after, slice(None, None, -1))
    return since + np.where(first < at, until[:, first], 0.0)
