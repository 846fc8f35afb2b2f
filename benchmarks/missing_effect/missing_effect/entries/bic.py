"""Stepwise forward selection by BIC; the visited models have weights exp(−BIC/2).

Sources: G. Schwarz, Ann. Stat. 6 (1978) 461; weights, A. Raftery, Sociol. Methodol. 25 (1995) 111.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from missing_effect.regression import Regression
from missing_effect.task import Task


def solve(task: Task) -> dict[str, Any]:
    return stepwise(task, lambda added, candidates: 0.0)


def stepwise(task: Task, penalty: Callable[[int, int], float]) -> dict[str, Any]:
    """Select terms forward while the criterion decreases.

    Args:
        penalty: penalty in addition to k·ln n, a function of the numbers of selected terms and of candidates.
    """
    problem = Regression(task)
    n, count = problem.y.size, len(problem.candidates)

    def criterion(chosen: frozenset[int]) -> float:
        k = sum(problem.cost[i] for i in chosen)
        return n * np.log(problem.squares(chosen) / n) + k * np.log(n) + penalty(len(chosen), count)

    current: frozenset[int] = frozenset()
    met = {current: criterion(current)}
    while True:
        trials = {current | {i}: criterion(current | {i}) for i in range(count) if i not in current}
        met |= trials
        best = min(trials, key=lambda s: trials[s], default=current)
        if best == current or trials[best] >= met[current]:
            break
        current = best
    lowest = min(met.values())
    weight = {s: float(np.exp(-(value - lowest) / 2)) for s, value in met.items()}
    total = sum(weight.values())
    mean, sd = problem.average([(s, w / total) for s, w in weight.items()])
    sets = {problem.names(s): w / total for s, w in weight.items()}
    return {"sets": sets, "mean": mean, "sd": sd}
