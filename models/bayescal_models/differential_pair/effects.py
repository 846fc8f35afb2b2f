"""Effects of single devices on the arm: candidates beside the shared environment (`environment.py`)."""

from __future__ import annotations

from typing import Any

import bayescal as bc
from bayescal import effects
from bayescal_models.differential_pair.campaign import GRAVITY, RADIUS, G
from bayescal_models.differential_pair.environment import DEPARTURE, SHARED
from bayescal_models.terms import one, progress, term

SOURCE = "source 3; size ours"


def slope(r: bc.Frame, values: Any) -> Any:
    """Time derivative of a column within each record, the mean of the differences to both neighbours, unit/s."""
    return difference(r, values, r.step)


def difference(r: bc.Frame, values: Any, over: Any = 1.0) -> Any:
    """Mean of the differences of a column to both neighbours in its record, each divided by `over`."""
    import jax.numpy as jnp  # JAX loads when something computes

    ordered = values[r.order]
    inside = r.step > 0
    back = jnp.where(inside, jnp.diff(ordered, prepend=ordered[:1]), 0.0)
    back = back / jnp.where(inside, over, 1.0)
    ahead = jnp.append(back[1:], 0.0)
    also = jnp.append(inside[1:], False)
    sides = inside.astype(float) + also.astype(float)
    mean = (back + jnp.where(also, ahead, 0.0)) / jnp.maximum(sides, 1.0)
    return jnp.zeros_like(mean).at[r.order].set(mean)


def direction(r: bc.Frame) -> Any:
    """+1 for the outer group, −1 for the inner."""
    return r.has_label("group", "outer") - r.has_label("group", "inner")


def tangential(r: bc.Frame) -> Any:
    """r·dΩ/dt from the commanded acceleration, µg."""
    import jax.numpy as jnp

    speed = jnp.sqrt(jnp.maximum(r["acceleration"], 1e-6) * (RADIUS * G / GRAVITY))
    return slope(r, speed)  # r·Ω in units such that its derivative is in µg


def _softening(r: bc.Frame) -> Any:
    """What a spring that softens with its deflection adds to a scale: x/(1 − kx) = x + kx² + k²x³ + …"""
    import jax.numpy as jnp

    outward = direction(r) * r["acceleration"]
    # Of a reading, which is a mean, k·⟨a²⟩ = k·(⟨a⟩² + var a): the variance within it goes with the change squared, by
    # a share that hangs on how long a reading is.
    change = difference(r, r["acceleration"])
    within = direction(r) * change**2 / (12.0 * jnp.maximum(r["acceleration"], 1.0))
    return jnp.stack([outward, outward**2, within], axis=1)


def _as_scale(readings: bc.Measurements) -> str:
    return (
        "is the same thing as scale.device: on an arm, a device at another radius reads as one of another "
        "scale factor. Measure the radii, or swap devices between places"
    )


def _device(
    name: str, size: float, unit: str, equation: str, *columns: str, basis=one, **more: Any
) -> bc.Effect:
    """An effect with one coefficient for each device, their spread learned; where they do, accelerations must vary."""
    return term(
        name,
        basis,
        size,
        unit,
        per="device",
        group_sd=bc.HalfNormal,
        columns=("device", *columns),
        equation=equation,
        source=SOURCE,
        **{"varies": ("acceleration",), **more},
    )


BIAS = effects.deviation("bias", "device", 10000.0, "ug", source=SOURCE)

# Third order beside second: at 10 g that of 650 ppm/g is 40 ppm of the scale factor, four times its uncertainty, and
# too little to be found by itself. K2' is K2 by the square of a reading's length over the time between two.
SECOND_ORDER = bc.Effect(
    "scale.second_order",
    "scale",
    _softening,
    coefficients=tuple(
        bc.Coefficient(unit, bc.Normal(0.0, size), part, None, "device", bc.HalfNormal(size))
        for part, unit, size in (
            ("", "ppm/g", 1000.0),
            ("third", "ppm/g^2", 1.0),
            ("within", "ppm/g", 1000.0),
        )
    ),
    columns=("device", "group", "time", "acceleration"),
    varies=("acceleration",),
    equation="K2[device]·s·a + K3[device]·a² + K2'[device]·s·var(a)/a in the scale, var(a) within a reading",
    source=SOURCE,
)

BASELINE = (
    effects.deviation("scale", "device", 5000.0, "ppm", source=SOURCE),
    SHARED,
    DEPARTURE,
)
CANDIDATES = (
    effects.linear("environment", 100.0, "ug/degC", source=SOURCE),
    SECOND_ORDER,
    _device(
        "misalignment.device",
        5.0,
        "mrad",
        "ε[device]·(g + r·dΩ/dt)",
        *("time", "acceleration"),
    ),
    _device(
        "input.radius",
        1e4,
        "ppm",
        "a·δr[device]/r",
        "acceleration",
        varies=(),
        untestable=_as_scale,
    ),
    _device("timing.skew", 10.0, "ms", "−δ[device]·da/dt", "time", "acceleration"),
    _device(
        "bias.drift",
        100.0,
        "ug",
        "d[device]·(t − t̄)/(tmax − tmin)",
        "time",
        basis=progress,
        varies=(),
    ),
    BIAS,
)
