"""Averages of readings over short times: a long log made short, with the noise of each mean."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from bayescal._core.errors import InputError
from bayescal._data.column import UNCERTAINTY
from bayescal._data.unit_conversion import convert, quantity

# In usual changes of a column: a larger change is a step between two settings, over which no mean is taken.
SET_JUMP_CHANGES = 10.0
# Share of the readings that may be such steps, which leave ten to a mean at the least.
SET_JUMPS_SHARE = 0.1


def duration(text: str | float) -> float:
    """Parse a duration such as "1 s", "0.5s", "2 min" or 1.0; return it in s; raise InputError if not positive."""
    with suppress(InputError):
        number, unit = quantity(f"{text} s" if isinstance(text, int | float) else text)
        seconds = float(convert(number, unit, "s"))
        if np.isfinite(seconds) and seconds > 0:
            return seconds
    raise InputError(
        f"{text!r} is no time to average over: write a positive number with a unit of time, such as '1 s', '0.5 s' or "
        "'2 min'"
    )


def refuse_useless(
    time: np.ndarray, same: np.ndarray, counts: np.ndarray, seconds: float, names: str
) -> None:
    """Raise InputError for a time that averages no two readings, or all of them."""
    if counts.size == 1:
        one_mean = f"a mean over {seconds:g} s is one of all {time.size} readings"
        raise InputError(f"{names}: {one_mean}: give a shorter time")
    if counts.max() == 1:
        usual = float(np.median(np.diff(time)[same[1:]])) if same.any() else np.inf
        spacing = f" (they are {usual:.3g} s apart)" * bool(np.isfinite(usual))
        raise InputError(
            f"{names}: nothing to average, as no two readings with the same labels and settings lie within "
            f"{seconds:g} s{spacing}: give a longer time, or do not average"
        )


def bin_times(time: np.ndarray, same: np.ndarray, seconds: float) -> np.ndarray:
    """Return the index of the averaging time that each reading falls into, counted from its record's first reading.

    They begin half a step before a reading, so that uneven clocks do not move readings across.
    """
    starts = np.flatnonzero(~same)
    starts_of_records = np.repeat(time[starts], np.diff(starts, append=time.size))
    steps = np.diff(time, prepend=time[:1])[same]
    median_step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    return np.floor((time - starts_of_records + 0.5 * min(median_step, seconds)) / seconds)


def find_steps(values: np.ndarray, same: np.ndarray) -> np.ndarray:
    """Return where (n,) a column of settings, such as an angle held for many readings, goes to its next value.

    A step is a change of more than ten times the usual one (the median: zero where a value is held exactly). A column
    with many of them holds no settings, but toggles in its last digit: its means are as good as any.
    """
    change = np.where(same, np.abs(np.diff(values, prepend=values[:1])), 0.0)
    stepped = change > SET_JUMP_CHANGES * (np.median(change[same]) if same.any() else 0.0)
    return stepped & (np.count_nonzero(stepped) <= SET_JUMPS_SHARE * values.size)


def mean_rows(rows: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Return means (m, …) of stretches of `rows` (n, …), by distances from the first: held values stay as they are."""
    counts, first = np.diff(begins, append=len(rows)), rows[begins]
    deviations = np.add.reduceat(rows - np.repeat(first, counts, axis=0), begins, axis=0)
    return first + deviations / counts.reshape(-1, *(1,) * (rows.ndim - 1))


def noise_of_reading(
    columns: Mapping[str, np.ndarray], output: str, order: np.ndarray, inside: np.ndarray
) -> float:
    """Return the white noise of a reading beyond its known uncertainty: half the mean square of its changes, rooted."""
    uncertainties = columns[UNCERTAINTY] if UNCERTAINTY in columns else np.zeros(order.size)
    change = np.diff(columns[output][order], prepend=0.0)[inside]
    variance = 0.5 * float(np.mean(change**2)) - float(np.mean(uncertainties[order][inside] ** 2))
    return float(np.sqrt(max(variance, 0.0)))


def uncertainty_of_means(
    columns: Mapping[str, np.ndarray], order: np.ndarray, begins: np.ndarray, noise: float
) -> np.ndarray | None:
    """Return the standard uncertainty of each mean beyond the noise of the fullest, which a fit finds; None if zero.

    A mean of n readings has the noise σ²/n; the fullest has σ²/N, hence σ²·(1/n − 1/N) beside it.
    """
    counts = np.diff(begins, append=order.size)
    variance = noise**2 * (1 / counts - 1 / counts.max())
    if UNCERTAINTY in columns:
        variances = columns[UNCERTAINTY][order] ** 2
        variance = variance + np.add.reduceat(variances, begins) / counts**2
    return np.sqrt(variance) if variance.any() else None
