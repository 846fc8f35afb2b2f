"""Effects of three gyroscopes on a rate table; sizes are prior standard deviations, those of consumer MEMS parts."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

import bayescal as bc
from bayescal_models.triad.columns import AROUND
from bayescal_models.triad.equation import AXES, BIAS, LOWER, SCALE, SQUARE, UPPER
from bayescal_models.triad.families import BEHIND, OF_RUN, WITH_TIME, family, over_temperature

SHEETS = "data sheets of BMI088, ICM-20948 and ADXRS645, zero-rate offset, sensitivity and cross axis; size ours"
TEMPCO = "the same data sheets, change with temperature; size ours"
GRAVITY = tuple(f"gravity_{a}" for a in AXES)
SENSITIVITY = tuple(f"sensitivity_{a}{j}" for a in AXES for j in AXES)
TURN = tuple(f"turn_{a}" for a in AXES)
DIRECTION = tuple(f"direction_{a}" for a in AXES)
EARTH = tuple(f"earth_{a}" for a in AXES)
ACROSS = tuple(f"across_{a}" for a in AXES)


def _at_each_mounting(count: int, r: bc.Frame) -> Any:
    return jnp.broadcast_to(r["pose_uncertainty"][:, None], (r.size, count))


CONSTANT = family("bias.constant", BIAS, 3.0, "deg/s", SHEETS)
FACTOR = family("scale.constant", SCALE, 20000.0, "ppm", SHEETS)
TURNED = family("misalignment.constant", (*UPPER, *LOWER), 20.0, "mrad", SHEETS)
MOUNTING = family(
    "turn.mounting",
    TURN,
    1.0,
    "1",
    "the standard uncertainty of the mounting, as given with the readings",
    basis=_at_each_mounting,
    equation="c[mounting]·u(mounting),  c ~ N(0, 1)",
    per="mounting",
    learned=False,
    columns=("mounting", "pose_uncertainty"),
)
BIAS_TEMPERATURE = family(
    "bias.temperature", BIAS, 0.03, "deg/s/degC", TEMPCO, **over_temperature()
)
SCALE_TEMPERATURE = family(
    "scale.temperature", SCALE, 200.0, "ppm/degC", TEMPCO, **over_temperature()
)
TURNED_TEMPERATURE = family(
    "misalignment.temperature",
    (*UPPER, *LOWER),
    0.02,
    "mrad/degC",
    "ours: 1 mrad in 50 °C, of a package's plastic",
    **over_temperature(),
)
BIAS_QUADRATIC = family(
    "bias.temperature_quadratic", BIAS, 3e-4, "deg/s/degC^2", TEMPCO, **over_temperature(2)
)
G_SENSITIVITY = family(
    "bias.g_sensitivity",
    SENSITIVITY,
    0.1,
    "deg/s/g",
    "IEEE Std 1431-2004, acceleration-sensitive drift; data sheet of BMI088; size ours",
    equation="Σ_j c_aj·g_j",
    columns=GRAVITY,
    along="",
)
EARTH_ROTATION = family(
    "earth.rotation",
    AROUND,
    15.041 / 3600 / 3**0.5,
    "deg/s",
    "15.041 °/h in an unknown direction",
    equation="ω_E along the axes of the body in the first pose of a run",
    per="run",
    learned=False,
    columns=AROUND,
)
LAG = family("bias.thermal_lag", BIAS, 0.03, "deg/s/degC", TEMPCO, **BEHIND)
SQUARES = family(
    "square.constant",
    SQUARE,
    10.0,
    "ppm*s/deg",
    "IEEE Std 1431-2004, scale-factor nonlinearity; size ours, 0.1 % at 100 °/s",
    equation="K2·ω²",
)
DRIFT = family("bias.drift", BIAS, 0.05, "deg/s", "ours", **WITH_TIME)
RUN = family("bias.run", BIAS, 0.1, "deg/s", "ours; turn-on to turn-on of consumer parts", **OF_RUN)
