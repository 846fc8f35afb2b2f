"""What can be hidden in a simulated quartz beam accelerometer: sizes, and one small physical law per cause.

A law gives what one unit of the effect does to each reading; the same laws act on bias (µg) and scale factor
(ppm). They work on the world's own temperatures and heat flows, not on the columns of a fitted model's bases.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from bayescal_models.quartz_beam_accelerometer.campaign import Campaign
from bayescal_models.quartz_beam_accelerometer.thermal import Array, World, body
from bayescal_models.simulated import Size

KELVIN = 273.15
EINSTEIN = 400.0  # K, of the oscillators whose energy bends the circuit's tempco; ours
LEAKAGE = 80.0  # °C, over which leakage currents grow by e; ours
BOW = 60.0  # °C of gradient at which a bowed plate has stiffened; ours
SLIPS = (0.3, 0.6, 1.0, 1.5)  # °C, thresholds of joints that stick and slip; ours


SIZES: Mapping[str, Size] = MappingProxyType(
    {
        "temperature_circuit": Size(50.0, "/degC"),
        "temperature_circuit_quadratic": Size(0.5, "/degC^2"),
        "temperature_circuit_cubic": Size(0.005, "/degC^3"),
        "temperature_circuit_quartic": Size(5e-5, "/degC^4"),
        "temperature_circuit_quintic": Size(5e-7, "/degC^5"),
        "temperature_head": Size(50.0, "/degC"),
        "temperature_head_quadratic": Size(0.5, "/degC^2"),
        "temperature_head_cubic": Size(0.005, "/degC^3"),
        "gradient": Size(20.0, "/degC"),
        "gradient_quadratic": Size(1.0, "/degC^2"),
        "gradient_cubic": Size(0.1, "/degC^3"),
        "rate_circuit": Size(10.0, "/(degC/min)"),
        "rate_head": Size(10.0, "/(degC/min)"),
        "temperature_x_rate": Size(0.2, "/degC/(degC/min)"),
        "temperature_x_gradient": Size(0.5, "/degC^2"),
        "thermal_lag": Size(20.0, "/degC"),
        "hysteresis": Size(20.0),
        "warm_up": Size(50.0),
        "drift": Size(10.0),
        "run": Size(20.0),
        "cell": Size(5.0),
    }
)
"""Prior standard deviations for bias, µg, with what they are per; for scale factor a tenth, ppm. All of them ours."""

SECOND_ORDER = 10.0  # µg/g²
SHARE = {"bias": 1.0, "scale": 0.1}
UNIT = {"bias": "ug", "scale": "ppm"}


def size(slot: str, cause: str) -> tuple[float, str]:
    """Plausible size of `slot.cause`, and its unit."""
    return SIZES[cause].value * SHARE[slot], UNIT[slot] + SIZES[cause].unit


class Chance(NamedTuple):
    """Standard normal numbers of one slot: one per run, one per cell, held through it."""

    run: Array
    cell: Array


def _energy(change: Array, T0: float) -> Array:
    """Energy of an Einstein oscillator less its tangent at T0, curvature one: about ½·2·ΔT² = ΔT²."""

    def level(kelvin):
        return 1.0 / np.expm1(EINSTEIN / kelvin)

    at, step = T0 + KELVIN, 1.0
    slope = (level(at + step) - level(at - step)) / (2 * step)
    curvature = (level(at + step) - 2 * level(at) + level(at - step)) / step**2
    return 2.0 * (level(at + change) - level(at) - slope * change) / curvature


def _circuit(world: World, campaign: Campaign, chance: Chance) -> Array:
    """A resistor of the drive circuit has a tempco."""
    return world.average(world.circuit - campaign.T0)


def _circuit_quadratic(world: World, campaign: Campaign, chance: Chance) -> Array:
    return world.average(_energy(world.circuit - campaign.T0, campaign.T0))


def _circuit_cubic(world: World, campaign: Campaign, chance: Chance) -> Array:
    """Two leakages, one growing with heat and one with cold, less what is linear in them."""
    part = (world.circuit - campaign.T0) / LEAKAGE
    return world.average(6.0 * LEAKAGE**3 * (np.sinh(part) - part))


def _gradient(world: World, campaign: Campaign, chance: Chance) -> Array:
    """Heat flowing from circuit to head strains the mount."""
    return world.average(world.circuit - world.head)


def _gradient_quadratic(world: World, campaign: Campaign, chance: Chance) -> Array:
    """An unevenly warm plate bows, whichever side is warmer, and stiffens as it does."""
    part = (world.circuit - world.head) / BOW
    return world.average(2.0 * BOW**2 * (np.sqrt(1.0 + part**2) - 1.0))


def _gradient_cubic(world: World, campaign: Campaign, chance: Chance) -> Array:
    uneven = world.circuit - world.head
    return world.average(uneven**3 / (1.0 + (uneven / BOW) ** 2))


def _rate_circuit(world: World, campaign: Campaign, chance: Chance) -> Array:
    """The heat that flows into the circuit board strains it: its true heating rate, °C/min."""
    return world.average(world.circuit_rate)


def _rate_head(world: World, campaign: Campaign, chance: Chance) -> Array:
    return world.average(world.head_rate)


def _temperature_x_rate(world: World, campaign: Campaign, chance: Chance) -> Array:
    """Strain by heat flow, through a mismatch of expansions that grows with temperature."""
    return world.average((world.head - campaign.T0) * world.head_rate)


def _temperature_x_gradient(world: World, campaign: Campaign, chance: Chance) -> Array:
    return world.average((world.head - campaign.T0) * (world.circuit - world.head))


def _thermal_lag(world: World, campaign: Campaign, chance: Chance) -> Array:
    """The resonators are not at the temperature of the head's thermometer."""
    return world.average(body(world.head, campaign.lag_time) - world.head)


def _hysteresis(world: World, campaign: Campaign, chance: Chance) -> Array:
    """Joints stick, each up to its own strain, then slip along: plays of several widths (Prandtl, Ishlinskii)."""
    total = np.zeros(world.head.size)
    for width in SLIPS:
        seat, strain = float(world.head[0]), np.empty(world.head.size)
        for i, here in enumerate(world.head.tolist()):
            seat = min(max(seat, here - width), here + width)
            strain[i] = (here - seat) / width
        total += strain / len(SLIPS)
    return world.average(total)


def _warm_up(world: World, campaign: Campaign, chance: Chance) -> Array:
    """The oscillators are off when cold and right when they have warmed."""
    return world.average(1.0 - world.warmth)


def _drift(world: World, campaign: Campaign, chance: Chance) -> Array:
    """Ageing, logarithmic in time, one over the whole test."""
    return world.average(np.log2(1.0 + world.time / world.time[-1]))


def _run(world: World, campaign: Campaign, chance: Chance) -> Array:
    """Turn-on repeatability."""
    return chance.run[world.run]


def _cell(world: World, campaign: Campaign, chance: Chance) -> Array:
    """The fixture settles anew at each soak."""
    cell = world.cell
    return np.where(cell >= 0, chance.cell[np.maximum(cell, 0)], 0.0)


Law = Callable[[World, Campaign, Chance], Array]
LAWS: Mapping[str, Law] = MappingProxyType(
    {
        "temperature_circuit": _circuit,
        "temperature_circuit_quadratic": _circuit_quadratic,
        "temperature_circuit_cubic": _circuit_cubic,
        "gradient": _gradient,
        "gradient_quadratic": _gradient_quadratic,
        "gradient_cubic": _gradient_cubic,
        "rate_circuit": _rate_circuit,
        "rate_head": _rate_head,
        "temperature_x_rate": _temperature_x_rate,
        "temperature_x_gradient": _temperature_x_gradient,
        "thermal_lag": _thermal_lag,
        "hysteresis": _hysteresis,
        "warm_up": _warm_up,
        "drift": _drift,
        "run": _run,
        "cell": _cell,
    }
)
"""Every cause that can be hidden in bias or scale factor."""
