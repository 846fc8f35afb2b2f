"""How probable each reading of a calibration is, left out of it."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import xarray as xr

from bayescal._calibration.calibration import Calibration


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
