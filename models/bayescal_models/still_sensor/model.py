"""Any sensor at rest: one output, temperature and time, for any logged channel.

    bayescal calibrate imu.csv --instrument still_sensor --columns output=acc_x
        --unit acc_x=m/s^2 --columns time=t_s --unit t_s=s --unit temperature=degC

Measurement equation, with the output in its logged unit (stored in µg, °/s, rad, °C, s, or base units):

    output = bias

One slot, `bias`, in the output's unit. Baseline: `bias.constant` and `bias.temperature`, a line; the constant alone if
the temperature was not recorded, or varied by less than a tenth of a degree. The true input is assumed constant: all
changes are attributed to the sensor. Noise: white, of unknown size.

Such a channel has no data sheet, so the plausible sizes are estimated from the record itself: an empirical choice,
which uses the readings twice, though only for orders of magnitude. Five settings define them: *unit* of the output;
*size*, half the output's range from its 0.5 % to its 99.5 % quantile; *constant*, the prior standard deviation of the
constant, √(median² + (10·size)²); *span*, half the temperature range; *pace*, the mean |dT/dt|.

`INSTRUMENT` itself has relative sizes (size 1, span 1 °C, pace 1 °C/min), and
`INSTRUMENT.for_readings(readings)` is the instrument in a record's own unit. If the sizes are
known, give them: `instrument("ug", size=300.0, constant=2000.0, span=40.0, pace=3.0)`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, wraps
from typing import Any

import numpy as np

import bayescal as bc
from bayescal_models import catalogue
from bayescal_models.catalogue import MINUTE
from bayescal_models.still_sensor import COLUMNS
from bayescal_models.still_sensor.simulator import simulate_columns

SETTING_NAMES = {"unit", "size", "constant", "span", "pace"}
MIN_TEMPERATURE_RANGE_DEGC = 0.1  # stability of a good chamber; less identifies no effect


def _evaluate_response(slots, r):
    return slots["bias"]


def _use_output(true_input, slots, r):
    return slots["bias"] + true_input


CONSTANT_SOURCE = "empirical: √(median² + (5 × range)²) of the record; there is no data sheet"
SIZE_SOURCE = "empirical: {:g} of half the range of the record{}; there is no data sheet"


@cache  # equal settings give the same instrument object
def instrument(
    unit: str = "1",
    *,
    size: float = 1.0,
    constant: float | None = None,
    span: float = 1.0,
    pace: float = 1.0,
) -> bc.Instrument:
    """Build the instrument for a sensor at rest with these plausible sizes.

    Args:
        unit: unit of the output, such as "ug", "deg/s" or "V".
        size: plausible size of the output's change over the record, in `unit`.
        constant: prior standard deviation of the output's constant, in `unit`; by default 10·size.
        span: half the temperature range, °C; 0 if it is constant or was not recorded.
        pace: plausible temperature rate, °C/min.

    Raises:
        InputError: a size is not positive and finite, or the unit is unknown.
    """
    constant = 10 * size if constant is None else constant
    settings = {"size": size, "constant": constant, "span": span, "pace": pace}
    for name, value in settings.items():
        if not (np.isfinite(value) and (value > 0 or (name == "span" and value == 0))):
            raise bc.InputError(f"still_sensor({name}={value}): give a positive, finite number")
    linear_effect, *candidates = catalogue.make_common_effects(
        "bias", unit, size=size, span=span or 1.0, pace=pace, order=4, source=SIZE_SOURCE
    )
    constant_effect = catalogue.constant("bias.constant", constant, unit, CONSTANT_SOURCE)
    sensor = bc.Instrument(
        name="still_sensor",
        title="any sensor at rest: its output over temperature and time",
        columns=tuple(replace(c, unit=unit) if c.name == "output" else c for c in COLUMNS),
        slots=(bc.Slot("bias", unit, "output at rest"),),
        response=_evaluate_response,
        effects=(constant_effect, linear_effect) if span else (constant_effect,),
        candidates=(*([] if span else [linear_effect]), *candidates),
        noise=bc.White(bc.HalfCauchy(0.1 * size)),
        structures=(
            ("line", lambda: sensor.baseline()),
            ("quadratic", lambda: sensor.baseline() + candidates[:1]),
            ("cubic", lambda: sensor.baseline() + candidates[:2]),
        ),
        simulator=simulate_columns,
        use=bc.Use("input", unit, equation=_use_output),
        source="no published source",
        settings=(("unit", unit), *settings.items()),
    )
    return sensor


def tailor_to_readings(readings: bc.Measurements, **settings: Any) -> bc.Instrument:
    """Build the instrument for these readings, in their unit, with plausible sizes estimated from them.

    Args:
        readings: readings of any channel.
        settings: arguments of `instrument` that replace estimates.

    Raises:
        InputError: the output does not change, or its square overflows, so that no size can be estimated.
    """
    if set(settings) == SETTING_NAMES:
        return instrument(**settings)
    output = readings["output"]
    median = float(np.median(output))
    low, high = np.quantile(output, [0.005, 0.995])
    size = settings.get("size") or 0.5 * float(high - low) or 0.5 * float(np.ptp(output))
    if not 1e-150 < size < 1e150:  # its square is finite
        column = next((s.output for s in readings.sources if s.output), "output")
        extent = f"{median:g} within ±{size:.3g}" if size > 0 else f"{median:g} throughout"
        text = f"{readings.file}, column {column!r} is {extent}, so that no size can be estimated"
        raise bc.InputError(f"{text}: choose another channel")
    span = 0.5 * float(np.ptp(readings["temperature"])) if readings.has("temperature") else 0.0
    sizes = {
        "unit": readings.unit("output"),
        "size": size,
        "constant": float(np.hypot(median, 10 * size)),
        "span": span if span >= 0.5 * MIN_TEMPERATURE_RANGE_DEGC else 0.0,
        "pace": _compute_mean_temperature_rate(readings) if span else 1.0,
    }
    return instrument(**{**sizes, **settings})


def _compute_mean_temperature_rate(readings: bc.Measurements) -> float:
    """Return the mean absolute temperature change from minute to minute within runs, °C/min; 1 if there is none."""
    _, codes = readings.groups("run")
    total_change, minute_count = 0.0, 0
    for run in np.unique(codes):
        time, temperature = readings["time"][codes == run], readings["temperature"][codes == run]
        grid = np.arange(time[0], time[-1], MINUTE)
        total_change += float(np.abs(np.diff(np.interp(grid, time, temperature))).sum())
        minute_count += max(grid.size - 1, 0)
    return total_change / minute_count if total_change > 0 else 1.0


INSTRUMENT = replace(instrument(), columns=COLUMNS, tailor=tailor_to_readings, settings=())


@wraps(simulate_columns)
def simulate(*args: Any, unit: str = "ug", **options: Any) -> bc.Measurements:
    return instrument(unit).simulate(*args, unit=unit, **options)
