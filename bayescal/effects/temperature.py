"""Polynomials in T − T0."""

from __future__ import annotations

from bayescal._coefficient import Coefficient
from bayescal._effect import Effect
from bayescal._prior import Normal

_POWERS = {1: ("", ""), 2: ("_quadratic", "²"), 3: ("_cubic", "³")}


def _power(
    slot: str, order: int, column: str, size: float, unit: str, name: str, source: str
) -> Effect:
    suffix, sign = _POWERS[order]
    return Effect(
        f"{slot}.{name}{suffix}",
        slot,
        basis=lambda r: r.centred(column) ** order,
        coefficients=(Coefficient(unit, Normal(0.0, size)),),
        columns=(column,),
        varies=(column,),
        equation=f"c·(T − T0){sign}",
        source=source,
    )


def linear(
    slot: str,
    size: float,
    unit: str,
    *,
    source: str,
    column: str = "temperature",
    name: str = "temperature",
) -> Effect:
    return _power(slot, 1, column, size, unit, name, source)


def quadratic(
    slot: str,
    size: float,
    unit: str,
    *,
    source: str,
    column: str = "temperature",
    name: str = "temperature",
) -> Effect:
    return _power(slot, 2, column, size, unit, name, source)


def cubic(
    slot: str,
    size: float,
    unit: str,
    *,
    source: str,
    column: str = "temperature",
    name: str = "temperature",
) -> Effect:
    return _power(slot, 3, column, size, unit, name, source)
