"""Gradient boosting of the base model's residuals on all recorded columns: a prediction only, without sets.

scikit-learn's HistGradientBoostingRegressor with its defaults; standard deviation from five-fold cross-validation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from sklearn.ensemble import (  # pyright: ignore[reportMissingImports]
    HistGradientBoostingRegressor,
)
from sklearn.model_selection import cross_val_predict  # pyright: ignore[reportMissingImports]

from missing_effect.regression import Regression
from missing_effect.task import Task


def solve(task: Task) -> dict[str, Any]:
    problem = Regression(task)
    names = [c for c in task.holdout if c not in ("run", "device")]
    x, later = (f[names].to_numpy(float) for f in (task.train, task.holdout))
    learner = HistGradientBoostingRegressor(random_state=0)
    out_of_fold = cross_val_predict(learner, x, problem.left, cv=5)
    spread = float(np.std(problem.left - out_of_fold))
    mean, _ = problem.predict(())
    mean = mean + learner.fit(x, problem.left).predict(later)
    sd = np.full(mean.size, np.sqrt(spread**2 + problem.extra))
    return {"sets": None, "mean": mean, "sd": sd}
