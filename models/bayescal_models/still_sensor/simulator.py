"""Simulator of records of a sensor at rest on temperature ramps, with hidden effects.

The test is simulated second by second and logged every ten; effects are laws of the true temperature and
its true rate (the catalogue's rate is an estimate from the preceding readings).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bayescal_models.simulated import (
    SUPPLY,
    correlated,
    first_order_body,
    refuse,
    refuse_effects,
    supplied,
    wandering_supply,
)

RAMPS = ((0.0, 25.0), (10.0, -15.0), (25.0, 65.0), (40.0, 25.0))  # min, °C: cooled, heated, cooled
PAUSE = 3600.0  # s between runs
CHAMBER_TIME, LAG_TIME, SLOW_TIME = 60.0, 300.0, 2400.0  # s
REVERSAL_TIME = 30.0  # s, in which hysteresis follows a change of direction
WARM_UP_TIME, WANDER_TIME = 600.0, 300.0  # s
NOISE_LAWS = ("white", "ornstein_uhlenbeck")
BASELINE = {"bias.constant": 2000.0, "bias.temperature": 40.0}
NOISE = 20.0  # standard deviation of white noise, and of the wander beside it, output unit


class World:
    """True conditions second by second, in a chamber whose air follows its ramps with a lag.

    Attributes:
        second: time within a run, s, (m,).
        ambient: T, °C, (m,), the same in every run.
        departure: T − T0, °C, T0 the mean rounded to 1 °C.
        start: start of each run, s, (runs, 1).
        turn_on: one standard normal number for each run, (runs, 1).
        supply: voltage of the supply, V, (runs, m).
    """

    def __init__(self, turn_on: np.ndarray, seed: int) -> None:
        minutes, goals = np.array(RAMPS).T
        self.second = np.arange(60.0 * minutes[-1] + 1)
        self.ambient = self.body(np.interp(self.second, 60 * minutes, goals), CHAMBER_TIME)
        self.departure = self.ambient - round(float(self.ambient.mean()))
        self.start = np.arange(len(turn_on))[:, None] * (self.second[-1] + PAUSE)
        self.turn_on = turn_on[:, None]
        self.supply = wandering_supply(np.random.default_rng([seed, 1]), self.start + self.second)

    def body(self, drive: np.ndarray, time_constant: float) -> np.ndarray:
        return first_order_body(drive, time_constant, 1.0)

    @property
    def rate(self) -> np.ndarray:
        """Return dT/dt, °C/min."""
        return 60 * np.gradient(self.ambient)

    @property
    def behind(self) -> np.ndarray:
        """Return T̃ − T of a first-order body, °C."""
        return self.body(self.ambient, LAG_TIME) - self.ambient

    @property
    def progress(self) -> np.ndarray:
        """Return (t − t̄)/(tmax − tmin) over all runs, (runs, m)."""
        elapsed = self.start + self.second
        return (elapsed - elapsed.mean()) / np.ptp(elapsed)


_LAWS: dict[str, Callable[[World], np.ndarray]] = {
    "bias.constant": lambda w: np.ones_like(w.second),
    "bias.temperature": lambda w: w.departure,
    "bias.temperature_quadratic": lambda w: w.departure**2,
    "bias.temperature_cubic": lambda w: w.departure**3,
    "bias.temperature_quartic": lambda w: w.departure**4,
    "bias.rate": lambda w: w.rate,
    "bias.thermal_lag": lambda w: w.behind,
    "bias.thermal_lag_slow": lambda w: w.body(w.ambient, SLOW_TIME) - w.ambient,
    "bias.temperature_x_lag": lambda w: w.departure * w.behind,
    # the sign of the rate, with a lag
    "bias.hysteresis": lambda w: w.body(np.sign(w.rate), REVERSAL_TIME),
    "bias.warm_up": lambda w: np.exp(-w.second / WARM_UP_TIME),
    "bias.drift": lambda w: w.progress,
    "bias.run": lambda w: w.turn_on,
    "bias.supply": lambda w: w.supply - SUPPLY,
    "bias.temperature_x_supply": lambda w: w.departure * (w.supply - SUPPLY),
}


def simulated_columns(
    effects: Mapping[str, float] | None = None,
    *,
    seed: int,
    unit: str = "ug",
    runs: int = 3,
    interval: int = 10,
    noise_law: str = "white",
) -> dict[str, Any]:
    """Simulate ramps, 25 → −15 → 65 → 25 °C in 40 minutes, with hidden effects; return columns by name.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficient. The line is
            there (2000 and 40 per °C) unless given otherwise.
        seed: seed of every random number.
        unit: of the output; sizes and noise (20) are in it.
        runs: number of repetitions of the ramps, an hour apart.
        interval: time between readings, s.
        noise_law: "white" or "ornstein_uhlenbeck" (correlation time 300 s, plus white noise).

    Raises:
        ValueError: an unknown effect or noise law.
    """
    sizes = {**BASELINE, **(effects or {})}
    refuse_effects(sizes, _LAWS, "a sensor at rest")
    laws = ", ".join(NOISE_LAWS)
    refuse(noise_law not in NOISE_LAWS, f"noise law {noise_law!r} is not one of {laws}")
    rng = np.random.default_rng(seed)
    world = World(rng.standard_normal(runs), seed)
    shape = (runs, world.second.size)
    parts = (size * _LAWS[name](world) for name, size in sizes.items())
    true = sum(parts, start=np.zeros(shape))
    scatter = NOISE * rng.standard_normal(shape)
    if noise_law == "ornstein_uhlenbeck":
        scatter += NOISE * correlated(rng, shape, WANDER_TIME, 1.0)
    logged = slice(0, None, interval)
    count = world.second[logged].size
    columns = {
        "run": np.repeat(np.arange(1, runs + 1), count).astype(str),
        "time": (world.start + world.second)[:, logged].ravel(),
        "temperature": np.tile(world.ambient[logged], runs),
        f"output [{unit}]": (true + scatter)[:, logged].ravel(),
    }
    if supplied(sizes):
        columns["supply_voltage"] = world.supply[:, logged].ravel()
    return columns
