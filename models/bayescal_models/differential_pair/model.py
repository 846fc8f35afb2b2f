"""Differential pair: MEMS accelerometers in two groups on a centrifuge arm, outer and inner (source 3).

Input axes point outward in the outer group and inward in the inner one, so that the devices of a pair have opposite
accelerations and the same environment. Measurement equation, output in µg, s = +1 outer, −1 inner, a the
commanded acceleration along the arm (µg, outward):

    output = s·(1 + κ)·[a·(1 + ρ) − δ·da/dt] + bias + ε·(g + r·dΩ/dt) + λd·u + v,       a = Ω²·r

κ is `scale`, ρ `input`, δ `timing`, ε `misalignment`; u is `environment`, λd `sensitivity`, v `departure`. The equation
is from source 3; sizes are assumed by us. The term ε·g of `misalignment.device` is an alias of a bias, ε·r·dΩ/dt is
not; `input.radius` is an exact alias of `scale.device` and cannot be tested.

The radius r of the arm in r·dΩ/dt is 1 m (`RADIUS`). Noise: white, 100 µg; or, if the readings show it, larger while
the arm changes its speed (`noise.py`).

λd·u is a product of unknowns, so one factor must be sampled with the hyper-parameters: the coefficients of u, whose
number does not grow with the number of devices. (Sampled λd would form a funnel with its standard deviation.) At
constant acceleration each device's scale factor and the constant part of its environment are confounded: record steps.

Pairs are chosen by `pairing/selection.py` (`bayescal pairs FILE`), and used by `pairing/measure.py`.
"""

from __future__ import annotations

from typing import Any

import bayescal as bc
from bayescal import xp
from bayescal_models import catalogue
from bayescal_models.catalogue import EffectTable, Factory, effect, one, progress
from bayescal_models.differential_pair import COLUMNS, NOMINAL_SCALE
from bayescal_models.differential_pair.campaign import GRAVITY, RADIUS, G
from bayescal_models.differential_pair.environment import DEPARTURE, SHARED
from bayescal_models.differential_pair.noise import NoiseWhileChanging, differentiate, end_values
from bayescal_models.differential_pair.simulator import simulate_columns
from bayescal_models.simulated import make_readings_simulator

SOURCE = "source 3; size assumed by us"


def compute_side_sign(r: bc.Frame) -> Any:
    """Return the sign of each reading's input axis: +1 in the outer group, −1 in the inner one, (n,)."""
    return r.has_label("group", "outer") - r.has_label("group", "inner")


def compute_tangential_acceleration(r: bc.Frame) -> Any:
    """Compute the tangential acceleration r·dΩ/dt, µg, from the commanded acceleration, (n,)."""
    speed = xp.sqrt(xp.maximum(r["acceleration"], 1e-6) * (RADIUS * G / GRAVITY))
    return differentiate(r, speed)  # speed r·Ω in µg·s


def _evaluate_response(slots, r):
    a, sign = r["acceleration"], compute_side_sign(r)
    input_acceleration = a * (1.0 + slots["input"]) - slots["timing"] * differentiate(r, a)
    return (
        sign * (1.0 + slots["scale"]) * input_acceleration
        + slots["bias"]
        + slots["misalignment"] * (G + compute_tangential_acceleration(r))
        + slots["sensitivity"] * slots["environment"]
        + slots["departure"]
    )


def _evaluate_softening_columns(r: bc.Frame) -> Any:
    """Return the terms of a softening spring, x/(1 − kx) = x + kx² + k²x³ + …, in the scale factor, (n, 3)."""
    axial_input = compute_side_sign(r) * r["acceleration"]
    # A reading is a mean over its averaging time: k·⟨a²⟩ = k·(⟨a⟩² + var a). A parabola with the end values a₀, a₁ and
    # the mean ⟨a⟩ has the variance (a₁ − a₀)²/12 + (3·(a₁ + a₀) − 6·⟨a⟩)²/180.
    start_value, end_value = end_values(r, r["acceleration"])
    curvature = 3.0 * (start_value + end_value - 2.0 * r["acceleration"])
    variance = (end_value - start_value) ** 2 / 12.0 + curvature**2 / 180.0
    variance_term = compute_side_sign(r) * variance / xp.maximum(r["acceleration"], 1.0)
    return xp.stack([axial_input, axial_input**2, variance_term], axis=-1)


def _explain_radius(readings: bc.Measurements) -> str:
    return (
        "is an exact alias of scale.device: an error of the radius acts as a scale factor deviation. "
        "Measure the radii, or swap devices between positions"
    )


def _make_effect(equation: str, *columns: str, basis: Any = one, **fields: Any) -> Factory:
    """Return a factory that creates a random effect of devices; `acceleration` must vary in the readings."""
    defaults = {"per": "device", "group_sd_prior": bc.HalfNormal, "varies": ("acceleration",)}
    return effect(basis, equation, "device", *columns, **{**defaults, **fields})


# Second and third order in one effect: at 10 g and 650 ppm/g the third order is 40 ppm of the scale factor, four times
# the uncertainty, but too small to be found alone. K2' is K2 times (averaging time/reading interval)².
SECOND_ORDER = bc.Effect(
    "scale.second_order",
    "scale",
    _evaluate_softening_columns,
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

ARM_COLUMNS = ("time", "acceleration")
MISALIGNMENT = _make_effect("ε[device]·(g + r·dΩ/dt)", *ARM_COLUMNS)
TIMING_SKEW = _make_effect("−δ[device]·da/dt", *ARM_COLUMNS)
ARM_RADIUS = _make_effect("a·δr[device]/r", "acceleration", varies=(), untestable=_explain_radius)
DRIFT = _make_effect("d[device]·(t − t̄)/(tmax − tmin)", "time", basis=progress, varies=())

EFFECTS = EffectTable.from_rows(
    SOURCE,
    baseline=(("scale.device", catalogue.deviation, 5000.0, "ppm"), SHARED, DEPARTURE),
    candidates=(
        ("environment.temperature", catalogue.linear, 100.0, "ug/degC"),
        SECOND_ORDER,
        ("misalignment.device", MISALIGNMENT, 5.0, "mrad"),
        ("input.radius", ARM_RADIUS, 1e4, "ppm"),
        ("timing.skew", TIMING_SKEW, 10.0, "ms"),
        ("bias.drift", DRIFT, 100.0, "ug"),
        ("bias.device", catalogue.deviation, 10000.0, "ug"),
        # Lags and warm-up are part of the shared disturbance, a free function of time.
        *catalogue.make_common_effects(
            *("bias", "ug"), size=1000.0, span=5.0, pace=1.0, causes=("supply",), per="device"
        ),
    ),
)

INSTRUMENT = bc.Instrument(
    name="differential_pair",
    title="accelerometers in two opposed groups on a centrifuge: which two make a differential pair",
    columns=COLUMNS,
    slots=(
        bc.Slot("bias", "ug", "output at zero acceleration"),
        bc.Slot("scale", "1", "relative deviation of the scale factor"),
        bc.Slot("environment", "ug", "shared disturbance u(t)"),
        bc.Slot("sensitivity", "1", "sensitivity to the shared disturbance"),
        bc.Slot("departure", "ug", "departure of a device's environment from the shared one"),
        bc.Slot("input", "1", "relative deviation of the acceleration at the device"),
        bc.Slot("timing", "s", "delay of the device"),
        bc.Slot("misalignment", "rad", "tilt of the input axis"),
    ),
    response=_evaluate_response,
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
    simulator=simulate_columns,
    source="source 3",
)
simulate = make_readings_simulator(INSTRUMENT)
