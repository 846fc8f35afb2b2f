"""How probable a calibration's readings are: under another model, and each one left out."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import xarray as xr

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


def pointwise_loo(calibration: Calibration) -> tuple[np.ndarray, float]:
    """Expected log predictive density of each reading left out, by PSIS, and the largest Pareto k."""
    import arviz_stats  # a second that only a comparison needs

    tree = xr.DataTree.from_dict(
        {
            "log_likelihood": calibration.log_likelihood(),
            "posterior": calibration.posterior,
        }
    )
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", UserWarning
        )  # high Pareto k: said in our own words, by model
        found: Any = arviz_stats.loo(tree, pointwise=True)  # pyright: ignore[reportPrivateImportUsage]
    return np.asarray(found.elpd_i).ravel(), float(np.max(np.asarray(found.pareto_k)))
