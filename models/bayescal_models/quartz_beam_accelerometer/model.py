"""Quartz resonant beam accelerometer with two thermometers: bias and scale factor over temperature (source 2).

Measurement equation, a the known input in local g, Kn the nominal scale factor, b in µg, κ relative, K2 in µg/g²:

    f = Kn·[ b + (1 + κ)·a + K2·a² ]

The output is the difference of the two beams' frequencies in Hz; it becomes µg by Kn = 100 Hz/g (assumed; state a
nominal scale to replace it). Thermometers: t1 at the drive circuit, t2 in the head; δt = t1 − t2.

Both b and κ are, after source 2, sums of 15 columns (its `b_com = b0 − [ … ]`, here the bracket itself):

    c01 + c11·t1 + c21·t1² + c31·t1³ + c02 + c12·t2 + c22·t2² + c32·t2³ + cδ1·δt + cδ2·δt² + cδ3·δt³
        + ċ1·dt1/dt + ċ2·dt2/dt + c×rate·t2·dt2/dt + c×grad·t2·δt

with t1 and t2 relative to T0 (mean of t2, rounded, stored with the calibration as temperature_head_0). The
columns have rank 12: c01 − c02, c11 − c12 − cδ1 and c21 − c22 − cδ2 − 2·c×grad are not identified by any readings; all
15 are kept, their priors determine these three, and every calibration reports them. On soaked points the rank is 4.

*Baseline*: a cubic polynomial of the head's temperature for b and for κ, which a soaked four-position tumble determines
(rank 4). The other columns need ramps; `discover` finds those that are missing, and the structure "two thermometers"
has all 15. Further structures are the three earlier methods that source 2 describes: polynomials of t1 of order 1, 3
and 5; t1 with its rate and their product; polynomials of the sum of the beams' frequencies (`frequency_sum`). The
effects `*.constant_circuit` are in structures only: together with `*.constant_head` they are not identified.

Noise: white, of unknown size. Sizes are prior standard deviations for a first calibration, assumed if no source is
named; replace them by data-sheet values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import bayescal as bc
from bayescal import xp
from bayescal_models import catalogue
from bayescal_models.catalogue import MINUTE, POWERS, EffectTable, Factory, effect, one
from bayescal_models.quartz_beam_accelerometer import COLUMNS, NOMINAL_SCALE, PER_G
from bayescal_models.quartz_beam_accelerometer.campaign import Campaign
from bayescal_models.quartz_beam_accelerometer.simulator import simulate_columns
from bayescal_models.simulated import ReferenceProblem, list_experiments, make_readings_simulator

FREQUENCY_SUM_HZ = 80_000.0  # Hz at 15 °C, nominal; assumed
FREQUENCY_TEMPCO = -1.6  # Hz/°C, nominal, assumed: converts the sum to a temperature
PLAY_DEGC = 1.0  # °C, half width of the backlash


def _evaluate_response(slots, r):
    a = r["acceleration"]
    return slots["bias"] + (1 + slots["scale"]) * a + slots["second_order"] * (PER_G * a) ** 2


# Basis functions, °C: t1 − T0, t2 − T0, their difference, the temperature from the frequency sum; and a backlash.


def circuit(r: bc.Frame) -> Any:
    """Return the circuit's temperature change t1 − T0, °C, (n,)."""
    return r["temperature_circuit"] - r.reference["temperature_head_0"]


def head(r: bc.Frame) -> Any:
    """Return the head's temperature change t2 − T0, °C, (n,)."""
    return r.centred("temperature_head")


def gradient(r: bc.Frame) -> Any:
    """Return the temperature difference of circuit and head, δt = t1 − t2, °C, (n,)."""
    return r["temperature_circuit"] - r["temperature_head"]


def _evaluate_indicated_temperature(r: bc.Frame) -> Any:
    """Return the temperature change that the frequency sum indicates, °C, (n,)."""
    return (r["frequency_sum"] - FREQUENCY_SUM_HZ) / FREQUENCY_TEMPCO


def _power(quantity: Callable[[bc.Frame], Any], order: int, r: bc.Frame) -> Any:
    return quantity(r) ** order


def _evaluate_rate(column: str, r: bc.Frame) -> Any:
    return r.rate(column)


def _evaluate_rate_product(quantity: Callable[[bc.Frame], Any], column: str, r: bc.Frame) -> Any:
    return quantity(r) * r.rate(column)


def _multiply_gradient(quantity: Callable[[bc.Frame], Any], r: bc.Frame) -> Any:
    return quantity(r) * gradient(r)


def _evaluate_backlash(r: bc.Frame) -> Any:
    """Return the play (backlash) operator (t2 − s)/`PLAY_DEGC`, −1 … 1, (n,); s = t2 at the start of each run."""
    temperature, is_run_start = r["temperature_head"][r.order], r.step < 0

    def advance(centre, row):
        value, is_first = row
        centre = xp.where(is_first, value, xp.clip(centre, value - PLAY_DEGC, value + PLAY_DEGC))
        return centre, (value - centre) / PLAY_DEGC

    return xp.scatter(r.order, xp.scan(advance, temperature[0], (temperature, is_run_start)))


# Factories and effects of this instrument.

KINDS = ("", "linear", "quadratic", "cubic", "quartic", "")
T1, T2 = T1_T2 = ("temperature_circuit", "temperature_head")
Factories = dict[str, Factory]


def _make_pair(basis: Callable[..., Any], equation: str, *columns: str, **fields: Any) -> Factories:
    """Return the factories of an effect on bias and on scale factor, by slot; the latter needs an acceleration."""
    names = {"bias": columns, "scale": (*columns, "acceleration")}
    return {s: effect(basis, equation, *n, **{"along": "", **fields}) for s, n in names.items()}


def _make_circuit_power(n: int) -> Factories:
    return _make_pair(
        partial(_power, circuit, n), f"c·(t1 − T0){POWERS[n - 1]}", *T1_T2, along=T1, kind=KINDS[n]
    )


def _make_head_power(n: int) -> Factories:
    return _make_pair(
        partial(_power, head, n), f"c·(t2 − T0){POWERS[n - 1]}", T2, along=T2, kind=KINDS[n]
    )


def _make_gradient_power(n: int) -> Factories:
    kind = KINDS[n] if n > 1 else ""  # for n = 1 the term is linear in δt
    return _make_pair(
        partial(_power, gradient, n), f"c·(t1 − t2){POWERS[n - 1]}", *T1_T2, kind=kind
    )


def _make_sum_power(n: int) -> Factories:
    nominal_text = f"F0 = {FREQUENCY_SUM_HZ:g} Hz, F' = {FREQUENCY_TEMPCO:g} Hz/°C"
    equation = f"c·((F − F0)/F'){POWERS[n - 1]},  {nominal_text}"
    return _make_pair(
        partial(_power, _evaluate_indicated_temperature, n),
        equation,
        "frequency_sum",
        along=None,
        kind=KINDS[n],
    )


def _make_rate_effect(column: str, symbol: str) -> Factories:
    basis, along = partial(_evaluate_rate, column), f"{column} rate"
    return _make_pair(basis, f"c·d{symbol}/dt", "time", column, along=along, kind="rate")


def _make_rate_product(quantity: Callable[[bc.Frame], Any], column: str, symbol: str) -> Factories:
    basis = partial(_evaluate_rate_product, quantity, column)
    return _make_pair(basis, f"c·({symbol} − T0)·d{symbol}/dt", "time", *T1_T2)


def _make_gradient_product(quantity: Callable[[bc.Frame], Any], symbol: str) -> Factories:
    return _make_pair(partial(_multiply_gradient, quantity), f"c·({symbol} − T0)·(t1 − t2)", *T1_T2)


def _make_lag(start: float, unit: str, **fields: Any) -> Factory:
    return catalogue.thermal_lag(MINUTE, 60 * MINUTE, start, unit, column=T2, **fields)


CONSTANT = _make_pair(one, "c", along=None)
BACKLASH = _make_pair(
    _evaluate_backlash,
    f"c·(t2 − s)/w,  s(t2) a play operator with |t2 − s| ≤ w = {PLAY_DEGC:g} °C",
    *("time", T2),
    untestable=partial(catalogue.explain_missing_reversal, T2, PLAY_DEGC),
    along=None,
    kind="hysteresis",
)

# Rows for both slots: name, factory, size for the bias in µg, divisor of the unit, source. Sizes for the scale factor,
# in ppm, are a tenth of these, except the constants.
SCALE_RATIO, ASSUMED_SOURCE = 0.1, "assumed by us"
CONSTANT_SIZES = {"bias": 20_000.0, "scale": 5000.0}  # µg, ppm
# The body of the head is common to both slots, and a form of the bias's lag.
LAGS = {"bias": _make_lag(20.0, "ug"), "scale": _make_lag(20.0 * SCALE_RATIO, "ppm", bodies={})}
CIRCUIT_ROWS = (
    ("temperature_circuit", _make_circuit_power(1), 50.0, "/degC"),
    ("temperature_circuit_quadratic", _make_circuit_power(2), 0.5, "/degC^2"),
    ("temperature_circuit_cubic", _make_circuit_power(3), 0.005, "/degC^3"),
    ("temperature_circuit_quartic", _make_circuit_power(4), 5e-5, "/degC^4"),
    ("temperature_circuit_quintic", _make_circuit_power(5), 5e-7, "/degC^5"),
)
HEAD_ROWS = (
    ("temperature_head", _make_head_power(1), 50.0, "/degC"),
    ("temperature_head_quadratic", _make_head_power(2), 0.5, "/degC^2"),
    ("temperature_head_cubic", _make_head_power(3), 0.005, "/degC^3"),
)
GRADIENT_ROWS = (
    ("gradient", _make_gradient_power(1), 20.0, "/degC"),
    ("gradient_quadratic", _make_gradient_power(2), 1.0, "/degC^2"),
    ("gradient_cubic", _make_gradient_power(3), 0.1, "/degC^3"),
    ("rate_circuit", _make_rate_effect(T1, "t1"), 10.0, "/(degC/min)"),
    ("rate_head", _make_rate_effect(T2, "t2"), 10.0, "/(degC/min)"),
)
PRODUCT_ROWS = (
    ("temperature_x_rate", _make_rate_product(head, T2, "t2"), 0.2, "/degC/(degC/min)"),
    ("temperature_x_gradient", _make_gradient_product(head, "t2"), 0.5, "/degC^2"),
)
CIRCUIT_PRODUCTS = (  # source 2 does not say which thermometer t is
    ("temperature_x_rate_circuit", _make_rate_product(circuit, T1, "t1"), 0.2, "/degC/(degC/min)"),
    ("temperature_x_gradient_circuit", _make_gradient_product(circuit, "t1"), 0.5, "/degC^2"),
)
OTHER_ROWS = (
    ("thermal_lag", LAGS, 20.0, "/degC", ASSUMED_SOURCE),
    ("hysteresis", BACKLASH, 20.0, "", ASSUMED_SOURCE),
    ("warm_up", catalogue.warm_up(2 * MINUTE, 60 * MINUTE), 50.0, "", ASSUMED_SOURCE),
    ("drift", catalogue.drift, 10.0, "", ASSUMED_SOURCE),
    ("run", catalogue.deviation, 20.0, "", ASSUMED_SOURCE),
    ("cell", catalogue.deviation, 5.0, "", ASSUMED_SOURCE),
)
SUM_ROWS = (
    ("frequency_sum", _make_sum_power(1), 50.0, "/degC"),
    ("frequency_sum_quadratic", _make_sum_power(2), 0.5, "/degC^2"),
    ("frequency_sum_cubic", _make_sum_power(3), 0.005, "/degC^3"),
)
K2 = effect(one, "K2·a²", "acceleration")


def _expand_to_slots(*rows: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    for slot, unit, ratio in (("bias", "ug", 1.0), ("scale", "ppm", SCALE_RATIO)):
        for cause, factory, size, divisor, *source in rows:
            slot_size = size[slot] if isinstance(size, dict) else size * ratio
            slot_factory = factory[slot] if isinstance(factory, dict) else factory
            yield f"{slot}.{cause}", slot_factory, slot_size, unit + divisor, *source


EFFECTS = EffectTable.from_rows(
    "source 2; size assumed by us",
    baseline=_expand_to_slots(("constant_head", CONSTANT, CONSTANT_SIZES, ""), *HEAD_ROWS),
    candidates=(
        *_expand_to_slots(*CIRCUIT_ROWS[:3], *GRADIENT_ROWS, *PRODUCT_ROWS, *OTHER_ROWS),
        ("second_order", K2, 10.0, "ug/g^2", "IEEE Std 1293; size assumed by us"),
        # The products with rate and gradient of source 2 represent a lag that grows with temperature.
        *catalogue.make_common_effects(
            *("bias", "ug"),
            size=400.0,
            span=50.0,
            pace=1.0,
            column=T2,
            causes=("supply", "temperature_x_supply"),
        ),
    ),
    others=_expand_to_slots(
        ("constant_circuit", CONSTANT, CONSTANT_SIZES, ""),
        *(*CIRCUIT_ROWS[3:], *CIRCUIT_PRODUCTS, *SUM_ROWS),
    ),
)


# Named models: that of source 2, and the three earlier methods that it describes.


def _build_model(*causes: Any, base: bc.Model | None = None) -> bc.Model:
    """Return a base model (default: no effects) plus effects on bias and scale factor, given by cause or table row."""
    names = [cause if isinstance(cause, str) else cause[0] for cause in causes]
    model = base or bc.Model(INSTRUMENT, (), INSTRUMENT.noise)
    for slot in ("bias", "scale"):
        model = model + tuple(EFFECTS[f"{slot}.{name}"] for name in names)
    return model


def of_circuit(order: int) -> bc.Model:
    """Return the model with polynomials of t1 for bias and scale factor: the first earlier method in source 2."""
    return _build_model("constant_circuit", *CIRCUIT_ROWS[:order])


def with_rate() -> bc.Model:
    """Return the model with a cubic in t1 and terms dt1/dt and t1·dt1/dt: the second earlier method in source 2."""
    return _build_model("rate_circuit", "temperature_x_rate_circuit", base=of_circuit(3))


def of_frequency_sum(order: int = 3) -> bc.Model:
    """Return the model with polynomials of the frequency sum, in °C: the third earlier method in source 2."""
    return _build_model("constant_head", *SUM_ROWS[:order])


def two_thermometers(crossed_by: str = "head") -> bc.Model:
    """Return the model of source 2: 15 columns of rank 12 for each of bias and scale factor.

    Args:
        crossed_by: thermometer of t in the products t·dt/dt and t·δt: "head" or "circuit".
    """
    products = PRODUCT_ROWS if crossed_by == "head" else CIRCUIT_PRODUCTS
    circuit_causes = ("constant_circuit", *CIRCUIT_ROWS[:3])
    return _build_model(*circuit_causes, "constant_head", *HEAD_ROWS, *GRADIENT_ROWS, *products)


INSTRUMENT = bc.Instrument(
    name="quartz_beam_accelerometer",
    title="quartz resonant beam accelerometer with two thermometers",
    columns=COLUMNS,
    slots=(
        bc.Slot("bias", "ug", "output at zero input"),
        bc.Slot("scale", "1", "relative deviation of the scale factor from nominal"),
        bc.Slot("second_order", "ug/g^2", "K2"),
    ),
    response=_evaluate_response,
    effects=EFFECTS.baseline,
    candidates=EFFECTS.candidates,
    noise=bc.White(bc.HalfCauchy(20.0)),
    nominal_scale=NOMINAL_SCALE,
    structures=(
        ("cubic of t2", lambda: INSTRUMENT.baseline()),
        ("t1, order 1", lambda: of_circuit(1)),
        ("t1, order 3", lambda: of_circuit(3)),
        ("t1, order 5", lambda: of_circuit(5)),
        ("t1, rate and product", with_rate),
        ("frequency sum, order 3", of_frequency_sum),
        ("two thermometers", two_thermometers),
        ("two thermometers, t1 in the products", lambda: two_thermometers("circuit")),
    ),
    simulator=simulate_columns,
    experiments=list_experiments(
        simulate_columns,
        {
            "the same again": Campaign(),
            "ramps of 0.5 and 4 °C/min": Campaign(
                ramp_speeds=(0.5, 4.0), interval=120.0, average=120.0
            ),
            "four tumbles": Campaign(repeats=4),
            "ramps at five attitudes": Campaign(attitudes=(1.0, 0.5, 0.0, -0.5, -1.0)),
            "held for two hours at each end of a ramp": Campaign(
                hold=7200.0, interval=120.0, average=120.0
            ),
            "a minute without power between runs": Campaign(pause=60.0),
        },
    ),
    use=bc.Use("acceleration", "ug"),
    source="source 2",
)
simulate = make_readings_simulator(INSTRUMENT)
# Two tumbles over five temperatures and a ramp at each of three attitudes, a reading every ten minutes.
reference_problem = ReferenceProblem(
    INSTRUMENT,
    Campaign(temperatures=(-40.0, -10.0, 20.0, 45.0, 70.0), interval=600.0, soak=3600.0),
    Campaign(),
)
