"""Conditions of a simulated test: attitude of the table at every reading, and all temperatures.

The chamber's air follows a ramp-limited set point; the device, its sensing element, the fixture and the base follow
it as first-order bodies, all integrated on a grid of ten seconds over the whole test, pauses included. The
laboratory has a daily course and slow correlated noise of its own, and the base follows it with a lag.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from bayescal_models.ng_accelerometer.campaign import GRID, Campaign, SetUp
from bayescal_models.ng_accelerometer.moon_and_sun import BEGIN, DAY, tide
from bayescal_models.simulated import (
    HOUR,
    Array,
    correlated,
    first_order_body,
    ramp_limited,
    wandering_supply,
)

CHAMBER_TAU, DEVICE_TAU, FIXTURE_TAU = 180.0, 600.0, 900.0  # s, behind set point, air, air
BASE_TIME, LABORATORY_TIME = 1800.0, 900.0  # s, of the base behind chamber and laboratory
WANDER_TIME, LABORATORY_WANDER_TIME = 600.0, 2 * HOUR  # s, of the Ornstein–Uhlenbeck records
REVERSAL = 1.0  # °C, over which hysteresis follows a reversal
FORGETTING = 2 * HOUR  # s, decay time of the hysteresis while the power is off
LAG_TIME = 1800.0  # s, lag of the sensing element behind the device's thermometer
READING_TIME = 60.0  # s, over which the output is averaged; a whole number of grid steps
POWER_ON = 300.0  # s before the first reading of a run
WARM_UP_TIME = 1800.0  # s, warm-up of the electronics after power-on
MOVE_TIME = 60.0  # s, time to rotate to a position and come to rest


class World:
    """Conditions of each reading that effects depend on: a row per reading, a column per instant of its averaging.

    Attributes:
        plan: plan of the test.
        run, cell: index of each reading's run and cell, (n,).
        point: set point of its cell, °C, (n,).
        tilt, angle: γ and θ as set, rad, (n, 1).
        time: time since the start of the test, s, (n, m), as all below.
        share: elapsed fraction of the test, 0 at the first reading and 1 at the last.
        device, element, fixture, base: temperatures, °C.
        heating: temperature rate of the device, °C/h.
        laboratory, foundation: temperature of the laboratory, and of the base that follows it, °C.
        direction: state of hysteresis, −1 … 1.
        warmth: fraction of the self-heating not yet reached, 1 at power-on.
        supply: voltage of the supply, V.
        tide: components ∥ (towards east) and ⊥ (north), each relative to its monthly peak.
        by_cell, by_run: standard normal numbers by effect, one per reading, equal within a cell or run.
    """

    def __init__(
        self,
        plan: Campaign,
        generators: Mapping[str, np.random.Generator],
        cells: tuple[str, ...],
        runs: tuple[str, ...],
    ) -> None:
        """Simulate the plan.

        Args:
            plan: plan of the test.
            generators: random-number generators "chamber", "laboratory", "groups", "supply".
            cells, runs: names of quantities that vary between cells, and between runs.
        """
        self.plan, done = plan, _CarriedOut(plan)
        grid, body = np.arange(0.0, done.end + GRID, GRID), partial(first_order_body, step=GRID)
        run, cell, self.point, tilt, angle, start = map(np.array, zip(*done.readings, strict=True))
        self.run, self.cell, self.tilt, self.angle = run, cell, tilt[:, None], angle[:, None]
        moments = np.arange(round(READING_TIME / GRID))
        index = np.rint(start / GRID).astype(int)[:, None] + moments
        self.time = grid[index] + 0.5 * GRID
        middle = self.time.mean(axis=1)
        self.share = (self.time - middle[0]) / (middle[-1] - middle[0])
        on = np.array([first for first, _ in done.power])[run][:, None]
        self.warmth = np.exp(-(self.time - on) / WARM_UP_TIME)
        wander = correlated(generators["chamber"], grid.size, WANDER_TIME, GRID)
        calm = body(ramp_limited(grid, *zip(*done.goals, strict=True), plan.ramp), CHAMBER_TAU)
        air = calm + plan.chamber_wander * wander
        device = body(air, DEVICE_TAU)
        self.device = device[index]
        self.element = body(device, LAG_TIME)[index]
        self.fixture = body(air, FIXTURE_TAU)[index]
        self.base = body(air, BASE_TIME)[index]
        self.heating = (np.gradient(device) * HOUR / GRID)[index]
        self.direction = _hysteresis(grid, body(calm, DEVICE_TAU), done.power)[index]
        slow = correlated(generators["laboratory"], grid.size, LABORATORY_WANDER_TIME, GRID)
        daily = plan.laboratory_daily * np.cos(2 * np.pi * (BEGIN + grid / DAY))
        laboratory = plan.laboratory + plan.laboratory_wander * slow - daily
        self.laboratory = laboratory[index]
        self.foundation = body(laboratory, LABORATORY_TIME)[index]
        self.supply = wandering_supply(generators["supply"], self.time)
        self.tide = tide(self.time)
        normal = generators["groups"].standard_normal
        self.by_cell = {name: normal(cell.max() + 1)[cell][:, None] for name in cells}
        self.by_run = {name: normal(run.max() + 1)[run][:, None] for name in runs}


class _CarriedOut:
    """Schedule of the test, s: readings as (run, cell, point, tilt, angle, start), set points, and power.

    Set points are (time, goal), power (on, off).
    """

    def __init__(self, plan: Campaign) -> None:
        self.readings: list[tuple[int, int, float, float, float, float]] = []
        self.goals: list[tuple[float, float]] = []
        self.power: list[tuple[float, float]] = []
        now, cells, free = 0.0, 0, 0.0
        spread = [2 * np.pi * k / plan.positions for k in range(plan.positions)]
        everywhere = [SetUp(tilt, angle) for tilt in plan.tilts for angle in spread]
        for run, stay in enumerate([[s] for s in plan.set_ups] or [everywhere] * plan.runs):
            order = plan.temperatures
            order = order[::-1] if plan.alternate and run % 2 else order
            for number, point in enumerate(order):
                if number == 0:
                    self.goals.append((free, point))
                    now += plan.soak
                    self.power.append((max(now - POWER_ON, 0.0), now))
                else:
                    self.goals.append((now, point))
                    now += abs(point - order[number - 1]) / plan.ramp * 60.0 + plan.soak
                for set_up in stay:
                    now += MOVE_TIME
                    for _ in range(plan.repeats):
                        now = GRID * np.ceil(now / GRID)
                        self.readings.append((run, cells, point, *set_up, now))
                        now += READING_TIME
                cells += 1
            self.power[-1] = (self.power[-1][0], now)
            free, now = now, now + plan.pause
        self.end = self.readings[-1][-1] + 2 * READING_TIME


def _hysteresis(grid: Array, temperature: Array, power: list[tuple[float, float]]) -> Array:
    """Integrate dh = (sign(dT) − h)·|dT|/REVERSAL, as friction at a joint, reset at every power-on.

    `temperature` is without the chamber's wander, which is too small to move a joint.
    """
    on = np.zeros(grid.size, dtype=bool)
    for first, off in power:
        on |= (grid >= first) & (grid <= off)
    state, states = 0.0, np.zeros(grid.size)
    for k, step in enumerate(np.diff(temperature, prepend=temperature[0])):
        share = -np.expm1(-abs(step) / REVERSAL)
        state += (np.sign(step) - state) * share
        state *= 1.0 if on[k] else np.exp(-GRID / FORGETTING)
        states[k] = state
    return states
