"""SuSiE: a sum of single effects, each a categorical choice of one column, by iterative Bayesian stepwise selection.

Source: G. Wang, A. Sarkar, P. Carbonetto & M. Stephens, J. R. Stat. Soc. B 82 (2020) 1273, algorithm 1, with the
settings of the authors' R package susieR: at most ten effects, columns and output scaled to unit variance, prior and
residual variances by empirical Bayes, effects removed whose most likely prior variance is zero. The authors have no
Python package. Each column of a candidate with several columns is treated as a separate variable.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import fminbound
from scipy.special import logsumexp

from missing_effect.regression import Regression
from missing_effect.task import Task

EFFECTS = 10
ROUNDS = 100
CONVERGENCE_TOLERANCE = 1e-3  # change of the inclusion probabilities in a round
TOLERANCE = 1e-9  # prior variance of an effect that is not there
LEAST = 0.01  # probability of a choice, below which a set with it is not counted out


def solve(task: Task) -> dict[str, Any]:
    problem = Regression(task)
    chosen = single_effects(np.hstack(problem.projected), problem.left)
    widths = [c.shape[1] for c in problem.projected]
    owner = np.repeat(np.arange(len(widths)), widths)
    sets: dict[frozenset[int], float] = {frozenset(): 1.0}
    for alpha in chosen:
        inclusion = np.bincount(owner, alpha, len(widths))
        sets = _with(sets, {i: p for i, p in enumerate(inclusion) if p >= LEAST})
    total = sum(sets.values())
    mean, sd = problem.average([(s, p / total) for s, p in sets.items()])
    return {"sets": {problem.names(s): p / total for s, p in sets.items()}, "mean": mean, "sd": sd}


def _with(
    sets: dict[frozenset[int], float], choice: dict[int, float]
) -> dict[frozenset[int], float]:
    """Return the sets with one more candidate, chosen independently."""
    by_set: dict[frozenset[int], float] = {}
    for s, p in sets.items():
        for i, q in choice.items():
            by_set[s | {i}] = by_set.get(s | {i}, 0.0) + p * q
    return dict(sorted(by_set.items(), key=lambda item: -item[1])[:1000])


def single_effects(x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    """Return the probabilities of the columns for each effect with a nonzero prior variance.

    Args:
        x: columns, (n, p).
        y: output, (n,).
    """
    scale = np.sqrt(np.mean(x**2, axis=0))
    x = x[:, scale > 1e-12] / scale[scale > 1e-12]
    y = y / np.std(y)
    n, p = x.shape
    squares, noise = np.sum(x**2, axis=0), 1.0
    alpha, mean = np.full((EFFECTS, p), 1 / p), np.zeros((EFFECTS, p))
    second, prior = np.zeros((EFFECTS, p)), np.full(EFFECTS, 0.2)
    for _ in range(ROUNDS):
        before = alpha.copy()
        for k in range(EFFECTS):
            residuals = y - x @ (np.sum(alpha * mean, axis=0) - alpha[k] * mean[k])
            size, variance = x.T @ residuals / squares, noise / squares
            prior[k] = _prior_variance(size, variance)
            gain = _log_bayes_factors(size, variance, prior[k])
            alpha[k] = np.exp(gain - logsumexp(gain))
            posterior = prior[k] * variance / (prior[k] + variance)
            mean[k] = posterior / variance * size
            second[k] = posterior + mean[k] ** 2
        fitted = x @ (alpha * mean).T
        spread = np.sum(alpha * second @ squares) - np.sum(fitted**2)
        noise = float((np.sum((y - fitted.sum(axis=1)) ** 2) + spread) / n)
        if np.max(np.abs(alpha - before)) < CONVERGENCE_TOLERANCE:
            break
    whole = np.zeros((EFFECTS, len(scale)))
    whole[:, scale > 1e-12] = alpha
    return [whole[k] for k in range(EFFECTS) if prior[k] > TOLERANCE]


def _log_bayes_factors(size: np.ndarray, variance: np.ndarray, prior: float) -> np.ndarray:
    """Return each column's log Bayes factor against no effect."""
    z = size**2 / variance
    return 0.5 * (np.log(variance / (variance + prior)) + z * prior / (variance + prior))


def _prior_variance(size: np.ndarray, variance: np.ndarray) -> float:
    """Return the most likely prior variance; it may be zero."""

    def lost(log_prior: float) -> float:
        gain = _log_bayes_factors(size, variance, np.exp(log_prior))
        return -float(logsumexp(gain) - np.log(len(gain)))

    at = float(fminbound(lost, -30.0, 15.0))  # pyright: ignore[reportArgumentType]
    return float(np.exp(at)) if lost(at) < 0 else 0.0
