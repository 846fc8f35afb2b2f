"""Simulated records of a sensor at rest on temperature ramps, with effects hidden in them.

The world is made second by second and logged every ten: a chamber whose air follows its ramps with
a lag, and laws of the true temperature and its true rate (the catalogue's rate is an estimate from
the last minute).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

import bayescal as bc

NOISE_LAWS = ("white", "ornstein_uhlenbeck")
BASELINE = {"bias.constant": 2000.0, "bias.temperature": 40.0}
NOISE = 20.0  # standard deviation of white noise, and of the wander beside it, output unit
RAMPS = ((0.0, 25.0), (10.0, -15.0), (25.0, 65.0), (40.0, 25.0))  # min, °C: cooled, heated, cooled
PAUSE = 3600.0  # s between runs
CHAMBER_TIME, LAG_TIME, WARM_UP_TIME, WANDER_TIME = 60.0, 300.0, 600.0, 300.0  # s
REVERSAL_TIME = 30.0  # s, in which hysteresis follows a change of direction


@dataclass(frozen=True)
class _World:
    """The true temperature second by second: each a matrix (runs, seconds).

    Attributes:
        time: within the run, s.
        departure: T − T0, °C, T0 the mean of all rounded to 1 °C.
        rate: dT/dt, °C/min.
        direction: sign of the rate, which takes its time to turn.
        behind: T̃ − T of a body of first order, °C.
        turn_on: one standard normal number for each run.
        progress: (t − t̄)/(tmax − tmin) over all runs.
    """

    time: np.ndarray
    departure: np.ndarray
    rate: np.ndarray
    direction: np.ndarray
    behind: np.ndarray
    turn_on: np.ndarray
    progress: np.ndarray


_LAWS: dict[str, Callable[[_World], np.ndarray]] = {
    "bias.constant": lambda w: np.ones_like(w.time),
    "bias.temperature": lambda w: w.departure,
    "bias.temperature_quadratic": lambda w: w.departure**2,
    "bias.temperature_cubic": lambda w: w.departure**3,
    "bias.rate": lambda w: w.rate,
    "bias.thermal_lag": lambda w: w.behind,
    "bias.hysteresis": lambda w: w.direction,
    "bias.warm_up": lambda w: np.exp(-w.time / WARM_UP_TIME),
    "bias.drift": lambda w: w.progress,
    "bias.run": lambda w: w.turn_on + np.zeros_like(w.time),
}


def simulate(
    effects: Mapping[str, float] | None = None,
    *,
    seed: int,
    unit: str = "ug",
    runs: int = 3,
    interval: int = 10,
    noise_law: str = "white",
) -> bc.Measurements:
    """Readings of ramps, 25 → −15 → 65 → 25 °C in 40 minutes, with these effects hidden in them.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficient. The line is
            there (2000 and 40 per °C) unless given otherwise.
        seed: seed of every random number.
        unit: of the output; sizes and noise (20) are in it.
        runs: how many times the ramps are gone through, an hour apart.
        interval: between readings, s.
        noise_law: "white" or "ornstein_uhlenbeck" (correlation time 300 s, beside white noise).

    Raises:
        ValueError: an unknown effect or noise law, no run, or no interval.
    """
    from bayescal_models.still_sensor.model import instrument  # the instrument holds this function

    sizes = {**BASELINE, **(effects or {})}
    if unknown := sorted(set(sizes) - set(_LAWS)):
        raise ValueError(f"no law for {', '.join(unknown)}: choose among {', '.join(_LAWS)}")
    if noise_law not in NOISE_LAWS:
        raise ValueError(f"noise law {noise_law!r} is not one of {', '.join(NOISE_LAWS)}")
    if runs < 1 or interval < 1:
        raise ValueError(f"runs={runs} and interval={interval} s must be at least 1")
    rng = np.random.default_rng(seed)
    temperature, world = _world(runs, rng.standard_normal(runs))
    true = sum(size * _LAWS[name](world) for name, size in sizes.items())
    scatter = NOISE * rng.standard_normal(true.shape)
    if noise_law == "ornstein_uhlenbeck":
        scatter += NOISE * _wander(rng, true.shape)
    logged = slice(0, None, interval)
    start = np.arange(runs)[:, None] * (world.time[0, -1] + PAUSE)
    labels = np.repeat(np.arange(1, runs + 1), world.time[0, logged].size).astype(str)
    return bc.Measurements.from_arrays(
        instrument(unit),
        run=labels,
        time=(start + world.time)[:, logged].ravel(),
        temperature=temperature[:, logged].ravel(),
        output=(true + scatter)[:, logged].ravel(),
    )


def _world(runs: int, turn_on: np.ndarray) -> tuple[np.ndarray, _World]:
    minutes, goals = np.array(RAMPS).T
    second = np.arange(60.0 * minutes[-1] + 1)
    one = _body(np.interp(second, 60 * minutes, goals), CHAMBER_TIME)
    temperature, time = np.tile(one, (runs, 1)), np.tile(second, (runs, 1))
    elapsed = time + np.arange(runs)[:, None] * (second[-1] + PAUSE)
    rate = 60 * np.gradient(one)
    world = _World(
        time=time,
        departure=temperature - round(float(one.mean())),
        rate=np.tile(rate, (runs, 1)),
        direction=np.tile(_body(np.sign(rate), REVERSAL_TIME), (runs, 1)),
        behind=np.tile(_body(one, LAG_TIME) - one, (runs, 1)),
        turn_on=turn_on[:, None],
        progress=(elapsed - elapsed.mean()) / np.ptp(elapsed),
    )
    return temperature, world


def _body(drive: np.ndarray, time_constant: float) -> np.ndarray:
    """A body that follows `drive` from equilibrium: τ·dT/dt = drive − T, exact on lines."""
    decay = np.exp(-1 / time_constant)
    now = 1 - (1 - decay) * time_constant
    push = [now, 1 - decay - now]
    return drive[0] + lfilter(push, [1, -decay], drive - drive[0])


def _wander(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Ornstein–Uhlenbeck records of unit variance, one a row."""
    decay = np.exp(-1 / WANDER_TIME)
    kicks = rng.standard_normal(shape)
    kicks[:, 1:] *= np.sqrt(1 - decay**2)
    return lfilter([1.0], [1.0, -decay], kicks, axis=1)
