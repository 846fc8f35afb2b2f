"""Records in time: their readings, their stretches without a pause, and a column's slope within one."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

Columns = Mapping[str, np.ndarray]

RECORD = ("device", "axis", "run")  # columns of labels that identify a record in time
# Usual steps between readings, beyond which the next one is no neighbour; a logger that loses four readings in a row
# has not paused.
PAUSE_STEPS = 5.0
RATE_WINDOW = 60.0  # s
# Share of the usual step, by which others may differ where steps are to be even: time stamps jitter.
EVEN_STEPS = 0.05
# Windows of a rate (a minute each) without a reading, after which a rate is not known: a change over hours, such as
# a soak before a tumble, does not determine the rate now.
SILENCE_WINDOWS = 10.0
# Largest ratio to a step that was set, of the changes on either side of it; and the least share of the sum of squared
# changes that such steps make up where a column was set.
MAX_NEIGHBOUR_RATIO, MIN_SET_SHARE = 0.1, 0.9


def distinct(columns: Sequence[np.ndarray]) -> tuple[list[tuple[Any, ...]], np.ndarray]:
    """Return the distinct rows of columns, in the order in which they first appear, and the index of each row.

    By a dictionary of the first rows of stretches, since labels stay the same for long, and pandas takes half a second
    to load.
    """
    begins = np.ones(len(columns[0]), bool)
    begins[1:] = np.any([values[1:] != values[:-1] for values in columns], axis=0)
    first, codes = np.flatnonzero(begins), dict[tuple[Any, ...], int]()
    rows = zip(*(values[first].tolist() for values in columns), strict=True)
    indices = np.fromiter((codes.setdefault(row, len(codes)) for row in rows), np.int64, len(first))
    return list(codes), np.repeat(indices, np.diff(first, append=len(begins)))


def label_codes(columns: Columns, names: Collection[str]) -> np.ndarray:
    """Number the combinations of labels in the order in which they first appear; NaN is one of them."""
    labels = [columns[n] for n in names]
    labels = [np.where(v == v, v.astype(object), "") if v.dtype.kind == "f" else v for v in labels]
    return distinct(labels)[1] if labels else np.zeros(len(next(iter(columns.values()))), np.int64)


def equal_runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the begin and the length of each stretch of equal values."""
    begins = np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]]))
    return begins, np.diff(begins, append=len(values))


@dataclass(frozen=True, eq=False)
class Records:
    """Records in time: each run of each device and axis.

    Attributes:
        names: of its axis, its device and its run, "1" where there is no such column.
        codes: index of each reading's record (n,).
        time: of each reading, s (n,); empty without a column `time`.
    """

    names: tuple[str, ...]
    codes: np.ndarray
    time: np.ndarray

    @classmethod
    def of(cls, columns: Columns) -> Records:
        """Group the rows of columns into records, by their labels."""
        codes = label_codes(columns, [n for n in RECORD if n in columns])
        first = np.flatnonzero(np.diff(np.maximum.accumulate(codes), prepend=-1))
        labels = [columns[n][first] for n in ("axis", "device") if n in columns]
        labels.append(columns["run"][first] if "run" in columns else np.ones(len(first), int))
        names = tuple("|".join(map(str, label)) for label in zip(*labels, strict=True))
        return cls(names, codes, columns.get("time", np.zeros(0)))

    @cached_property
    def rows(self) -> list[np.ndarray]:
        """Return the rows of each record, in the order of the file."""
        order = np.argsort(self.codes, kind="stable")
        ends = 1 + np.flatnonzero(np.diff(self.codes[order]))
        return np.split(order, ends) if self.codes.size else []

    @cached_property
    def order(self) -> np.ndarray:
        """Return the order of time within records (n,); that of the file where there is no time."""
        has_time = self.time.size
        return np.lexsort((self.time, self.codes)) if has_time else np.arange(self.codes.size)

    @cached_property
    def step(self) -> np.ndarray:
        """Return the time since the record's previous reading, s, in `order`; −1 at its first or without time (n,)."""
        if not self.time.size:
            return -np.ones(self.codes.size)
        time = self.time[self.order]
        step = np.diff(time, prepend=time[:1])
        step[np.diff(self.codes[self.order], prepend=-1) != 0] = -1.0
        return step

    @cached_property
    def in_time(self) -> list[np.ndarray]:
        """Return the rows of each record, in the order of time."""
        return np.split(self.order, np.flatnonzero(self.step < 0)[1:])

    def stretches(self, fewest: int = 3) -> list[np.ndarray]:
        """Return the rows of each stretch without a pause, of `fewest` readings or more, in the order of time."""
        pieces = []
        for rows in self.in_time:
            steps = np.diff(self.time[rows])
            usual = np.median(steps) if steps.size else 0.0
            pieces += np.split(rows, 1 + np.flatnonzero(steps > PAUSE_STEPS * usual))
        return [rows for rows in pieces if len(rows) >= fewest]

    def starts(self, record: Records | None = None) -> np.ndarray:
        """Return the start of each, s: of its first reading, or of the fitted run (in `record`) that it continues.

        It continues one of its name (and device and axis) whose readings, or the pause after them, include its first
        reading; a run of the same name on another day is another run.
        """
        first = np.full(len(self.names), np.inf)
        np.minimum.at(first, self.codes, self.time)
        if record is not None and record.time.size:
            for i, (_, times) in self.matching_records(record).items():
                pause = PAUSE_STEPS * usual_step(times)
                if times[0] <= first[i] <= times[-1] + pause:
                    first[i] = times[0]
        return first

    def matching_records(self, record: Records) -> dict[int, tuple[str, np.ndarray]]:
        """Return name and sorted times of other records, by the index of the record of the same name here."""
        return {
            i: (name, record.time[record.in_time[record.names.index(name)]])
            for i, name in enumerate(self.names)
            if name in record.names
        }

    def elapsed(self, record: Records | None = None) -> np.ndarray:
        """Return the time since the start of each reading's record, s (n,); `record` as of `starts`."""
        return self.time - self.starts(record)[self.codes]

    @property
    def silence(self) -> float:
        """Return the longest time between readings, s, over which a quantity may be interpolated."""
        return SILENCE_WINDOWS * rate_window(self.step)

    def set_in_steps(self, values: np.ndarray) -> bool:
        """Return whether a column was set in steps and constant between, as a load, rather than measured as it changed.

        Nearly all of the sum of its squared changes is then in changes whose neighbours hardly change it.
        """
        change = np.where(self.step[1:] < 0, 0.0, np.abs(np.diff(values[self.order])))
        padded = np.pad(change, 1)
        alone = np.maximum(padded[:-2], padded[2:]) < MAX_NEIGHBOUR_RATIO * change
        whole = float(np.sum(change**2))
        return whole > 0 and float(np.sum(change[alone] ** 2)) > MIN_SET_SHARE * whole

    def slope(self, values: np.ndarray) -> np.ndarray:
        """Return the least-squares slope over the last minute (or the last step, if longer) of each record, unit/s.

        The first reading of a record has no past and gets 0; so does the first after a silence, such as the soak before
        a tumble, as a change over hours does not determine the rate now. Linear in the readings.
        """
        t, y, index = self.time[self.order], values[self.order], np.arange(self.time.size)
        window = rate_window(self.step) * (1 + 1e-9)
        first = np.empty(t.size, dtype=int)  # reading of each window
        for low, high in itertools.pairwise([*np.flatnonzero(self.step < 0), t.size]):
            times = t[low:high]
            last = (np.searchsorted(times, times) - 1).clip(0)  # of an earlier time at least
            first[low:high] = low + np.clip(np.searchsorted(times, times - window), 0, last)
        of_t, of_y, of_tt, of_ty = _window_sums(t, y, first)
        count = index - first + 1
        scatter = of_tt - of_t**2 / count
        valid = (first < index) & (scatter > 0) & (t - t[first] <= self.silence * (1 + 1e-9))
        slopes = np.zeros_like(y)
        slopes[self.order[valid]] = (of_ty - of_t * of_y / count)[valid] / scatter[valid]
        return slopes


def usual_step(times: np.ndarray) -> float:
    """Return the median step between sorted times, s; 0 for a single one."""
    return float(np.median(np.diff(times))) * (1 + 1e-9) if times.size > 1 else 0.0


def rate_window(step: np.ndarray) -> float:
    """Return the window of a rate, s: a minute, or the usual step between readings, if longer."""
    steps = step[step > 0]
    return max(RATE_WINDOW, float(np.median(steps)) if steps.size else 0.0)


def recursion(share: np.ndarray, push: np.ndarray) -> np.ndarray:
    """Solve xᵢ = shareᵢ·xᵢ₋₁ + pushᵢ from zero for x (*s, n): a unit bidiagonal matrix, LAPACK's banded solver."""
    from scipy.linalg.lapack import dtbtrs, ztbtrs  # only what computes loads SciPy

    share, push = np.broadcast_arrays(share, push)
    solve = ztbtrs if np.iscomplexobj(share) else dtbtrs
    # All recursions are one, which begins anew at the first element of each.
    band = np.ones((share.size, 2), share.dtype)
    np.negative(share.reshape(-1)[1:], out=band[:-1, 1])
    band[share.shape[-1] - 1 :: share.shape[-1], 1] = 0.0
    return solve(band.T, push.reshape(-1), uplo="L", diag="U")[0].reshape(push.shape)


def _window_sums(t: np.ndarray, y: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return sums of dt, dy, dt² and dt·dy over the readings first[i] … i, for each i; `first` rises.

    An anchor stands in each window: the sums grow away from it on either side, dt and dy are distances from it, and
    nothing is ever subtracted from a sum, so no digits are lost however long the record.
    """
    index = np.arange(t.size)
    beyond = np.searchsorted(first, index, side="right")  # the first window without this reading
    anchors = [0]
    while (after := int(beyond[anchors[-1]])) < t.size:
        anchors.append(after)
    stretch = np.searchsorted(anchors, index, side="right") - 1
    at, after = np.array(anchors)[stretch], np.array([*anchors[1:], t.size - 1])[stretch]

    def sums(origin: np.ndarray, rows: slice) -> np.ndarray:  # of each stretch, in this direction
        dt, dy = t - t[origin], y - y[origin]
        terms = np.stack([dt, dy, dt * dt, dt * dy])[:, rows]
        same = np.diff(stretch[rows], prepend=-1) == 0
        return recursion(same.astype(float), terms)[:, rows]

    since, until = sums(at, slice(None)), sums(after, slice(None, None, -1))
    return since + np.where(first < at, until[:, first], 0.0)
