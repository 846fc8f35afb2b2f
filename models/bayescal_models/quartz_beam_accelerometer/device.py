"""The device itself: its bias, scale factor and frequency sum in a thermal world.

Two truths. `cubic`: bias and scale factor follow the head's temperature by a cubic, exactly. `beams`: two quartz
beams pulled and pushed by the proof mass, of frequency `F·(1 + α·ΔT + β·ΔT² + γ·ΔT³)` each, with slightly unlike
coefficients and lags behind the head; the difference of their frequencies carries the bias, the sum is a
thermometer. To it come the oscillator circuit's phase, the stress of an uneven temperature, which grows with
temperature, and the softening of a glued joint. None of these is a polynomial in what the thermometers read.

Source: source 2 (differential beams, thermometers, dependence on gradient and rate); numbers ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from bayescal_models.quartz_beam_accelerometer import SCALE_FACTOR
from bayescal_models.quartz_beam_accelerometer.campaign import GRID, Campaign
from bayescal_models.quartz_beam_accelerometer.thermal import World
from bayescal_models.simulated import Array, first_order_body

BEAM_FREQUENCY = 40_000.0  # Hz, of one beam
BEAM_TEMPCO = -20e-6  # 1/°C, of one beam's frequency: what makes the sum a thermometer
POWERS = ("constant_head", *(f"temperature_head{n}" for n in ("", "_quadratic", "_cubic")))
LAG_MISMATCH = 0.005  # by how much one beam lags more than the other, relative

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
    """What the device does, reading by reading (n,): bias in µg, relative scale factor in ppm, sum in Hz."""

    bias: Array
    scale: Array
    frequency_sum: Array


def truth(campaign: Campaign, world: World, coefficients: Mapping[str, float]) -> Truth:
    """Bias, scale factor and frequency sum of the campaign's device.

    Args:
        coefficients: of the cubic device; the beams have none of these.
    """
    if campaign.device == "beams":
        return _beams(campaign, world)
    change = world.head - campaign.T0
    bias, scale = (
        np.polynomial.polynomial.polyval(change, [coefficients[f"{slot}.{n}"] for n in POWERS])
        for slot in ("bias", "scale")
    )
    both = _sum_of_frequencies(change, change)
    return Truth(world.average(bias), world.average(scale), world.average(both))


def _relative(change: Array, tempco: float, curvature: float, cubic: float) -> Array:
    """Relative change of a beam's frequency."""
    return change * (tempco + change * (curvature + change * cubic))


def _sum_of_frequencies(first: Array, second: Array) -> Array:
    curvature = -0.02e-6  # 1/°C²: about quartz's
    one, other = (_relative(beam, BEAM_TEMPCO, curvature, 0.0) for beam in (first, second))
    return BEAM_FREQUENCY * (2.0 + (one + other))


def _beams(campaign: Campaign, world: World) -> Truth:
    beam, other = (
        first_order_body(world.head, campaign.beam_time * slower, GRID)
        for slower in (1, 1 + LAG_MISMATCH)
    )
    first, second = beam - campaign.T0, other - campaign.T0
    per_ug = SCALE_FACTOR * 1e-6
    unlike = (1.375e-7, 0.9e-9, 0.8e-11)  # 1/°C and powers: 55 µg/°C, 0.36 µg/°C², 0.0032 µg/°C³
    common = (BEAM_TEMPCO, -0.02e-6, 0.0)
    pulled = _relative(first, *(c + u for c, u in zip(common, unlike, strict=True)))
    pushed = _relative(second, *common)
    uneven = world.uneven
    stress = 10.0 * uneven * (1 + 0.01 * (world.head - campaign.T0))
    phase = 4.0 * (world.circuit - campaign.T0)
    joint = 20.0 * np.tanh((beam - 50.0) / 20.0)
    bias = 2500.0 + BEAM_FREQUENCY * (pulled - pushed) / per_ug + stress + phase + joint
    scale = (
        800.0
        + first * (6.0 + first * (0.04 + first * 0.0003))
        + uneven * (1.0 + 0.01 * first)
        - 0.2 * (world.circuit - campaign.T0)  # the clock that counts the beats
    )
    frequencies = _sum_of_frequencies(first, second)
    return Truth(world.average(bias), world.average(scale), world.average(frequencies))
