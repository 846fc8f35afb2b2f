"""Effects of three magnetometers on a vehicle; sizes are prior standard deviations."""

from __future__ import annotations

from bayescal_models.triad.equation import BIAS, LOWER, SCALE, UPPER
from bayescal_models.triad.families import (
    OF_RUN,
    WITH_TIME,
    family,
    over_temperature,
    unknown_directions,
)

IRON = "ours: hard and soft iron of a small vehicle"
TEMPCO = "data sheets of RM3100, LIS3MDL and BMM150, change with temperature; size ours"

CONSTANT = family("bias.constant", BIAS, 50.0, "uT", IRON)
FACTOR = family("scale.constant", SCALE, 300000.0, "ppm", IRON)
SHEAR = family("misalignment.constant", UPPER, 100.0, "mrad", IRON)
TURNED = family("misalignment.frame", LOWER, 100.0, "mrad", IRON, untestable=unknown_directions)
BIAS_TEMPERATURE = family("bias.temperature", BIAS, 0.1, "uT/degC", TEMPCO, **over_temperature())
SCALE_TEMPERATURE = family(
    "scale.temperature", SCALE, 500.0, "ppm/degC", TEMPCO, **over_temperature()
)
SHEAR_TEMPERATURE = family(
    "misalignment.temperature",
    UPPER,
    0.1,
    "mrad/degC",
    "ours: 5 mrad in 50 °C",
    **over_temperature(),
)
BIAS_QUADRATIC = family(
    "bias.temperature_quadratic", BIAS, 0.001, "uT/degC^2", TEMPCO, **over_temperature(2)
)
DRIFT = family(
    "bias.drift", BIAS, 1.0, "uT", "ours: a battery's or a motor's field that changes", **WITH_TIME
)
RUN = family("bias.run", BIAS, 1.0, "uT", "ours: hard iron from one session to the next", **OF_RUN)
