"""Columns of a simulated campaign, with effects hidden in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayescal_models import simulated
from bayescal_models.quartz_beam_accelerometer.campaign import Campaign
from bayescal_models.quartz_beam_accelerometer.device import CUBIC, Truth, truth
from bayescal_models.quartz_beam_accelerometer.laws import CHANCE, LAWS, Chance
from bayescal_models.quartz_beam_accelerometer.thermal import World, make_world
from bayescal_models.simulated import Array

WANDER_TIME = 300.0  # s
CHANCES = ("noise", "wander", "thermometers", "bias", "scale", "frequency")


def simulated_columns(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """A campaign with these effects hidden in it: its columns, by name, in the instrument's units.

    The same seed gives the same noise and the same turn-on offsets whatever the effects.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficient; for an effect with learned
            deviations (`*.run`, `*.cell`) their standard deviation. The cubic device's own coefficients (about
            T0 = `campaign.T0`) may be replaced by name.
        seed: of every random number.
        campaign: plan of the test.

    Raises:
        ValueError: no law for an effect of that name, or a size that is no number.
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
    known = [f"{slot}.{cause}" for slot in ("bias", "scale") for cause in (*LAWS, *CHANCE)]
    known += ["second_order", *(CUBIC if campaign.device == "cubic" else ())]
    simulated.refuse_effects(effects, known, f"a {campaign.device!r} device")
    world, generators = make_world(campaign), simulated.generators(CHANCES, seed)
    device = truth(campaign, world, {n: effects.get(n, v) for n, v in CUBIC.items()})
    sums = {"bias": device.bias, "scale": device.scale}
    chances = {slot: _chance(generators[slot], world) for slot in sums}
    for name, size in effects.items():
        slot, _, cause = name.partition(".")
        if cause in LAWS:
            sums[slot] = sums[slot] + size * world.average(LAWS[cause](world, campaign))
        elif cause in CHANCE:
            sums[slot] = sums[slot] + size * CHANCE[cause](world, chances[slot])
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
    # An Ornstein–Uhlenbeck record of unit variance at the readings' times, anew in each run.
    step = np.diff(world.average(world.time), prepend=-np.inf)
    step[np.diff(world.run, prepend=-1) != 0] = np.inf
    decay = np.exp(-step / WANDER_TIME)
    kicks = np.sqrt(1.0 - decay**2) * generators["wander"].standard_normal(world.run.size)
    slow, now = np.empty(world.run.size), 0.0
    for i, kick in enumerate(kicks):
        slow[i] = now = decay[i] * now + kick
    return white + campaign.noise * slow
