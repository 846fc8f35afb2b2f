"""Instrument whose output is noise alone, to fit noise laws to residuals."""

from __future__ import annotations

from typing import Any

from bayescal._data.column import Column
from bayescal._model.frame import Frame
from bayescal._model.instrument import Instrument, Slot, Slots


def _evaluate_constant_response(slots: Slots, frame: Frame) -> Any:
    return slots["rest"]


CHANNEL = Instrument(
    name="channel_at_rest",
    title="a channel at rest, whose output may have any unit",
    columns=(Column("output", "1"),),
    slots=(Slot("rest", "1", "the output at rest"),),
    response=_evaluate_constant_response,
    effects=(),
)
