"""Polynomials in T − T0, or in any other column relative to its reference value."""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

from bayescal._model.effect import Coefficient, Effect, Kind
from bayescal._model.frame import Frame, name_reference
from bayescal._model.prior import Normal


class PowerFactory(Protocol):  # signature of `linear` to `quartic`
    def __call__(
        self,
        slot: str,
        size: float,
        unit: str,
        *,
        source: str,
        column: str = "temperature",
        name: str | None = None,
    ) -> Effect: ...


def _evaluate_power(column: str, order: int, frame: Frame) -> Any:
    return frame.centred(column) ** order


def _make_factory(kind: Kind, order: int, description: str) -> PowerFactory:
    suffix, exponent = ("", "") if order == 1 else (f"_{kind}", "²³⁴"[order - 2])
    divisor = "degC" if order == 1 else f"degC^{order}"

    def make_effect(slot, size, unit, *, source, column="temperature", name=None):
        variable = "T − T0" if column == "temperature" else f"{column} − {name_reference(column)}"
        return Effect(
            f"{slot}.{name or column}{suffix}",
            slot,
            basis=partial(_evaluate_power, column, order),
            coefficients=(Coefficient(unit, Normal(0.0, size)),),
            columns=(column,),
            varies=(column,),
            equation=f"c·({variable}){exponent}",
            source=source,
            kind=kind,
        )

    make_effect.__name__ = make_effect.__qualname__ = kind
    make_effect.__doc__ = f"""Return the effect c·(T − T0){exponent}: {description}.

    Args:
        slot: slot that the effect adds to, such as "bias".
        size: prior standard deviation of c, in `unit`: how large it plausibly is.
        unit: unit of c, such as "deg/s/{divisor}" or "ppm/{divisor}": the slot's unit divided by that power
            of the column's unit.
        source: source of the size: a document, or the person who estimated it.
        column: the temperature, °C, or another numeric column in its own unit, such as "pressure". The reference value
            is the rounded mean of the temperature in the fit, or the middle of the other column's range; it is printed
            and stored with the result.
        name: name of the effect after the slot, `slot.name{suffix}`; the column's name if not given.

    Source: a truncated Taylor series about T0; assumes only that the output is smooth in T.
    """
    return make_effect


linear: PowerFactory = _make_factory("linear", 1, "a straight line (temperature coefficient)")
quadratic: PowerFactory = _make_factory("quadratic", 2, "curvature, symmetric about T0")
cubic: PowerFactory = _make_factory("cubic", 3, "curvature, antisymmetric about T0")
quartic: PowerFactory = _make_factory("quartic", 4, "curvature that grows towards both ends")
