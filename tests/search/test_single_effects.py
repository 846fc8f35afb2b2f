"""The sum of single effects names what is missing and says what it cannot tell apart."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from bayescal._core.errors import InputError
from bayescal._discovery.susie import Item, enumerate_models, log_bayes_factor, single_effects


def singles(count: int) -> list[Item]:
    return [Item(i, 1.0, (i,)) for i in range(count)]


def correlated_columns(rng: np.random.Generator, readings: int, count: int) -> np.ndarray:
    """Columns of unit length; neighbours correlate by about a half."""
    columns = rng.standard_normal((readings, count + 1))
    columns = columns[:, 1:] + columns[:, :-1]
    return columns / np.linalg.norm(columns, axis=0)


def statistics(X: np.ndarray, truth: dict[int, float], rng: np.random.Generator):
    """Score and information of columns X for unit white noise and the true coefficients."""
    y = sum((b * X[:, c] for c, b in truth.items()), rng.standard_normal(len(X)))
    return X.T @ y, X.T @ X


def exact_two_rows(u, I, W, items, prior, nothing_prior=0.5):  # noqa: E741
    """Log evidence and P(nothing) of the model with two rows, by summing over all row contents."""
    null = np.sqrt(nothing_prior)
    contents = [
        ((), null),
        *(((i.columns), (1 - null) * prior[i.candidate] * i.weight) for i in items),
    ]
    terms = []
    for (a, p), (b, q) in product(contents, contents):
        c = [*a, *b]
        terms.append(np.log(p * q) + (log_bayes_factor(u[c], I[np.ix_(c, c)], W[c]) if c else 0.0))
    evidence = logsumexp(terms)
    return evidence, nothing_prior * np.exp(-evidence)


# --- the Bayes factor of a group -----------------------------------------------------------------


@pytest.mark.parametrize("columns", [1, 2, 4])
def test_group_factor_is_the_ratio_of_normal_evidences(columns):
    rng = np.random.default_rng(columns)
    X, y = rng.standard_normal((30, columns)), rng.standard_normal(30)
    W = rng.uniform(0.1, 9, columns)
    evidence = multivariate_normal(np.zeros(30), np.eye(30) + (X * W) @ X.T).logpdf(y)
    nothing = multivariate_normal(np.zeros(30), np.eye(30)).logpdf(y)
    assert log_bayes_factor(X.T @ y, X.T @ X, W) == pytest.approx(evidence - nothing, abs=1e-9)


def test_columns_without_information_count_nothing():
    assert log_bayes_factor([0.0], [[0.0]], [4.0]) == 0.0
    assert log_bayes_factor([1e-17], [[0.0]], [1e30]) == 0.0  # what rounding leaves of a score
    assert log_bayes_factor([3.0], [[1.0]], [0.0]) == 0.0
    alone = log_bayes_factor([3.0], [[1.0]], [4.0])
    assert log_bayes_factor([3.0, 0.0], [[1.0, 0.0], [0.0, 0.0]], [4.0, 4.0]) == pytest.approx(
        alone
    )


def test_nearly_dependent_columns_of_a_group_behave_as_one():
    rng = np.random.default_rng(3)
    x, y = rng.standard_normal((2, 50))
    one = log_bayes_factor([x @ y], [[x @ x]], [2.0])
    for step in (0.0, 1e-13, 1e-9):
        X = np.stack([x, x + step * rng.standard_normal(50)], axis=1)
        assert log_bayes_factor(X.T @ y, X.T @ X, [1.0, 1.0]) == pytest.approx(one, abs=1e-5)


def test_invisible_candidates_keep_their_prior_and_spoil_nothing():
    u, information = np.array([8.0, 0.0, 0.0]), np.diag([1.0, 0.0, 0.0])
    found = single_effects(u, information, np.full(3, 25.0), [Item(0, 1, (0,)), Item(1, 1, (1, 2))])
    assert [s.members for s in found.sets] == [(0,)]
    assert np.isfinite(found.alpha).all() and np.isfinite(found.coefficients).all()
    quiet = single_effects(np.zeros(3), 0 * information, np.full(3, 25.0), singles(3))
    assert quiet.nothing_probability == pytest.approx(0.5, abs=0.02) and not quiet.sets


# --- what is found -------------------------------------------------------------------------------


def test_one_strong_effect_is_found_with_its_size():
    rng = np.random.default_rng(0)
    X = correlated_columns(rng, 200, 20)
    u, information = statistics(X, {7: 12.0}, rng)
    found = single_effects(u, information, np.full(20, 100.0), singles(20))
    (only,) = found.sets
    assert only.members == (7,) and only.purity == 1.0 and only.probability > 0.999
    assert found.converged and found.nothing_probability < 1e-10
    assert found.inclusion[7] > 0.999 and np.delete(found.inclusion, 7).max() < 0.1
    assert found.mean[7] == pytest.approx(12, abs=3)
    assert found.coefficients[only.row, 7, 7] == pytest.approx(12, abs=3)


def test_two_effects_and_the_neighbour_of_both():
    """The neighbour alone has the largest z; it must not be named without one of the two."""
    rng = np.random.default_rng(1)
    named, findings = 0, 0
    for _ in range(40):
        a, b, other = rng.standard_normal((3, 200))
        X = np.column_stack([a, b, a + b + 0.9 * other, rng.standard_normal((200, 6))])
        X /= np.linalg.norm(X, axis=0)
        u, information = statistics(X, {0: 10.0, 1: 10.0}, rng)
        assert abs(u[2]) > 9
        found = single_effects(u, information, np.full(9, 100.0), singles(9))
        assert all({0, 1} & set(s.members) for s in found.sets)
        named += sum({0, 1} <= set().union(*(s.members for s in found.sets)) for _ in [0])
        findings += len(found.sets)
    assert named >= 38 and findings <= 82


@pytest.mark.parametrize("factor", [1.0, -3e-4])
def test_an_exact_alias_gives_one_set_of_two_equals(factor):
    rng = np.random.default_rng(2)
    X = correlated_columns(rng, 100, 6)
    X[:, 4] = factor * X[:, 1]
    W = np.full(6, 64.0)
    W[4] = 64.0 / factor**2
    found = single_effects(*statistics(X, {1: 9.0}, rng), W, singles(6))
    (only,) = found.sets
    assert only.members == (1, 4)
    assert only.shares[0] == pytest.approx(only.shares[1], abs=1e-6)
    assert only.purity == pytest.approx(1.0)


def test_many_aliases_are_all_named():
    """With thirty equals a coverage of 0.95 would leave one out at random."""
    found = single_effects(np.full(30, 9.0), np.ones((30, 30)), np.full(30, 36.0), singles(30))
    (only,) = found.sets
    assert only.members == tuple(range(30))


def test_an_alias_that_only_its_prior_speaks_against_is_mentioned():
    found = single_effects(
        [30.0, 30.0, 0.0],
        np.kron(np.diag([1, 0]), np.ones((2, 2)))[:3, :3],
        [900.0, 1.0, 1.0],
        singles(3),
    )
    assert found.sets[0].members == (0,) and found.sets[0].aliases == (1,)


def test_an_effect_far_larger_than_its_prior_is_told_once():
    """Several rows share it then; they are one finding."""
    information = np.eye(5)
    information[0, 1] = information[1, 0] = 0.9
    found = single_effects(information[0] * 50.0, information, np.full(5, 4.0), singles(5))
    assert (found.null < 0.5).sum() > 1
    assert [s.members for s in found.sets] == [(0,)]


def test_unlike_members_are_unresolved_not_named():
    found = single_effects([5.0, 5.0], np.eye(2) * 1.0, [25.0, 25.0], singles(2), rows=1)
    assert not found.sets
    assert found.unresolved[0].members == (0, 1) and found.unresolved[0].purity < 0.01


def test_shape_grid_finds_the_shape_and_pays_for_it_once():
    rng = np.random.default_rng(4)
    t = np.linspace(0, 1, 150)
    X = np.column_stack([1 - np.exp(-t / tau) for tau in (0.02, 0.1, 0.5, 2.0)] + [np.cos(9 * t)])
    X /= np.linalg.norm(X, axis=0)
    items = [*(Item(0, 0.25, (i,)) for i in range(4)), Item(1, 1.0, (4,))]
    u, information = statistics(X - X.mean(axis=0), {1: 30.0}, rng)
    found = single_effects(u, information, np.full(5, 400.0), items)
    assert found.sets[0].members == (0,)
    assert found.alpha[found.sets[0].row, :4].argmax() == 1
    # the same column four times over is the same candidate as once
    same = [*(Item(0, 0.25, (0,)) for i in range(4)), Item(1, 1.0, (4,))]
    once = [Item(0, 1.0, (0,)), Item(1, 1.0, (4,))]
    many, one = (single_effects(u, information, np.full(5, 400.0), it) for it in (same, once))
    assert many.nothing_probability == pytest.approx(one.nothing_probability, rel=1e-6)
    np.testing.assert_allclose(many.inclusion, one.inclusion, atol=1e-5)
    np.testing.assert_allclose(many.coefficients, one.coefficients, atol=1e-3)


@pytest.mark.parametrize("phase", [0.0, 0.8, 2.5])
def test_a_group_is_found_at_any_phase(phase):
    rng = np.random.default_rng(5)
    x = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    X = np.column_stack([f(m * x) for m in (1, 2, 3) for f in (np.cos, np.sin)]) / 6
    items = [Item(m, 1.0, (2 * m, 2 * m + 1)) for m in range(3)]
    truth = {2: 8 * np.cos(phase), 3: 8 * np.sin(phase)}
    found = single_effects(*statistics(X, truth, rng), np.full(6, 40.0), items)
    assert [s.members for s in found.sets] == [(1,)]
    np.testing.assert_allclose(found.mean[2:4], [truth[2], truth[3]], atol=3)


def test_candidate_prior_weighs_and_zero_shuts_out():
    u, information, W = np.full(2, 9.0), np.ones((2, 2)), np.full(2, 36.0)
    weighed = single_effects(u, information, W, singles(2), candidate_prior=[3.0, 1.0])
    np.testing.assert_allclose(weighed.sets[0].shares, [0.75, 0.25], atol=1e-6)
    shut = single_effects(u, information, W, singles(2), candidate_prior=[0.0, 1.0])
    assert shut.sets[0].members == (1,) and shut.inclusion[0] == 0


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
