"""Thermal bodies heated by another body."""

from __future__ import annotations

import numpy as np
from missing_effect.draws import Array
from scipy.signal import lfilter


def body(driven_by: Array, step: float, tau: float) -> Array:
    """Return the temperature of a body that follows another with time constant tau, along the last axis.

    Args:
        step: time between values, in the unit of tau.
    """
    decay = np.exp(-step / tau)
    first = driven_by[..., :1]
    return first + lfilter([0.0, 1.0 - decay], [1.0, -decay], driven_by - first, axis=-1)
