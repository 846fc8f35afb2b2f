"""Effects of a ng accelerometer: its baseline and what that may lack, with sizes and sources (table: `model.py`)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import bayescal as bc
from bayescal import effects
from bayescal_models.ng_accelerometer.rig.tidal_constituents import TIDE
from bayescal_models.ng_accelerometer.sizes import BASELINE_SIZES, HOUR, SIZES
from bayescal_models.terms import centred, one, progress, term

SOURCE = "PHYSICS §1 after source 0; size ours"
MINUTE = 60.0
SIDES = ("parallel", "perp")
HARMONICS = (2, 3)  # the first is a base tilt
LOBES = tuple(f"{wave}{m}" for m in HARMONICS for wave in ("cos", "sin"))
DEAD_BAND = 1.0  # °C: a chamber that holds its temperature wanders by 0.1 °C (source 0)
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


def _ones(count: int, r: bc.Frame) -> Float[Array, "n k"]:
    return jnp.ones((r.size, count))


def _laboratory(r: bc.Frame) -> Float[Array, "n"]:
    return r.centred("lab_temperature")


def _turned_by_temperature(r: bc.Frame) -> Float[Array, "n 4"]:
    return turned(r, r.centred())


def _once_round(r: bc.Frame) -> Float[Array, "n 2"]:
    return jnp.stack([jnp.cos(r[POSITION]), jnp.sin(r[POSITION])], axis=1)


def _on_both_sides(basis: Callable[[bc.Frame], Any], r: bc.Frame) -> Float[Array, "n 2"]:
    return jnp.stack([jnp.broadcast_to(basis(r), (r.size,))] * 2, axis=1)


def _effect(
    name: str,
    basis: Callable[[bc.Frame], Any],
    columns: tuple[str, ...],
    equation: str,
    **more: Any,
) -> bc.Effect:
    """An effect of its plausible size."""
    own = {"columns": columns, "equation": equation, "source": SOURCE}
    return term(name, basis, *(SIZES.get(name) or BASELINE_SIZES[name]), **{**own, **more})


def _base(name: str, basis: Callable[[bc.Frame], Any], *said: Any, **more: Any) -> bc.Effect:
    """An effect on both components of the base tilt, found or dropped together; what is said of it as in `_effect`."""
    slots = tuple(f"base_tilt_{side}" for side in SIDES)
    return _effect(name, partial(_on_both_sides, basis), *said, parts=SIDES, slots=slots, **more)


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


# A deviation of each cell has a spread that is known to an order of magnitude or two.
_CELLS: dict[str, Any] = {"per": "cell", "group_sd": bc.HalfCauchy}
_OF_CELLS = (("temperature_point",), "d[cell],  d ~ N(0, s²)")


def _cells(slot: str) -> bc.Effect:
    return _effect(
        f"{slot}.cell", partial(_ones, 1), *_OF_CELLS, slots=(slot,), varies=(), **_CELLS
    )


THERMOMETER = effects.thermometer(0.002, source="ours: 2 mK of an averaged temperature")

BASELINE = (
    _constant("bias"),
    effects.linear("bias", *BASELINE_SIZES["bias.temperature"], source=SOURCE),
    _cells("bias"),
    _constant("scale"),
    effects.linear("scale", *BASELINE_SIZES["scale.temperature"], source=SOURCE),
    _cells("scale"),
    _constant("fixture_tilt", "source 0: within 2′, taken as 95 %"),
    _cells("fixture_tilt"),
    _base("base_tilt.constant", one, (), "c, one for each component"),
    _base("base_tilt.cell", one, *_OF_CELLS, varies=(), **_CELLS),
    _constant("rotation"),
    _effect(
        "tilt.setting",
        one,
        ("tilt",),
        "c, added to γ as γ2⊥ is",
        slot="base_tilt_perp",
        varies=(),
        source="source 0: the table's angles are good to 1″",
    ),
)
CANDIDATES = (
    *(
        power(slot, *SIZES[f"{slot}.temperature_{order}"], source=SOURCE)
        for slot in ("bias", "scale")
        for order, power in (("quadratic", effects.quadratic), ("cubic", effects.cubic))
    ),
    effects.drift("bias", *SIZES["bias.drift"], source=SOURCE),
    effects.warm_up("bias", *SIZES["bias.warm_up"], low=2 * MINUTE, high=3 * HOUR, source=SOURCE),
    effects.deviation("bias", "run", *SIZES["bias.run"], source=SOURCE),
    effects.deviation("scale", "run", *SIZES["scale.run"], source=SOURCE),
    effects.thermal_lag(
        "bias",
        *SIZES["bias.thermal_lag"],
        low=MINUTE,
        high=3 * HOUR,
        start=5.0,
        start_unit="ug",
        source=SOURCE,
        short=effects.rate("bias", *SIZES["bias.rate"], source=SOURCE),
    ),
    _effect(
        "bias.hysteresis",
        direction,
        ("time", TEMPERATURE),
        f"c·sign(T − T of the previous cell),  0 in the first; dead band {DEAD_BAND:g} °C",
        untestable=one_direction,
    ),
    effects.linear("fixture_tilt", *SIZES["fixture_tilt.temperature"], source=SOURCE),
    effects.deviation("fixture_tilt", "run", *SIZES["fixture_tilt.run"], source=SOURCE),
    _effect(
        "fixture_tilt.run_temperature",
        centred,
        ("run", TEMPERATURE),
        "d[run]·(T − T0),  d ~ N(0, s²)",
        per="run",
        group_sd=bc.HalfNormal,
        varies=(TEMPERATURE,),
    ),
    _effect(
        "fixture_tilt.position",
        _turned_by_temperature,
        (POSITION, TEMPERATURE),
        "(T − T0)·Σ(c·cos mθ + s·sin mθ),  m = 2, 3",
        parts=LOBES,
    ),
    _base(
        "base_tilt.lab_temperature",
        _laboratory,
        ("lab_temperature",),
        "c·(L − L0), one c for each component",
    ),
    _base(
        "base_tilt.temperature",
        centred,
        (TEMPERATURE,),
        "c·(T − T0), one c for each component",
    ),
    _tide(),
    _base(
        "base_tilt.drift",
        progress,
        ("time",),
        "c·(t − t̄)/(tmax − tmin), one c for each component",
        varies=("time",),
    ),
    _effect("second_order", one, (POSITION,), "K2"),
    _effect("third_order", one, (POSITION,), "K3"),
    _effect("cross_coupling", one, (POSITION,), "Kip"),
    _effect("cross_coupling.temperature", centred, (POSITION, TEMPERATURE), "c·(T − T0)"),
    _effect(
        "rotation.harmonic",
        _once_round,
        (POSITION,),
        "c·cos θ + s·sin θ, dividing error of the table",
        parts=("cos", "sin"),
        source="source 0: the table's angle is good to 1″",
    ),
    _effect(
        "rotation.wobble",
        turned,
        (POSITION,),
        "Σ(c·cos mθ + s·sin mθ),  m = 2, 3, wobble of the spindle",
        slot="fixture_tilt",
        parts=LOBES,
    ),
)
