"""Two instruments whose laws are none of the catalogue's: effects in closed form, at sizes from tiny to large."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

import bayescal as bc
from bayescal_models import mems_gyro

SIZES = (0.05, 5.0)  # of the plausible one, log-uniform
OF_DEVICES = 10.0  # how much more devices differ in their zero than one from run to run
COUNTS = (0, 0, 1, 1, 2)  # hidden effects, one of these at random


@dataclass(frozen=True)
class World:
    """One campaign: readings, what was hidden, and the true expected output.

    Attributes:
        readings: to fit.
        truth: expected output of the readings without noise and without their runs' own offsets, output unit.
        later: hold-out readings: runs of their own.
        later_truth: of these.
        hidden: size over the plausible one, by name.
        baseline: true coefficients of the baseline, by name, reported units.
    """

    readings: bc.Measurements
    truth: np.ndarray
    later: bc.Measurements
    later_truth: np.ndarray
    hidden: dict[str, float]
    baseline: dict[str, float]


def gyro(seed: int, hidden: Mapping[str, float] | None = None, *, other: bool = False) -> World:
    """A gyro at rest through temperature sweeps: 0.05 °/s of noise, a reading a minute.

    Args:
        seed: of everything.
        hidden: sizes over the plausible ones; at random if not given.
        other: the hold-out data are of another device of the same make.
    """
    rng = np.random.default_rng([35, seed])
    hidden = _drawn(rng, _GYRO) if hidden is None else dict(hidden)
    zero, slope = rng.normal(20.0, 5.0), rng.normal(0.05, 0.02)

    def made(
        runs: int, first: int, zero: float, slope: float
    ) -> tuple[bc.Measurements, np.ndarray]:
        run, time, since, temperature = _sweeps(rng, runs)
        board = temperature + 4.0 - 3.0 / (1 + since / 500.0)
        at = Sweep(temperature - 55.0, since, time, run)
        truth = zero + slope * at.warmth
        for name, size in hidden.items():
            if name != "bias.run":
                truth = truth + size * _GYRO[name](at)
        own = 0.1 * hidden.get("bias.run", 0.0) * _uniform(rng, runs)[run]
        output = truth + own + rng.normal(0.0, 0.05, truth.size)
        readings = bc.Measurements.from_arrays(
            mems_gyro.INSTRUMENT,
            run=np.array([f"{first + r}" for r in run]),
            time=time + 1e5 * first,
            temperature=temperature,
            board_temperature=board,
            output=output,
        )
        return readings, truth

    readings, truth = made(6, 1, zero, slope)
    if other:
        zero = zero + rng.normal(0.0, OF_DEVICES * 0.1)
        slope = slope + rng.normal(0.0, 0.02)
    later, later_truth = made(2, 11, zero, slope)
    middle = float(np.mean(readings["temperature"]))
    known = {"bias.constant": zero + slope * (middle - 55.0), "bias.temperature": slope}
    return World(readings, truth, later, later_truth, hidden, known)


@dataclass(frozen=True)
class Sweep:
    """What an effect may depend on: °C from 55 °C, s since a run began, s since the record began, and the run."""

    warmth: np.ndarray
    since: np.ndarray
    time: np.ndarray
    run: np.ndarray


def _sweeps(rng: np.random.Generator, runs: int) -> tuple[np.ndarray, ...]:
    """Sweeps between 30 °C and 80 °C, each run at its own pace: run, time, time since its begin, temperature."""
    step, count = 60.0, 40
    since = np.tile(step * np.arange(count), runs)
    run = np.repeat(np.arange(runs), count)
    period = rng.uniform(1200.0, 3600.0, runs)[run]
    phase = rng.uniform(0.0, 2 * np.pi, runs)[run]
    temperature = 55.0 + 25.0 * np.sin(2 * np.pi * since / period + phase)
    return run, since + 1e4 * run, since, temperature


def _behind(at: Sweep, tau: float) -> np.ndarray:
    """°C by which a body of two equal stages is behind the thermometer; in balance when a run begins."""
    found = np.zeros_like(at.warmth)
    for run in np.unique(at.run):
        rows = np.flatnonzero(at.run == run)
        fine = np.arange(0.0, at.since[rows][-1] + 1.0, 2.0)
        air = np.interp(fine, at.since[rows], at.warmth[rows])
        first = second = air[0]
        inner = np.empty_like(air)
        for i, outer in enumerate(air):
            first += (outer - first) * 2.0 / (0.5 * tau)
            second += (first - second) * 2.0 / (0.5 * tau)
            inner[i] = second
        found[rows] = np.interp(at.since[rows], fine, inner) - at.warmth[rows]
    return found


_GYRO: Mapping[str, Callable[[Sweep], np.ndarray]] = {
    # 2·(cosh u − 1)/0.02² per °C² is u² to leading order and 4 % more at the ends.
    "bias.temperature_quadratic": lambda at: 3e-4 * 2 * (np.cosh(0.02 * at.warmth) - 1) / 4e-4,
    "bias.temperature_cubic": lambda at: (
        1e-5 * 6 * (np.sinh(0.02 * at.warmth) / 0.02 - at.warmth) / 4e-4
    ),
    "bias.thermal_lag": lambda at: 0.05 * _behind(at, 300.0),
    "bias.warm_up": lambda at: 0.3 / (1 + at.since / 400.0) ** 2,
    "bias.drift": lambda at: 0.3 * np.log1p(2 * at.time / at.time.max()) / np.log(3.0),
    "bias.run": lambda at: np.zeros_like(at.warmth),
}


def _uniform(rng: np.random.Generator, count: int) -> np.ndarray:
    """Offsets of unit standard deviation that are not normal."""
    return rng.uniform(-np.sqrt(3.0), np.sqrt(3.0), count)


def _drawn(rng: np.random.Generator, laws: Mapping[str, object]) -> dict[str, float]:
    """What is hidden, at sizes log-uniform over two decades."""
    names = rng.choice(sorted(laws), size=rng.choice(COUNTS), replace=False)
    low, high = np.log(SIZES)
    return {str(n): float(np.exp(rng.uniform(low, high)) * rng.choice((-1, 1))) for n in names}


def one_profile(seed: int) -> bc.Measurements:
    """Three runs of one profile: offsets of the runs, a body that lags, a warm-up, a weak quadratic.

    All that is thermal is a function of the time within a run there.
    """
    rng = np.random.default_rng([37, seed])
    step, count, runs = 20.0, 200, 3
    since, run = np.tile(step * np.arange(count), runs), np.repeat(np.arange(runs), count)
    temperature = 55.0 - 25.0 * np.cos(2 * np.pi * since / 2400.0)
    at = Sweep(temperature - 55.0, since, since + 1e4 * run, run)
    output = (
        rng.normal(20.0, 5.0)
        + 0.05 * at.warmth
        + 0.1 * _uniform(rng, runs)[run]
        + 0.05 * _behind(at, 240.0)
        + 0.3 * np.exp(-since / 600.0)
        + 1.3e-4 * at.warmth**2
        + rng.normal(0.0, 0.05, since.size)
    )
    return bc.Measurements.from_arrays(
        mems_gyro.INSTRUMENT,
        run=np.array([f"{r + 1}" for r in run]),
        time=at.time,
        temperature=temperature,
        output=output,
    )
