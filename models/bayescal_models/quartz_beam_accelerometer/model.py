"""Quartz resonant beam accelerometer with two thermometers: bias and scale factor over temperature (source 2).

Measurement equation, a the known input in local g, Kn the nominal scale factor, b in µg, κ relative, K2 in µg/g²:

    f = Kn·[ b + (1 + κ)·a + K2·a² ]

The output is the difference of the two beams' frequencies in Hz; it becomes µg by Kn = 100 Hz/g (ours; another with
a nominal scale of your own). Thermometers: t1 at the drive circuit, t2 in the head; δt = t1 − t2.

Both b and κ are, after source 2, sums of 15 columns (its `b_com = b0 − [ … ]`, here the bracket itself):

    c01 + c11·t1 + c21·t1² + c31·t1³ + c02 + c12·t2 + c22·t2² + c32·t2³ + cδ1·δt + cδ2·δt² + cδ3·δt³
        + ċ1·dt1/dt + ċ2·dt2/dt + c×rate·t2·dt2/dt + c×grad·t2·δt

with t1 and t2 about one T0 (mean of t2, rounded, stored with the calibration as temperature_head_0). The
columns have rank 12: c01 − c02, c11 − c12 − cδ1 and c21 − c22 − cδ2 − 2·c×grad are not identified by any readings; all
15 are kept, their priors determine these three, and every calibration reports them. On soaked points the rank is 4.

*Baseline*: a constant and a cubic of the head's temperature for b and for κ, which a soaked four-position tumble
determines (rank 4); further effects on ramps are found by `discover`, or included all at once by the structure
"two thermometers". The bracket above and `frequency_sum` belong to the
document's other methods: polynomials of t1 of order 1, 3 and 5; t1 with its rate and their product; the sum of the
beams' frequencies. `*.constant_circuit` is used in structures only: with `*.constant_head` it is not identified.

Noise: white, of unknown size. Sizes are prior standard deviations for a first calibration, ours if no source is
named; replace them by data-sheet values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import bayescal as bc
from bayescal import xp
from bayescal_models import catalogue
from bayescal_models.catalogue import MINUTE, SIGNS, EffectTable, Maker, effect, one
from bayescal_models.quartz_beam_accelerometer import COLUMNS, NOMINAL_SCALE, PER_G
from bayescal_models.quartz_beam_accelerometer.campaign import Campaign
from bayescal_models.quartz_beam_accelerometer.simulator import simulated_columns
from bayescal_models.simulated import ReferenceProblem, experiments, readings_of

FREQUENCY_SUM = 80_000.0  # Hz at 15 °C, nominal; ours
FREQUENCY_TEMPCO = -1.6  # Hz/°C, nominal; ours: turns the sum into an apparent temperature
SLIP = 1.0  # °C, half width of the backlash


def _response(slots, r):
    a = r["acceleration"]
    return slots["bias"] + (1 + slots["scale"]) * a + slots["second_order"] * (PER_G * a) ** 2


# Bases: t1 − T0, t2 − T0, their difference, the temperature indicated by the beams, °C; and backlash of a joint.


def circuit(r: bc.Frame) -> Any:
    """Return t1 − T0, °C."""
    return r["temperature_circuit"] - r.reference["temperature_head_0"]


def head(r: bc.Frame) -> Any:
    """Return t2 − T0, °C."""
    return r.centred("temperature_head")


def gradient(r: bc.Frame) -> Any:
    """Return δt = t1 − t2, °C."""
    return r["temperature_circuit"] - r["temperature_head"]


def _indicated(r: bc.Frame) -> Any:
    """Return the temperature indicated by the frequency sum, °C from nominal."""
    return (r["frequency_sum"] - FREQUENCY_SUM) / FREQUENCY_TEMPCO


def _power(of: Callable[[bc.Frame], Any], order: int, r: bc.Frame) -> Any:
    return of(r) ** order


def _slope(column: str, r: bc.Frame) -> Any:
    return r.rate(column)


def _times_rate(of: Callable[[bc.Frame], Any], column: str, r: bc.Frame) -> Any:
    return of(r) * r.rate(column)


def _times_gradient(of: Callable[[bc.Frame], Any], r: bc.Frame) -> Any:
    return of(r) * gradient(r)


def _slipped(r: bc.Frame) -> Any:
    """Return the backlash (play) operator (t2 − seat)/width, −1 … 1, reset in each run."""
    temperature = r["temperature_head"][r.order]
    begins = r.step < 0

    def advance(seat, row):
        now, begin = row
        seat = xp.where(begin, now, xp.clip(seat, now - SLIP, now + SLIP))
        return seat, (now - seat) / SLIP

    return xp.placed(r.order, xp.scan(advance, temperature[0], (temperature, begins)))


# Families of this instrument.

POWERS = ("", "linear", "quadratic", "cubic", "quartic", "")
T1, T2 = BOTH = ("temperature_circuit", "temperature_head")
BySlot = dict[str, Maker]


def _either(basis: Callable[..., Any], equation: str, *columns: str, **fields: Any) -> BySlot:
    """Return the factories of an effect on the bias and on the scale factor, which needs an acceleration."""
    needed = {"bias": columns, "scale": (*columns, "acceleration")}
    return {s: effect(basis, equation, *n, **{"along": "", **fields}) for s, n in needed.items()}


def _t1(n: int) -> BySlot:
    return _either(
        partial(_power, circuit, n), f"c·(t1 − T0){SIGNS[n - 1]}", *BOTH, along=T1, kind=POWERS[n]
    )


def _t2(n: int) -> BySlot:
    return _either(
        partial(_power, head, n), f"c·(t2 − T0){SIGNS[n - 1]}", T2, along=T2, kind=POWERS[n]
    )


def _difference(n: int) -> BySlot:
    kind = POWERS[n] if n > 1 else ""  # its first column is no gradient
    return _either(partial(_power, gradient, n), f"c·(t1 − t2){SIGNS[n - 1]}", *BOTH, kind=kind)


def _of_sum(n: int) -> BySlot:
    nominal = f"F0 = {FREQUENCY_SUM:g} Hz, F' = {FREQUENCY_TEMPCO:g} Hz/°C"
    equation = f"c·((F − F0)/F'){SIGNS[n - 1]},  {nominal}"
    return _either(
        partial(_power, _indicated, n), equation, "frequency_sum", along=None, kind=POWERS[n]
    )


def _rate(column: str, sign: str) -> BySlot:
    basis, along = partial(_slope, column), f"{column} rate"
    return _either(basis, f"c·d{sign}/dt", "time", column, along=along, kind="rate")


def _by_rate(of: Callable[[bc.Frame], Any], column: str, sign: str) -> BySlot:
    basis = partial(_times_rate, of, column)
    return _either(basis, f"c·({sign} − T0)·d{sign}/dt", "time", *BOTH)


def _by_gradient(of: Callable[[bc.Frame], Any], sign: str) -> BySlot:
    return _either(partial(_times_gradient, of), f"c·({sign} − T0)·(t1 − t2)", *BOTH)


def _lagging(start: float, unit: str, **fields: Any) -> Maker:
    return catalogue.thermal_lag(MINUTE, 60 * MINUTE, start, unit, column=T2, **fields)


CONSTANT = _either(one, "c", along=None)
SLIPPING = _either(
    _slipped,
    f"c·(t2 − s)/w,  s dragged along within ±w = {SLIP:g} °C: the direction of the last change",
    *("time", T2),
    untestable=partial(catalogue.goes_one_way, T2, SLIP),
    along=None,
    kind="hysteresis",
)

# Rows of both slots: cause, family, size for the bias, µg, divisor of its unit, and the source if another. The sizes of
# the scale factor are a tenth, ppm, except the constants.
SHARE, OURS = 0.1, "ours"
CONSTANTS = {"bias": 20_000.0, "scale": 5000.0}  # µg, ppm
# The body of the head is common to both slots, and a form of the bias's lag.
LAGGING = {"bias": _lagging(20.0, "ug"), "scale": _lagging(20.0 * SHARE, "ppm", bodies={})}
OF_CIRCUIT = (
    ("temperature_circuit", _t1(1), 50.0, "/degC"),
    ("temperature_circuit_quadratic", _t1(2), 0.5, "/degC^2"),
    ("temperature_circuit_cubic", _t1(3), 0.005, "/degC^3"),
    ("temperature_circuit_quartic", _t1(4), 5e-5, "/degC^4"),
    ("temperature_circuit_quintic", _t1(5), 5e-7, "/degC^5"),
)
OF_HEAD = (
    ("temperature_head", _t2(1), 50.0, "/degC"),
    ("temperature_head_quadratic", _t2(2), 0.5, "/degC^2"),
    ("temperature_head_cubic", _t2(3), 0.005, "/degC^3"),
)
BETWEEN = (
    ("gradient", _difference(1), 20.0, "/degC"),
    ("gradient_quadratic", _difference(2), 1.0, "/degC^2"),
    ("gradient_cubic", _difference(3), 0.1, "/degC^3"),
    ("rate_circuit", _rate(T1, "t1"), 10.0, "/(degC/min)"),
    ("rate_head", _rate(T2, "t2"), 10.0, "/(degC/min)"),
)
PRODUCTS = (
    ("temperature_x_rate", _by_rate(head, T2, "t2"), 0.2, "/degC/(degC/min)"),
    ("temperature_x_gradient", _by_gradient(head, "t2"), 0.5, "/degC^2"),
)
PRODUCTS_OF_CIRCUIT = (  # the document does not say which thermometer t is
    ("temperature_x_rate_circuit", _by_rate(circuit, T1, "t1"), 0.2, "/degC/(degC/min)"),
    ("temperature_x_gradient_circuit", _by_gradient(circuit, "t1"), 0.5, "/degC^2"),
)
OTHERS = (
    ("thermal_lag", LAGGING, 20.0, "/degC", OURS),
    ("hysteresis", SLIPPING, 20.0, "", OURS),
    ("warm_up", catalogue.warm_up(2 * MINUTE, 60 * MINUTE), 50.0, "", OURS),
    ("drift", catalogue.drift, 10.0, "", OURS),
    ("run", catalogue.deviation, 20.0, "", OURS),
    ("cell", catalogue.deviation, 5.0, "", OURS),
)
OF_SUM = (
    ("frequency_sum", _of_sum(1), 50.0, "/degC"),
    ("frequency_sum_quadratic", _of_sum(2), 0.5, "/degC^2"),
    ("frequency_sum_cubic", _of_sum(3), 0.005, "/degC^3"),
)
K2 = effect(one, "K2·a²", "acceleration")


def _both(*rows: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    for slot, unit, share in (("bias", "ug", 1.0), ("scale", "ppm", SHARE)):
        for cause, maker, size, per, *source in rows:
            slot_size = size[slot] if isinstance(size, dict) else size * share
            of_slot = maker[slot] if isinstance(maker, dict) else maker
            yield f"{slot}.{cause}", of_slot, slot_size, unit + per, *source


EFFECTS = EffectTable.of(
    "source 2; size ours",
    baseline=_both(("constant_head", CONSTANT, CONSTANTS, ""), *OF_HEAD),
    candidates=(
        *_both(*OF_CIRCUIT[:3], *BETWEEN, *PRODUCTS, *OTHERS),
        ("second_order", K2, 10.0, "ug/g^2", "IEEE Std 1293; size ours"),
        # The document's products with a rate and a gradient are a lag that grows with temperature.
        *catalogue.recorded(
            *("bias", "ug"),
            size=400.0,
            span=50.0,
            pace=1.0,
            column=T2,
            causes=("supply", "temperature_x_supply"),
        ),
    ),
    others=_both(
        ("constant_circuit", CONSTANT, CONSTANTS, ""),
        *(*OF_CIRCUIT[3:], *PRODUCTS_OF_CIRCUIT, *OF_SUM),
    ),
)


# Named models: the document's own, and its three prior methods.


def _model(*causes: Any, base: bc.Model | None = None) -> bc.Model:
    """Build a model of these causes or rows, for bias and scale factor, added to a base model."""
    names = [cause if isinstance(cause, str) else cause[0] for cause in causes]
    model = base or bc.Model(INSTRUMENT, (), INSTRUMENT.noise)
    for slot in ("bias", "scale"):
        model = model + tuple(EFFECTS[f"{slot}.{name}"] for name in names)
    return model


def of_circuit(order: int) -> bc.Model:
    """Return bias and scale factor as polynomials of t1: the document's first prior method."""
    return _model("constant_circuit", *OF_CIRCUIT[:order])


def with_rate() -> bc.Model:
    """Return a cubic of t1, its rate and their product: the document's second prior method."""
    return _model("rate_circuit", "temperature_x_rate_circuit", base=of_circuit(3))


def of_frequency_sum(order: int = 3) -> bc.Model:
    """Return polynomials of the temperature indicated by the frequency sum: the document's third prior method."""
    return _model("constant_head", *OF_SUM[:order])


def two_thermometers(crossed_by: str = "head") -> bc.Model:
    """Return the document's model, 15 columns each for bias and scale factor, in its order; rank 12 in total.

    Args:
        crossed_by: which thermometer is t in t·dt/dt and t·δt, "head" or "circuit".
    """
    products = PRODUCTS if crossed_by == "head" else PRODUCTS_OF_CIRCUIT
    of_circuit_alone = ("constant_circuit", *OF_CIRCUIT[:3])
    return _model(*of_circuit_alone, "constant_head", *OF_HEAD, *BETWEEN, *products)


INSTRUMENT = bc.Instrument(
    name="quartz_beam_accelerometer",
    title="quartz resonant beam accelerometer with two thermometers",
    columns=COLUMNS,
    slots=(
        bc.Slot("bias", "ug", "output at zero input"),
        bc.Slot("scale", "1", "relative deviation of the scale factor from nominal"),
        bc.Slot("second_order", "ug/g^2", "K2"),
    ),
    response=_response,
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
    simulator=simulated_columns,
    experiments=experiments(
        simulated_columns,
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
simulate = readings_of(INSTRUMENT)
# Two tumbles over five temperatures and a ramp at each of three attitudes, a reading every ten minutes.
reference_problem = ReferenceProblem(
    INSTRUMENT,
    Campaign(temperatures=(-40.0, -10.0, 20.0, 45.0, 70.0), interval=600.0, soak=3600.0),
    Campaign(),
)
