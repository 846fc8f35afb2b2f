"""Pareto smoothing against ArviZ's."""

from __future__ import annotations

import numpy as np
import pytest
from arviz_stats.base.array import array_stats

from bayescal._core.importance_weights import ALIKE_SCATTER, Corrections, smoothed


@pytest.mark.parametrize("count", [25, 225, 226, 4000])
@pytest.mark.parametrize("freedom", [2, 30])
@pytest.mark.parametrize("size", [1e-3, 0.3, 3.0])
def test_smoothed_weights_are_those_of_arviz(count: int, freedom: float, size: float) -> None:
    log_weight = size * np.random.default_rng(count).standard_t(freedom, count)
    weights, k_hat = smoothed(log_weight)
    theirs, their_k_hat = array_stats.psislw(-log_weight)
    assert weights == pytest.approx(np.exp(theirs) / np.exp(theirs).sum(), rel=1e-10)
    assert k_hat == pytest.approx(float(their_k_hat), abs=1e-10)


def test_what_has_no_tail() -> None:
    weights, k_hat = smoothed(np.full(10, 3.0))
    assert k_hat == 0.0
    assert np.all(weights == 0.1)
    with pytest.raises(ValueError):
        smoothed(np.arange(24.0))


@pytest.mark.parametrize(
    ("scatter", "alike"), [(0.5 * ALIKE_SCATTER, True), (3 * ALIKE_SCATTER, False)]
)
def test_weights_are_left_as_they_are_only_where_their_corrections_agree(scatter, alike) -> None:
    random, judged = np.random.default_rng(1), Corrections()
    judged.add(np.zeros(200), 0.3 + scatter * random.standard_normal(200))
    assert judged.alike is alike
    assert judged.mean == pytest.approx(0.3, abs=3 * scatter)
    judged = Corrections()
    judged.add(np.zeros(200), np.where(np.arange(200) == 7, -np.inf, 0.0))
    assert not judged.alike
    few = Corrections()
    few.add(np.r_[np.zeros(10), np.full(190, -30.0)], np.zeros(200))
    assert not few.alike  # ten draws hold all of the weight
