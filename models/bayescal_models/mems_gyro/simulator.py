"""Simulator of campaigns of a MEMS gyro in a stepped chamber, independent of the model's equations.

    sim = simulate_arrays({"bias.thermal_lag": 0.05}, seed=1)
    sim.columns["output"], sim.noise_free, sim.contributions["bias.thermal_lag"]

The world is made second by second over the whole test, pauses included, so that what a run finds at its start is what
the run before it and the pause have left. Three bodies of first order hang on the chamber's air: the package (tens of
seconds), the die's surroundings (minutes) and the electronics board (minutes, with its own heat). Each hidden effect
is a law in that world, and the logger's samples are averaged into readings at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayescal_models import simulated
from bayescal_models.mems_gyro.campaign import GRID, LOGGING_INTERVAL, Campaign
from bayescal_models.simulated import Array, Clock, Simulated, correlated, refuse

NOISE_LAWS = ("white", "student_t", "ornstein_uhlenbeck")
SILICON_TEMPERATURE = (
    500.0  # K, characteristic, of the modulus in Varshni's law; ours, as silicon's
)
SATURATION = 60.0  # °C, temperature change over which a built-in compensation saturates; ours
PACKAGE_TIME = 20.0  # s, thermal time constant of the package
SLOW_TIME = 2400.0  # s, time constant of a slow body, such as the chamber's load
BOARD_TIME, BOARD_HEATING = 480.0, 2.0  # s, of the electronics board; °C, by which it heats itself
WARM_UP_TIME = 600.0  # s, warm-up of the electronics after power-on
NOISE_DEGREES = 4.0  # degrees of freedom of Student-t noise
WANDER, WANDER_TIME = 0.05, 300.0  # °/s and s, of correlated noise


class World(Clock):
    """Conditions in a test, second by second; arrays have one value per grid point.

    Attributes:
        plan: plan of the test.
        since: time since the last power-on, s.
        powered: whether the gyro is on.
        ambient: air at the ambient thermometer, °C: ramp-limited steps through a first-order lag.
        turn_on: one standard normal number per run, constant through that run and the pause after it.
        supply: voltage of the gyro's supply, V.
        humidity: relative humidity in the chamber, %.
        run: run of each reading, counted from 0.
    """

    step = GRID

    def __init__(self, plan: Campaign, generators: Mapping[str, np.random.Generator]) -> None:
        self.plan, starts = plan, plan.run_starts
        length = round((starts[-1] + plan.run_duration) / GRID) + 1
        self.time = GRID * np.arange(length)
        # A run has the samples in (start, end], as has a step: the sample at the end belongs to it.
        self._run = np.maximum(np.searchsorted(starts, self.time, side="left") - 1, 0)
        self.since = self.time - starts[self._run]
        self.powered = (self.since > 0) & (self.time <= starts[self._run] + plan.run_duration)
        self.ambient = self.body(_set_point(plan, self.time), plan.chamber_time)
        self.turn_on = generators["run"].standard_normal(plan.runs)[self._run]
        self.supply = simulated.wandering_supply(generators["supply"], self.time)
        moist = 45.0 + 5.0 * correlated(generators["humidity"], length, 2400.0, GRID)
        self.humidity = np.clip(moist, 2.0, 98.0)
        samples = round(plan.run_duration / LOGGING_INTERVAL)
        taken_at = starts[:, None] + LOGGING_INTERVAL * np.arange(1, samples + 1)
        points = np.rint(taken_at / GRID).astype(np.intp)
        self.samples = points.reshape(-1, round(plan.average / LOGGING_INTERVAL))
        self.run = self._run[self.samples[:, 0]]

    @cached_property
    def package(self) -> Array:
        """Return the package temperature, °C."""
        return self.body(self.ambient, PACKAGE_TIME)

    @cached_property
    def board(self) -> Array:
        """Return the electronics board temperature, °C."""
        around = self.ambient + BOARD_HEATING * self.powered
        return self.body(around, BOARD_TIME, start=self.ambient[0])

    @cached_property
    def rate(self) -> Array:
        """Return the turntable rate, °/s, cycled over the steps of all runs; 0 without a table."""
        rates = np.asarray(self.plan.rate_input or (0.0,), dtype=float)
        at = np.ceil(self.since / self.plan.dwell).astype(int) - 1
        turning = rates[(self._run * len(self.plan.temperatures) + at) % len(rates)]
        return np.where(self.powered, turning, 0.0)


def _set_point(plan: Campaign, time: Array) -> Array:
    """Return the chamber's set point, °C: ramp-limited steps, the first held from the beginning."""
    starts: list[float] = []
    goals: list[float] = []
    for k, start in enumerate(plan.run_starts):
        starts += [start + plan.dwell * i for i in range(len(plan.temperatures))]
        goals += plan.set_points(k)
        if k + 1 < plan.runs and plan.pause > 0:
            starts.append(start + plan.run_duration)
            goals.append(plan.set_points(k + 1)[0])
    return simulated.ramp_limited(time, starts, goals, plan.chamber_ramp)


# Laws: contribution of one unit of an effect to the output, °/s. None uses the columns of a candidate effect's basis,
# so that a fitted model is an approximation, as with real readings.


def _quadratic(w: World) -> Array:
    """Return the modulus after Varshni, `E = E0 − s/(e^(Θ/T)−1)`, less its tangent at T0: about ΔT².

    Source: Y. P. Varshni, Phys. Rev. B 2 (1970) 3952.
    """
    theta, kelvin = SILICON_TEMPERATURE, w.plan.T0 + 273.15
    change = w.ambient - w.plan.T0
    e = np.exp(theta / kelvin)
    at_T0 = 1.0 / (e - 1.0)
    slope = theta / kelvin**2 * e / (e - 1.0) ** 2
    curvature = slope * (theta / kelvin**2 * (e + 1.0) / (e - 1.0) - 2.0 / kelvin) / 2.0
    softening = 1.0 / np.expm1(theta / (kelvin + change)) - at_T0 - slope * change
    return _mix_terms(w, change**2, softening / curvature)


def _cubic(w: World) -> Array:
    """Return the remainder of a line after a tanh compensation: slightly less than ΔT³."""
    change = w.ambient - w.plan.T0
    remainder = 3.0 * SATURATION**3 * (change / SATURATION - np.tanh(change / SATURATION))
    return _mix_terms(w, change**3, remainder)


def _drift(w: World) -> Array:
    """Return an ageing logarithmic in time, 1 over the whole test: mildly curved."""
    share = w.time / w.time[-1]
    return _mix_terms(w, share, np.log2(1.0 + share))


def _mix_terms(w: World, leading: Array, law: Array) -> Array:
    """Return the leading term of a law, plus a share of its higher terms."""
    return leading + w.plan.nonlinearity * (law - leading)


LAWS: Mapping[str, Callable[[World], Array]] = MappingProxyType(
    {
        "bias.temperature_quadratic": _quadratic,
        "bias.temperature_cubic": _cubic,
        # stress from the heat flowing into the package: its true heating rate, °C/min
        "bias.rate": lambda w: 60.0 * (w.ambient - w.package) / PACKAGE_TIME,
        # the die lags behind the ambient thermometer
        "bias.thermal_lag": lambda w: w.body(w.ambient, w.plan.lag_time) - w.ambient,
        "bias.thermal_lag_slow": lambda w: w.body(w.ambient, SLOW_TIME) - w.ambient,
        # stress between package and die, of a glue that is softer when warm
        "bias.temperature_x_lag": lambda w: (
            (w.ambient - w.plan.T0) * (w.body(w.ambient, w.plan.lag_time) - w.ambient)
        ),
        "bias.hysteresis": lambda w: simulated.sticking(w.ambient),
        "bias.supply": lambda w: w.supply - simulated.SUPPLY,
        "bias.temperature_x_supply": lambda w: (
            (w.ambient - w.plan.T0) * (w.supply - simulated.SUPPLY)
        ),
        # the 1.2 V reference, on the board, has a linear tempco
        "bias.reference_voltage": lambda w: w.board - w.plan.T0,
        # the error of the electronics decays with self-heating
        "bias.warm_up": lambda w: 1.0 - w.body(w.powered.astype(float), WARM_UP_TIME, start=0.0),
        "bias.drift": _drift,
        # turn-on repeatability: a new offset at each power-on, the size its standard deviation
        "bias.run": lambda w: w.turn_on,
        # the scale factor follows the package: κ(T_package)·Ω, nothing at rest
        "scale.temperature": lambda w: 1e-6 * (w.package - w.plan.T0) * w.rate,
        "scale.constant": lambda w: 1e-6 * w.rate,
        # not in the catalogue: leakage that grows with relative humidity, about 45 %, in °/s/%
        "unlisted.humidity": lambda w: w.humidity - 45.0,
    }
)
"""Every effect that can be hidden, by its canonical name."""


def simulate_arrays(
    effects: Mapping[str, float] | None = None,
    *,
    seed: int,
    campaign: Campaign | None = None,
    noise_law: str = "white",
) -> Simulated:
    """Simulate a stepped-chamber campaign with hidden effects.

    The same seed gives the same noise, the same turn-on offsets and the same humidity whatever the effects, so two
    simulations differ by the effects alone. The number of rows depends on the campaign only. Contributions are in °/s
    and add up to the output without noise: "baseline", "rate_input" where there is one, and each hidden effect.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficient. The baseline's constant and slope
            are options of the campaign.
        seed: seed of the random-number generator.
        campaign: the plan of the test and the world it is made in; the default has three runs between 30 and 80 °C.
        noise_law: "white"; "student_t" (same standard deviation, heavier tails); "ornstein_uhlenbeck" (the white noise,
            and the campaign's correlated part, `wander`).

    Raises:
        ValueError: an effect or a noise law of an unknown name, or a size that is not finite.
    """
    campaign, effects = campaign or Campaign(), dict(effects or {})
    laws = ", ".join(NOISE_LAWS)
    refuse(noise_law not in NOISE_LAWS, f"noise law {noise_law!r} is not one of {laws}")
    of_campaign = effects.keys() & {"bias.temperature", "bias.constant"}
    refuse(
        of_campaign,
        f"{', '.join(of_campaign)}: of the baseline; set Campaign(slope=…, constant=…).",
    )
    simulated.refuse_effects(effects, LAWS, "a gyro campaign")
    names = ("noise", "wander", "thermometer", "run", "humidity", "supply")
    generators = simulated.generators(names, seed)
    world = World(campaign, generators)

    line = campaign.constant + campaign.slope * (world.ambient - campaign.T0)
    contributions = {"baseline": world.average(line)}
    if campaign.rate_input is not None:
        contributions["rate_input"] = world.average(world.rate)
    for name, size in effects.items():
        contributions[name] = world.average(size * LAWS[name](world))
    noise_free = np.sum(list(contributions.values()), axis=0)
    output = noise_free + _noise(world, generators, noise_law)

    error = campaign.thermometer_noise * generators["thermometer"].standard_normal(len(output))
    columns: dict[str, NDArray[Any]] = {
        "run": np.array([str(k + 1) for k in world.run]),
        "time": world.average(world.time),
        "temperature": world.average(world.ambient) + error,
        "board_temperature": world.average(world.board),
    }
    if campaign.rate_input is not None:
        columns["rate_input"] = contributions["rate_input"].copy()
    if simulated.supplied(effects):
        columns["supply_voltage"] = world.average(world.supply)
    if "unlisted.humidity" in effects:
        columns["humidity [%]"] = world.average(world.humidity)  # no column of the instrument's own
    columns["output"] = output
    return Simulated(columns, world, contributions, noise_free)


simulated_columns = simulated.columns_of(simulate_arrays)


def _noise(world: World, generators: Mapping[str, np.random.Generator], noise_law: str) -> Array:
    """Return the noise of each averaged reading, °/s."""
    campaign, generator, readings = world.plan, generators["noise"], len(world.run)
    if noise_law == "student_t":
        unit_variance = np.sqrt((NOISE_DEGREES - 2.0) / NOISE_DEGREES)
        return campaign.noise * unit_variance * generator.standard_t(NOISE_DEGREES, readings)
    white = campaign.noise * generator.standard_normal(readings)
    if noise_law == "white":
        return white
    slow, wander = np.empty(readings), generators["wander"]
    for k in range(campaign.runs):  # the correlated noise starts anew at each power-on
        record = world.average(correlated(wander, len(world.time), WANDER_TIME, GRID))
        slow[world.run == k] = record[world.run == k]
    return white + WANDER * slow
