"""Errors in variables: the true input of each reading is unknown; of a thermometer that it is noisy, off or late."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from bayescal._model.effect import Coefficient, Effect
from bayescal._model.frame import Frame
from bayescal._model.prior import Normal
from bayescal.effects.constant import deviation, one


def _rate(column: str, r: Frame) -> Any:
    return r.rate(column)


def _column(name: str, r: Frame) -> Any:
    return r[name]


def uncertain_input(column: str, sd: float | str, unit: str = "1", *, source: str) -> Effect:
    """Correct a column by an independent error of each reading, of known standard deviation.

    The column is corrected before any other effect sees it: the variance of each reading grows by the square of the
    output's slope by the column times `sd`. (An error shared by all readings would be part of a constant or a scale
    factor, and is left there.)

    Args:
        column: numeric, such as "pressure".
        sd: standard deviation, in `unit`; or the name of a column that holds that of each reading.
        unit: of `sd`, "delta_degC" for a temperature; of a column of standard deviations leave it out.
        source: where the standard deviation comes from.

    Source: JCGM 100:2008, 5.1.2; of a straight line ISO/TS 28037:2010, 7.
    """
    named = isinstance(sd, str)
    return Effect(
        f"{column}.reading",
        column,
        basis=partial(_column, sd) if named else one,
        coefficients=(Coefficient(unit, Normal(0.0, 1.0 if named else sd), per="reading"),),
        columns=(column, sd) if named else (column,),
        equation=f"{column}_true = {column} + e,  e ~ N(0, s²)",
        source=source,
    )


def thermometer(sd: float, *, source: str, column: str = "temperature") -> Effect:
    """Correct a temperature by an independent error of each reading, of known standard deviation `sd`, °C."""
    return uncertain_input(column, sd, "delta_degC", source=source)


def thermometer_offset(
    size: float,
    *,
    source: str,
    column: str = "temperature",
    per: str = "run",
    unit: str = "delta_degC",
) -> Effect:
    """Return the thermometer's constant error in each run, of unknown spread: it was re-seated, or exchanged.

    It corrects the column before any other effect sees it. Where the output is a line of the temperature, that is a
    deviation of the bias in each run, `deviation("bias", "run")`; a curve or a second slot tells them apart.

    Args:
        size: scale of the half-normal prior of the spread between the groups, in `unit`.
        column: that it corrects, of a thermometer or of another instrument.
        per: group whose members have an error each.
        unit: of the error, that of a difference of the column.
    """
    offset = deviation(column, per, size, unit, source=source)
    return replace(offset, columns=(column,), equation=f"T_true = T + e[{per}]")


def thermometer_delay(sd: float, *, source: str, column: str = "temperature") -> Effect:
    """Return a thermometer's delay, s: of first order with the time τ, or a column written τ later.

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
