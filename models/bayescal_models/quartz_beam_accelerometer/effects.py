"""The effects of a quartz beam accelerometer, each for bias and for scale factor.

Temperatures of both thermometers are taken about *one* T0, that of the head (`temperature_head_0`, stored with the
calibration): only so is the gradient δt = t1 − t2 exactly the difference of the two columns, and the document's
null combinations are exact as printed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial  # equal models then share one compiled program
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import bayescal as bc
from bayescal import effects
from bayescal_models.quartz_beam_accelerometer.laws import SECOND_ORDER, SHARE, UNIT, size
from bayescal_models.terms import one, term

SLOTS = ("bias", "scale")
SOURCE = "source 2; size ours"
OURS = "ours"
MINUTE = 60.0
THERMOMETERS = ("temperature_circuit", "temperature_head")
FREQUENCY_SUM = 80_000.0  # Hz at 15 °C, nominal; ours
FREQUENCY_TEMPCO = -1.6  # Hz/°C, nominal; ours
SLIP = 1.0  # °C, width of the play
SEEN = 0.02  # share of the readings that a direction must have to count as one


def circuit(r: bc.Frame) -> Any:
    """t1 − T0, °C."""
    return r["temperature_circuit"] - r.reference["temperature_head_0"]


def head(r: bc.Frame) -> Any:
    """t2 − T0, °C."""
    return r.centred("temperature_head")


def gradient(r: bc.Frame) -> Any:
    """δt = t1 − t2, °C."""
    return r["temperature_circuit"] - r["temperature_head"]


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


def _slipped(r: bc.Frame) -> Any:
    """(t2 − seat)/width, the seat dragged along within ±width, anew in each run: from −1 to 1."""
    here = r["temperature_head"][r.order]
    begins = r.step < 0

    def advance(seat, row):
        now, begin = row
        seat = jnp.where(begin, now, jnp.clip(seat, now - SLIP, now + SLIP))
        return seat, (now - seat) / SLIP

    _, strain = jax.lax.scan(advance, here[0], (here, begins))
    return jnp.zeros_like(strain).at[r.order].set(strain)


def _one_way(readings: bc.Measurements) -> str | None:
    """Why readings cannot show hysteresis: the head's temperature goes one way only."""
    _, run = readings.groups("run")
    rises = falls = 0
    for k in np.unique(run):
        chosen = np.flatnonzero(run == k)
        order = chosen[np.argsort(readings["time"][chosen], kind="stable")]
        change = np.diff(readings["temperature_head"][order])
        rises, falls = rises + (change > 0.05).sum(), falls + (change < -0.05).sum()
    if min(rises, falls) >= SEEN * len(readings):
        return None
    return "needs temperature_head to rise and to fall within runs; it goes one way only"


POWERS = ("", "_quadratic", "_cubic", "_quartic", "_quintic")
SIGNS = ("", "²", "³", "⁴", "⁵")


def _effect(
    slot: str,
    cause: str,
    basis: Callable[..., Any],
    columns: tuple[str, ...],
    equation: str,
    *,
    like: str = "",
    **more: Any,
) -> bc.Effect:
    """An effect of the plausible size of `like`, another cause, or of its own."""
    needed = (*columns, "acceleration") if slot == "scale" else columns
    return term(
        f"{slot}.{cause}",
        basis,
        *size(slot, like or cause),
        columns=needed,
        equation=equation,
        **{"source": SOURCE, "along": "", **more},
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
    return tuple(
        _effect(
            slot,
            of + POWERS[n - 1],
            partial(_power, quantity, n),
            columns,
            f"c·{sign}{SIGNS[n - 1]}",
            along=of if of in THERMOMETERS else "",
        )
        for n in orders
    )


@cache
def constant(slot: str, where: str) -> bc.Effect:
    """The document's zero-order coefficient of a thermometer: `*.constant_circuit` or `*.constant_head`."""
    return _effect(slot, f"constant_{where}", one, (), "c", like="constant", along=None)


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
            along=f"temperature_{name} rate",
        )
        for name, sign in (("circuit", "t1"), ("head", "t2"))
    )


@cache
def crossed(slot: str, by: str = "head") -> tuple[bc.Effect, ...]:
    """`*.temperature_x_rate` and `*.temperature_x_gradient`, t·dt/dt and t·δt, of the head or the circuit.

    The document leaves open which thermometer t is; those of the circuit carry `_circuit` in their names.
    """
    of, sign = (head, "t2") if by == "head" else (circuit, "t1")
    bases = {
        "rate": (partial(_times_rate, of, f"temperature_{by}"), ("time",), f"d{sign}/dt"),
        "gradient": (partial(_times_gradient, of), (), "(t1 − t2)"),
    }
    suffix = "" if by == "head" else "_circuit"
    return tuple(
        _effect(
            slot,
            f"temperature_x_{name}{suffix}",
            basis,
            (*time, *THERMOMETERS),
            f"c·({sign} − T0)·{factor}",
            like=f"temperature_x_{name}",
        )
        for name, (basis, time, factor) in bases.items()
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
    return tuple(
        _effect(
            slot,
            f"frequency_sum{POWERS[n - 1]}",
            partial(_power, shown, n),
            ("frequency_sum",),
            f"c·((F − F0)/F'){SIGNS[n - 1]},  F0 = {nominal:g} Hz, F' = {tempco:g} Hz/°C",
            like=f"temperature_head{POWERS[n - 1]}",
            along=None,
        )
        for n in orders
    )


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
            # the body of the head is one for both slots, and a form of the bias's lag
            bodies=None if slot == "bias" else {},
        ),
        _effect(
            slot,
            "hysteresis",
            _slipped,
            ("time", "temperature_head"),
            f"c·(t2 − s)/w,  s dragged along within ±w = {SLIP:g} °C: the direction of the last change",
            untestable=_one_way,
            source=OURS,
            along=None,
        ),
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
K2 = term(
    "second_order",
    one,
    SECOND_ORDER,
    "ug/g^2",
    columns=("acceleration",),
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
