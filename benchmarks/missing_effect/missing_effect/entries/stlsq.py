"""Sequentially thresholded least squares: pysindy's STLSQ (defaults: threshold 0.1, alpha 0.05) on scaled columns.

Columns and output have standard deviation 1, so that the threshold is a tenth of the residuals' scatter.
Source: S. Brunton, J. Proctor & J. Kutz, PNAS 113 (2016) 3932; pysindy's documentation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pysindy  # pyright: ignore[reportMissingImports]

from missing_effect.regression import Regression
from missing_effect.task import Task


def solve(task: Task) -> dict[str, Any]:
    problem = Regression(task)
    x, y, owner = scaled(problem)
    chosen = chosen_by(pysindy.STLSQ().fit(x, y).coef_, owner)
    mean, sd = problem.predict(chosen)
    return {"sets": {problem.names(chosen): 1.0}, "mean": mean, "sd": sd}


def scaled(problem: Regression) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return columns (n, p) and output (n, 1) scaled to a standard deviation of 1, and the candidate of each column."""
    x = np.hstack(problem.projected)
    owner = np.repeat(np.arange(len(problem.projected)), [c.shape[1] for c in problem.projected])
    return x / np.maximum(x.std(axis=0), 1e-300), problem.left[:, None] / problem.left.std(), owner


def chosen_by(coefficients: np.ndarray, owner: np.ndarray) -> tuple[int, ...]:
    """Return the candidates with a nonzero coefficient."""
    return tuple(sorted({int(i) for i in owner[np.ravel(coefficients) != 0]}))
