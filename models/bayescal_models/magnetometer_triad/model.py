"""Three magnetometers turned in a constant field: hard iron, soft iron and misalignments, over temperature.

    y_a = m_a + b_a + Σ_j G_aj·m_j + e_a,     |m| = magnitude

b is the hard iron with the sensor's own offset; G holds the scale factors, the misalignments and the soft iron, which
no turning in one field tells apart. The direction of the field in the body is unknown, or known to
`pose_uncertainty`.

**Gauge.** As of `accelerometer_triad`: three misalignments in place of six where directions are unknown, and z of the
body that of the sensor z. All three scale factors hang together with the local field's size. Where that is not given
(column `magnitude`, `--local-field`), it is taken as the magnetometers read it, the mean radius of their ellipsoid: the
ratios of the scale factors alone are measured, and headings do not depend on it.

| effect | coefficients | plausible size |
|---|---|---|
| `bias.constant` (baseline) | x, y, z | 50 µT |
| `scale.constant` (baseline) | x, y, z | 30 % |
| `misalignment.constant` (baseline) | xy, xz, yz | 100 mrad |
| `bias.temperature` | x, y, z | 0.1 µT/°C |
| `scale.temperature` | x, y, z | 500 ppm/°C |
| `misalignment.temperature` | xy, xz, yz | 100 µrad/°C |
| `bias.temperature_quadratic` | x, y, z | 1 nT/°C² |
| `misalignment.frame` | yx, zx, zy | 100 mrad |
| `bias.drift` | x, y, z | 1 µT |
| `bias.run` | x, y, z for each run, learned | 1 µT |

Noise: white, one standard deviation for all three axes.
"""

from __future__ import annotations

import bayescal as bc
from bayescal_models.magnetometer_triad import COLUMNS, OUTPUTS, effects
from bayescal_models.magnetometer_triad.simulator import simulated_columns
from bayescal_models.simulated import readings_of
from bayescal_models.triad.equation import equation, slots
from bayescal_models.triad.experiments import experiments

# Sensitivities by data sheets of RM3100, LIS3MDL and BMM150; what iron adds differs from axis to axis.
VECTOR = bc.Vector(outputs=OUTPUTS, equation=equation, common_scale=0.05)


def _response(slots, r):
    return VECTOR.response(slots, r)


INSTRUMENT = bc.Instrument(
    name="magnetometer_triad",
    title="three magnetometers in a constant field: hard iron, soft iron",
    columns=COLUMNS,
    slots=slots("uT", "field"),
    response=_response,
    effects=(effects.CONSTANT, effects.FACTOR, effects.SHEAR),
    candidates=(
        effects.BIAS_TEMPERATURE,
        effects.SCALE_TEMPERATURE,
        effects.SHEAR_TEMPERATURE,
        effects.BIAS_QUADRATIC,
        effects.TURNED,
        effects.DRIFT,
        effects.RUN,
    ),
    noise=bc.White(bc.HalfCauchy(0.3)),
    simulator=simulated_columns,
    experiments=experiments(50.0),
    vector=VECTOR,
    source="D. Gebre-Egziabher et al., J. Aerosp. Eng. 19 (2006) 87 (calibration in the magnetic field domain)",
)
simulate = readings_of(INSTRUMENT, simulated_columns)
