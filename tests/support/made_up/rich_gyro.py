"""A gyro model with everything in it that bends, bound to readings: what the tests of composition share."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import bayescal as bc
from bayescal._model import forward
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import bind
from bayescal_models.mems_gyro import INSTRUMENT
from bayescal_models.mems_gyro.model import THERMOMETER

# A model with everything in it that bends: a corrected column, a square, a lag, a scale factor, groups.
RICH = INSTRUMENT.baseline() + [
    "bias.temperature_quadratic",
    "bias.thermal_lag",
    "scale.constant",
    "scale.temperature",
    "bias.run",
    THERMOMETER,
]


def readings(rows: int = 14, seed: int = 5, **more: Any) -> bc.Measurements:
    """Two runs over temperature on a rate table, irregular in time."""
    rng = np.random.default_rng(seed)
    half = rows // 2
    time = np.cumsum(rng.uniform(20.0, 400.0, rows)) + np.repeat([0.0, 3000.0], half)
    columns = {
        "run": np.repeat(["up", "down"], half),
        "time": time,
        "temperature": 50 + 20 * np.sin(time / 900.0) + rng.normal(0.0, 1.0, rows),
        "rate_input": rng.uniform(-100.0, 100.0, rows),
        "output": rng.normal(0.0, 1.0, rows),
        **more,
    }
    return bc.Measurements.from_arrays(INSTRUMENT, **columns)


def bound(model: bc.Model, data: bc.Measurements) -> SimpleNamespace:
    """A model bound to readings, a random point of all its unknowns, and an output drawn there."""
    layout, _ = bind(model, data)
    frame = build_frame(data, reference_of(data))
    rng = np.random.default_rng(8)
    v = jnp.asarray(rng.normal(0.0, 0.5, len(layout.hypers)))
    hyper = forward.hyper_values(layout, v)
    sd = forward.prior_sd(layout, hyper)
    x = forward.prior_mean(layout) + sd * rng.normal(size=layout.size)
    y = forward.draw_readings(layout, frame, x, v, jax.random.key(8))
    return SimpleNamespace(layout=layout, frame=frame, x=x, v=v, hyper=hyper, y=y)
