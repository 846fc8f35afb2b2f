"""Simulator of campaigns with hidden effects: two devices, and one physical law per effect.

Device "cubic": bias and scale factor are cubic polynomials of the head's temperature. Device "beams": two quartz
beams, one pulled and one pushed by the proof mass, with frequencies `F·(1 + α·ΔT + β·ΔT² + γ·ΔT³)` of slightly
different coefficients and lags behind the head; their difference determines the bias, and their sum indicates the
temperature. The phase of the oscillator circuit, the stress of temperature gradients, which grows with temperature,
and the softening of a glued joint add to the bias. None of these is a polynomial of the measured temperatures.

A law returns the contribution of one unit of an effect to the bias (µg) or scale factor (ppm) at each simulation step.
Laws use true temperatures and heat flows, not the columns of the fitted model's basis functions.

Source: source 2 (differential beams, thermometers, dependence on gradient and rate); numbers assumed.
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
from bayescal_models.quartz_beam_accelerometer.world import Conditions
from bayescal_models.simulated import SUPPLY_V, Array

BEAM_FREQUENCY_HZ = 40_000.0  # Hz, of one beam
BEAM_TEMPCO = -20e-6  # 1/°C, of one beam's frequency; the sum indicates the temperature
POWER_NAMES = ("constant_head", *(f"temperature_head{n}" for n in ("", "_quadratic", "_cubic")))
BEAM_TAU_S = 90.0  # s, lag of the beams behind the head's thermometer
LAG_MISMATCH = 0.005  # relative difference of the two beams' lags
KELVIN_OFFSET = 273.15
EINSTEIN_TEMPERATURE_K = 400.0  # K, of the oscillators in the circuit's quadratic law; assumed
LEAKAGE_SCALE_DEGC = 80.0  # °C, temperature rise that multiplies leakage currents by e; assumed
BOWING_DEGC = 60.0  # °C, gradient at which a bowed plate stiffens; assumed
NOISE_TAU_S, LAG_TAU_S = 300.0, 600.0  # s, of correlated noise and of the hidden lag
RANDOM_STREAMS = ("noise", "wander", "thermometers", "bias", "scale", "frequency", "supply")

CUBIC_COEFFICIENTS: Mapping[str, float] = MappingProxyType(
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
"""True coefficients of the cubic device, relative to T0: µg and ppm, per power of °C."""
CUBIC = CUBIC_COEFFICIENTS  # the former name


@dataclass(frozen=True)
class Truth:
    """True values at readings, (n,) each: bias, µg; scale factor deviation, ppm; sum of the beams' frequencies, Hz."""

    bias: Array
    scale: Array
    frequency_sum: Array


def compute_device_truth(test: Conditions, coefficients: Mapping[str, float]) -> Truth:
    """Return the true bias, scale factor and frequency sum of the device without hidden effects.

    Args:
        test: conditions of the test.
        coefficients: coefficients of the device "cubic" by name, as in `CUBIC_COEFFICIENTS`; not used for "beams".
    """
    if test.plan.device == "beams":
        return _compute_beam_truth(test)
    change = test.head - test.plan.T0
    bias, scale = (
        np.polynomial.polynomial.polyval(change, [coefficients[f"{slot}.{n}"] for n in POWER_NAMES])
        for slot in ("bias", "scale")
    )
    frequency_sum = _sum_frequencies(change, change)
    return Truth(test.average(bias), test.average(scale), test.average(frequency_sum))


def _compute_frequency(change: Array, tempco: float, curvature: float, cubic: float) -> Array:
    """Return a beam's relative frequency change for a temperature change, °C; coefficients in 1/°C, 1/°C², 1/°C³."""
    return change * (tempco + change * (curvature + change * cubic))


def _sum_frequencies(first: Array, second: Array) -> Array:
    curvature = -0.02e-6  # 1/°C², typical of quartz
    low, high = (_compute_frequency(beam, BEAM_TEMPCO, curvature, 0.0) for beam in (first, second))
    return BEAM_FREQUENCY_HZ * (2.0 + (low + high))


def _compute_beam_truth(test: Conditions) -> Truth:
    beam, other = (test.low_pass(test.head, BEAM_TAU_S * lag) for lag in (1, 1 + LAG_MISMATCH))
    first, second = beam - test.plan.T0, other - test.plan.T0
    hz_per_ug = SCALE_FACTOR * 1e-6
    # Differences of the beams' coefficients, 1/°C and powers: 55 µg/°C, 0.36 µg/°C², 0.0032 µg/°C³.
    differences = (1.375e-7, 0.9e-9, 0.8e-11)
    terms = (BEAM_TEMPCO, -0.02e-6, 0.0)
    f_pulled = _compute_frequency(first, *(c + u for c, u in zip(terms, differences, strict=True)))
    f_pushed, gradient = _compute_frequency(second, *terms), test.gradient
    stress = 10.0 * gradient * (1 + 0.01 * (test.head - test.plan.T0))
    phase = 4.0 * (test.circuit - test.plan.T0)
    joint = 20.0 * np.tanh((beam - 50.0) / 20.0)
    bias = 2500.0 + BEAM_FREQUENCY_HZ * (f_pulled - f_pushed) / hz_per_ug + stress + phase + joint
    scale = (
        800.0
        + first * (6.0 + first * (0.04 + first * 0.0003))
        + gradient * (1.0 + 0.01 * first)
        - 0.2 * (test.circuit - test.plan.T0)  # by the frequency counter's clock
    )
    frequencies = _sum_frequencies(first, second)
    return Truth(test.average(bias), test.average(scale), test.average(frequencies))


def _evaluate_einstein_energy(test: Conditions) -> Array:
    """Return the energy of an Einstein oscillator minus its tangent at T0, scaled to ΔT² at small ΔT, °C²."""

    def energy(kelvin):
        return 1.0 / np.expm1(EINSTEIN_TEMPERATURE_K / kelvin)

    at, step, change = test.plan.T0 + KELVIN_OFFSET, 1.0, test.circuit - test.plan.T0
    slope = (energy(at + step) - energy(at - step)) / (2 * step)
    curvature = (energy(at + step) - 2 * energy(at) + energy(at - step)) / step**2
    return 2.0 * (energy(at + change) - energy(at) - slope * change) / curvature


def _evaluate_leakage_difference(test: Conditions) -> Array:
    """Return the difference of two leakage currents, 6w³(sinh(ΔT/w) − ΔT/w) ≈ ΔT³, °C³, w = `LEAKAGE_SCALE_DEGC`."""
    ratio = (test.circuit - test.plan.T0) / LEAKAGE_SCALE_DEGC
    return 6.0 * LEAKAGE_SCALE_DEGC**3 * (np.sinh(ratio) - ratio)


LAWS: Mapping[str, Callable[[Conditions], Array]] = MappingProxyType(
    {
        "temperature_circuit": lambda test: test.circuit - test.plan.T0,
        "temperature_circuit_quadratic": _evaluate_einstein_energy,
        "temperature_circuit_cubic": _evaluate_leakage_difference,
        # strain of the mount by heat flow from circuit to head
        "gradient": lambda test: test.gradient,
        # bowing of a plate with a temperature gradient of either sign, which stiffens
        "gradient_quadratic": lambda test: (
            2.0 * BOWING_DEGC**2 * (np.sqrt(1.0 + (test.gradient / BOWING_DEGC) ** 2) - 1.0)
        ),
        "gradient_cubic": lambda test: (
            test.gradient**3 / (1.0 + (test.gradient / BOWING_DEGC) ** 2)
        ),
        # strain of the circuit board by the heat flow into it: true temperature rate, °C/min
        "rate_circuit": lambda test: test.circuit_rate,
        "rate_head": lambda test: test.head_rate,
        # strain by heat flow, with a mismatch of thermal expansion that grows with temperature
        "temperature_x_rate": lambda test: (test.head - test.plan.T0) * test.head_rate,
        "temperature_x_gradient": lambda test: (test.head - test.plan.T0) * test.gradient,
        "thermal_lag": lambda test: test.low_pass(test.head, LAG_TAU_S) - test.head,
        "hysteresis": lambda test: simulated.compute_stick_slip_strain(test.head),
        "warm_up": lambda test: 1.0 - test.warm_up_fraction,
        # ageing, logarithmic in time, 0 to 1 over the whole test
        "drift": lambda test: np.log2(1.0 + test.time / test.time[-1]),
    }
)
"""Laws of the deterministic effects on bias or scale factor, by name without the slot."""

BIAS_LAWS: Mapping[str, Callable[[Conditions], Array]] = MappingProxyType(
    {
        "bias.supply": lambda test: test.supply - SUPPLY_V,
        "bias.temperature_x_supply": lambda test: (
            (test.head - test.plan.T0) * (test.supply - SUPPLY_V)
        ),
    }
)
"""Laws of the effects of the supply voltage, on the bias only."""

RANDOM: Mapping[str, Callable[[Conditions, Mapping[str, Array]], Array]] = MappingProxyType(
    {
        # turn-on repeatability
        "run": lambda test, draws: draws["run"][test.run],
        # settling of the fixture at each soak
        "cell": lambda test, draws: np.where(
            test.cell >= 0, draws["cell"][np.maximum(test.cell, 0)], 0.0
        ),
    }
)
"""Laws of random effects: a standard normal deviate for each run or cell, by name without the slot."""


def simulate_columns(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """Simulate a campaign with hidden effects; return columns by name, in the instrument's units.

    The same seed gives the same noise and turn-on offsets for any effects.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficient; of random effects (`*.run`,
            `*.cell`) the standard deviation. For the device "cubic", names in `CUBIC_COEFFICIENTS` replace the
            coefficients of the polynomials of bias and scale factor in the head's temperature minus `campaign.T0`.
        seed: seed of the random-number generator.
        campaign: plan of the test; None: `Campaign()`.

    Raises:
        ValueError: an unknown effect, or a size that is not a finite number.
    """
    campaign, effects = campaign or Campaign(), dict(effects or {})
    test, truth = _truth(Conditions(campaign), effects, seed)
    generators, g = simulated.spawn_generators(RANDOM_STREAMS, seed), test.acceleration
    output = truth.bias + (1e6 + truth.scale) * g + effects.get("second_order", 0.0) * g**2
    output = output + _draw_noise(test, generators)
    error = campaign.thermometer_noise * generators["thermometers"].standard_normal((2, g.size))
    columns: dict[str, Any] = {
        "run": np.array([str(k + 1) for k in test.run]),
        "temperature_point": test.point,
        "time": test.average(test.time),
        "temperature_circuit": test.average(test.circuit) + error[0],
        "temperature_head": test.average(test.head) + error[1],
        "acceleration": 1e6 * g,
        "output": output,
    }
    if simulated.needs_supply_column(effects):
        columns["supply_voltage"] = test.average(test.supply)
    if campaign.frequency_sum:
        frequency_noise = 0.005 * generators["frequency"].standard_normal(g.size)  # Hz
        columns["frequency_sum"] = truth.frequency_sum + frequency_noise
    return columns


def true_values(
    campaign: Campaign, effects: Mapping[str, float] | None = None, *, seed: int = 0
) -> Truth:
    """Return the true bias, scale factor and frequency sum at the readings that `simulate` returns; same arguments."""
    return _truth(Conditions(campaign), dict(effects or {}), seed)[1]


def _truth(test: Conditions, effects: Mapping[str, float], seed: int) -> tuple[Conditions, Truth]:
    by_name = {f"{s}.{cause}": (s, cause) for s in ("bias", "scale") for cause in (*LAWS, *RANDOM)}
    coefficients = CUBIC_COEFFICIENTS if test.plan.device == "cubic" else {}
    names = [*by_name, "second_order", *BIAS_LAWS, *coefficients]
    simulated.validate_effects(effects, names, f"a {test.plan.device!r} device")
    generators = simulated.spawn_generators(RANDOM_STREAMS, seed)
    test.supply = simulated.simulate_supply(generators["supply"], test.time)
    coefficients = {n: effects.get(n, v) for n, v in CUBIC_COEFFICIENTS.items()}
    device_values = compute_device_truth(test, coefficients)
    values = {"bias": device_values.bias, "scale": device_values.scale}
    slot_draws = {slot: _draw_group_deviates(generators[slot], test) for slot in values}
    for name, size in effects.items():
        slot, cause = by_name.get(name, ("bias", ""))
        if cause in LAWS:
            values[slot] = values[slot] + size * test.average(LAWS[cause](test))
        elif name in BIAS_LAWS:
            values[slot] = values[slot] + size * test.average(BIAS_LAWS[name](test))
        elif cause in RANDOM:
            values[slot] = values[slot] + size * RANDOM[cause](test, slot_draws[slot])
    return test, Truth(values["bias"], values["scale"], device_values.frequency_sum)


def _draw_group_deviates(generator: np.random.Generator, test: Conditions) -> dict[str, Array]:
    """Draw the standard normal deviates of one slot: "run" → (runs,), "cell" → (cells,)."""
    runs, cells = int(test.run.max()) + 1, int(test.cell.max()) + 1
    return {n: generator.standard_normal(k) for n, k in (("run", runs), ("cell", max(cells, 1)))}


def _draw_noise(test: Conditions, generators: Mapping[str, np.random.Generator]) -> Array:
    """Draw the noise of each reading, µg, (n,)."""
    white_noise = test.plan.noise * generators["noise"].standard_normal(test.run.size)
    if test.plan.noise_law == "white":
        return white_noise
    # Ornstein–Uhlenbeck noise of unit variance at the times of the readings, independent between runs.
    step = np.diff(test.average(test.time), prepend=-np.inf)
    step[np.diff(test.run, prepend=-1) != 0] = np.inf
    decay = np.exp(-step / NOISE_TAU_S)
    increments = np.sqrt(1.0 - decay**2) * generators["wander"].standard_normal(test.run.size)
    wander, state = np.empty(test.run.size), 0.0
    for i, increment in enumerate(increments):
        wander[i] = state = decay[i] * state + increment
    return white_noise + test.plan.noise * wander
