"""Weights: of draws, Pareto smoothing, effective sample size, resampling; of models, stacking."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize

ALIKE_SCATTER = 0.01  # scatter of corrections, from which the posterior is the same without
TRIED_SIZE = 50  # effective sample size from which this is known


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
    # One random number for the whole ladder: how often a draw is taken differs from count·weight by less than one.
    ladder = (np.arange(count) + random.random()) / count
    pick = np.searchsorted(np.cumsum(weights) / np.sum(weights), ladder)
    return random.permutation(np.minimum(pick, weights.size - 1))


class Corrections:
    """What corrects the log weights of joint draws, as far as it was computed.

    Attributes:
        mean: of the corrections, weighted as the draws are.
        alike: whether they scatter so little that the others may have this mean: a relative scatter δ of the weights
            moves a posterior mean by δ standard deviations at most (Cauchy and Schwarz), a standard deviation by δ/√2.
    """

    def __init__(self) -> None:
        self.log_weight, self.corrections = np.zeros(0), np.zeros(0)
        self.mean, self.alike = 0.0, False

    def add(self, log_weight: Float[np.ndarray, "b"], correction: Float[np.ndarray, "b"]) -> None:
        """Corrections of further draws with these log weights before them."""
        if self.alike or not len(correction):
            return
        self.log_weight = np.append(self.log_weight, log_weight)
        self.corrections = np.append(self.corrections, correction)
        weight = np.exp(self.log_weight - np.max(self.log_weight))
        weight /= np.sum(weight)
        if effective_size(weight) > TRIED_SIZE and np.all(np.isfinite(self.corrections)):
            self.mean = float(weight @ self.corrections)
            scatter = np.sqrt(float(weight @ (self.corrections - self.mean) ** 2))
            self.alike = bool(scatter < ALIKE_SCATTER)


def stacking(log_densities: np.ndarray) -> np.ndarray:
    """Weights on models (m,) that maximise the log score of their mixture, from (n, m) log densities.

    Source: Yao et al., Bayesian Analysis 13 (2018) 917.
    """
    count = log_densities.shape[1]
    density = np.exp(log_densities - log_densities.max(axis=1, keepdims=True))

    def loss(free: np.ndarray) -> tuple[float, np.ndarray]:
        # Weights as a softmax of free numbers f are positive and add up to one. With g the slope of the score by the
        # weights its slope by f is w·(g − w·g).
        weight = np.exp(free - free.max())
        weight /= weight.sum()
        mixed = density @ weight
        slope = (density / mixed[:, None]).sum(axis=0)
        return -float(np.log(mixed).sum()), -weight * (slope - slope @ weight)

    found = minimize(loss, np.zeros(count), jac=True, method="BFGS")
    weight = np.exp(found.x - found.x.max())
    return weight / weight.sum()
