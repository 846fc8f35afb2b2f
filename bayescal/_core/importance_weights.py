"""Weights: of draws, Pareto smoothing, effective sample size, resampling; of models, stacking."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize


def smoothed(log_weight: Float[np.ndarray, "s"]) -> tuple[Float[np.ndarray, "s"], float]:
    """Pareto-smoothed weights, summing to one, and k̂, by ArviZ.

    Source: Vehtari et al., JMLR 25 (2024) 72.
    """
    from arviz_stats.base.array import array_stats  # half a second that only sampling needs

    if np.ptp(log_weight) < 1e-9:
        return np.full(log_weight.size, 1 / log_weight.size), 0.0
    values, k_hat = array_stats.psislw(-np.asarray(log_weight, dtype=float))
    # psislw takes log likelihood and smooths its inverse: hence the sign.
    weights = np.exp(values - np.max(values))
    return weights / weights.sum(), float(k_hat)


def effective_size(weights: Float[np.ndarray, "s"]) -> float:
    """Effective sample size of weights that sum to one (Kish)."""
    return float(1 / np.sum(weights**2))


def resample(weights: Float[np.ndarray, "s"], count: int, seed: int) -> Int[np.ndarray, "count"]:
    """Positions of draws by systematic resampling, then shuffled so that they stand in no order."""
    random = np.random.default_rng(seed)
    ladder = (np.arange(count) + random.random()) / count
    pick = np.searchsorted(np.cumsum(weights) / np.sum(weights), ladder)
    return random.permutation(np.minimum(pick, weights.size - 1))


def stacking(log_densities: np.ndarray) -> np.ndarray:
    """Weights on models (m,) that maximise the log score of their mixture, from (n, m) log densities.

    Source: Yao et al., Bayesian Analysis 13 (2018) 917.
    """
    count = log_densities.shape[1]
    density = np.exp(log_densities - log_densities.max(axis=1, keepdims=True))

    def loss(free: np.ndarray) -> tuple[float, np.ndarray]:
        weight = np.exp(free - free.max())
        weight /= weight.sum()
        mixed = density @ weight
        slope = (density / mixed[:, None]).sum(axis=0)
        return -float(np.log(mixed).sum()), -weight * (slope - slope @ weight)

    found = minimize(loss, np.zeros(count), jac=True, method="BFGS")
    weight = np.exp(found.x - found.x.max())
    return weight / weight.sum()
