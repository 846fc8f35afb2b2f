"""What can be hidden in a simulated gyro: one small physical law per effect.

Each law takes the effect's size (the unit is that of `SIZES` or `UNLISTED_SIZES`), the campaign
and the world of the test, and returns its part of the output in °/s on the one-second grid. None
uses the columns from which a candidate effect builds its basis, so a fitted model is an
approximation here as it is in life.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from bayescal_models.mems_gyro.campaign import Array, Campaign
from bayescal_models.mems_gyro.chamber import World
from bayescal_models.simulated import Size

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


def _quadratic(size: float, campaign: Campaign, world: World) -> Array:
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
    return size * _mixed(change**2, softening / curvature, campaign.nonlinearity)


def _cubic(size: float, campaign: Campaign, world: World) -> Array:
    """What a compensation saturating as tanh leaves of a line: ΔT³ and a little less."""
    change = world.ambient - campaign.T0
    left = 3.0 * SATURATION**3 * (change / SATURATION - np.tanh(change / SATURATION))
    return size * _mixed(change**3, left, campaign.nonlinearity)


def _rate(size: float, campaign: Campaign, world: World) -> Array:
    """Stress from the heat flowing into the package: its true heating rate, °C/min."""
    return size * 60.0 * (world.ambient - world.package) / campaign.package_time


def _thermal_lag(size: float, campaign: Campaign, world: World) -> Array:
    """The die is not at the temperature that the ambient thermometer shows."""
    return size * (world.die - world.ambient)


def _reference_voltage(size: float, campaign: Campaign, world: World) -> Array:
    """The chip that gives the zero level, 1.2 V, has a linear tempco and sits on the board."""
    tempco = size * campaign.sensitivity / campaign.null_voltage
    shift = campaign.null_voltage * tempco * (world.board - campaign.T0)
    return shift / campaign.sensitivity


def _warm_up(size: float, campaign: Campaign, world: World) -> Array:
    """Electronics are off by `size` when cold, and right when they have heated themselves."""
    return size * (1.0 - world.warmth)


def _drift(size: float, campaign: Campaign, world: World) -> Array:
    """Ageing, logarithmic in time, `size` over the whole test: mildly curved."""
    share = world.time / world.time[-1]
    return size * _mixed(share, np.log2(1.0 + share), campaign.nonlinearity)


def _run(size: float, campaign: Campaign, world: World) -> Array:
    """Turn-on repeatability: a new offset at each power-on, `size` its standard deviation."""
    return size * world.turn_on


def _scale_temperature(size: float, campaign: Campaign, world: World) -> Array:
    """Scale factor follows the package: `κ(T_package)·Ω`; nothing at rest."""
    return 1e-6 * size * (world.package - campaign.T0) * world.rate


def _scale_constant(size: float, campaign: Campaign, world: World) -> Array:
    """Scale factor is off by a constant share: `κ·Ω`; nothing at rest."""
    return 1e-6 * size * world.rate


def _periodic(size: float, campaign: Campaign, world: World) -> Array:
    """Periodic pick-up such as the chamber's compressor; `size` is the amplitude."""
    return size * np.sin(2.0 * np.pi * world.time / campaign.period)


def _step(size: float, campaign: Campaign, world: World) -> Array:
    """A step at a share of the logged time (so never within a pause)."""
    run, within = divmod(campaign.step_fraction * campaign.runs, 1.0)
    at = run * (campaign.run_duration + campaign.pause) + within * campaign.run_duration
    return size * (world.time > at)


def _humidity(size: float, campaign: Campaign, world: World) -> Array:
    """Leakage that grows with the relative humidity, about 45 %."""
    return size * (world.humidity - 45.0)


LAWS: Mapping[str, Callable[[float, Campaign, World], Array]] = MappingProxyType(
    {
        "bias.temperature_quadratic": _quadratic,
        "bias.temperature_cubic": _cubic,
        "bias.rate": _rate,
        "bias.thermal_lag": _thermal_lag,
        "bias.reference_voltage": _reference_voltage,
        "bias.warm_up": _warm_up,
        "bias.drift": _drift,
        "bias.run": _run,
        "scale.temperature": _scale_temperature,
        "scale.constant": _scale_constant,
        "unlisted.periodic": _periodic,
        "unlisted.step": _step,
        "unlisted.humidity": _humidity,
    }
)
"""Every effect that can be hidden, by its canonical name."""
