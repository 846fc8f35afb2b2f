"""Errors in variables: the true temperature of each reading is unknown."""

from __future__ import annotations

from bayescal._model.effect import Coefficient, Effect
from bayescal._model.frame import Frame
from bayescal._model.prior import Normal


def _one(r: Frame) -> float:
    return 1.0


def thermometer(sd: float, *, source: str, column: str = "temperature") -> Effect:
    """One thermometer error per reading, of known standard deviation `sd`, °C.

    It corrects the column before any other effect sees it. (An error shared by all readings would be part of
    the bias constant, and is left there.)
    """
    return Effect(
        f"{column}.reading",
        column,
        basis=_one,
        coefficients=(Coefficient("delta_degC", Normal(0.0, sd), per="reading"),),
        columns=(column,),
        equation="T_true = T + e,  e ~ N(0, s²)",
        source=source,
    )
