"""Differential pair: MEMS accelerometers in two groups on a centrifuge arm, outer and inner (source 3).

Input axes point outward in the outer group and inward in the inner one, so that the devices of a pair have opposite
accelerations and the same environment. Measurement equation, output in µg, s = +1 outer, −1 inner, a the
commanded acceleration along the arm (µg, outward):

    output = s·(1 + κ)·[a·(1 + ρ) − δ·da/dt] + bias + ε·(g + r·dΩ/dt) + λd·u + v,       a = Ω²·r

κ is `scale`, ρ `input`, δ `timing`, ε `misalignment`; u is `environment`, λd `sensitivity`, v `departure`. Sizes
are ours, the equation is source 3's. g of `misalignment.device` is an alias of a bias, r·dΩ/dt is not; `input.radius`
is an exact alias of `scale.device`, hence untestable.

The radius of the arm, where dΩ/dt is needed, is 1 m (`RADIUS`). Noise: white, 100 µg; or, if the readings show it,
larger while the arm changes its speed (`noise.py`).

λd·u is a product of unknowns: one factor is sampled with the hyper-parameters: the orders of u, whose number
does not grow with that of devices; λd, whose standard deviation is learned, would form a funnel with it. A constant
acceleration leaves each device's scale and the constant part of its environment indistinguishable: record steps.

Pairs are chosen by `pairing/selection.py` (`bayescal pairs FILE`), and used by `pairing/measure.py`.
"""

from __future__ import annotations

from typing import Any

import bayescal as bc
from bayescal import xp
from bayescal_models import catalogue
from bayescal_models.catalogue import EffectTable, Maker, effect, one, progress
from bayescal_models.differential_pair import COLUMNS, NOMINAL_SCALE
from bayescal_models.differential_pair.campaign import GRAVITY, RADIUS, G
from bayescal_models.differential_pair.environment import DEPARTURE, SHARED
from bayescal_models.differential_pair.noise import NoiseWhileChanging, ends, slope
from bayescal_models.differential_pair.simulator import simulated_columns
from bayescal_models.simulated import readings_of

SOURCE = "source 3; size ours"


def direction(r: bc.Frame) -> Any:
    """Return +1 for the outer group, −1 for the inner."""
    return r.has_label("group", "outer") - r.has_label("group", "inner")


def tangential(r: bc.Frame) -> Any:
    """Return r·dΩ/dt from the commanded acceleration, µg."""
    speed = xp.sqrt(xp.maximum(r["acceleration"], 1e-6) * (RADIUS * G / GRAVITY))
    return slope(r, speed)  # r·Ω in units such that its derivative is in µg


def _response(slots, r):
    a, sign = r["acceleration"], direction(r)
    input_acceleration = a * (1.0 + slots["input"]) - slots["timing"] * slope(r, a)
    return (
        sign * (1.0 + slots["scale"]) * input_acceleration
        + slots["bias"]
        + slots["misalignment"] * (G + tangential(r))
        + slots["sensitivity"] * slots["environment"]
        + slots["departure"]
    )


def _softening(r: bc.Frame) -> Any:
    """Return columns of a softening spring's change of scale: x/(1 − kx) = x + kx² + k²x³ + …"""
    outward = direction(r) * r["acceleration"]
    # Of a reading, which is a mean, k·⟨a²⟩ = k·(⟨a⟩² + var a). Between its ends a parabola of that mean has the
    # variance (a₁ − a₀)²/12 + (3·(a₁ + a₀) − 6·⟨a⟩)²/180; how long a reading is of its step is a share of it.
    before, after = ends(r, r["acceleration"])
    bend = 3.0 * (before + after - 2.0 * r["acceleration"])
    varies = (after - before) ** 2 / 12.0 + bend**2 / 180.0
    within = direction(r) * varies / xp.maximum(r["acceleration"], 1.0)
    return xp.stack([outward, outward**2, within], axis=-1)


def _as_scale(readings: bc.Measurements) -> str:
    return (
        "is an exact alias of scale.device: on an arm, another radius has the effect of another scale factor. "
        "Measure the radii, or swap devices between places"
    )


def _device(equation: str, *columns: str, basis: Any = one, **fields: Any) -> Maker:
    """Build an effect with one coefficient per device and learned standard deviation; `acceleration` must vary."""
    defaults = {"per": "device", "learned": bc.HalfNormal, "varies": ("acceleration",)}
    return effect(basis, equation, "device", *columns, **{**defaults, **fields})


# Third order with the second: at 10 g that of 650 ppm/g is 40 ppm of the scale factor, four times its uncertainty, but
# too small to be found alone. K2' is K2 times (duration of a reading/interval between readings)².
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

ARM = ("time", "acceleration")
TILTED = _device("ε[device]·(g + r·dΩ/dt)", *ARM)
LATE = _device("−δ[device]·da/dt", *ARM)
FARTHER = _device("a·δr[device]/r", "acceleration", varies=(), untestable=_as_scale)
AGEING = _device("d[device]·(t − t̄)/(tmax − tmin)", "time", basis=progress, varies=())

EFFECTS = EffectTable.of(
    SOURCE,
    baseline=(("scale.device", catalogue.deviation, 5000.0, "ppm"), SHARED, DEPARTURE),
    candidates=(
        ("environment.temperature", catalogue.linear, 100.0, "ug/degC"),
        SECOND_ORDER,
        ("misalignment.device", TILTED, 5.0, "mrad"),
        ("input.radius", FARTHER, 1e4, "ppm"),
        ("timing.skew", LATE, 10.0, "ms"),
        ("bias.drift", AGEING, 100.0, "ug"),
        ("bias.device", catalogue.deviation, 10000.0, "ug"),
        # Lags and warm-up are part of the shared disturbance, a free function of time.
        *catalogue.recorded(
            *("bias", "ug"), size=1000.0, span=5.0, pace=1.0, causes=("supply",), per="device"
        ),
    ),
)

INSTRUMENT = bc.Instrument(
    name="differential_pair",
    title="accelerometers in two opposed groups on a centrifuge: which two make a differential pair",
    columns=COLUMNS,
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
    effects=EFFECTS.baseline,
    candidates=EFFECTS.candidates,
    noise=bc.White(bc.HalfCauchy(100.0)),
    noise_laws=(NoiseWhileChanging(),),
    nominal_scale=NOMINAL_SCALE,
    structures=(
        ("shared", lambda: INSTRUMENT.baseline()),
        ("shared, biases", lambda: INSTRUMENT.baseline() + "bias.device"),
        ("no departures", lambda: INSTRUMENT.baseline() - DEPARTURE),
    ),
    simulator=simulated_columns,
    source="source 3",
)
simulate = readings_of(INSTRUMENT)
