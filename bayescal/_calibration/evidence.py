"""The evidence of another model on a calibration's readings."""

from __future__ import annotations

import jax.numpy as jnp

from bayescal._calibration.calibration import Calibration
from bayescal._inference.laplace import compiled_mode
from bayescal._model.frame import build_frame
from bayescal._model.model import Model
from bayescal._model.parameters import bind


def laplace_evidence(model: Model, calibration: Calibration) -> float:
    """Log evidence of a model on a calibration's readings, by Laplace."""
    model.require(calibration.readings)
    layout, _ = bind(model, calibration.readings)
    extra = [n for n in calibration.layout.promoted if n in model.unknowns]
    layout = layout.promote(*extra)
    frame = build_frame(calibration.readings, calibration.reference)
    y = jnp.asarray(calibration.readings["output"])
    return float(compiled_mode(layout, frame, y).log_evidence)
