"""Differential pair: MEMS accelerometers in two groups on a centrifuge arm, outer and inner (source 3).

Input axes point outward in the outer group and inward in the inner one, so that the devices of a pair see opposite
accelerations and the same environment. Measurement equation, output in µg, s = +1 outer, −1 inner, a the
commanded acceleration along the arm (µg, outward):

    output = s·(1 + κ)·[a·(1 + ρ) − δ·da/dt] + bias + ε·(g + r·dΩ/dt) + λd·u + v,       a = Ω²·r

| coefficient | slot, its unit | plausible size (ours; the equation is source 3's) |
|---|---|---|
| `scale.device`, baseline | `scale` κ, 1 | 5000 ppm: one per device, spread learned |
| `environment.shared[order 0]` … `[order 5]`, baseline | `environment` u, µg | 1 mg rms together |
| `environment.shared[sensitivity]`, baseline | `sensitivity` λd, 1 | 0.2 about 1: one per device, spread learned |
| `departure.device[order 0]` … `[order 5]`, baseline | `departure` v, µg | 0.05 of u; size and spectrum learned |
| `environment.temperature` | `environment` | 100 µg/°C |
| `scale.second_order` | `scale`: K2·s·a | 1000 ppm/g per device |
| `misalignment.device` | `misalignment` ε, rad | 5 mrad per device; its g is an alias of a bias, r·dΩ/dt is not |
| `input.radius` | `input` ρ = δr/r, 1 | 10⁻² per device; an exact alias of `scale.device`, hence untestable |
| `timing.skew` | `timing` δ, s | 10 ms per device |
| `bias.device`, `bias.drift` | `bias`, µg | 10 mg; 100 µg over the record; both per device |

The radius of the arm, where dΩ/dt is needed, is 1 m (`RADIUS`). Noise: white, 100 µg.

λd·u is a product of unknowns: one factor is sampled with the hyper-parameters. The framework takes the orders of u,
which stay six however many devices there are; λd, whose spread is learned, would make a funnel with it. A constant
acceleration leaves each device's scale and the constant part of its environment indistinguishable: record steps.

Pairs are chosen by `selection.py` (`bayescal pairs FILE`), and used by `measure.py`.
"""

from __future__ import annotations

from typing import Any

import bayescal as bc
from bayescal import effects
from bayescal_models.differential_pair.campaign import RADIUS, simulate
from bayescal_models.differential_pair.environment import DEPARTURE, SHARED

SOURCE = "source 3; size ours"
G = 1e6  # µg
STANDARD_GRAVITY = 9.80665  # m/s²


def slope(r: bc.Frame, values: Any) -> Any:
    """Time derivative of a column within each record, the mean of the differences to both neighbours, unit/s."""
    import jax.numpy as jnp  # JAX loads when something computes

    ordered = values[r.order]
    inside = r.step > 0
    back = jnp.where(inside, jnp.diff(ordered, prepend=ordered[:1]), 0.0)
    back = back / jnp.where(inside, r.step, 1.0)
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

    speed = jnp.sqrt(jnp.maximum(r["acceleration"], 1e-6) * (RADIUS * G / STANDARD_GRAVITY))
    return slope(r, speed)  # r·Ω in units such that its derivative is in µg


def _response(slots, r):
    a, sign = r["acceleration"], direction(r)
    seen = a * (1.0 + slots["input"]) - slots["timing"] * slope(r, a)
    return (
        sign * (1.0 + slots["scale"]) * seen
        + slots["bias"]
        + slots["misalignment"] * (G + tangential(r))
        + slots["sensitivity"] * slots["environment"]
        + slots["departure"]
    )


def _device(
    name: str, slot: str, size: float, unit: str, equation: str, basis=lambda r: 1.0, **more: Any
) -> bc.Effect:
    """An effect with one coefficient for each device, their spread learned."""
    coefficient = bc.Coefficient(
        unit, bc.Normal(0.0, size), per="device", spread=bc.HalfNormal(size)
    )
    needs = ("device", *more.pop("columns", ()))
    return bc.Effect(
        name, slot, basis, (coefficient,), columns=needs, equation=equation, source=SOURCE, **more
    )


SCALE = effects.deviation("scale", "device", 5000.0, "ppm", source=SOURCE)
TEMPERATURE = effects.linear("environment", 100.0, "ug/degC", source=SOURCE)
SECOND_ORDER = _device(
    "scale.second_order",
    "scale",
    1000.0,
    "ppm/g",
    "K2[device]·s·a in the scale",
    lambda r: direction(r) * r["acceleration"],
    columns=("group", "acceleration"),
    varies=("acceleration",),
)
MISALIGNMENT = _device(
    "misalignment.device",
    "misalignment",
    5.0,
    "mrad",
    "ε[device]·(g + r·dΩ/dt)",
    columns=("time", "acceleration"),
    varies=("acceleration",),
)
RADIUS_OF_DEVICE = _device(
    "input.radius",
    "input",
    1e4,
    "ppm",
    "a·δr[device]/r",
    columns=("acceleration",),
    untestable=lambda readings: (
        "is the same thing as scale.device: on an arm, a device at another radius reads as one of another "
        "scale factor. Measure the radii, or swap devices between places"
    ),
)
SKEW = _device(
    "timing.skew",
    "timing",
    10.0,
    "ms",
    "−δ[device]·da/dt",
    columns=("time", "acceleration"),
    varies=("acceleration",),
)
DRIFT = _device(
    "bias.drift",
    "bias",
    100.0,
    "ug",
    "d[device]·(t − t̄)/(tmax − tmin)",
    lambda r: r.progress,
    columns=("time",),
)
BIAS = effects.deviation("bias", "device", 10000.0, "ug", source=SOURCE)


def pairs(calibration: bc.Calibration, *, criterion: str = "residual") -> Any:
    """Which outer and inner device make the differential pair: see `selection.select`."""
    from bayescal_models.differential_pair.selection import select  # it needs this module

    return select(calibration, criterion=criterion)


INSTRUMENT = bc.Instrument(
    name="differential_pair",
    title="accelerometers in two opposed groups on a centrifuge: which two make a differential pair",
    columns=(
        bc.Column("device", None, "label of the device"),
        bc.Column("group", None, "side of the arm", allowed=("outer", "inner")),
        bc.Column("time", "s", "the same for every device"),
        bc.Column("acceleration", "ug", "commanded, outward along the arm", low=0.0),
        bc.Column("temperature", "degC", "of the fixture", required=False, low=-273.15, high=400.0),
        bc.Column("output", "ug", "output, or V with a nominal scale"),
    ),
    slots=(
        bc.Slot("bias", "ug", "output at no acceleration"),
        bc.Slot("scale", "1", "relative deviation of the scale factor"),
        bc.Slot("environment", "ug", "shared disturbance u(t)"),
        bc.Slot("sensitivity", "1", "sensitivity to the shared disturbance"),
        bc.Slot("departure", "ug", "a device's own environment"),
        bc.Slot("input", "1", "relative deviation of the acceleration at the device"),
        bc.Slot("timing", "s", "delay of the device"),
        bc.Slot("misalignment", "rad", "tilt of the input axis"),
    ),
    response=_response,
    effects=(SCALE, SHARED, DEPARTURE),
    candidates=(TEMPERATURE, SECOND_ORDER, MISALIGNMENT, RADIUS_OF_DEVICE, SKEW, DRIFT, BIAS),
    noise=bc.White(bc.HalfCauchy(100.0)),
    nominal_scale=bc.NominalScale("V", gain=1e-6, offset=0.0),
    structures=(
        ("shared", lambda: INSTRUMENT.baseline()),
        ("shared, biases", lambda: INSTRUMENT.baseline() + BIAS),
        ("no departures", lambda: INSTRUMENT.baseline() - DEPARTURE),
    ),
    simulate=simulate,
    pairs=pairs,
    source="source 3",
)
