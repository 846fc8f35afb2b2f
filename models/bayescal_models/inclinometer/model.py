"""Two-axis inclinometer of quartz flexure accelerometers: zero offset against placement angle (source 4).

An accelerometer feels A = g·sin x along its axis and reads arcsin(A/g). Its true sensing direction deviates
from its flange axis by S_p toward its pendulum direction and by S_d toward its door direction; turned by the
*placement angle* ω from pendulum toward door attitude it reads, at no tilt,

    S(ω) = S_e + S_p·cos ω + S_d·sin ω                                 (S_e the electrical zero)

and at a tilt x, with the other axis at y,

    reading = arcsin[ (1 + κ)·( sin x + cos x·zero(ω) + m·sin y ) ]

Source 4 takes ω = y, and a line for zero(ω); the exact angle is ω = atan2(sin y, √(1 − sin²x − sin²y)) (`geometry.py`).
S_e is not an angle of the axis, so cos x does not multiply it; here it is part of `zero`, and the effect
`zero.electrical_tilt`, S_e·(1/cos x − 1), cancels the cosine.

**One instrument, two tests.** A *zero test* has the columns `axis`, `run`, `placement_angle` and `output` (or
`zero_offset`) and no tilt: reading = zero + m·sin ω + dividing + base_tilt, which is linear. *Verification data* have
two rows per set-up, (axis x, true_angle x, placement_angle y, output of x) and likewise for y. The column `true_angle`
distinguishes the two tests. `output` is in arcsec, tilts in rad (files carry their own units).

**Sign.** reading = truth + zero. Source 4's S is a *correction*, with the opposite sign.

Slots: `zero` (arcsec), `scale` = κ, `cross_axis` = m (arcsec); `dividing` and `base_tilt` (arcsec; added to the tilt)
are errors of the test rig, which compensation excludes. Effects on the instrument have one coefficient per axis
(accelerometer); those on the dividing table are common to all axes. A *run* is one mounting of one axis, with a unique
label (x1, y1, …); with several devices, each axis of each device has its own label (7 x, 7 y, …).

**Aliases.** `dividing.face` is an exact alias of S_e, and `dividing.wobble` of m = 1 of the projection of one
axis (a second axis on the same table, with projections of its own, separates them). `zero.cross_axis` is S_d·sin ω
where ω = y: exactly in the zero test, but for cos x in verification data. cos ω falls by 29 % over ±45°, so S_p and S_e
are weakly separated, and a parabola is nearly a projection. The deviation of each mounting absorbs a drift of the
base except within a mounting: in the default plan a drift of 30″ over the test is detectable. Electrical tilt, exact
placement and scale factor need verification data.

Noise: white, of unknown size. Source 4 only gives the table's 2″, which is used here.
Sizes are prior standard deviations for a first calibration, assumed if no source is named.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

import bayescal as bc
from bayescal import xp
from bayescal_models.catalogue import (
    EffectTable,
    Factory,
    centred,
    effect,
    make_common_effects,
    one,
    progress,
)
from bayescal_models.inclinometer import COLUMNS
from bayescal_models.inclinometer.campaign import VERIFICATION, Campaign
from bayescal_models.inclinometer.geometry import ARCSEC, compute_placement_angle, compute_sine
from bayescal_models.inclinometer.simulator import simulate_columns
from bayescal_models.simulated import ReferenceProblem, list_experiments, make_readings_simulator

KNOT_ANGLES_RAD = np.deg2rad(np.arange(-45.0, 46.0, 15.0))  # knots of the spline table


def _evaluate_response(slots, r):
    cross_axis = slots["cross_axis"] * xp.sin(r["placement_angle"])
    rig = slots["dividing"] + slots["base_tilt"]
    if "true_angle" not in r.columns:
        return slots["zero"] + cross_axis + rig
    tilt, zero = r["true_angle"] + ARCSEC * rig, ARCSEC * slots["zero"]
    sine = compute_sine(xp.sin(tilt), zero, xp.cos(tilt), 0.0, slots["scale"], ARCSEC * cross_axis)
    return xp.arcsin(xp.clip(sine, -1.0, 1.0)) / ARCSEC


# Basis functions.


def _evaluate_power(power: int, r: bc.Frame) -> Any:
    return r["placement_angle"] ** power


def _evaluate_sweep_direction(r: bc.Frame) -> Any:
    return r.has_label("direction", "forward") - r.has_label("direction", "backward")


def _evaluate_inverse_cosine(r: bc.Frame) -> Any:
    return 1 / xp.cos(r["true_angle"])


def _evaluate_inverse_cosine_change(r: bc.Frame) -> Any:
    return _evaluate_inverse_cosine(r) - 1


def _evaluate_placement_difference(r: bc.Frame) -> Any:
    return compute_placement_angle(r["true_angle"], r["placement_angle"], xp) - r["placement_angle"]


def _fourier(orders: tuple[int, ...], r: bc.Frame) -> Any:
    angle = r["placement_angle"]
    return xp.stack([f(m * angle) for m in orders for f in (xp.cos, xp.sin)], axis=-1)


def _evaluate_exact_projections(r: bc.Frame) -> Any:
    angle = compute_placement_angle(r["true_angle"], r["placement_angle"], xp)
    return xp.stack([xp.cos(angle), xp.sin(angle)], axis=-1)


def _evaluate_spline(r: bc.Frame) -> Any:
    """Return the natural cubic cardinal splines, (n, 7): 1 at one knot, 0 at the others, linear outside the knots."""
    spline = CubicSpline(KNOT_ANGLES_RAD, np.eye(KNOT_ANGLES_RAD.size), bc_type="natural")
    # Truncated power basis: a line from the first knot, plus the jumps of the third derivative at the knots.
    jumps = np.diff(spline.c[0], axis=0, prepend=0.0, append=0.0)
    distances = r["placement_angle"][..., None] - KNOT_ANGLES_RAD
    linear_part = spline(KNOT_ANGLES_RAD[0]) + distances[..., :1] * spline(KNOT_ANGLES_RAD[0], 1)
    return linear_part + xp.maximum(distances, 0.0) ** 3 @ jumps


def _explain_missing_direction(readings: bc.Measurements) -> str | None:
    """Return why the readings' sweep directions do not identify a hysteresis; None if they do."""
    directions = set(readings.groups("direction")[0])
    if {"forward", "backward"} <= directions:
        return None
    return f"needs sweeps forward and backward; these readings have {', '.join(sorted(directions))} only"


# Factories and effects of this instrument: one coefficient per accelerometer, one for the table, or random deviations
# of accelerometers ("axis"), devices or mountings ("run") with estimated standard deviation.


def _by_axis(basis: Any, equation: str, *columns: str, **fields: Any) -> Factory:
    return effect(basis, equation, *columns, **{"per": "axis", **fields})


def _make_deviation(per: str, equation: str = "", basis: Any = one, *columns: str) -> Factory:
    """Return a factory that creates random deviations of the members of the group `per`, times `basis`."""
    required, varies = (columns, None) if columns else ((per,), ())
    text = equation or f"d[{per}]" + ("" if per == "device" else ",  d ~ N(0, s²)")
    return effect(basis, text, *required, per=per, group_sd_prior=bc.HalfNormal, varies=varies)


def _make_term(power: int) -> tuple[Any, ...]:
    return partial(_evaluate_power, power), f"c·ω{('', '²', '³')[power - 1]}", "placement_angle"


QUADRATIC = _by_axis(*_make_term(2), kind="quadratic")
HYSTERESIS = _by_axis(
    _evaluate_sweep_direction,
    "+c in forward sweeps, −c in backward ones",
    "direction",
    varies=(),
    untestable=_explain_missing_direction,
    kind="hysteresis",
)
PROJECTION = _by_axis(
    partial(_fourier, (1,)), "S_p·cos ω + S_d·sin ω", "placement_angle", parts=("pendulum", "door")
)
EXACT_PROJECTION = _by_axis(
    _evaluate_exact_projections,
    "S_p·cos ω + S_d·sin ω,  ω = atan2(sin y, √(1 − sin²x − sin²y))",
    *("true_angle", "placement_angle"),
    parts=("pendulum", "door"),
)
PLACEMENT_DIFFERENCE = _by_axis(
    _evaluate_placement_difference,
    "c·(atan2(sin y, √(1 − sin²x − sin²y)) − y)",
    *("true_angle", "placement_angle"),
)
SPLINE = _by_axis(
    _evaluate_spline,
    "natural cubic spline through deviations from the line at −45°, −30° … 45°",
    "placement_angle",
    parts=tuple(f"{k:g}" for k in np.rad2deg(KNOT_ANGLES_RAD).round()),
)
SPINDLE_WOBBLE = effect(
    partial(_fourier, (1, 2)),
    "Σ_m a_m·cos mω + b_m·sin mω,  m = 1, 2",
    "placement_angle",
    parts=("cos1", "sin1", "cos2", "sin2"),
)
CROSS_AXIS = _by_axis(one, "m·sin ω", "placement_angle", slot="cross_axis")
ELECTRICAL_TILT = _by_axis(_evaluate_inverse_cosine_change, "S_e·(1/cos x − 1)", "true_angle")
ELECTRICAL_ZERO = _by_axis(_evaluate_inverse_cosine, "S_e/cos x", "true_angle", varies=())
BASE_DRIFT = _by_axis(progress, "c·(t − t̄)/(tmax − tmin)", "time", kind="drift")
TEMPCO = _by_axis(centred, "c·(T − T0)", "temperature", kind="linear")
AXIS_SLOPE, DEVICE_SLOPE = (
    _make_deviation(per, _make_term(1)[1], _make_term(1)[0], "placement_angle")
    for per in ("axis", "device")
)
ZERO_SOURCE = "source 4: 3 to 5 mg of bias"  # 619 to 1031″
FACE_SOURCE = "source 4: face vertical within 2″"
SLOPE_SOURCE = "source 4: its two lines have 0.72 and 0.07″/deg"

EFFECTS = EffectTable.from_rows(
    "source 4; size assumed by us",
    baseline=(
        ("zero.constant", _by_axis(one, "c[axis]", kind="constant"), 1000.0, "arcsec", ZERO_SOURCE),
        ("zero.placement", _by_axis(*_make_term(1)), 2.0, "arcsec/deg", SLOPE_SOURCE),
        ("zero.run", _make_deviation("run"), 2.0, "arcsec"),
    ),
    candidates=(
        ("zero.placement_quadratic", QUADRATIC, 0.005, "arcsec/deg^2"),
        ("zero.projection", PROJECTION, 100.0, "arcsec"),
        ("zero.temperature", TEMPCO, 2.0, "arcsec/degC"),
        ("zero.hysteresis", HYSTERESIS, 2.0, "arcsec"),
        ("zero.cross_axis", CROSS_AXIS, 100.0, "arcsec"),
        ("zero.electrical_tilt", ELECTRICAL_TILT, 100.0, "arcsec"),
        ("zero.exact_placement", PLACEMENT_DIFFERENCE, 2.0, "arcsec/deg"),
        ("scale.constant", _by_axis(one, "κ", "true_angle", kind="constant"), 100.0, "ppm"),
        ("dividing.wobble", SPINDLE_WOBBLE, 2.0, "arcsec", FACE_SOURCE),
        ("dividing.face", effect(one, "c"), 2.0, "arcsec", FACE_SOURCE),
        ("base_tilt.drift", BASE_DRIFT, 2.0, "arcsec"),
        # A laboratory's temperature varies too little for a cubic and too slowly for a lag, and a
        # drift of the zero is an alias of one of the base.
        *make_common_effects(
            *("zero", "arcsec"),
            size=10.0,
            span=5.0,
            pace=0.25,
            causes=("temperature_quadratic", "warm_up", "supply", "temperature_x_supply"),
            per="axis",
        ),
    ),
    others=(
        ("zero.placement_cubic", _by_axis(*_make_term(3), kind="cubic"), 1e-4, "arcsec/deg^3"),
        ("zero.table", SPLINE, 20.0, "arcsec"),
        ("zero.electrical", ELECTRICAL_ZERO, 1000.0, "arcsec"),
        ("zero.projection_exact", EXACT_PROJECTION, 100.0, "arcsec"),
        ("zero.mean", effect(one, "c"), 1000.0, "arcsec", ZERO_SOURCE),
        ("zero.placement_mean", effect(*_make_term(1)), 2.0, "arcsec/deg"),
        ("zero.axis", _make_deviation("axis"), 100.0, "arcsec"),
        ("zero.placement_axis", AXIS_SLOPE, 1.0, "arcsec/deg"),
        ("zero.device", _make_deviation("device"), 100.0, "arcsec"),
        ("zero.placement_device", DEVICE_SLOPE, 1.0, "arcsec/deg"),
    ),
)

# Named models: accelerometers (and devices) of one population; the full equation of verification data, with the
# exact placement angle, untilted S_e, and the scale factor.
SLOPE_NAMES, LINE_NAMES = ("zero.placement",), ("zero.constant", "zero.placement")
AXIS_NAMES = ("zero.mean", "zero.placement_mean", "zero.axis", "zero.placement_axis")
EXACT_NAMES = ("zero.electrical", "zero.projection_exact", "scale.constant")


def _model(*names: str, without: tuple[str, ...] = ()) -> bc.Model:
    model = INSTRUMENT.baseline()
    for name in without:
        model = model - name
    return model + tuple(EFFECTS[name] for name in names)


INSTRUMENT = bc.Instrument(
    name="inclinometer",
    title="two-axis quartz inclinometer: zero offset against placement angle",
    columns=COLUMNS,
    slots=(
        bc.Slot("zero", "arcsec", "zero offset of the accelerometer"),
        bc.Slot("scale", "1", "relative deviation of the scale factor"),
        bc.Slot("cross_axis", "arcsec", "sensitivity to the tilt of the other axis"),
        bc.Slot("dividing", "arcsec", "tilt of the dividing table's face"),
        bc.Slot("base_tilt", "arcsec", "tilt of the table's base"),
    ),
    response=_evaluate_response,
    effects=EFFECTS.baseline,
    candidates=EFFECTS.candidates,
    noise=bc.White(bc.HalfCauchy(2.0)),
    structures=(
        ("line", lambda: INSTRUMENT.baseline()),
        ("quadratic", lambda: _model("zero.placement_quadratic")),
        ("cubic", lambda: _model("zero.placement_quadratic", "zero.placement_cubic")),
        ("projection", lambda: _model("zero.projection", without=SLOPE_NAMES)),
        ("spline table", lambda: _model("zero.table")),
        ("line, hierarchy of axes", lambda: _model(*AXIS_NAMES, without=LINE_NAMES)),
        (
            "line, hierarchy of axes and devices",
            lambda: _model(*AXIS_NAMES, "zero.device", "zero.placement_device", without=LINE_NAMES),
        ),
        ("projection, exact geometry", lambda: _model(*EXACT_NAMES, without=LINE_NAMES)),
    ),
    simulator=simulate_columns,
    experiments=list_experiments(
        simulate_columns,
        {
            "the same again": Campaign(),
            "four mountings of each axis": Campaign(runs=4),
            "±75° by 5°": Campaign(angles=tuple(float(a) for a in range(-75, 76, 5))),
            "±45° by 1°": Campaign(angles=tuple(float(a) for a in range(-45, 46))),
            "forward sweeps alone": Campaign(backward=False),
            "the laboratory's temperature varied by 8 °C": Campaign(swing=8.0),
            "ten minutes at each angle": Campaign(interval=600.0),
        },
    ),
    use=bc.Use("true_angle", "rad", slots=("zero", "scale", "cross_axis")),
    source="source 4",
)
simulate = make_readings_simulator(INSTRUMENT)

# ±45° by 15°, forward and backward, two mountings of each axis: 56 rows.
TILT_EFFECTS = {"zero.electrical_tilt", "zero.exact_placement", "scale.constant"}
reference_problem = ReferenceProblem(
    INSTRUMENT,
    Campaign(angles=tuple(float(a) for a in range(-45, 46, 15))),
    lambda effects: replace(VERIFICATION, runs=2) if TILT_EFFECTS & {*effects} else Campaign(),
)
