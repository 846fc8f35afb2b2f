"""Averaging of readings over short intervals to shorten a long log, and the noise of each mean."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from bayescal._core.errors import InputError
from bayescal._data.column import UNCERTAINTY
from bayescal._data.unit_conversion import convert, parse_quantity

# Median changes of a column, above which a change is a step between two settings, not to be averaged over.
MIN_STEP_CHANGES = 10.0
MAX_STEPS_SHARE = 0.1  # largest share of steps in the readings; a mean then has ten or more of them


def parse_duration(text: str | float) -> float:
    """Parse a duration such as "1 s", "0.5s", "2 min" or 1.0 to seconds; raise InputError if it is not positive."""
    with suppress(InputError):
        number, unit = parse_quantity(f"{text} s" if isinstance(text, int | float) else text)
        seconds = float(convert(number, unit, "s"))
        if np.isfinite(seconds) and seconds > 0:
            return seconds
    raise InputError(
        f"{text!r} is not an averaging time: write a positive number with a unit of time, such as '0.5 s' or '2 min'"
    )


def check_averaging_time(
    time: np.ndarray, is_next: np.ndarray, counts: np.ndarray, seconds: float, file: str
) -> None:
    """Raise InputError if means are of one reading, or of all; `is_next`: whether a reading continues a group."""
    if counts.size == 1:
        fault = f"averaging over {seconds:g} s combines all {time.size} readings into one mean"
        raise InputError(f"{file}: {fault}: give a shorter averaging time")
    if counts.max() == 1:
        median_step = float(np.median(np.diff(time)[is_next[1:]])) if is_next.any() else np.inf
        spacing_text = f" (they are {median_step:.3g} s apart)" * bool(np.isfinite(median_step))
        raise InputError(
            f"{file}: nothing can be averaged: no two readings with the same labels and settings are within "
            f"{seconds:g} s{spacing_text}. Give a longer averaging time, or do not average"
        )


def bin_times(time: np.ndarray, is_next: np.ndarray, seconds: float) -> np.ndarray:
    """Return the index (n,) of the averaging interval of each reading, counted from the start of its record."""
    # Intervals begin half a step before a reading, so that clock jitter moves no reading to another one.
    start_rows = np.flatnonzero(~is_next)
    record_start_times = np.repeat(time[start_rows], np.diff(start_rows, append=time.size))
    steps = np.diff(time, prepend=time[:1])[is_next]
    median_step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    return np.floor((time - record_start_times + 0.5 * min(median_step, seconds)) / seconds)


def find_steps(values: np.ndarray, is_next: np.ndarray) -> np.ndarray:
    """Return a mask (n,) of the readings at which a setting, such as an angle held for many readings, changes.

    These are changes of more than ten times the median change (zero for exactly held values). A column with many of
    them is not a setting: it fluctuates in its last digit, and may be averaged.
    """
    change = np.where(is_next, np.abs(np.diff(values, prepend=values[:1])), 0.0)
    is_step = change > MIN_STEP_CHANGES * (np.median(change[is_next]) if is_next.any() else 0.0)
    return is_step & (np.count_nonzero(is_step) <= MAX_STEPS_SHARE * values.size)


def average(rows: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the means (m, …) of segments of `rows` (n, …) that begin at `starts`; exact for constant segments."""
    counts, first_rows = np.diff(starts, append=len(rows)), rows[starts]
    deviations = np.add.reduceat(rows - np.repeat(first_rows, counts, axis=0), starts, axis=0)
    return first_rows + deviations / counts.reshape(-1, *(1,) * (rows.ndim - 1))


def estimate_reading_noise(
    columns: Mapping[str, np.ndarray], output: str, order: np.ndarray, is_next: np.ndarray
) -> float:
    """Estimate the white-noise standard deviation of a reading, √(mean(Δ²)/2 − u²), u its known uncertainty."""
    uncertainties = columns[UNCERTAINTY] if UNCERTAINTY in columns else np.zeros(order.size)
    change = np.diff(columns[output][order], prepend=0.0)[is_next]
    variance = 0.5 * float(np.mean(change**2)) - float(np.mean(uncertainties[order][is_next] ** 2))
    return float(np.sqrt(max(variance, 0.0)))


def compute_excess_uncertainty(
    columns: Mapping[str, np.ndarray], order: np.ndarray, begins: np.ndarray, noise_sd: float
) -> np.ndarray | None:
    """Return the uncertainty (m,) of each mean in excess of the mean of the largest number of readings; None if zero.

    Its variance is σ²·(1/n − 1/N) for a mean of n readings, at most N, plus that of the readings' known uncertainties.
    """
    counts = np.diff(begins, append=order.size)
    variance = noise_sd**2 * (1 / counts - 1 / counts.max())
    if UNCERTAINTY in columns:
        variances = columns[UNCERTAINTY][order] ** 2
        variance = variance + np.add.reduceat(variances, begins) / counts**2
    return np.sqrt(variance) if variance.any() else None
