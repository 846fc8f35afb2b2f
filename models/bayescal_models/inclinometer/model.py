"""Two-axis inclinometer of quartz flexure accelerometers: zero offset against placement angle (source 4).

An accelerometer feels A = g·sin x along its axis and reads arcsin(A/g). Its true sensing direction deviates
from its flange axis by S_p toward its pendulum direction and by S_d toward its door direction; turned by the
*placement angle* ω from pendulum toward door attitude it reads, at no tilt,

    S(ω) = S_e + S_p·cos ω + S_d·sin ω                                 (S_e the electrical zero)

and at a tilt x, with the other axis at y,

    reading = arcsin[ (1 + κ)·( sin x + cos x·zero(ω) + m·sin y ) ]

Document: ω = y, and zero(ω) a line. S_e is not an angle of the axis and not multiplied by cos x; it is part of
`zero` here, and `zero.electrical_tilt`, S_e·(1/cos x − 1), removes the cosine. Exact (`geometry.py`):
ω = atan2(sin y, √(1 − sin²x − sin²y)).

**One instrument, two tables.** *Zero test*: rows of `axis`, `run`, `placement_angle`, `output` (files may call it
`zero_offset`), no tilt: reading = zero + m·sin ω + dividing + base_tilt, which is affine. *Verification data*: two rows
of each set-up, (axis x, true_angle x, placement_angle y, output of x) and the same for y. The column `true_angle`
distinguishes the two.
`output` is in arcsec, tilts in rad (files carry their own units).

**Sign.** reading = truth + zero. Source 4's S is a *correction*: minus that.

Slots: `zero` (arcsec), `scale` = κ, `cross_axis` = m (arcsec); of the test rig only, excluded in use:
`dividing`, `base_tilt` (arcsec; added to the tilt). Effects on the instrument have one
coefficient per axis (accelerometer); the dividing table is common to all. A *run* is one mounting of
one axis, its label unique to it (x1, y1, …); of several devices each axis has a label of its own (7 x, 7 y, …).

**Aliases.** `dividing.face` is an exact alias of S_e, and `dividing.wobble` of m = 1 of the projection of one
axis (a second axis on the same table, with projections of its own, separates them). `zero.cross_axis` is S_d·sin ω
where ω = y: exactly in the zero test, but for cos x in verification data. cos ω falls by 29 % over ±45°, so S_p and S_e
are weakly separated, and a parabola is nearly a projection. The deviation of each mounting absorbs a drift of the
base except within a mounting: in the default plan a drift of 30″ over the test is detectable. Electrical tilt, exact
placement and scale factor need verification data.

Noise: white, of unknown size. Source 4 only gives the table's 2″, which is used here.
Sizes are prior standard deviations for a first calibration, ours if no source is named.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

import bayescal as bc
from bayescal import xp
from bayescal_models.catalogue import EffectTable, Maker, centred, effect, one, progress, recorded
from bayescal_models.inclinometer import COLUMNS
from bayescal_models.inclinometer.campaign import VERIFICATION, Campaign
from bayescal_models.inclinometer.geometry import ARCSEC, exact_placement, sensed
from bayescal_models.inclinometer.simulator import simulated_columns
from bayescal_models.simulated import ReferenceProblem, experiments, readings_of

KNOTS = np.deg2rad(np.arange(-45.0, 46.0, 15.0))  # knots of the spline table


def _response(slots, r):
    leak = slots["cross_axis"] * xp.sin(r["placement_angle"])
    rig = slots["dividing"] + slots["base_tilt"]
    if "true_angle" not in r.columns:
        return slots["zero"] + leak + rig
    tilt = r["true_angle"] + ARCSEC * rig
    zero = ARCSEC * slots["zero"]
    sine = sensed(xp.sin(tilt), zero, xp.cos(tilt), 0.0, slots["scale"], ARCSEC * leak)
    return xp.arcsin(xp.clip(sine, -1.0, 1.0)) / ARCSEC


# Bases.


def _angle_to(power: int, r: bc.Frame) -> Any:
    return r["placement_angle"] ** power


def _sweep(r: bc.Frame) -> Any:
    return r.has_label("direction", "forward") - r.has_label("direction", "backward")


def _of_tilt(r: bc.Frame) -> Any:
    return 1 / xp.cos(r["true_angle"])


def _of_tilt_from_level(r: bc.Frame) -> Any:
    return _of_tilt(r) - 1


def _exact_less_linear(r: bc.Frame) -> Any:
    return exact_placement(r["true_angle"], r["placement_angle"], xp) - r["placement_angle"]


def _waves(orders: tuple[int, ...], r: bc.Frame) -> Any:
    angle = r["placement_angle"]
    return xp.stack([f(m * angle) for m in orders for f in (xp.cos, xp.sin)], axis=-1)


def _exact_waves(r: bc.Frame) -> Any:
    angle = exact_placement(r["true_angle"], r["placement_angle"], xp)
    return xp.stack([xp.cos(angle), xp.sin(angle)], axis=-1)


def _spline(r: bc.Frame) -> Any:
    """Return the natural cubic splines that are 1 at one knot and 0 at the others; linear beyond."""
    spline = CubicSpline(KNOTS, np.eye(KNOTS.size), bc_type="natural")
    # A line from below the first knot, bent at each knot by the step of its third derivative.
    steps = np.diff(spline.c[0], axis=0, prepend=0.0, append=0.0)
    beyond = r["placement_angle"][..., None] - KNOTS
    line = spline(KNOTS[0]) + beyond[..., :1] * spline(KNOTS[0], 1)
    return line + xp.maximum(beyond, 0.0) ** 3 @ steps


def _one_way(readings: bc.Measurements) -> str | None:
    """Return the reason why these sweep directions do not identify a hysteresis; None if they do."""
    directions = set(readings.groups("direction")[0])
    if {"forward", "backward"} <= directions:
        return None
    return f"needs sweeps forward and backward; these readings have {', '.join(sorted(directions))} only"


# Families of this instrument: one coefficient per accelerometer, one for the table, or one per member of a
# population of accelerometers ("axis"), devices or mountings ("run") with learned standard deviation.


def _per_axis(basis: Any, equation: str, *columns: str, **fields: Any) -> Maker:
    return effect(basis, equation, *columns, **{"per": "axis", **fields})


def _deviate(per: str, equation: str = "", basis: Any = one, *columns: str) -> Maker:
    """Build deviations of a group's members from the common value; a constant unless a basis is given."""
    needed, varies = (columns, None) if columns else ((per,), ())
    text = equation or f"d[{per}]" + ("" if per == "device" else ",  d ~ N(0, s²)")
    return effect(basis, text, *needed, per=per, learned=bc.HalfNormal, varies=varies)


def _of_placement(power: int) -> tuple[Any, ...]:
    return partial(_angle_to, power), f"c·ω{('', '²', '³')[power - 1]}", "placement_angle"


CURVED = _per_axis(*_of_placement(2), kind="quadratic")
FORWARD = _per_axis(
    _sweep,
    "+c in forward sweeps, −c in backward ones",
    "direction",
    varies=(),
    untestable=_one_way,
    kind="hysteresis",
)
PROJECTED = _per_axis(
    partial(_waves, (1,)), "S_p·cos ω + S_d·sin ω", "placement_angle", parts=("pendulum", "door")
)
PROJECTED_EXACTLY = _per_axis(
    _exact_waves,
    "S_p·cos ω + S_d·sin ω,  ω = atan2(sin y, √(1 − sin²x − sin²y))",
    *("true_angle", "placement_angle"),
    parts=("pendulum", "door"),
)
EXACT_LESS_Y = _per_axis(
    _exact_less_linear,
    "c·(atan2(sin y, √(1 − sin²x − sin²y)) − y)",
    *("true_angle", "placement_angle"),
)
SPLINE = _per_axis(
    _spline,
    "natural cubic spline through departures from the line at −45°, −30° … 45°",
    "placement_angle",
    parts=tuple(f"{k:g}" for k in np.rad2deg(KNOTS).round()),
)
SPINDLE = effect(
    partial(_waves, (1, 2)),
    "Σ_m a_m·cos mω + b_m·sin mω,  m = 1, 2",
    "placement_angle",
    parts=("cos1", "sin1", "cos2", "sin2"),
)
LEAK = _per_axis(one, "m·sin ω", "placement_angle", slot="cross_axis")
S_E_TILT = _per_axis(_of_tilt_from_level, "S_e·(1/cos x − 1)", "true_angle")
S_E = _per_axis(_of_tilt, "S_e/cos x", "true_angle", varies=())
SETTLING = _per_axis(progress, "c·(t − t̄)/(tmax − tmin)", "time", kind="drift")
WARM = _per_axis(centred, "c·(T − T0)", "temperature", kind="linear")
AXIS_LINE, DEVICE_LINE = (
    _deviate(per, _of_placement(1)[1], _of_placement(1)[0], "placement_angle")
    for per in ("axis", "device")
)
ZERO, FACE = "source 4: 3 to 5 mg of bias", "source 4: face vertical within 2″"  # 619 to 1031″
TWO_LINES = "source 4: its two lines have 0.72 and 0.07″/deg"

EFFECTS = EffectTable.of(
    "source 4; size ours",
    baseline=(
        ("zero.constant", _per_axis(one, "c[axis]", kind="constant"), 1000.0, "arcsec", ZERO),
        ("zero.placement", _per_axis(*_of_placement(1)), 2.0, "arcsec/deg", TWO_LINES),
        ("zero.run", _deviate("run"), 2.0, "arcsec"),
    ),
    candidates=(
        ("zero.placement_quadratic", CURVED, 0.005, "arcsec/deg^2"),
        ("zero.projection", PROJECTED, 100.0, "arcsec"),
        ("zero.temperature", WARM, 2.0, "arcsec/degC"),
        ("zero.hysteresis", FORWARD, 2.0, "arcsec"),
        ("zero.cross_axis", LEAK, 100.0, "arcsec"),
        ("zero.electrical_tilt", S_E_TILT, 100.0, "arcsec"),
        ("zero.exact_placement", EXACT_LESS_Y, 2.0, "arcsec/deg"),
        ("scale.constant", _per_axis(one, "κ", "true_angle", kind="constant"), 100.0, "ppm"),
        ("dividing.wobble", SPINDLE, 2.0, "arcsec", FACE),
        ("dividing.face", effect(one, "c"), 2.0, "arcsec", FACE),
        ("base_tilt.drift", SETTLING, 2.0, "arcsec"),
        # A laboratory's temperature varies too little for a cubic and too slowly for a lag, and a
        # drift of the zero is an alias of one of the base.
        *recorded(
            *("zero", "arcsec"),
            size=10.0,
            span=5.0,
            pace=0.25,
            causes=("temperature_quadratic", "warm_up", "supply", "temperature_x_supply"),
            per="axis",
        ),
    ),
    others=(
        ("zero.placement_cubic", _per_axis(*_of_placement(3), kind="cubic"), 1e-4, "arcsec/deg^3"),
        ("zero.table", SPLINE, 20.0, "arcsec"),
        ("zero.electrical", S_E, 1000.0, "arcsec"),
        ("zero.projection_exact", PROJECTED_EXACTLY, 100.0, "arcsec"),
        ("zero.mean", effect(one, "c"), 1000.0, "arcsec", ZERO),
        ("zero.placement_mean", effect(*_of_placement(1)), 2.0, "arcsec/deg"),
        ("zero.axis", _deviate("axis"), 100.0, "arcsec"),
        ("zero.placement_axis", AXIS_LINE, 1.0, "arcsec/deg"),
        ("zero.device", _deviate("device"), 100.0, "arcsec"),
        ("zero.placement_device", DEVICE_LINE, 1.0, "arcsec/deg"),
    ),
)

# Named models: accelerometers (and devices) of one population; the full equation of verification data, with the
# exact placement angle, untilted S_e, and the scale factor.
LINE, BOTH = ("zero.placement",), ("zero.constant", "zero.placement")
AXES = ("zero.mean", "zero.placement_mean", "zero.axis", "zero.placement_axis")
EXACT = ("zero.electrical", "zero.projection_exact", "scale.constant")


def _with(*added: str, without: tuple[str, ...] = ()) -> bc.Model:
    model = INSTRUMENT.baseline()
    for name in without:
        model = model - name
    return model + tuple(EFFECTS[name] for name in added)


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
    response=_response,
    effects=EFFECTS.baseline,
    candidates=EFFECTS.candidates,
    noise=bc.White(bc.HalfCauchy(2.0)),
    structures=(
        ("line", lambda: INSTRUMENT.baseline()),
        ("quadratic", lambda: _with("zero.placement_quadratic")),
        ("cubic", lambda: _with("zero.placement_quadratic", "zero.placement_cubic")),
        ("projection", lambda: _with("zero.projection", without=LINE)),
        ("spline table", lambda: _with("zero.table")),
        ("line, hierarchy of axes", lambda: _with(*AXES, without=BOTH)),
        (
            "line, hierarchy of axes and devices",
            lambda: _with(*AXES, "zero.device", "zero.placement_device", without=BOTH),
        ),
        ("projection, exact geometry", lambda: _with(*EXACT, without=BOTH)),
    ),
    simulator=simulated_columns,
    experiments=experiments(
        simulated_columns,
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
simulate = readings_of(INSTRUMENT)

ON_TILT = {"zero.electrical_tilt", "zero.exact_placement", "scale.constant"}


def _fuller(effects) -> Campaign:
    """Choose a zero test; a verification where effects are on tilt."""
    return replace(VERIFICATION, runs=2) if ON_TILT & {*effects} else Campaign()


# ±45° by 15°, forward and backward, two mountings of each axis: 56 rows.
reference_problem = ReferenceProblem(
    INSTRUMENT, Campaign(angles=tuple(float(a) for a in range(-45, 46, 15))), _fuller
)
