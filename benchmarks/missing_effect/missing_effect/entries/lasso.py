"""LASSO, penalty by cross-validation (scikit-learn's LassoCV with cv=5): nonzero coefficients make up the set.

Source: R. Tibshirani, J. R. Stat. Soc. B 58 (1996) 267; scikit-learn's user guide, section 1.1.3.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from sklearn.linear_model import LassoCV  # pyright: ignore[reportMissingImports]

from missing_effect.regression import Regression
from missing_effect.task import Task


def solve(task: Task) -> dict[str, Any]:
    problem = Regression(task)
    x = np.hstack(problem.projected)
    owner = np.repeat(np.arange(len(problem.projected)), [c.shape[1] for c in problem.projected])
    scale = np.maximum(x.std(axis=0), 1e-300)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of convergence at the smallest penalties
        lasso = LassoCV(cv=5).fit(x / scale, problem.left)
    chosen = {int(i) for i in owner[lasso.coef_ != 0]}
    mean, sd = problem.predict(chosen)
    return {"sets": {problem.names(chosen): 1.0}, "mean": mean, "sd": sd}
