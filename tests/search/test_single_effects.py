"""The sum of single effects names what is missing and says what it cannot tell apart."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from bayescal._discovery.susie import Item, log_bayes_factor, single_effects
from tests.support.single_effects import correlated_columns, singles, statistics

# --- the Bayes factor of a group -----------------------------------------------------------------


@pytest.mark.parametrize("columns", [1, 2, 4])
def test_group_factor_is_the_ratio_of_normal_evidences(columns):
    rng = np.random.default_rng(columns)
    X, y = rng.standard_normal((30, columns)), rng.standard_normal(30)
    W = rng.uniform(0.1, 9, columns)
    covariance = np.eye(30) + (X * W) @ X.T
    evidence = multivariate_normal.logpdf(y, np.zeros(30), covariance)
    nothing = multivariate_normal.logpdf(y, np.zeros(30), np.eye(30))  # pyright: ignore[reportArgumentType]
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
