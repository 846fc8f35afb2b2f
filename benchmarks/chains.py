"""What the draws of chains are worth, by ArviZ; every function takes draws (chains, draws) of one unknown."""

from __future__ import annotations

import numpy as np
from arviz_stats.base.array import array_stats


def mean_error(draws: np.ndarray) -> float:
    """Monte-Carlo standard error of the mean, in the draws' unit."""
    return _number(array_stats.mcse(draws, chain_axis=0, draw_axis=1, method="mean"))


def sd_error(draws: np.ndarray) -> float:
    """Monte-Carlo standard error of the standard deviation, in the draws' unit."""
    return _number(array_stats.mcse(draws, chain_axis=0, draw_axis=1, method="sd"))


def r_hat(draws: np.ndarray) -> float:
    """Rank-normalised R̂."""
    return _number(array_stats.rhat(draws, chain_axis=0, draw_axis=1))


def effective_draws(draws: np.ndarray) -> float:
    """Bulk effective sample size."""
    return _number(array_stats.ess(draws, chain_axis=0, draw_axis=1, method="bulk"))


def _number(found: object) -> float:
    return float(np.asarray(found))
