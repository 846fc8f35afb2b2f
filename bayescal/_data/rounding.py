"""Rounding of the output, found from the readings themselves."""

from __future__ import annotations

import numpy as np

from bayescal._data.record_settings import recording


def rounding_step(values: np.ndarray) -> float:
    """The step that an output is rounded to, in its unit; 0 where most values occur once, or lie on no grid."""
    levels = np.unique(values)
    if not 3 <= len(levels) <= recording().rounded * len(values):
        return 0.0
    gaps, off = np.diff(levels), recording().off_grid
    step = float(gaps[gaps > off * np.median(gaps)].min())
    places = (levels - levels[0]) / step
    return step if np.all(np.abs(places - np.round(places)) < off) else 0.0
