"""Catalogue of general effects, one file per family.

Each function returns an `Effect` for a slot, a plausible size and a unit; an instrument lists those that its physics
allows.
"""

from bayescal._model.unknown_effect import cycle, jump, kink, line, peak, unknown
from bayescal.effects.constant import constant, deviation
from bayescal.effects.temperature import cubic, linear, quadratic, quartic
from bayescal.effects.thermal import body, hysteresis, rate, temperature_x_lag, thermal_lag
from bayescal.effects.thermometer import (
    thermometer,
    thermometer_delay,
    thermometer_offset,
    uncertain_input,
)
from bayescal.effects.time import drift, warm_up

__all__ = [
    "body", "constant", "cubic", "cycle", "deviation", "drift", "hysteresis", "jump", "kink", "line", "linear",
    "peak", "quadratic", "quartic", "rate", "temperature_x_lag", "thermal_lag", "thermometer", "thermometer_delay",
    "thermometer_offset", "uncertain_input", "unknown", "warm_up",
]  # fmt: skip
