"""Three gyroscopes on a rate table about known axes or in moves between poses, and at rest.

A reading is the mean of three outputs while the table turns about an axis u of the body at a known rate Ω, or rests:

    y_a = ω_a + b_a + Σ_j G_aj·ω_j + K2_a·ω_a² + Ω·(θ × u)_a + e_a,     ω = Ω·u + ω_E

G has the deviations of the scale factors on its diagonal and six misalignments off it, θ is the rotation error of the
mounting on the table, of standard uncertainty `pose_uncertainty` about each body axis, and ω_E the Earth's rotation if
given. (G·θ, at most 2 % of θ, is neglected, so that the output is linear in all unknowns.) All readings of one mounting
have the same θ, whose uncertainty limits that of the misalignments. By default all readings about one axis, in both
directions, are one mounting; a column `mounting` overrides this, as for a table of two or three axes (one mounting).

**Moves.** The function `moves` integrates the outputs during a rotation (a move) between two poses at rest, in which
accelerometers measure gravity. A reading is the mean output over a move, or a pose, along a space-fixed direction a(t),

    y = mean of aᵀ(ω + b + G·ω + Γ·f + K2·ω²) + wᵀω_E + e

with the g-sensitivity matrix Γ and the specific force f; the means of a_a, a_a·ω_j, a_a·f_j, a_a·ω_a² and the weights w
of the Earth's rotation are columns. `moved()` is the baseline for moves: no mounting errors, unknown `earth.rotation`.

**Identifiability.** Readings at rest determine the bias and, in poses of known gravity, its g-sensitivity. Rotation
about one axis determines the column of G of that axis; rotation about three axes determines all of G, its off-diagonals
with at least the uncertainty of the mounting. An error of the table's rate is an exact alias of a common scale factor
of all three axes. Full turns of the table cancel the Earth's rotation (15.04 °/h) except along the table's axis.

Moves about level axes determine all of G in the axes of the accelerometers, with at least the uncertainty of these
axes. A constant rate about the vertical in every pose is an alias of a bias.

Noise: white, one standard deviation for all three axes; for moves in addition to each reading's known uncertainty.
"""

from __future__ import annotations

import bayescal as bc
from bayescal import xp
from bayescal_models.catalogue import EffectTable, family, one
from bayescal_models.gyro_triad import COLUMNS, OUTPUTS
from bayescal_models.gyro_triad.campaign import Campaign
from bayescal_models.gyro_triad.simulator import simulate_columns
from bayescal_models.simulated import ReferenceProblem, make_readings_simulator
from bayescal_models.triad.columns import EARTH_RATES, MEAN_FORCE, MEAN_RATE, SQUARED_RATE_COLUMNS
from bayescal_models.triad.equation import (
    AXES,
    BIAS,
    FIRST_ORDER,
    LOWER,
    SCALE,
    SQUARE,
    UPPER,
    build_equation,
    make_slots,
)
from bayescal_models.triad.experiments import RATE_EXPERIMENTS
from bayescal_models.triad.families import constant, drift, run_offset, tempco, thermal_lag

GRAVITY_COLUMNS = tuple(f"gravity_{a}" for a in AXES)
G_SLOTS = tuple(f"sensitivity_{a}{j}" for a in AXES for j in AXES)
TURN_SLOTS = tuple(f"turn_{a}" for a in AXES)
DIRECTION_COLUMNS = tuple(f"direction_{a}" for a in AXES)
EARTH_COLUMNS = tuple(f"earth_{a}" for a in AXES)
SENSING_AXIS_COLUMNS = tuple(f"across_{a}" for a in AXES)
MISALIGNMENT_SLOTS = (*UPPER, *LOWER)


def _stack_all(values, names):
    return xp.stack([values[name] for name in names], axis=-1)


def _compute_true_rate(r):
    rate = r["rate"][..., None] * _stack_all(r, DIRECTION_COLUMNS)
    return rate + _stack_all(r, EARTH_COLUMNS) if EARTH_COLUMNS[0] in r.columns else rate


def _build_equation(slots, r):
    outputs = build_equation(slots, r)
    if GRAVITY_COLUMNS[0] not in r.columns:
        return outputs
    matrices = _stack_all(slots, G_SLOTS).reshape(r.size, 3, 3)
    gravity_drift = xp.sum(matrices * _stack_all(r, GRAVITY_COLUMNS)[:, None, :], axis=-1)
    return lambda rate: outputs(rate) + gravity_drift


VECTOR = bc.Vector(
    outputs=OUTPUTS,
    equation=_build_equation,
    acting=_compute_true_rate,
    common_scale=0.03,
    rig=(*TURN_SLOTS, *EARTH_RATES),
    secondary_columns=GRAVITY_COLUMNS,
)


def _evaluate_move_mean(slots, r):
    """Return mean outputs over rotations between poses, along directions fixed in space, °/s; linear in all slots."""
    flat_identity = xp.eye(3).ravel()
    terms = (
        (SENSING_AXIS_COLUMNS, BIAS),
        (MEAN_RATE, FIRST_ORDER),
        (MEAN_FORCE, G_SLOTS),
        (SQUARED_RATE_COLUMNS, SQUARE),
        (EARTH_RATES, EARTH_RATES),
    )
    total = xp.sum(_stack_all(r, MEAN_RATE) * flat_identity, axis=-1)
    for columns, slot_names in terms:
        total = total + xp.sum(_stack_all(r, columns) * _stack_all(slots, slot_names), axis=-1)
    return total


def _evaluate_response(slots, r):
    if MEAN_RATE[0] in r.columns:
        return _evaluate_move_mean(slots, r)
    axis_error = xp.cross(_stack_all(slots, TURN_SLOTS), _stack_all(r, DIRECTION_COLUMNS))
    error = r["rate"][..., None] * axis_error
    return VECTOR.response(slots, r) + xp.sum(_stack_all(r, SENSING_AXIS_COLUMNS) * error, axis=-1)


def _evaluate_mounting_uncertainty(r):
    return r["pose_uncertainty"]


SHEETS = "zero offset and (cross-axis) sensitivity in the data sheets of BMI088, ICM-20948 and ADXRS645; size assumed"
TEMPCO = "change with temperature in the data sheets of BMI088, ICM-20948 and ADXRS645; size assumed by us"
PACKAGE_SOURCE = "assumed: 1 mrad in 50 °C, for a plastic package"
MOUNTING_ERROR = family(
    TURN_SLOTS,
    _evaluate_mounting_uncertainty,
    "c[mounting]·u(mounting),  c ~ N(0, 1)",
    *("mounting", "pose_uncertainty"),
    per="mounting",
    varies=(),
)
G_SENSITIVITY = family(G_SLOTS, one, "Σ_j c_aj·g_j", *GRAVITY_COLUMNS, along="", varies=())
EARTH_ROTATION = family(
    EARTH_RATES,
    one,
    "ω_E along the axes of the body in the first pose of a run",
    *EARTH_RATES,
    per="run",
    varies=(),
)

# Sizes are those of consumer MEMS parts.
MOUNTING_SOURCE = "the standard uncertainty of the mounting, as given with the readings"
G_SOURCE = "IEEE Std 1431-2004, acceleration-sensitive drift; data sheet of BMI088; size assumed"
NONLINEARITY = "IEEE Std 1431-2004, scale-factor nonlinearity; size assumed by us, 0.1 % at 100 °/s"
EARTH_SOURCE = "15.041 °/h in an unknown direction"

EFFECTS = EffectTable.from_rows(
    SHEETS,
    baseline=(
        ("bias.constant", constant(BIAS), 3.0, "deg/s"),
        ("scale.constant", constant(SCALE), 20000.0, "ppm"),
        ("misalignment.constant", constant(MISALIGNMENT_SLOTS), 20.0, "mrad"),
        ("turn.mounting", MOUNTING_ERROR, 1.0, "1", MOUNTING_SOURCE),
    ),
    candidates=(
        ("bias.temperature", tempco(BIAS), 0.03, "deg/s/degC", TEMPCO),
        ("scale.temperature", tempco(SCALE), 200.0, "ppm/degC", TEMPCO),
        ("misalignment.temperature", tempco(MISALIGNMENT_SLOTS), 0.02, "mrad/degC", PACKAGE_SOURCE),
        ("bias.temperature_quadratic", tempco(BIAS, 2), 3e-4, "deg/s/degC^2", TEMPCO),
        ("bias.g_sensitivity", G_SENSITIVITY, 0.1, "deg/s/g", G_SOURCE),
        ("bias.thermal_lag", thermal_lag(BIAS), 0.03, "deg/s/degC", TEMPCO),
        ("square.constant", constant(SQUARE, "K2·ω²"), 10.0, "ppm*s/deg", NONLINEARITY),
        ("bias.drift", drift(BIAS), 0.05, "deg/s", "assumed by us"),
        ("bias.run", run_offset(BIAS), 0.1, "deg/s", "assumed: turn-on repeatability"),
    ),
    others=(("earth.rotation", EARTH_ROTATION, 15.041 / 3600 / 3**0.5, "deg/s", EARTH_SOURCE),),
)


def moved() -> bc.Model:
    """Return the baseline for rotations between poses: no mounting errors; the Earth's rotation is estimated."""
    return INSTRUMENT.baseline() - "turn.mounting" + EFFECTS["earth.rotation"]


INSTRUMENT = bc.Instrument(
    name="gyro_triad",
    title="three gyroscopes on a rate table and at rest: bias, scale, misalignment",
    columns=COLUMNS,
    slots=(
        *make_slots("deg/s", "rate"),
        *(bc.Slot(n, "s/deg", f"second-order coefficient of axis {n[-1]}") for n in SQUARE),
        *(bc.Slot(n, "rad", f"mounting error about axis {n[-1]}") for n in TURN_SLOTS),
        *(
            bc.Slot(n, "deg/s/g", f"g-sensitivity of axis {n[-2]} to force along {n[-1]}")
            for n in G_SLOTS
        ),
        *(
            bc.Slot(n, "deg/s", f"Earth's rotation along axis {n[-1]} of the first pose")
            for n in EARTH_RATES
        ),
    ),
    response=_evaluate_response,
    effects=EFFECTS.baseline,
    candidates=EFFECTS.candidates,
    noise=bc.White(bc.HalfCauchy(0.03)),
    simulator=simulate_columns,
    structures=(("moves", moved),),
    experiments=RATE_EXPERIMENTS,
    vector=VECTOR,
    source="IEEE Std 1431-2004, model equation; rates about the axes of a table",
)
simulate = make_readings_simulator(INSTRUMENT)
# Five rates in three mountings; with hidden effects six mountings at three temperatures.
SMALL_CAMPAIGN = Campaign(mountings=("x", "y", "z"))
EFFECT_CAMPAIGN = Campaign(temperatures=(-20.0, 25.0, 70.0), runs=2)
reference_problem = ReferenceProblem(INSTRUMENT, SMALL_CAMPAIGN, EFFECT_CAMPAIGN)
