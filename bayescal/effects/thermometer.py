"""Errors in variables: input columns with noise, an offset or a delay, such as a thermometer's."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from bayescal._model.effect import Coefficient, Effect
from bayescal._model.frame import Frame
from bayescal._model.prior import Normal
from bayescal.effects.constant import deviation, one


def _evaluate_rate(column: str, frame: Frame) -> Any:
    return frame.rate(column)


def _evaluate_column(column: str, frame: Frame) -> Any:
    return frame[column]


def uncertain_input(column: str, sd: float | str, unit: str = "1", *, source: str) -> Effect:
    """Return an effect that corrects a column by an independent error of each reading, of known standard deviation.

    The column is corrected before any other effect uses it: the variance of each output grows by
    (∂output/∂column)²·sd². An error common to all readings is part of a constant or a scale factor.

    Args:
        column: numeric column, such as "pressure".
        sd: standard deviation, in `unit`; or the name of a column of standard deviations.
        unit: unit of `sd`, "delta_degC" for a temperature; omit it for a column of standard deviations.
        source: source of the standard deviation.

    Source: JCGM 100:2008, 5.1.2; for a straight line, ISO/TS 28037:2010, 7.
    """
    is_column = isinstance(sd, str)
    return Effect(
        f"{column}.reading",
        column,
        basis=partial(_evaluate_column, sd) if is_column else one,
        coefficients=(Coefficient(unit, Normal(0.0, 1.0 if is_column else sd), per="reading"),),
        columns=(column, sd) if is_column else (column,),
        equation=f"{column}_true = {column} + e,  e ~ N(0, s²)",
        source=source,
    )


def thermometer(sd: float, *, source: str, column: str = "temperature") -> Effect:
    """Return an effect that corrects a temperature by independent errors of known standard deviation `sd`, °C."""
    return uncertain_input(column, sd, "delta_degC", source=source)


def thermometer_offset(
    size: float,
    *,
    source: str,
    column: str = "temperature",
    per: str = "run",
    unit: str = "delta_degC",
) -> Effect:
    """Return an effect of a thermometer's offset, one per run (it is re-seated); their standard deviation is estimated.

    It corrects the column before any other effect uses it. If the output is linear in temperature it is collinear with
    a deviation of the bias per run, `deviation("bias", "run")`; a nonlinearity or a second slot identifies both.

    Args:
        size: scale of the half-normal prior of the offsets' standard deviation, in `unit`.
        column: corrected column, of a thermometer or another instrument.
        per: group with one offset per member.
        unit: unit of the offset, that of a difference of the column.
    """
    offset = deviation(column, per, size, unit, source=source)
    return replace(offset, columns=(column,), equation=f"T_true = T + e[{per}]")


def thermometer_delay(sd: float, *, source: str, column: str = "temperature") -> Effect:
    """Return an effect of a thermometer's delay τ, s: a first-order response, or readings recorded τ late.

    The correction τ·dT/dt = T_true − T is exact for a first-order response; for late readings it holds while dT/dt is
    constant over τ. It corrects the column before any other effect uses it. If the output is linear in temperature it
    is collinear with `rate`; a nonlinearity or a second slot identifies both. dT/dt is a slope over the last minute: τ
    is biased by up to half a minute.

    Args:
        sd: prior standard deviation of τ, s.
    """
    return Effect(
        f"{column}.delay",
        column,
        basis=partial(_evaluate_rate, column),
        coefficients=(Coefficient("s", Normal(0.0, sd)),),
        columns=("time", column),
        varies=(column,),
        equation="T_true = T + τ·dT/dt",
        source=source,
    )
