"""The evidence of another model on a calibration's readings."""

from __future__ import annotations

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._engine.assembly import Assembly
from bayescal._engine.linear_model import sized
from bayescal._engine.mode import find_mode
from bayescal._engine.record import Record
from bayescal._inference.laplace import compiled_mode
from bayescal._inference.method import by_engine
from bayescal._model.frame import build_frame
from bayescal._model.model import Model
from bayescal._model.parameters import bind


def laplace_evidence(model: Model, calibration: Calibration) -> float:
    """Log evidence of a model on a calibration's readings, by Laplace."""
    model.require(calibration.readings)
    frame = build_frame(calibration.readings, calibration.reference)
    model = sized(model, calibration.readings, frame)
    layout, _ = bind(model, calibration.readings)
    extra = [n for n in calibration.layout.promoted if n in model.unknowns]
    layout = layout.promote(*extra)
    y = np.asarray(calibration.readings["output"])
    if by_engine(layout):
        assembly = Assembly(layout, Record(model.instrument, frame, y))
        return float(find_mode(assembly).log_evidence)
    return float(compiled_mode(layout, frame, y).log_evidence)
