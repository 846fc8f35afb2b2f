"""Columns of a simulated test, with effects hidden in it.

    columns = simulated_columns({"base_tilt.tide": 200.0, "second_order": 0.05}, seed=1)

The geometry is done here with rotations of vectors, apart from the closed form that models are fitted with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayescal_models import simulated
from bayescal_models.ng_accelerometer.campaign import INSTRUMENT_A, Campaign
from bayescal_models.ng_accelerometer.laws import BY_CELL, BY_RUN, LAWS
from bayescal_models.ng_accelerometer.rig.world import Array, World, make_world

G = 1e6  # µg
STREAMS = ("noise", "thermometer", "chamber", "laboratory", "groups")


@dataclass(frozen=True)
class Simulated:
    """A simulated test before its readings are noted down.

    Attributes:
        world: where the table stood and every temperature behind it.
        sizes: size of every effect in it, the instrument's truth included.
        contributions: of every effect to its slot, in the slot's unit, (slot, (n, m)) for each component.
        noise_free: output, µg, (n,).
        output: with noise, µg, (n,).
    """

    world: World
    sizes: dict[str, float]
    contributions: dict[str, tuple[tuple[str, Array], ...]]
    noise_free: Array
    output: Array


def simulated_columns(
    effects: Mapping[str, float] | None = None,
    *,
    seed: int,
    campaign: Campaign = INSTRUMENT_A,
) -> dict[str, Any]:
    """A test with these effects hidden in it: its columns, by name, in the instrument's units.

    The same seed gives the same noise, the same weather and the same scatter whatever the effects, so two
    simulations differ by the effects alone.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficients, all of which take it (see
            `laws.py` for the two components of the base tilt, and for the tide). The instrument's own line,
            constants and scatter are there too, as `campaign.truth` has them unless given here.
        seed: of every random number.
        campaign: plan of the test.

    Raises:
        ValueError: an unknown effect, or a size that is no number.
    """
    made = simulate_arrays(effects, seed=seed, campaign=campaign)
    world, temperature = made.world, made.world.device.mean(axis=1)
    scatter = simulated.generators(STREAMS, seed)["thermometer"].standard_normal(
        (2, len(temperature))
    )
    return {
        "run": np.array([str(k + 1) for k in world.run]),
        "temperature_point": world.point,
        "time": world.time.mean(axis=1),
        "temperature": temperature + campaign.thermometer_noise * scatter[0],
        "lab_temperature": world.laboratory.mean(axis=1) + campaign.thermometer_noise * scatter[1],
        "position_angle": world.angle[:, 0],
        "tilt": world.tilt[:, 0],
        "output": made.output,
    }


def simulate_arrays(
    effects: Mapping[str, float] | None = None,
    *,
    seed: int,
    campaign: Campaign = INSTRUMENT_A,
) -> Simulated:
    """The same with everything that made it.

    Raises:
        ValueError: an unknown effect, or a size that is no number.
    """
    sizes = {**campaign.truth, **(effects or {})}
    simulated.refuse_effects(sizes, LAWS, "a test of the ng accelerometer")
    generators = simulated.generators(STREAMS, seed)
    world = make_world(campaign, generators, BY_CELL, BY_RUN)
    contributions = {
        name: tuple((law.slot, law.contribution(size, world, campaign)) for law in LAWS[name])
        for name, size in sizes.items()
    }
    noise_free = respond(world, contributions).mean(axis=1)
    noise = campaign.noise * generators["noise"].standard_normal(len(noise_free))
    return Simulated(world, sizes, contributions, noise_free, output=noise_free + noise)


def respond(world: World, contributions: Mapping[str, tuple[tuple[str, Array], ...]]) -> Array:
    """Output without noise, moment by moment, µg."""
    slots: dict[str, Array] = {}
    for name in contributions:
        for slot, part in contributions[name]:
            slots[slot] = slots.get(slot, 0.0) + part
    zero = np.zeros_like(world.time)
    a, ap = gravity(
        world.tilt + slots.get("base_tilt_perp", zero),
        slots.get("base_tilt_parallel", zero),
        world.angle + slots.get("rotation", zero),
        slots.get("fixture_tilt", zero),
    )
    return (
        slots.get("bias", zero)
        + (1 + slots.get("scale", zero)) * a
        + slots.get("second_order", zero) * (a / 1e3) ** 2
        + slots.get("third_order", zero) * (a / 1e3) ** 3
        + slots.get("cross_coupling", zero) * a * ap
    )


def gravity(tilt: Array, parallel: Array, angle: Array, fixture: Array) -> tuple[Array, Array]:
    """Acceleration along the input axis, µg, and along the table's normal, g, by turning vectors one after another.

    Up, (0, 0, 1) in the laboratory, is turned into the face by the tilt about e0 and by the base about e90; the
    input axis is lifted by the fixture and then turned with the table.

    Args:
        tilt, parallel: of the face about e0 and of the base about e90, rad.
        angle: of the table, rad.
        fixture: of the input axis out of the face, rad.
    """
    zero = np.zeros_like(angle + tilt)
    up = _turn(_turn((zero, zero, zero + 1.0), 1, parallel), 0, -tilt)
    axis = _turn(_turn((zero + 1.0, zero, zero), 1, -fixture), 2, angle)
    along = sum((u * s for u, s in zip(up, axis, strict=True)), start=zero)
    return G * along, up[2]


def _turn(vector: tuple[Array, ...], about: int, by: Array) -> tuple[Array, ...]:
    """A vector turned about an axis of the frame, counter-clockwise."""
    first, second = (about + 1) % 3, (about + 2) % 3
    turned = list(vector)
    turned[first] = np.cos(by) * vector[first] - np.sin(by) * vector[second]
    turned[second] = np.sin(by) * vector[first] + np.cos(by) * vector[second]
    return tuple(turned)
