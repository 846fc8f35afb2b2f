"""Intervals of draws and of counts, and stated probabilities beside how often they came true."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from scipy import stats


def credible_interval(draws: np.ndarray, level: float = 0.95) -> list[float]:
    """Equal-tailed interval of posterior draws, in their unit."""
    return np.quantile(draws, [(1 - level) / 2, (1 + level) / 2]).tolist()


def proportion(count: int, total: int) -> str:
    """A proportion with its exact (Clopper–Pearson) 95 % interval, in words."""
    if total == 0:
        return "–"
    low, high = stats.binomtest(count, total).proportion_ci(0.95, method="exact")
    places = 1 if total > 2000 else 0
    return f"{count}/{total} ({100 * low:.{places}f}–{100 * high:.{places}f} %)"


def expected_counts(total: int, chance: float, level: float) -> tuple[int, int]:
    """Least and most of `total` independent events, outside of which their count falls with at most `level`.

    Args:
        total: of events.
        chance: of each.
        level: half of it lies beyond either end, or less, for counts are whole.
    """
    law = stats.binom(total, chance)
    return int(law.ppf(level / 2)), int(law.isf(level / 2))


def by_stated(
    stated: np.ndarray, happened: np.ndarray, edges: Sequence[float]
) -> Iterator[tuple[float, float, np.ndarray, int]]:
    """Stated probabilities bin by bin: both edges of a bin, what was stated within, and how often it was so.

    Bins hold their lower edge, the last one its upper edge too; empty ones are left out.
    """
    for low, high in pairwise(edges):
        inside = (stated >= low) & ((stated < high) | (high == edges[-1]))
        if inside.any():
            yield low, high, stated[inside], int(happened[inside].sum())
