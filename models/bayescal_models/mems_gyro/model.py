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

import math

import bayescal as bc
from bayescal import effects
from bayescal_models.mems_gyro.campaign import SIZES
from bayescal_models.mems_gyro.demo import run
from bayescal_models.mems_gyro.experiments import EXPERIMENTS
from bayescal_models.mems_gyro.simulate import simulate
from bayescal_models.mems_gyro.structures import RESONANCE, RESONANCE_FORCE

SOURCE = "source 1; size ours"
SENSITIVITY = 0.83e-3  # V per °/s, source 1
THERMOMETER_SD = 0.5 / math.sqrt(3)  # °C; good to 0.5 °C, taken as uniform; source 1
CONVERTER_STEP = 0.0311e-3 / SENSITIVITY  # °/s, source 1
VOLTAGE_STEP = 0.1e-3 / SENSITIVITY  # °/s, rounding of the printed voltage, source 1
MINUTE = 60.0


def _size(name: str) -> tuple[float, str]:
    return SIZES[name].value, SIZES[name].unit


def _response(slots, r):
    rate = r["rate_input"] if "rate_input" in r.columns else 0.0
    return slots["bias"] + (1 + slots["scale"]) * rate


def _known_noise(slope: float) -> dict[str, float]:
    """Standard deviations known before any fit, °/s, for a bias that changes by `slope` °/s per °C."""
    return {
        "converter step": CONVERTER_STEP / math.sqrt(12),
        "rounding of the voltage": VOLTAGE_STEP / math.sqrt(12),
        "thermometer": THERMOMETER_SD * abs(slope),
    }


CONSTANT = effects.constant("bias", 50.0, "deg/s", source=SOURCE)
LINE = effects.linear("bias", *_size("bias.temperature"), source=SOURCE)
QUADRATIC = effects.quadratic("bias", *_size("bias.temperature_quadratic"), source=SOURCE)
CUBIC = effects.cubic("bias", *_size("bias.temperature_cubic"), source=SOURCE)
RATE = effects.rate("bias", *_size("bias.rate"), source=SOURCE)
LAG = effects.thermal_lag(
    "bias",
    *_size("bias.thermal_lag"),
    low=MINUTE,
    high=20 * MINUTE,
    start=0.1,
    start_unit="deg/s",
    source=SOURCE,
)
REFERENCE = bc.Effect(
    "bias.reference_voltage",
    "bias",
    basis=lambda r: r.centred("board_temperature"),
    coefficients=(
        bc.Coefficient("deg/s/degC", bc.Normal(0.0, _size("bias.reference_voltage")[0])),
    ),
    columns=("board_temperature",),
    varies=("board_temperature",),
    equation="c·(T_board − T_board,0)",
    source="source 1 names the reference voltage and the electronics as possible causes; size ours",
)
WARM_UP = effects.warm_up(
    "bias", *_size("bias.warm_up"), low=2 * MINUTE, high=40 * MINUTE, source=SOURCE
)
DRIFT = effects.drift("bias", *_size("bias.drift"), source=SOURCE)
RUN = effects.deviation("bias", "run", *_size("bias.run"), source=SOURCE)
SCALE = bc.Effect(
    "scale.constant",
    "scale",
    basis=lambda r: 1.0,
    coefficients=(bc.Coefficient("ppm", bc.Normal(0.0, 10000.0)),),
    columns=("rate_input",),
    varies=("rate_input",),
    equation="c",
    source="ours: 1 % of scale factor",
)
SCALE_TEMPERATURE = bc.Effect(
    "scale.temperature",
    "scale",
    basis=lambda r: r.centred(),
    coefficients=(bc.Coefficient("ppm/degC", bc.Normal(0.0, _size("scale.temperature")[0])),),
    columns=("temperature", "rate_input"),
    varies=("temperature", "rate_input"),
    equation="c·(T − T0)",
    source=SOURCE,
)
THERMOMETER = effects.thermometer(THERMOMETER_SD, source="source 1: thermometer good to 0.5 °C")

INSTRUMENT = bc.Instrument(
    name="mems_gyro",
    title="MEMS gyroscope: zero-rate drift over temperature",
    columns=(
        bc.Column("run", None, "label of the run", required=False),
        bc.Column("time", "s", "one origin over all runs", required=False),
        bc.Column("temperature", "degC", "ambient thermometer", low=-273.15, high=400.0),
        bc.Column(
            "board_temperature", "degC", "electronics", required=False, low=-273.15, high=400.0
        ),
        bc.Column("rate_input", "deg/s", "rate of the table about the input axis", required=False),
        bc.Column("output", "deg/s", "output, or V with the nominal scale"),
    ),
    slots=(
        bc.Slot("bias", "deg/s", "zero-rate output"),
        bc.Slot("scale", "1", "relative deviation of the scale factor"),
    ),
    response=_response,
    effects=(CONSTANT, LINE),
    candidates=(
        QUADRATIC,
        CUBIC,
        RATE,
        LAG,
        REFERENCE,
        WARM_UP,
        DRIFT,
        RUN,
        SCALE,
        SCALE_TEMPERATURE,
    ),
    noise=bc.White(bc.HalfCauchy(0.1)),
    nominal_scale=bc.NominalScale("V", gain=SENSITIVITY, offset=1.2),
    known_noise=_known_noise,
    structures=(
        ("line", lambda: INSTRUMENT.baseline()),
        ("quadratic", lambda: INSTRUMENT.baseline() + QUADRATIC),
        ("cubic", lambda: INSTRUMENT.baseline() + QUADRATIC + CUBIC),
        ("resonance", lambda: INSTRUMENT.baseline() - LINE + RESONANCE),
        ("resonance, force held", lambda: INSTRUMENT.baseline() - LINE + RESONANCE_FORCE),
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
    simulate=simulate,
    experiments=EXPERIMENTS,
    demo=run,
    use=bc.Use("rate_input", "deg/s"),
    source="source 1",
)
