"""The coupled thermal world: a chamber drives circuit and head, and the powered circuit heats itself and the head.

    τ_c·dTc/dt = T_air + h·p(t) − Tc          p = 1 with power, else 0
    τ_h·dTh/dt = (1−k)·T_air + k·Tc − Th

so that both thermometers, their rates and their difference hang together, as they do in a sensor.
Source: structure from source 2's two thermometers; equations and numbers ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayescal_models.quartz_beam_accelerometer.campaign import GRID, POSITIONS, Campaign
from bayescal_models.simulated import Array, first_order_body


@dataclass(frozen=True)
class World:
    """A test step by step on the grid, and the readings taken of it.

    Attributes:
        time: s, one origin over all runs, (m,).
        circuit, head: temperatures, °C, (m,).
        circuit_rate, head_rate: true heating rates, °C/min, (m,).
        warmth: share of the warm-up reached, 0 cold … 1 warm, (m,).
        samples: grid points averaged into each reading, (n, samples).
        run: of each reading, counted from 0, (n,).
        point: soak temperature of each reading, °C, not a number on ramps, (n,).
        acceleration: g, (n,).
    """

    time: Array
    circuit: Array
    head: Array
    circuit_rate: Array
    head_rate: Array
    warmth: Array
    samples: NDArray[np.intp]
    run: NDArray[np.intp]
    point: Array
    acceleration: Array

    def average(self, values: Array) -> Array:
        """Mean of a quantity over the samples of each reading, (n,), in its own unit."""
        return values[self.samples].mean(axis=1)

    @property
    def uneven(self) -> Array:
        """Circuit less head, °C, (m,)."""
        return self.circuit - self.head

    @property
    def cell(self) -> NDArray[np.intp]:
        """Number of each reading's cell (run and soak temperature), −1 on ramps, (n,)."""
        soaked = ~np.isnan(self.point)
        pairs = np.column_stack([self.run, np.where(soaked, self.point, 0.0)])
        _, codes = np.unique(pairs, axis=0, return_inverse=True)
        return np.where(soaked, codes.ravel(), -1)


@dataclass
class _Plan:
    """Set points and readings, written down as the test goes on; times in s."""

    room: float
    now: float = 0.0
    here: float = 0.0

    def __post_init__(self) -> None:
        self.here = self.room
        self.knots: list[tuple[float, float]] = [(0.0, self.room)]
        self.power: list[tuple[float, float]] = []
        self.readings: list[tuple[float, int, float, float]] = []  # end, run, point, acceleration

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.knots.append((self.now, self.here))

    def go(self, goal: float, speed: float) -> None:
        """Lead the set point to `goal`, °C, at `speed`, °C/min."""
        self.now += 60.0 * abs(goal - self.here) / speed
        self.here = goal
        self.knots.append((self.now, self.here))


def make_world(campaign: Campaign) -> World:
    """Carry out a campaign's plan: chamber, circuit, head, and when what was read."""
    plan = _planned(campaign)
    time = GRID * np.arange(int(np.ceil(plan.now / GRID)) + 1, dtype=np.float64)
    knots, goals = np.array(plan.knots).T
    air = first_order_body(np.interp(time, knots, goals), campaign.air_time, GRID)
    powered = np.zeros(time.size)
    for on, off in plan.power:
        powered[(time > on) & (time <= off)] = 1.0
    around_circuit = air + campaign.self_heating * powered
    circuit = first_order_body(around_circuit, campaign.circuit_time, GRID, start=air[0])
    around_head = (1 - campaign.coupling) * air + campaign.coupling * circuit
    head = first_order_body(around_head, campaign.head_time, GRID)
    ends, run, point, acceleration = (
        np.array(column) for column in zip(*plan.readings, strict=True)
    )
    count = round(campaign.average / GRID)
    last = np.rint(ends / GRID).astype(np.intp)
    return World(
        time=time,
        circuit=circuit,
        head=head,
        circuit_rate=60.0 * (around_circuit - circuit) / campaign.circuit_time,
        head_rate=60.0 * (around_head - head) / campaign.head_time,
        warmth=first_order_body(powered, campaign.warm_up_time, GRID),
        samples=last[:, None] - np.arange(count)[::-1],
        run=run.astype(np.intp),
        point=point,
        acceleration=acceleration,
    )


def _planned(campaign: Campaign) -> _Plan:
    plan, run = _Plan(campaign.room), 0
    for repeat in range(int(campaign.repeats)):
        with_order = campaign.temperatures[:: -1 if repeat % 2 else 1]
        _tumble(plan, campaign, run, with_order)
        run += 1
    for speed in campaign.ramp_speeds:
        for attitude in campaign.attitudes:
            _ramp(plan, campaign, run, attitude, speed)
            run += 1
    return plan


def _tumble(plan: _Plan, campaign: Campaign, run: int, temperatures: tuple[float, ...]) -> None:
    on = plan.now
    plan.wait(campaign.average)
    plan.readings.append((plan.now, run, np.nan, POSITIONS[0]))
    for temperature in temperatures:
        plan.go(temperature, campaign.chamber_speed)
        plan.wait(campaign.soak)
        for acceleration in POSITIONS:
            plan.wait(campaign.position_time)
            plan.readings.append((plan.now, run, temperature, acceleration))
    _switch_off(plan, campaign, on)


def _ramp(plan: _Plan, campaign: Campaign, run: int, attitude: float, speed: float) -> None:
    on = plan.now
    plan.wait(campaign.hold)
    for goal in (min(campaign.temperatures), max(campaign.temperatures)):
        plan.go(goal, speed)
        plan.wait(campaign.hold)
    plan.go(campaign.room, speed)
    for end in np.arange(on + campaign.interval, plan.now + 1e-6, campaign.interval):
        plan.readings.append((float(end), run, np.nan, attitude))
    _switch_off(plan, campaign, on)


def _switch_off(plan: _Plan, campaign: Campaign, on: float) -> None:
    plan.power.append((on, plan.now))
    plan.go(campaign.room, campaign.chamber_speed)
    plan.wait(campaign.pause)
