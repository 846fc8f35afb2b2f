"""Effects that a ng accelerometer's baseline may lack, with their sizes and sources (the table is in `model.py`)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import bayescal as bc
from bayescal import effects
from bayescal_models.ng_accelerometer.sizes import HOUR, SIZES, TIDE

SOURCE = "PHYSICS §1 after source 0; size ours"
MINUTE = 60.0
DEAD_BAND = 1.0  # °C: a chamber that holds its temperature wanders by 0.1 °C (source 0)
SIDES = ("parallel", "perp")
HARMONICS = (2, 3)  # the first is a base tilt


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


def _base(name: str, basis, columns: tuple[str, ...], varies: tuple[str, ...], equation: str):
    """An effect on both components of the base tilt, found or dropped together."""
    size, unit = SIZES[name]
    return bc.Effect(
        name,
        "base_tilt_parallel",
        basis=lambda r: jnp.stack([basis(r)] * 2, axis=1),
        coefficients=tuple(
            bc.Coefficient(unit, bc.Normal(0.0, size), part=side, slot=f"base_tilt_{side}")
            for side in SIDES
        ),
        columns=columns,
        varies=varies,
        equation=f"{equation}, one c for each component",
        source=SOURCE,
    )


def _one(name: str, slot: str, basis, columns, varies, equation: str) -> bc.Effect:
    """An effect of one coefficient."""
    size, unit = SIZES[name]
    return bc.Effect(
        name,
        slot,
        basis=basis,
        coefficients=(bc.Coefficient(unit, bc.Normal(0.0, size)),),
        columns=columns,
        varies=varies,
        equation=equation,
        source=SOURCE,
    )


def _lobes(name: str, basis, columns, varies, equation: str) -> bc.Effect:
    """Second and third harmonic of the position, in the fixture tilt."""
    size, unit = SIZES[name]
    parts = [f"{wave}{m}" for m in HARMONICS for wave in ("cos", "sin")]
    return bc.Effect(
        name,
        "fixture_tilt",
        basis=basis,
        coefficients=tuple(bc.Coefficient(unit, bc.Normal(0.0, size), part=p) for p in parts),
        columns=columns,
        varies=varies,
        equation=equation,
        source=SOURCE,
    )


def _run_slope() -> bc.Effect:
    name = "fixture_tilt.run_temperature"
    size, unit = SIZES[name]
    return bc.Effect(
        name,
        "fixture_tilt",
        basis=lambda r: r.centred(),
        coefficients=(
            bc.Coefficient(unit, bc.Normal(0.0, size), per="run", spread=bc.HalfNormal(size)),
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


def _hysteresis() -> bc.Effect:
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
        source=SOURCE,
    )


def _polynomials() -> tuple[bc.Effect, ...]:
    return tuple(
        power(slot, *SIZES[f"{slot}.temperature_{order}"], source=SOURCE)
        for slot in ("bias", "scale")
        for order, power in (("quadratic", effects.quadratic), ("cubic", effects.cubic))
    )


POSITION, TEMPERATURE = "position_angle", "temperature"

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
    _hysteresis(),
    effects.linear("fixture_tilt", *SIZES["fixture_tilt.temperature"], source=SOURCE),
    effects.deviation("fixture_tilt", "run", *SIZES["fixture_tilt.run"], source=SOURCE),
    _run_slope(),
    _lobes(
        "fixture_tilt.position",
        lambda r: turned(r, r.centred()),
        (POSITION, TEMPERATURE),
        (POSITION, TEMPERATURE),
        "(T − T0)·Σ(c·cos mθ + s·sin mθ),  m = 2, 3",
    ),
    _base(
        "base_tilt.lab_temperature",
        lambda r: r.centred("lab_temperature"),
        ("lab_temperature",),
        ("lab_temperature",),
        "c·(L − L0)",
    ),
    _base(
        "base_tilt.temperature",
        lambda r: r.centred(),
        (TEMPERATURE,),
        (TEMPERATURE,),
        "c·(T − T0)",
    ),
    _tide(),
    _base("base_tilt.drift", lambda r: r.progress, ("time",), ("time",), "c·(t − t̄)/(tmax − tmin)"),
    _one("second_order", "second_order", lambda r: 1.0, (POSITION,), (POSITION,), "K2"),
    _one("third_order", "third_order", lambda r: 1.0, (POSITION,), (POSITION,), "K3"),
    _one("cross_coupling", "cross_coupling", lambda r: 1.0, (POSITION,), (POSITION,), "Kip"),
    _one(
        "cross_coupling.temperature",
        "cross_coupling",
        lambda r: r.centred(),
        (POSITION, TEMPERATURE),
        (POSITION, TEMPERATURE),
        "c·(T − T0)",
    ),
    bc.Effect(
        "rotation.harmonic",
        "rotation",
        basis=lambda r: jnp.stack([jnp.cos(r[POSITION]), jnp.sin(r[POSITION])], axis=1),
        coefficients=tuple(
            bc.Coefficient(
                SIZES["rotation.harmonic"].unit,
                bc.Normal(0.0, SIZES["rotation.harmonic"].value),
                part=p,
            )
            for p in ("cos", "sin")
        ),
        columns=(POSITION,),
        varies=(POSITION,),
        equation="c·cos θ + s·sin θ, dividing error of the table",
        source="source 0: the table's angle is good to 1″",
    ),
    _lobes(
        "rotation.wobble",
        turned,
        (POSITION,),
        (POSITION,),
        "Σ(c·cos mθ + s·sin mθ),  m = 2, 3, wobble of the spindle",
    ),
)
