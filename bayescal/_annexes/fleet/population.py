"""The population that devices are drawn from: mean and variance of values that are known to variances of their own.

A value x of variance v is drawn from N(μ, τ² + v). μ and τ² are those of greatest restricted likelihood.
Source: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq


def estimate_population(
    values: Float[np.ndarray, "n"], variance: Float[np.ndarray, "n"]
) -> tuple[float, float, Float[np.ndarray, "n"]]:
    """Return mean, variance between devices, and weights of values of known variances."""

    def mean(between: float) -> tuple[float, np.ndarray]:
        weight = 1 / (between + variance)
        return float(weight @ values / weight.sum()), weight

    def slope(between: float) -> float:
        middle, weight = mean(between)
        squares = weight**2 @ (values - middle) ** 2
        return float(squares - weight.sum() + weight @ weight / weight.sum())

    most = 2 * float(np.ptp(values)) ** 2 + float(np.min(variance))
    least = 1e-12 * most
    between = 0.0 if slope(least) <= 0 else float(brentq(slope, least, most))  # pyright: ignore
    middle, weight = mean(between)
    return middle, between, weight
