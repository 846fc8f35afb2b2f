"""Effects of a ng accelerometer: its baseline and what that may lack, with sizes and sources (table: `model.py`)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

import bayescal as bc
from bayescal import effects
from bayescal_models.ng_accelerometer.hysteresis import hysteresis
from bayescal_models.ng_accelerometer.rig.tidal_constituents import TIDE
from bayescal_models.ng_accelerometer.sizes import BASELINE_SIZES, HOUR, SIZES

SOURCE = "PHYSICS §1 after source 0; size ours"
MINUTE = 60.0
SIDES = ("parallel", "perp")
HARMONICS = (2, 3)  # the first is a base tilt
LOBES = tuple(f"{wave}{m}" for m in HARMONICS for wave in ("cos", "sin"))
POSITION, TEMPERATURE = "position_angle", "temperature"


def turned(r: bc.Frame, share: Float[Array, "n"] | float = 1.0) -> Float[Array, "n 4"]:
    """cos mθ and sin mθ, m = 2 and 3, times `share`."""
    angle = r["position_angle"]
    waves = [wave(m * angle) for m in HARMONICS for wave in (jnp.cos, jnp.sin)]
    return jnp.stack(waves, axis=1) * jnp.reshape(jnp.asarray(share), (-1, 1))


def tides(r: bc.Frame) -> Float[Array, "n 20"]:
    """cos and sin of every constituent, for one component of the base tilt and then for the other."""
    phase = [2 * jnp.pi * r["time"] / (hours * HOUR) for hours, _ in TIDE.values()]
    waves = [wave(p) for p in phase for wave in (jnp.cos, jnp.sin)]
    return jnp.stack([*waves, *waves], axis=1)


def _one(r: bc.Frame) -> float:
    return 1.0


def _ones(count: int, r: bc.Frame) -> Float[Array, "n k"]:
    return jnp.ones((r.size, count))


def _centred(r: bc.Frame) -> Float[Array, "n"]:
    return r.centred()


def _laboratory(r: bc.Frame) -> Float[Array, "n"]:
    return r.centred("lab_temperature")


def _progress(r: bc.Frame) -> Float[Array, "n"]:
    return r.progress


def _turned_by_temperature(r: bc.Frame) -> Float[Array, "n 4"]:
    return turned(r, r.centred())


def _once_round(r: bc.Frame) -> Float[Array, "n 2"]:
    return jnp.stack([jnp.cos(r[POSITION]), jnp.sin(r[POSITION])], axis=1)


def _on_both_sides(basis: Callable[[bc.Frame], Any], r: bc.Frame) -> Float[Array, "n 2"]:
    return jnp.stack([basis(r)] * 2, axis=1)


def _effect(
    name: str,
    slot: str,
    basis: Callable[[bc.Frame], Any],
    columns: tuple[str, ...],
    equation: str,
    *,
    parts: tuple[str, ...] = ("",),
    varies: tuple[str, ...] | None = None,
    source: str = SOURCE,
) -> bc.Effect:
    """An effect whose coefficients, one for each part, are all of one size."""
    size, unit = SIZES.get(name) or BASELINE_SIZES[name]
    return bc.Effect(
        name,
        slot,
        basis=basis,
        coefficients=tuple(bc.Coefficient(unit, bc.Normal(0.0, size), part=p) for p in parts),
        columns=columns,
        varies=columns if varies is None else varies,
        equation=equation,
        source=source,
    )


def _base(name: str, basis: Callable[[bc.Frame], Any], column: str, equation: str) -> bc.Effect:
    """An effect on both components of the base tilt, found or dropped together."""
    size, unit = SIZES[name]
    return bc.Effect(
        name,
        "base_tilt_parallel",
        basis=partial(_on_both_sides, basis),
        coefficients=tuple(
            bc.Coefficient(unit, bc.Normal(0.0, size), part=side, slot=f"base_tilt_{side}")
            for side in SIDES
        ),
        columns=(column,),
        varies=(column,),
        equation=f"{equation}, one c for each component",
        source=SOURCE,
    )


def _run_slope() -> bc.Effect:
    name = "fixture_tilt.run_temperature"
    size, unit = SIZES[name]
    return bc.Effect(
        name,
        "fixture_tilt",
        basis=_centred,
        coefficients=(
            bc.Coefficient(unit, bc.Normal(0.0, size), per="run", group_sd=bc.HalfNormal(size)),
        ),
        columns=("run", "temperature"),
        varies=("temperature",),
        equation="d[run]·(T − T0),  d ~ N(0, s²)",
        source=SOURCE,
    )


def _tide() -> bc.Effect:
    return bc.Effect(
        "base_tilt.tide",
        "base_tilt_parallel",
        basis=tides,
        coefficients=tuple(
            bc.Coefficient(
                "nrad",
                bc.Normal(0.0, size),
                part=f"{side},{constituent},{wave}",
                slot=f"base_tilt_{side}",
            )
            for side in SIDES
            for constituent, (_, size) in TIDE.items()
            for wave in ("cos", "sin")
        ),
        columns=("time",),
        varies=("time",),
        equation="Σ c·cos(2πt/P) + s·sin(2πt/P) over M2, S2, N2, K1, O1, for each component",
        source="periods: the constituents' own; ±200 nrad in all: source 0; the shares ours",
    )


def _constant(slot: str, source: str = SOURCE) -> bc.Effect:
    return effects.constant(slot, *BASELINE_SIZES[f"{slot}.constant"], source=source)


def _cells(name: str, parts: tuple[str, ...] = ("",)) -> bc.Effect:
    """A deviation of each cell whose spread is known to an order of magnitude or two."""
    size, unit = BASELINE_SIZES[name]
    slots = [f"base_tilt_{p}" if p else name.removesuffix(".cell") for p in parts]
    return bc.Effect(
        name,
        slots[0],
        basis=partial(_ones, len(parts)),
        coefficients=tuple(
            bc.Coefficient(
                unit,
                bc.Normal(0.0, size),
                part=part,
                slot=slot,
                per="cell",
                group_sd=bc.HalfCauchy(size),
            )
            for part, slot in zip(parts, slots, strict=True)
        ),
        columns=("temperature_point",),
        equation="d[cell],  d ~ N(0, s²)",
        source=SOURCE,
    )


BASE_CONSTANT = bc.Effect(
    "base_tilt.constant",
    "base_tilt_parallel",
    basis=partial(_ones, len(SIDES)),
    coefficients=tuple(
        bc.Coefficient(
            BASELINE_SIZES["base_tilt.constant"].unit,
            bc.Normal(0.0, BASELINE_SIZES["base_tilt.constant"].value),
            part=side,
            slot=f"base_tilt_{side}",
        )
        for side in SIDES
    ),
    equation="c, one for each component",
    source=SOURCE,
)
TILT_SETTING = _effect(
    "tilt.setting",
    "base_tilt_perp",
    _one,
    ("tilt",),
    "c, added to γ as γ2⊥ is",
    varies=(),
    source="source 0: the table's angles are good to 1″",
)
THERMOMETER = effects.thermometer(0.002, source="ours: 2 mK of an averaged temperature")

BASELINE = (
    _constant("bias"),
    effects.linear("bias", *BASELINE_SIZES["bias.temperature"], source=SOURCE),
    _cells("bias.cell"),
    _constant("scale"),
    effects.linear("scale", *BASELINE_SIZES["scale.temperature"], source=SOURCE),
    _cells("scale.cell"),
    _constant("fixture_tilt", "source 0: within 2′, taken as 95 %"),
    _cells("fixture_tilt.cell"),
    BASE_CONSTANT,
    _cells("base_tilt.cell", SIDES),
    _constant("rotation"),
    TILT_SETTING,
)


def _polynomials() -> tuple[bc.Effect, ...]:
    return tuple(
        power(slot, *SIZES[f"{slot}.temperature_{order}"], source=SOURCE)
        for slot in ("bias", "scale")
        for order, power in (("quadratic", effects.quadratic), ("cubic", effects.cubic))
    )


CANDIDATES = (
    *_polynomials(),
    effects.drift("bias", *SIZES["bias.drift"], source=SOURCE),
    effects.warm_up("bias", *SIZES["bias.warm_up"], low=2 * MINUTE, high=3 * HOUR, source=SOURCE),
    effects.deviation("bias", "run", *SIZES["bias.run"], source=SOURCE),
    effects.deviation("scale", "run", *SIZES["scale.run"], source=SOURCE),
    effects.rate("bias", *SIZES["bias.rate"], source=SOURCE),
    effects.thermal_lag(
        "bias",
        *SIZES["bias.thermal_lag"],
        low=MINUTE,
        high=3 * HOUR,
        start=5.0,
        start_unit="ug",
        source=SOURCE,
    ),
    hysteresis(SOURCE),
    effects.linear("fixture_tilt", *SIZES["fixture_tilt.temperature"], source=SOURCE),
    effects.deviation("fixture_tilt", "run", *SIZES["fixture_tilt.run"], source=SOURCE),
    _run_slope(),
    _effect(
        "fixture_tilt.position",
        "fixture_tilt",
        _turned_by_temperature,
        (POSITION, TEMPERATURE),
        "(T − T0)·Σ(c·cos mθ + s·sin mθ),  m = 2, 3",
        parts=LOBES,
    ),
    _base(
        "base_tilt.lab_temperature",
        _laboratory,
        "lab_temperature",
        "c·(L − L0)",
    ),
    _base("base_tilt.temperature", _centred, TEMPERATURE, "c·(T − T0)"),
    _tide(),
    _base("base_tilt.drift", _progress, "time", "c·(t − t̄)/(tmax − tmin)"),
    _effect("second_order", "second_order", _one, (POSITION,), "K2"),
    _effect("third_order", "third_order", _one, (POSITION,), "K3"),
    _effect("cross_coupling", "cross_coupling", _one, (POSITION,), "Kip"),
    _effect(
        "cross_coupling.temperature",
        "cross_coupling",
        _centred,
        (POSITION, TEMPERATURE),
        "c·(T − T0)",
    ),
    _effect(
        "rotation.harmonic",
        "rotation",
        _once_round,
        (POSITION,),
        "c·cos θ + s·sin θ, dividing error of the table",
        parts=("cos", "sin"),
        source="source 0: the table's angle is good to 1″",
    ),
    _effect(
        "rotation.wobble",
        "fixture_tilt",
        turned,
        (POSITION,),
        "Σ(c·cos mθ + s·sin mθ),  m = 2, 3, wobble of the spindle",
        parts=LOBES,
    ),
)
