"""Effects of any sensor at rest; their sizes are parts of what the record itself shows."""

from __future__ import annotations

import bayescal as bc
from bayescal import effects

MINUTE = 60.0  # s
SOURCE = (
    "ours: {share:g} of the record's own robust spread{at}; empirical, for want of a data sheet"
)
LAG_TIME = 5.0  # min, of a body whose lag would show such a spread


def constant(unit: str, sd: float) -> bc.Effect:
    """The output at rest at T0."""
    source = "ours: √(median² + (10 × robust spread)²) of the record itself, an empirical choice"
    return effects.constant("bias", sd, unit, source=source)


def thermal(unit: str, size: float, span: float, pace: float) -> tuple[bc.Effect, ...]:
    """What follows the temperature: powers, rate, lag, direction."""
    from_middle = ", from the middle to an end of the temperatures"
    rate_source = SOURCE.format(share=0.25, at=" at the mean rate of the temperature")
    lag_source = SOURCE.format(
        share=0.25, at=f" at the mean rate of the temperature and a lag of {LAG_TIME:g} min"
    )
    return (
        effects.linear(
            "bias", size / span, f"{unit}/degC", source=SOURCE.format(share=1, at=from_middle)
        ),
        effects.quadratic(
            "bias",
            0.5 * size / span**2,
            f"{unit}/degC^2",
            source=SOURCE.format(share=0.5, at=from_middle),
        ),
        effects.cubic(
            "bias",
            0.25 * size / span**3,
            f"{unit}/degC^3",
            source=SOURCE.format(share=0.25, at=from_middle),
        ),
        effects.rate("bias", 0.25 * size / pace, f"{unit}/(degC/min)", source=rate_source),
        effects.thermal_lag(
            "bias",
            0.25 * size / (pace * LAG_TIME),
            f"{unit}/degC",
            low=MINUTE,
            high=20 * MINUTE,
            start=0.25 * size,
            start_unit=unit,
            source=lag_source,
        ),
        effects.hysteresis("bias", 0.25 * size, unit, source=SOURCE.format(share=0.25, at="")),
    )


def temporal(unit: str, size: float) -> tuple[bc.Effect, ...]:
    """What follows the time."""
    half, quarter = SOURCE.format(share=0.5, at=""), SOURCE.format(share=0.25, at="")
    return (
        effects.warm_up("bias", 0.5 * size, unit, low=2 * MINUTE, high=40 * MINUTE, source=half),
        effects.drift("bias", 0.5 * size, unit, source=half),
        effects.deviation("bias", "run", 0.25 * size, unit, source=quarter),
    )
