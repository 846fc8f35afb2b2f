"""Simulated batches of accelerometers on a centrifuge arm (source 3's test).

The world is made ten times per reading and averaged: an arm that is driven through plateaus, a fixture that windage
heats, a slow disturbance shared by all devices, and each device's own. The disturbance is made of a thermal
transient and slow oscillations, not of the polynomials by which the model describes it.

    made = simulate_batch(seed=1)
    made.readings, made.sensitivity, made.environment
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

import bayescal as bc
from bayescal_models.differential_pair.disturbance import departures, shared, warming

Array = NDArray[np.float64]

G = 1e6  # µg
RADIUS = 1.0  # m, of the arm (ours)
GRAVITY = 9.80665  # m/s²
FINE = 10  # steps of the world in each reading
PROFILES = ("steps", "plateau")
HIDDEN = (
    "environment.temperature",
    "scale.second_order",
    "misalignment.device",
    "input.radius",
    "timing.skew",
    "bias.drift",
    "bias.device",
)


@dataclass(frozen=True)
class Campaign:
    """The plan of a test and the population that its devices come from.

    Attributes:
        outer, inner: number of devices in each group.
        duration: of the record, s.
        samples: readings of each device, each an average over duration/samples.
        profile: "steps", through `levels` with ramps between them; "plateau", at `level` throughout.
        levels: plateaus, g; up and down, or a slow disturbance looks like a wrong scale factor.
        level: of the one plateau, g.
        ramp: time of a change of level, s; the speed of the arm changes smoothly.
        disturbance: rms of u over the record, µg.
        sensitivity_spread: standard deviation of λd over devices.
        departure: rms of a device's own environment, in parts of `disturbance`.
        scale_spread: standard deviation of the scale factors, ppm.
        noise: white, of an output averaged over 1 s, µg; a reading, averaged over τ seconds, has noise/√τ.
        warming: rise of the fixture's temperature, °C.
        thermometer: noise of the thermometer, °C; None leaves the column out.
        alike: devices identical but for noise: λd = 1, no departures, one scale factor.
    """

    outer: int = 3
    inner: int = 3
    duration: float = 600.0
    samples: int = 40
    profile: str = "steps"
    levels: tuple[float, ...] = (2.0, 10.0, 4.0, 8.0, 1.0, 6.0)
    level: float = 5.0
    ramp: float = 40.0
    disturbance: float = 1000.0
    sensitivity_spread: float = 0.2
    departure: float = 0.05
    scale_spread: float = 2000.0
    noise: float = 100.0
    warming: float = 5.0
    thermometer: float | None = 0.05
    alike: bool = False

    def __post_init__(self) -> None:
        """Refuse a plan that cannot be carried out.

        Raises:
            ValueError: no device in a group, fewer than 8 readings, an unknown profile, or ramps longer than
                the plateaus.
        """
        if self.outer < 1 or self.inner < 1:
            raise ValueError(
                f"Campaign(outer={self.outer}, inner={self.inner}): each group needs a device"
            )
        if self.samples < 8:
            raise ValueError(f"Campaign(samples={self.samples}): give at least 8 readings")
        if self.profile not in PROFILES:
            raise ValueError(f"Campaign(profile={self.profile!r}): choose {' or '.join(PROFILES)}")
        if self.ramp * len(self.levels) >= self.duration:
            raise ValueError(
                f"Campaign(ramp={self.ramp:g} s): {len(self.levels)} levels in {self.duration:g} s leave "
                "no plateau; shorten the ramps"
            )

    @property
    def time(self) -> Array:
        """Middles of the readings, s."""
        return (np.arange(self.samples) + 0.5) * self.duration / self.samples


@dataclass(frozen=True)
class SimulatedBatch:
    """Readings of a batch and the truth behind them; devices in the order outer, inner.

    Attributes:
        readings: measurements of all devices.
        names: of the devices.
        outer: number of outer devices.
        scale: 1 + κ of each device, (K,).
        sensitivity: λd of each device, (K,).
        environment: λd·u + v of each device, averaged as the readings are, µg, (K, T).
        acceleration: commanded, µg, (T,).
        seed: of every random number.
    """

    readings: bc.Measurements = field(repr=False)
    names: tuple[str, ...]
    outer: int
    scale: Array
    sensitivity: Array
    environment: Array
    acceleration: Array
    seed: int


def simulate(
    effects: Mapping[str, float] | None = None,
    *,
    seed: int,
    campaign: Campaign | None = None,
    noise_law: str = "white",
) -> bc.Measurements:
    """Readings of a batch with these effects hidden in it.

    Args:
        effects: canonical name → true size in the coefficient's unit: for effects with one coefficient a device
            the standard deviation over devices, else the coefficient.
        seed: of every random number; the same seed gives the same devices, disturbance and noise whatever the
            effects and the profile.
        campaign: the plan; `Campaign()` if not given.
        noise_law: "white"; there is no other here.

    Raises:
        ValueError: an unknown effect, a size that is not finite, or another noise law.
    """
    if noise_law != "white":
        raise ValueError(f"noise law {noise_law!r} is not simulated for these devices: take white")
    return simulate_batch(effects, seed=seed, campaign=campaign).readings


def simulate_batch(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> SimulatedBatch:
    """The same, with the truth.

    Raises:
        ValueError: an unknown effect, or a size that is not finite.
    """
    plan, sizes = campaign or Campaign(), dict(effects or {})
    _check(sizes)
    count = plan.outer + plan.inner
    seeds = np.random.SeedSequence(seed).spawn(6)
    devices, environment, own, hidden, noise, thermometer = map(np.random.default_rng, seeds)
    fine = (np.arange(plan.samples * FINE) + 0.5) * plan.duration / (plan.samples * FINE)

    sensitivity = 1.0 + plan.sensitivity_spread * devices.standard_normal(count)
    scale = 1.0 + 1e-6 * plan.scale_spread * devices.standard_normal(count)
    u = plan.disturbance * shared(environment, fine / plan.duration)
    v = plan.departure * plan.disturbance * departures(own, fine / plan.duration, count)
    if plan.alike:
        sensitivity, scale, v = np.ones(count), np.ones(count), 0.0 * v
    temperature = 25.0 + plan.warming * warming(fine / plan.duration)
    u = u + sizes.get("environment.temperature", 0.0) * (temperature - temperature.mean())
    env = sensitivity[:, None] * u + v
    sign = np.repeat([1.0, -1.0], [plan.outer, plan.inner])
    own_sizes = {name: hidden.standard_normal(count) for name in HIDDEN}
    drawn = {name: sizes.get(name, 0.0) * z for name, z in own_sizes.items()}
    made = _outputs(plan, fine, sign, scale, drawn) + env
    scatter = plan.noise / np.sqrt(plan.duration / plan.samples)
    readings = average(made) + scatter * noise.standard_normal((count, plan.samples))
    names = (
        *(f"outer {i + 1}" for i in range(plan.outer)),
        *(f"inner {i + 1}" for i in range(plan.inner)),
    )
    commanded = average(acceleration(plan, fine))
    measured = None
    if plan.thermometer is not None:
        error = plan.thermometer * thermometer.standard_normal(plan.samples)
        measured = average(temperature) + error
    table = _measurements(plan, names, commanded, measured, readings)
    return SimulatedBatch(
        table, names, plan.outer, scale, sensitivity, average(env), commanded, seed
    )


def acceleration(plan: Campaign, time: Array) -> Array:
    """Acceleration at the devices' radius, µg: the arm's speed goes smoothly from plateau to plateau."""
    if plan.profile == "plateau":
        return np.full(np.shape(time), plan.level * G)
    speeds = np.sqrt(np.asarray(plan.levels))
    edges = plan.duration * np.arange(1, len(speeds)) / len(speeds)
    speed = np.full(np.shape(time), speeds[0])
    for edge, rise in zip(edges, np.diff(speeds), strict=True):
        share = np.clip((time - edge) / plan.ramp + 0.5, 0.0, 1.0)
        speed = speed + rise * 0.5 * (1.0 - np.cos(np.pi * share))
    return speed**2 * G


def average(values: Array) -> Array:
    """Readings from the fine grid, along the last axis."""
    return values.reshape(*values.shape[:-1], -1, FINE).mean(axis=-1)


def _outputs(
    plan: Campaign, fine: Array, sign: Array, scale: Array, drawn: Mapping[str, Array]
) -> Array:
    """What the devices read without environment and noise, µg, (K, fine)."""
    late = fine[None, :] - 1e-3 * drawn["timing.skew"][:, None]
    seen = acceleration(plan, late) * (1.0 + 1e-6 * drawn["input.radius"][:, None])
    seen = sign[:, None] * seen
    # A spring that softens with its deflection: K2 and, far below it, a third order.
    softening = 1e-6 * drawn["scale.second_order"][:, None] * seen / G
    output = scale[:, None] * seen / (1.0 - softening)
    step = 1e-3  # s, of the derivative of the arm's speed
    ends = [np.sqrt(acceleration(plan, fine + d) / G * GRAVITY / RADIUS) for d in (-step, step)]
    tangential = RADIUS * (ends[1] - ends[0]) / (2 * step) / GRAVITY * G
    tilt = np.sin(1e-3 * drawn["misalignment.device"])[:, None]
    ageing = np.log2(1.0 + fine / plan.duration)
    drift = drawn["bias.drift"][:, None] * (ageing - ageing.mean())
    return output + tilt * (G + tangential) + drift + drawn["bias.device"][:, None]


def _measurements(
    plan: Campaign,
    names: tuple[str, ...],
    commanded: Array,
    temperature: Array | None,
    readings: Array,
) -> bc.Measurements:
    """One record after another, as a logger's file would have them."""
    from bayescal_models.differential_pair.model import INSTRUMENT  # it holds this simulator

    count = len(names)
    thermal = {} if temperature is None else {"temperature": np.tile(temperature, count)}
    return bc.Measurements.from_arrays(
        INSTRUMENT,
        device=np.repeat(names, plan.samples),
        group=np.repeat(["outer", "inner"], [plan.outer * plan.samples, plan.inner * plan.samples]),
        time=np.tile(plan.time, count),
        acceleration=np.tile(commanded, count),
        output=readings.ravel(),
        **thermal,
    )


def _check(effects: Mapping[str, float]) -> None:
    for name, size in effects.items():
        if name not in HIDDEN:
            raise ValueError(
                f"no effect {name!r} can be hidden in a batch: choose among {', '.join(HIDDEN)}"
            )
        if not np.isfinite(size):
            raise ValueError(f"the size of {name!r} is {size!r}: give a finite number")
