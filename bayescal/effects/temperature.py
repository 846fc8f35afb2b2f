"""Polynomials in T − T0."""

from __future__ import annotations

from functools import partial
from typing import Any

from bayescal._model.effect import Coefficient, Effect
from bayescal._model.frame import Frame
from bayescal._model.prior import Normal

_POWERS = {1: ("", ""), 2: ("_quadratic", "²"), 3: ("_cubic", "³"), 4: ("_quartic", "⁴")}


def _powered(column: str, order: int, r: Frame) -> Any:
    return r.centred(column) ** order


def _power(
    slot: str, order: int, column: str, size: float, unit: str, name: str, source: str
) -> Effect:
    suffix, sign = _POWERS[order]
    return Effect(
        f"{slot}.{name}{suffix}",
        slot,
        basis=partial(_powered, column, order),
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
    """c·(T − T0): a straight line in a temperature, in practice the tempco.

    Args:
        slot: that it adds to, such as "bias".
        size: prior standard deviation of c, in `unit`: how large it plausibly is.
        unit: of c, such as "deg/s/degC" or "ppm/degC"; of the dimension of the slot's unit over a temperature.
        source: where the size comes from: a document, or whose estimate it is.
        column: the temperature T, °C; T0 is its rounded mean in the fit, printed and stored with the result.
        name: of the effect, after the slot: `slot.name`.

    Source: a truncated Taylor series about T0; no physics beyond that the output is smooth in T.
    """
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
    """c·(T − T0)²: curvature, symmetric about T0.

    Arguments and source as of `linear`; the unit of c is over a squared temperature, such as "deg/s/degC^2", and the
    name is `slot.name_quadratic`.
    """
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
    """c·(T − T0)³: curvature, antisymmetric about T0.

    Arguments and source as of `linear`; the unit of c is over a cubed temperature, such as "deg/s/degC^3", and the
    name is `slot.name_cubic`.
    """
    return _power(slot, 3, column, size, unit, name, source)


def quartic(
    slot: str,
    size: float,
    unit: str,
    *,
    source: str,
    column: str = "temperature",
    name: str = "temperature",
) -> Effect:
    """c·(T − T0)⁴: curvature that grows towards both ends.

    Arguments and source as of `linear`; the unit of c is over the fourth power of a temperature, such as
    "deg/s/degC^4", and the name is `slot.name_quartic`.
    """
    return _power(slot, 4, column, size, unit, name, source)
