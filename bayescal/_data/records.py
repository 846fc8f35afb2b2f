"""Records in time (runs): grouping of readings, time order, pauses, and the rate of change of a column."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

Columns = Mapping[str, np.ndarray]

RECORD = ("device", "axis", "run")  # columns of labels that identify a record in time
# Time step over the median step, above which there is a pause; four lost readings in a row are none.
PAUSE_STEPS = 5.0
RATE_WINDOW = 60.0  # s
# Relative deviation of steps that count as even: time stamps jitter.
EVEN_STEPS = 0.05
# Pause in windows of a rate (a minute each), after which a rate is undefined: a change over hours, such as a soak, does
# not determine the present rate.
SILENCE_WINDOWS = 10.0
# A set step: largest ratio of the adjacent changes to it; least fraction of the sum of squared changes in set steps.
MAX_NEIGHBOUR_RATIO, MIN_SET_SHARE = 0.1, 0.9


def distinct(columns: Sequence[np.ndarray]) -> tuple[list[tuple[Any, ...]], np.ndarray]:
    """Return the distinct rows of columns in order of first appearance, and the index of each row among them.

    Only the first row of each stretch of equal rows is looked up, without pandas, which takes half a second to load.
    """
    begins = np.ones(len(columns[0]), bool)
    begins[1:] = np.any([values[1:] != values[:-1] for values in columns], axis=0)
    first, codes = np.flatnonzero(begins), dict[tuple[Any, ...], int]()
    rows = zip(*(values[first].tolist() for values in columns), strict=True)
    indices = np.fromiter((codes.setdefault(row, len(codes)) for row in rows), np.int64, len(first))
    return list(codes), np.repeat(indices, np.diff(first, append=len(begins)))


def label_codes(columns: Columns, names: Collection[str]) -> np.ndarray:
    """Number the combinations of labels in order of first appearance; NaN is a label."""
    labels = [columns[n] for n in names]
    labels = [np.where(v == v, v.astype(object), "") if v.dtype.kind == "f" else v for v in labels]
    return distinct(labels)[1] if labels else np.zeros(len(next(iter(columns.values()))), np.int64)


def equal_runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the start index and length of each run of equal consecutive values (run-length encoding)."""
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

    def stretches(self, min_readings: int = 3) -> list[np.ndarray]:
        """Return the row indices of each segment without a gap, of at least `min_readings` readings, in time order."""
        parts = []
        for rows in self.in_time:
            steps = np.diff(self.time[rows])
            median = np.median(steps) if steps.size else 0.0
            parts += np.split(rows, 1 + np.flatnonzero(steps > PAUSE_STEPS * median))
        return [rows for rows in parts if len(rows) >= min_readings]

    def starts(self, record: Records | None = None) -> np.ndarray:
        """Return the start time of each record, s: its first reading, or the start of the fitted run that it continues.

        It continues a run of `record` with the same name, device and axis if its first reading is within that run or
        less than a pause after it.
        """
        first = np.full(len(self.names), np.inf)
        np.minimum.at(first, self.codes, self.time)
        if record is not None and record.time.size:
            for i, (_, times) in self.matching_records(record).items():
                pause = PAUSE_STEPS * median_step(times)
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
        """Return the longest time step, s, over which a column is interpolated."""
        return SILENCE_WINDOWS * rate_window(self.step)

    def set_in_steps(self, values: np.ndarray) -> bool:
        """Return whether a column is piecewise constant (a setting, such as a load) rather than a measured series.

        Then nearly all of the sum of squared changes is in isolated changes.
        """
        change = np.where(self.step[1:] < 0, 0.0, np.abs(np.diff(values[self.order])))
        padded = np.pad(change, 1)
        is_isolated = np.maximum(padded[:-2], padded[2:]) < MAX_NEIGHBOUR_RATIO * change
        total = float(np.sum(change**2))
        return total > 0 and float(np.sum(change[is_isolated] ** 2)) > MIN_SET_SHARE * total

    def slope(self, values: np.ndarray) -> np.ndarray:
        """Return the least-squares slope over the last minute (or the last step, if longer) of each record, unit/s.

        Zero at the first reading of a record, and at the first after a long pause. Linear in the values.
        """
        t, y, index = self.time[self.order], values[self.order], np.arange(self.time.size)
        window = rate_window(self.step) * (1 + 1e-9)
        first = np.empty(t.size, dtype=int)  # reading of each window
        for low, high in itertools.pairwise([*np.flatnonzero(self.step < 0), t.size]):
            times = t[low:high]
            last = (np.searchsorted(times, times) - 1).clip(0)  # of an earlier time at least
            first[low:high] = low + np.clip(np.searchsorted(times, times - window), 0, last)
        sum_t, sum_y, sum_tt, sum_ty = _window_sums(t, y, first)
        count = index - first + 1
        denominator = sum_tt - sum_t**2 / count
        valid = (first < index) & (denominator > 0) & (t - t[first] <= self.silence * (1 + 1e-9))
        slopes = np.zeros_like(y)
        slopes[self.order[valid]] = (sum_ty - sum_t * sum_y / count)[valid] / denominator[valid]
        return slopes


def median_step(times: np.ndarray) -> float:
    """Return the median step between sorted times, s; 0 for a single one."""
    return float(np.median(np.diff(times))) * (1 + 1e-9) if times.size > 1 else 0.0


def rate_window(step: np.ndarray) -> float:
    """Return the window of a rate, s: a minute, or the usual step between readings, if longer."""
    steps = step[step > 0]
    return max(RATE_WINDOW, float(np.median(steps)) if steps.size else 0.0)


def solve_recursion(decay: np.ndarray, drive: np.ndarray) -> np.ndarray:
    """Solve xᵢ = shareᵢ·xᵢ₋₁ + pushᵢ from zero for x (*s, n): a unit bidiagonal matrix, LAPACK's banded solver."""
    from scipy.linalg.lapack import dtbtrs, ztbtrs  # only what computes loads SciPy

    decay, drive = np.broadcast_arrays(decay, drive)
    solve = ztbtrs if np.iscomplexobj(decay) else dtbtrs
    # All recursions are one, which begins anew at the first element of each.
    band = np.ones((decay.size, 2), decay.dtype)
    np.negative(decay.reshape(-1)[1:], out=band[:-1, 1])
    band[decay.shape[-1] - 1 :: decay.shape[-1], 1] = 0.0
    return solve(band.T, drive.reshape(-1), uplo="L", diag="U")[0].reshape(drive.shape)


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
        return solve_recursion(same.astype(float), terms)[:, rows]

    since, until = sums(at, slice(None)), sums(after, slice(None, None, -1))
    return since + np.where(first < at, until[:, first], 0.0)
