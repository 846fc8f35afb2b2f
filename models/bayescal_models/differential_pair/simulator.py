"""Simulator of batches of accelerometers on a centrifuge arm with hidden effects, and their true values.

The test is simulated at ten times per reading and averaged: an arm driven through plateaus, a fixture heated by
windage, a slow disturbance shared by all devices, and each device's own. The disturbance consists of a thermal
transient and slow oscillations, not of the polynomials of the model; its time runs from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayescal_models.differential_pair.campaign import (
    DEPARTURE,
    DISTURBANCE,
    GRAVITY,
    LEVEL,
    RADIUS,
    SCALE_SPREAD,
    SENSITIVITY_SPREAD,
    Campaign,
    G,
)
from bayescal_models.simulated import (
    SUPPLY,
    Array,
    generators,
    refuse_effects,
    supplied,
    wandering_supply,
)

FINE = 10  # simulation steps per reading
WARMING = 0.45  # time constant of the fixture's heating by windage, in records
HIDDEN = (
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
        environment: λd·u + v of each device, averaged as the readings are, µg, (K, T).
        acceleration: commanded, µg, (T,).
    """

    names: tuple[str, ...]
    outer: int
    scale: Array
    sensitivity: Array
    environment: Array
    acceleration: Array


def simulated_columns(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """Return the columns of `columns_and_truth`."""
    return columns_and_truth(effects, seed=seed, campaign=campaign)[0]


def columns_and_truth(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> tuple[dict[str, Any], Truth]:
    """Simulate a batch with hidden effects; return its columns, by name, in the instrument's units, and the truth.

    Args:
        effects: canonical name → true size in the coefficient's unit: for effects with one coefficient per device
            the standard deviation over devices, otherwise the coefficient.
        seed: seed of the random-number generator; the same seed gives the same devices, disturbance and noise for any
            effects and profile.
        campaign: the plan; `Campaign()` if not given.

    Raises:
        ValueError: an unknown effect, or a size that is not finite.
    """
    plan, sizes = campaign or Campaign(), dict(effects or {})
    refuse_effects(sizes, HIDDEN, "a batch")
    count = plan.outer + plan.inner
    uses = ("devices", "environment", "own", "hidden", "noise", "thermometer", "supply")
    random = generators(uses, seed)
    devices, environment, departure, hidden, noise, thermometer, power = random.values()
    fine = (np.arange(plan.samples * FINE) + 0.5) * plan.duration / (plan.samples * FINE)

    sensitivity = 1.0 + SENSITIVITY_SPREAD * devices.standard_normal(count)
    scale = 1.0 + 1e-6 * SCALE_SPREAD * devices.standard_normal(count)
    u = DISTURBANCE * shared(environment, fine / plan.duration)
    v = DEPARTURE * DISTURBANCE * departures(departure, fine / plan.duration, count)
    if plan.alike:
        sensitivity, scale, v = np.ones(count), np.ones(count), 0.0 * v
    temperature = 25.0 + plan.warming * warming(fine / plan.duration)
    u = u + sizes.get("environment.temperature", 0.0) * (temperature - temperature.mean())
    env = sensitivity[:, None] * u + v
    sign = np.repeat([1.0, -1.0], [plan.outer, plan.inner])
    deviates = {name: hidden.standard_normal(count) for name in HIDDEN}
    drawn = {name: sizes.get(name, 0.0) * z for name, z in deviates.items()}
    supply = wandering_supply(power, fine)
    outputs = _outputs(plan, fine, sign, scale, drawn) + env
    outputs = outputs + drawn["bias.supply"][:, None] * (supply - SUPPLY)
    scatter = plan.noise / np.sqrt(plan.duration / plan.samples)
    readings = average(outputs) + scatter * noise.standard_normal((count, plan.samples))
    groups = np.repeat(["outer", "inner"], [plan.outer, plan.inner])
    places = (*range(1, plan.outer + 1), *range(1, plan.inner + 1))
    names = tuple(f"{group} {place}" for group, place in zip(groups, places, strict=True))
    commanded = average(acceleration(plan, fine))
    # One record after another, as a logger's file would have them.
    columns = {
        "device": np.repeat(names, plan.samples),
        "group": np.repeat(groups, plan.samples),
        "time": np.tile(plan.time, count),
        "acceleration": np.tile(commanded, count),
        "output": readings.ravel(),
    }
    if supplied(sizes):
        columns["supply_voltage"] = np.tile(average(supply), count)
    if plan.thermometer is not None:
        error = plan.thermometer * thermometer.standard_normal(plan.samples)
        columns["temperature"] = np.tile(average(temperature) + error, count)
    truth = Truth(names, plan.outer, scale, sensitivity, average(env), commanded)
    return columns, truth


def acceleration(plan: Campaign, time: Array) -> Array:
    """Return the acceleration at the devices' radius, µg; the arm's speed is smooth between plateaus."""
    if plan.profile == "plateau":
        return np.full(np.shape(time), LEVEL * G)
    speeds = np.sqrt(np.asarray(plan.levels))
    edges = plan.duration * np.arange(1, len(speeds)) / len(speeds)
    speed = np.full(np.shape(time), speeds[0])
    for edge, rise in zip(edges, np.diff(speeds), strict=True):
        share = np.clip((time - edge) / plan.ramp + 0.5, 0.0, 1.0)
        speed = speed + rise * 0.5 * (1.0 - np.cos(np.pi * share))
    return speed**2 * G


def average(values: Array) -> Array:
    """Average simulation steps to readings, along the last axis."""
    return values.reshape(*values.shape[:-1], -1, FINE).mean(axis=-1)


def _outputs(
    plan: Campaign, fine: Array, sign: Array, scale: Array, drawn: Mapping[str, Array]
) -> Array:
    """Return the devices' outputs without environment and noise, µg, (K, fine)."""
    late = fine[None, :] - 1e-3 * drawn["timing.skew"][:, None]
    felt = acceleration(plan, late) * (1.0 + 1e-6 * drawn["input.radius"][:, None])
    felt = sign[:, None] * felt
    # A spring that softens with its deflection: K2 and, far below it, a third order.
    softening = 1e-6 * drawn["scale.second_order"][:, None] * felt / G
    output = scale[:, None] * felt / (1.0 - softening)
    step = 1e-3  # s, of the derivative of the arm's speed
    ends = [np.sqrt(acceleration(plan, fine + d) / G * GRAVITY / RADIUS) for d in (-step, step)]
    tangential = RADIUS * (ends[1] - ends[0]) / (2 * step) / GRAVITY * G
    tilt = np.sin(1e-3 * drawn["misalignment.device"])[:, None]
    ageing = np.log2(1.0 + fine / plan.duration)
    drift = drawn["bias.drift"][:, None] * (ageing - ageing.mean())
    return output + tilt * (G + tangential) + drift + drawn["bias.device"][:, None]


def _transient(random: np.random.Generator, time: Array) -> Array:
    """Return the response of a body heated from the start, with asymptote 1."""
    return 1.0 - np.exp(-time / random.uniform(0.2, 0.7))


def _wave(random: np.random.Generator, time: Array) -> Array:
    """Return a slow oscillation, such as that of room air, with a period of 1 to 2.5 records."""
    return np.sin(2 * np.pi * (time / random.uniform(1.0, 2.5) + random.uniform()))


def shared(random: np.random.Generator, time: Array) -> Array:
    """Simulate the shared disturbance, of unit rms over the record."""
    transient = random.choice([-1.0, 1.0]) * random.uniform(0.8, 1.6) * _transient(random, time)
    waves = [random.uniform(0.2, 0.7) * _wave(random, time) for _ in range(2)]
    disturbance = transient + waves[0] + waves[1]
    return disturbance / np.sqrt(np.mean(disturbance**2))


def departures(random: np.random.Generator, time: Array, count: int) -> Array:
    """Simulate each device's disturbance, (count, time): offset, transient and wave, together of rms about 1."""
    records = []
    for _ in range(count):
        offset, heat, slow = random.standard_normal(3) / np.sqrt(3.0)
        transient = _transient(random, time)
        records.append(
            offset
            + heat * transient / np.sqrt(np.mean(transient**2))
            + slow * np.sqrt(2.0) * _wave(random, time)
        )
    return np.array(records)


def warming(time: Array) -> Array:
    """Return the fixture's temperature, with asymptote 1 and a slow wave of the room."""
    return 1.0 - np.exp(-time / WARMING) + 0.1 * np.sin(2 * np.pi * time / 0.6)
