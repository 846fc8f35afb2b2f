"""Ensemble SINDy: pysindy's STLSQ on 100 bootstrap samples; a set's probability is its fraction of the samples.

Source: U. Fasel et al., Proc. R. Soc. A 478 (2022) 20210904; settings of pysindy's EnsembleOptimizer, with 100 models
in place of 20, so that the standard error of a fraction is a few hundredths.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pysindy  # pyright: ignore[reportMissingImports]

from missing_effect.entries.stlsq import chosen_by, scaled
from missing_effect.regression import Regression
from missing_effect.task import Task

MODELS = 100


def solve(task: Task) -> dict[str, Any]:
    problem = Regression(task)
    x, y, owner = scaled(problem)
    np.random.seed(0)  # noqa: NPY002 (pysindy draws its samples from NumPy's global stream)
    ensemble = pysindy.EnsembleOptimizer(pysindy.STLSQ(), bagging=True, n_models=MODELS).fit(x, y)
    counts = Counter(chosen_by(c, owner) for c in ensemble.coef_list)
    mean, sd = problem.average([(s, count / MODELS) for s, count in counts.items()])
    sets = {problem.names(s): count / MODELS for s, count in counts.items()}
    return {"sets": sets, "mean": mean, "sd": sd}
