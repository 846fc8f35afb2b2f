"""Common parts of simulators: random-number generators, a clock, first-order bodies, noise, input checks."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial, wraps
from typing import Any, NamedTuple, ParamSpec

import numpy as np
from numpy.typing import NDArray

import bayescal as bc

MINUTE, HOUR = 60.0, 3600.0  # s
DEGREE = math.pi / 180  # rad
ARCSEC = DEGREE / 3600  # rad
Array = NDArray[np.floating[Any]]
P = ParamSpec("P")


def spawn_generators(names: Sequence[str], seed: int) -> dict[str, np.random.Generator]:
    """Return an independent random-number generator for each name, all spawned from one seed."""
    seeds = np.random.SeedSequence(seed).spawn(len(names))
    return {name: np.random.default_rng(s) for name, s in zip(names, seeds, strict=True)}


def validate_effects(effects: Mapping[str, float], names: Collection[str], simulation: str) -> None:
    """Check that a simulator has these effects and that their sizes are finite.

    Args:
        effects: effect name → size.
        names: names of the effects that the simulator has.
        simulation: description of the simulation, such as "a gyro campaign".

    Raises:
        ValueError: an unknown name, or a size that is not finite or whose magnitude is 1e100 or more.
    """
    for name, size in effects.items():
        choices = f"choose among {', '.join(names)}"
        raise_if(name not in names, f"unknown effect {name!r} for {simulation}: {choices}")
        unlimited = f"the size of {name!r} is {size!r}: give a finite size below 1e100 in magnitude"
        raise_if(not abs(size) < 1e100, unlimited)


def raise_if(condition: Any, message: str) -> None:
    """Raise a ValueError with this message if the condition holds."""
    if condition:
        raise ValueError(message)


def validate_options(plan: object, **choices: Collection[str]) -> None:
    """Raise a ValueError if an attribute of a plan has a forbidden value; `choices`: attribute → allowed values."""
    for name, allowed in choices.items():
        option = f"{type(plan).__name__}({name}={getattr(plan, name)!r})"
        raise_if(getattr(plan, name) not in allowed, f"{option}: give one of {', '.join(allowed)}.")


class TimeGrid:
    """Time grid of a simulation, with the grid points that are averaged to each reading.

    Attributes:
        step: grid step, s.
        time: time of each grid point, s, (m,).
        samples: indices of the grid points averaged to each reading, (n, samples).
    """

    step: float
    time: Array
    samples: NDArray[np.intp]

    def average(self, values: Array) -> Array:
        """Average a quantity on the grid (m,) over the samples of each reading; return (n,) values."""
        return values[self.samples].mean(axis=1)

    def low_pass(self, drive: Array, time_constant: float, start: float | None = None) -> Array:
        """Return `drive` (m,) after a first-order low-pass; time constant in s; `start`: see `apply_low_pass`."""
        return apply_low_pass(drive, time_constant, self.step, start)


def apply_low_pass(
    drive: Array, time_constant: float, step: float, start: float | None = None
) -> Array:
    """Solve τ·dT/dt = drive − T on a uniform grid, exactly for a piecewise linear drive; return T, (m,).

    Args:
        drive: input of the low-pass, any unit, (m,).
        time_constant: τ, s.
        step: grid step, s.
        start: initial value of T; None: that of the drive.
    """
    from scipy.signal import lfilter  # half a second that only a simulation needs

    start = float(drive[0]) if start is None else start
    decay = np.exp(-step / time_constant)
    b0 = 1.0 - (1.0 - decay) * time_constant / step
    deviation = drive - start
    response, _ = lfilter([b0, 1.0 - decay - b0], [1.0, -decay], deviation, zi=[-b0 * deviation[0]])
    return start + response


def correlated_noise(
    generator: np.random.Generator, shape: int | tuple[int, int], time_constant: float, step: float
) -> Array:
    """Simulate stationary Ornstein–Uhlenbeck noise of unit variance along the last axis; return an array of `shape`.

    Args:
        generator: random-number generator.
        shape: number of time steps (m,), or (number of records, number of time steps).
        time_constant: correlation time, s.
        step: time step, s.
    """
    from scipy.signal import lfilter  # half a second that only a simulation needs

    decay = np.exp(-step / time_constant)
    increments = generator.standard_normal(shape)
    increments[..., 1:] *= np.sqrt(1.0 - decay**2)
    return np.asarray(lfilter([1.0], [1.0, -decay], increments))


def compute_ramped_set_point(
    time: Array, starts: Sequence[float], goals: Sequence[float], ramp: float
) -> Array:
    """Return the set point at `time`, °C; it moves at `ramp` °C/min to each of `goals`, °C, from its `starts`, s."""
    knots, set_points = [float(starts[0])], [float(goals[0])]
    rate_per_s = ramp / 60.0
    for start, end, set_point in zip(starts, [*starts[1:], float(time[-1])], goals, strict=True):
        max_change = rate_per_s * (end - start)
        change = float(np.clip(set_point - set_points[-1], -max_change, max_change))
        knots += [start, start + abs(change) / rate_per_s]
        set_points += [set_points[-1], set_points[-1] + change]
    return np.interp(time, knots, set_points)


SLIP_THRESHOLDS_DEGC = (0.3, 0.6, 1.0, 1.5)  # °C, thresholds of stick-slip joints; assumed
# Supply voltage: mean, standard deviation, and interval of independent values; assumed.
SUPPLY_V, SUPPLY_SD_V, SUPPLY_INTERVAL_S = 5.0, 0.1, 1200.0


def compute_stick_slip_strain(temperature: Array) -> Array:
    """Return the strain of stick-slip joints, −1 … 1, (m,): mean of several play operators (Prandtl–Ishlinskii)."""
    mean_strain = np.zeros(temperature.size)
    for threshold in SLIP_THRESHOLDS_DEGC:
        play_position, strain = float(temperature[0]), np.empty(temperature.size)
        for i, value in enumerate(temperature.tolist()):
            play_position = min(max(play_position, value - threshold), value + threshold)
            strain[i] = (value - play_position) / threshold
        mean_strain += strain / len(SLIP_THRESHOLDS_DEGC)
    return mean_strain


def simulate_supply(generator: np.random.Generator, time: Array) -> Array:
    """Return a simulated supply voltage, V, that varies slowly about 5 V, at these times, s, of any shape."""
    knots = np.arange(time.min(), time.max() + 2 * SUPPLY_INTERVAL_S, SUPPLY_INTERVAL_S)
    return np.interp(time, knots, SUPPLY_V + SUPPLY_SD_V * generator.standard_normal(knots.size))


SUPPLY_EFFECTS = {f"{s}.{e}" for s in ("bias", "zero") for e in ("supply", "temperature_x_supply")}


def needs_supply_column(effects: Collection[str]) -> bool:
    """Return whether any of these effects needs the column of the supply voltage."""
    return not SUPPLY_EFFECTS.isdisjoint(effects)


def list_experiments(
    simulator: Callable[..., dict[str, Any]], campaigns: Mapping[str, Any]
) -> tuple[tuple[str, Callable[[], dict[str, Any]]], ...]:
    """Return (description, function that simulates the columns with seed 0) for each feasible campaign.

    Args:
        simulator: function that simulates columns, with the arguments `seed` and `campaign`.
        campaigns: description → campaign.
    """
    return tuple((n, partial(simulator, seed=0, campaign=c)) for n, c in campaigns.items())


class SimulatedTest(NamedTuple):
    """Readings of a simulated test with the true values behind them.

    Attributes:
        columns: columns of the readings, by name.
        conditions: true conditions of the test.
        contributions: true contributions of each effect, by name; some simulators sum those of the baseline.
        noise_free: output without noise, in the instrument's unit, (n,).
    """

    columns: dict[str, NDArray[Any]]
    conditions: Any
    contributions: dict[str, Any]
    noise_free: Array


def column_simulator(simulator: Callable[P, SimulatedTest]) -> Callable[P, dict[str, NDArray[Any]]]:
    """Return a simulator of columns that calls a simulator of tests and discards the true values."""

    @wraps(simulator)
    def simulate_columns(*args: P.args, **options: P.kwargs) -> dict[str, NDArray[Any]]:
        return simulator(*args, **options).columns

    return simulate_columns


def make_readings_simulator(instrument: bc.Instrument) -> Callable[..., bc.Measurements]:
    """Return a simulator of `Measurements` that calls an instrument's simulator of columns."""
    assert instrument.simulator is not None

    @wraps(instrument.simulator)
    def simulate(*args: Any, **options: Any) -> bc.Measurements:
        return instrument.simulate(*args, **options)

    simulate.__name__ = simulate.__qualname__ = "simulate"
    simulate.__annotations__["return"] = bc.Measurements
    return simulate


class ReferenceProblem(NamedTuple):
    """Reference problem: the instrument's baseline model on readings of a small simulated campaign.

    Attributes:
        instrument: instrument of the problem.
        campaign: plan of its readings.
        effect_plan: plan of readings with hidden effects, or a function that returns it for given effects.
    """

    instrument: bc.Instrument
    campaign: Any
    effect_plan: Any

    def model(self) -> bc.Model:
        return self.instrument.baseline()

    def readings(self, seed: int = 0) -> bc.Measurements:
        return self.instrument.simulate(seed=seed, campaign=self.campaign)

    def simulate_effects(self, effects: Mapping[str, float], seed: int) -> bc.Measurements:
        plan = self.effect_plan(effects) if callable(self.effect_plan) else self.effect_plan
        return self.instrument.simulate(effects, seed=seed, campaign=plan)
