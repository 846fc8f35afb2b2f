"""Simulator of a test with hidden effects: one small physical law per effect.

    made = simulate_arrays({"base_tilt.tide": 200.0, "second_order": 0.05}, seed=1)
    made.columns["output"], made.world, made.contributions["second_order"]

A law returns the contribution of one unit of the effect to its slot at each instant of the simulated test. None uses
the columns of a candidate's basis (set points, the thermometer's record, the clock of the readings), and most have a
slightly different form, so that a fitted model is an approximation, as with real readings. The geometry is computed by
rotations of vectors, independently of the model's closed form.

An effect on the base tilt acts on both components with the size given; `name[parallel]` and `name[perp]` set one
alone. The size of `base_tilt.tide` is each component's largest tilt of the month, nrad.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from bayescal_models import simulated
from bayescal_models.ng_accelerometer.campaign import INSTRUMENT_A, Campaign
from bayescal_models.ng_accelerometer.world import World
from bayescal_models.simulated import ARCSEC, DEGREE, Array, Simulated

G = 1e6  # µg
STREAMS = ("noise", "thermometer", "chamber", "laboratory", "groups", "supply")
SATURATION = 40.0  # °C, scale on which a curved law deviates from its leading power
UNEVEN = 0.002  # 1/°C, relative increase of the fixture's bending with temperature
HIGHER = 0.1  # relative amplitude of the higher harmonics around a turn
UNITS = {
    **dict.fromkeys(("ug", "ug/mg^2", "ug/mg^3", "1/g"), 1.0),
    **{"ppm": 1e-6, "urad": 1e-6, "nrad": 1e-9, "arcsec": ARCSEC, "deg": DEGREE},
}
BY_CELL = ("bias", "scale", "fixture_tilt", "base_tilt_parallel", "base_tilt_perp")
BY_RUN = ("bias", "scale", "fixture_tilt", "fixture_tilt.temperature")


class Law(NamedTuple):
    """The slot that a law adds to, the unit of the effect, and the contribution of one unit at each instant."""

    slot: str
    unit: str
    curve: Callable[[World], Array]

    def contribution(self, size: float, world: World) -> Array:
        """Return the contribution in the slot's unit, (n, m)."""
        return size * UNITS[self.unit] * self.curve(world)


def _warmer(w: World) -> Array:
    return w.device - w.plan.T0


def _square(w: World) -> Array:
    """Return 2w²(cosh(ΔT/w) − 1): slightly more than ΔT²."""
    return 2 * SATURATION**2 * (np.cosh(_warmer(w) / SATURATION) - 1)


def _cube(w: World) -> Array:
    """Return 6w³(sinh(ΔT/w) − ΔT/w): slightly more than ΔT³."""
    ratio = _warmer(w) / SATURATION
    return 6 * SATURATION**3 * (np.sinh(ratio) - ratio)


def _fixture(w: World) -> Array:
    """Return the expansion of the fixture, whose coefficient grows slightly with temperature, °C."""
    change = w.fixture - w.plan.T0
    return change + UNEVEN * change**2


def _lobed(w: World) -> Array:
    """Return two and three lobes around a turn, and higher ones."""
    waves = [wave(m * w.angle) for m in (2, 3) for wave in (np.cos, np.sin)]
    return sum(waves) + HIGHER * (np.cos(4 * w.angle) + np.sin(5 * w.angle))


def _settled(w: World) -> Array:
    """Return a foundation's settlement: fast first, then slower; 1 over the test."""
    return np.expm1(-2 * w.share) / np.expm1(-2.0)


def _eccentric(w: World) -> Array:
    """Return the reading error of an eccentrically mounted circle, relative to its amplitude."""
    small = np.sqrt(2) * ARCSEC
    angle = w.angle + np.pi / 4
    return np.arctan2(small * np.sin(angle), 1 + small * np.cos(angle)) / ARCSEC


def _surplus(w: World) -> Array:
    """Return the supply's excess over its nominal voltage, V."""
    return w.supply - simulated.SUPPLY


def _ones(w: World) -> Array:
    return np.ones_like(w.time)


def _scatter(
    what: str, group: str, along: Callable[[World], Array] = _ones
) -> Callable[[World], Array]:
    """Return a law of one standard normal deviate per cell or run; the size multiplies it."""

    def curve(w: World) -> Array:
        return (w.by_cell[what] if group == "cell" else w.by_run[what]) * along(w)

    return curve


_LAWS = {
    "bias.constant": Law("bias", "ug", _ones),
    "bias.temperature": Law("bias", "ug", _warmer),
    "bias.cell": Law("bias", "ug", _scatter("bias", "cell")),
    "scale.constant": Law("scale", "ppm", _ones),
    "scale.temperature": Law("scale", "ppm", _warmer),
    "scale.cell": Law("scale", "ppm", _scatter("scale", "cell")),
    "fixture_tilt.constant": Law("fixture_tilt", "urad", _ones),
    "fixture_tilt.cell": Law("fixture_tilt", "urad", _scatter("fixture_tilt", "cell")),
    "rotation.constant": Law("rotation", "deg", _ones),
    "tilt.setting": Law("base_tilt_perp", "arcsec", _ones),
    "bias.temperature_quadratic": Law("bias", "ug", _square),
    "bias.temperature_cubic": Law("bias", "ug", _cube),
    "scale.temperature_quadratic": Law("scale", "ppm", _square),
    "scale.temperature_cubic": Law("scale", "ppm", _cube),
    "bias.drift": Law("bias", "ug", lambda w: np.log2(1 + w.share)),  # ageing
    "bias.warm_up": Law("bias", "ug", lambda w: w.warmth),
    "bias.run": Law("bias", "ug", _scatter("bias", "run")),
    "scale.run": Law("scale", "ppm", _scatter("scale", "run")),
    "bias.rate": Law("bias", "ug", lambda w: w.heating),
    "bias.thermal_lag": Law("bias", "ug", lambda w: w.element - w.device),
    "bias.temperature_x_lag": Law("bias", "ug", lambda w: _warmer(w) * (w.element - w.device)),
    "bias.supply": Law("bias", "ug", _surplus),
    "bias.temperature_x_supply": Law("bias", "ug", lambda w: _warmer(w) * _surplus(w)),
    "bias.hysteresis": Law("bias", "ug", lambda w: w.direction),
    "fixture_tilt.temperature": Law("fixture_tilt", "urad", _fixture),
    "fixture_tilt.run": Law("fixture_tilt", "urad", _scatter("fixture_tilt", "run")),
    "fixture_tilt.run_temperature": Law(
        "fixture_tilt", "urad", _scatter("fixture_tilt.temperature", "run", _fixture)
    ),
    "fixture_tilt.position": Law(
        "fixture_tilt", "urad", lambda w: (w.fixture - w.plan.T0) * _lobed(w)
    ),
    "second_order": Law("second_order", "ug/mg^2", _ones),
    "third_order": Law("third_order", "ug/mg^3", _ones),
    "cross_coupling": Law("cross_coupling", "1/g", _ones),
    "cross_coupling.temperature": Law("cross_coupling", "1/g", _warmer),
    "rotation.harmonic": Law("rotation", "arcsec", _eccentric),
    "rotation.wobble": Law("fixture_tilt", "arcsec", lambda w: _lobed(w) + 0 * w.time),
}
# Of each component of the base tilt, parallel and perp.
_OF_BASE = {
    "base_tilt.constant": ("arcsec", (_ones, _ones)),
    "base_tilt.lab_temperature": ("urad", 2 * (lambda w: w.foundation - w.plan.laboratory,)),
    "base_tilt.temperature": ("urad", 2 * (lambda w: w.base - w.plan.T0,)),
    "base_tilt.tide": ("nrad", (lambda w: w.tide[0], lambda w: w.tide[1])),
    "base_tilt.drift": ("urad", (_settled, _settled)),
    "base_tilt.cell": (
        "urad",
        (_scatter("base_tilt_parallel", "cell"), _scatter("base_tilt_perp", "cell")),
    ),
}


def _all() -> dict[str, tuple[Law, ...]]:
    laws = {name: (law,) for name, law in _LAWS.items()}
    for name, (unit, curves) in _OF_BASE.items():
        along, across = sides = tuple(
            Law(f"base_tilt_{side}", unit, curve)
            for side, curve in zip(("parallel", "perp"), curves, strict=True)
        )
        laws |= {name: sides, f"{name}[parallel]": (along,), f"{name}[perp]": (across,)}
    return laws


LAWS: Mapping[str, tuple[Law, ...]] = MappingProxyType(_all())
"""All effects of a simulated test, baseline and hidden, by canonical name."""


def simulate_arrays(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign = INSTRUMENT_A
) -> Simulated:
    """Simulate a test with hidden effects.

    The same seed gives the same noise, temperatures and scatter for any effects, so two simulations differ by the
    effects alone. Contributions are those of every effect to its slot, in the slot's unit, (slot, (n, m))
    for each component.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficients, all of which take it (see
            above for the two components of the base tilt, and for the tide). The instrument's own line,
            constants and scatter are included, as in `campaign.truth` unless given here.
        seed: seed of the random-number generator.
        campaign: plan of the test.

    Raises:
        ValueError: an unknown effect, or a size that is not a finite number.
    """
    sizes = {**campaign.truth, **(effects or {})}
    simulated.refuse_effects(sizes, LAWS, "a test of the ng accelerometer")
    generators = simulated.generators(STREAMS, seed)
    world = World(campaign, generators, BY_CELL, BY_RUN)
    contributions = {
        name: tuple((law.slot, law.contribution(size, world)) for law in LAWS[name])
        for name, size in sizes.items()
    }
    noise_free = respond(world, contributions).mean(axis=1)
    noise = campaign.noise * generators["noise"].standard_normal(len(noise_free))
    scatter = generators["thermometer"].standard_normal((2, len(noise_free)))
    columns = {
        "run": np.array([str(k + 1) for k in world.run]),
        "temperature_point": world.point,
        "time": world.time.mean(axis=1),
        "temperature": world.device.mean(axis=1) + campaign.thermometer_noise * scatter[0],
        "lab_temperature": world.laboratory.mean(axis=1) + campaign.thermometer_noise * scatter[1],
        "position_angle": world.angle[:, 0],
        "tilt": world.tilt[:, 0],
        "output": noise_free + noise,
    }
    if simulated.supplied(sizes):
        columns["supply_voltage"] = world.supply.mean(axis=1)
    return Simulated(columns, world, contributions, noise_free)


simulated_columns = simulated.columns_of(simulate_arrays)


def respond(world: World, contributions: Mapping[str, tuple[tuple[str, Array], ...]]) -> Array:
    """Return the output without noise at each instant, µg."""
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
    """Return the acceleration along the input axis, µg, and the table's normal, g, by successive rotations.

    Up, (0, 0, 1) in the laboratory, is rotated into the face by the tilt about e0 and by the base about e90; the
    input axis is tilted by the fixture and then rotated with the table.

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
    """Rotate a vector about an axis of the frame, counter-clockwise."""
    first, second = (about + 1) % 3, (about + 2) % 3
    turned = list(vector)
    turned[first] = np.cos(by) * vector[first] - np.sin(by) * vector[second]
    turned[second] = np.sin(by) * vector[first] + np.cos(by) * vector[second]
    return tuple(turned)
