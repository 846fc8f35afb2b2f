"""Thermometers' counters that wrap: negative temperatures as 256 + T, a byte of quarter degrees, a lost sign."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

SIGN = "sign"  # --unwrap temperature=sign: a column of absolute values
ROOM = 20.0  # °C, near which a record begins where its counter leaves open which of its periods it is in
# What a thermometer's counter of some bits holds, °C: in whole degrees and parts of them by two, and in decimals.
PERIODS = sorted({2.0**bits * size for bits in range(4, 21) for size in (1.0, 0.1, 0.01, 0.001)})
LEAST_PERIOD = 50.0  # °C; steps of less are other faults'
# °C, of counters that may go on from their largest value at the smallest: ±64, ±128
SIGNED = (128.0, 256.0)
PART = 0.25  # of a period, that a column may change by at the most where a change tells that it began anew
LEAST_LEVELS = 3  # values beyond a wrap; fewer are an error value
USUAL_SHARE = 0.9  # of a column's changes
# Of residual sums of squares, from which an output denies a column's absolute values.
BETTER_RATIO = 4.0


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


def restore_sign(values: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Return a column whose sign was lost, (n,): in each record positive at first, and another sign beyond each zero.

    A zero is where readings are as small as the column's usual change, between larger ones on both sides.
    """
    found = values.copy()
    for code in np.unique(codes):
        rows = np.flatnonzero((codes == code) & np.isfinite(values))
        own = values[rows]
        changes = np.abs(np.diff(own))
        small = own <= np.quantile(changes[changes > 0], USUAL_SHARE) if changes.any() else own < 0
        edges = np.flatnonzero(np.diff(np.concatenate([[False], small, [False]]).astype(int)))
        sign = np.ones(len(own))
        for begin, end in edges.reshape(-1, 2):
            if begin > 0 and end < len(own):
                least = begin + int(np.argmin(own[begin:end]))
                sign[least + (own[least - 1] >= own[min(least + 1, len(own) - 1)]) :] *= -1.0
        found[rows] = sign * own
    return found


def wrap_period(values: np.ndarray, codes: np.ndarray, allowed: np.ndarray) -> float | None:
    """Return the period, °C, at which a column's counter began anew; None where it did not.

    Within a record each change by more than half of it is one of a period, to what the column may change by; all values
    lie in one period, from 0 or (of signed bytes) about 0; and those beyond the others are more than an error value.
    `values` in °C and `codes` of their records are (n,), `allowed` changes from each reading to the next (n − 1,).
    """
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


def lost_its_sign(
    values: np.ndarray,
    codes: np.ndarray,
    allowed: np.ndarray,
    output: np.ndarray,
    others: Sequence[np.ndarray],
) -> bool:
    """Return whether an output follows a column's values with their sign restored far more closely than the values.

    Arguments as `wrap_period`; `output` (n,), and `others`: further columns that it may depend on, (n,) each.
    """
    signed = restore_sign(values, codes)
    # at a zero by both sides
    leaps = (np.abs(np.diff(signed)) > 2.0 * allowed) & (np.diff(codes) == 0)
    if values.min() < 0 or not (signed < 0).any() or leaps.any():
        return False
    left = []
    for column in (values, signed):
        basis = np.column_stack([np.ones(len(values)), column, column**2, *others])
        basis = basis / np.maximum(np.abs(basis).max(axis=0), np.finfo(float).tiny)
        left.append(np.sum((output - basis @ np.linalg.lstsq(basis, output)[0]) ** 2))
    return bool(left[0] > BETTER_RATIO * left[1])
