"""Simulator of tumble tests on a dividing head with hidden effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from bayescal_models.accelerometer_dividing_head.campaign import Campaign
from bayescal_models.simulated import (
    MINUTE,
    Array,
    Simulated,
    columns_of,
    generators,
    refuse_effects,
)

G = 1e6  # µg
BASELINE = {
    "bias.constant": 1500.0,
    "bias.temperature": 12.0,
    "scale.constant": 3000.0,
    "scale.temperature": 110.0,
    "zero.constant": 800.0,
}
WARM_UP_TIME = 20 * MINUTE


class World:
    """True quantities at each reading (n,).

    Attributes:
        angle: set angle θ, rad.
        time: s; `since` the start of its run.
        temperature: device temperature, °C; `departure`: the same minus T0, the mean rounded to 1 °C.
        run: index of the run, from 0; `differs`: a standard normal number per run, by slot.
        sweep: +1 if the temperature was reached from below, −1 from above, 0 at first.
    """

    def __init__(self, campaign: Campaign, random: Mapping[str, np.random.Generator]) -> None:
        c, count = campaign, len(campaign.temperatures)
        duration = c.soak + c.positions * c.dwell
        place, self.run = np.meshgrid(np.arange(count * c.positions), np.arange(c.runs))
        self.run, place = self.run.ravel(), place.ravel()
        soak, position = place // c.positions, place % c.positions
        self.since = soak * duration + c.soak + position * c.dwell
        self.time = self.run * (count * duration + 24 * 3600.0) + self.since
        self.angle = 2 * np.pi * position / c.positions
        set_points = np.array(c.temperatures)
        wander = c.thermometer_noise * random["temperature"].standard_normal(len(place))
        self.temperature = set_points[soak] + wander
        self.departure = self.temperature - round(float(self.temperature.mean()))
        self.sweep = np.sign(np.diff(set_points, prepend=set_points[:1]))[soak]
        self.differs = {
            name: random["runs"].standard_normal(c.runs)[self.run]
            for name in ("bias", "scale", "zero")
        }

    @property
    def progress(self) -> Array:
        return (self.time - self.time.mean()) / np.ptp(self.time)


Law = tuple[str, Callable[[World], Array]]  # slot, and contribution of one unit of the effect
LAWS: dict[str, Law] = {
    "bias.constant": ("bias", lambda w: np.ones_like(w.time)),
    "bias.temperature": ("bias", lambda w: w.departure),
    "bias.temperature_quadratic": ("bias", lambda w: w.departure**2),
    "bias.hysteresis": ("bias", lambda w: w.sweep),
    "bias.warm_up": ("bias", lambda w: np.exp(-w.since / WARM_UP_TIME)),
    "bias.drift": ("bias", lambda w: w.progress),
    "bias.run": ("bias", lambda w: w.differs["bias"]),
    "scale.constant": ("scale", lambda w: 1e-6 * np.ones_like(w.time)),
    "scale.temperature": ("scale", lambda w: 1e-6 * w.departure),
    "scale.temperature_quadratic": ("scale", lambda w: 1e-6 * w.departure**2),
    "scale.run": ("scale", lambda w: 1e-6 * w.differs["scale"]),
    "zero.constant": ("zero", lambda w: 1e-6 * np.ones_like(w.time)),
    "zero.temperature": ("zero", lambda w: 1e-6 * w.departure),
    "zero.run": ("zero", lambda w: 1e-6 * w.differs["zero"]),
    "zero.harmonic": ("zero", lambda w: 1e-6 * np.cos(w.angle)),
    "second_order.constant": ("second_order", lambda w: np.ones_like(w.time)),
    "second_order.temperature": ("second_order", lambda w: w.departure),
    "third_order.constant": ("third_order", lambda w: np.ones_like(w.time)),
    "cross_coupling.constant": ("cross_coupling", lambda w: np.ones_like(w.time)),
}


def simulated(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> Simulated:
    """Simulate a tumble with hidden effects.

    Args:
        effects: canonical name → true size in the unit of its coefficient; for a deviation the standard deviation. The
            baseline is there with sizes of its own unless given otherwise.
        seed: seed of the random-number generator.
        campaign: the plan; `Campaign()` if None.

    Raises:
        ValueError: an unknown effect.
    """
    plan, sizes = campaign or Campaign(), {**BASELINE, **(effects or {})}
    refuse_effects(sizes, LAWS, "a tumble on a dividing head")
    random = generators(("temperature", "runs", "noise"), seed)
    world = World(plan, random)
    slots = dict.fromkeys(
        ("bias", "scale", "zero", "second_order", "third_order", "cross_coupling"), 0.0
    )
    parts = {name: size * LAWS[name][1](world) for name, size in sizes.items()}
    for name, part in parts.items():
        slots[LAWS[name][0]] = slots[LAWS[name][0]] + part
    a, p = np.sin(world.angle + slots["zero"]), np.cos(world.angle + slots["zero"])
    powers = slots["second_order"] * a**2 + slots["third_order"] * a**3
    true = slots["bias"] + (1 + slots["scale"]) * G * a + powers + slots["cross_coupling"] * a * p
    columns = {
        "run": np.array([f"{k + 1}" for k in world.run]),
        "time": world.time,
        "temperature": world.temperature,
        "position_angle": world.angle,
        "output": true + plan.noise * random["noise"].standard_normal(len(true)),
    }
    return Simulated(columns, world, parts, true)


simulated_columns = columns_of(simulated)
