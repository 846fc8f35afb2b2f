"""Columns of a simulated campaign, with effects hidden in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayescal_models import simulated
from bayescal_models.quartz_beam_accelerometer.campaign import Campaign
from bayescal_models.quartz_beam_accelerometer.device import CUBIC, Truth, truth
from bayescal_models.quartz_beam_accelerometer.laws import LAWS, Chance
from bayescal_models.quartz_beam_accelerometer.thermal import Array, World, make_world

WANDER_TIME = 300.0  # s
CHANCES = ("noise", "wander", "thermometers", "bias", "scale", "frequency")


def simulated_columns(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """Columns of a campaign with these effects hidden in it, by name, in the instrument's units.

    The same seed gives the same noise and the same turn-on offsets whatever the effects.

    Args and Raises: as of `simulate` in `model.py`.
    """
    campaign, effects = campaign or Campaign(), dict(effects or {})
    world, true = _true(campaign, effects, seed)
    generators = simulated.generators(CHANCES, seed)
    g = world.acceleration
    output = true.bias + (1e6 + true.scale) * g + effects.get("second_order", 0.0) * g**2
    output = output + _noise(campaign, world, generators)
    error = campaign.thermometer_noise * generators["thermometers"].standard_normal((2, g.size))
    columns: dict[str, Any] = {
        "run": np.array([str(k + 1) for k in world.run]),
        "temperature_point": world.point,
        "time": world.average(world.time),
        "temperature_circuit": world.average(world.circuit) + error[0],
        "temperature_head": world.average(world.head) + error[1],
        "acceleration": 1e6 * g,
        "output": output,
    }
    if campaign.frequency_sum:
        jitter = 0.005 * generators["frequency"].standard_normal(g.size)  # Hz
        columns["frequency_sum"] = true.frequency_sum + jitter
    return columns


def true_values(
    campaign: Campaign, effects: Mapping[str, float] | None = None, *, seed: int = 0
) -> Truth:
    """True bias, scale factor and frequency sum at each reading of `simulate`, without noise.

    Args:
        campaign, effects, seed: as given to `simulate`.

    Raises:
        ValueError: as `simulate`.
    """
    return _true(campaign, dict(effects or {}), seed)[1]


def _true(campaign: Campaign, effects: Mapping[str, float], seed: int) -> tuple[World, Truth]:
    known = [f"{slot}.{cause}" for slot in ("bias", "scale") for cause in LAWS]
    known += ["second_order", *(CUBIC if campaign.device == "cubic" else ())]
    simulated.refuse_effects(effects, known, f"a {campaign.device!r} device")
    world, generators = make_world(campaign), simulated.generators(CHANCES, seed)
    device = truth(campaign, world, {n: effects.get(n, v) for n, v in CUBIC.items()})
    sums = {"bias": device.bias, "scale": device.scale}
    chances = {slot: _chance(generators[slot], world) for slot in sums}
    for name, size in effects.items():
        slot, _, cause = name.partition(".")
        if cause in LAWS:
            sums[slot] = sums[slot] + size * LAWS[cause](world, campaign, chances[slot])
    return world, Truth(sums["bias"], sums["scale"], device.frequency_sum)


def _chance(generator: np.random.Generator, world: World) -> Chance:
    runs, cells = int(world.run.max()) + 1, int(world.cell.max()) + 1
    return Chance(generator.standard_normal(runs), generator.standard_normal(max(cells, 1)))


def _noise(
    campaign: Campaign, world: World, generators: Mapping[str, np.random.Generator]
) -> Array:
    """Noise of each reading, µg."""
    white = campaign.noise * generators["noise"].standard_normal(world.run.size)
    if campaign.noise_law == "white":
        return white
    time, slow = world.average(world.time), np.empty(world.run.size)
    for run in range(int(world.run.max()) + 1):
        chosen = world.run == run
        slow[chosen] = _wander(generators["wander"], time[chosen])
    return white + campaign.noise * slow


def _wander(generator: np.random.Generator, time: Array) -> Array:
    """An Ornstein–Uhlenbeck record of unit variance at these times, s."""
    kicks = generator.standard_normal(time.size)
    made, now = np.empty(time.size), 0.0
    for i, step in enumerate(np.diff(time, prepend=-np.inf)):
        decay = np.exp(-step / WANDER_TIME)
        now = decay * now + np.sqrt(1.0 - decay**2) * kicks[i]
        made[i] = now
    return made
