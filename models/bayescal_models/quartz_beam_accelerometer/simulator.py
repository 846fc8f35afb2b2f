"""Simulator of a campaign with hidden effects: the device, and one physical law per cause.

Two devices. `cubic`: bias and scale factor follow the head's temperature by a cubic, exactly. `beams`: two quartz
beams pulled and pushed by the proof mass, of frequency `F·(1 + α·ΔT + β·ΔT² + γ·ΔT³)` each, with slightly unlike
coefficients and lags behind the head; the difference of their frequencies carries the bias, the sum is a
thermometer. To it come the oscillator circuit's phase, the stress of an uneven temperature, which grows with
temperature, and the softening of a glued joint. None of these is a polynomial in what the thermometers read.

A law returns the contribution of one unit of the effect at each simulation step, to the bias (µg) or scale factor
(ppm). Laws use the true temperatures and heat flows, not the columns of a fitted model's bases.

Source: source 2 (differential beams, thermometers, dependence on gradient and rate); numbers ours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from bayescal_models import simulated
from bayescal_models.quartz_beam_accelerometer import SCALE_FACTOR
from bayescal_models.quartz_beam_accelerometer.campaign import Campaign
from bayescal_models.quartz_beam_accelerometer.world import World
from bayescal_models.simulated import Array

BEAM_FREQUENCY = 40_000.0  # Hz, of one beam
BEAM_TEMPCO = -20e-6  # 1/°C, of one beam's frequency: what makes the sum a thermometer
POWERS = ("constant_head", *(f"temperature_head{n}" for n in ("", "_quadratic", "_cubic")))
BEAM_TIME = 90.0  # s, of the beams behind the head's thermometer
LAG_MISMATCH = 0.005  # by how much one beam lags more than the other, relative
KELVIN = 273.15
EINSTEIN = 400.0  # K, of the oscillators whose energy bends the circuit's tempco; ours
LEAKAGE = 80.0  # °C, over which leakage currents increase by the factor e; ours
BOW = 60.0  # °C, gradient at which a bowed plate stiffens; ours
WANDER_TIME, LAG_TIME = 300.0, 600.0  # s, of correlated noise and of the hidden lag
CHANCES = ("noise", "wander", "thermometers", "bias", "scale", "frequency", "supply")

CUBIC: Mapping[str, float] = MappingProxyType(
    {
        "bias.constant_head": 3000.0,
        "bias.temperature_head": 60.0,
        "bias.temperature_head_quadratic": 0.4,
        "bias.temperature_head_cubic": 0.004,
        "scale.constant_head": 800.0,
        "scale.temperature_head": 6.0,
        "scale.temperature_head_quadratic": 0.04,
        "scale.temperature_head_cubic": 0.0004,
    }
)
"""Coefficients of the cubic device about T0: µg and ppm, per power of °C."""


@dataclass(frozen=True)
class Truth:
    """True values of the device at each reading (n,): bias in µg, relative scale factor in ppm, sum in Hz."""

    bias: Array
    scale: Array
    frequency_sum: Array


def truth(world: World, coefficients: Mapping[str, float]) -> Truth:
    """Return bias, scale factor and frequency sum of the test's device.

    Args:
        coefficients: coefficients of the cubic device; not used for "beams".
    """
    if world.plan.device == "beams":
        return _beams(world)
    change = world.head - world.plan.T0
    bias, scale = (
        np.polynomial.polynomial.polyval(change, [coefficients[f"{slot}.{n}"] for n in POWERS])
        for slot in ("bias", "scale")
    )
    both = _sum_of_frequencies(change, change)
    return Truth(world.average(bias), world.average(scale), world.average(both))


def _relative(change: Array, tempco: float, curvature: float, cubic: float) -> Array:
    """Return the relative change of a beam's frequency."""
    return change * (tempco + change * (curvature + change * cubic))


def _sum_of_frequencies(first: Array, second: Array) -> Array:
    curvature = -0.02e-6  # 1/°C²: about quartz's
    low, high = (_relative(beam, BEAM_TEMPCO, curvature, 0.0) for beam in (first, second))
    return BEAM_FREQUENCY * (2.0 + (low + high))


def _beams(world: World) -> Truth:
    beam, other = (world.body(world.head, BEAM_TIME * slower) for slower in (1, 1 + LAG_MISMATCH))
    first, second = beam - world.plan.T0, other - world.plan.T0
    per_ug = SCALE_FACTOR * 1e-6
    unlike = (1.375e-7, 0.9e-9, 0.8e-11)  # 1/°C and powers: 55 µg/°C, 0.36 µg/°C², 0.0032 µg/°C³
    common = (BEAM_TEMPCO, -0.02e-6, 0.0)
    pulled = _relative(first, *(c + u for c, u in zip(common, unlike, strict=True)))
    pushed = _relative(second, *common)
    uneven = world.uneven
    stress = 10.0 * uneven * (1 + 0.01 * (world.head - world.plan.T0))
    phase = 4.0 * (world.circuit - world.plan.T0)
    joint = 20.0 * np.tanh((beam - 50.0) / 20.0)
    bias = 2500.0 + BEAM_FREQUENCY * (pulled - pushed) / per_ug + stress + phase + joint
    scale = (
        800.0
        + first * (6.0 + first * (0.04 + first * 0.0003))
        + uneven * (1.0 + 0.01 * first)
        - 0.2 * (world.circuit - world.plan.T0)  # the clock that counts the beats
    )
    frequencies = _sum_of_frequencies(first, second)
    return Truth(world.average(bias), world.average(scale), world.average(frequencies))


def _energy(change: Array, T0: float) -> Array:
    """Return an Einstein oscillator's energy less its tangent at T0, curvature one: about ½·2·ΔT² = ΔT²."""

    def level(kelvin):
        return 1.0 / np.expm1(EINSTEIN / kelvin)

    at, step = T0 + KELVIN, 1.0
    slope = (level(at + step) - level(at - step)) / (2 * step)
    curvature = (level(at + step) - 2 * level(at) + level(at - step)) / step**2
    return 2.0 * (level(at + change) - level(at) - slope * change) / curvature


def _leakages(world: World) -> Array:
    """Return two leakages, one growing with heat and one with cold, less their linear part."""
    part = (world.circuit - world.plan.T0) / LEAKAGE
    return 6.0 * LEAKAGE**3 * (np.sinh(part) - part)


LAWS: Mapping[str, Callable[[World], Array]] = MappingProxyType(
    {
        # a resistor of the drive circuit has a tempco
        "temperature_circuit": lambda w: w.circuit - w.plan.T0,
        "temperature_circuit_quadratic": lambda w: _energy(w.circuit - w.plan.T0, w.plan.T0),
        "temperature_circuit_cubic": _leakages,
        # heat flowing from circuit to head strains the mount
        "gradient": lambda w: w.uneven,
        # an unevenly warm plate bows, whichever side is warmer, and stiffens
        "gradient_quadratic": lambda w: 2.0 * BOW**2 * (np.sqrt(1.0 + (w.uneven / BOW) ** 2) - 1.0),
        "gradient_cubic": lambda w: w.uneven**3 / (1.0 + (w.uneven / BOW) ** 2),
        # the heat that flows into the circuit board strains it: its true heating rate, °C/min
        "rate_circuit": lambda w: w.circuit_rate,
        "rate_head": lambda w: w.head_rate,
        # strain by heat flow, through a mismatch of expansions that grows with temperature
        "temperature_x_rate": lambda w: (w.head - w.plan.T0) * w.head_rate,
        "temperature_x_gradient": lambda w: (w.head - w.plan.T0) * w.uneven,
        # the resonators lag behind the head's thermometer
        "thermal_lag": lambda w: w.body(w.head, LAG_TIME) - w.head,
        "hysteresis": lambda w: simulated.sticking(w.head),
        # the error of the oscillators decays with warm-up
        "warm_up": lambda w: 1.0 - w.warmth,
        # ageing, logarithmic in time, one over the whole test
        "drift": lambda w: np.log2(1.0 + w.time / w.time[-1]),
    }
)
"""All causes that can be hidden in bias or scale factor, except random ones."""

OF_BIAS: Mapping[str, Callable[[World], Array]] = MappingProxyType(
    {
        "bias.supply": lambda w: w.supply - simulated.SUPPLY,
        "bias.temperature_x_supply": lambda w: (w.head - w.plan.T0) * (w.supply - simulated.SUPPLY),
    }
)
"""Effects of the supply, on the bias only."""

CHANCE: Mapping[str, Callable[[World, Mapping[str, Array]], Array]] = MappingProxyType(
    {
        # turn-on repeatability
        "run": lambda w, chance: chance["run"][w.run],
        # the fixture settles anew at each soak
        "cell": lambda w, chance: np.where(w.cell >= 0, chance["cell"][np.maximum(w.cell, 0)], 0.0),
    }
)
"""Random effects at each reading, in standard deviations."""


def simulated_columns(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """Simulate a campaign with hidden effects: columns by name, in the instrument's units.

    The same seed gives the same noise and the same turn-on offsets whatever the effects.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficient; for an effect with learned
            deviations (`*.run`, `*.cell`) their standard deviation. The cubic device's own coefficients (about
            T0 = `campaign.T0`) may be replaced by name.
        seed: seed of the random-number generator.
        campaign: plan of the test.

    Raises:
        ValueError: an unknown effect, or a size that is not a finite number.
    """
    campaign, effects = campaign or Campaign(), dict(effects or {})
    world, true = _true(World(campaign), effects, seed)
    generators = simulated.generators(CHANCES, seed)
    g = world.acceleration
    output = true.bias + (1e6 + true.scale) * g + effects.get("second_order", 0.0) * g**2
    output = output + _noise(world, generators)
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
    if simulated.supplied(effects):
        columns["supply_voltage"] = world.average(world.supply)
    if campaign.frequency_sum:
        jitter = 0.005 * generators["frequency"].standard_normal(g.size)  # Hz
        columns["frequency_sum"] = true.frequency_sum + jitter
    return columns


def true_values(
    campaign: Campaign, effects: Mapping[str, float] | None = None, *, seed: int = 0
) -> Truth:
    """Return true bias, scale factor and frequency sum at each reading of `simulate`, without noise.

    Args:
        campaign, effects, seed: as given to `simulate`.

    Raises:
        ValueError: as `simulate`.
    """
    return _true(World(campaign), dict(effects or {}), seed)[1]


def _true(world: World, effects: Mapping[str, float], seed: int) -> tuple[World, Truth]:
    places = {f"{s}.{cause}": (s, cause) for s in ("bias", "scale") for cause in (*LAWS, *CHANCE)}
    names = [*places, "second_order", *OF_BIAS, *(CUBIC if world.plan.device == "cubic" else ())]
    simulated.refuse_effects(effects, names, f"a {world.plan.device!r} device")
    generators = simulated.generators(CHANCES, seed)
    world.supply = simulated.wandering_supply(generators["supply"], world.time)
    device = truth(world, {n: effects.get(n, v) for n, v in CUBIC.items()})
    sums = {"bias": device.bias, "scale": device.scale}
    chances = {slot: _chance(generators[slot], world) for slot in sums}
    for name, size in effects.items():
        slot, cause = places.get(name, ("bias", ""))
        if cause in LAWS:
            sums[slot] = sums[slot] + size * world.average(LAWS[cause](world))
        elif name in OF_BIAS:
            sums[slot] = sums[slot] + size * world.average(OF_BIAS[name](world))
        elif cause in CHANCE:
            sums[slot] = sums[slot] + size * CHANCE[cause](world, chances[slot])
    return world, Truth(sums["bias"], sums["scale"], device.frequency_sum)


def _chance(generator: np.random.Generator, world: World) -> dict[str, Array]:
    """Draw standard normal numbers of one slot: one per run, one per cell, constant through it."""
    runs, cells = int(world.run.max()) + 1, int(world.cell.max()) + 1
    return {n: generator.standard_normal(k) for n, k in (("run", runs), ("cell", max(cells, 1)))}


def _noise(world: World, generators: Mapping[str, np.random.Generator]) -> Array:
    """Draw the noise of each reading, µg."""
    white = world.plan.noise * generators["noise"].standard_normal(world.run.size)
    if world.plan.noise_law == "white":
        return white
    # An Ornstein–Uhlenbeck record of unit variance at the readings' times, anew in each run.
    step = np.diff(world.average(world.time), prepend=-np.inf)
    step[np.diff(world.run, prepend=-1) != 0] = np.inf
    decay = np.exp(-step / WANDER_TIME)
    kicks = np.sqrt(1.0 - decay**2) * generators["wander"].standard_normal(world.run.size)
    slow, now = np.empty(world.run.size), 0.0
    for i, kick in enumerate(kicks):
        slow[i] = now = decay[i] * now + kick
    return white + world.plan.noise * slow
