"""Effects of any sensor at rest; their sizes are parts of what the record itself shows."""

from __future__ import annotations

import bayescal as bc
from bayescal import effects

MINUTE = 60.0  # s
SOURCE = "ours: {share:g} of half the record's own range{at}; empirical, for want of a data sheet"
LAG_TIME, SLOW_TIME = 5.0, 40.0  # min, of bodies whose lag would show such a size


def constant(unit: str, sd: float) -> bc.Effect:
    """The output at rest at T0."""
    source = "ours: √(median² + (5 × range)²) of the record itself, an empirical choice"
    return effects.constant("bias", sd, unit, source=source)


def thermal(unit: str, size: float, span: float, pace: float) -> tuple[bc.Effect, ...]:
    """What follows the temperature: powers, rate, bodies that lag, direction."""
    from_middle = ", from the middle to an end of the temperatures"
    quarter = 0.25 * size

    def behind(minutes: float) -> str:
        return SOURCE.format(
            share=0.25, at=f" at the mean rate of the temperature and a lag of {minutes:g} min"
        )

    def power(effect, order: int, share: float) -> bc.Effect:
        per = f"{unit}/degC" + (f"^{order}" if order > 1 else "")
        source = SOURCE.format(share=share, at=from_middle)
        return effect("bias", share * size / span**order, per, source=source)

    return (
        power(effects.linear, 1, 1.0),
        power(effects.quadratic, 2, 0.5),
        power(effects.cubic, 3, 0.25),
        power(effects.quartic, 4, 0.25),
        effects.thermal_lag(
            "bias",
            quarter / (pace * LAG_TIME),
            f"{unit}/degC",
            low=MINUTE,
            high=20 * MINUTE,
            start=quarter,
            start_unit=unit,
            source=behind(LAG_TIME),
            short=effects.rate(
                "bias",
                quarter / pace,
                f"{unit}/(degC/min)",
                source=SOURCE.format(share=0.25, at=" at the mean rate of the temperature"),
            ),
        ),
        effects.thermal_lag(
            "bias",
            quarter / (pace * SLOW_TIME),
            f"{unit}/degC",
            low=20 * MINUTE,
            high=180 * MINUTE,
            start=quarter,
            start_unit=unit,
            source=behind(SLOW_TIME),
            name="thermal_lag_slow",
        ),
        effects.temperature_x_lag(
            "bias",
            quarter / (pace * LAG_TIME * span),
            f"{unit}/degC^2",
            low=MINUTE,
            high=20 * MINUTE,
            source=behind(LAG_TIME),
        ),
        effects.hysteresis("bias", quarter, unit, source=SOURCE.format(share=0.25, at="")),
    )


def temporal(unit: str, size: float) -> tuple[bc.Effect, ...]:
    """What follows the time."""
    half, quarter = SOURCE.format(share=0.5, at=""), SOURCE.format(share=0.25, at="")
    return (
        effects.warm_up("bias", 0.5 * size, unit, low=2 * MINUTE, high=40 * MINUTE, source=half),
        effects.drift("bias", 0.5 * size, unit, source=half),
        effects.deviation("bias", "run", 0.25 * size, unit, source=quarter),
    )
