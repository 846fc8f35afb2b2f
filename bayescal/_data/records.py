"""Records in time (runs): grouping of readings, time order, gaps, and the rate of change of a column."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

Columns = Mapping[str, np.ndarray]

RECORD = ("device", "axis", "run")  # columns of labels that identify a record in time
# Time step over the median step, above which it is a gap; four consecutive lost readings are not a gap.
PAUSE_STEPS = 5.0
RATE_WINDOW_S = 60.0  # over which a rate of change is estimated
# Largest relative deviation of equal time steps, for jitter of time stamps.
EVEN_STEPS = 0.05
# Longest time step, in rate windows of a minute, across which a rate is defined; a soak of hours has no present rate.
MAX_GAP_WINDOWS = 10.0
# Steps of a setting: largest ratio of adjacent changes to a step; minimum share of squared changes in steps.
MAX_NEIGHBOUR_RATIO, MIN_STEP_SHARE = 0.1, 0.9


def distinct(columns: Sequence[np.ndarray]) -> tuple[list[tuple[Any, ...]], np.ndarray]:
    """Return the distinct rows of columns in order of first appearance, and the index of each row among them."""
    begins = np.ones(len(columns[0]), bool)
    begins[1:] = np.any([values[1:] != values[:-1] for values in columns], axis=0)
    first, codes = np.flatnonzero(begins), dict[tuple[Any, ...], int]()
    rows = zip(*(values[first].tolist() for values in columns), strict=True)
    indices = np.fromiter((codes.setdefault(row, len(codes)) for row in rows), np.int64, len(first))
    return list(codes), np.repeat(indices, np.diff(first, append=len(begins)))


def label_codes(columns: Columns, names: Collection[str]) -> np.ndarray:
    """Number the combinations of labels in order of first appearance (n,); NaN is a label."""
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
        names: "axis|device|run" of each record; the run is "1" without a column `run`.
        codes: index of each reading's record (n,).
        time: time of each reading, s (n,); empty without a column `time`.
    """

    names: tuple[str, ...]
    codes: np.ndarray
    time: np.ndarray

    @classmethod
    def of(cls, columns: Columns) -> Records:
        """Group the rows of columns into records by device, axis and run."""
        codes = label_codes(columns, [n for n in RECORD if n in columns])
        first = np.flatnonzero(np.diff(np.maximum.accumulate(codes), prepend=-1))
        labels = [columns[n][first] for n in ("axis", "device") if n in columns]
        labels.append(columns["run"][first] if "run" in columns else np.ones(len(first), int))
        names = tuple("|".join(map(str, label)) for label in zip(*labels, strict=True))
        return cls(names, codes, columns.get("time", np.zeros(0)))

    @cached_property
    def rows(self) -> list[np.ndarray]:
        """Return the row indices of each record, in the order of the file."""
        order = np.argsort(self.codes, kind="stable")
        ends = 1 + np.flatnonzero(np.diff(self.codes[order]))
        return np.split(order, ends) if self.codes.size else []

    @cached_property
    def order(self) -> np.ndarray:
        """Return the row indices sorted by record and time (n,); without times, in the order of the file."""
        has_time = self.time.size
        return np.lexsort((self.time, self.codes)) if has_time else np.arange(self.codes.size)

    @cached_property
    def step(self) -> np.ndarray:
        """Return the time steps within records (n,), s, in the order `order`; −1 at first readings or without times."""
        if not self.time.size:
            return -np.ones(self.codes.size)
        time = self.time[self.order]
        step = np.diff(time, prepend=time[:1])
        step[np.diff(self.codes[self.order], prepend=-1) != 0] = -1.0
        return step

    @cached_property
    def in_time(self) -> list[np.ndarray]:
        """Return the row indices of each record, in time order."""
        return np.split(self.order, np.flatnonzero(self.step < 0)[1:])

    def stretches(self, min_readings: int = 3) -> list[np.ndarray]:
        """Return the row indices, in time order, of each gap-free segment of at least `min_readings` readings."""
        parts = []
        for rows in self.in_time:
            steps = np.diff(self.time[rows])
            median = np.median(steps) if steps.size else 0.0
            parts += np.split(rows, 1 + np.flatnonzero(steps > PAUSE_STEPS * median))
        return [rows for rows in parts if len(rows) >= min_readings]

    def starts(self, record: Records | None = None) -> np.ndarray:
        """Return the start time of each record, s: its first reading, or the start of the run that it continues.

        It continues a run of the earlier records `record` with the same name, device and axis if its first reading is
        within that run, or follows it without a gap.
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
        """Return name and sorted times of the records in `record` that have a name of these, by index in these."""
        return {
            i: (name, record.time[record.in_time[record.names.index(name)]])
            for i, name in enumerate(self.names)
            if name in record.names
        }

    def elapsed(self, record: Records | None = None) -> np.ndarray:
        """Return the time since the start of each reading's record, s (n,); `record` as in `starts`."""
        return self.time - self.starts(record)[self.codes]

    @property
    def max_gap(self) -> float:
        """Return the longest time step, s, across which a column is interpolated."""
        return MAX_GAP_WINDOWS * rate_window(self.step)

    def is_set_in_steps(self, values: np.ndarray) -> bool:
        """Return whether a column is a piecewise constant setting: nearly all squared change is in isolated steps."""
        changes = np.where(self.step[1:] < 0, 0.0, np.abs(np.diff(values[self.order])))
        previous_changes, next_changes = np.pad(changes, 1)[:-2], np.pad(changes, 1)[2:]
        is_isolated = np.maximum(previous_changes, next_changes) < MAX_NEIGHBOUR_RATIO * changes
        total = float(np.sum(changes**2))
        return total > 0 and float(np.sum(changes[is_isolated] ** 2)) > MIN_STEP_SHARE * total

    def slope(self, values: np.ndarray) -> np.ndarray:
        """Return the least-squares slope over the preceding minute (or step, if longer) at each reading (n,), unit/s.

        The slope is zero at the first reading of a record and after a long gap, and a linear function of the values.
        """
        t, y, index = self.time[self.order], values[self.order], np.arange(self.time.size)
        window = rate_window(self.step) * (1 + 1e-9)
        first = np.empty(t.size, dtype=int)  # index of the first reading of each window
        for low, high in itertools.pairwise([*np.flatnonzero(self.step < 0), t.size]):
            times = t[low:high]
            last = (np.searchsorted(times, times) - 1).clip(0)  # at least one earlier time
            first[low:high] = low + np.clip(np.searchsorted(times, times - window), 0, last)
        sum_t, sum_y, sum_tt, sum_ty = _sum_windows(t, y, first)
        count = index - first + 1
        denominator = sum_tt - sum_t**2 / count
        valid = (first < index) & (denominator > 0) & (t - t[first] <= self.max_gap * (1 + 1e-9))
        slopes = np.zeros_like(y)
        slopes[self.order[valid]] = (sum_ty - sum_t * sum_y / count)[valid] / denominator[valid]
        return slopes


def median_step(times: np.ndarray) -> float:
    """Return the median step between sorted times, s; 0 for a single one."""
    return float(np.median(np.diff(times))) * (1 + 1e-9) if times.size > 1 else 0.0


def rate_window(step: np.ndarray) -> float:
    """Return the window of a rate, s: a minute, or the median step between readings, if longer."""
    steps = step[step > 0]
    return max(RATE_WINDOW_S, float(np.median(steps)) if steps.size else 0.0)


def solve_recursion(decay: np.ndarray, drive: np.ndarray) -> np.ndarray:
    """Solve xᵢ = decayᵢ·xᵢ₋₁ + driveᵢ, x₋₁ = 0, for x (*s, n), as a banded triangular system (LAPACK)."""
    from scipy.linalg.lapack import dtbtrs, ztbtrs  # SciPy is slow to import

    decay, drive = np.broadcast_arrays(decay, drive)
    solve = ztbtrs if np.iscomplexobj(decay) else dtbtrs
    # All recursions are solved as one; a zero decay separates them.
    band = np.ones((decay.size, 2), decay.dtype)
    np.negative(decay.reshape(-1)[1:], out=band[:-1, 1])
    band[decay.shape[-1] - 1 :: decay.shape[-1], 1] = 0.0
    return solve(band.T, drive.reshape(-1), uplo="L", diag="U")[0].reshape(drive.shape)


def _sum_windows(t: np.ndarray, y: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the sums (4, n) of dt, dy, dt², dt·dy over the readings first[i] … i for each i; `first` is increasing.

    Each window contains an anchor: dt and dy are differences from it, and sums are accumulated from it to both sides,
    so that no sums are subtracted and no digits are lost in long records.
    """
    index = np.arange(t.size)
    next_window = np.searchsorted(first, index, side="right")  # first window after this reading
    anchors = [0]
    while (next_anchor := int(next_window[anchors[-1]])) < t.size:
        anchors.append(next_anchor)
    block = np.searchsorted(anchors, index, side="right") - 1
    anchor, next_anchor = np.array(anchors)[block], np.array([*anchors[1:], t.size - 1])[block]

    def sums(origin: np.ndarray, rows: slice) -> np.ndarray:  # cumulative within each block
        dt, dy = t - t[origin], y - y[origin]
        terms = np.stack([dt, dy, dt * dt, dt * dy])[:, rows]
        is_continued = np.diff(block[rows], prepend=-1) == 0
        return solve_recursion(is_continued.astype(float), terms)[:, rows]

    backward_sums = sums(next_anchor, slice(None, None, -1))[:, first]
    return sums(anchor, slice(None)) + np.where(first < anchor, backward_sums, 0.0)
