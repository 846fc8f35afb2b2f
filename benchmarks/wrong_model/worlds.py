"""Three simulated instruments whose laws are not in the catalogue: effects in closed form, from tiny to large sizes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

import bayescal as bc
import bayescal_models.inclinometer
from bayescal_models import mems_gyro, quartz_beam_accelerometer

SIZES = (0.05, 5.0)  # of the plausible one, log-uniform
RUN_PERIOD = 1e4  # s between the beginnings of runs
SPAN = 5 * RUN_PERIOD + 2400.0  # s of the runs that are fitted
LATER, OTHER = 11, 21  # label of the first hold-out run, and of the first of another profile
NO_FORMULA = 1000  # from this seed on what is hidden is like nothing in the catalogue
COUNTS = (0, 0, 1, 1, 2)  # hidden effects, one of these at random


Course = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class World:
    """One campaign: readings, hidden effects, and the true expected output.

    Attributes:
        readings: readings to fit.
        truth: expected output of the readings without noise, with their runs' offsets, output unit.
        later: hold-out readings, of other runs.
        later_truth: expected output of the hold-out readings.
        other, other_truth: hold-out readings of another temperature profile with a wider range, and their truth; an
            inclinometer has none.
        hidden: size over the plausible one, by name.
        static: by slot, given T0, °C, its steady-state values about the centre of the baseline's coefficients, at the
            middle of the record, reported units: a function of °C from T0, or for an inclinometer of degrees from 0.
    """

    readings: bc.Measurements
    truth: np.ndarray
    later: bc.Measurements
    later_truth: np.ndarray
    hidden: dict[str, float]
    static: dict[str, Callable[[float], Course]]
    other: bc.Measurements | None = None
    other_truth: np.ndarray | None = None

    def about(self, slot: str, reference: float, count: int) -> np.ndarray:
        """Return the first terms of a slot's power series about `reference`, °C: a baseline's true coefficients."""
        step = 5.0 * np.linspace(-1.0, 1.0, 13)
        fitted = np.polynomial.polynomial.polyfit(step, self.static[slot](reference)(step), 6)
        return fitted[:count]


def gyro(seed: int, hidden: Mapping[str, float] | None = None, without: str = "") -> World:
    """Simulate a gyro at rest through temperature sweeps: 0.05 °/s of noise, a reading per minute.

    Args:
        seed: seed of all random numbers.
        hidden: sizes over the plausible ones; if not given, drawn at random, except for `without`.
    """
    rng, laws = np.random.default_rng([35, seed]), _GYRO if seed < NO_FORMULA else _ODD_GYRO
    hidden = _drawn(rng, laws, without) if hidden is None else dict(hidden)
    zero, slope = rng.normal(20.0, 5.0), rng.normal(0.05, 0.02)

    def simulate(runs: int, first: int) -> tuple[bc.Measurements, np.ndarray]:
        run, time, since, temperature = _sweeps(rng, runs, first)
        board = temperature + 4.0 - 3.0 / (1 + since / 500.0)
        at = Sweep(temperature - 55.0, since, time, run)
        truth = zero + slope * at.warmth
        for name, size in hidden.items():
            if name != "bias.run":
                truth = truth + size * laws[name](at)
        truth = truth + 0.1 * hidden.get("bias.run", 0.0) * _uniform(rng, runs)[run]
        output = truth + rng.normal(0.0, 0.05, truth.size)
        readings = bc.Measurements.from_arrays(
            mems_gyro.INSTRUMENT,
            run=np.array([f"{first + r}" for r in run]),
            time=time,
            temperature=temperature,
            board_temperature=board,
            output=output,
        )
        return readings, truth

    readings, truth = simulate(6, 1)
    later, later_truth = simulate(2, LATER)

    static = {"bias": _static(laws, hidden, "bias", (zero, slope), readings)}
    return World(readings, truth, later, later_truth, hidden, static, *simulate(2, OTHER))


def quartz(seed: int, hidden: Mapping[str, float] | None = None, without: str = "") -> World:
    """Simulate a quartz accelerometer with two thermometers: ramps at three attitudes, 5 µg noise, a reading a minute.

    Args: as in `gyro`.
    """
    rng, laws = np.random.default_rng([38, seed]), _QUARTZ if seed < NO_FORMULA else _ODD_QUARTZ
    hidden = _drawn(rng, laws, without) if hidden is None else dict(hidden)
    curves = {"bias": _cubic(rng, 3000.0, 50.0), "scale": _cubic(rng, 800.0, 5.0)}

    def simulate(runs: int, first: int) -> tuple[bc.Measurements, np.ndarray]:
        run, time, since, head = _sweeps(rng, runs, first)
        at = Sweep(head - 55.0, since, time, run)
        circuit = head + 4.0 * -np.expm1(-since / 600.0) - 0.2 * _behind(at, 400.0)
        at = Sweep(at.warmth, since, time, run, circuit - head)
        attitude = np.array([1.0, 0.0, -1.0])[(run + first) % 3]
        bias, scale = (
            np.polynomial.polynomial.polyval(at.warmth, curves[s]) for s in ("bias", "scale")
        )
        square = 0.0
        for name, size in hidden.items():
            change = size * laws[name](at)
            if name.startswith("bias"):
                bias = bias + change
            elif name.startswith("scale"):
                scale = scale + change
            else:
                square = square + change
        bias = bias + 20.0 * hidden.get("bias.run", 0.0) * _uniform(rng, runs)[run]
        truth = bias + (1e6 + scale) * attitude + square * attitude**2
        readings = bc.Measurements.from_arrays(
            quartz_beam_accelerometer.INSTRUMENT,
            run=np.array([f"{first + r}" for r in run]),
            time=time,
            temperature_head=head,
            temperature_circuit=circuit,
            acceleration=1e6 * attitude,
            output=truth + rng.normal(0.0, 5.0, truth.size),
        )
        return readings, truth

    readings, truth = simulate(6, 1)
    later, later_truth = simulate(3, LATER)

    static = {slot: _static(laws, hidden, slot, curves[slot], readings) for slot in curves}
    return World(readings, truth, later, later_truth, hidden, static, *simulate(3, OTHER))


def inclinometer(seed: int, hidden: Mapping[str, float] | None = None, without: str = "") -> World:
    """Simulate a two-axis inclinometer on a dividing table: ±45° by 3°, both ways, three mountings per axis, 2″ noise.

    Args: as in `gyro`.
    """
    rng, laws = (
        np.random.default_rng([40, seed]),
        _INCLINOMETER if seed < NO_FORMULA else _ODD_TABLE,
    )
    hidden = _drawn(rng, laws, without) if hidden is None else dict(hidden)
    axis_constants = {axis: rng.normal(0.0, (100.0, 1.0)) for axis in "xy"}
    share = {axis: rng.uniform(0.5, 1.0) * rng.choice((-1.0, 1.0)) for axis in "xy"}
    angles = np.arange(-45.0, 46.0, 3.0)
    degrees = np.concatenate([angles, angles[::-1]])
    turned = np.concatenate([np.full(angles.size, np.inf), angles - angles[0]])
    forward = np.repeat([1.0, -1.0], angles.size)
    swing, phase = rng.uniform(1.0, 6.0), rng.uniform(0.0, 2 * np.pi)

    def simulate(mountings: int, first: int) -> tuple[bc.Measurements, np.ndarray]:
        parts, clock = [], 0.0 if first == 1 else 0.5 * RUN_PERIOD
        offsets = 2.0 * _uniform(rng, 2 * mountings)
        for i, offset in enumerate(offsets):
            axis, time = "xy"[i % 2], clock + 60.0 * np.arange(degrees.size)
            warmth = swing * np.sin(2 * np.pi * time / 14_000.0 + phase)
            at = Table(degrees, warmth, time, forward, turned)
            value = offset + axis_constants[axis][0] + axis_constants[axis][1] * degrees
            for name, size in hidden.items():
                value = value + share[axis] * size * laws[name](at)
            label = f"{axis}{first + i // 2}"
            parts.append((np.full(degrees.size, axis), np.full(degrees.size, label), at, value))
            clock += RUN_PERIOD
        axes, labels, tables, values = zip(*parts, strict=True)
        truth = np.concatenate(values)
        columns = {
            name: np.concatenate([getattr(at, name) for at in tables])
            for name in ("degrees", "warmth", "time", "forward")
        }
        readings = bc.Measurements.from_arrays(
            bayescal_models.inclinometer.INSTRUMENT,
            axis=np.concatenate(axes),
            run=np.concatenate(labels),
            placement_angle=np.deg2rad(columns["degrees"]),
            temperature=20.0 + columns["warmth"],
            time=columns["time"],
            direction=np.where(columns["forward"] > 0, "forward", "backward"),
            output=truth + rng.normal(0.0, 2.0, truth.size),
        )
        return readings, truth

    readings, truth = simulate(3, 1)
    later, later_truth = simulate(2, LATER)

    def of_axis(axis: str) -> Callable[[float], Course]:
        none, time = np.zeros(1), readings["time"][readings["axis"] == axis]

        def at(reference: float, step: np.ndarray) -> np.ndarray:
            value = axis_constants[axis][0] + axis_constants[axis][1] * step
            for name, size in hidden.items():
                if not name.endswith("hysteresis"):
                    t = time if name.startswith("base_tilt") else none
                    warm = np.full(1, reference - 20.0)
                    terms = [
                        np.mean(laws[name](Table(np.full(1, w), warm, t, none, none))) for w in step
                    ]
                    value = value + share[axis] * size * np.array(terms)
            return value

        return lambda reference: lambda step: at(reference, step)

    static = {f"zero({axis})": of_axis(axis) for axis in "xy"}
    return World(readings, truth, later, later_truth, hidden, static)


@dataclass(frozen=True)
class Table:
    """Columns that an effect of an inclinometer may depend on: placement angle, °; °C from 20 °C; time, s; direction,
    +1 forward and −1 backward; angle since the direction changed, °.
    """

    degrees: np.ndarray
    warmth: np.ndarray
    time: np.ndarray
    forward: np.ndarray
    turned: np.ndarray


def _static(
    laws: Mapping[str, Callable[[Sweep], np.ndarray]],
    hidden: Mapping[str, float],
    slot: str,
    parameters: tuple[float, ...],
    readings: bc.Measurements,
) -> Callable[[float], Course]:
    """Return a slot as a function of °C from T0, long after power-on, with a drift at its mean over the readings."""
    zero, time = np.zeros(1), readings["time"]

    def output_at(temperature: np.ndarray) -> np.ndarray:
        value = np.polynomial.polynomial.polyval(temperature - 55.0, parameters)
        for name, size in hidden.items():
            if name.startswith(f"{slot}.temperature"):
                value = value + size * laws[name](Sweep(temperature - 55.0, zero, zero, zero))
            elif name == f"{slot}.drift":
                value = value + size * np.mean(laws[name](Sweep(0 * time, time, time, time)))
        return value

    return lambda reference: lambda step: output_at(reference + step)


def _cubic(rng: np.random.Generator, constant: float, slope: float) -> tuple[float, ...]:
    """Draw a cubic polynomial with plausible coefficients."""
    sizes = constant, slope, 0.01 * slope, 1e-4 * slope
    return tuple(float(v) for v in rng.normal(0.0, sizes))


@dataclass(frozen=True)
class Sweep:
    """Columns that an effect may depend on: °C from 55 °C, time since the start of the run and of the record, s, run,
    and temperature of the circuit minus that of the head, °C.
    """

    warmth: np.ndarray
    since: np.ndarray
    time: np.ndarray
    run: np.ndarray
    gradient: np.ndarray | float = 0.0


def _sweeps(rng: np.random.Generator, runs: int, first: int) -> tuple[np.ndarray, ...]:
    """Return run, time, time since the run's start, and temperature of sweeps between 30 and 80 °C at random rates.

    Runs begin every `RUN_PERIOD` seconds; hold-out runs are between the fitted ones.
    """
    step, count = 60.0, 40
    since = np.tile(step * np.arange(count), runs)
    run = np.repeat(np.arange(runs), count)
    period = rng.uniform(1200.0, 3600.0, runs)[run]
    phase = rng.uniform(0.0, 2 * np.pi, runs)[run]
    temperature = 55.0 + 25.0 * np.sin(2 * np.pi * since / period + phase)
    if first == OTHER:  # held, and on its way at twice the pace, beyond the range by a fifth of it
        course = np.interp(since, [0, 300, 900, 1200, 1800, 2400], [0, 0, 35, 30, -30, -35])
        temperature = 55.0 + np.where(run % 2, -1, 1) * course
    start = RUN_PERIOD * (run if first == 1 else run + 1.5)
    return run, since + start, since, temperature


def _behind(at: Sweep, tau: float) -> np.ndarray:
    """Return °C by which two equal bodies in series are behind the thermometer, in equilibrium at a run's start."""
    lag = np.zeros_like(at.warmth)
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
        lag[rows] = np.interp(at.since[rows], fine, inner) - at.warmth[rows]
    return lag


def _two_decays(since: np.ndarray, time: float) -> np.ndarray:
    """Return the warm-up of a part and its case: two thirds with one time constant, a third with twice that."""
    return (2 * np.exp(-since / time) + np.exp(-since / (2 * time))) / 3


_GYRO: Mapping[str, Callable[[Sweep], np.ndarray]] = {
    # 2·(cosh u − 1)/0.02² per °C² is u² to leading order and 4 % more at the ends.
    "bias.temperature_quadratic": lambda at: 3e-4 * 2 * (np.cosh(0.02 * at.warmth) - 1) / 4e-4,
    "bias.temperature_cubic": lambda at: (
        1e-5 * 6 * (np.sinh(0.02 * at.warmth) / 0.02 - at.warmth) / 4e-4
    ),
    "bias.thermal_lag": lambda at: 0.05 * _behind(at, 300.0),
    "bias.warm_up": lambda at: 0.3 * _two_decays(at.since, 300.0),
    "bias.drift": lambda at: 0.3 * np.log1p(2 * at.time / SPAN) / np.log(3.0),
    "bias.run": lambda at: np.zeros_like(at.warmth),
}

_QUARTZ: Mapping[str, Callable[[Sweep], np.ndarray]] = {
    "bias.gradient": lambda at: 20.0 * 40.0 * np.tanh(at.gradient / 40.0),
    "bias.thermal_lag": lambda at: 20.0 * _behind(at, 600.0),
    "bias.warm_up": lambda at: 50.0 * _two_decays(at.since, 300.0),
    "bias.drift": lambda at: 10.0 * np.log1p(2 * at.time / SPAN) / np.log(3.0),
    "bias.run": lambda at: np.zeros_like(at.warmth),
    "scale.gradient": lambda at: 2.0 * 40.0 * np.tanh(at.gradient / 40.0),
    "scale.thermal_lag": lambda at: 2.0 * _behind(at, 600.0),
    "second_order": lambda at: np.full_like(at.warmth, 10.0),
}

_INCLINOMETER: Mapping[str, Callable[[Table], np.ndarray]] = {
    "zero.placement_quadratic": lambda at: 0.005 * 2 * (np.cosh(0.02 * at.degrees) - 1) / 4e-4,
    "zero.temperature": lambda at: 2.0 * 8.0 * np.tanh(at.warmth / 8.0),
    "zero.hysteresis": lambda at: 2.0 * at.forward * (1 - 2 * np.exp(-at.turned / 3.0)),
    "base_tilt.drift": lambda at: 2.0 * np.log1p(2 * at.time / SPAN) / np.log(3.0),
}


def _play(at: Sweep) -> np.ndarray:
    """Return °C by which a part with 3 °C of play is behind the thermometer."""
    play, last = np.zeros_like(at.warmth), 0.0
    for i, (now, since) in enumerate(zip(at.warmth, at.since, strict=True)):
        last = now if since == 0 else min(max(last, now - 3.0), now + 3.0)
        play[i] = last - now
    return play


def _rate(at: Sweep) -> np.ndarray:
    """Return the temperature rate, °C/min."""
    same = np.diff(at.run, prepend=-1) == 0
    return np.where(
        same, 60 * np.diff(at.warmth, prepend=0.0) / np.diff(at.time, prepend=-1.0), 0.0
    )


# Of none of these has the catalogue a formula, to first order neither.
_ODD: Mapping[str, Callable[[Sweep], np.ndarray]] = {
    "bias.temperature_resonance": lambda at: 1 / (1 + ((at.warmth - 8.0) / 4.0) ** 2),
    "bias.temperature_ripple": lambda at: 0.5 * np.sin(at.warmth / 4.0),
    "bias.temperature_saw": lambda at: np.mod(at.warmth / 20.0, 1.0) - 0.5,
    "bias.temperature_kink": lambda at: 0.12 * np.logaddexp(0, (at.warmth + 5) / 1.5),
    "bias.play": lambda at: _play(at) / 3.0,
    "bias.memory": lambda at: 0.03 * sum(_behind(at, tau) for tau in (60.0, 400.0, 2500.0)),
    "bias.creep": lambda at: np.log1p(at.since / 40.0) / 4,
    "bias.rate_squared": lambda at: _rate(at) ** 2 / 10,
    "bias.stretched": lambda at: np.exp(-np.sqrt(at.since / 400.0)),
}


def _scaled(size: float, law: Callable[[Sweep], np.ndarray]) -> Callable[[Sweep], np.ndarray]:
    return lambda at: size * law(at)


_ODD_GYRO = {name: _scaled(0.3, law) for name, law in _ODD.items()}
_ODD_QUARTZ = {
    f"{s}{n[4:]}": _scaled(30.0, law) for s in ("bias", "scale") for n, law in _ODD.items()
}
_ODD_TABLE: Mapping[str, Callable[[Table], np.ndarray]] = {
    "zero.ripple": lambda at: 2.0 * np.sin(at.degrees / 4.0),
    "zero.resonance": lambda at: 3.0 / (1 + ((at.degrees - 10.0) / 5.0) ** 2),
    "zero.saw": lambda at: 2.0 * (np.mod(at.degrees / 30.0, 1.0) - 0.5),
    "zero.saturation": lambda at: 3.0 * np.tanh(at.warmth / 2.0),
    "zero.slow_hysteresis": lambda at: 1.5 * at.forward * np.exp(-at.turned / 15.0),
    "base_tilt.root": lambda at: 2.0 * np.sqrt(np.maximum(at.time, 0.0) / SPAN),
}


def _uniform(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw offsets of unit standard deviation that are not normal."""
    return rng.uniform(-np.sqrt(3.0), np.sqrt(3.0), count)


def _drawn(rng: np.random.Generator, laws: Mapping[str, object], without: str) -> dict[str, float]:
    """Draw hidden effects at sizes log-uniform over two decades; that of an omitted one is zero."""
    names = rng.choice(sorted(laws), size=rng.choice(COUNTS), replace=False)
    low, high = np.log(SIZES)
    sizes = {str(n): float(np.exp(rng.uniform(low, high)) * rng.choice((-1, 1))) for n in names}
    return {n: 0.0 if n == without else size for n, size in sizes.items()}
