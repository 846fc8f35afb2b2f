"""Columns of simulated records of a sensor at rest on temperature ramps, with effects hidden in them.

The world (`campaign.py`) is made second by second and logged every ten; effects are laws of the true temperature and
its true rate (the catalogue's rate is an estimate from the readings before).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bayescal_models.simulated import correlated, refuse_effects
from bayescal_models.still_sensor.campaign import PAUSE, World, make_world

NOISE_LAWS = ("white", "ornstein_uhlenbeck")
BASELINE = {"bias.constant": 2000.0, "bias.temperature": 40.0}
NOISE = 20.0  # standard deviation of white noise, and of the wander beside it, output unit
WARM_UP_TIME, WANDER_TIME = 600.0, 300.0  # s

_LAWS: dict[str, Callable[[World], np.ndarray]] = {
    "bias.constant": lambda w: np.ones_like(w.time),
    "bias.temperature": lambda w: w.departure,
    "bias.temperature_quadratic": lambda w: w.departure**2,
    "bias.temperature_cubic": lambda w: w.departure**3,
    "bias.temperature_quartic": lambda w: w.departure**4,
    "bias.rate": lambda w: w.rate,
    "bias.thermal_lag": lambda w: w.behind,
    "bias.thermal_lag_slow": lambda w: w.far_behind,
    "bias.temperature_x_lag": lambda w: w.departure * w.behind,
    "bias.hysteresis": lambda w: w.direction,
    "bias.warm_up": lambda w: np.exp(-w.time / WARM_UP_TIME),
    "bias.drift": lambda w: w.progress,
    "bias.run": lambda w: w.turn_on + np.zeros_like(w.time),
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
    """Columns of ramps with these effects hidden in them, by name.

    Args and Raises: as of `simulate` in `model.py`.
    """
    sizes = {**BASELINE, **(effects or {})}
    refuse_effects(sizes, _LAWS, "a sensor at rest")
    if noise_law not in NOISE_LAWS:
        raise ValueError(f"noise law {noise_law!r} is not one of {', '.join(NOISE_LAWS)}")
    if runs < 1 or interval < 1:
        raise ValueError(f"runs={runs} and interval={interval} s must be at least 1")
    rng = np.random.default_rng(seed)
    temperature, world = make_world(runs, rng.standard_normal(runs))
    parts = (size * _LAWS[name](world) for name, size in sizes.items())
    true = sum(parts, start=np.zeros_like(world.time))
    scatter = NOISE * rng.standard_normal(true.shape)
    if noise_law == "ornstein_uhlenbeck":
        scatter += NOISE * correlated(rng, true.shape, WANDER_TIME, 1.0)
    logged = slice(0, None, interval)
    start = np.arange(runs)[:, None] * (world.time[0, -1] + PAUSE)
    labels = np.repeat(np.arange(1, runs + 1), world.time[0, logged].size).astype(str)
    return {
        "run": labels,
        "time": (start + world.time)[:, logged].ravel(),
        "temperature": temperature[:, logged].ravel(),
        f"output [{unit}]": (true + scatter)[:, logged].ravel(),
    }
