"""Effects of single devices on the arm: candidates beside the shared environment (`environment.py`)."""

from __future__ import annotations

import math
from typing import Any

import bayescal as bc
from bayescal import effects
from bayescal_models.differential_pair.campaign import GRAVITY, RADIUS, G
from bayescal_models.differential_pair.environment import DEPARTURE, SHARED
from bayescal_models.terms import one, progress, term

SOURCE = "source 3; size ours"
SPLINE = math.sqrt(3.0) - 2.0
REACH = 12  # neighbours to either side: the next one counts 10⁻⁷


def slope(r: bc.Frame, values: Any) -> Any:
    """Mean time derivative of a column within each reading, unit/s: its change over the reading, by how long that is.

    A reading lasts from half way to the one before it to half way to the next.
    """
    import jax.numpy as jnp  # JAX loads when something computes

    back = jnp.where(r.step > 0, r.step, 0.0)
    ahead = jnp.append(back[1:], 0.0)
    sides = (back > 0).astype(float) + (ahead > 0)
    lasts = jnp.zeros_like(back).at[r.order].set((back + ahead) / jnp.maximum(sides, 1.0))
    before, after = ends(r, values)
    return (after - before) / jnp.where(lasts > 0, lasts, 1.0)


def ends(r: bc.Frame, values: Any) -> tuple[Any, Any]:
    """A column at the beginning and at the end of each reading, where a reading is its mean over the time between.

    These are the slopes e of the cubic spline through the integral of the column, which the means give exactly: of a
    record of even steps eₖ₋₁ + 4·eₖ + eₖ₊₁ = 3·(mean before + mean after), so that e is a mean of neighbours' means
    with weights z^|j|, z = √3 − 2. Beyond its ends a record goes on as it stood there.
    Source: C. de Boor, A Practical Guide to Splines (1978), ch. VIII (area matching).
    """
    import jax
    import jax.numpy as jnp

    ordered, place = jnp.asarray(values)[r.order], jnp.arange(r.size)
    begins = r.step <= 0
    first = jax.lax.cummax(jnp.where(begins, place, 0))
    last = jax.lax.cummin(jnp.where(jnp.append(begins[1:], True), place, r.size - 1), reverse=True)

    def at(shift: int) -> Any:
        return ordered[jnp.clip(place + shift, first, last)]

    weights = {j: SPLINE ** abs(j) for j in range(-REACH, REACH + 1)}
    total = 2.0 * sum(weights.values())
    before = sum(w * (at(j - 1) + at(j)) for j, w in weights.items()) / total
    after = sum(w * (at(j) + at(j + 1)) for j, w in weights.items()) / total
    empty = jnp.zeros_like(ordered)
    return empty.at[r.order].set(before), empty.at[r.order].set(after)


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
    # Of a reading, which is a mean, k·⟨a²⟩ = k·(⟨a⟩² + var a). Between its ends a parabola of that mean has the
    # variance (a₁ − a₀)²/12 + (3·(a₁ + a₀) − 6·⟨a⟩)²/180; how long a reading is of its step is a share of it.
    before, after = ends(r, r["acceleration"])
    bend = 3.0 * (before + after - 2.0 * r["acceleration"])
    varies = (after - before) ** 2 / 12.0 + bend**2 / 180.0
    within = direction(r) * varies / jnp.maximum(r["acceleration"], 1.0)
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
