"""The effects of a quartz beam accelerometer, each for bias and for scale factor.

Temperatures of both thermometers are taken about *one* T0, that of the head (`temperature_head_0`, stored with the
calibration): only so is the gradient δt = t1 − t2 exactly the difference of the two columns, and the document's
null combinations are exact as printed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial  # equal models then share one compiled program
from typing import Any

import bayescal as bc
from bayescal import effects
from bayescal_models.quartz_beam_accelerometer.hysteresis import hysteresis
from bayescal_models.quartz_beam_accelerometer.laws import SECOND_ORDER, SHARE, UNIT, size

SLOTS = ("bias", "scale")
SOURCE = "source 2; size ours"
OURS = "ours"
CONSTANT = {"bias": 20_000.0, "scale": 5000.0}  # µg, ppm
MINUTE = 60.0
THERMOMETERS = ("temperature_circuit", "temperature_head")
FREQUENCY_SUM = 80_000.0  # Hz at 15 °C, nominal; ours
FREQUENCY_TEMPCO = -1.6  # Hz/°C, nominal; ours


def circuit(r: bc.Frame) -> Any:
    """t1 − T0, °C."""
    return r["temperature_circuit"] - r.reference["temperature_head_0"]


def head(r: bc.Frame) -> Any:
    """t2 − T0, °C."""
    return r.centred("temperature_head")


def gradient(r: bc.Frame) -> Any:
    """δt = t1 − t2, °C."""
    return r["temperature_circuit"] - r["temperature_head"]


def _one(r: bc.Frame) -> float:
    return 1.0


def _power(of: Callable[[bc.Frame], Any], order: int, r: bc.Frame) -> Any:
    return of(r) ** order


def _rate(column: str, r: bc.Frame) -> Any:
    return r.rate(column)


def _times_rate(of: Callable[[bc.Frame], Any], column: str, r: bc.Frame) -> Any:
    return of(r) * r.rate(column)


def _times_gradient(of: Callable[[bc.Frame], Any], r: bc.Frame) -> Any:
    return of(r) * gradient(r)


def _shown(nominal: float, tempco: float, r: bc.Frame) -> Any:
    """The temperature that the frequency sum shows, °C from where it is nominal."""
    return (r["frequency_sum"] - nominal) / tempco


POWERS = ("", "_quadratic", "_cubic", "_quartic", "_quintic")
SIGNS = ("", "²", "³", "⁴", "⁵")


def _effect(
    slot: str,
    cause: str,
    basis: Callable[..., Any],
    columns: tuple[str, ...],
    equation: str,
    along: str = "",
) -> bc.Effect:
    value, unit = size(slot, cause)
    needed = (*columns, "acceleration") if slot == "scale" else columns
    return bc.Effect(
        f"{slot}.{cause}",
        slot,
        basis=basis,
        coefficients=(bc.Coefficient(unit, bc.Normal(0.0, value)),),
        columns=needed,
        varies=tuple(c for c in needed if c != "time"),
        equation=equation,
        source=SOURCE,
        along=along,
    )


@cache
def polynomial(slot: str, of: str, orders: range) -> tuple[bc.Effect, ...]:
    """Powers of t1 ("temperature_circuit"), t2 ("temperature_head") or δt ("gradient").

    Args:
        slot: "bias" or "scale".
        of: which of the three.
        orders: of the powers, 1 to 5 (t1) or 1 to 3.
    """
    quantity, columns, sign = {
        "temperature_circuit": (circuit, THERMOMETERS, "(t1 − T0)"),
        "temperature_head": (head, ("temperature_head",), "(t2 − T0)"),
        "gradient": (gradient, THERMOMETERS, "(t1 − t2)"),
    }[of]
    along = of if of in THERMOMETERS else ""
    return tuple(
        _effect(
            slot,
            of + POWERS[n - 1],
            partial(_power, quantity, n),
            columns,
            f"c·{sign}{SIGNS[n - 1]}",
            along,
        )
        for n in orders
    )


@cache
def constant(slot: str, where: str) -> bc.Effect:
    """The document's zero-order coefficient of a thermometer: `*.constant_circuit` or `*.constant_head`."""
    return bc.Effect(
        f"{slot}.constant_{where}",
        slot,
        basis=_one,
        coefficients=(bc.Coefficient(UNIT[slot], bc.Normal(0.0, CONSTANT[slot])),),
        columns=("acceleration",) if slot == "scale" else (),
        varies=("acceleration",) if slot == "scale" else (),
        equation="c",
        source=SOURCE,
    )


@cache
def rates(slot: str) -> tuple[bc.Effect, ...]:
    """`*.rate_circuit` and `*.rate_head`: c·dt1/dt, c·dt2/dt (causal slope of the last minute)."""
    return tuple(
        _effect(
            slot,
            f"rate_{name}",
            partial(_rate, f"temperature_{name}"),
            ("time", f"temperature_{name}"),
            f"c·d{sign}/dt",
            f"temperature_{name} rate",
        )
        for name, sign in (("circuit", "t1"), ("head", "t2"))
    )


@cache
def crossed(slot: str, by: str = "head") -> tuple[bc.Effect, ...]:
    """`*.temperature_x_rate` and `*.temperature_x_gradient`, t·dt/dt and t·δt, of the head or the circuit.

    The document leaves open which thermometer t is; those of the circuit carry `_circuit` in their names.
    """
    of, sign, column = (
        (head, "t2", THERMOMETERS[1]) if by == "head" else (circuit, "t1", THERMOMETERS[0])
    )
    made = (
        _effect(
            slot,
            "temperature_x_rate",
            partial(_times_rate, of, column),
            ("time", *THERMOMETERS),
            f"c·({sign} − T0)·d{sign}/dt",
        ),
        _effect(
            slot,
            "temperature_x_gradient",
            partial(_times_gradient, of),
            THERMOMETERS,
            f"c·({sign} − T0)·(t1 − t2)",
        ),
    )
    return made if by == "head" else tuple(_renamed(e, f"{e.name}_circuit") for e in made)


def _renamed(effect: bc.Effect, name: str) -> bc.Effect:
    return bc.Effect(
        name,
        effect.slot,
        basis=effect.basis,
        coefficients=effect.coefficients,
        columns=effect.columns,
        varies=effect.varies,
        equation=effect.equation,
        source=effect.source,
    )


def two_thermometers(slot: str, crossed_by: str = "head") -> tuple[bc.Effect, ...]:
    """The document's 15 columns, in its order; together of rank 12."""
    return (
        constant(slot, "circuit"),
        *polynomial(slot, "temperature_circuit", range(1, 4)),
        constant(slot, "head"),
        *polynomial(slot, "temperature_head", range(1, 4)),
        *polynomial(slot, "gradient", range(1, 4)),
        *rates(slot),
        *crossed(slot, crossed_by),
    )


@cache
def frequency_sum(
    slot: str, orders: range, nominal: float = FREQUENCY_SUM, tempco: float = FREQUENCY_TEMPCO
) -> tuple[bc.Effect, ...]:
    """Powers of the temperature that the sum of both beams' frequencies shows (source 2's third prior method).

    Args:
        slot: "bias" or "scale".
        orders: of the powers, 1 to 3.
        nominal: sum near the middle of the range, Hz.
        tempco: of the sum, Hz/°C; turns it into an apparent temperature, so that sizes keep their meaning.
    """
    shown = partial(_shown, nominal, tempco)
    made = []
    for n in orders:
        like = _effect(
            slot,
            "temperature_head" + POWERS[n - 1],
            partial(_power, shown, n),
            ("frequency_sum",),
            f"c·((F − F0)/F'){SIGNS[n - 1]},  F0 = {nominal:g} Hz, F' = {tempco:g} Hz/°C",
        )
        made.append(_renamed(like, f"{slot}.frequency_sum{POWERS[n - 1]}"))
    return tuple(made)


@cache
def temporal(slot: str) -> tuple[bc.Effect, ...]:
    """Lag, hysteresis, warm-up, drift, and deviations of runs and cells."""
    unit = UNIT[slot]
    return (
        effects.thermal_lag(
            slot,
            *size(slot, "thermal_lag"),
            low=MINUTE,
            high=60 * MINUTE,
            start=20.0 * SHARE[slot],
            start_unit=unit,
            source=OURS,
            column="temperature_head",
        ),
        hysteresis(slot),
        effects.warm_up(
            slot, *size(slot, "warm_up"), low=2 * MINUTE, high=60 * MINUTE, source=OURS
        ),
        effects.drift(slot, *size(slot, "drift"), source=OURS),
        effects.deviation(slot, "run", *size(slot, "run"), source=OURS),
        effects.deviation(slot, "cell", *size(slot, "cell"), source=OURS),
    )


BASELINE = tuple(
    effect
    for slot in SLOTS
    for effect in (
        constant(slot, "head"),
        *polynomial(slot, "temperature_head", range(1, 4)),
    )
)
K2 = bc.Effect(
    "second_order",
    "second_order",
    basis=_one,
    coefficients=(bc.Coefficient("ug/g^2", bc.Normal(0.0, SECOND_ORDER)),),
    columns=("acceleration",),
    varies=("acceleration",),
    equation="K2·a²",
    source="IEEE Std 1293; size ours",
)
CANDIDATES = tuple(
    effect
    for slot in SLOTS
    for effect in (
        *polynomial(slot, "temperature_circuit", range(1, 4)),
        *polynomial(slot, "gradient", range(1, 4)),
        *rates(slot),
        *crossed(slot),
        *temporal(slot),
    )
) + (K2,)
