"""Effects of three magnetometers on a vehicle; sizes are prior standard deviations."""

from __future__ import annotations

from bayescal_models.triad.equation import BIAS, LOWER, SCALE, UPPER
from bayescal_models.triad.families import drift, family, over_temperature, run, unknown_directions

IRON = "ours: hard and soft iron of a small vehicle, and a field known to a third"
TEMPCO = "data sheets of RM3100, LIS3MDL and BMM150, change with temperature; size ours"

CONSTANT = family("bias.constant", BIAS, 50.0, "uT", IRON)
FACTOR = family("scale.constant", SCALE, 300000.0, "ppm", IRON)
SHEAR = family("misalignment.constant", UPPER, 100.0, "mrad", IRON)
TURNED = family("misalignment.frame", LOWER, 100.0, "mrad", IRON, untestable=unknown_directions)
BIAS_TEMPERATURE = over_temperature("bias.temperature", BIAS, 0.1, "uT/degC", TEMPCO)
SCALE_TEMPERATURE = over_temperature("scale.temperature", SCALE, 500.0, "ppm/degC", TEMPCO)
SHEAR_TEMPERATURE = over_temperature(
    "misalignment.temperature", UPPER, 0.1, "mrad/degC", "ours: 5 mrad in 50 °C"
)
BIAS_QUADRATIC = over_temperature(
    "bias.temperature_quadratic", BIAS, 0.001, "uT/degC^2", TEMPCO, order=2
)
DRIFT = drift("bias.drift", BIAS, 1.0, "uT", "ours: a battery's or a motor's field that changes")
RUN = run(
    BIAS,
    1.0,
    "uT",
    "ours: hard iron from one session to the next",
)
