"""Simulator of batches of accelerometers on a centrifuge arm with hidden effects, and their true values.

The test is simulated in ten steps per reading, which are averaged: an arm driven through plateaus, a fixture heated by
windage, a slow disturbance common to all devices, and one for each device. Disturbances are thermal transients and slow
oscillations, not the polynomials of the model; their time runs from 0 to 1 over the record.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayescal_models.differential_pair.campaign import (
    DEPARTURE_RATIO,
    DISTURBANCE_UG,
    GRAVITY,
    PLATEAU_LEVEL_G,
    RADIUS,
    SCALE_SD_PPM,
    SENSITIVITY_SD,
    Campaign,
    G,
)
from bayescal_models.simulated import (
    SUPPLY_V,
    Array,
    needs_supply_column,
    simulate_supply,
    spawn_generators,
    validate_effects,
)

SUBSTEPS = 10  # simulation steps per reading
WARMING_TAU_RECORDS = 0.45  # durations of the record, time constant of the heating by windage
EFFECT_NAMES = (
    *("environment.temperature", "scale.second_order", "misalignment.device"),
    *("input.radius", "timing.skew", "bias.drift", "bias.device", "bias.supply"),
)


@dataclass(frozen=True)
class Truth:
    """True values of a simulated batch; devices in the order outer, inner.

    Attributes:
        names: names of the devices.
        outer: number of outer devices.
        scale: 1 + κ of each device, (K,).
        sensitivity: λd of each device, (K,).
        environment: λd·u + v of each device, averaged like the readings, µg, (K, T).
        acceleration: commanded acceleration, µg, (T,).
    """

    names: tuple[str, ...]
    outer: int
    scale: Array
    sensitivity: Array
    environment: Array
    acceleration: Array


def simulate_columns(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """Simulate a batch with hidden effects; return columns by name; arguments as of `simulate_batch`."""
    return simulate_batch(effects, seed=seed, campaign=campaign)[0]


def simulate_batch(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> tuple[dict[str, Any], Truth]:
    """Simulate a batch with hidden effects; return columns by name, in the instrument's units, and the true values.

    Args:
        effects: canonical name → true size in the coefficient's unit: the standard deviation over devices for
            effects with one coefficient per device, otherwise the coefficient.
        seed: seed of the random-number generator; the same seed gives the same devices, disturbance and noise for any
            effects and profile.
        campaign: plan of the test; by default `Campaign()`.

    Raises:
        ValueError: an unknown effect, or a size that is not finite.
    """
    plan, sizes = campaign or Campaign(), dict(effects or {})
    validate_effects(sizes, EFFECT_NAMES, "a batch")
    count = plan.outer + plan.inner
    streams = ("devices", "environment", "own", "hidden", "noise", "thermometer", "supply")
    rngs = spawn_generators(streams, seed)
    times = (np.arange(plan.samples * SUBSTEPS) + 0.5) * plan.duration / (plan.samples * SUBSTEPS)
    progress = times / plan.duration
    sensitivity = 1.0 + SENSITIVITY_SD * rngs["devices"].standard_normal(count)
    scale = 1.0 + 1e-6 * SCALE_SD_PPM * rngs["devices"].standard_normal(count)
    u = DISTURBANCE_UG * simulate_shared_disturbance(rngs["environment"], progress)
    v = DEPARTURE_RATIO * DISTURBANCE_UG * simulate_departures(rngs["own"], progress, count)
    if plan.alike:
        sensitivity, scale, v = np.ones(count), np.ones(count), 0.0 * v
    temperature = 25.0 + plan.warming * compute_temperature_rise(progress)
    u = u + sizes.get("environment.temperature", 0.0) * (temperature - temperature.mean())
    environment = sensitivity[:, None] * u + v
    sign = np.repeat([1.0, -1.0], [plan.outer, plan.inner])
    deviates = {name: rngs["hidden"].standard_normal(count) for name in EFFECT_NAMES}
    device_sizes = {name: sizes.get(name, 0.0) * z for name, z in deviates.items()}
    supply = simulate_supply(rngs["supply"], times)
    outputs = _simulate_outputs(plan, times, sign, scale, device_sizes) + environment
    outputs = outputs + device_sizes["bias.supply"][:, None] * (supply - SUPPLY_V)
    noise_sd = plan.noise / np.sqrt(plan.duration / plan.samples)
    noise = noise_sd * rngs["noise"].standard_normal((count, plan.samples))
    readings = average_steps(outputs) + noise
    groups = np.repeat(["outer", "inner"], [plan.outer, plan.inner])
    numbers = (*range(1, plan.outer + 1), *range(1, plan.inner + 1))
    names = tuple(f"{group} {number}" for group, number in zip(groups, numbers, strict=True))
    commanded = average_steps(acceleration(plan, times))
    # Records of successive devices, as in a logger's file.
    columns = {
        "device": np.repeat(names, plan.samples),
        "group": np.repeat(groups, plan.samples),
        "time": np.tile(plan.time, count),
        "acceleration": np.tile(commanded, count),
        "output": readings.ravel(),
    }
    if needs_supply_column(sizes):
        columns["supply_voltage"] = np.tile(average_steps(supply), count)
    if plan.thermometer is not None:
        thermometer_errors = plan.thermometer * rngs["thermometer"].standard_normal(plan.samples)
        columns["temperature"] = np.tile(average_steps(temperature) + thermometer_errors, count)
    truth = Truth(names, plan.outer, scale, sensitivity, average_steps(environment), commanded)
    return columns, truth


def acceleration(plan: Campaign, time: Array) -> Array:
    """Return the acceleration at the devices at `time`, s, in µg; the arm's speed changes smoothly between plateaus."""
    if plan.profile == "plateau":
        return np.full(np.shape(time), PLATEAU_LEVEL_G * G)
    speeds = np.sqrt(np.asarray(plan.levels))
    switch_times = plan.duration * np.arange(1, len(speeds)) / len(speeds)
    speed = np.full(np.shape(time), speeds[0])
    for switch_time, speed_change in zip(switch_times, np.diff(speeds), strict=True):
        fraction = np.clip((time - switch_time) / plan.ramp + 0.5, 0.0, 1.0)
        speed = speed + speed_change * 0.5 * (1.0 - np.cos(np.pi * fraction))
    return speed**2 * G


def average_steps(values: Array) -> Array:
    """Average simulation steps to readings along the last axis: (…, T·`SUBSTEPS`) to (…, T)."""
    return values.reshape(*values.shape[:-1], -1, SUBSTEPS).mean(axis=-1)


def _simulate_outputs(
    plan: Campaign, times: Array, sign: Array, scale: Array, device_sizes: Mapping[str, Array]
) -> Array:
    """Return the devices' outputs without environment and noise, µg, (K, simulation steps)."""
    delayed = times[None, :] - 1e-3 * device_sizes["timing.skew"][:, None]
    true_input = acceleration(plan, delayed) * (1.0 + 1e-6 * device_sizes["input.radius"][:, None])
    true_input = sign[:, None] * true_input
    # A spring that softens with its deflection: K2 and a much smaller third order.
    softening = 1e-6 * device_sizes["scale.second_order"][:, None] * true_input / G
    output = scale[:, None] * true_input / (1.0 - softening)
    step = 1e-3  # s, step of the finite difference of the arm's speed
    speeds = [np.sqrt(acceleration(plan, times + d) / G * GRAVITY / RADIUS) for d in (-step, step)]
    tangential = RADIUS * (speeds[1] - speeds[0]) / (2 * step) / GRAVITY * G
    tilt = np.sin(1e-3 * device_sizes["misalignment.device"])[:, None]
    ageing = np.log2(1.0 + times / plan.duration)
    drift = device_sizes["bias.drift"][:, None] * (ageing - ageing.mean())
    return output + tilt * (G + tangential) + drift + device_sizes["bias.device"][:, None]


def _simulate_transient(rng: np.random.Generator, time: Array) -> Array:
    """Simulate an exponential transient from 0 to the asymptote 1 with a random time constant."""
    return 1.0 - np.exp(-time / rng.uniform(0.2, 0.7))


def _simulate_wave(rng: np.random.Generator, time: Array) -> Array:
    """Simulate a slow oscillation of unit amplitude, with a random period of 1 to 2.5 times the record."""
    return np.sin(2 * np.pi * (time / rng.uniform(1.0, 2.5) + rng.uniform()))


def simulate_shared_disturbance(rng: np.random.Generator, time: Array) -> Array:
    """Simulate the shared disturbance at `time`, 0 … 1 over the record; its rms is 1."""
    transient = rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 1.6) * _simulate_transient(rng, time)
    waves = [rng.uniform(0.2, 0.7) * _simulate_wave(rng, time) for _ in range(2)]
    disturbance = transient + waves[0] + waves[1]
    return disturbance / np.sqrt(np.mean(disturbance**2))


def simulate_departures(rng: np.random.Generator, time: Array, count: int) -> Array:
    """Simulate each device's departure from the shared disturbance, (count, n): offset, transient, wave; rms ≈ 1."""
    records = []
    for _ in range(count):
        offset, transient_size, wave_size = rng.standard_normal(3) / np.sqrt(3.0)
        transient = _simulate_transient(rng, time)
        records.append(
            offset
            + transient_size * transient / np.sqrt(np.mean(transient**2))
            + wave_size * np.sqrt(2.0) * _simulate_wave(rng, time)
        )
    return np.array(records)


def compute_temperature_rise(time: Array) -> Array:
    """Return the fixture's temperature rise, with the asymptote 1, plus an oscillation of the room, amplitude 0.1."""
    return 1.0 - np.exp(-time / WARMING_TAU_RECORDS) + 0.1 * np.sin(2 * np.pi * time / 0.6)
