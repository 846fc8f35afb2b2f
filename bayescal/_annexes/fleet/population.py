"""Mean μ and between-device variance τ² of a population of devices, from values of known variances.

A value x of variance v is distributed as N(μ, τ² + v). μ and τ² maximise the restricted likelihood.
Source: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq


def estimate_population(
    values: Float[np.ndarray, "n"], variance: Float[np.ndarray, "n"]
) -> tuple[float, float, Float[np.ndarray, "n"]]:
    """Return the estimates of μ and τ², and the weights 1/(τ² + v) of values with variances v."""

    def average(tau2: float) -> tuple[float, np.ndarray]:
        weights = 1 / (tau2 + variance)
        return float(weights @ values / weights.sum()), weights

    def score(tau2: float) -> float:  # derivative of 2·log likelihood with respect to τ²
        mean, weights = average(tau2)
        weighted_squares = weights**2 @ (values - mean) ** 2
        return float(weighted_squares - weights.sum() + weights @ weights / weights.sum())

    upper = 2 * float(np.ptp(values)) ** 2 + float(np.min(variance))
    lower = 1e-12 * upper
    tau2 = 0.0 if score(lower) <= 0 else float(brentq(score, lower, upper))  # pyright: ignore
    mean, weights = average(tau2)
    return mean, tau2, weights
