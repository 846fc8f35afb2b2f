"""Effects of three accelerometers; sizes are prior standard deviations, those of consumer MEMS parts."""

from __future__ import annotations

from bayescal_models.triad.equation import BIAS, CROSS, CUBE, LOWER, SCALE, SQUARE, UPPER
from bayescal_models.triad.families import (
    BEHIND,
    OF_RUN,
    WITH_TIME,
    family,
    over_temperature,
    unknown_directions,
)

SHEETS = "data sheets of ADXL355, BMI088 and ICM-20948, zero-g offset, sensitivity and cross axis; size ours"
TEMPCO = "the same data sheets, change with temperature; size ours"
SECOND = "IEEE Std 1293-2018, model equation; size ours, a nonlinearity of 0.1 % at 1 g"

CONSTANT = family("bias.constant", BIAS, 50.0, "mg", SHEETS)
FACTOR = family("scale.constant", SCALE, 30000.0, "ppm", SHEETS)
SHEAR = family("misalignment.constant", UPPER, 20.0, "mrad", SHEETS)
TURNED = family(
    "misalignment.frame",
    LOWER,
    20.0,
    "mrad",
    "ours: how well a triad is mounted",
    untestable=unknown_directions,
)
BIAS_TEMPERATURE = family("bias.temperature", BIAS, 0.5, "mg/degC", TEMPCO, **over_temperature())
SCALE_TEMPERATURE = family(
    "scale.temperature", SCALE, 200.0, "ppm/degC", TEMPCO, **over_temperature()
)
SHEAR_TEMPERATURE = family(
    "misalignment.temperature",
    UPPER,
    0.02,
    "mrad/degC",
    "ours: 1 mrad in 50 °C, of a package's plastic",
    **over_temperature(),
)
BIAS_QUADRATIC = family(
    "bias.temperature_quadratic", BIAS, 0.005, "mg/degC^2", TEMPCO, **over_temperature(2)
)
SQUARES = family("square.constant", SQUARE, 1.0, "mg/g^2", SECOND, equation="K2·f²")
PRODUCTS = family("cross.constant", CROSS, 1.0, "mg/g^2", SECOND, equation="K·f_i·f_j")
CUBES = family("cube.constant", CUBE, 1.0, "mg/g^3", SECOND, equation="K3·f³")
LAG = family("bias.thermal_lag", BIAS, 0.5, "mg/degC", TEMPCO, **BEHIND)
DRIFT = family("bias.drift", BIAS, 1.0, "mg", "ours", **WITH_TIME)
RUN = family(
    "bias.run",
    BIAS,
    1.0,
    "mg",
    "ours; 72 public calibrations of eight units scatter by 0.6 to 3.7 mg between sessions",
    **OF_RUN,
)
