"""Instrument for a channel at constant true input: one level per run, plus noise.

The levels have flat priors, so that the evidence of a noise law is its restricted likelihood.
Source: D. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood).
"""

from __future__ import annotations

from typing import Any

from bayescal._data.column import Column
from bayescal._model.effect import Coefficient, Effect
from bayescal._model.frame import Frame
from bayescal._model.instrument import Instrument, Slot, Slots
from bayescal._model.prior import Flat


def _evaluate_constant_basis(r: Frame) -> float:
    return 1.0


def _evaluate_constant_response(slots: Slots, r: Frame) -> Any:
    return slots["rest"]


LEVEL = Effect(
    "rest.level",
    "rest",
    basis=_evaluate_constant_basis,
    coefficients=(Coefficient("1", Flat(), per="run"),),
    columns=("run",),
    equation="c[run]",
    source="the instrument does not move",
)
CHANNEL = Instrument(
    name="channel_at_rest",
    title="a channel at rest, its output in whatever unit it has",
    columns=(
        Column("run", None),
        Column("time", "s"),
        Column("temperature", "degC", required=False),
        Column("output", "1"),
    ),
    slots=(Slot("rest", "1", "the output at rest"),),
    response=_evaluate_constant_response,
    effects=(LEVEL,),
)
