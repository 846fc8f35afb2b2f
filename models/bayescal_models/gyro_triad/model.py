"""Three gyroscopes on a rate table about known axes or in moves between poses, and at rest.

A reading is the mean of three outputs while the table turns about an axis u of the body at a known rate Ω, or rests:

    y_a = ω_a + b_a + Σ_j G_aj·ω_j + K2_a·ω_a² + Ω·(θ × u)_a + e_a,     ω = Ω·u + ω_E

G holds the deviations of the scale factors and six misalignments, θ is the rotation by which the mounting on the table
is off, known to `pose_uncertainty` about each axis of the body, and ω_E the Earth's rotation where it is given. (G·θ,
2 % of θ at most, is left out: the output is linear in all that is unknown.) All
readings of one mounting share θ: turning more often about one axis does not tell its misalignments better than the
mounting is known. Readings about one axis, forward or back, are of one mounting unless the column `mounting` says
which are; on a table of two or three axes all of them are.

**Moves.** `moves` of bayescal integrates the outputs between two poses of accelerometers, and a reading is their mean
over the move along a direction a(t) that turns with the unit; in pose or move

    y = mean of aᵀ(ω + b + G·ω + Γ·f + K2·ω²) + wᵀω_E + e

with the means of a_a, a_a·ω_j, a_a·f_j, a_a·ω_a² and w as columns. `moved()` is the baseline there: no mounting, and
`earth.rotation` is unknown.

| effect | coefficients | plausible size |
|---|---|---|
| `bias.constant` (baseline) | x, y, z | 3 °/s |
| `scale.constant` (baseline) | x, y, z | 2 % |
| `misalignment.constant` (baseline) | xy, xz, yz, yx, zx, zy | 20 mrad |
| `turn.mounting` (baseline) | x, y, z of each mounting | `pose_uncertainty` |
| `bias.temperature` | x, y, z | 0.03 °/s/°C |
| `scale.temperature` | x, y, z | 200 ppm/°C |
| `misalignment.temperature` | xy, xz, yz, yx, zx, zy | 20 µrad/°C |
| `bias.temperature_quadratic` | x, y, z | 0.3 m°/s/°C² |
| `bias.g_sensitivity` | nine | 0.1 °/s/g |
| `bias.thermal_lag` | x, y, z, one time | 0.03 °/s/°C |
| `square.constant` (K2) | x, y, z | 10 ppm/(°/s) |
| `earth.rotation` (baseline of moves) | along the first pose's axes, of each run | 15.04 °/h |
| `bias.drift` | x, y, z | 0.05 °/s |
| `bias.run` | x, y, z for each run, learned | 0.1 °/s |

One effect on a family is one effect: its coefficients are found or dropped together.

**What readings determine.** At rest: bias alone and, in poses of which gravity is known, its g-sensitivity. About one
axis: the column of G of that axis. About three: all of G, its off-diagonals no better than the mounting. A rate that
the table states wrongly is a scale factor of all three axes, and nothing here tells the two apart. The Earth turns at
15.04 °/h, 0.0042 °/s: averaged over whole turns of the table its part along the axis remains.

Moves about level axes determine all of G, in the axes of the accelerometers and no better than these are known; a
constant rate about the vertical in every pose is a bias.

Noise: white, one standard deviation for all three axes; of moves beside the known one of each reading.
"""

from __future__ import annotations

import jax.numpy as jnp

import bayescal as bc
from bayescal_models.gyro_triad import COLUMNS, OUTPUTS, effects
from bayescal_models.gyro_triad.simulator import simulated_columns
from bayescal_models.simulated import readings_of
from bayescal_models.triad.columns import AROUND, PULLED, SQUARED, TURNED
from bayescal_models.triad.equation import BIAS, FIRST, SQUARE, equation, slots
from bayescal_models.triad.experiments import RATES


def _stacked(values, names):
    return jnp.stack([values[name] for name in names], axis=1)


def _acting(r):
    rate = r["rate"][:, None] * _stacked(r, effects.DIRECTION)
    return rate + _stacked(r, effects.EARTH) if effects.EARTH[0] in r.columns else rate


def _equation(slots, r):
    outputs = equation(slots, r)
    if effects.GRAVITY[0] not in r.columns:
        return outputs
    each = _stacked(slots, effects.SENSITIVITY).reshape(r.size, 3, 3)
    by_gravity = jnp.sum(each * _stacked(r, effects.GRAVITY)[:, None, :], axis=2)
    return lambda rate: outputs(rate) + by_gravity


VECTOR = bc.Vector(
    outputs=OUTPUTS,
    equation=_equation,
    acting=_acting,
    common_scale=0.03,
    rig=(*effects.TURN, *AROUND),
    beside=effects.GRAVITY,
)


def _in_moves(slots, r):
    """Means along directions that turn with the unit, as moves between poses give them: linear in all slots."""
    identity = jnp.eye(3).ravel()
    levers = (
        (effects.ACROSS, BIAS),
        (TURNED, FIRST),
        (PULLED, effects.SENSITIVITY),
        (SQUARED, SQUARE),
        (AROUND, AROUND),
    )
    total = jnp.sum(_stacked(r, TURNED) * identity, axis=1)
    for columns, own in levers:
        total = total + jnp.sum(_stacked(r, columns) * _stacked(slots, own), axis=1)
    return total


def _response(slots, r):
    if TURNED[0] in r.columns:
        return _in_moves(slots, r)
    aside = jnp.cross(_stacked(slots, effects.TURN), _stacked(r, effects.DIRECTION))
    beside = r["rate"][:, None] * aside
    return VECTOR.response(slots, r) + jnp.sum(_stacked(r, effects.ACROSS) * beside, axis=1)


def moved() -> bc.Model:
    """The baseline of moves between poses: no mounting on a table, and the Earth's rotation is unknown."""
    return INSTRUMENT.baseline() - "turn.mounting" + effects.EARTH_ROTATION


INSTRUMENT = bc.Instrument(
    name="gyro_triad",
    title="three gyroscopes on a rate table and at rest: bias, scale, misalignment",
    columns=COLUMNS,
    slots=(
        *slots("deg/s", "rate"),
        *(bc.Slot(n, "s/deg", f"of axis {n[-1]}, times its own input squared") for n in SQUARE),
        *(
            bc.Slot(n, "rad", f"of the mounting on the table, about axis {n[-1]}")
            for n in effects.TURN
        ),
        *(
            bc.Slot(n, "deg/s/g", f"of axis {n[-2]} to the specific force along {n[-1]}")
            for n in effects.SENSITIVITY
        ),
        *(
            bc.Slot(n, "deg/s", f"the Earth's rotation, along axis {n[-1]} of the first pose")
            for n in AROUND
        ),
    ),
    response=_response,
    effects=(effects.CONSTANT, effects.FACTOR, effects.TURNED, effects.MOUNTING),
    candidates=(
        effects.BIAS_TEMPERATURE,
        effects.SCALE_TEMPERATURE,
        effects.TURNED_TEMPERATURE,
        effects.BIAS_QUADRATIC,
        effects.G_SENSITIVITY,
        effects.LAG,
        effects.SQUARES,
        effects.DRIFT,
        effects.RUN,
    ),
    noise=bc.White(bc.HalfCauchy(0.03)),
    simulator=simulated_columns,
    structures=(("moves", moved),),
    experiments=RATES,
    vector=VECTOR,
    source="IEEE Std 1431-2004, model equation; rates about the axes of a table",
)
simulate = readings_of(INSTRUMENT, simulated_columns)
