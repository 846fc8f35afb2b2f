"""One effect of each maker in `bayescal.effects`, for a sensor at rest; a file that commands take with --effects."""

from typing import Any

from bayescal import effects

BODY: dict[str, Any] = {"low": 60.0, "high": 1200.0}  # s
START: dict[str, Any] = {"start": 100.0, "start_unit": "ug"}
OWN: dict[str, Any] = {"source": "made up"}
MADE = {
    "constant": effects.constant("bias", 2e4, "ug", **OWN),
    "deviation": effects.deviation("bias", "run", 100.0, "ug", **OWN),
    "linear": effects.linear("bias", 50.0, "ug/degC", **OWN),
    "quadratic": effects.quadratic("bias", 1.0, "ug/degC^2", **OWN),
    "cubic": effects.cubic("bias", 0.03, "ug/degC^3", **OWN),
    "quartic": effects.quartic("bias", 1e-3, "ug/degC^4", **OWN),
    "rate": effects.rate("bias", 100.0, "ug/(degC/min)", **OWN),
    "hysteresis": effects.hysteresis("bias", 100.0, "ug", **OWN),
    "thermal_lag": effects.thermal_lag("bias", 10.0, "ug/degC", **BODY, **START, **OWN),
    "temperature_x_lag": effects.temperature_x_lag("bias", 1.0, "ug/degC^2", **BODY, **OWN),
    "body": effects.body("bias", 100.0, "ug", **BODY, **OWN),
    "uncertain_input": effects.uncertain_input("temperature", 0.3, "delta_degC", **OWN),
    "thermometer": effects.thermometer(0.3, **OWN),
    "thermometer_offset": effects.thermometer_offset(1.0, **OWN),
    "thermometer_delay": effects.thermometer_delay(60.0, **OWN),
    "drift": effects.drift("bias", 100.0, "ug", **OWN),
    "warm_up": effects.warm_up("bias", 100.0, "ug", **BODY, **OWN),
    "unknown": effects.unknown("temperature", "bias", 1.0, 100.0, "ug"),
    "jump": effects.jump("bias", 1.0, 100.0, "ug"),
    "line": effects.line("bias", 1.0, 100.0, "ug", covariate="temperature"),
    "kink": effects.kink("bias", 1.0, 100.0, "ug", covariate="temperature"),
    "peak": effects.peak("bias", 1.0, 100.0, "ug", covariate="temperature"),
    "cycle": effects.cycle("bias", 1.0, 100.0, "ug"),
}
EFFECTS = tuple(MADE.values())
