"""Pairs are judged with probabilities, and the printed rule is shown for what it prefers."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from bayescal_models import differential_pair as dp
from bayescal_models.differential_pair.pairing import criteria
from bayescal_models.differential_pair.pairing.selection import CRITERIA, judge
from tests.support.made_up.pairs import SMALL, made_up


@pytest.mark.parametrize("criterion", CRITERIA)
def test_probabilities_add_up_and_the_first_pair_is_the_best(criterion: str) -> None:
    table = dp.select(made_up(), criterion=criterion)
    assert len(table.pairs) == 12
    for name in ("residual", "ratio_variance", "ratio_variance_raw"):
        assert sum(getattr(p, f"probability_{name}") for p in table.pairs) == pytest.approx(1)
    assert table.best == (table.pairs[0].outer, table.pairs[0].inner)
    if criterion == "residual":
        assert table.pairs[0].expected_loss == min(p.expected_loss for p in table.pairs) >= 0


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_set_of_pairs_is_disjoint_and_optimal(seed: int) -> None:
    devices = made_up(seed)
    table, cost = dp.select(devices), judge(devices).of_pair["expected_residual"]
    for side in zip(*table.matching, strict=True):
        assert len(set(side)) == 3
    total = sum(table.of(*pair).expected_residual for pair in table.matching)
    best = min(
        sum(cost[i, j] for i, j in enumerate(chosen)) for chosen in permutations(range(4), 3)
    )
    assert total == pytest.approx(best)


def test_the_residual_is_the_rms_that_its_formula_says() -> None:
    devices = made_up(draws=3)
    ratio = np.full((3, 4), 0.9)
    found = criteria.residual(devices.environment, devices.scale, ratio)
    one, two = devices.environment[1, 2], devices.environment[1, 5]
    left = (one - 0.9 * two) / (devices.scale[1, 2] + 0.9 * devices.scale[1, 5])
    assert found[1, 2, 2] == pytest.approx(np.sqrt(np.mean(left**2)))


def plateau(**changed) -> tuple[np.ndarray, dp.SimulatedBatch]:
    """Variances of ratios by the printed rule, on raw records at constant acceleration."""
    plan = replace(SMALL, profile="plateau", **changed)
    made = dp.simulate_batch(seed=11, campaign=plan)
    records = made.readings["output"].reshape(len(made.names), -1)
    return criteria.ratio_variance(criteria.polynomial(plan.time, records), made.outer), made


def test_ideal_pairs_have_a_raw_variance_near_three_quarters() -> None:
    found, _ = plateau(alike=True, noise=0.0)
    np.testing.assert_allclose(found, 0.75, atol=0.01)


def test_the_documents_ratio_needs_a_mean_and_takes_offsets_for_environment() -> None:
    time = np.linspace(0, 1, 50)
    u = 1000 * (0.5 + np.sin(5 * time))
    records = np.stack([1.2 * u, 0.8 * u])
    assert criteria.document_ratio(records, 1)[0, 0] == pytest.approx(1.5)
    assert abs(criteria.document_ratio(records + [[0], [300.0]], 1)[0, 0] - 1.5) > 0.2
