"""Formulas of model terms: functions of recorded columns and of a few shapes, by their names in task.json.

Each takes the data frame, the arguments stated in the task, and its shapes as keywords; it returns (n, k), a column
for each coefficient of the term. The readings of a run are equally spaced in time and contiguous.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pandas as pd
from scipy.signal import lfilter

Array = np.ndarray


def constant(data: pd.DataFrame) -> Array:
    """Return a column of ones."""
    return np.ones((len(data), 1))


def power(data: pd.DataFrame, column: str, about: float, order: int) -> Array:
    """Return (x − about)^order."""
    return (data[column].to_numpy(float)[:, None] - about) ** order


def product(data: pd.DataFrame, first: str, second: str, about: float) -> Array:
    """Return x·(z − about)."""
    x, z = data[first].to_numpy(float), data[second].to_numpy(float)
    return (x * (z - about))[:, None]


def difference(data: pd.DataFrame, first: str, second: str, order: int) -> Array:
    """Return (x − z)^order."""
    x, z = data[first].to_numpy(float), data[second].to_numpy(float)
    return ((x - z) ** order)[:, None]


def harmonic(data: pd.DataFrame, column: str, period: float) -> Array:
    """Return cos and sin of 2π·x/period: two coefficients."""
    at = 2 * np.pi * data[column].to_numpy(float) / period
    return np.column_stack([np.cos(at), np.sin(at)])


def decay(data: pd.DataFrame, column: str, scale: float) -> Array:
    """Return exp(−x/scale)."""
    return np.exp(-data[column].to_numpy(float) / scale)[:, None]


def peak(data: pd.DataFrame, column: str, centre: float, *, width: float) -> Array:
    """Return exp(−((x − centre)/width)²)."""
    return np.exp(-(((data[column].to_numpy(float) - centre) / width) ** 2))[:, None]


def rate(data: pd.DataFrame, column: str, group: str) -> Array:
    """Return dx/dt, by central differences within a run."""
    rates = np.zeros(len(data))
    for at in _runs(data, group):
        rates[at] = np.gradient(data[column].to_numpy(float)[at], data["time"].to_numpy(float)[at])
    return rates[:, None]


def lag(data: pd.DataFrame, column: str, group: str, *, tau: float) -> Array:
    """Return x̃ − x of a first-order body, τ·dx̃/dt = x − x̃, x̃ = x at a run's start; x linear between readings."""
    lags = np.zeros(len(data))
    for at in _runs(data, group):
        x, time = data[column].to_numpy(float)[at], data["time"].to_numpy(float)[at]
        step = (time[1] - time[0]) / tau
        decay = np.exp(-step)
        k = (1 - decay) / step
        follows = lfilter([1 - k, k - decay], [1.0, -decay], x - x[0])
        lags[at] = follows - (x - x[0])
    return lags[:, None]


def warm_up(data: pd.DataFrame, group: str, *, tau: float) -> Array:
    """Return exp(−t/τ), t from the start of the run."""
    time, elapsed = data["time"].to_numpy(float), np.zeros(len(data))
    for at in _runs(data, group):
        elapsed[at] = np.exp(-(time[at] - time[at][0]) / tau)
    return elapsed[:, None]


def direction(data: pd.DataFrame, column: str, group: str, *, width: float) -> Array:
    """Return Dahl's hysteresis D, dD/dx = (sign(dx) − D)/width along the path of x within a run, D = 0 at its start."""
    directions = np.zeros(len(data))
    for at in _runs(data, group):
        x = data[column].to_numpy(float)[at]
        state = np.zeros(x.size)
        for i in range(1, x.size):
            travel = x[i] - x[i - 1]
            decay = np.exp(-abs(travel) / width)
            state[i] = decay * state[i - 1] + np.sign(travel) * (1 - decay)
        directions[at] = state
    return directions[:, None]


def each(data: pd.DataFrame, group: str, levels: list[int]) -> Array:
    """Return an indicator column for each listed member of a group; other members have zeros in all."""
    return (data[group].to_numpy()[:, None] == np.asarray(levels)[None, :]).astype(float)


def each_times(
    data: pd.DataFrame, group: str, levels: list[int], column: str, about: float, order: int
) -> Array:
    """Return (x − about)^order in a column for each member of a group."""
    return each(data, group, levels) * power(data, column, about, order)


def _runs(data: pd.DataFrame, group: str) -> Iterator[slice]:
    """Yield the rows of each run."""
    label = data[group].to_numpy()
    edges = np.flatnonzero(np.diff(label)) + 1
    for begin, end in zip([0, *edges], [*edges, len(label)], strict=True):
        yield slice(int(begin), int(end))


FORMULAS: dict[str, Callable[..., Array]] = {
    f.__name__: f
    for f in (
        *(constant, power, product, difference, harmonic, decay, peak, rate),
        *(lag, warm_up, direction, each, each_times),
    )
}
