"""Bayesian model averaging over all sets of candidates: Zellner's g-prior with g = n, uniform prior on the set's size.

Sources: F. Liang et al., J. Am. Stat. Assoc. 103 (2008) 410, equation 6; unit information prior, C. Fernández,
E. Ley & M. Steel, J. Econometrics 100 (2001) 381; prior on the number, J. Scott & J. Berger, Ann. Stat. 38 (2010) 2587.
"""

from __future__ import annotations

from itertools import combinations
from math import comb, log
from typing import Any

import numpy as np

from missing_effect.regression import Regression
from missing_effect.task import Task

MOST = 12  # candidates whose sets are counted out


def solve(task: Task) -> dict[str, Any]:
    return averaged(Regression(task))


def averaged(problem: Regression) -> dict[str, Any]:
    """Average over all sets of candidates.

    Raises:
        ValueError: there are too many candidates.
    """
    count = len(problem.candidates)
    if count > MOST:
        raise ValueError(f"{count} candidates: their sets are counted out up to {MOST}")
    n = g = problem.y.size
    free, total = n - problem.parameters, float(problem.left @ problem.left)
    inner = np.hstack(problem.projected)
    gram, right = inner.T @ inner, inner.T @ problem.left
    ends = np.cumsum([0, *(c.shape[1] for c in problem.projected)])
    logs: dict[tuple[int, ...], float] = {}
    for k in range(count + 1):
        for chosen in combinations(range(count), k):
            at = np.concatenate([np.arange(ends[i], ends[i + 1]) for i in chosen] or [[]])
            at = at.astype(int)
            explained = right[at] @ np.linalg.lstsq(gram[np.ix_(at, at)], right[at], rcond=1e-12)[0]
            unexplained = max(1.0 - float(explained) / total, 1e-12)
            cost = sum(problem.cost[i] for i in chosen)
            bayes_factor = ((free - cost) * log(1 + g) - free * log(1 + g * unexplained)) / 2
            logs[chosen] = bayes_factor - log(comb(count, k) * (count + 1))
    highest = max(logs.values())
    weight = {s: float(np.exp(value - highest)) for s, value in logs.items()}
    mass = sum(weight.values())
    mean, sd = problem.average([(s, w / mass) for s, w in weight.items()])
    sets = {problem.names(s): w / mass for s, w in weight.items() if w > 1e-6 * mass}
    return {"sets": sets, "mean": mean, "sd": sd}
