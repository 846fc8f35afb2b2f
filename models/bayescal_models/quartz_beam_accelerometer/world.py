"""Coupled thermal model: a chamber drives circuit and head, and the powered circuit heats itself and the head.

    τ_c·dTc/dt = T_air + h·p(t) − Tc          p = 1 with power, else 0
    τ_h·dTh/dt = (1−k)·T_air + k·Tc − Th

so that both thermometers, their rates and their difference are correlated, as in a sensor.
Source: structure from source 2's two thermometers; equations and numbers ours.
"""

from __future__ import annotations

import numpy as np

from bayescal_models.quartz_beam_accelerometer.campaign import GRID, POSITIONS, Campaign
from bayescal_models.simulated import SUPPLY, Clock

CIRCUIT_TIME, HEAD_TIME = 300.0, 720.0  # s
POSITION_TIME = 180.0  # s, from position to position
ROOM = 25.0  # °C, at power-on
COUPLING = 0.15  # thermal coupling of the head to the circuit; the remainder is to air
SELF_HEATING = 4.0  # °C, final temperature rise of the powered circuit
WARM_UP_TIME = 900.0  # s


class World(Clock):
    """Conditions of a test at simulation steps (m,), and at the readings (n,).

    Attributes:
        plan: plan of the test.
        circuit, head: temperatures, °C; `uneven` is circuit less head.
        circuit_rate, head_rate: true heating rates, °C/min.
        supply: supply voltage, V; nominal unless replaced by a varying one.
        warmth: fraction of the warm-up reached, 0 cold … 1 warm.
        run: run of each reading, counted from 0.
        point: soak temperature of each reading, °C, NaN on ramps.
        cell: number of each reading's cell (run and soak temperature), −1 on ramps.
        acceleration: acceleration at each reading, g.
    """

    step = GRID

    def __init__(self, plan: Campaign) -> None:
        self.plan, carried_out = plan, _CarriedOut(plan)
        self.time = GRID * np.arange(int(np.ceil(carried_out.now / GRID)) + 1, dtype=np.float64)
        knots, goals = np.array(carried_out.knots).T
        air = self.body(np.interp(self.time, knots, goals), plan.air_time)
        powered = np.zeros(self.time.size)
        for on, off in carried_out.power:
            powered[(self.time > on) & (self.time <= off)] = 1.0
        around_circuit = air + SELF_HEATING * powered
        self.circuit = self.body(around_circuit, CIRCUIT_TIME, start=air[0])
        around_head = (1 - COUPLING) * air + COUPLING * self.circuit
        self.head = self.body(around_head, HEAD_TIME)
        self.uneven = self.circuit - self.head
        self.circuit_rate = 60.0 * (around_circuit - self.circuit) / CIRCUIT_TIME
        self.head_rate = 60.0 * (around_head - self.head) / HEAD_TIME
        self.supply = np.full(self.time.size, SUPPLY)
        self.warmth = self.body(powered, WARM_UP_TIME)
        ends, run, self.point, self.acceleration = map(
            np.array, zip(*carried_out.readings, strict=True)
        )
        self.run, last = run.astype(np.intp), np.rint(ends / GRID).astype(np.intp)
        self.samples = last[:, None] - np.arange(round(plan.average / GRID))[::-1]
        soaked = ~np.isnan(self.point)
        pairs = np.column_stack([self.run, np.where(soaked, self.point, 0.0)])
        _, codes = np.unique(pairs, axis=0, return_inverse=True)
        self.cell = np.where(soaked, codes.ravel(), -1)


class _CarriedOut:
    """Schedule of a campaign: knots of the set point, times of power, and readings; times in s."""

    def __init__(self, plan: Campaign) -> None:
        self.plan, self.now, self.here = plan, 0.0, ROOM
        self.knots: list[tuple[float, float]] = [(0.0, ROOM)]
        self.power: list[tuple[float, float]] = []
        self.readings: list[tuple[float, int, float, float]] = []  # end, run, point, acceleration
        run = 0
        for repeat in range(int(plan.repeats)):
            self._tumble(run, plan.temperatures[:: -1 if repeat % 2 else 1])
            run += 1
        for speed in plan.ramp_speeds:
            for attitude in plan.attitudes:
                self._ramp(run, attitude, speed)
                run += 1

    def _wait(self, seconds: float) -> None:
        self.now += seconds
        self.knots.append((self.now, self.here))

    def _go(self, goal: float, speed: float) -> None:
        """Move the set point to `goal`, °C, at `speed`, °C/min."""
        self.now += 60.0 * abs(goal - self.here) / speed
        self.here = goal
        self.knots.append((self.now, self.here))

    def _tumble(self, run: int, temperatures: tuple[float, ...]) -> None:
        on = self.now
        self._wait(self.plan.average)
        self.readings.append((self.now, run, np.nan, POSITIONS[0]))
        for temperature in temperatures:
            self._go(temperature, self.plan.chamber_speed)
            self._wait(self.plan.soak)
            for acceleration in POSITIONS:
                self._wait(POSITION_TIME)
                self.readings.append((self.now, run, temperature, acceleration))
        self._switch_off(on)

    def _ramp(self, run: int, attitude: float, speed: float) -> None:
        plan, on = self.plan, self.now
        self._wait(plan.hold)
        for goal in (min(plan.temperatures), max(plan.temperatures)):
            self._go(goal, speed)
            self._wait(plan.hold)
        self._go(ROOM, speed)
        for end in np.arange(on + plan.interval, self.now + 1e-6, plan.interval):
            self.readings.append((float(end), run, np.nan, attitude))
        self._switch_off(on)

    def _switch_off(self, on: float) -> None:
        self.power.append((on, self.now))
        self._go(ROOM, self.plan.chamber_speed)
        self._wait(self.plan.pause)
