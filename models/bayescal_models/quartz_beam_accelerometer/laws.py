"""What can be hidden in a simulated quartz beam accelerometer: sizes, and one small physical law per cause.

A law gives what one unit of the effect does, step by step of the world; the same laws act on bias (µg) and scale
factor (ppm). They work on the world's own temperatures and heat flows, not on the columns of a fitted model's bases.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from bayescal_models.quartz_beam_accelerometer.campaign import GRID, Campaign
from bayescal_models.quartz_beam_accelerometer.thermal import World
from bayescal_models.simulated import Array, Size, first_order_body

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


CONSTANT = {"bias": 20_000.0, "scale": 5000.0}  # µg, ppm


def size(slot: str, cause: str) -> tuple[float, str]:
    """Plausible size of `slot.cause`, and its unit."""
    if cause == "constant":
        return CONSTANT[slot], UNIT[slot]
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


def _hysteresis(world: World, campaign: Campaign) -> Array:
    """Joints stick, each up to its own strain, then slip along: plays of several widths (Prandtl, Ishlinskii)."""
    total = np.zeros(world.head.size)
    for width in SLIPS:
        seat, strain = float(world.head[0]), np.empty(world.head.size)
        for i, here in enumerate(world.head.tolist()):
            seat = min(max(seat, here - width), here + width)
            strain[i] = (here - seat) / width
        total += strain / len(SLIPS)
    return total


def _leakages(world: World, campaign: Campaign) -> Array:
    """Two leakages, one growing with heat and one with cold, less what is linear in them."""
    part = (world.circuit - campaign.T0) / LEAKAGE
    return 6.0 * LEAKAGE**3 * (np.sinh(part) - part)


Law = Callable[[World, Campaign], Array]
LAWS: Mapping[str, Law] = MappingProxyType(
    {
        # a resistor of the drive circuit has a tempco
        "temperature_circuit": lambda w, c: w.circuit - c.T0,
        "temperature_circuit_quadratic": lambda w, c: _energy(w.circuit - c.T0, c.T0),
        "temperature_circuit_cubic": _leakages,
        # heat flowing from circuit to head strains the mount
        "gradient": lambda w, c: w.uneven,
        # an unevenly warm plate bows, whichever side is warmer, and stiffens as it does
        "gradient_quadratic": lambda w, c: (
            2.0 * BOW**2 * (np.sqrt(1.0 + (w.uneven / BOW) ** 2) - 1.0)
        ),
        "gradient_cubic": lambda w, c: w.uneven**3 / (1.0 + (w.uneven / BOW) ** 2),
        # the heat that flows into the circuit board strains it: its true heating rate, °C/min
        "rate_circuit": lambda w, c: w.circuit_rate,
        "rate_head": lambda w, c: w.head_rate,
        # strain by heat flow, through a mismatch of expansions that grows with temperature
        "temperature_x_rate": lambda w, c: (w.head - c.T0) * w.head_rate,
        "temperature_x_gradient": lambda w, c: (w.head - c.T0) * w.uneven,
        # the resonators are not at the temperature of the head's thermometer
        "thermal_lag": lambda w, c: first_order_body(w.head, c.lag_time, GRID) - w.head,
        "hysteresis": _hysteresis,
        # the oscillators are off when cold and right when they have warmed
        "warm_up": lambda w, c: 1.0 - w.warmth,
        # ageing, logarithmic in time, one over the whole test
        "drift": lambda w, c: np.log2(1.0 + w.time / w.time[-1]),
    }
)
"""Every cause that can be hidden in bias or scale factor, beside chance."""

CHANCE: Mapping[str, Callable[[World, Chance], Array]] = MappingProxyType(
    {
        # turn-on repeatability
        "run": lambda w, chance: chance.run[w.run],
        # the fixture settles anew at each soak
        "cell": lambda w, chance: np.where(w.cell >= 0, chance.cell[np.maximum(w.cell, 0)], 0.0),
    }
)
"""What is there by chance: of each reading, in standard deviations."""
