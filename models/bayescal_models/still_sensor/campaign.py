"""Temperature ramps of a simulated sensor at rest, and what is true of it second by second.

A chamber whose air follows its ramps with a lag, gone through once in each run.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from bayescal_models.simulated import first_order_body

RAMPS = ((0.0, 25.0), (10.0, -15.0), (25.0, 65.0), (40.0, 25.0))  # min, °C: cooled, heated, cooled
PAUSE = 3600.0  # s between runs
CHAMBER_TIME, LAG_TIME, SLOW_TIME = 60.0, 300.0, 2400.0  # s
REVERSAL_TIME = 30.0  # s, in which hysteresis follows a change of direction


@dataclass(frozen=True)
class World:
    """The true temperature second by second: each a matrix (runs, seconds).

    Attributes:
        time: within the run, s.
        departure: T − T0, °C, T0 the mean of all rounded to 1 °C.
        rate: dT/dt, °C/min.
        direction: sign of the rate, which takes its time to turn.
        behind: T̃ − T of a body of first order, °C.
        far_behind: of a slower one.
        turn_on: one standard normal number for each run.
        progress: (t − t̄)/(tmax − tmin) over all runs.
    """

    time: np.ndarray
    departure: np.ndarray
    rate: np.ndarray
    direction: np.ndarray
    behind: np.ndarray
    far_behind: np.ndarray
    turn_on: np.ndarray
    progress: np.ndarray


def make_world(runs: int, turn_on: np.ndarray) -> tuple[np.ndarray, World]:
    """Temperatures, °C, (runs, seconds), and the world that goes through them.

    Args:
        runs: how many times the ramps are gone through.
        turn_on: one standard normal number for each run, (runs,).
    """
    (minutes, goals), body = np.array(RAMPS).T, partial(first_order_body, step=1.0)
    second = np.arange(60.0 * minutes[-1] + 1)
    one = body(np.interp(second, 60 * minutes, goals), CHAMBER_TIME)
    temperature, time = np.tile(one, (runs, 1)), np.tile(second, (runs, 1))
    elapsed = time + np.arange(runs)[:, None] * (second[-1] + PAUSE)
    rate = 60 * np.gradient(one)
    world = World(
        time=time,
        departure=temperature - round(float(one.mean())),
        rate=np.tile(rate, (runs, 1)),
        direction=np.tile(body(np.sign(rate), REVERSAL_TIME), (runs, 1)),
        behind=np.tile(body(one, LAG_TIME) - one, (runs, 1)),
        far_behind=np.tile(body(one, SLOW_TIME) - one, (runs, 1)),
        turn_on=turn_on[:, None],
        progress=(elapsed - elapsed.mean()) / np.ptp(elapsed),
    )
    return temperature, world
