"""A stepped chamber with a gyro in it: the temperatures that follow from the plan of a test.

Three bodies hang on the chamber's air, each of first order: the package (tens of seconds), the
die's surroundings (minutes) and the electronics board (minutes, with its own heat). Everything is
integrated on a grid of one second over the whole test, pauses included, so that what a run finds
at its start is what the run before it and the pause have left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayescal_models.mems_gyro.campaign import GRID, Campaign
from bayescal_models.simulated import Array, correlated, first_order_body


@dataclass(frozen=True)
class World:
    """What happens in a test, second by second; arrays have one value per grid point.

    Attributes:
        time: s from the first power-on.
        ambient, package, die, board: temperatures, °C; `ambient` is what the thermometer sees.
        warmth: share of the electronics' self-heating reached, 0 cold … 1 warm.
        rate: input rate, °/s (0 without a turntable).
        humidity: relative humidity in the chamber, %.
        turn_on: one standard normal number per run, held through that run and the pause after it.
        logged: indices of the grid points behind each reading, readings × samples.
        run: run of each reading, counted from 0.
    """

    time: Array
    ambient: Array
    package: Array
    die: Array
    board: Array
    warmth: Array
    rate: Array
    humidity: Array
    turn_on: Array
    logged: NDArray[np.intp]
    run: NDArray[np.intp]

    def average(self, values: Array) -> Array:
        """Mean of a quantity over the logger's samples of each reading, in its own unit."""
        return values[self.logged].mean(axis=1)


def make_world(campaign: Campaign, generators: Mapping[str, np.random.Generator]) -> World:
    """Run the chamber, the bodies and the logger of a campaign through the whole test.

    Args:
        campaign: the plan.
        generators: random generators named "run" and "humidity".
    """
    starts = campaign.run_starts
    length = round((starts[-1] + campaign.run_duration) / GRID) + 1
    time = GRID * np.arange(length)
    # A run owns the samples in (start, end], as does a step: the sample on the hour closes it.
    run = np.maximum(np.searchsorted(starts, time, side="left") - 1, 0)
    powered = (time > starts[run]) & (time <= starts[run] + campaign.run_duration)
    ambient = _ambient(campaign, time)
    logged = _logged(campaign)
    moist = 45.0 + 5.0 * correlated(generators["humidity"], length, 2400.0, GRID)
    return World(
        time=time,
        ambient=ambient,
        package=first_order_body(ambient, campaign.package_time, GRID),
        die=first_order_body(ambient, campaign.lag_time, GRID),
        board=first_order_body(
            ambient + campaign.board_heating * powered, campaign.board_time, GRID, start=ambient[0]
        ),
        warmth=first_order_body(powered.astype(float), campaign.warm_up_time, GRID, start=0.0),
        rate=np.where(powered, _input_rate(campaign, time - starts[run], run), 0.0),
        humidity=np.clip(moist, 2.0, 98.0),
        turn_on=generators["run"].standard_normal(campaign.runs)[run],
        logged=logged,
        run=run[logged[:, 0]],
    )


def _ambient(campaign: Campaign, time: Array) -> Array:
    """Air at the ambient thermometer, °C: steps, no faster than the ramp, then first order."""
    begin, goals = [], []
    for k, start in enumerate(campaign.run_starts):
        begin += [start + campaign.dwell * i for i in range(len(campaign.temperatures))]
        goals += campaign.set_points(k)
        if k + 1 < campaign.runs and campaign.pause > 0:
            begin.append(start + campaign.run_duration)
            goals.append(campaign.set_points(k + 1)[0])
    air = ramp_limited(time, begin, goals, campaign.chamber_ramp)
    return first_order_body(air, campaign.chamber_time, GRID)


def _input_rate(campaign: Campaign, since_start: Array, run: NDArray[np.intp]) -> Array:
    """Rate of the turntable, °/s, cycled over the steps of all runs."""
    rates = np.asarray(campaign.rate_input or (0.0,), dtype=float)
    step = np.ceil(since_start / campaign.dwell).astype(int) - 1
    return rates[(run * len(campaign.temperatures) + step) % len(rates)]


def _logged(campaign: Campaign) -> NDArray[np.intp]:
    """Grid points that the logger samples, readings × samples."""
    samples = round(campaign.run_duration / campaign.logging_interval)
    since_start = campaign.logging_interval * np.arange(1, samples + 1)
    at = np.rint((campaign.run_starts[:, None] + since_start) / GRID).astype(np.intp)
    return at.reshape(-1, round(campaign.average / campaign.logging_interval))


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
