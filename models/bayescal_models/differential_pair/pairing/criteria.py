"""The two criteria of a pair, and the document's estimator of the environment ratio.

Ratio variance (source 3, step 1): records are fitted by y = Σ c_i·t^i, i = 0 … 3, t from the start of the record in
parts of its length, not centred; a pair's ratios are c_i(outer)/c_i(inner), and their variance over i is to be least.
The degree is ours (the source leaves n open).

Residual (ours, physical): rms over the record of [env1 − λbd·env2]/(λ1 + λbd·λ2), the residual environment of the
pair's measurement, with the calibrated λbd.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DEGREE = 3


def polynomial(time: Array, records: Array) -> Array:
    """Fit coefficients c_0 … c_3 of records (…, T) in powers of time from the start, (…, 4)."""
    t = (time - time[0]) / (time[-1] - time[0])
    return records @ np.linalg.pinv(np.vander(t, DEGREE + 1, increasing=True)).T


def ratio_variance(coefficients: Array, outer: int) -> Array:
    """Return the variance of c_i(outer)/c_i(inner) over the powers i of time.

    Args:
        coefficients: c_i of each device, outer first, (…, K, 4).
        outer: number of outer devices.

    Returns:
        (…, outer, inner).
    """
    above = coefficients[..., :outer, None, :]
    below = coefficients[..., None, outer:, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = np.var(above / below, axis=-1)
    return np.where(np.isfinite(variance), variance, np.inf)


def residual(environment: Array, scale: Array, ratio: Array) -> Array:
    """Return the rms residual environment of differencing, over the record, µg.

    Args:
        environment: environment of each device, outer first, µg, (…, K, T).
        scale: 1 + κ, (…, K).
        ratio: λbd of each pair, (outer, inner).

    Returns:
        (…, outer, inner).
    """
    outer = len(ratio)
    product = environment @ np.swapaxes(environment, -1, -2) / environment.shape[-1]
    squares = np.diagonal(product, axis1=-2, axis2=-1)
    above, below = squares[..., :outer, None], squares[..., None, outer:]
    square = above - 2 * ratio * product[..., :outer, outer:] + ratio**2 * below
    divisor = scale[..., :outer, None] + ratio * scale[..., None, outer:]
    return np.sqrt(np.maximum(square, 0.0)) / np.abs(divisor)


def document_ratio(removed: Array, outer: int) -> Array:
    """Return Σ(a1 − λ1·a − Σw1)/Σ(a2 + λ2·a − Σw2) over the record (source 3, step 2), (outer, inner).

    It is unreliable if Σu is near zero, and attributes any offset of the records to the environment.
    """
    total = removed.sum(axis=-1)
    return total[:outer, None] / total[None, outer:]
