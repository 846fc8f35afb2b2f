"""Coupled thermal model: the chamber's air drives circuit (Tc) and head (Th); self-heating h of the powered circuit.

    τ_c·dTc/dt = T_air + h·p(t) − Tc          p = 1 with power on, else 0
    τ_h·dTh/dt = (1−k)·T_air + k·Tc − Th      k: coupling of head and circuit

Both temperatures, their rates and their difference are therefore correlated, as in a real sensor.
Source: structure from source 2's two thermometers; equations and numbers assumed.
"""

from __future__ import annotations

import numpy as np

from bayescal_models.quartz_beam_accelerometer.campaign import STEP_S, TUMBLE_G, Campaign
from bayescal_models.simulated import SUPPLY_V, TimeGrid

CIRCUIT_TAU_S, HEAD_TAU_S = 300.0, 720.0  # s, thermal time constants τ_c, τ_h
POSITION_INTERVAL_S = 180.0  # s, time per position of a tumble
ROOM_TEMPERATURE_DEGC = 25.0  # °C, at power-on
COUPLING = 0.15  # k, thermal coupling of the head to the circuit; to air it is 1 − k
SELF_HEATING = 4.0  # °C, h, final temperature rise of the powered circuit
WARM_UP_S = 900.0  # s, time constant of the warm-up


class Conditions(TimeGrid):
    """True conditions of a test, at simulation steps (m,) and, from `run` on, at readings (n,).

    Attributes:
        plan: plan of the test.
        circuit, head: temperatures of circuit and head, °C.
        gradient: temperature of the circuit minus that of the head, °C.
        circuit_rate, head_rate: temperature rates of circuit and head, °C/min.
        supply: supply voltage, V; nominal until the simulator replaces it.
        warm_up_fraction: completed fraction of the warm-up, 0 at power-on … 1.
        run: run index of each reading, from 0.
        point: soak temperature of each reading, °C, NaN on ramps.
        cell: index of each reading's cell (run and soak temperature), −1 on ramps.
        acceleration: acceleration at each reading, g.
    """

    step = STEP_S

    def __init__(self, plan: Campaign) -> None:
        self.plan, schedule = plan, _Schedule(plan)
        self.time = STEP_S * np.arange(int(np.ceil(schedule.clock / STEP_S)) + 1, dtype=np.float64)
        knots, set_points = np.array(schedule.knots).T
        air = self.low_pass(np.interp(self.time, knots, set_points), plan.air_time)
        power_state = np.zeros(self.time.size)
        for power_on, power_off in schedule.power:
            power_state[(self.time > power_on) & (self.time <= power_off)] = 1.0
        circuit_drive = air + SELF_HEATING * power_state
        self.circuit = self.low_pass(circuit_drive, CIRCUIT_TAU_S, start=air[0])
        head_drive = (1 - COUPLING) * air + COUPLING * self.circuit
        self.head = self.low_pass(head_drive, HEAD_TAU_S)
        self.gradient = self.circuit - self.head
        self.circuit_rate = 60.0 * (circuit_drive - self.circuit) / CIRCUIT_TAU_S
        self.head_rate = 60.0 * (head_drive - self.head) / HEAD_TAU_S
        self.supply = np.full(self.time.size, SUPPLY_V)
        self.warm_up_fraction = self.low_pass(power_state, WARM_UP_S)
        end_times, run, self.point, self.acceleration = map(
            np.array, zip(*schedule.readings, strict=True)
        )
        self.run, last_samples = run.astype(np.intp), np.rint(end_times / STEP_S).astype(np.intp)
        self.samples = last_samples[:, None] - np.arange(round(plan.average / STEP_S))[::-1]
        is_soaked = ~np.isnan(self.point)
        cells = np.column_stack([self.run, np.where(is_soaked, self.point, 0.0)])
        _, codes = np.unique(cells, axis=0, return_inverse=True)
        self.cell = np.where(is_soaked, codes.ravel(), -1)


class _Schedule:
    """Schedule of a campaign, times in s: `knots` (time, set point °C), `power` (on, off), and `readings`."""

    def __init__(self, plan: Campaign) -> None:
        self.plan, self.clock, self.set_point = plan, 0.0, ROOM_TEMPERATURE_DEGC
        self.knots: list[tuple[float, float]] = [(0.0, ROOM_TEMPERATURE_DEGC)]
        self.power: list[tuple[float, float]] = []
        self.readings: list[tuple[float, int, float, float]] = []  # end, run, point, acceleration
        run = 0
        for tumble in range(int(plan.repeats)):
            self._add_tumble(run, plan.temperatures[:: -1 if tumble % 2 else 1])
            run += 1
        for rate in plan.ramp_speeds:
            for attitude in plan.attitudes:
                self._add_ramp(run, attitude, rate)
                run += 1

    def _wait(self, seconds: float) -> None:
        self.clock += seconds
        self.knots.append((self.clock, self.set_point))

    def _ramp_to(self, target: float, rate: float) -> None:
        """Ramp the set point to `target`, °C, at `rate`, °C/min."""
        self.clock += 60.0 * abs(target - self.set_point) / rate
        self.set_point = target
        self.knots.append((self.clock, self.set_point))

    def _add_tumble(self, run: int, temperatures: tuple[float, ...]) -> None:
        power_on = self.clock
        self._wait(self.plan.average)
        self.readings.append((self.clock, run, np.nan, TUMBLE_G[0]))
        for temperature in temperatures:
            self._ramp_to(temperature, self.plan.chamber_speed)
            self._wait(self.plan.soak)
            for acceleration in TUMBLE_G:
                self._wait(POSITION_INTERVAL_S)
                self.readings.append((self.clock, run, temperature, acceleration))
        self._switch_off(power_on)

    def _add_ramp(self, run: int, attitude: float, rate: float) -> None:
        plan, power_on = self.plan, self.clock
        self._wait(plan.hold)
        for target in (min(plan.temperatures), max(plan.temperatures)):
            self._ramp_to(target, rate)
            self._wait(plan.hold)
        self._ramp_to(ROOM_TEMPERATURE_DEGC, rate)
        for end_time in np.arange(power_on + plan.interval, self.clock + 1e-6, plan.interval):
            self.readings.append((float(end_time), run, np.nan, attitude))
        self._switch_off(power_on)

    def _switch_off(self, power_on: float) -> None:
        self.power.append((power_on, self.clock))
        self._ramp_to(ROOM_TEMPERATURE_DEGC, self.plan.chamber_speed)
        self._wait(self.plan.pause)
