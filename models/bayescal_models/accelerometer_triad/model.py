"""Three accelerometers in poses at rest: gravity turns about them, and its magnitude is known.

A *pose* is one averaged reading of three outputs. The specific force f at rest is 1 g up; its direction is unknown, or
known to `pose_uncertainty` (a dividing head, a robot):

    y_a = f_a + b_a + Σ_j G_aj·f_j + K2_a·f_a² + Σ_{i<j} K_aij·f_i·f_j + K3_a·f_a³ + e_a,     |f| = magnitude

**Gauge.** Where directions are unknown a rotation of the triad moves no reading. By convention the z axis of the body
is that of the sensor z, and its y axis lies in the plane of the sensors y and z: three misalignments (x toward y, x
toward z, y toward z) in place of six. `misalignment.frame` holds the other three, and needs known directions.

| effect | coefficients | plausible size |
|---|---|---|
| `bias.constant` (baseline) | x, y, z | 50 mg |
| `scale.constant` (baseline) | x, y, z | 3 % |
| `misalignment.constant` (baseline) | xy, xz, yz | 20 mrad |
| `bias.temperature` | x, y, z | 0.5 mg/°C |
| `scale.temperature` | x, y, z | 200 ppm/°C |
| `misalignment.temperature` | xy, xz, yz | 20 µrad/°C |
| `bias.temperature_quadratic` | x, y, z | 5 µg/°C² |
| `bias.thermal_lag` | x, y, z, one time | 0.5 mg/°C |
| `square.constant` (K2) | x, y, z | 1 mg/g² |
| `cross.constant` | nine | 1 mg/g² |
| `cube.constant` (K3) | x, y, z | 1 mg/g³ |
| `misalignment.frame` | yx, zx, zy | 20 mrad |
| `bias.drift` | x, y, z | 1 mg |
| `bias.run` | x, y, z for each run, learned | 1 mg |

One effect on a family is one effect: its coefficients are found or dropped together.

**What poses determine.** Nine coefficients need nine poses or more that do not all lie on a quadric other than the
sphere: six positions determine bias and scale and no misalignment; poses in one plane leave the axis across it free;
poses within 10° of level determine the bias of z less its scale and little else. What is not determined stays at
its prior's width. K2 and cross terms of 1 mg/g² move |f| by less than 0.5 mg,
K3 of 1 mg/g³ beside the scale factor by less than 0.3 mg.

Noise: white, one standard deviation for all three axes.
"""

from __future__ import annotations

import bayescal as bc
from bayescal_models.accelerometer_triad import COLUMNS, OUTPUTS, effects
from bayescal_models.accelerometer_triad.simulator import simulated_columns
from bayescal_models.simulated import readings_of
from bayescal_models.triad.equation import equation, higher_order, slots
from bayescal_models.triad.experiments import experiments

VECTOR = bc.Vector(outputs=OUTPUTS, equation=equation, common_scale=0.03)


def _response(slots, r):
    return VECTOR.response(slots, r)


INSTRUMENT = bc.Instrument(
    name="accelerometer_triad",
    title="three accelerometers in poses at rest: bias, scale, misalignment",
    columns=COLUMNS,
    slots=(*slots("g", "force"), *higher_order("g")),
    response=_response,
    effects=(effects.CONSTANT, effects.FACTOR, effects.SHEAR),
    candidates=(
        effects.BIAS_TEMPERATURE,
        effects.SCALE_TEMPERATURE,
        effects.SHEAR_TEMPERATURE,
        effects.BIAS_QUADRATIC,
        effects.SQUARES,
        effects.PRODUCTS,
        effects.CUBES,
        effects.TURNED,
        effects.LAG,
        effects.DRIFT,
        effects.RUN,
    ),
    noise=bc.White(bc.HalfCauchy(1e-3)),
    simulator=simulated_columns,
    experiments=experiments(1.0),
    vector=VECTOR,
    source="IEEE Std 1293-2018; D. Tedaldi, A. Pretto and E. Menegatti, ICRA 2014 (poses at rest)",
)
simulate = readings_of(INSTRUMENT, simulated_columns)
