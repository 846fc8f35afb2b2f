"""MEMS gyroscope: zero-rate drift over temperature (source 1).

Measurement equation, output in °/s:

    output = bias + (1 + κ)·Ω

Slots, and the effects that add to them:

- `bias`, °/s: `bias.constant` and `bias.temperature` (the baseline: a line), `bias.temperature_quadratic`,
  `bias.temperature_cubic`, `bias.rate`, `bias.thermal_lag`, `bias.reference_voltage`, `bias.warm_up`, `bias.drift`,
  `bias.run`, and the structures `bias.resonance` and `bias.resonance_force`
- `scale`, 1: `scale.constant`, `scale.temperature`
- `temperature`, °C: `temperature.reading`, the thermometer's own error (errors in variables)

Raw outputs in volt become °/s by V = 1.2000 V + 0.83 mV/(°/s)·rate (source 1; the 1.2000 V follows from its table).

Noise: white, of unknown size. Known beforehand: the converter's step 0.0311 mV (0.037 °/s), the rounding of the
printed voltage to 0.1 mV (0.12 °/s), and the thermometer, good to 0.5 °C (uniform: 0.29 °C).

Prior sizes are standard deviations for a first calibration, ours, where no source is named; a user replaces
them with data-sheet values.
"""

from __future__ import annotations

import bayescal as bc
from bayescal_models.mems_gyro import COLUMNS, NOMINAL_SCALE, VOLTAGE_STEP, effects
from bayescal_models.mems_gyro.campaign import Campaign
from bayescal_models.mems_gyro.effects import CUBIC, LINE, QUADRATIC, RESONANCE, THERMOMETER
from bayescal_models.mems_gyro.simulator import simulated_columns
from bayescal_models.simulated import experiments, readings_of


def _response(slots, r):
    rate = r["rate_input"] if "rate_input" in r.columns else 0.0
    return slots["bias"] + (1 + slots["scale"]) * rate


INSTRUMENT = bc.Instrument(
    name="mems_gyro",
    title="MEMS gyroscope: zero-rate drift over temperature",
    columns=COLUMNS,
    slots=(
        bc.Slot("bias", "deg/s", "zero-rate output"),
        bc.Slot("scale", "1", "relative deviation of the scale factor"),
    ),
    response=_response,
    effects=effects.BASELINE,
    candidates=effects.CANDIDATES,
    noise=bc.White(bc.HalfCauchy(0.1)),
    nominal_scale=NOMINAL_SCALE,
    structures=(
        ("line", lambda: INSTRUMENT.baseline()),
        ("quadratic", lambda: INSTRUMENT.baseline() + QUADRATIC),
        ("cubic", lambda: INSTRUMENT.baseline() + QUADRATIC + CUBIC),
        ("resonance", lambda: INSTRUMENT.baseline() - LINE + RESONANCE),
        ("resonance, force held", lambda: INSTRUMENT.baseline() - LINE + effects.RESONANCE_FORCE),
        ("line, thermometer error", lambda: INSTRUMENT.baseline() + THERMOMETER),
        ("quadratic, thermometer error", lambda: INSTRUMENT.baseline() + QUADRATIC + THERMOMETER),
        (
            "cubic, thermometer error",
            lambda: INSTRUMENT.baseline() + QUADRATIC + CUBIC + THERMOMETER,
        ),
        (
            "resonance, thermometer error",
            lambda: INSTRUMENT.baseline() - LINE + RESONANCE + THERMOMETER,
        ),
        (
            "line, voltage rounded",
            lambda: INSTRUMENT.baseline().with_noise(
                bc.Quantised(VOLTAGE_STEP, bc.HalfCauchy(0.1))
            ),
        ),
    ),
    simulator=simulated_columns,
    experiments=experiments(
        simulated_columns,
        {
            "the same again": Campaign(),
            "twice as many runs": Campaign(runs=6),
            "steps four times as long": Campaign(dwell=1200.0, average=120.0),
            "steps of one minute": Campaign(dwell=60.0, average=10.0),
            "one temperature, held for an hour": Campaign(
                temperatures=(50.0, 55.0), dwell=3600.0, average=120.0
            ),
            "every run upwards": Campaign(alternate=False),
            "power left on between runs for a minute": Campaign(pause=60.0),
            "six hours between runs": Campaign(pause=21600.0),
            "turned at ±100 °/s": Campaign(rate_input=(0.0, 100.0, -100.0)),
        },
    ),
    use=bc.Use("rate_input", "deg/s"),
    source="source 1",
)
simulate = readings_of(INSTRUMENT, simulated_columns)
