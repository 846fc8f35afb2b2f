"""Rounding of the output, found from the readings themselves."""

from __future__ import annotations

import numpy as np

SHARED = 0.5  # of all readings, from which values that occur again are no chance
EXACT = 0.01  # of a step, by which values on a grid may be off it

# White noise of 0.3 steps before rounding makes the error of rounding as good as noise: what is left of the staircase
# is 0.05 steps high (Widrow & Kollár, Quantization Noise, 2008). With the rounding's own 1/√12 that is 0.42 steps.
AS_GOOD_AS_NOISE = 0.42


def rounding_step(values: np.ndarray) -> float:
    """The step that an output is rounded to, in its unit; 0 where most values occur once, or lie on no grid."""
    levels = np.unique(values)
    if not 3 <= len(levels) <= SHARED * len(values):
        return 0.0
    gaps = np.diff(levels)
    step = float(gaps[gaps > EXACT * np.median(gaps)].min())
    places = (levels - levels[0]) / step
    return step if np.all(np.abs(places - np.round(places)) < EXACT) else 0.0
