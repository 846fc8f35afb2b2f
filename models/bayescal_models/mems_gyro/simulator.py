"""Simulator of campaigns of a MEMS gyro in a stepped chamber, independent of the model's equations.

    test = simulate_arrays({"bias.thermal_lag": 0.05}, seed=1)
    test.columns["output"], test.noise_free, test.contributions["bias.thermal_lag"]

Conditions are simulated in steps of 1 s over the whole test, pauses included, so that temperatures at the start of a
run depend on the previous run and the pause. Three first-order bodies follow the chamber's air: the package (tens of
seconds), the surroundings of the die (minutes) and the electronics board (minutes, with self-heating). Each hidden
effect is a physical law of these conditions; the logger's samples are averaged to readings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayescal_models import simulated
from bayescal_models.mems_gyro.campaign import LOGGING_INTERVAL_S, STEP_S, Campaign
from bayescal_models.simulated import (
    SUPPLY_V,
    Array,
    SimulatedTest,
    TimeGrid,
    correlated_noise,
    raise_if,
)

NOISE_LAWS = ("white", "student_t", "ornstein_uhlenbeck")
VARSHNI_TEMPERATURE_K = 500.0  # characteristic temperature of silicon in Varshni's law; assumed
SATURATION_DEGC = 60.0  # °C, temperature change at which a built-in compensation saturates; assumed
PACKAGE_TAU_S = 20.0  # s, thermal time constant of the package
SLOW_TAU_S = 2400.0  # s, time constant of a slow body, such as the chamber's load
BOARD_TAU_S, BOARD_HEATING_DEGC = 480.0, 2.0  # time constant, self-heating of the electronics board
WARM_UP_S = 600.0  # s, warm-up of the electronics after power-on
STUDENT_T_DOF = 4.0  # degrees of freedom of Student-t noise
CORRELATED_NOISE_SD, NOISE_TAU_S = 0.05, 300.0  # °/s and s, sd and time constant


class Conditions(TimeGrid):
    """True conditions of a test; arrays have one value per grid point, (m,), unless stated otherwise.

    Attributes:
        plan: plan of the test.
        run_time: time since the last power-on, s.
        powered: whether the gyro is powered.
        ambient: air temperature at the ambient thermometer, °C: low-pass of ramp-limited steps.
        run_deviates: standard normal deviate of each run, constant during the run and the pause after it.
        supply: supply voltage of the gyro, V.
        humidity: relative humidity in the chamber, %.
        run: run index of each reading, from 0, (n,).
    """

    step = STEP_S

    def __init__(self, plan: Campaign, generators: Mapping[str, np.random.Generator]) -> None:
        self.plan, starts = plan, plan.run_starts
        grid_size = round((starts[-1] + plan.run_duration) / STEP_S) + 1
        self.time = STEP_S * np.arange(grid_size)
        # Runs and steps are intervals (start, end], which include the sample at their end.
        self._run = np.maximum(np.searchsorted(starts, self.time, side="left") - 1, 0)
        self.run_time = self.time - starts[self._run]
        self.powered = (self.run_time > 0) & (self.time <= starts[self._run] + plan.run_duration)
        self.ambient = self.low_pass(_compute_chamber_set_point(plan, self.time), plan.chamber_time)
        self.run_deviates = generators["run"].standard_normal(plan.runs)[self._run]
        self.supply = simulated.simulate_supply(generators["supply"], self.time)
        humidity = 45.0 + 5.0 * correlated_noise(generators["humidity"], grid_size, 2400.0, STEP_S)
        self.humidity = np.clip(humidity, 2.0, 98.0)
        samples = round(plan.run_duration / LOGGING_INTERVAL_S)
        sample_times = starts[:, None] + LOGGING_INTERVAL_S * np.arange(1, samples + 1)
        points = np.rint(sample_times / STEP_S).astype(np.intp)
        self.samples = points.reshape(-1, round(plan.average / LOGGING_INTERVAL_S))
        self.run = self._run[self.samples[:, 0]]

    @property
    def departure(self) -> Array:
        """Return the temperature change T − T0 of the air, °C."""
        return self.ambient - self.plan.T0

    def lag(self, time_constant: float) -> Array:
        """Return the temperature of a first-order body minus that of the air, °C; time constant in s."""
        return self.low_pass(self.ambient, time_constant) - self.ambient

    @cached_property
    def package(self) -> Array:
        """Return the package temperature, °C."""
        return self.low_pass(self.ambient, PACKAGE_TAU_S)

    @cached_property
    def board(self) -> Array:
        """Return the electronics board temperature, °C."""
        drive = self.ambient + BOARD_HEATING_DEGC * self.powered
        return self.low_pass(drive, BOARD_TAU_S, start=self.ambient[0])

    @cached_property
    def rate(self) -> Array:
        """Return the turntable rate, °/s, cycled over the steps of all runs; 0 without a turntable."""
        rates = np.asarray(self.plan.rate_input or (0.0,), dtype=float)
        step_index = np.ceil(self.run_time / self.plan.dwell).astype(int) - 1
        step_rates = rates[(self._run * len(self.plan.temperatures) + step_index) % len(rates)]
        return np.where(self.powered, step_rates, 0.0)


def _compute_chamber_set_point(plan: Campaign, time: Array) -> Array:
    """Return the chamber's set point, °C, at times in s: steps of limited rate."""
    starts: list[float] = []
    set_points: list[float] = []
    for k, start in enumerate(plan.run_starts):
        starts += [start + plan.dwell * i for i in range(len(plan.temperatures))]
        set_points += plan.set_points(k)
        if k + 1 < plan.runs and plan.pause > 0:
            starts.append(start + plan.run_duration)
            set_points.append(plan.set_points(k + 1)[0])
    return simulated.compute_ramped_set_point(time, starts, set_points, plan.chamber_ramp)


# Laws: contribution of one unit of an effect to the output, °/s, (m,). They do not use the columns of the model's basis
# functions, so that a fitted model is an approximation, as for real readings.


def _evaluate_quadratic(test: Conditions) -> Array:
    """Return Varshni's modulus `E = E0 − s/(e^(Θ/T)−1)` minus its tangent at T0, scaled to ΔT² at small ΔT, °C².

    Source: Y. P. Varshni, Phys. Rev. B 2 (1970) 3952.
    """
    theta, kelvin = VARSHNI_TEMPERATURE_K, test.plan.T0 + 273.15
    departure = test.departure
    e = np.exp(theta / kelvin)
    value_at_T0 = 1.0 / (e - 1.0)
    slope = theta / kelvin**2 * e / (e - 1.0) ** 2
    curvature = slope * (theta / kelvin**2 * (e + 1.0) / (e - 1.0) - 2.0 / kelvin) / 2.0
    softening = 1.0 / np.expm1(theta / (kelvin + departure)) - value_at_T0 - slope * departure
    return _mix_terms(test, departure**2, softening / curvature)


def _evaluate_cubic(test: Conditions) -> Array:
    """Return the residual of a tanh compensation of a linear error, scaled to slightly less than ΔT³, °C³."""
    departure = test.departure
    ratio = departure / SATURATION_DEGC
    full_law = 3.0 * SATURATION_DEGC**3 * (ratio - np.tanh(ratio))
    return _mix_terms(test, departure**3, full_law)


def _evaluate_drift(test: Conditions) -> Array:
    """Return an ageing drift, logarithmic in time, from 0 to 1 over the whole test."""
    elapsed_fraction = test.time / test.time[-1]
    return _mix_terms(test, elapsed_fraction, np.log2(1.0 + elapsed_fraction))


def _mix_terms(test: Conditions, leading_term: Array, full_law: Array) -> Array:
    """Return the leading term of a law plus `plan.nonlinearity` times its higher-order terms."""
    return leading_term + test.plan.nonlinearity * (full_law - leading_term)


LAWS: Mapping[str, Callable[[Conditions], Array]] = MappingProxyType(
    {
        "bias.temperature_quadratic": _evaluate_quadratic,
        "bias.temperature_cubic": _evaluate_cubic,
        # stress by heat flow into the package: its true temperature rate, °C/min
        "bias.rate": lambda test: 60.0 * (test.ambient - test.package) / PACKAGE_TAU_S,
        "bias.thermal_lag": lambda test: test.lag(test.plan.lag_time),
        "bias.thermal_lag_slow": lambda test: test.lag(SLOW_TAU_S),
        # stress between package and die by a glue that softens with temperature
        "bias.temperature_x_lag": lambda test: test.departure * test.lag(test.plan.lag_time),
        "bias.hysteresis": lambda test: simulated.compute_stick_slip_strain(test.ambient),
        "bias.supply": lambda test: test.supply - SUPPLY_V,
        "bias.temperature_x_supply": lambda test: test.departure * (test.supply - SUPPLY_V),
        # linear tempco of the 1.2 V reference on the board
        "bias.reference_voltage": lambda test: test.board - test.plan.T0,
        "bias.warm_up": lambda test: 1.0 - test.low_pass(1.0 * test.powered, WARM_UP_S, start=0.0),
        "bias.drift": _evaluate_drift,
        # turn-on repeatability: an offset at each power-on, of standard deviation 1
        "bias.run": lambda test: test.run_deviates,
        # scale factor that depends on the package temperature: κ(T_package)·Ω, zero at rest
        "scale.temperature": lambda test: 1e-6 * (test.package - test.plan.T0) * test.rate,
        "scale.constant": lambda test: 1e-6 * test.rate,
        # leakage that grows with relative humidity, relative to 45 %, in °/s/%; not in the catalogue
        "unlisted.humidity": lambda test: test.humidity - 45.0,
    }
)
"""Laws of all effects that can be hidden, by canonical name."""


def simulate_arrays(
    effects: Mapping[str, float] | None = None,
    *,
    seed: int,
    campaign: Campaign | None = None,
    noise_law: str = "white",
) -> SimulatedTest:
    """Simulate a stepped-chamber campaign with hidden effects.

    The same seed gives the same noise, turn-on offsets and humidity for any effects, so that two simulations differ
    by the effects alone. The number of rows depends on the campaign only. Contributions are in °/s and add up to the
    noise-free output: "baseline", "rate_input" if there is one, and each hidden effect.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficient. Constant and slope of the
            baseline are options of the campaign.
        seed: seed of the random-number generator.
        campaign: plan of the test; the default has three runs between 30 and 80 °C.
        noise_law: "white"; "student_t": same standard deviation, heavier tails; "ornstein_uhlenbeck": white plus
            correlated noise.

    Raises:
        ValueError: an unknown effect or noise law, a baseline effect, or a size that is not finite.
    """
    campaign, effects = campaign or Campaign(), dict(effects or {})
    choices = ", ".join(NOISE_LAWS)
    raise_if(noise_law not in NOISE_LAWS, f"noise law {noise_law!r} is not one of {choices}")
    baseline_names = effects.keys() & {"bias.temperature", "bias.constant"}
    baseline_text = f"{', '.join(baseline_names)}: give the size of a baseline effect as"
    raise_if(baseline_names, f"{baseline_text} Campaign(slope=…, constant=…)")
    simulated.validate_effects(effects, LAWS, "a gyro campaign")
    names = ("noise", "wander", "thermometer", "run", "humidity", "supply")
    generators = simulated.spawn_generators(names, seed)
    test = Conditions(campaign, generators)

    baseline = campaign.constant + campaign.slope * (test.ambient - campaign.T0)
    contributions = {"baseline": test.average(baseline)}
    if campaign.rate_input is not None:
        contributions["rate_input"] = test.average(test.rate)
    for name, size in effects.items():
        contributions[name] = test.average(size * LAWS[name](test))
    noise_free = np.sum(list(contributions.values()), axis=0)
    output = noise_free + _draw_noise(test, generators, noise_law)

    errors = campaign.thermometer_noise * generators["thermometer"].standard_normal(len(output))
    columns: dict[str, NDArray[Any]] = {
        "run": np.array([str(k + 1) for k in test.run]),
        "time": test.average(test.time),
        "temperature": test.average(test.ambient) + errors,
        "board_temperature": test.average(test.board),
    }
    if campaign.rate_input is not None:
        columns["rate_input"] = contributions["rate_input"].copy()
    if simulated.needs_supply_column(effects):
        columns["supply_voltage"] = test.average(test.supply)
    if "unlisted.humidity" in effects:
        columns["humidity [%]"] = test.average(test.humidity)  # not a column of the instrument
    columns["output"] = output
    return SimulatedTest(columns, test, contributions, noise_free)


simulate_columns = simulated.column_simulator(simulate_arrays)


def _draw_noise(
    test: Conditions, generators: Mapping[str, np.random.Generator], noise_law: str
) -> Array:
    """Draw the noise of each averaged reading, °/s, (n,)."""
    campaign, generator, readings = test.plan, generators["noise"], len(test.run)
    if noise_law == "student_t":
        unit_variance_factor = np.sqrt((STUDENT_T_DOF - 2.0) / STUDENT_T_DOF)
        return campaign.noise * unit_variance_factor * generator.standard_t(STUDENT_T_DOF, readings)
    white_noise = campaign.noise * generator.standard_normal(readings)
    if noise_law == "white":
        return white_noise
    wander, rng = np.empty(readings), generators["wander"]
    for k in range(campaign.runs):  # correlated noise is independent between runs
        record = test.average(correlated_noise(rng, len(test.time), NOISE_TAU_S, STEP_S))
        wander[test.run == k] = record[test.run == k]
    return white_noise + CORRELATED_NOISE_SD * wander
