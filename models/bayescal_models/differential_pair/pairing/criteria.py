"""Two criteria for pairs of devices, and source 3's estimator of the environment ratio λbd.

Ratio variance (source 3, step 1): records are fitted by polynomials y = Σ c_i·t^i, i = 0 … 3, with t from 0 to 1 over
the record; the criterion is the variance over i of the ratios c_i(outer)/c_i(inner). Source 3 does not state
the degree; we use 3.

Residual (not in source 3): rms over the record of [env1 − λbd·env2]/(λ1 + λbd·λ2), the environment that remains in
the pair's measurement with the calibrated λbd.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POLYNOMIAL_DEGREE = 3  # of the polynomials in time


def fit_polynomial(time: Array, records: Array) -> Array:
    """Fit polynomials in time to records (…, T) by least squares; return coefficients c_0 … c_3, (…, 4)."""
    t = (time - time[0]) / (time[-1] - time[0])
    return records @ np.linalg.pinv(np.vander(t, POLYNOMIAL_DEGREE + 1, increasing=True)).T


def ratio_variance(coefficients: Array, outer_count: int) -> Array:
    """Return the variance over i of the coefficient ratio c_i(outer)/c_i(inner) of every pair, (…, outer, inner).

    Args:
        coefficients: c_i of each device, outer first, (…, K, 4).
        outer_count: number of outer devices.
    """
    outer_values = coefficients[..., :outer_count, None, :]
    inner_values = coefficients[..., None, outer_count:, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = np.var(outer_values / inner_values, axis=-1)
    return np.where(np.isfinite(variance), variance, np.inf)


def compute_residual_rms(environment: Array, scale: Array, ratio: Array) -> Array:
    """Return the rms over the record of the environment left by differencing, µg, of every pair, (…, outer, inner).

    Args:
        environment: environment of each device, outer first, µg, (…, K, T).
        scale: 1 + κ, (…, K).
        ratio: λbd of each pair, (outer, inner).
    """
    outer_count = len(ratio)
    products = environment @ np.swapaxes(environment, -1, -2) / environment.shape[-1]
    squares = np.diagonal(products, axis1=-2, axis2=-1)
    outer_values, inner_values = squares[..., :outer_count, None], squares[..., None, outer_count:]
    mean_square = outer_values - 2 * ratio * products[..., :outer_count, outer_count:]
    mean_square = mean_square + ratio**2 * inner_values
    divisor = scale[..., :outer_count, None] + ratio * scale[..., None, outer_count:]
    return np.sqrt(np.maximum(mean_square, 0.0)) / np.abs(divisor)


def compute_ratio_of_sums(environment: Array, outer_count: int) -> Array:
    """Return the environment ratio Σ(a1 − λ1·a − Σw1)/Σ(a2 + λ2·a − Σw2) of every pair (source 3, step 2).

    The estimate is unreliable if Σu is near zero, and attributes any offset of the records to the environment.

    Args:
        environment: records without known contributions, outer devices first, µg, (K, T).
        outer_count: number of outer devices.
    """
    total = environment.sum(axis=-1)
    return total[:outer_count, None] / total[None, outer_count:]
