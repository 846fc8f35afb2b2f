"""Three accelerometers in poses at rest: the direction of gravity varies, and its magnitude is known.

A *pose* is one averaged reading of three outputs. The specific force f at rest is 1 g up; its direction is unknown, or
known to `pose_uncertainty` (a dividing head, a robot):

    y_a = f_a + b_a + Σ_j G_aj·f_j + K2_a·f_a² + Σ_{i<j} K_aij·f_i·f_j + K3_a·f_a³ + e_a,     |f| = magnitude

**Gauge.** If directions are unknown, a rotation of the triad changes no reading. By convention the z axis of the body
is that of the sensor z, and its y axis lies in the plane of the sensors y and z: three misalignments (x toward y, x
toward z, y toward z) in place of six. `misalignment.frame` has the other three, which need known directions.

**What poses determine.** Nine coefficients need nine poses or more that do not all lie on a quadric other than the
sphere: six positions determine bias and scale but no misalignment; poses in a plane leave the axis normal to it free;
poses within 10° of level determine little more than the difference of bias and scale of z. Undetermined coefficients
keep their prior standard deviation. K2 and cross terms of 1 mg/g² change |f| by less than 0.5 mg, K3 of 1 mg/g³, after
adjustment of the scale factor, by less than 0.3 mg.

An unstated local gravity makes all three scale factors uncertain by a common factor (`magnitude.local_gravity`).

Noise: white, one standard deviation for all three axes.
"""

from __future__ import annotations

from typing import Any

import bayescal as bc
from bayescal_models import local_gravity
from bayescal_models.accelerometer_triad import COLUMNS, OUTPUTS
from bayescal_models.accelerometer_triad.simulator import simulate_columns
from bayescal_models.catalogue import EffectTable
from bayescal_models.simulated import ReferenceProblem, make_readings_simulator
from bayescal_models.triad.campaign import TWO_SESSIONS, Campaign
from bayescal_models.triad.equation import (
    BIAS,
    CROSS,
    CUBE,
    LOWER,
    SCALE,
    SQUARE,
    UPPER,
    build_equation,
    make_higher_order_slots,
    make_slots,
)
from bayescal_models.triad.experiments import list_pose_experiments
from bayescal_models.triad.families import (
    constant,
    drift,
    run_offset,
    tempco,
    thermal_lag,
    triad_rotation,
)
from bayescal_models.triad.scatter import set_noise_prior

VECTOR = bc.Vector(outputs=OUTPUTS, equation=build_equation, common_scale=0.03)


def _evaluate_response(slots, r):
    return VECTOR.response(slots, r)


SHEETS = "zero-g offset and (cross-axis) sensitivity in the data sheets of ADXL355, BMI088 and ICM-20948; size assumed"
TEMPCO = "change with temperature in the data sheets of ADXL355, BMI088 and ICM-20948; size assumed"
NONLINEARITY = "model equation of IEEE Std 1293-2018; we assume a nonlinearity of 0.1 % at 1 g"
PACKAGE_SOURCE = "our assumption: 1 mrad in 50 °C, for a plastic package"
MOUNTING_SOURCE = "our assumption: accuracy of the mounting of a triad"
SCATTER_SOURCE = "our assumption; 72 public calibrations of eight units scatter by 0.6 to 3.7 mg between sessions"
K2, KIJ, K3 = constant(SQUARE, "K2·f²"), constant(CROSS, "K·f_i·f_j"), constant(CUBE, "K3·f³")

# Sizes are those of consumer MEMS parts.
EFFECTS = EffectTable.from_rows(
    SHEETS,
    baseline=(
        ("bias.constant", constant(BIAS), 50.0, "mg"),
        ("scale.constant", constant(SCALE), 30000.0, "ppm"),
        ("misalignment.constant", constant(UPPER), 20.0, "mrad"),
    ),
    candidates=(
        ("bias.temperature", tempco(BIAS), 0.5, "mg/degC", TEMPCO),
        ("scale.temperature", tempco(SCALE), 200.0, "ppm/degC", TEMPCO),
        ("misalignment.temperature", tempco(UPPER), 0.02, "mrad/degC", PACKAGE_SOURCE),
        ("bias.temperature_quadratic", tempco(BIAS, 2), 0.005, "mg/degC^2", TEMPCO),
        ("square.constant", K2, 1.0, "mg/g^2", NONLINEARITY),
        ("cross.constant", KIJ, 1.0, "mg/g^2", NONLINEARITY),
        ("cube.constant", K3, 1.0, "mg/g^3", NONLINEARITY),
        ("misalignment.frame", triad_rotation(LOWER), 20.0, "mrad", MOUNTING_SOURCE),
        ("bias.thermal_lag", thermal_lag(BIAS), 0.5, "mg/degC", TEMPCO),
        ("bias.drift", drift(BIAS), 1.0, "mg", "assumed by us"),
        ("bias.run", run_offset(BIAS), 1.0, "mg", SCATTER_SOURCE),
    ),
)


def tailor_to_readings(readings: bc.Measurements | None, **settings: Any) -> bc.Instrument:
    """Return the instrument with a noise prior from the stated uncertainties of poses; see `set_noise_prior`."""
    return set_noise_prior(INSTRUMENT, readings, **settings)


INSTRUMENT = bc.Instrument(
    name="accelerometer_triad",
    title="three accelerometers in poses at rest: bias, scale, misalignment",
    columns=COLUMNS,
    slots=(*make_slots("g", "force"), *make_higher_order_slots("g")),
    response=_evaluate_response,
    effects=EFFECTS.baseline,
    candidates=EFFECTS.candidates,
    nuisances=(local_gravity.make_nuisance_effect("magnitude", 1e-3 * local_gravity.SD_PPM, "mg"),),
    noise=bc.White(bc.HalfCauchy(1e-3)),
    simulator=simulate_columns,
    experiments=list_pose_experiments(1.0),
    vector=VECTOR,
    tailor=tailor_to_readings,
    source="IEEE Std 1293-2018; D. Tedaldi, A. Pretto and E. Menegatti, ICRA 2014 (poses at rest)",
)
simulate = make_readings_simulator(INSTRUMENT)
EFFECT_CAMPAIGN = Campaign(**TWO_SESSIONS, pose_uncertainty=5e-4)  # with hidden effects
# 24 poses in unknown directions at 0.5 mg.
reference_problem = ReferenceProblem(INSTRUMENT, Campaign(), EFFECT_CAMPAIGN)
