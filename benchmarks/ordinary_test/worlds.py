"""Campaigns of a sensor on a package in a chamber: recorded quantities, and all true columns.

The thermometer is on the package, and the sensor, or its electronics, is a body behind it. A campaign has three to five
runs of one to two and a half hours; each begins with power-on, in a chamber with a random initial temperature.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.ordinary_test.bodies import Array, Body, Chamber, lump, slab, two_stages
from benchmarks.ordinary_test.oracle import least_squares, log_evidence

STEP = 1.0  # s, of the integration: half of it moves no body by a thousandth of a degree
STRUCTURES = ("die", "two stages", "diffusing", "added")
ZERO, CONSTANT_SD = 20.0, 50.0  # °/s
SLOPES = (0.01, 0.1)  # °/s/°C, log-uniform, of either sign
SLOPE_SD = 0.05
NOISES = (0.02, 0.1)  # °/s, log-uniform
LARGEST = 8.0  # rms of what is hidden, in parts of the noise; log-uniform up to this
SMALLEST = 3.0  # from this, over the square root of the readings (of the runs, for their offsets)
# As far as a gyroscope's stated sizes reach, three of them: no test of priors. °/s/°C², °/s, °/s
PLAUSIBLE = {"curve": 1.5e-3, "warm-up": 1.5, "run": 0.15}
TIMES = (45.0, 1800.0)  # s, log-uniform: the time by which a body is behind a steady ramp
WARM_UPS = (200.0, 2400.0)  # s, log-uniform
MONTH = 30 * 86400.0  # s, between what is fitted and what is held out
STYLES = ("mixed", "ramps", "steps")  # of a program


class Program(NamedTuple):
    """Set points of a chamber through a run, as a piecewise linear function.

    Attributes:
        time: times of the corners since power-on, s.
        goal: set points at the corners, °C.
    """

    time: Array
    goal: Array


@dataclass(frozen=True)
class Record:
    """Recorded runs, and the true quantities at each reading.

    Attributes:
        run: index of each reading's run, from 0.
        time: time from a common origin of all runs, s.
        package: true temperature at the thermometer, °C.
        thermometer: recorded temperature, °C.
        inner: temperature of the body behind the package, °C.
        warming: remaining fraction of the self-heating, 1 at power-on.
        supply: recorded supply voltage, V.
        output: recorded output, °/s.
        clean: output without noise, °/s.
        since: time since a run's first reading, s.
    """

    run: NDArray[np.int64]
    time: Array
    package: Array
    thermometer: Array
    inner: Array
    warming: Array
    supply: Array
    output: Array
    clean: Array
    since: Array


@dataclass(frozen=True)
class Sensor:
    """True properties of one sensor.

    Attributes:
        structure: one of `STRUCTURES`; "none": no lag.
        body: body behind the package.
        middle: temperature about which its laws are expanded, °C.
        slope: slope of the steady-state output, °/s/°C.
        share: part of the slope due to the electronics; of structure `added` only.
        sizes: °/s per unit of each hidden family's column: °/s/°C² for the curve, °/s for warm-up and runs (standard
            deviation), °/s/V for the supply.
        noise: standard deviation of the noise, °/s.
        further: an effect that no family describes, °/s.
    """

    structure: str
    body: Body
    middle: float
    slope: float
    share: float
    sizes: Mapping[str, float]
    noise: float
    further: Callable[[Record], Array] | None = None

    def acting(self, record: Record) -> Array:
        """Return the temperature at which the sensor's own terms act, relative to `middle`, °C."""
        at = record.package if self.structure in ("added", "none") else record.inner
        return at - self.middle

    def thermal(self, record: Record) -> Array:
        """Return the output caused by temperatures, °/s."""
        acts = self.acting(record)
        output = self.slope * acts + self.sizes.get("curve", 0.0) * acts**2
        if self.structure == "added":
            output = output + self.share * self.slope * (record.inner - record.package)
        return output

    def measured(self, rng: np.random.Generator, record: Record) -> Record:
        """Return the record with an output, with an offset for each run."""
        runs = len(np.unique(record.run))
        offsets = self.sizes.get("run", 0.0) * rng.standard_normal(runs)
        clean = ZERO + offsets[record.run] + self.thermal(record)
        clean = clean + self.sizes.get("warm-up", 0.0) * record.warming
        clean = clean + self.sizes.get("supply", 0.0) * (record.supply - 5.0)
        if self.further is not None:
            clean = clean + self.further(record)
        output = clean + self.noise * rng.standard_normal(len(clean))
        return replace(record, clean=clean, output=output)

    def settled(self, temperature: Array) -> Array:
        """Return the steady-state output, °/s, with runs and supply at their means."""
        u = temperature - self.middle
        return ZERO + self.slope * u + self.sizes.get("curve", 0.0) * u**2


@dataclass(frozen=True)
class Campaign:
    """A record to fit, two to predict, and the sensor.

    Attributes:
        sensor: the true sensor.
        fitted: readings to fit.
        later: hold-out readings with the same kind of profile, and with another kind.
        hidden: hidden families.
        recorded: whether the supply is a column of the file.
        columns: further columns, by header.
    """

    sensor: Sensor
    fitted: Record
    later: Mapping[str, Record]
    hidden: tuple[str, ...]
    recorded: bool
    columns: Mapping[str, Callable[[Record], Array]]

    def file(self, record: Record, first: int = 1) -> dict[str, Array]:
        """Return the columns of a file by header; runs are numbered from `first`."""
        table = {
            "run": np.array([f"{first + int(r)}" for r in record.run]),
            "time [s]": np.round(record.time, 3),
            "temperature [degC]": np.round(record.thermometer, 3),
        }
        if self.recorded:
            table["supply [V]"] = np.round(record.supply, 5)
        table |= {header: column(record) for header, column in self.columns.items()}
        return {**table, "output [deg/s]": np.round(record.output, 6)}

    def design(self, record: Record, without: str = "") -> tuple[Array, Array, list[str]]:
        """Return the true columns of a model (n, k), their coefficients' prior standard deviations, and their families.

        Args:
            record: readings.
            without: family to omit; all temperature terms then act at the thermometer.
        """
        sensor, sizes = self.sensor, self.sensor.sizes
        lags = without != "lag" and sensor.structure not in ("added", "none")
        acts = record.inner - sensor.middle if lags else record.thermometer - sensor.middle
        columns = [("constant", np.ones_like(acts), CONSTANT_SD), ("slope", acts, SLOPE_SD)]
        if sensor.structure == "added":
            columns.append(("lag", record.inner - record.thermometer, sensor.share * sensor.slope))
        if sensor.further is not None:
            columns.append(("further", sensor.further(record), 1.0))
        by_effect = {
            "curve": [acts**2],
            "warm-up": [record.warming],
            "supply": [record.supply - 5.0],
            "run": [(record.run == r).astype(float) for r in np.unique(record.run)],
        }
        for name in self.hidden:
            columns += [(name, column, sizes[name]) for column in by_effect.get(name, ())]
        included = [entry for entry in columns if entry[0] != without]
        names = [name for name, _, _ in included]
        return np.array([c for _, c, _ in included]).T, np.abs([s for _, _, s in included]), names

    def oracle(self) -> dict[str, float]:
        """Return each hidden family's log Bayes factor: all true columns over those without its own, nats."""
        y = self.fitted.output
        columns, sd, _ = self.design(self.fitted)
        whole = log_evidence(y, columns, sd)
        evidence = {}
        names = (*self.hidden, *(("further",) if self.sensor.further is not None else ()))
        for name in names:
            columns, sd, _ = self.design(self.fitted, without=name)
            evidence[name] = whole - log_evidence(y, columns, sd)
        return evidence

    def errors_of_true(self) -> dict[str, float]:
        """Return hold-out errors of the true model fitted by least squares, °/s rms, without a constant per run."""
        columns, _, names = self.design(self.fitted)
        # Of a constant and an offset for every run, one is too many: the latter have the level.
        indices = [i for i, n in enumerate(names) if n != "constant" or "run" not in self.hidden]
        coefficients = least_squares(self.fitted.output, columns[:, indices])
        level = np.array([names[i] not in ("run", "constant") for i in indices])
        errors = {}
        for kind, record in self.later.items():
            later, _, by_name = self.design(record)
            chosen = [i for i, n in enumerate(by_name) if n not in ("run", "constant")]
            expected = later[:, chosen] @ coefficients[level]
            errors[kind] = within_runs(record.output - expected, record.run)
        return errors


def within_runs(errors: Array, run: NDArray[np.int64]) -> float:
    """Return the root mean square of errors after subtraction of each run's mean."""
    codes = np.unique(run, return_inverse=True)[1]
    means = np.bincount(codes, errors) / np.bincount(codes)
    return float(np.sqrt(np.mean((errors - means[codes]) ** 2)))


def drawn(
    rng: np.random.Generator,
    structure: str,
    repeats: bool,
    readings: int,
    hidden: tuple[str, ...],
    *,
    recorded: bool,
    offsets: float | None = None,
    further: Callable[[np.random.Generator, Record, float], Further] | None = None,
) -> Campaign:
    """Draw a campaign with these families hidden in it, and all other properties at random.

    Args:
        rng: random-number generator.
        structure: one of `STRUCTURES`, or "none".
        repeats: whether all runs have one profile.
        readings: approximate number of readings.
        hidden: families among "run", "warm-up", "curve", "supply".
        recorded: whether the supply is in the file.
        offsets: standard deviation of the runs' offsets relative to the noise; random if not given.
        further: factory of an effect that no family describes, from generator, readings to fit and noise.
    """
    plan = Plan.of(rng, structure, repeats, readings)
    noise = _log_uniform(rng, NOISES)
    bare, count = plan.record(rng, plan.programs), len(plan.programs)
    sizes = {}
    for name in hidden:
        column, observed = {
            "curve": (_beyond_line((bare.inner - plan.middle) ** 2, bare.inner), len(bare.time)),
            "warm-up": (bare.warming - bare.warming.mean(), len(bare.time)),
            "supply": (bare.supply - bare.supply.mean(), len(bare.time)),
            "run": (np.ones(1), len(bare.time) / count),
        }[name]
        unit = np.sqrt(np.mean(column**2)) / noise
        low, high = SMALLEST / np.sqrt(observed) / unit, LARGEST / unit
        high = max(low, min(high, PLAUSIBLE.get(name, high)))
        sign = 1.0 if name == "run" else rng.choice((-1.0, 1.0))
        sizes[name] = sign * _log_uniform(rng, (low, high))
    if offsets is not None:
        sizes["run"] = offsets * noise
    extra = Further() if further is None else further(rng, bare, noise)
    description = plan.structure, plan.body, plan.middle, plan.slope, plan.share
    sensor = Sensor(*description, sizes, noise, extra.law)
    later = {
        kind: sensor.measured(rng, plan.record(rng, programs, (1 + i) * MONTH))
        for i, (kind, programs) in enumerate(plan.later.items())
    }
    true = () if structure == "none" else ("lag",)
    fitted = sensor.measured(rng, bare)
    return Campaign(sensor, fitted, later, (*true, *hidden), recorded, extra.columns)


class Further(NamedTuple):
    """An effect that no family describes, and the columns that are recorded for it."""

    law: Callable[[Record], Array] | None = None
    columns: Mapping[str, Callable[[Record], Array]] = MappingProxyType({})


@dataclass(frozen=True)
class Plan:
    """Plan of a campaign: the sensor's bodies, the programs of its runs, the times of readings.

    Attributes:
        structure, body, warm, middle: as in `Sensor`.
        package: body between the chamber's air and the thermometer.
        chamber: the chamber.
        slope, share: as in `Sensor`.
        programs: programs of the fitted runs.
        later: programs of the hold-out runs, by kind: "same", "other".
        duration: duration of a run, s.
        interval: time between readings, s.
        delay: time from power-on to a run's first reading, s.
    """

    structure: str
    body: Body
    warm: Body
    package: Body
    chamber: Chamber
    middle: float
    slope: float
    share: float
    programs: tuple[Program, ...]
    later: Mapping[str, tuple[Program, ...]]
    duration: float
    interval: float
    delay: float

    @classmethod
    def of(cls, rng: np.random.Generator, structure: str, repeats: bool, readings: int) -> Plan:
        """Draw a plan at random."""
        runs = int(rng.integers(3, 6))
        duration = rng.uniform(1.2, 2.5) * 3600
        low = rng.uniform(-40.0, 25.0)
        ends = low, low + rng.uniform(35.0, min(90.0, 85.0 - low))
        style = str(rng.choice(STYLES))
        other = str(rng.choice([s for s in STYLES if s != style]))

        def programs(count: int, style: str, single: bool) -> tuple[Program, ...]:
            drawn = [_program(rng, style, ends, duration) for _ in range(1 if single else count)]
            return tuple(drawn * count if single else drawn)

        fitted = programs(runs, style, repeats)
        same = (fitted[0], fitted[0]) if repeats else programs(2, style, False)
        return cls(
            structure,
            _body(rng, structure),
            _warm(rng),
            lump(rng.uniform(30.0, 120.0)),
            Chamber(
                rng.uniform(240.0, 600.0), rng.uniform(0.4, 0.9), rng.uniform(3.0, 8.0) / 60, 0.1
            ),
            float(np.mean(ends)),
            _log_uniform(rng, SLOPES) * rng.choice((-1.0, 1.0)),
            rng.uniform(0.2, 1.0) * rng.choice((-1.0, 1.0)),
            fitted,
            {"same": same, "other": programs(2, other, False)},
            duration,
            duration * runs / readings,
            rng.uniform(0.0, 60.0),
        )

    def record(
        self, rng: np.random.Generator, programs: tuple[Program, ...], start: float = 0.0
    ) -> Record:
        """Simulate runs through these programs, with the power off between them; without output."""
        parts = []
        for i, program in enumerate(programs):
            run = _run(rng, self, program)
            count = len(run["since"])
            parts.append({**run, "run": np.full(count, i), "time": start + run["since"]})
            start += self.duration + rng.uniform(0.5, 15.0) * 3600
        joined = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
        zeros = np.zeros_like(joined["time"])
        return Record(**joined, output=zeros, clean=zeros)


def _run(rng: np.random.Generator, plan: Plan, program: Program) -> dict[str, Array]:
    """Simulate one run: the chamber soaks from a random temperature, the power is switched on, and the program runs."""
    first = float(program.goal[0])
    came = rng.uniform(18.0, 28.0)
    # Who tests knows about how slow the part is: it has come to within a degree or two.
    soak = max(float(rng.choice((600.0, 1800.0, 5400.0))), rng.uniform(2.0, 5.0) * plan.body.behind)
    before = abs(came - first) / plan.chamber.fastest + soak
    grid = np.arange(0.0, before + plan.duration + 2 * STEP, STEP)
    ramp = abs(came - first) / plan.chamber.fastest
    corners = [0.0, max(ramp, STEP), before]
    goal = np.interp(
        grid, [*corners, *(before + STEP + program.time)], [came, first, first, *program.goal]
    )
    air = plan.chamber.air(goal, STEP, rng)
    package = plan.package.inside(air, STEP)
    inner = plan.body.inside(package, STEP)
    on = plan.delay
    since = np.arange(0.0, plan.duration - on, plan.interval)
    at = before + on + since
    ticks = np.arange(0.0, plan.duration + 2 * STEP, STEP)
    reached = np.interp(at, grid, package)
    return {
        "since": since,
        "package": reached,
        "thermometer": reached + 0.005 * rng.standard_normal(len(at)),
        "inner": np.interp(at, grid, inner),
        "warming": np.interp(on + since, ticks, plan.warm.warming(ticks, STEP)),
        "supply": np.interp(on + since, ticks, _supply(rng, len(ticks))),
    }


def _supply(rng: np.random.Generator, count: int) -> Array:
    """Simulate a 5 V supply that varies over 20 min, with steps of its load, V."""
    share = STEP / 1200.0
    kicks = np.sqrt(2 * share) * rng.standard_normal(count)
    kicks[0] = rng.standard_normal()
    wander = lfilter([1.0], [1.0, share - 1.0], kicks)
    steps = np.zeros(count)
    for at in rng.integers(0, count, rng.poisson(3)):
        steps[at:] += 0.04 * rng.standard_normal()
    return 5.0 + 0.05 * np.asarray(wander) + steps


def _program(
    rng: np.random.Generator, style: str, ends: tuple[float, float], duration: float
) -> Program:
    """Draw ramps, steps and dwells between two temperatures."""
    time, goal = [0.0], [float(rng.uniform(*ends))]
    up = bool(rng.integers(2))
    while time[-1] < duration:
        low, high = ends
        span = high - low
        # Ramps go from one end's third to the other's; steps anywhere.
        to = rng.uniform(high - span / 3, high) if up else rng.uniform(low, low + span / 3)
        if style == "steps" or (style == "mixed" and rng.random() < 0.3):
            to = float(
                np.clip(goal[-1] + rng.choice((-1, 1)) * span * rng.uniform(0.1, 0.4), *ends)
            )
            took, dwell = 30.0, rng.uniform(8.0, 30.0) * 60
        else:
            took = abs(to - goal[-1]) / (_log_uniform(rng, (0.7, 4.0)) / 60)
            dwell = 0.0 if style == "ramps" and rng.random() < 0.6 else rng.uniform(3.0, 25.0) * 60
        up = not up
        for seconds in (took, dwell):
            if seconds > 0:
                time.append(time[-1] + seconds)
                goal.append(float(to))
    return Program(np.array(time), np.array(goal))


def _body(rng: np.random.Generator, structure: str) -> Body:
    """Draw a body whose steady lag on a ramp is log-uniform over `TIMES`."""
    time = _log_uniform(rng, TIMES)
    ratio, contact, mean = (
        _log_uniform(rng, (0.2, 1.0)),
        _log_uniform(rng, (2, 50)),
        rng.integers(2),
    )
    if structure == "two stages":
        body = two_stages(1.0, ratio, rng.uniform(0.1, 0.5))
    elif structure == "diffusing":
        body = slab(1.0, contact, bool(mean))
    else:
        body = lump(1.0)
    return Body(body.capacity * time / body.behind, body.conductance, body.weight)


def _warm(rng: np.random.Generator) -> Body:
    """Draw a self-heating body: an exponential of two times, or a slab."""
    time, ratio = _log_uniform(rng, WARM_UPS), _log_uniform(rng, (0.1, 0.4))
    body = two_stages(1.0, ratio, ratio) if rng.random() < 0.5 else slab(2.5, 3.0, False)
    return Body(body.capacity * time, body.conductance, body.weight)


def _beyond_line(column: Array, along: Array) -> Array:
    """Return a column's residuals from a constant and a line."""
    line = np.array([np.ones_like(along), along - along.mean()]).T
    return column - line @ least_squares(column, line)


def _log_uniform(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(ends))))
