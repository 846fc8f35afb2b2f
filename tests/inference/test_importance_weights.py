"""Pareto smoothing against ArviZ's."""

from __future__ import annotations

import numpy as np
import pytest
from arviz_stats.base.array import array_stats

from tests.support.inside import smoothed


@pytest.mark.parametrize("count", [25, 225, 226, 4000])
@pytest.mark.parametrize("freedom", [2, 30])
@pytest.mark.parametrize("size", [1e-3, 0.3, 3.0])
def test_smoothed_weights_are_those_of_arviz(count: int, freedom: float, size: float) -> None:
    log_weight = size * np.random.default_rng(count).standard_t(freedom, count)
    weights, k_hat = smoothed(log_weight)
    theirs, their_k_hat = array_stats.psislw(-log_weight)
    assert weights == pytest.approx(np.exp(theirs) / np.exp(theirs).sum(), rel=1e-10)
    assert k_hat == pytest.approx(float(their_k_hat), abs=1e-10)
