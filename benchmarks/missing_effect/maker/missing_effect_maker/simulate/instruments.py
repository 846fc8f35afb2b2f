"""Physical simulators of six instruments and a batch of devices, and the models with which they are calibrated.

A test is simulated in ten steps per reading and averaged: a chamber that follows its set points, bodies that follow the
chamber, slow variations of the laboratory's air and supply. `formulas.py` has the formulas of the candidates; the laws
here always differ from them: a quadratic is an exponential minus its tangent, a lag has two bodies in series,
hysteresis is that of stick-slip joints, ageing is logarithmic, and rotations are exact. Sizes are assumed: a term of
plausible size contributes about as much to a reading as the noise.
Sources: MEMS gyroscopes, IEEE 1431; accelerometers on tables and centrifuges, IEEE 1293 and 836; tides, M2 of
12.4206 h; stick-slip operators, A. Y. Ishlinskii (1944).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from missing_effect.draws import Array, Draws
from missing_effect.task import Term

from missing_effect_maker.simulate.bodies import body

FINE = 10  # moments of the world in each reading
VAST = 1e3  # plausible size of what is not known beforehand, in standard deviations of a reading's noise
TIDE = 12.4206 * 3600.0  # s


@dataclass
class World:
    """True quantities of one test, and its record.

    Attributes:
        unit: unit of the output.
        noise: standard deviation of the white noise of a reading, that unit.
        decimals: decimals of each recorded column; the last is at most a fiftieth of its scatter.
        columns: recorded columns, (n,) each.
        units: units of the columns.
        known: contribution of the base model's terms to the output, (n,).
        hidden: contribution of each candidate's cause at its plausible size, (n,).
        base, candidates: terms of the model.
        environment: names of candidates that depend on a recorded quantity of the laboratory.
    """

    unit: str
    noise: float
    decimals: dict[str, int] = field(default_factory=dict)
    columns: dict[str, Array] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    known: Any = 0.0
    hidden: dict[str, Array] = field(default_factory=dict)
    base: list[Term] = field(default_factory=list)
    candidates: list[Term] = field(default_factory=list)
    environment: tuple[str, ...] = ()

    def note(self, name: str, values: Array, unit: str, decimals: int) -> None:
        """Record a column."""
        self.columns[name], self.units[name], self.decimals[name] = values, unit, decimals

    def knows(
        self, name: str, truth: Any, formula: str, unit: str, words: str, **fields: Any
    ) -> None:
        """Add a term to the base model, and its true contribution to the output."""
        size = fields.pop("size", VAST * self.noise)
        nuisance = fields.pop("nuisance", False)
        self.base.append(Term(name, words, formula, fields, unit, size, {}, nuisance))
        self.known = self.known + truth

    def may_lack(
        self, name: str, adds: Array, formula: str, unit: str, words: str, **fields: Any
    ) -> None:
        """Add a candidate, and the true contribution of its cause at `size`."""
        size, shapes = fields.pop("size"), fields.pop("shapes", {})
        self.candidates.append(Term(name, words, formula, fields, unit, size, shapes))
        self.hidden[name] = size * adds


@dataclass
class Chamber:
    """Runs in a stepped chamber; each quantity has the shape (runs, readings·FINE).

    Attributes:
        time: time since the start of the test, s.
        since: time since the start of the run, s.
        air: air temperature, °C.
        step: time step, s.
    """

    time: Array
    since: Array
    air: Array
    step: float

    @classmethod
    def of(
        cls,
        draws: Draws,
        levels: tuple[float, ...],
        each_count: int,
        interval: float,
        runs: int = 5,
        slow: float = 3.0,
    ) -> Chamber:
        """Simulate runs through these temperatures, in a different order each, with `each_count` readings at each.

        Args:
            interval: time between readings, s.
            slow: time constant of the chamber, in intervals.
        """
        step = interval / FINE
        moments = len(levels) * each_count * FINE
        set_points = np.array(
            [np.repeat(draws.shuffled(levels), each_count * FINE) for _ in range(runs)]
        )
        since = np.tile((np.arange(moments) + 0.5) * step, (runs, 1))
        pause = 3600.0  # s between runs
        time = since + np.arange(runs)[:, None] * (moments * step + pause)
        return cls(time, since, body(set_points, step, slow * interval), step)

    def behind(self, tau: float) -> Array:
        """Return the temperature, °C, behind two bodies in series, of time constants 0.86·tau and 0.14·tau."""
        return body(body(self.air, self.step, 0.86 * tau), self.step, 0.14 * tau)

    def cold(self, tau: float) -> Array:
        """Return the decay after a cold start: that of the electronics, and a slower one of their case."""
        return 0.85 * np.exp(-self.since / tau) + 0.15 * np.exp(-self.since / (3.0 * tau))

    def aged(self) -> Array:
        """Return ageing that is logarithmic in time: 0 at the start, 1 at the end of the test."""
        return np.log(1.0 + 0.5 * self.time / self.time.max()) / np.log(1.5)

    def read(self, values: Array) -> Array:
        """Average a quantity over each reading, in test order."""
        return np.broadcast_to(values, self.time.shape).reshape(-1, FINE).mean(axis=1)


def softening(change: Array, over: float) -> Array:
    """Return an exponential minus its tangent: about change², more at high temperature."""
    return 2.0 * over**2 * (np.expm1(change / over) - change / over)


def saturating(change: Array, over: float) -> Array:
    """Return the residual of a line after a tanh compensation: about change³, less at large changes."""
    return 3.0 * over**3 * (change / over - np.tanh(change / over))


def sticking(path: Array, widths: tuple[float, ...]) -> Array:
    """Return the mean strain of stick-slip joints (play operators), between −1 and 1, along the last axis."""
    total = np.zeros(path.shape)
    for width in widths:
        seat = path[..., 0].copy()
        for i in range(path.shape[-1]):
            seat = np.clip(seat, path[..., i] - width, path[..., i] + width)
            total[..., i] += (path[..., i] - seat) / width
    return total / len(widths)


def new_world(unit: str, noise: float, draws: Draws, chamber: Chamber, decimals: int) -> World:
    """Return a test with the terms that all have: an offset, a line in temperature, and offsets of runs."""
    world = World(unit, noise)
    runs = len(chamber.time)
    label = np.repeat(np.arange(1, runs + 1), chamber.time.shape[1] // FINE)
    world.note("run", label, "", 0)
    world.note("time", chamber.read(chamber.time), "s", 1)
    air = chamber.read(chamber.air)
    world.note("temperature", air + 0.02 * draws.normal(air.size), "degC", 3)
    world.decimals["output"], world.units["output"] = decimals, unit
    offset, slope = 50.0 * noise * draws.normal(2)
    world.knows("bias.constant", offset, "constant", unit, "c")
    warm = slope / 30.0 * (air - 40.0)
    line: dict[str, Any] = {"column": "temperature", "about": 40.0, "order": 1}
    words, size = "c·(T − 40 °C)", VAST * noise / 30
    world.knows("bias.temperature", warm, "power", f"{unit}/degC", words, size=size, **line)
    turn_on = noise * draws.normal(runs)
    levels = list(range(1, runs))  # the last run is held out
    fields: dict[str, Any] = {"group": "run", "levels": levels, "size": noise, "nuisance": True}
    words = "one offset for each run: how it was switched on"
    world.knows("bias.run", turn_on[label - 1], "each", unit, words, **fields)
    return world


def laboratory(
    world: World, draws: Draws, rho: float, **quantities: tuple[str, float, float]
) -> None:
    """Add two recorded quantities of the laboratory, of correlation `rho`, with a candidate each.

    Args:
        quantities: name → unit, usual value, scatter.
    """
    count = len(world.columns["time"])
    first, other = draws.wave(count, 40), draws.wave(count, 40)
    other = other - first * np.mean(first * other)
    second = rho * first + np.sqrt(1 - rho**2) * other / np.std(other)
    for (name, (unit, usual, scatter)), course in zip(
        quantities.items(), draws.shuffled([first, second]), strict=True
    ):
        decimals = max(0, 3 - int(np.floor(np.log10(scatter))))
        meter = 0.01 * draws.normal(count)
        world.note(name, usual + scatter * (course + meter), unit, decimals)
        fields: dict[str, Any] = {"column": name, "about": usual, "order": 1}
        size = world.noise / scatter
        words = f"c·({name} − {usual:g} {unit})"
        per = f"{world.unit}/{unit}"
        world.may_lack(f"bias.{name}", scatter * course, "power", per, words, size=size, **fields)
    world.environment = tuple(f"bias.{name}" for name in quantities)


def thermal(world: World, draws: Draws, chamber: Chamber, *which: str) -> None:
    """Add candidates that depend on the chamber's temperature and on time."""
    noise, unit, air = world.noise, world.unit, chamber.air - 40.0
    step, half = chamber.step * FINE, float(np.ptp(chamber.air)) / 2
    tau, warm = step * draws.ratio(2.5, 15.0), step * draws.ratio(5.0, 25.0)
    lagging, times = chamber.behind(tau) - chamber.air, {"tau": (1.5 * step, 20.0 * step)}
    slow = {"tau": (3.0 * step, 33.0 * step)}
    in_run: dict[str, Any] = {"column": "temperature", "group": "run"}
    t: dict[str, Any] = {"column": "temperature", "about": 40.0}
    two, three = {**t, "order": 2}, {**t, "order": 3}
    bent, skew = softening(air, 400.0), saturating(air, 90.0)
    lags, joints = {**in_run, "shapes": times}, {**in_run, "shapes": {"width": (0.5, 10.0)}}
    sticks, last = sticking(chamber.air, (1.0, 2.5, 5.0)), float(chamber.time.max())
    warming, ageing = {"group": "run", "shapes": slow}, {"column": "time", "about": 0.0, "order": 1}
    # name: what happens, formula, unit, words, size, arguments and shapes
    laws: dict[str, tuple[Array, str, str, str, float, dict[str, Any]]] = {
        "quadratic": (bent, "power", "/degC^2", "c·(T − 40 °C)²", 4 / half**2, two),
        "cubic": (skew, "power", "/degC^3", "c·(T − 40 °C)³", 5 / half**3, three),
        "lag": (lagging, "lag", "/degC", "c·(T̃ − T), τ·dT̃/dt = T − T̃", 4 / half, lags),
        "hysteresis": (sticks, "direction", "", "c·D, dD/dT = (sign(dT) − D)/w", 1.0, joints),
        "warm_up": (chamber.cold(warm), "warm_up", "", "c·exp(−t/τ) in a run", 3.0, warming),
        "drift": (last * chamber.aged(), "power", "/s", "c·t", 24 / last, ageing),
    }
    for name in which:
        adds, formula, per, words, size, fields = laws[name]
        adds, size = chamber.read(adds), size * noise
        world.may_lack(f"bias.{name}", adds, formula, unit + per, words, size=size, **fields)


def mems_gyro(draws: Draws, rho: float) -> World:
    """Simulate a rate gyroscope in a stepped chamber on a rate table."""
    chamber = Chamber.of(draws, (10.0, 25.0, 40.0, 55.0, 70.0), 10, 60.0)
    world = new_world("deg/s", 0.02, draws, chamber, 5)
    count = len(world.columns["time"])
    table = np.array([0.0, 100.0, -100.0, 50.0, -50.0])[np.arange(count) % 5]
    world.note("rate_input", table, "deg/s", 1)
    words = "κ·Ω"
    off: dict[str, Any] = {"column": "rate_input", "about": 0.0, "order": 1, "size": 10.0}
    world.knows(
        "scale.constant", (1 + 0.01 * draws.normal(1)[0]) * table, "power", "1", words, **off
    )
    thermal(world, draws, chamber, "quadratic", "cubic", "lag", "hysteresis", "warm_up", "drift")
    laboratory(world, draws, rho, supply=("V", 5.0, 0.05), humidity=("%", 45.0, 6.0))
    package = chamber.read(chamber.behind(25.0)) - 40.0
    fields: dict[str, Any] = {"first": "rate_input", "second": "temperature", "about": 40.0}
    world.may_lack(
        "scale.temperature",
        table * package,
        "product",
        "1/degC",
        "c·Ω·(T − 40 °C)",
        size=1.5e-5,
        **fields,
    )
    bent = table**2 / (1 + (table / 600.0) ** 2)
    even: dict[str, Any] = {"column": "rate_input", "about": 0.0, "order": 2}
    world.may_lack("scale.even", bent, "power", "1/(deg/s)", "c·Ω²", size=5e-6, **even)
    return world


def tilt_accelerometer(draws: Draws, rho: float) -> World:
    """Simulate an accelerometer on a tilted, turning table, with the input g·sin γ·sin θ."""
    chamber = Chamber.of(draws, (15.0, 30.0, 45.0, 60.0), 12, 300.0)
    world = new_world("ug", 0.5, draws, chamber, 3)
    count = len(world.columns["time"])
    angle = 30.0 * (np.arange(count) % 12)
    theta = np.deg2rad(angle)
    tilt = np.deg2rad(0.06)
    across = 1e6 * np.sin(tilt) * np.sin(theta)  # µg
    world.note("angle", angle, "deg", 1)
    world.note("acceleration", across, "ug", 4)
    turn: dict[str, Any] = {"column": "angle", "period": 360.0}
    azimuth, scale = 1e-2 * draws.normal(2)
    turned = (1 + scale) * 1e6 * np.sin(tilt) * np.sin(theta + azimuth)
    world.knows("input", turned, "harmonic", "ug", "c·cos θ, s·sin θ", size=1e4, **turn)
    thermal(world, draws, chamber, "quadratic", "cubic", "lag", "warm_up", "drift")
    laboratory(
        world, draws, rho, lab_temperature=("degC", 21.0, 0.5), pressure=("hPa", 1010.0, 5.0)
    )
    product: dict[str, Any] = {"first": "acceleration", "second": "temperature", "about": 40.0}
    body_at = chamber.read(chamber.behind(100.0)) - 40.0
    world.may_lack(
        "scale.temperature",
        across * body_at,
        "product",
        "1/degC",
        "c·a·(T − 40 °C)",
        size=5e-5,
        **product,
    )
    wobble = np.deg2rad(10.0 + 350.0 * draws.uniform(1)[0])
    tipped = np.sin(tilt + 4e-7 * np.cos(2 * theta + wobble)) - np.sin(tilt)
    adds = 1e6 * tipped / 0.5
    world.may_lack(
        "table.wobble",
        adds,
        "harmonic",
        "ug",
        "c·cos 2θ, s·sin 2θ",
        size=0.5,
        column="angle",
        period=180.0,
    )
    hours, (moons, suns) = 2 * np.pi * chamber.time, 6.28 * draws.uniform(2)
    moon = chamber.read(np.sin(hours / TIDE + moons) + 0.1 * np.sin(hours / 43200.0 + suns))
    world.may_lack(
        "base.tide",
        moon,
        "harmonic",
        "ug",
        "c·cos, s·sin of M2",
        size=0.6,
        column="time",
        period=TIDE,
    )
    return world


def warm_scale(
    world: World,
    chamber: Chamber,
    input_g: np.ndarray,
    unit: str,
    *,
    about: float,
    behind: float,
    size: float,
) -> None:
    """Add a scale factor that may depend on the temperature of a body, about `about` °C, time constant `behind` s."""
    world.may_lack(
        "scale.temperature",
        input_g * (chamber.read(chamber.behind(behind)) - about),
        "product",
        f"{unit}/g/degC",
        f"c·a·(T − {about:g} °C)",
        size=size,
        first="acceleration",
        second="temperature",
        about=about,
    )


def two_thermometers(draws: Draws, rho: float) -> World:
    """Simulate a vibrating-beam accelerometer at ±1 g, with thermometers in its head and at its circuit."""
    chamber = Chamber.of(draws, (0.0, 20.0, 40.0, 60.0, 80.0), 10, 60.0)
    world = new_world("ug", 20.0, draws, chamber, 1)
    count = len(world.columns["time"])
    up = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
    world.note("acceleration", up, "g", 1)
    scale: dict[str, Any] = {"column": "acceleration", "about": 0.0, "order": 1, "size": 1e5}
    error = 1e6 + 3e4 * draws.normal(1)[0]
    world.knows("scale.constant", (error - 1e6) * up, "power", "ug/g", "c·a", **scale)
    circuit = chamber.read(chamber.behind(240.0))
    noted = circuit + 0.02 * draws.normal(count)
    world.note("temperature_circuit", noted, "degC", 3)
    head = chamber.read(chamber.air)
    thermal(world, draws, chamber, "quadratic", "cubic", "hysteresis", "warm_up", "drift")
    laboratory(world, draws, rho, supply=("V", 12.0, 0.1), field=("uT", 48.0, 3.0))
    pair: dict[str, Any] = {"first": "temperature_circuit", "second": "temperature"}
    gradient = circuit - head
    world.may_lack(
        "bias.gradient", gradient, "difference", "ug/degC", "c·(t1 − t2)", size=4.0, **pair, order=1
    )
    bowed = 2.0 * 80.0**2 * (np.sqrt(1.0 + (gradient / 80.0) ** 2) - 1.0)
    world.may_lack(
        "bias.gradient_quadratic",
        bowed,
        "difference",
        "ug/degC^2",
        "c·(t1 − t2)²",
        size=0.3,
        **pair,
        order=2,
    )
    warm_scale(world, chamber, up, "ug", about=40.0, behind=25.0, size=0.8)
    return world


def centrifuge(draws: Draws, rho: float) -> World:
    """Simulate an accelerometer on a centrifuge with speed plateaus: nonlinearity, radius, tangential acceleration."""
    chamber = Chamber.of(draws, (20.0, 30.0, 40.0), 16, 10.0)
    world = new_world("mg", 0.3, draws, chamber, 4)
    shape = chamber.time.shape
    levels = np.array([draws.shuffled((1.0, 4.0, 7.0, 10.0, 2.5, 8.5)) for _ in range(shape[0])])
    speed = body(np.sqrt(np.repeat(levels, shape[1] // 6, axis=1)), chamber.step, 25.0)
    input_g = chamber.read(speed**2)
    world.note("acceleration", input_g, "g", 5)
    scale: dict[str, Any] = {"column": "acceleration", "about": 0.0, "order": 1, "size": 1e3}
    world.knows(
        "scale.constant", 3.0 * draws.normal(1)[0] * input_g, "power", "mg/g", "c·a", **scale
    )
    thermal(world, draws, chamber, "quadratic", "lag", "drift")
    laboratory(world, draws, rho, supply=("V", 12.0, 0.1), pressure=("hPa", 1010.0, 5.0))
    power: dict[str, Any] = {"column": "acceleration", "about": 5.0}
    spring = (input_g - 5.0) ** 2 / (1.0 - (input_g - 5.0) / 100.0)
    world.may_lack(
        "second_order", spring, "power", "mg/g^2", "K2·(a − 5 g)²", size=0.04, **power, order=2
    )
    stop = saturating(input_g - 5.0, 15.0)
    world.may_lack(
        "third_order", stop, "power", "mg/g^3", "K3·(a − 5 g)³", size=0.015, **power, order=3
    )
    slope = np.gradient(speed, chamber.step, axis=1)
    along = chamber.read(2 * speed * slope)
    world.may_lack(
        "timing", along, "rate", "mg/(g/s)", "c·da/dt", size=2.0, column="acceleration", group="run"
    )
    warm_scale(world, chamber, input_g, "mg", about=30.0, behind=4.0, size=0.012)
    return world


def inclinometer(draws: Draws, rho: float) -> World:
    """Simulate a level rotated about its axis: its zero against the placement angle."""
    chamber = Chamber.of(draws, (15.0, 25.0, 35.0), 18, 60.0)
    world = new_world("arcsec", 1.0, draws, chamber, 3)
    shape = chamber.time.shape
    angles = np.concatenate([np.linspace(-45, 45, 27), np.linspace(45, -45, 27)])
    angle = np.tile(np.repeat(angles, FINE), (shape[0], 1))
    placed = chamber.read(angle)
    omega = np.deg2rad(placed)
    world.note("angle", placed, "deg", 3)
    line: dict[str, Any] = {"column": "angle", "about": 0.0, "order": 1, "size": 1e3}
    world.knows(
        "zero.placement", 2.0 * draws.normal(1)[0] * placed, "power", "arcsec/deg", "c·ω", **line
    )
    thermal(world, draws, chamber, "quadratic", "lag", "warm_up", "drift")
    laboratory(world, draws, rho, lab_temperature=("degC", 21.0, 0.5), field=("uT", 48.0, 3.0))
    square: dict[str, Any] = {"column": "angle", "about": 0.0}
    pendulum = 2.0 * (1.0 - np.cos(omega)) * np.rad2deg(1.0) ** 2
    world.may_lack(
        "zero.projection", pendulum, "power", "arcsec/deg^2", "c·ω²", size=0.0016, **square, order=2
    )
    door = 6.0 * (omega - np.sin(omega)) * np.rad2deg(1.0) ** 3
    world.may_lack("zero.door", door, "power", "arcsec/deg^3", "c·ω³", size=6e-5, **square, order=3)
    pivots = chamber.read(sticking(angle, (2.0, 5.0, 12.0)))
    world.may_lack(
        "zero.hysteresis", pivots, "direction", "arcsec", "c·D, dD/dω = (sign(dω) − D)/w", size=1.0,
        column="angle", group="run", shapes={"width": (1.0, 30.0)},
    )  # fmt: skip
    phase = 6.28 * draws.uniform(1)[0]
    worm = np.cos(2 * np.pi * placed / 10.0 + phase + 0.05 * np.cos(omega))
    world.may_lack(
        "table.dividing",
        worm,
        "harmonic",
        "arcsec",
        "c·cos, s·sin of 36 ω",
        size=1.0,
        column="angle",
        period=10.0,
    )
    return world


def still_sensor(draws: Draws, rho: float) -> World:
    """Simulate any sensor at rest on temperature ramps, such as the zero of a barometer or a strain gauge."""
    chamber = Chamber.of(draws, (-10.0, 10.0, 30.0, 50.0, 70.0, 85.0), 8, 30.0, slow=6.0)
    world = new_world("uV", 1.5, draws, chamber, 3)
    thermal(world, draws, chamber, "quadratic", "cubic", "lag", "hysteresis", "warm_up", "drift")
    laboratory(world, draws, rho, pressure=("hPa", 1010.0, 5.0), humidity=("%", 45.0, 6.0))
    heat = chamber.read(np.gradient(body(chamber.air, chamber.step, 10.0), chamber.step, axis=1))
    world.may_lack(
        "bias.rate",
        heat,
        "rate",
        "uV/(degC/s)",
        "c·dT/dt",
        size=10.0,
        column="temperature",
        group="run",
    )
    return world


INSTRUMENTS: dict[str, Callable[[Draws, float], World]] = {
    f.__name__: f
    for f in (
        mems_gyro,
        tilt_accelerometer,
        two_thermometers,
        centrifuge,
        inclinometer,
        still_sensor,
    )
}

DEVICES, READINGS, HOLDOUTS = 100, 60, 12


def fleet(draws: Draws, rho: float) -> World:
    """Simulate a batch of gyroscopes in one chamber, one run each, with an offset and a tempco for each device."""
    chamber = Chamber.of(draws, (10.0, 25.0, 40.0, 55.0, 70.0), READINGS // 5, 60.0, runs=1)
    noise, unit = 0.02, "deg/s"
    world = World(unit, noise)
    device = np.repeat(np.arange(1, DEVICES + 1), READINGS)
    air = np.tile(chamber.read(chamber.air), DEVICES)
    world.note("device", device, "", 0)
    world.note("time", np.tile(chamber.read(chamber.time), DEVICES), "s", 1)
    world.note("temperature", air + 0.02 * draws.normal(air.size), "degC", 3)
    world.decimals["output"], world.units["output"] = 5, unit
    levels = list(range(1, DEVICES + 1))
    offset, slope = 0.5 * draws.normal(DEVICES), 0.01 * draws.normal(DEVICES)
    g: dict[str, Any] = {"group": "device", "levels": levels}
    line = {**g, "column": "temperature", "about": 40.0, "order": 1}
    world.knows(
        "bias.device", offset[device - 1], "each", unit, "one offset a device", size=0.5, **g
    )
    words = "one tempco a device"
    tempco = slope[device - 1] * (air - 40.0)
    world.knows("bias.temperature", tempco, "each_times", f"{unit}/degC", words, size=0.01, **line)
    soft, tau, warm = (
        softening(air - 40.0, 400.0),
        draws.ratio(150.0, 900.0),
        draws.ratio(300.0, 1500.0),
    )

    def all_alike(values: Array) -> Array:
        return np.tile(chamber.read(values), DEVICES)

    t: dict[str, Any] = {"column": "temperature", "about": 40.0}
    weak = (
        0.25 * noise
    )  # plausible for a term that all devices have in common: twenty times the readings show it
    per = f"{unit}/degC"
    world.may_lack(
        "bias.quadratic", soft, "power", f"{per}^2", "c·(T − 40 °C)²", size=weak / 200, **t, order=2
    )
    world.may_lack(
        "bias.cubic",
        saturating(air - 40.0, 90.0),
        "power",
        f"{per}^3",
        "c·(T − 40 °C)³",
        size=weak / 5e3,
        **t,
        order=3,
    )
    words = "c[device]·(T − 40 °C)²"
    spread = draws.normal(DEVICES)[device - 1] * soft
    fields: dict[str, Any] = {**line, "order": 2, "size": noise / 800}
    world.may_lack("bias.quadratic_device", spread, "each_times", f"{per}^2", words, **fields)
    group: dict[str, Any] = {"group": "device"}
    lagging = all_alike(chamber.behind(tau) - chamber.air)
    world.may_lack(
        "bias.lag", lagging, "lag", per, "c·(T̃ − T)", size=weak / 6, **group, column="temperature",
        shapes={"tau": (100.0, 1200.0)},
    )  # fmt: skip
    world.may_lack(
        "bias.warm_up", all_alike(chamber.cold(warm)), "warm_up", unit, "c·exp(−t/τ)", size=2 * weak, **group,
        shapes={"tau": (200.0, 2000.0)},
    )  # fmt: skip
    supply = np.concatenate([draws.wave(READINGS, 12) for _ in range(DEVICES)])
    world.note("supply", 5.0 + 0.05 * (supply + 0.01 * draws.normal(supply.size)), "V", 4)
    a: dict[str, Any] = {"column": "supply", "about": 5.0, "order": 1}
    world.may_lack(
        "bias.supply", 0.05 * supply, "power", f"{unit}/V", "c·(V − 5)", size=weak / 0.05, **a
    )
    place = np.cos(2 * np.pi * np.arange(DEVICES) / 10.0)[device - 1]
    world.note("place", place, "", 4)
    ice = place * all_alike(chamber.aged())
    iced: dict[str, Any] = {"first": "place", "second": "time", "about": 0.0}
    size, last = 8 * weak, float(chamber.time.max())
    world.may_lack(
        "chamber.ice", last * ice, "product", f"{unit}/s", "c·place·t", size=size / last, **iced
    )
    return world
