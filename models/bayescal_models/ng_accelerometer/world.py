"""Conditions of a simulated test on the tilted table: attitude and temperatures at every reading.

The chamber's air follows a ramp-limited set point; device, fixture and base follow the air, and the sensing element
the device, as first-order bodies. Temperatures are simulated in steps of ten seconds over the test with its pauses. The
laboratory temperature has a daily variation and slow correlated noise, and the foundation follows it with a lag.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from bayescal_models.ng_accelerometer.campaign import STEP_S, Campaign, SetUp
from bayescal_models.ng_accelerometer.moon_and_sun import DAY_S, TEST_START_DAY, compute_tide
from bayescal_models.simulated import (
    HOUR,
    Array,
    apply_low_pass,
    compute_ramped_set_point,
    correlated_noise,
    simulate_supply,
)

CHAMBER_TAU_S, DEVICE_TAU_S, FIXTURE_TAU_S = 180.0, 600.0, 900.0  # s, behind set point, air, air
BASE_TAU_S, LABORATORY_TAU_S = 1800.0, 900.0  # s, lags of the base behind chamber and laboratory
CHAMBER_NOISE_TAU_S, LAB_NOISE_TAU_S = 600.0, 2 * HOUR  # s, of Ornstein–Uhlenbeck noise
REVERSAL_DEGC = 1.0  # °C, temperature change in which the hysteresis reverses
HYSTERESIS_DECAY_TAU_S = 2 * HOUR  # s, decay time of the hysteresis while the power is off
ELEMENT_TAU_S = 1800.0  # s, lag of the sensing element behind the device's thermometer
READING_S = 60.0  # s, averaging time of a reading, a multiple of the grid step
POWER_ON_LEAD_S = 300.0  # s, from power-on to the first reading of a run
WARM_UP_S = 1800.0  # s, warm-up of the electronics after power-on
MOVE_DURATION_S = 60.0  # s, time to rotate to a position and come to rest


class Conditions:
    """Conditions of a test: one row per reading, one column per instant within the reading's averaging time.

    Attributes:
        plan: plan of the test.
        run, cell: index of each reading's run and cell, (n,).
        point: set point of each reading's cell, °C, (n,).
        tilt, angle: set tilt γ and rotation angle θ, rad, (n, 1).
        time: time since the start of the test, s, (n, m); the following have the same shape.
        elapsed_fraction: elapsed fraction of the test, 0 at the first reading and 1 at the last.
        device, element, fixture, base: temperatures, °C.
        temperature_rate: temperature rate of the device, °C/h.
        laboratory, foundation: temperature of the laboratory, and of the foundation that follows it, °C.
        hysteresis: state of the hysteresis, −1 … 1.
        warm_up_deficit: remaining fraction of the warm-up, 1 at power-on.
        supply: supply voltage, V.
        tide: tidal tilts ∥ (towards east) and ⊥ (towards north), each relative to its monthly peak.
        cell_deviates, run_deviates: quantity → standard normal deviates (n, 1), constant within a cell or run.
    """

    def __init__(
        self,
        plan: Campaign,
        generators: Mapping[str, np.random.Generator],
        cell_quantities: tuple[str, ...],
        run_quantities: tuple[str, ...],
    ) -> None:
        """Simulate the conditions of a planned test.

        Args:
            plan: plan of the test.
            generators: random-number generators "chamber", "laboratory", "groups", "supply".
            cell_quantities, run_quantities: names of quantities that vary between cells, or runs.
        """
        self.plan, schedule = plan, _Schedule(plan)
        low_pass = partial(apply_low_pass, step=STEP_S)
        grid = np.arange(0.0, schedule.end + STEP_S, STEP_S)
        readings = zip(*schedule.readings, strict=True)
        run, cell, self.point, tilt, angle, start = map(np.array, readings)
        self.run, self.cell, self.tilt, self.angle = run, cell, tilt[:, None], angle[:, None]
        sample_offsets = np.arange(round(READING_S / STEP_S))
        index = np.rint(start / STEP_S).astype(int)[:, None] + sample_offsets
        self.time = grid[index] + 0.5 * STEP_S
        mid_times = self.time.mean(axis=1)
        self.elapsed_fraction = (self.time - mid_times[0]) / (mid_times[-1] - mid_times[0])
        power_on = np.array([start for start, _ in schedule.power])[run][:, None]
        self.warm_up_deficit = np.exp(-(self.time - power_on) / WARM_UP_S)
        noise = correlated_noise(generators["chamber"], grid.size, CHAMBER_NOISE_TAU_S, STEP_S)
        starts, goals = zip(*schedule.set_points, strict=True)
        set_point = compute_ramped_set_point(grid, starts, goals, plan.ramp)
        mean_air = low_pass(set_point, CHAMBER_TAU_S)
        air = mean_air + plan.chamber_wander * noise
        device = low_pass(air, DEVICE_TAU_S)
        self.device = device[index]
        self.element = low_pass(device, ELEMENT_TAU_S)[index]
        self.fixture = low_pass(air, FIXTURE_TAU_S)[index]
        self.base = low_pass(air, BASE_TAU_S)[index]
        self.temperature_rate = (np.gradient(device) * HOUR / STEP_S)[index]
        self.hysteresis = _integrate(grid, low_pass(mean_air, DEVICE_TAU_S), schedule.power)[index]
        noise = correlated_noise(generators["laboratory"], grid.size, LAB_NOISE_TAU_S, STEP_S)
        daily_course = plan.laboratory_daily * np.cos(2 * np.pi * (TEST_START_DAY + grid / DAY_S))
        laboratory = plan.laboratory + plan.laboratory_wander * noise - daily_course
        self.laboratory = laboratory[index]
        self.foundation = low_pass(laboratory, LABORATORY_TAU_S)[index]
        self.supply = simulate_supply(generators["supply"], self.time)
        self.tide = compute_tide(self.time)
        draw = generators["groups"].standard_normal
        self.cell_deviates = {name: draw(cell.max() + 1)[cell][:, None] for name in cell_quantities}
        self.run_deviates = {name: draw(run.max() + 1)[run][:, None] for name in run_quantities}


class _Schedule:
    """Schedule of the test, times in s.

    `readings` has (run, cell, set point °C, tilt, angle, start), `set_points` (time, °C), `power` (on, off).
    """

    def __init__(self, plan: Campaign) -> None:
        self.readings: list[tuple[int, int, float, float, float, float]] = []
        self.set_points: list[tuple[float, float]] = []
        self.power: list[tuple[float, float]] = []
        clock, cell_count, previous_end = 0.0, 0, 0.0
        angles = [2 * np.pi * k / plan.positions for k in range(plan.positions)]
        all_set_ups = [SetUp(tilt, angle) for tilt in plan.tilts for angle in angles]
        for run, set_ups in enumerate([[s] for s in plan.set_ups] or [all_set_ups] * plan.runs):
            set_points = plan.temperatures
            set_points = set_points[::-1] if plan.alternate and run % 2 else set_points
            for point_index, point in enumerate(set_points):
                if point_index == 0:
                    self.set_points.append((previous_end, point))
                    clock += plan.soak
                    self.power.append((max(clock - POWER_ON_LEAD_S, 0.0), clock))
                else:
                    self.set_points.append((clock, point))
                    clock += abs(point - set_points[point_index - 1]) / plan.ramp * 60.0 + plan.soak
                for set_up in set_ups:
                    clock += MOVE_DURATION_S
                    for _ in range(plan.repeats):
                        clock = STEP_S * np.ceil(clock / STEP_S)
                        self.readings.append((run, cell_count, point, *set_up, clock))
                        clock += READING_S
                cell_count += 1
            self.power[-1] = (self.power[-1][0], clock)
            previous_end, clock = clock, clock + plan.pause
        self.end = self.readings[-1][-1] + 2 * READING_S


def _integrate(grid: Array, temperature: Array, power: list[tuple[float, float]]) -> Array:
    """Return the hysteresis h of a joint with friction, dh = (sign(dT) − h)·|dT|/`REVERSAL_DEGC`, at grid times, s.

    It decays while the power is off. `temperature` has no chamber noise, which is too small to move a joint.
    """
    is_powered = np.zeros(grid.size, dtype=bool)
    for power_on, power_off in power:
        is_powered |= (grid >= power_on) & (grid <= power_off)
    state, states = 0.0, np.zeros(grid.size)
    for k, change in enumerate(np.diff(temperature, prepend=temperature[0])):
        step_fraction = -np.expm1(-abs(change) / REVERSAL_DEGC)
        state += (np.sign(change) - state) * step_fraction
        state *= 1.0 if is_powered[k] else np.exp(-STEP_S / HYSTERESIS_DECAY_TAU_S)
        states[k] = state
    return states
