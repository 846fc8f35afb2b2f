"""Stepwise forward selection by mBIC: BIC plus 2k·ln(p/4 − 1), a prior of about four terms among p candidates.

Source: M. Bogdan, J. Ghosh & R. Doerge, Genetics 167 (2004) 989. With eight candidates or fewer, for which the penalty
would be negative or zero, it is zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from missing_effect.entries.bic import stepwise
from missing_effect.task import Task

EXPECTED = 4.0  # terms, the authors' choice where nothing is known


def solve(task: Task) -> dict[str, Any]:
    return stepwise(
        task, lambda added, candidates: 2 * added * np.log(max(1.0, candidates / EXPECTED - 1))
    )
