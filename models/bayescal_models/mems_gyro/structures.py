"""Model structures of the zero rate over temperature: line, polynomials, resonance.

The resonance law follows source 1: silicon softens as E0·(1 − K_ET·(T−T0)), so both modes of the gyro detune,
and the zero-rate offset carries the resonance denominator

    D = √[ (r²·(1−ε_s) − (1−ε_d))² + (1−ε_d)/Q² ],   ε = K_ET·(T−T0) of each mode,  r = ω_s0/ω_d0,

as rate = c0 + q·(D(T0)/D(T) − 1). (Written so that c0 is the zero rate at T0; the document's c0 + q·D(T0)/D(T)
has the same curves.) A second form holds the drive force instead of the amplitude, with a factor (1−ε_d)^−½.
"""

from __future__ import annotations

import jax.numpy as jnp

import bayescal as bc

SOURCE = "source 1; values of K_ET, r and Q ours"


def _denominator(change, k_drive, k_sense, ratio, quality):
    drive, sense = 1 - k_drive * change, 1 - k_sense * change
    return jnp.sqrt((ratio**2 * sense - drive) ** 2 + drive / quality**2)


def _held_amplitude(r, k_drive, k_sense, ratio, quality):
    change = r.centred()
    here = _denominator(change, k_drive, k_sense, ratio, quality)
    return _denominator(0.0, k_drive, k_sense, ratio, quality) / here - 1


def _held_force(r, k_drive, k_sense, ratio, quality):
    softening = 1 / jnp.sqrt(1 - k_drive * r.centred())
    return (1 + _held_amplitude(r, k_drive, k_sense, ratio, quality)) * softening - 1


def _resonance(name: str, basis, equation: str) -> bc.Effect:
    return bc.Effect(
        name,
        "bias",
        basis=basis,
        coefficients=(bc.Coefficient("deg/s", bc.Normal(0.0, 500.0)),),
        shapes=(
            bc.Shape("k_drive", "1/degC", 6e-5, 1e-4),
            bc.Shape("k_sense", "1/degC", 6e-5, 1e-4),
            bc.Shape("ratio", "1", 1.01, 1.10, scale="linear"),
            bc.Shape("quality", "1", 300.0, 30000.0),
        ),
        columns=("temperature",),
        varies=("temperature",),
        equation=equation,
        source=SOURCE,
    )


RESONANCE = _resonance(
    "bias.resonance", _held_amplitude, "q·(D(T0)/D(T) − 1), drive amplitude held"
)
RESONANCE_FORCE = _resonance(
    "bias.resonance_force", _held_force, "q·((1−ε_d)^−½·D(T0)/D(T) − 1), drive force held"
)
