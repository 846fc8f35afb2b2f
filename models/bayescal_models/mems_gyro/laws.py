"""What can be hidden in a simulated gyro: one small physical law per effect.

Each law takes the campaign and the world of the test, and returns what one unit of the effect (that of `SIZES` or
`UNLISTED_SIZES`) adds to the output, °/s, on the one-second grid. None uses the columns from which a candidate
effect builds its basis, so a fitted model is an approximation here as it is in life.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from bayescal_models.mems_gyro.campaign import Campaign
from bayescal_models.mems_gyro.chamber import World
from bayescal_models.simulated import Array, Size

SILICON_TEMPERATURE = 500.0
"""Characteristic temperature of the modulus in Varshni's law, K (ours: about silicon's)."""

SATURATION = 60.0
"""Temperature change over which a built-in compensation saturates, °C (ours)."""


SIZES: Mapping[str, Size] = MappingProxyType(
    {
        "bias.temperature": Size(0.05, "deg/s/degC"),
        "bias.temperature_quadratic": Size(5e-4, "deg/s/degC^2"),
        "bias.temperature_cubic": Size(1e-5, "deg/s/degC^3"),
        "bias.rate": Size(0.1, "deg/s/(degC/min)"),
        "bias.thermal_lag": Size(0.05, "deg/s/degC"),
        "bias.reference_voltage": Size(0.02, "deg/s/degC"),
        "bias.warm_up": Size(0.5, "deg/s"),
        "bias.drift": Size(0.1, "deg/s"),
        "bias.run": Size(0.05, "deg/s"),
        "scale.temperature": Size(300.0, "ppm/degC"),
        "scale.constant": Size(10000.0, "ppm"),
    }
)
"""Prior standard deviations of a gyro's effects, ours; `bias.temperature` is the baseline's."""

UNLISTED_SIZES: Mapping[str, Size] = MappingProxyType(
    {
        "unlisted.periodic": Size(0.1, "deg/s"),
        "unlisted.step": Size(0.2, "deg/s"),
        "unlisted.humidity": Size(0.02, "deg/s/%"),
    }
)
"""Plausible sizes of the effects that no catalogue holds, ours."""


def _mixed(leading: Array, law: Array, nonlinearity: float) -> Array:
    """The leading term of a law, plus a share of what the law has beyond it."""
    return leading + nonlinearity * (law - leading)


def _quadratic(campaign: Campaign, world: World) -> Array:
    """Modulus after Varshni, `E = E0 − s/(e^(Θ/T)−1)`, less its tangent at T0: about ΔT².

    Source: Y. P. Varshni, Phys. Rev. B 2 (1970) 3952.
    """
    theta, kelvin = SILICON_TEMPERATURE, campaign.T0 + 273.15
    change = world.ambient - campaign.T0
    e = np.exp(theta / kelvin)
    at_T0 = 1.0 / (e - 1.0)
    slope = theta / kelvin**2 * e / (e - 1.0) ** 2
    curvature = slope * (theta / kelvin**2 * (e + 1.0) / (e - 1.0) - 2.0 / kelvin) / 2.0
    softening = 1.0 / np.expm1(theta / (kelvin + change)) - at_T0 - slope * change
    return _mixed(change**2, softening / curvature, campaign.nonlinearity)


def _cubic(campaign: Campaign, world: World) -> Array:
    """What a compensation saturating as tanh leaves of a line: ΔT³ and a little less."""
    change = world.ambient - campaign.T0
    left = 3.0 * SATURATION**3 * (change / SATURATION - np.tanh(change / SATURATION))
    return _mixed(change**3, left, campaign.nonlinearity)


def _drift(campaign: Campaign, world: World) -> Array:
    """Ageing, logarithmic in time, one over the whole test: mildly curved."""
    share = world.time / world.time[-1]
    return _mixed(share, np.log2(1.0 + share), campaign.nonlinearity)


def _step(campaign: Campaign, world: World) -> Array:
    """A step at a share of the logged time (so never within a pause)."""
    run, within = divmod(campaign.step_fraction * campaign.runs, 1.0)
    at = run * (campaign.run_duration + campaign.pause) + within * campaign.run_duration
    return 1.0 * (world.time > at)


LAWS: Mapping[str, Callable[[Campaign, World], Array]] = MappingProxyType(
    {
        "bias.temperature_quadratic": _quadratic,
        "bias.temperature_cubic": _cubic,
        # stress from the heat flowing into the package: its true heating rate, °C/min
        "bias.rate": lambda c, w: 60.0 * (w.ambient - w.package) / c.package_time,
        # the die is not at the temperature that the ambient thermometer shows
        "bias.thermal_lag": lambda c, w: w.die - w.ambient,
        # the chip that gives the zero level, 1.2 V, has a linear tempco and sits on the board
        "bias.reference_voltage": lambda c, w: w.board - c.T0,
        # electronics are off when cold, and right when they have heated themselves
        "bias.warm_up": lambda c, w: 1.0 - w.warmth,
        "bias.drift": _drift,
        # turn-on repeatability: a new offset at each power-on, the size its standard deviation
        "bias.run": lambda c, w: w.turn_on,
        # the scale factor follows the package: κ(T_package)·Ω, nothing at rest
        "scale.temperature": lambda c, w: 1e-6 * (w.package - c.T0) * w.rate,
        "scale.constant": lambda c, w: 1e-6 * w.rate,
        # periodic pick-up such as the chamber's compressor; the size is the amplitude
        "unlisted.periodic": lambda c, w: np.sin(2.0 * np.pi * w.time / c.period),
        "unlisted.step": _step,
        # leakage that grows with the relative humidity, about 45 %
        "unlisted.humidity": lambda c, w: w.humidity - 45.0,
    }
)
"""Every effect that can be hidden, by its canonical name."""
