"""Simulator of tumble tests on a dividing head with hidden effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from bayescal_models.accelerometer_dividing_head.campaign import Campaign
from bayescal_models.simulated import (
    MINUTE,
    Array,
    SimulatedTest,
    column_simulator,
    spawn_generators,
    validate_effects,
)

G = 1e6  # µg
BASELINE = {
    "bias.constant": 1500.0,
    "bias.temperature": 12.0,
    "scale.constant": 3000.0,
    "scale.temperature": 110.0,
    "zero.constant": 800.0,
}
WARM_UP_S = 20 * MINUTE  # s, time constant of the warm-up


class Conditions:
    """Conditions at each reading, (n,); the laws depend on the measured temperature.

    Attributes:
        angle: set angle θ, rad.
        time, run_time: time since the start of the test and since the start of the run, s.
        temperature: measured temperature T of the device, °C.
        departure: T − T0, °C, with T0 the mean of T rounded to 1 °C.
        run: run index, from 0.
        run_deviates: slot → standard normal deviates, constant within a run.
        approach_sign: +1 if the temperature was reached from below, −1 from above, 0 at the first set point.
    """

    def __init__(self, campaign: Campaign, generators: Mapping[str, np.random.Generator]) -> None:
        c, soak_count = campaign, len(campaign.temperatures)
        duration = c.soak + c.positions * c.dwell
        row_index, self.run = np.meshgrid(np.arange(soak_count * c.positions), np.arange(c.runs))
        self.run, row_index = self.run.ravel(), row_index.ravel()
        soak_index, position_index = row_index // c.positions, row_index % c.positions
        self.run_time = soak_index * duration + c.soak + position_index * c.dwell
        self.time = self.run * (soak_count * duration + 24 * 3600.0) + self.run_time
        self.angle = 2 * np.pi * position_index / c.positions
        set_points = np.array(c.temperatures)
        noise = c.thermometer_noise * generators["temperature"].standard_normal(len(row_index))
        self.temperature = set_points[soak_index] + noise
        self.departure = self.temperature - round(float(self.temperature.mean()))
        self.approach_sign = np.sign(np.diff(set_points, prepend=set_points[:1]))[soak_index]
        self.run_deviates = {
            name: generators["runs"].standard_normal(c.runs)[self.run]
            for name in ("bias", "scale", "zero")
        }

    @property
    def progress(self) -> Array:
        return (self.time - self.time.mean()) / np.ptp(self.time)


Law = tuple[str, Callable[[Conditions], Array]]  # slot, and contribution of one unit of the effect
LAWS: dict[str, Law] = {
    "bias.constant": ("bias", lambda test: np.ones_like(test.time)),
    "bias.temperature": ("bias", lambda test: test.departure),
    "bias.temperature_quadratic": ("bias", lambda test: test.departure**2),
    "bias.hysteresis": ("bias", lambda test: test.approach_sign),
    "bias.warm_up": ("bias", lambda test: np.exp(-test.run_time / WARM_UP_S)),
    "bias.drift": ("bias", lambda test: test.progress),
    "bias.run": ("bias", lambda test: test.run_deviates["bias"]),
    "scale.constant": ("scale", lambda test: 1e-6 * np.ones_like(test.time)),
    "scale.temperature": ("scale", lambda test: 1e-6 * test.departure),
    "scale.temperature_quadratic": ("scale", lambda test: 1e-6 * test.departure**2),
    "scale.run": ("scale", lambda test: 1e-6 * test.run_deviates["scale"]),
    "zero.constant": ("zero", lambda test: 1e-6 * np.ones_like(test.time)),
    "zero.temperature": ("zero", lambda test: 1e-6 * test.departure),
    "zero.run": ("zero", lambda test: 1e-6 * test.run_deviates["zero"]),
    "zero.harmonic": ("zero", lambda test: 1e-6 * np.cos(test.angle)),
    "second_order.constant": ("second_order", lambda test: np.ones_like(test.time)),
    "second_order.temperature": ("second_order", lambda test: test.departure),
    "third_order.constant": ("third_order", lambda test: np.ones_like(test.time)),
    "cross_coupling.constant": ("cross_coupling", lambda test: np.ones_like(test.time)),
}


def simulate_arrays(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> SimulatedTest:
    """Simulate a tumble test with hidden effects.

    Args:
        effects: canonical name → true size in the unit of the effect's coefficient; of random effects the standard
            deviation. Baseline effects have the sizes in `BASELINE` unless given here.
        seed: seed of the random-number generator.
        campaign: plan of the test; None: `Campaign()`.

    Raises:
        ValueError: an unknown effect, or a size that is not finite.
    """
    plan, sizes = campaign or Campaign(), {**BASELINE, **(effects or {})}
    validate_effects(sizes, LAWS, "a tumble on a dividing head")
    generators = spawn_generators(("temperature", "runs", "noise"), seed)
    test = Conditions(plan, generators)
    slots = dict.fromkeys(
        ("bias", "scale", "zero", "second_order", "third_order", "cross_coupling"), 0.0
    )
    contributions = {name: size * LAWS[name][1](test) for name, size in sizes.items()}
    for name, contribution in contributions.items():
        slots[LAWS[name][0]] = slots[LAWS[name][0]] + contribution
    a, p = np.sin(test.angle + slots["zero"]), np.cos(test.angle + slots["zero"])
    powers = slots["second_order"] * a**2 + slots["third_order"] * a**3
    signal = slots["bias"] + (1 + slots["scale"]) * G * a + powers + slots["cross_coupling"] * a * p
    columns = {
        "run": np.array([f"{k + 1}" for k in test.run]),
        "time": test.time,
        "temperature": test.temperature,
        "position_angle": test.angle,
        "output": signal + plan.noise * generators["noise"].standard_normal(len(signal)),
    }
    return SimulatedTest(columns, test, contributions, signal)


simulate_columns = column_simulator(simulate_arrays)
