"""Two-axis inclinometer of quartz flexure accelerometers: zero offset against placement angle (source 4).

An accelerometer feels A = g·sin x along its axis and reads arcsin(A/g). Its true sensing direction stands a little
beside its flange axis, toward its pendulum direction by S_p and toward its door direction by S_d; turned by the
*placement angle* ω from pendulum toward door attitude it reads, at no tilt,

    S(ω) = S_e + S_p·cos ω + S_d·sin ω                                 (S_e the electrical zero)

and at a tilt x, with the other axis at y,

    reading = arcsin[ (1 + κ)·( sin x + cos x·zero(ω) + m·sin y ) ]

Document: ω = y, and zero(ω) a line. S_e is no angle of the axis and is not multiplied by cos x; it is part of
`zero` here, and `zero.electrical_tilt`, S_e·(1/cos x − 1), takes the cosine out again. Exact (`geometry.py`):
ω = atan2(sin y, √(1 − sin²x − sin²y)).

**One instrument, two tables.** *Zero test*: rows of `axis`, `run`, `placement_angle`, `output` (files may call it
`zero_offset`), no tilt: reading = zero + m·sin ω + dividing + base_tilt, which is affine. *Verification data*: each
row of true_x, true_y, reading_x, reading_y becomes two rows, (axis x, true_angle x, placement_angle y, output
reading_x) and the same for y: `Verification.readings()`. The column `true_angle` is what tells the two apart.
`output` is in arcsec, tilts in rad (files carry their own units).

**Sign.** reading = truth + zero. Source 4's S is a *correction*; `inclinometer.read(…, corrections=True)` negates.

Slots: `zero` (arcsec), `scale` = κ, `cross_axis` = m (arcsec); of the test rig only, and not acting in use:
`dividing`, `base_tilt` (arcsec; added to the tilt). "Per axis": every accelerometer has its own. A *run* is one
mounting of one axis, its label unique to it (x1, y1, …): `accelerometers` makes labels so.

| effect | slot | form | plausible size |
|---|---|---|---|
| `zero.constant` (baseline, per axis) | zero | c | 1000″ |
| `zero.placement` (baseline, per axis) | zero | c·ω | 2″/deg |
| `zero.run` (baseline) | zero | one for each run, spread learned | 2″ |
| `zero.placement_quadratic` (per axis) | zero | c·ω² | 0.005″/deg² |
| `zero.projection` (per axis) | zero | S_p·cos ω, S_d·sin ω | 100″ (up to 1000″) |
| `zero.temperature` (per axis) | zero | c·(T − T0) | 2″/°C |
| `zero.hysteresis` (per axis) | zero | +c forward, −c backward | 2″ |
| `zero.cross_axis` (per axis) | cross_axis | m | 100″ |
| `zero.electrical_tilt` (per axis) | zero | S_e·(1/cos x − 1) | 100″ |
| `zero.exact_placement` (per axis) | zero | c·(ω_exact − y) | 2″/deg |
| `scale.constant` (per axis) | scale | κ | 100 ppm |
| `dividing.wobble` | dividing | cos mω, sin mω, m = 1, 2 | 2″ |
| `dividing.face` | dividing | c | 2″ |
| `base_tilt.drift` (per axis) | base_tilt | (t − t̄)/(tmax − tmin) | 2″ |
| `zero.placement_cubic` (structure) | zero | c·ω³ | 10⁻⁴″/deg³ |
| `zero.table` (structure) | zero | spline through 7 departures from the line | 20″ |
| `zero.electrical` (structure, per axis) | zero | S_e/cos x | 1000″ |
| `zero.projection_exact` (structure, per axis) | zero | the projection, exact ω | 100″ |
| `zero.mean`, `zero.placement_mean` (structure) | zero | c, c·ω of a population | 1000″, 2″/deg |
| `zero.axis`, `zero.placement_axis` (structure) | zero | deviation of an axis, spread learned | 100″, 1″/deg |
| `zero.device`, `zero.placement_device` (structure) | zero | deviation of a device, spread learned | 100″, 1″/deg |

**Aliases.** `dividing.face` is a constant as S_e is, exactly; so is `dividing.wobble` of m = 1 the projection of one
axis (a second axis on the same table, with projections of its own, tells them apart). `zero.cross_axis` is S_d·sin ω
where ω = y: exactly in the zero test, but for cos x in verification data. cos ω falls by 29 % over ±45°, so S_p and S_e
are weakly separated, and a parabola is nearly a projection. Every mounting's own deviation hides all of a base's
drift but what happens within a mounting: in the default plan some 30″ over the test are seen. Electrical tilt, exact
placement and scale factor need verification data.

Noise: white, of unknown size. Source 4 gives none but the table's 2″, which stands for it here.
Sizes are prior standard deviations for a first calibration, ours where no source is named.
"""

from __future__ import annotations

import jax.numpy as jnp

import bayescal as bc
from bayescal_models.inclinometer import COLUMNS, effects
from bayescal_models.inclinometer.campaign import Campaign
from bayescal_models.inclinometer.geometry import ARCSEC, sensed
from bayescal_models.inclinometer.simulator import simulated_columns
from bayescal_models.simulated import experiments, readings_of


def _response(slots, r):
    leak = slots["cross_axis"] * jnp.sin(r["placement_angle"])
    rig = slots["dividing"] + slots["base_tilt"]
    if "true_angle" not in r.columns:
        return slots["zero"] + leak + rig
    tilt = r["true_angle"] + ARCSEC * rig
    zero = ARCSEC * slots["zero"]
    sine = sensed(jnp.sin(tilt), zero, jnp.cos(tilt), 0.0, slots["scale"], ARCSEC * leak)
    return jnp.arcsin(jnp.clip(sine, -1.0, 1.0)) / ARCSEC


def _with(*more: bc.Effect) -> bc.Model:
    return INSTRUMENT.baseline() + more


def _projection() -> bc.Model:
    """S_e of each axis, and its projections in place of the line."""
    return INSTRUMENT.baseline() - effects.LINE + effects.PROJECTION


def _exact_projection() -> bc.Model:
    """The whole equation of verification data: exact placement angle, S_e not tilted, scale factor."""
    bare = INSTRUMENT.baseline() - effects.CONSTANT - effects.LINE
    return bare + (effects.ELECTRICAL_ZERO, effects.EXACT_PROJECTION, effects.SCALE)


def _hierarchy(devices: bool = False) -> bc.Model:
    """Accelerometers (and devices) drawn from one population, between-group standard deviations estimated."""
    bare = INSTRUMENT.baseline() - effects.CONSTANT - effects.LINE
    made = bare + (effects.MEAN, effects.MEAN_LINE, effects.AXIS, effects.AXIS_LINE)
    return made + (effects.DEVICE, effects.DEVICE_LINE) if devices else made


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
    effects=(effects.CONSTANT, effects.LINE, effects.RUN),
    candidates=(
        effects.QUADRATIC,
        effects.PROJECTION,
        effects.TEMPERATURE,
        effects.HYSTERESIS,
        effects.CROSS_AXIS,
        effects.ELECTRICAL,
        effects.EXACT,
        effects.SCALE,
        effects.WOBBLE,
        effects.FACE,
        effects.DRIFT,
    ),
    noise=bc.White(bc.HalfCauchy(2.0)),
    structures=(
        ("line", lambda: INSTRUMENT.baseline()),
        ("quadratic", lambda: _with(effects.QUADRATIC)),
        ("cubic", lambda: _with(effects.QUADRATIC, effects.CUBIC)),
        ("projection", _projection),
        ("spline table", lambda: _with(effects.TABLE)),
        ("line, hierarchy of axes", _hierarchy),
        ("line, hierarchy of axes and devices", lambda: _hierarchy(devices=True)),
        ("projection, exact geometry", _exact_projection),
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
simulate = readings_of(INSTRUMENT, simulated_columns)
