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


def generators(names: Sequence[str], seed: int) -> dict[str, np.random.Generator]:
    """Return one independent random-number generator per purpose, all spawned from one seed."""
    seeds = np.random.SeedSequence(seed).spawn(len(names))
    return {name: np.random.default_rng(s) for name, s in zip(names, seeds, strict=True)}


def refuse_effects(effects: Mapping[str, float], names: Collection[str], where: str) -> None:
    """Raise ValueError for effects that the simulator does not have.

    Args:
        effects: name → size.
        names: names of the available effects.
        where: description of the simulation, such as "a gyro campaign".

    Raises:
        ValueError: an unknown name, or a size that is not finite, or so large that outputs may overflow.
    """
    for name, size in effects.items():
        choices = f"choose among {', '.join(names)}"
        refuse(name not in names, f"no effect {name!r} can be hidden in {where}: {choices}")
        refuse(not abs(size) < 1e100, f"the size of {name!r} is {size!r}: give one below 1e100")


def refuse(wrong: Any, message: str) -> None:
    """Raise a ValueError with this message if `wrong` is true."""
    if wrong:
        raise ValueError(message)


def refuse_unknown(plan: object, **choices: Collection[str]) -> None:
    """Raise a ValueError if an option of a plan is not one of its `choices`, given by the option's name."""
    for name, allowed in choices.items():
        option = f"{type(plan).__name__}({name}={getattr(plan, name)!r})"
        refuse(getattr(plan, name) not in allowed, f"{option}: give one of {', '.join(allowed)}.")


class Clock:
    """Time grid of a simulation, and the grid points averaged in each reading.

    Attributes:
        step: step of the grid, s.
        time: times of its points, s, (m,).
        samples: indices of the points averaged in each reading, (n, samples).
    """

    step: float
    time: Array
    samples: NDArray[np.intp]

    def average(self, values: Array) -> Array:
        """Average a quantity over the samples of each reading, (n,), in its unit."""
        return values[self.samples].mean(axis=1)

    def body(self, drive: Array, time_constant: float, start: float | None = None) -> Array:
        """Return the response of a first-order body to `drive`, of time constant `time_constant`, s."""
        return first_order_body(drive, time_constant, self.step, start)


def first_order_body(
    drive: Array, time_constant: float, step: float, start: float | None = None
) -> Array:
    """Return the response of a first-order body, τ·dT/dt = drive − T, exact for a piecewise linear drive.

    Args:
        drive: input, any unit.
        time_constant: τ, s.
        step: step of the grid, s.
        start: initial value; None for that of the drive.
    """
    from scipy.signal import lfilter  # half a second that only a simulation needs

    start = float(drive[0]) if start is None else start
    decay = np.exp(-step / time_constant)
    now = 1.0 - (1.0 - decay) * time_constant / step
    push = drive - start
    response, _ = lfilter([now, 1.0 - decay - now], [1.0, -decay], push, zi=[-now * push[0]])
    return start + response


def correlated(
    generator: np.random.Generator, shape: int | tuple[int, int], time_constant: float, step: float
) -> Array:
    """Simulate stationary Ornstein–Uhlenbeck records of unit variance along the last axis.

    Args:
        generator: random-number generator.
        shape: shape of the records.
        time_constant: correlation time, s.
        step: time step, s.
    """
    from scipy.signal import lfilter  # half a second that only a simulation needs

    decay = np.exp(-step / time_constant)
    kicks = generator.standard_normal(shape)
    kicks[..., 1:] *= np.sqrt(1.0 - decay**2)
    return np.asarray(lfilter([1.0], [1.0, -decay], kicks))


def ramp_limited(
    time: Array, starts: Sequence[float], goals: Sequence[float], ramp: float
) -> Array:
    """Return a ramp-limited set point, °C: goals set at their starts, s, with a ramp in °C/min."""
    knots, values = [float(starts[0])], [float(goals[0])]
    per_second = ramp / 60.0
    for start, end, goal in zip(starts, [*starts[1:], float(time[-1])], goals, strict=True):
        reach = per_second * (end - start)
        move = float(np.clip(goal - values[-1], -reach, reach))
        knots += [start, start + abs(move) / per_second]
        values += [values[-1], values[-1] + move]
    return np.interp(time, knots, values)


SLIPS = (0.3, 0.6, 1.0, 1.5)  # °C, thresholds of joints that stick and slip; ours
SUPPLY, SUPPLY_WANDER, SUPPLY_TIME = 5.0, 0.1, 1200.0  # V, V and s, of a supply that wanders; ours


def sticking(temperature: Array) -> Array:
    """Return the strain of joints that stick and slip: play operators of several widths (Prandtl, Ishlinskii)."""
    total = np.zeros(temperature.size)
    for width in SLIPS:
        seat, strain = float(temperature[0]), np.empty(temperature.size)
        for i, value in enumerate(temperature.tolist()):
            seat = min(max(seat, value - width), value + width)
            strain[i] = (value - seat) / width
        total += strain / len(SLIPS)
    return total


def wandering_supply(generator: np.random.Generator, time: Array) -> Array:
    """Simulate a supply voltage, V, that varies slowly about 5 V, at these times, s."""
    knots = np.arange(time.min(), time.max() + 2 * SUPPLY_TIME, SUPPLY_TIME)
    return np.interp(time, knots, SUPPLY + SUPPLY_WANDER * generator.standard_normal(knots.size))


OF_SUPPLY = {f"{s}.{e}" for s in ("bias", "zero") for e in ("supply", "temperature_x_supply")}


def supplied(effects: Collection[str]) -> bool:
    """Return whether one of these effects needs the supply's voltage recorded."""
    return not OF_SUPPLY.isdisjoint(effects)


def experiments(
    columns: Callable[..., dict[str, Any]], campaigns: Mapping[str, Any]
) -> tuple[tuple[str, Callable[[], dict[str, Any]]], ...]:
    """List feasible campaigns, by description, with the columns that each would record.

    Args:
        columns: function that simulates the columns of a campaign.
        campaigns: campaigns by description.
    """
    return tuple((n, partial(columns, seed=0, campaign=c)) for n, c in campaigns.items())


class Simulated(NamedTuple):
    """Readings of a simulated test, and their true values.

    Attributes:
        columns: columns of the readings, by name.
        world: true conditions of the test.
        contributions: contributions of the baseline and of each effect, by name.
        noise_free: the output without noise and rounding, (n,).
    """

    columns: dict[str, NDArray[Any]]
    world: Any
    contributions: dict[str, Any]
    noise_free: Array


def columns_of(simulator: Callable[P, Simulated]) -> Callable[P, dict[str, NDArray[Any]]]:
    """Wrap a simulator to return its columns only."""

    @wraps(simulator)
    def simulated_columns(*args: P.args, **options: P.kwargs) -> dict[str, NDArray[Any]]:
        return simulator(*args, **options).columns

    return simulated_columns


def readings_of(instrument: bc.Instrument) -> Callable[..., bc.Measurements]:
    """Wrap an instrument's simulator to return readings."""
    assert instrument.simulator is not None

    @wraps(instrument.simulator)
    def simulate(*args: Any, **options: Any) -> bc.Measurements:
        return instrument.simulate(*args, **options)

    simulate.__name__ = simulate.__qualname__ = "simulate"
    simulate.__annotations__["return"] = bc.Measurements
    return simulate


class ReferenceProblem(NamedTuple):
    """A reference problem that is the baseline, its priors as they stand; `bayescal_models` says what it is for.

    Attributes:
        instrument: instrument of the problem.
        campaign: plan of its readings, without hidden effects.
        fuller: plan with hidden effects: a campaign, or a function of the effects.
    """

    instrument: bc.Instrument
    campaign: Any
    fuller: Any

    def model(self) -> bc.Model:
        return self.instrument.baseline()

    def readings(self, seed: int = 0) -> bc.Measurements:
        return self.instrument.simulate(seed=seed, campaign=self.campaign)

    def hidden(self, effects: Mapping[str, float], seed: int) -> bc.Measurements:
        plan = self.fuller(effects) if callable(self.fuller) else self.fuller
        return self.instrument.simulate(effects, seed=seed, campaign=plan)
