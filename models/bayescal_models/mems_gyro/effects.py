"""Effects of a MEMS gyro: those of its baseline, its candidates, and the resonance laws that stand in for the line.

The resonance law follows source 1: silicon softens as E0·(1 − K_ET·(T−T0)), so both modes of the gyro detune,
and the zero-rate offset carries the resonance denominator

    D = √[ (r²·(1−ε_s) − (1−ε_d))² + (1−ε_d)/Q² ],   ε = K_ET·(T−T0) of each mode,  r = ω_s0/ω_d0,

as rate = c0 + q·(D(T0)/D(T) − 1). (Written so that c0 is the zero rate at T0; the document's c0 + q·D(T0)/D(T)
has the same curves.) A second form holds the drive force instead of the amplitude, with a factor (1−ε_d)^−½.
"""

from __future__ import annotations

import jax.numpy as jnp

import bayescal as bc
from bayescal import effects
from bayescal_models.mems_gyro import THERMOMETER_SD
from bayescal_models.mems_gyro.laws import SIZES
from bayescal_models.terms import centred, one, term

SOURCE = "source 1; size ours"
RESONANCE_SOURCE = "source 1; values of K_ET, r and Q ours"
MINUTE = 60.0


def _board(r):
    return r.centred("board_temperature")


CONSTANT = effects.constant("bias", 50.0, "deg/s", source=SOURCE)
LINE = effects.linear("bias", *SIZES["bias.temperature"], source=SOURCE)
QUADRATIC = effects.quadratic("bias", *SIZES["bias.temperature_quadratic"], source=SOURCE)
CUBIC = effects.cubic("bias", *SIZES["bias.temperature_cubic"], source=SOURCE)
THERMOMETER = effects.thermometer(THERMOMETER_SD, source="source 1: thermometer good to 0.5 °C")


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
    shapes = (
        bc.Shape("k_drive", "1/degC", 6e-5, 1e-4),
        bc.Shape("k_sense", "1/degC", 6e-5, 1e-4),
        bc.Shape("ratio", "1", 1.01, 1.10, scale="linear"),
        bc.Shape("quality", "1", 300.0, 30000.0),
    )
    more = {"columns": ("temperature",), "equation": equation, "source": RESONANCE_SOURCE}
    return term(name, basis, 500.0, "deg/s", shapes=shapes, **more)


RESONANCE = _resonance(
    "bias.resonance", _held_amplitude, "q·(D(T0)/D(T) − 1), drive amplitude held"
)
RESONANCE_FORCE = _resonance(
    "bias.resonance_force", _held_force, "q·((1−ε_d)^−½·D(T0)/D(T) − 1), drive force held"
)

BASELINE = (CONSTANT, LINE)
CANDIDATES = (
    QUADRATIC,
    CUBIC,
    effects.thermal_lag(
        "bias",
        *SIZES["bias.thermal_lag"],
        low=MINUTE,
        high=20 * MINUTE,
        start=0.1,
        start_unit="deg/s",
        source=SOURCE,
        short=effects.rate("bias", *SIZES["bias.rate"], source=SOURCE),
    ),
    term(
        "bias.reference_voltage",
        _board,
        *SIZES["bias.reference_voltage"],
        columns=("board_temperature",),
        equation="c·(T_board − T_board,0)",
        source="source 1 names the reference voltage and the electronics as possible causes; size ours",
    ),
    effects.warm_up(
        "bias", *SIZES["bias.warm_up"], low=2 * MINUTE, high=40 * MINUTE, source=SOURCE
    ),
    effects.drift("bias", *SIZES["bias.drift"], source=SOURCE),
    effects.deviation("bias", "run", *SIZES["bias.run"], source=SOURCE),
    term(
        "scale.constant",
        one,
        *SIZES["scale.constant"],
        columns=("rate_input",),
        equation="c",
        source="ours: 1 % of scale factor",
    ),
    term(
        "scale.temperature",
        centred,
        *SIZES["scale.temperature"],
        columns=("temperature", "rate_input"),
        equation="c·(T − T0)",
        source=SOURCE,
    ),
)
