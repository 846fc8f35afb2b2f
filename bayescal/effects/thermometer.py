"""Errors in variables: the true temperature of each reading is unknown, as its thermometer is noisy, off or late."""

from __future__ import annotations

from functools import partial
from typing import Any

from bayescal._model.effect import Coefficient, Effect
from bayescal._model.frame import Frame
from bayescal._model.prior import HalfNormal, Normal
from bayescal.effects.constant import one


def _rate(column: str, r: Frame) -> Any:
    return r.rates[column]


def thermometer(sd: float, *, source: str, column: str = "temperature") -> Effect:
    """One thermometer error per reading, of known standard deviation `sd`, °C.

    It corrects the column before any other effect sees it. (An error shared by all readings would be part of
    the bias constant, and is left there.)
    """
    return Effect(
        f"{column}.reading",
        column,
        basis=one,
        coefficients=(Coefficient("delta_degC", Normal(0.0, sd), per="reading"),),
        columns=(column,),
        equation="T_true = T + e,  e ~ N(0, s²)",
        source=source,
    )


def thermometer_offset(
    size: float, *, source: str, column: str = "temperature", per: str = "run"
) -> Effect:
    """The thermometer's constant error in each run, of unknown spread, °C: it was re-seated, or exchanged.

    It corrects the column before any other effect sees it. Where the output is a line of the temperature, that is a
    deviation of the bias in each run, `deviation("bias", "run")`; a curve or a second slot tells them apart.

    Args:
        size: scale of the half-normal prior of the spread between the groups, °C.
        per: group whose members have an error each.
    """
    return Effect(
        f"{column}.{per}",
        column,
        basis=one,
        coefficients=(
            Coefficient("delta_degC", Normal(0.0, size), per=per, group_sd=HalfNormal(size)),
        ),
        columns=(column,),
        equation=f"T_true = T + e[{per}]",
        source=source,
    )


def thermometer_delay(sd: float, *, source: str, column: str = "temperature") -> Effect:
    """A thermometer that is late, s: one of first order that follows with τ, or a column written τ later.

    The first is exact, τ·dT/dt = T_true − T; the second holds while the temperature changes evenly over τ. It corrects
    the column before any other effect sees it. Where the output is a line of the temperature, that is `rate`, with the
    coefficient slope × τ; a curve or a second slot tells them apart.

    The rate is the slope over the last minute, itself half a minute late: of a delay below a minute the size is known
    to that.

    Args:
        sd: prior standard deviation of τ, s.
    """
    return Effect(
        f"{column}.delay",
        column,
        basis=partial(_rate, column),
        coefficients=(Coefficient("s", Normal(0.0, sd)),),
        columns=("time", column),
        varies=(column,),
        equation="T_true = T + τ·dT/dt",
        source=source,
    )
