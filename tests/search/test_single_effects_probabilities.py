"""The sum of single effects: how honest its probabilities are, and what must not matter to it."""

from __future__ import annotations

import numpy as np
import pytest

from bayescal._core.errors import InputError
from bayescal._discovery.susie import Item, enumerate_models, single_effects
from tests.support.single_effects import correlated_columns, exact_two_rows, singles, statistics

# --- how honest the probabilities are ------------------------------------------------------------


def test_nothing_missing_seldom_reports_something():
    rng = np.random.default_rng(6)
    X = correlated_columns(rng, 200, 20)
    reports, confident = 0, 0
    for _ in range(300):
        found = single_effects(*statistics(X, {}, rng), np.full(20, 25.0), singles(20))
        reports += bool(found.sets)
        confident += found.nothing_probability <= 0.05
    assert reports <= 9 and confident <= 6


def test_probabilities_are_calibrated_under_the_prior():
    """Truths drawn from the prior of two rows, 400 times."""
    rng = np.random.default_rng(7)
    X = correlated_columns(rng, 60, 8)
    nothing, stated, holds, claimed = [], [], [], []
    for _ in range(400):
        rows = [c for c in rng.integers(8, size=2) if rng.random() > np.sqrt(0.5)]
        b = np.zeros(8)
        for c in rows:
            b[c] += 6 * rng.standard_normal()
        found = single_effects(
            *statistics(X, dict(enumerate(b)), rng), np.full(8, 36.0), singles(8), rows=2
        )
        nothing.append(not rows)
        stated.append(found.nothing_probability)
        holds += [bool(set(rows) & set(s.members)) for s in found.sets]
        claimed += [s.probability for s in found.sets]
    assert np.mean(stated) == pytest.approx(np.mean(nothing), abs=0.06)
    low = np.array(stated) <= 0.05
    assert low.sum() > 80 and np.mean(np.array(nothing)[low]) <= 0.05
    assert np.mean(holds) >= 0.95 * np.mean(claimed) - 0.02


def test_one_row_is_exact():
    rng = np.random.default_rng(8)
    X = correlated_columns(rng, 80, 7)
    u, information = statistics(X, {3: 3.0}, rng)
    items = [
        Item(0, 0.3, (0,)),
        Item(0, 0.7, (1, 2)),
        *(Item(c, 1.0, (c + 2,)) for c in range(1, 5)),
    ]
    prior = [1.0, 2.0, 1.0, 1.0, 0.5]
    found = single_effects(u, information, np.full(7, 9.0), items, rows=1, candidate_prior=prior)
    exact = enumerate_models(
        u, information, np.full(7, 9.0), items, max_effects=1, candidate_prior=prior
    )
    assert found.nothing_probability == pytest.approx(exact.counts[0], rel=1e-9)
    assert found.bound == pytest.approx(exact.log_evidence, abs=1e-9)
    np.testing.assert_allclose(found.inclusion, exact.inclusion, atol=1e-9)
    np.testing.assert_allclose(found.alpha.sum(axis=1) + found.null, 1.0)


@pytest.mark.parametrize("truth", [{}, {2: 3.0}, {2: 6.0}, {1: 4.0, 5: -4.0}])
def test_nothing_is_never_understated_and_the_bound_holds(truth):
    rng = np.random.default_rng(9)
    X = correlated_columns(rng, 80, 7)
    items = [Item(0, 0.5, (0,)), Item(0, 0.5, (1,)), *(Item(c, 1.0, (c + 1,)) for c in range(1, 6))]
    for _ in range(5):
        u, information = statistics(X, truth, rng)
        W = np.full(7, 25.0)
        found = single_effects(u, information, W, items, rows=2)
        evidence, nothing = exact_two_rows(u, information, W, items, np.full(6, 1 / 6))
        assert found.bound <= evidence + 1e-9 and found.bound > evidence - 1.5
        assert nothing - 1e-12 <= found.nothing_probability <= 2.2 * nothing


@pytest.mark.parametrize("size", [6.0, 8.0, 12.0])
def test_agrees_with_enumeration_where_one_effect_is_missing(size):
    rng = np.random.default_rng(10)
    X = correlated_columns(rng, 120, 12)
    for _ in range(10):
        args = (*statistics(X, {4: size}, rng), np.full(12, 36.0), singles(12))
        found, exact = single_effects(*args, rows=2), enumerate_models(*args)
        assert found.nothing_probability == pytest.approx(exact.counts[0], abs=0.02)
        np.testing.assert_allclose(found.inclusion, exact.inclusion, atol=0.12)
        assert found.inclusion.argmax() == exact.inclusion.argmax()


def test_weak_effects_are_understated_not_overstated():
    """Where nothing stands out the rows share what there is, on the cautious side."""
    rng = np.random.default_rng(10)
    X = correlated_columns(rng, 120, 12)
    for _ in range(20):
        args = (*statistics(X, {4: 2.0}, rng), np.full(12, 36.0), singles(12))
        found, exact = single_effects(*args, rows=2), enumerate_models(*args)
        assert (found.inclusion <= exact.inclusion + 0.02).all()
        assert 0 <= found.nothing_probability - exact.counts[0] < 0.06


def test_enumeration_adds_up_and_names_two():
    rng = np.random.default_rng(11)
    X = correlated_columns(rng, 120, 9)
    items = [
        Item(0, 0.5, (0,)),
        Item(0, 0.5, (1, 2)),
        *(Item(c, 1.0, (c + 2,)) for c in range(1, 7)),
    ]
    u, information = statistics(X, {4: 12.0, 7: -12.0}, rng)
    exact = enumerate_models(u, information, np.full(9, 64.0), items)
    assert next(iter(exact.models)) == (2, 5) and exact.counts.argmax() == 2
    assert exact.counts.sum() == pytest.approx(1) == sum(exact.models.values())
    assert len(exact.models) == 1 + 7 + 21
    three = enumerate_models(u, information, np.full(9, 64.0), items, max_effects=3)
    assert (2, 5) in three.models and len(three.models) == 1 + 7 + 21 + 35


# --- what must not matter ------------------------------------------------------------------------


def test_order_and_units_of_the_columns_do_not_matter():
    rng = np.random.default_rng(12)
    X = correlated_columns(rng, 100, 8)
    X[:, 6] = 2 * X[:, 2]
    u, information = statistics(X, {2: 7.0, 4: 7.0}, rng)
    W = np.full(8, 49.0)
    W[6] /= 4
    plain = single_effects(u, information, W, singles(8))
    order, unit = rng.permutation(8), 10.0 ** rng.integers(-9, 9, 8)
    moved = single_effects(
        (u * unit)[order],
        (information * np.outer(unit, unit))[np.ix_(order, order)],
        (W / unit**2)[order],
        singles(8),
    )
    assert moved.nothing_probability == pytest.approx(plain.nothing_probability, rel=1e-6)
    np.testing.assert_allclose(moved.inclusion, plain.inclusion[order], atol=1e-5)
    np.testing.assert_allclose(moved.mean, (plain.mean / unit)[order], rtol=1e-3)
    sets = {frozenset(order[list(s.members)].tolist()) for s in moved.sets}
    assert sets == {frozenset(s.members) for s in plain.sets} and frozenset({2, 6}) in sets


def test_the_same_question_gets_the_same_answer():
    rng = np.random.default_rng(13)
    X = correlated_columns(rng, 100, 8)
    args = (*statistics(X, {2: 5.0}, rng), np.full(8, 49.0), singles(8))
    first, second = single_effects(*args), single_effects(*args)
    assert first.sets == second.sets and (first.alpha == second.alpha).all()


def test_more_sweeps_raise_the_bound_and_too_few_are_admitted():
    rng = np.random.default_rng(14)
    X = correlated_columns(rng, 100, 8)
    args = (*statistics(X, {2: 5.0, 3: 5.0}, rng), np.full(8, 49.0), singles(8))
    fits = [single_effects(*args, max_iterations=n) for n in (1, 2, 3, 1000)]
    assert [f.converged for f in fits] == [False, False, False, True]
    assert all(np.diff([f.bound for f in fits]) >= -1e-9)


# --- what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"score": [1.0]}, "must agree"),
        ({"score": [1.0, np.nan]}, r"score is not finite at \[1\]"),
        ({"prior_variance": [1.0, np.inf]}, "every prior must be proper"),
        ({"prior_variance": [1.0, -1.0]}, "negative at 1"),
        ({"information": [[1.0, 0.5], [0.0, 1.0]]}, "not symmetric"),
        ({"items": []}, "no items"),
        ({"items": [Item(0, 1.0, (2,))]}, r"Item 0 of candidate 0 .* within 0 ... 1"),
        ({"items": [Item(0, 1.0, (0, 0))]}, "distinct"),
        ({"items": [Item(0, 0.5, (0,)), Item(1, 1.0, (1,))]}, "sum to one"),
        ({"candidate_prior": [1.0]}, "needs 2 weights"),
        ({"nothing_prior": 1.0}, "between 0 and 1"),
        ({"rows": 0}, "start at 1"),
    ],
)
def test_what_makes_no_problem_is_refused(change, message):
    good = {
        "score": [1.0, 2.0],
        "information": np.eye(2),
        "prior_variance": [1.0, 1.0],
        "items": singles(2),
    }
    with pytest.raises(InputError, match=message):
        single_effects(**(good | change))


def test_enumeration_refuses_what_it_cannot_afford():
    with pytest.raises(InputError, match="thin the shape grids"):
        enumerate_models(np.zeros(200), np.eye(200), np.ones(200), singles(200), max_effects=4)
    with pytest.raises(InputError, match="max_effects"):
        enumerate_models(np.zeros(2), np.eye(2), np.ones(2), singles(2), max_effects=0)
