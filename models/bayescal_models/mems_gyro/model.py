"""MEMS gyroscope: zero-rate drift over temperature (source 1).

Measurement equation, output in °/s:

    output = bias + (1 + κ)·Ω

Raw outputs in volt become °/s by V = 1.2000 V + 0.83 mV/(°/s)·rate (source 1; the 1.2000 V follows from its table).

The resonance laws replace the line. Silicon softens as E0·(1 − K_ET·(T−T0)), so both modes of the gyro detune,
and the zero-rate offset carries the resonance denominator (source 1)

    D = √[ (r²·(1−ε_s) − (1−ε_d))² + (1−ε_d)/Q² ],   ε = K_ET·(T−T0) of each mode,  r = ω_s0/ω_d0,

as rate = c0 + q·(D(T0)/D(T) − 1). (Written so that c0 is the zero rate at T0; the document's c0 + q·D(T0)/D(T)
has the same curves.) A second form has constant drive force instead of constant amplitude, with a factor (1−ε_d)^−½.

Noise: white, of unknown size. Known beforehand: the converter's step 0.0311 mV (0.037 °/s), the rounding of the
printed voltage to 0.1 mV (0.12 °/s), and the thermometer, good to 0.5 °C (uniform: 0.29 °C).

Prior sizes are standard deviations for a first calibration, ours if no source is named; replace
them by data-sheet values.
"""

from __future__ import annotations

import bayescal as bc
from bayescal import effects
from bayescal_models import catalogue
from bayescal_models.catalogue import MINUTE, EffectTable, centred, effect, one
from bayescal_models.mems_gyro import COLUMNS, NOMINAL_SCALE, THERMOMETER_SD, VOLTAGE_STEP
from bayescal_models.mems_gyro.campaign import Campaign
from bayescal_models.mems_gyro.resonance import with_amplitude_held, with_force_held
from bayescal_models.mems_gyro.simulator import simulated_columns
from bayescal_models.simulated import ReferenceProblem, experiments, readings_of


def _response(slots, r):
    rate = r["rate_input"] if "rate_input" in r.columns else 0.0
    return slots["bias"] + (1 + slots["scale"]) * rate


def _board(r):
    return r.centred("board_temperature")


def _held_amplitude(r, k_drive, k_sense, ratio, quality):
    return with_amplitude_held(r.centred(), k_drive, k_sense, ratio, quality)


def _held_force(r, k_drive, k_sense, ratio, quality):
    return with_force_held(r.centred(), k_drive, k_sense, ratio, quality)


MODES = (
    bc.Shape("k_drive", "1/degC", 6e-5, 1e-4),
    bc.Shape("k_sense", "1/degC", 6e-5, 1e-4),
    bc.Shape("ratio", "1", 1.01, 1.10, scale="linear"),
    bc.Shape("quality", "1", 300.0, 30000.0),
)
AMPLITUDE = effect(
    _held_amplitude, "q·(D(T0)/D(T) − 1), drive amplitude held", "temperature", shapes=MODES
)
FORCE = effect(
    _held_force, "q·((1−ε_d)^−½·D(T0)/D(T) − 1), drive force held", "temperature", shapes=MODES
)
LAG = catalogue.thermal_lag(MINUTE, 20 * MINUTE, 0.1, "deg/s", rate=(0.1, "deg/s/(degC/min)"))
BOARD = effect(_board, "c·(T_board − T_board,0)", "board_temperature")
ON_RATE = effect(one, "c", "rate_input", kind="constant")
ON_RATE_OVER_TEMPERATURE = effect(centred, "c·(T − T0)", "temperature", "rate_input")
ELECTRONICS = "source 1 names reference voltage and electronics as possible causes; size ours"
RESONANT = "source 1; values of K_ET, r and Q ours"

EFFECTS = EffectTable.of(
    "source 1; size ours",
    baseline=(
        ("bias.constant", catalogue.constant, 50.0, "deg/s"),
        ("bias.temperature", catalogue.linear, 0.05, "deg/s/degC"),
    ),
    candidates=(
        ("bias.temperature_quadratic", catalogue.quadratic, 5e-4, "deg/s/degC^2"),
        ("bias.temperature_cubic", catalogue.cubic, 1e-5, "deg/s/degC^3"),
        ("bias.thermal_lag", LAG, 0.05, "deg/s/degC"),
        ("bias.reference_voltage", BOARD, 0.02, "deg/s/degC", ELECTRONICS),
        ("bias.warm_up", catalogue.warm_up(2 * MINUTE, 40 * MINUTE), 0.5, "deg/s"),
        ("bias.drift", catalogue.drift, 0.1, "deg/s"),
        ("bias.run", catalogue.deviation, 0.05, "deg/s"),
        ("scale.constant", ON_RATE, 10000.0, "ppm", "ours: 1 % of scale factor"),
        ("scale.temperature", ON_RATE_OVER_TEMPERATURE, 300.0, "ppm/degC"),
        *catalogue.recorded("bias", "deg/s", size=0.6, span=25.0, pace=1.0),
    ),
    others=(
        ("bias.resonance", AMPLITUDE, 500.0, "deg/s", RESONANT),
        ("bias.resonance_force", FORCE, 500.0, "deg/s", RESONANT),
    ),
)
LINE, RESONANCE, RESONANCE_FORCE = (
    EFFECTS[f"bias.{cause}"] for cause in ("temperature", "resonance", "resonance_force")
)
THERMOMETER = effects.thermometer(THERMOMETER_SD, source="source 1: thermometer good to 0.5 °C")


def _polynomial(*orders: str, error: bool = False) -> bc.Model:
    """Build a polynomial model of temperature, with or without thermometer error in each reading."""
    model = INSTRUMENT.baseline()
    for order in orders:
        model = model + f"bias.temperature_{order}"
    return model + THERMOMETER if error else model


def _resonant(law: bc.Effect, error: bool = False) -> bc.Model:
    model = INSTRUMENT.baseline() - LINE + law
    return model + THERMOMETER if error else model


def _rounded() -> bc.Model:
    return INSTRUMENT.baseline().with_noise(bc.Quantised(VOLTAGE_STEP, bc.HalfCauchy(0.1)))


INSTRUMENT = bc.Instrument(
    name="mems_gyro",
    title="MEMS gyroscope: zero-rate drift over temperature",
    columns=COLUMNS,
    slots=(
        bc.Slot("bias", "deg/s", "zero-rate output"),
        bc.Slot("scale", "1", "relative deviation of the scale factor"),
    ),
    response=_response,
    effects=EFFECTS.baseline,
    candidates=EFFECTS.candidates,
    noise=bc.White(bc.HalfCauchy(0.1)),
    nominal_scale=NOMINAL_SCALE,
    structures=(
        ("line", _polynomial),
        ("quadratic", lambda: _polynomial("quadratic")),
        ("cubic", lambda: _polynomial("quadratic", "cubic")),
        ("resonance", lambda: _resonant(RESONANCE)),
        ("resonance, force held", lambda: _resonant(RESONANCE_FORCE)),
        ("line, thermometer error", lambda: _polynomial(error=True)),
        ("quadratic, thermometer error", lambda: _polynomial("quadratic", error=True)),
        ("cubic, thermometer error", lambda: _polynomial("quadratic", "cubic", error=True)),
        ("resonance, thermometer error", lambda: _resonant(RESONANCE, error=True)),
        ("line, voltage rounded", _rounded),
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
simulate = readings_of(INSTRUMENT)


def _fuller(effects) -> Campaign:
    """Return a campaign on a turntable, without which no scale factor shows, where one is hidden."""
    turning = any(INSTRUMENT.effect(name).slot == "scale" for name in effects)
    return Campaign(rate_input=(0.0, 100.0, -100.0) if turning else None)


# Over 30 to 80 °C, one reading a step: 44 rows.
reference_problem = ReferenceProblem(INSTRUMENT, Campaign(average=300, runs=4), _fuller)
