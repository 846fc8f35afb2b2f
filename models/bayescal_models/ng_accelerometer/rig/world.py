"""The world of a test: where the table stands at every reading, and every temperature behind it.

The chamber's air follows a ramp-limited set point; the device, its sensing element, the fixture and the base hang
on it as bodies of first order, all integrated on a grid of ten seconds over the whole test, pauses included. The
laboratory has a daily course and slow correlated noise of its own, and the base follows it with a lag.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bayescal_models.ng_accelerometer.campaign import GRID, Campaign, SetUp
from bayescal_models.ng_accelerometer.rig.moon_and_sun import DAY, tide
from bayescal_models.ng_accelerometer.sizes import HOUR
from bayescal_models.simulated import Array, correlated, first_order_body

CHAMBER_TIME, DEVICE_TIME, FIXTURE_TIME = 180.0, 600.0, 900.0  # s, behind set point, air, air
BASE_TIME, LABORATORY_TIME = 1800.0, 900.0  # s, of the base behind chamber and laboratory
WANDER_TIME, LABORATORY_WANDER_TIME = 600.0, 2 * HOUR  # s, of the Ornstein–Uhlenbeck records
REVERSAL = 1.0  # °C, of path on which hysteresis follows a change of direction
FORGETTING = 2 * HOUR  # s, in which hysteresis is lost while the power is off
POWER_ON = 300.0  # s before the first reading of a run


@dataclass(frozen=True)
class World:
    """Everything that an effect may depend on: a row per reading, a column per moment of its averaging.

    Attributes:
        run, cell: index of each reading's run and cell, (n,).
        point: set point of its cell, °C, (n,).
        tilt, angle: γ and θ as set, rad, (n, 1).
        time: since the start of the test, s, (n, m), as all below.
        share: of the test that has passed, 0 at the first reading and 1 at the last.
        device, element, fixture, base: temperatures, °C.
        heating: rate of the device, °C/h.
        laboratory, foundation: of the laboratory, and of the base that follows it, °C.
        direction: state of hysteresis, −1 … 1.
        warmth: share of its own heat that the electronics lack, 1 at power-on.
        tide: components ∥ (towards east) and ⊥ (north), each in parts of its month's peak.
        by_cell, by_run: standard normal numbers by effect, one per reading, equal within a cell or run.
    """

    run: NDArray[np.int64]
    cell: NDArray[np.int64]
    point: Array
    tilt: Array
    angle: Array
    time: Array
    share: Array
    device: Array
    element: Array
    fixture: Array
    base: Array
    heating: Array
    laboratory: Array
    foundation: Array
    direction: Array
    warmth: Array
    tide: tuple[Array, Array]
    by_cell: Mapping[str, Array]
    by_run: Mapping[str, Array]


@dataclass
class _Plan:
    """Readings as (run, cell, point, tilt, angle, start), set points as (time, goal), and power as (on, off)."""

    readings: list[tuple[int, int, float, float, float, float]]
    goals: list[tuple[float, float]]
    power: list[tuple[float, float]]
    end: float


def make_world(
    campaign: Campaign,
    generators: Mapping[str, np.random.Generator],
    cells: tuple[str, ...],
    runs: tuple[str, ...],
) -> World:
    """Carry out the plan.

    Args:
        campaign: the plan.
        generators: of random numbers: "chamber", "laboratory", "groups".
        cells, runs: names of what scatters from cell to cell, and from run to run.
    """
    plan = _planned(campaign)
    grid, body = np.arange(0.0, plan.end + GRID, GRID), partial(first_order_body, step=GRID)
    wander = campaign.chamber_wander * correlated(
        generators["chamber"], grid.size, WANDER_TIME, GRID
    )
    calm = body(_set_point(grid, plan.goals, campaign.ramp), CHAMBER_TIME)
    air = calm + wander
    device = body(air, DEVICE_TIME)
    slow = correlated(generators["laboratory"], grid.size, LABORATORY_WANDER_TIME, GRID)
    laboratory = (
        campaign.laboratory
        + campaign.laboratory_wander * slow
        - campaign.laboratory_daily * np.cos(2 * np.pi * (campaign.begin + grid / DAY))
    )
    run, cell = (np.array([row[k] for row in plan.readings]) for k in (0, 1))
    point, tilt, angle, start = (np.array([row[k] for row in plan.readings]) for k in (2, 3, 4, 5))
    moments = round(campaign.reading_time / GRID)
    index = np.rint(start / GRID).astype(int)[:, None] + np.arange(moments)
    time = grid[index] + 0.5 * GRID
    middle = time.mean(axis=1)
    on = np.array([first for first, _ in plan.power])[run][:, None]
    normal = generators["groups"].standard_normal
    return World(
        run=run,
        cell=cell,
        point=point,
        tilt=tilt[:, None],
        angle=angle[:, None],
        time=time,
        share=(time - middle[0]) / (middle[-1] - middle[0]),
        device=device[index],
        element=body(device, campaign.lag_time)[index],
        fixture=body(air, FIXTURE_TIME)[index],
        base=body(air, BASE_TIME)[index],
        heating=(np.gradient(device) * HOUR / GRID)[index],
        laboratory=laboratory[index],
        foundation=body(laboratory, LABORATORY_TIME)[index],
        direction=_hysteresis(grid, body(calm, DEVICE_TIME), plan.power)[index],
        warmth=np.exp(-(time - on) / campaign.warm_up_time),
        tide=tide(time, campaign.begin, campaign.latitude, campaign.longitude),
        by_cell={name: normal(cell.max() + 1)[cell][:, None] for name in cells},
        by_run={name: normal(run.max() + 1)[run][:, None] for name in runs},
    )


def _planned(campaign: Campaign) -> _Plan:
    """When everything happens, s."""
    plan, now, cells, free = _Plan([], [], [], 0.0), 0.0, 0, 0.0
    spread = [2 * np.pi * k / campaign.positions for k in range(campaign.positions)]
    everywhere = [SetUp(tilt, angle) for tilt in campaign.tilts for angle in spread]
    stays: list[list[SetUp]] = (
        [[s] for s in campaign.set_ups] if campaign.set_ups else [everywhere] * campaign.runs
    )
    for run, stay in enumerate(stays):
        order = campaign.temperatures
        order = order[::-1] if campaign.alternate and run % 2 else order
        for number, point in enumerate(order):
            if number == 0:
                plan.goals.append((free, point))
                now += campaign.soak
                plan.power.append((max(now - POWER_ON, 0.0), now))
            else:
                plan.goals.append((now, point))
                now += abs(point - order[number - 1]) / campaign.ramp * 60.0 + campaign.soak
            for set_up in stay:
                now += campaign.move_time
                for _ in range(campaign.repeats):
                    now = GRID * np.ceil(now / GRID)
                    plan.readings.append((run, cells, point, set_up.tilt, set_up.position, now))
                    now += campaign.reading_time
            cells += 1
        plan.power[-1] = (plan.power[-1][0], now)
        free, now = now, now + campaign.pause
    plan.end = plan.readings[-1][-1] + 2 * campaign.reading_time
    return plan


def _set_point(grid: Array, goals: list[tuple[float, float]], ramp: float) -> Array:
    """A set point that goes from goal to goal at `ramp`, °C/min; °C."""
    times, values = [0.0], [goals[0][1]]
    for start, goal in goals[1:]:
        times += [start, start + abs(goal - values[-1]) / ramp * 60.0]
        values += [values[-1], goal]
    return np.interp(grid, times, values)


def _hysteresis(grid: Array, temperature: Array, power: list[tuple[float, float]]) -> Array:
    """dh = (sign(dT) − h)·|dT|/REVERSAL, as friction at a joint, starting afresh at every power-on.

    `temperature` is that without the chamber's wander, which is too small to move a joint.
    """
    on = np.zeros(grid.size, dtype=bool)
    for first, off in power:
        on |= (grid >= first) & (grid <= off)
    state, made = 0.0, np.zeros(grid.size)
    for k, step in enumerate(np.diff(temperature, prepend=temperature[0])):
        share = -np.expm1(-abs(step) / REVERSAL)
        state += (np.sign(step) - state) * share
        state *= 1.0 if on[k] else np.exp(-GRID / FORGETTING)
        made[k] = state
    return made
