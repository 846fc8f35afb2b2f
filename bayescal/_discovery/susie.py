"""The sum of single effects: which few of many candidate effects do the readings ask for?

The unknown coefficients b are a sum of L rows; a row is nothing, or exactly one *item*: one
candidate at one grid point of its shape. The readings enter only through the efficient score u and
information I, every nuisance marginalised and the noise scaled to one, so that u ~ N(I b, I).
Inside, each column is multiplied by its prior standard deviation: priors are then standard normal,
and no answer depends on the unit in which an effect is reported.

Sources: Wang, Sarkar, Carbonetto & Stephens (2020), J. R. Stat. Soc. B 82, for the model, its
coordinate ascent and its credible sets; Zou, Carbonetto, Wang & Stephens (2022), PLoS Genetics 18,
for the form in sufficient statistics. Added here: groups of columns, shape grids, a null in each
row, fixed prior scales, the bound on P(nothing), and sets that imply each other told once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayescal._core.errors import InputError
from bayescal._diagnostics.group_bayes_factor import Array, Blocks, Problem, make_problem, row_null
from bayescal._diagnostics.group_bayes_factor import Enumeration as Enumeration
from bayescal._diagnostics.group_bayes_factor import Item as Item
from bayescal._diagnostics.group_bayes_factor import enumerate_models as enumerate_models
from bayescal._diagnostics.group_bayes_factor import log_bayes_factor as log_bayes_factor

COVERAGE = 0.95  # part of a row's non-null probability that its set must hold
MIN_PURITY = 0.5
MAX_NULL = 0.5  # a row that is more probably nothing gives no set
TIE = 1e-6  # relative difference within which two members are equally likely
ALIAS = 1 - 1e-6  # cosine from which two contributions are one and the same
BETTER = 1e-3  # nats; two ascents closer than this reached the same optimum


@dataclass(frozen=True)
class CredibleSet:
    """One of these candidates is missing; the data cannot tell which.

    Attributes:
        members: candidate indices, the likeliest first.
        shares: probability of each member, given that the row holds an effect at all.
        probability: that the row holds an effect.
        purity: smallest absolute cosine between two members' fitted contributions.
        aliases: candidates outside the set that no reading could tell from its first member;
            their prior size or weight alone speaks against them.
        row: the row of `SingleEffects.alpha` that the set was read from.
    """

    members: tuple[int, ...]
    shares: tuple[float, ...]
    probability: float
    purity: float
    aliases: tuple[int, ...]
    row: int


@dataclass(frozen=True)
class SingleEffects:
    """Posterior of the sum of single effects: L rows, n items, C candidates, P columns.

    Attributes:
        alpha: (L, n) probability that the row holds the item.
        null: (L,) probability that the row holds nothing.
        inclusion: (C,) probability that a candidate stands in at least one row; too low for weak
            effects, which the rows share (0.21 for an exact 0.34 in one trial).
        nothing_probability: upper bound on P(nothing is missing); exact for L = 1.
        sets: the findings, the most probable first.
        unresolved: sets whose members are too unlike to be named as one finding.
        coefficients: (L, C, P) posterior mean given that the row holds the candidate, in the
            coefficients' own units.
        mean: (P,) posterior mean of the sum of the rows, in the same units.
        bound: lower bound on log p(u) - log p(u | nothing), in nats.
        converged: whether the weights settled within the iterations allowed.
        iterations: sweeps over the rows in the ascent that was kept.
    """

    alpha: Array
    null: Array
    inclusion: Array
    nothing_probability: float
    sets: tuple[CredibleSet, ...]
    unresolved: tuple[CredibleSet, ...]
    coefficients: Array
    mean: Array
    bound: float
    converged: bool
    iterations: int


@dataclass(frozen=True)
class _Fit:
    log_alpha: Array  # (L, n)
    null: Array  # (L,)
    means: Array  # (L, P + 1)
    fitted: Array  # (L, n, m)
    bound: float
    converged: bool
    iterations: int


def single_effects(
    score: ArrayLike,
    information: ArrayLike,
    prior_variance: ArrayLike,
    items: Sequence[Item],
    *,
    rows: int = 5,
    candidate_prior: ArrayLike | None = None,
    nothing_prior: float = 0.5,
    tolerance: float = 1e-6,
    max_iterations: int = 1000,
) -> SingleEffects:
    """Fit the sum of single effects and read its credible sets.

    Each row in turn is updated on what the others leave, until no weight moves. P(nothing) is its
    prior over the evidence. The evidence has two lower bounds, the ascent's and the exact sum over
    models of at most one effect; the larger serves, so that P(nothing) is never understated.

    Args:
        score: u, (P,), in one over the unit of each coefficient.
        information: I, (P, P), symmetric and positive semi-definite.
        prior_variance: W, (P,), prior variance of each coefficient, squared unit; never estimated.
        items: grid points of the candidates 0 ... C-1; weights sum to one in each candidate.
        rows: L, the most effects that may be missing.
        candidate_prior: (C,) relative prior weights of the candidates; equal by default.
        nothing_prior: prior probability that nothing is missing; each row has its L-th root.
        tolerance: a sweep that moves no weight by more has settled.
        max_iterations: most sweeps in one ascent.

    Raises:
        InputError: the shapes, numbers, indices or probabilities do not make a problem.

    Source: Wang et al. (2020); Zou et al. (2022).
    """
    if rows < 1 or max_iterations < 1:
        raise InputError(f"'rows' ({rows}) and 'max_iterations' ({max_iterations}) start at 1.")
    null = row_null(nothing_prior, rows)
    problem = make_problem(score, information, prior_variance, items, candidate_prior)
    blocks = Blocks(problem.information, problem.columns)
    fit = _search(problem, blocks, rows, null, tolerance, max_iterations)
    mean_factor = np.logaddexp.reduce(problem.log_prior + blocks.effects(problem.score)[0])
    one = np.log(rows * (1 - null)) + (rows - 1) * np.log(null) + mean_factor
    log_evidence = max(fit.bound, np.logaddexp(np.log(nothing_prior), one))
    alpha = np.exp(fit.log_alpha)
    sets = _read_sets(problem, fit)
    return SingleEffects(
        alpha=alpha,
        null=fit.null,
        inclusion=1 - np.prod(1 - np.minimum(alpha @ problem.member, 1), axis=0),
        nothing_probability=min(1.0, float(nothing_prior * np.exp(-log_evidence))),
        sets=_told_once([s for s in sets if s.purity >= MIN_PURITY]),
        unresolved=_told_once([s for s in sets if s.purity < MIN_PURITY]),
        coefficients=(_given_candidate(problem, fit) * problem.scale)[..., :-1],
        mean=(fit.means.sum(axis=0) * problem.scale)[:-1],
        bound=fit.bound,
        converged=fit.converged,
        iterations=fit.iterations,
    )


def _search(
    problem: Problem, blocks: Blocks, rows: int, null: float, tolerance: float, most: int
) -> _Fit:
    """The best of several ascents.

    One ascent can stop at a neighbour of two true effects. It is begun again from the answer that
    is reached without the members of a set, for each set, as long as the bound rises.
    """
    empty = np.zeros((rows, problem.score.size))

    def ascend(start: Array, without: tuple[int, ...] = ()) -> _Fit:
        banned = problem.member[:, list(without)].any(axis=1)
        log_prior = np.log1p(-null) + np.where(banned, -np.inf, problem.log_prior)
        return _ascend(problem, blocks, log_prior, float(np.log(null)), start, tolerance, most)

    best, risen = ascend(empty), True
    while risen:
        again = [ascend(ascend(empty, s.members).means) for s in _read_sets(problem, best)]
        top = max(again, key=lambda fit: fit.bound, default=best)
        risen = top.bound > best.bound + BETTER
        best = top if risen else best
    return best


def _ascend(
    problem: Problem,
    blocks: Blocks,
    log_prior: Array,
    log_null: float,
    start: Array,
    tolerance: float,
    most: int,
) -> _Fit:
    """Coordinate ascent over the rows, from the means `start`."""
    means, rows = start.copy(), len(start)
    log_alpha, null = np.full((rows, len(log_prior)), -np.inf), np.ones(rows)
    fitted = np.zeros((rows, *problem.columns.shape))
    energy, divergence = np.zeros(rows), np.zeros(rows)
    settled, sweep = False, 0
    while not settled and sweep < most:
        sweep += 1
        before = np.exp(log_alpha)
        for row in range(rows):
            residual = problem.score - problem.information @ (means.sum(axis=0) - means[row])
            log_factor, fitted[row], energies = blocks.effects(residual)
            total = np.logaddexp(log_null, np.logaddexp.reduce(log_prior + log_factor))
            log_alpha[row], null[row] = log_prior + log_factor - total, np.exp(log_null - total)
            alpha = np.exp(log_alpha[row])
            means[row] = 0.0
            np.add.at(means[row], problem.columns, alpha[:, None] * fitted[row])
            energy[row] = alpha @ energies
            divergence[row] = means[row] @ residual - energy[row] / 2 - total
        settled = float(np.abs(np.exp(log_alpha) - before).max()) < tolerance
    both = means.sum(axis=0)
    spread = energy - np.einsum("lp,pq,lq->l", means, problem.information, means)
    misfit = both @ problem.information @ both + spread.sum()
    bound = float(problem.score @ both - misfit / 2 - divergence.sum())
    return _Fit(
        log_alpha=log_alpha,
        null=null,
        means=means,
        fitted=fitted,
        bound=bound,
        converged=settled,
        iterations=sweep,
    )


def _given_candidate(problem: Problem, fit: _Fit) -> Array:
    """Mean coefficients (L, C, P + 1) of each row given each candidate, shapes averaged."""
    owner = problem.member.argmax(axis=1)
    mean = np.zeros((len(fit.null), len(problem.member.T), problem.score.size))
    for row, log_alpha in enumerate(fit.log_alpha):
        peak = np.where(problem.member.T > 0, log_alpha, -np.inf).max(axis=1)
        part = np.exp(log_alpha - np.where(np.isfinite(peak), peak, 0.0)[owner])
        part /= np.maximum(part @ problem.member, np.finfo(float).tiny)[owner]
        np.add.at(mean[row], (owner[:, None], problem.columns), part[:, None] * fit.fitted[row])
    return mean


def _read_sets(problem: Problem, fit: _Fit) -> list[CredibleSet]:
    """The credible set of every row that is not mostly null, the most probable first."""
    means, sets = _given_candidate(problem, fit), []
    for row in np.flatnonzero(fit.null < MAX_NULL).tolist():
        share = np.exp(fit.log_alpha[row]) @ problem.member
        share /= share.sum()
        order = np.argsort(-share, kind="stable")
        last = order[min(np.searchsorted(np.cumsum(share[order]), COVERAGE), len(order) - 1)]
        members = np.flatnonzero(share >= share[last] * (1 - TIE)).tolist()
        members.sort(key=lambda c: (-round(share[c], 6), c))
        gram = means[row] @ problem.information @ means[row].T
        norm = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
        cosine = np.abs(gram / np.outer(norm, norm))
        alike = np.flatnonzero(cosine[members[0]] >= ALIAS).tolist()
        sets.append(
            CredibleSet(
                members=tuple(members),
                shares=tuple(share[members].tolist()),
                probability=1 - float(fit.null[row]),
                purity=float(cosine[np.ix_(members, members)].min()) if len(members) > 1 else 1.0,
                aliases=tuple(c for c in alike if c not in members),
                row=row,
            )
        )
    return sorted(sets, key=lambda s: (-s.probability, s.row))


def _told_once(sets: list[CredibleSet]) -> tuple[CredibleSet, ...]:
    """Leave out a set that repeats another, or that holds another: the narrower one implies it."""
    names = [frozenset(s.members) for s in sets]
    return tuple(
        s
        for i, s in enumerate(sets)
        if not any(o < names[i] or (o == names[i] and j < i) for j, o in enumerate(names))
    )
