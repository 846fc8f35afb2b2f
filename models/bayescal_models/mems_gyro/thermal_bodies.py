"""Small laws in time on a grid of one second: a body of first order, a ramp, a slow wander."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.floating[Any]]

GRID = 1.0
"""Step of the integration grid, s."""


def first_order_body(drive: Array, time_constant: float, start: float | None = None) -> Array:
    """Temperature of a body that follows `drive`: `τ·dT/dt = drive − T`, on the grid.

    Exact for a drive that is linear between grid points.

    Args:
        drive: temperature that drives the body, °C (or any unit, which the body then has).
        time_constant: τ, s.
        start: first value of the body; None starts it soaked at the first value of `drive`.
    """
    start = float(drive[0]) if start is None else start
    decay = np.exp(-GRID / time_constant)
    now = 1.0 - (1.0 - decay) * time_constant / GRID
    before = 1.0 - decay - now
    departure = drive - start
    body, _ = lfilter([now, before], [1.0, -decay], departure, zi=[-now * departure[0]])
    return start + body


def wander(generator: np.random.Generator, length: int, correlation_time: float) -> Array:
    """Stationary Ornstein-Uhlenbeck record of unit variance; `correlation_time` in s."""
    decay = np.exp(-GRID / correlation_time)
    kicks = generator.standard_normal(length)
    kicks[1:] *= np.sqrt(1.0 - decay**2)
    return np.asarray(lfilter([1.0], [1.0, -decay], kicks))


def ramp_limited(
    time: Array, starts: Sequence[float], goals: Sequence[float], ramp: float
) -> Array:
    """A set point that goes from goal to goal no faster than a ramp.

    Args:
        time: grid, s.
        starts: when each goal is set, s, increasing.
        goals: goals, °C; the first is held from the beginning.
        ramp: fastest change, °C/min.
    """
    knots, values = [float(starts[0])], [float(goals[0])]
    per_second = ramp / 60.0
    for start, end, goal in zip(starts, [*starts[1:], float(time[-1])], goals, strict=True):
        reach = per_second * (end - start)
        move = float(np.clip(goal - values[-1], -reach, reach))
        knots += [start, start + abs(move) / per_second]
        values += [values[-1], values[-1] + move]
    return np.interp(time, knots, values)
