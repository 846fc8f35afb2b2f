"""MEMS gyroscope: zero-rate drift over temperature (source 1).

Measurement equation, output in °/s:

    output = bias + (1 + κ)·Ω

Raw outputs in volt become °/s by V = 1.2000 V + 0.83 mV/(°/s)·rate (source 1; the 1.2000 V follows from its table).

The resonance laws replace the line. Young's modulus of silicon is E0·(1 − K_ET·(T−T0)), so both modes of the gyro
detune, and the zero-rate output depends on the resonance denominator (source 1)

    D = √[ (r²·(1−ε_s) − (1−ε_d))² + (1−ε_d)/Q² ],   ε = K_ET·(T−T0) of each mode,  r = ω_s0/ω_d0,

as rate = c0 + q·(D(T0)/D(T) − 1), so that c0 is the zero-rate output at T0; source 1's c0 + q·D(T0)/D(T) is the same
up to the constant. A second law has constant drive force instead of constant amplitude, with a factor (1−ε_d)^−½.

Noise: white, of unknown size. Known contributions: the converter's resolution 0.0311 mV (0.037 °/s), the rounding of
the printed voltage to 0.1 mV (0.12 °/s), and the thermometer's error within ±0.5 °C (uniform: 0.29 °C).

Prior standard deviations are those of a first calibration, assumed if no source is named; replace them by data-sheet
values.
"""

from __future__ import annotations

import bayescal as bc
from bayescal import effects
from bayescal_models import catalogue
from bayescal_models.catalogue import MINUTE, EffectTable, centred, effect, one
from bayescal_models.mems_gyro import COLUMNS, NOMINAL_SCALE, THERMOMETER_SD, VOLTAGE_STEP
from bayescal_models.mems_gyro.campaign import Campaign
from bayescal_models.mems_gyro.resonance import compute_amplitude_law, compute_force_law
from bayescal_models.mems_gyro.simulator import simulate_columns
from bayescal_models.simulated import ReferenceProblem, list_experiments, make_readings_simulator


def _evaluate_response(slots, r):
    rate = r["rate_input"] if "rate_input" in r.columns else 0.0
    return slots["bias"] + (1 + slots["scale"]) * rate


def _evaluate_board_departure(r):
    return r.centred("board_temperature")


def _evaluate_amplitude_law(r, k_drive, k_sense, ratio, quality):
    return compute_amplitude_law(r.centred(), k_drive, k_sense, ratio, quality)


def _evaluate_force(r, k_drive, k_sense, ratio, quality):
    return compute_force_law(r.centred(), k_drive, k_sense, ratio, quality)


MODES = (
    bc.Shape("k_drive", "1/degC", 6e-5, 1e-4),
    bc.Shape("k_sense", "1/degC", 6e-5, 1e-4),
    bc.Shape("ratio", "1", 1.01, 1.10, scale="linear"),
    bc.Shape("quality", "1", 300.0, 30000.0),
)
AMPLITUDE_EFFECT = effect(
    _evaluate_amplitude_law, "q·(D(T0)/D(T) − 1), drive amplitude held", "temperature", shapes=MODES
)
FORCE_EFFECT = effect(
    _evaluate_force, "q·((1−ε_d)^−½·D(T0)/D(T) − 1), drive force held", "temperature", shapes=MODES
)
LAG = catalogue.thermal_lag(MINUTE, 20 * MINUTE, 0.1, "deg/s", rate=(0.1, "deg/s/(degC/min)"))
BOARD_EFFECT = effect(_evaluate_board_departure, "c·(T_board − T_board,0)", "board_temperature")
SCALE_CONSTANT = effect(one, "c", "rate_input", kind="constant")
SCALE_TEMPCO = effect(centred, "c·(T − T0)", "temperature", "rate_input")
ELECTRONICS = "source 1 names reference voltage and electronics as possible causes; size assumed"
RESONANCE_SOURCE = "source 1; values of K_ET, r and Q assumed by us"

EFFECTS = EffectTable.from_rows(
    "source 1; size assumed by us",
    baseline=(
        ("bias.constant", catalogue.constant, 50.0, "deg/s"),
        ("bias.temperature", catalogue.linear, 0.05, "deg/s/degC"),
    ),
    candidates=(
        ("bias.temperature_quadratic", catalogue.quadratic, 5e-4, "deg/s/degC^2"),
        ("bias.temperature_cubic", catalogue.cubic, 1e-5, "deg/s/degC^3"),
        ("bias.thermal_lag", LAG, 0.05, "deg/s/degC"),
        ("bias.reference_voltage", BOARD_EFFECT, 0.02, "deg/s/degC", ELECTRONICS),
        ("bias.warm_up", catalogue.warm_up(2 * MINUTE, 40 * MINUTE), 0.5, "deg/s"),
        ("bias.drift", catalogue.drift, 0.1, "deg/s"),
        ("bias.run", catalogue.deviation, 0.05, "deg/s"),
        ("scale.constant", SCALE_CONSTANT, 10000.0, "ppm", "assumed: 1 % of scale factor"),
        ("scale.temperature", SCALE_TEMPCO, 300.0, "ppm/degC"),
        *catalogue.make_common_effects("bias", "deg/s", size=0.6, span=25.0, pace=1.0),
    ),
    others=(
        ("bias.resonance", AMPLITUDE_EFFECT, 500.0, "deg/s", RESONANCE_SOURCE),
        ("bias.resonance_force", FORCE_EFFECT, 500.0, "deg/s", RESONANCE_SOURCE),
    ),
)
LINEAR, RESONANCE, RESONANCE_FORCE = (
    EFFECTS[f"bias.{cause}"] for cause in ("temperature", "resonance", "resonance_force")
)
THERMOMETER = effects.thermometer(THERMOMETER_SD, source="source 1: thermometer good to 0.5 °C")


def _add_powers(*orders: str, include_error: bool = False) -> bc.Model:
    """Return the baseline plus bias terms in powers of temperature (`orders`); `include_error`: errors in variables."""
    model = INSTRUMENT.baseline()
    for order in orders:
        model = model + f"bias.temperature_{order}"
    return model + THERMOMETER if include_error else model


def _build_resonance(law: bc.Effect, include_error: bool = False) -> bc.Model:
    model = INSTRUMENT.baseline() - LINEAR + law
    return model + THERMOMETER if include_error else model


def _build_quantised() -> bc.Model:
    return INSTRUMENT.baseline().with_noise(bc.Quantised(VOLTAGE_STEP, bc.HalfCauchy(0.1)))


INSTRUMENT = bc.Instrument(
    name="mems_gyro",
    title="MEMS gyroscope: zero-rate drift over temperature",
    columns=COLUMNS,
    slots=(
        bc.Slot("bias", "deg/s", "zero-rate output"),
        bc.Slot("scale", "1", "relative deviation of the scale factor"),
    ),
    response=_evaluate_response,
    effects=EFFECTS.baseline,
    candidates=EFFECTS.candidates,
    noise=bc.White(bc.HalfCauchy(0.1)),
    nominal_scale=NOMINAL_SCALE,
    structures=(
        ("line", _add_powers),
        ("quadratic", lambda: _add_powers("quadratic")),
        ("cubic", lambda: _add_powers("quadratic", "cubic")),
        ("resonance", lambda: _build_resonance(RESONANCE)),
        ("resonance, force held", lambda: _build_resonance(RESONANCE_FORCE)),
        ("line, thermometer error", lambda: _add_powers(include_error=True)),
        ("quadratic, thermometer error", lambda: _add_powers("quadratic", include_error=True)),
        ("cubic, thermometer error", lambda: _add_powers("quadratic", "cubic", include_error=True)),
        ("resonance, thermometer error", lambda: _build_resonance(RESONANCE, include_error=True)),
        ("line, voltage rounded", _build_quantised),
    ),
    simulator=simulate_columns,
    experiments=list_experiments(
        simulate_columns,
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
simulate = make_readings_simulator(INSTRUMENT)


# Over 30 to 80 °C, one reading a step: 44 rows.
ON_TURNTABLE = Campaign(rate_input=(0.0, 100.0, -100.0))  # without it no scale factor is identified
reference_problem = ReferenceProblem(
    INSTRUMENT,
    Campaign(average=300, runs=4),
    lambda effects: ON_TURNTABLE if any("scale" in name for name in effects) else Campaign(),
)
