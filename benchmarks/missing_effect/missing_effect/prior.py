"""The data sheet's prior for the simulated tracks, for entries that use it.

Weights are numbers of tasks out of its 600; they are not normalised.
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from missing_effect.task import Task

MOST = 2  # effects missing at once
LAWS = 5  # of noise that is not white
# By kind of noise: tasks with so many effects missing. "outside" is what no candidate describes; it acts alone.
TASKS = {"white": (90, 84, 36), "coloured": (90, 63, 27), "outside": (60, 0, 0)}
FLEETS = {"white": (20, 42, 18)}  # by the shares of one and two effects in the others
SIZES = (1 / 3, 3.0)  # of a missing effect, in plausible ones, of either sign
ELSE = 1e-3  # of all else, where two candidates are rivals
RIVAL_CORRELATION = 0.9  # correlation of the courses of two rivals, at least


def weight(kind: str, missing: int, candidates: int, fleet: bool = False) -> float:
    """Return the prior weight of one set of `missing` effects; sets of equal size share that of their kind of noise."""
    if missing > MOST:
        return 0.0
    tasks = (FLEETS if fleet else TASKS).get(kind, (0, 0, 0))
    return tasks[missing] / comb(candidates, missing)


def rivals(task: Task) -> tuple[str, ...]:
    """Return the two candidates of a confounded task, of which one is missing; empty for other tasks."""
    linear = [t for t in task.candidates if t.formula == "power" and t.arguments["order"] == 1]
    correlated = [
        (a.name, b.name)
        for a, b in combinations(linear, 2)
        if a.arguments["column"] != b.arguments["column"]
        and abs(np.corrcoef(*(task.train[t.arguments["column"]] for t in (a, b)))[0, 1])
        > RIVAL_CORRELATION
    ]
    return correlated[0] if len(correlated) == 1 else ()
