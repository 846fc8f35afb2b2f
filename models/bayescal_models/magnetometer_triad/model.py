"""Three magnetometers turned in a constant field: hard iron, soft iron and misalignments, over temperature.

    y_a = m_a + b_a + Σ_j G_aj·m_j + e_a,     |m| = magnitude

b is the hard iron plus the sensor's offset; G has the scale factors, the misalignments and the soft iron, which
rotation in one field does not separate. The direction of the field in the body is unknown, or known to
`pose_uncertainty`.

**Gauge.** As in `accelerometer_triad`: three misalignments in place of six if directions are unknown, and the body's z
axis is that of sensor z. A common factor of the scale factors is an alias of the local field's magnitude. If that
magnitude is not given (column `magnitude`, `--local-field`), it is taken as the mean radius of the ellipsoid of the
outputs: only the ratios of the scale factors are then measured; headings do not depend on the magnitude.

Noise: white, one standard deviation for all three axes.
"""

from __future__ import annotations

from typing import Any

import bayescal as bc
from bayescal_models.catalogue import EffectTable
from bayescal_models.magnetometer_triad import COLUMNS, OUTPUTS
from bayescal_models.magnetometer_triad.campaign import Campaign
from bayescal_models.magnetometer_triad.simulator import simulate_columns
from bayescal_models.simulated import ReferenceProblem, make_readings_simulator
from bayescal_models.triad.campaign import TWO_SESSIONS
from bayescal_models.triad.equation import BIAS, LOWER, SCALE, UPPER, build_equation, make_slots
from bayescal_models.triad.experiments import list_pose_experiments
from bayescal_models.triad.families import constant, drift, run_offset, tempco, triad_rotation
from bayescal_models.triad.scatter import set_noise_prior

# Sensitivities by data sheets of RM3100, LIS3MDL and BMM150; the contribution of iron differs between axes.
VECTOR = bc.Vector(outputs=OUTPUTS, equation=build_equation, common_scale=0.05)


def _evaluate_response(slots, r):
    return VECTOR.response(slots, r)


IRON_SOURCE = "assumed: hard and soft iron of a small vehicle"
TEMPCO = "data sheets of RM3100, LIS3MDL and BMM150, change with temperature; size assumed by us"
FIELD_SOURCE = "assumed: variable field of a battery or motor"
PACKAGE_SOURCE = "assumed: 5 mrad in 50 °C"

EFFECTS = EffectTable.from_rows(
    IRON_SOURCE,
    baseline=(
        ("bias.constant", constant(BIAS), 50.0, "uT"),
        ("scale.constant", constant(SCALE), 300000.0, "ppm"),
        ("misalignment.constant", constant(UPPER), 100.0, "mrad"),
    ),
    candidates=(
        ("bias.temperature", tempco(BIAS), 0.1, "uT/degC", TEMPCO),
        ("scale.temperature", tempco(SCALE), 500.0, "ppm/degC", TEMPCO),
        ("misalignment.temperature", tempco(UPPER), 0.1, "mrad/degC", PACKAGE_SOURCE),
        ("bias.temperature_quadratic", tempco(BIAS, 2), 0.001, "uT/degC^2", TEMPCO),
        ("misalignment.frame", triad_rotation(LOWER), 100.0, "mrad"),
        ("bias.drift", drift(BIAS), 1.0, "uT", FIELD_SOURCE),
        ("bias.run", run_offset(BIAS), 1.0, "uT", "assumed: hard iron changes between sessions"),
    ),
)


def tailor_to_readings(readings: bc.Measurements | None, **settings: Any) -> bc.Instrument:
    """Return the instrument with a noise prior from the stated uncertainties of poses; see `set_noise_prior`."""
    return set_noise_prior(INSTRUMENT, readings, **settings)


INSTRUMENT = bc.Instrument(
    name="magnetometer_triad",
    title="three magnetometers in a constant field: hard iron, soft iron",
    columns=COLUMNS,
    slots=make_slots("uT", "field"),
    response=_evaluate_response,
    effects=EFFECTS.baseline,
    candidates=EFFECTS.candidates,
    noise=bc.White(bc.HalfCauchy(0.3)),
    simulator=simulate_columns,
    experiments=list_pose_experiments(50.0),
    vector=VECTOR,
    tailor=tailor_to_readings,
    source="D. Gebre-Egziabher et al., J. Aerosp. Eng. 19 (2006) 87 (calibration in the magnetic field domain)",
)
simulate = make_readings_simulator(INSTRUMENT)
EFFECT_CAMPAIGN = Campaign(**TWO_SESSIONS, pose_uncertainty=5e-4)  # with hidden effects
# 40 readings in unknown directions at 0.3 µT.
reference_problem = ReferenceProblem(INSTRUMENT, Campaign(poses=40), EFFECT_CAMPAIGN)
