"""Hysteresis of the bias: the direction of the last change of temperature, and whether readings can show it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import bayescal as bc
from bayescal_models.ng_accelerometer.sizes import SIZES

DEAD_BAND = 1.0  # °C: a chamber that holds its temperature wanders by 0.1 °C (source 0)


def direction(r: bc.Frame) -> Float[Array, "n"]:
    """Sign of the last change of temperature within the run, 0 before the first.

    A change is one by more than the dead band from where the temperature last stood: between readings at soaked
    temperature points this is the sign of (this cell − previous cell).
    """
    temperature, first = r.record["temperature"][r.order], r.step < 0

    def advance(state, row):
        stood, sign = state
        now, begins = row
        moved = jnp.abs(now - stood) > DEAD_BAND
        sign = jnp.where(begins, 0.0, jnp.where(moved, jnp.sign(now - stood), sign))
        return (jnp.where(begins | moved, now, stood), sign), sign

    start = (temperature[0], jnp.zeros(()))
    _, signs = jax.lax.scan(advance, start, (temperature, first))
    return jnp.zeros_like(signs).at[r.order].set(signs)


def one_direction(readings: bc.Measurements) -> str | None:
    """Why readings do not show hysteresis: their temperature never rises, or never falls."""
    rises = falls = False
    _, run = readings.groups("run")
    for k in np.unique(run):
        path = readings["temperature"][run == k][np.argsort(readings["time"][run == k])]
        stood = path[0]
        for now in path:
            if abs(now - stood) > DEAD_BAND:
                rises, falls = rises or now > stood, falls or now < stood
                stood = now
    if rises and falls:
        return None
    seen = "only rises" if rises else "only falls" if falls else "stands still"
    return f"needs temperature to rise and to fall within runs, by over {DEAD_BAND:g} °C; it {seen}"


def hysteresis(source: str) -> bc.Effect:
    """`bias.hysteresis`, with the source of its equation."""
    size, unit = SIZES["bias.hysteresis"]
    return bc.Effect(
        "bias.hysteresis",
        "bias",
        basis=direction,
        coefficients=(bc.Coefficient(unit, bc.Normal(0.0, size)),),
        columns=("time", "temperature"),
        varies=("temperature",),
        untestable=one_direction,
        equation=f"c·sign(T − T of the previous cell),  0 in the first; dead band {DEAD_BAND:g} °C",
        source=source,
    )
