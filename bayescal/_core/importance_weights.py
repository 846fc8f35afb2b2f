"""Importance weights of draws: Pareto smoothing, effective sample size, resampling; stacking weights of models."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

MAX_CORRECTION_SD = 0.01  # of corrections, nats, below which they are treated as constant
MIN_TAIL_WEIGHTS = 5  # minimum number of weights for the fit of a Pareto tail
MIN_EFFECTIVE_SIZE = 50  # from which the standard deviation of corrections is estimated


def smooth(log_weights: Float[np.ndarray, "s"]) -> tuple[Float[np.ndarray, "s"], float]:
    """Return Pareto-smoothed importance weights (s,), which sum to one, and the tail's shape parameter k̂.

    The largest weights are replaced by quantiles of a generalised Pareto distribution fitted to them, as in ArviZ.

    Raises:
        ValueError: fewer than 25 draws, too few for a tail.

    Source: Vehtari et al., JMLR 25 (2024) 72.
    """
    count = log_weights.size
    if np.ptp(log_weights) < 1e-9:
        return np.full(count, 1 / count), 0.0
    tail_size = int(3 * count**0.5) if count > 225 else count // 5
    if tail_size < MIN_TAIL_WEIGHTS:
        raise ValueError(f"{count} draws are too few for Pareto smoothing")
    weights = np.exp(log_weights - np.max(log_weights))
    order = np.argsort(log_weights)
    tail, cutoff = order[-tail_size:], weights[order[-tail_size - 1]]
    k_hat, scale = _fit_pareto(weights[tail] - cutoff)
    if np.isfinite(k_hat) and scale > 0:
        tail_log = np.log1p(-(np.arange(tail_size) + 0.5) / tail_size)
        scaled_quantiles = np.expm1(-k_hat * tail_log) / k_hat if k_hat else -tail_log
        weights[tail] = np.minimum(cutoff + scale * scaled_quantiles, 1.0)
    return weights / weights.sum(), k_hat


def _fit_pareto(excess: Float[np.ndarray, "t"]) -> tuple[float, float]:
    """Fit a generalised Pareto distribution to sorted positive values; return k̂ (shrunk to ½, weight 10) and scale σ.

    Source: J. Zhang and M. Stephens, Technometrics 51 (2009) 316: the mean of b = −k/σ over its profile likelihood.
    """
    n, grid_size = len(excess), 30 + int(len(excess) ** 0.5)
    quartile = excess[int(n / 4 + 0.5) - 1]
    if quartile == 0.0:  # equal values: no tail; one positive value among zeros: infinite tail
        return np.inf if excess[-1] > 0.0 else 0.0, 0.0
    b = (1 - np.sqrt(grid_size / (np.arange(grid_size) + 0.5))) / (3 * quartile) + 1 / excess[-1]
    k = np.mean(np.log1p(-b[:, None] * excess), axis=1)
    log_likelihood = n * (np.log(-b / k) - k - 1)
    weight = np.exp(log_likelihood - np.max(log_likelihood))
    weight /= weight.sum()
    weight[weight < 10 * np.finfo(float).eps] = 0.0
    mean_b = float(b @ weight / weight.sum())
    k_hat = float(np.mean(np.log1p(-mean_b * excess)))
    return (n * k_hat + 5) / (n + 10), -k_hat / mean_b


def compute_ess(weights: Float[np.ndarray, "s"]) -> float:
    """Return the effective sample size of weights that sum to one (Kish)."""
    return float(1 / np.sum(weights**2))


def resample(weights: Float[np.ndarray, "s"], count: int, seed: int) -> Int[np.ndarray, "count"]:
    """Resample draws systematically with probabilities proportional to `weights`; return indices (count,), shuffled."""
    rng = np.random.default_rng(seed)
    # One random offset: the number of copies of a draw differs from count·weight by less than one.
    cumulative_probabilities = (np.arange(count) + rng.random()) / count
    indices = np.searchsorted(np.cumsum(weights) / np.sum(weights), cumulative_probabilities)
    return rng.permutation(np.minimum(indices, weights.size - 1))


class Corrections:
    """Accumulator of corrections to the log weights of joint draws, which detects that they are constant.

    Attributes:
        mean: weighted mean of the corrections.
        is_constant: whether their standard deviation δ is below `MAX_CORRECTION_SD`. Treating them as constant changes
            a posterior mean by at most δ standard deviations (Cauchy–Schwarz), a standard deviation by δ/√2.
    """

    def __init__(self) -> None:
        self.log_weight, self.corrections = np.zeros(0), np.zeros(0)
        self.mean, self.is_constant = 0.0, False

    def add(self, log_weight: Float[np.ndarray, "b"], correction: Float[np.ndarray, "b"]) -> None:
        """Add the corrections (b,) of further draws, whose log weights before correction are `log_weight` (b,)."""
        if self.is_constant or not len(correction):
            return
        self.log_weight = np.append(self.log_weight, log_weight)
        self.corrections = np.append(self.corrections, correction)
        weight = np.exp(self.log_weight - np.max(self.log_weight))
        weight /= np.sum(weight)
        if compute_ess(weight) > MIN_EFFECTIVE_SIZE and np.all(np.isfinite(self.corrections)):
            self.mean = float(weight @ self.corrections)
            scatter = np.sqrt(float(weight @ (self.corrections - self.mean) ** 2))
            self.is_constant = bool(scatter < MAX_CORRECTION_SD)


def stack_models(log_densities: np.ndarray) -> np.ndarray:
    """Return the model weights (m,) that maximise the log score of the mixture, from log densities (n, m).

    Source: Yao et al., Bayesian Analysis 13 (2018) 917.
    """
    from scipy.optimize import minimize  # slow to import, not needed by a search

    count = log_densities.shape[1]
    density = np.exp(log_densities - log_densities.max(axis=1, keepdims=True))

    def evaluate_loss(logits: np.ndarray) -> tuple[float, np.ndarray]:
        # Softmax parametrisation: with g = ∂/∂w, w the weights, the gradient in the logits is w·(g − w·g).
        weight = np.exp(logits - logits.max())
        weight /= weight.sum()
        mixture = density @ weight
        gradient = (density / mixture[:, None]).sum(axis=0)
        return -float(np.log(mixture).sum()), -weight * (gradient - gradient @ weight)

    optimum = minimize(evaluate_loss, np.zeros(count), jac=True, method="BFGS")
    weight = np.exp(optimum.x - optimum.x.max())
    return weight / weight.sum()
