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
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp

from bayescal._errors import InputError

Array = NDArray[np.float64]
Index = NDArray[np.intp]

COVERAGE = 0.95  # part of a row's non-null probability that its set must hold
MIN_PURITY = 0.5
MAX_NULL = 0.5  # a row that is more probably nothing gives no set
TIE = 1e-6  # relative difference within which two members are equally likely
ALIAS = 1 - 1e-6  # cosine from which two contributions are one and the same
BETTER = 1e-3  # nats; two ascents closer than this reached the same optimum
INVISIBLE = 1e-12  # I·W of a direction below this: its prior spread is lost in its uncertainty
ROUNDING = 64 * float(np.finfo(float).eps)  # below this part of its group, only rounding
MOST_MODELS = 1_000_000


@dataclass(frozen=True)
class Item:
    """One candidate at one grid point of its shape: its share of the grid and its columns."""

    candidate: int
    weight: float
    columns: tuple[int, ...]


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
class Enumeration:
    """Exact posterior over all models of few distinct candidates.

    Attributes:
        counts: (K + 1,) probability of none, one, ... K effects.
        inclusion: (C,) probability that a candidate is in the model.
        models: the candidates of a model -> its probability, the likeliest first.
        log_evidence: log p(u) - log p(u | nothing), in nats.
    """

    counts: Array
    inclusion: Array
    models: dict[tuple[int, ...], float]
    log_evidence: float


@dataclass(frozen=True)
class _Problem:
    """The statistics under unit priors; a last column of zeros pads the narrow items."""

    score: Array  # (P + 1,)
    information: Array  # (P + 1, P + 1)
    scale: Array  # (P + 1,) prior standard deviations
    columns: Index  # (n, m)
    member: Array  # (n, C) one where the item belongs to the candidate
    log_prior: Array  # (n,) log of candidate prior times grid weight


@dataclass(frozen=True)
class _Fit:
    log_alpha: Array  # (L, n)
    null: Array  # (L,)
    means: Array  # (L, P + 1)
    fitted: Array  # (L, n, m)
    bound: float
    converged: bool
    iterations: int


class _Blocks:
    """Each item's own information, factored once; answers for any residual score."""

    def __init__(self, information: Array, columns: Index) -> None:
        self.columns = columns
        values, self.vectors = np.linalg.eigh(information[columns[:, :, None], columns[:, None]])
        floor = np.maximum(INVISIBLE, ROUNDING * values[:, -1:])
        self.values = np.where(values > floor, values, 0.0)

    def effects(self, score: Array) -> tuple[Array, Array, Array]:
        """Log Bayes factor (n,), mean (n, m) and E[b'Ib] (n,) of every item on its own."""
        along = np.einsum("nij,ni->nj", self.vectors, score[self.columns])
        along = np.where(self.values > 0, along, 0.0)
        mean = along / (1 + self.values)
        log_factor = 0.5 * np.sum(along * mean - np.log1p(self.values), axis=1)
        energy = np.sum(self.values * (mean**2 + 1 / (1 + self.values)), axis=1)
        return log_factor, np.einsum("nij,nj->ni", self.vectors, mean), energy


def log_bayes_factor(score: ArrayLike, information: ArrayLike, prior_variance: ArrayLike) -> float:
    """Log Bayes factor of one group of columns against nothing, in nats.

    It is ½ u'(W⁻¹ + I)⁻¹u - ½ log|1 + IW|. A direction without information counts nothing, so that
    zero and linearly dependent columns are allowed. Arguments and refusals: `single_effects`.
    """
    whole = Item(0, 1.0, tuple(range(np.size(score))))
    problem = _problem(score, information, prior_variance, [whole], None)
    return float(_Blocks(problem.information, problem.columns).effects(problem.score)[0][0])


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
    null = _row_null(nothing_prior, rows)
    problem = _problem(score, information, prior_variance, items, candidate_prior)
    blocks = _Blocks(problem.information, problem.columns)
    fit = _search(problem, blocks, rows, null, tolerance, max_iterations)
    mean_factor = logsumexp(problem.log_prior + blocks.effects(problem.score)[0])
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


def enumerate_models(
    score: ArrayLike,
    information: ArrayLike,
    prior_variance: ArrayLike,
    items: Sequence[Item],
    *,
    max_effects: int = 2,
    candidate_prior: ArrayLike | None = None,
    nothing_prior: float = 0.5,
) -> Enumeration:
    """Exact posterior over every model of at most `max_effects` distinct candidates.

    The number of effects has the binomial prior of `single_effects` with as many rows; given the
    number, a model's prior is proportional to the product of its candidates' priors; shapes are
    averaged. It costs one small factorisation per combination of items. Arguments as there.

    Raises:
        InputError: as `single_effects`, or there are no or more than a million combinations.
    """
    problem = _problem(score, information, prior_variance, items, candidate_prior)
    size = min(max_effects, int(problem.member[np.isfinite(problem.log_prior)].any(axis=0).sum()))
    number = sum(comb(len(items), k) for k in range(1, size + 1))
    if not 1 <= number <= MOST_MODELS:
        raise InputError(
            f"Up to {max_effects} effects of {len(items)} items make {number:,} combinations, "
            f"not 1 to {MOST_MODELS:,}: change 'max_effects' or thin the shape grids."
        )
    null = _row_null(nothing_prior, size)
    owner = problem.member.argmax(axis=1)
    models: list[tuple[int, ...]] = [()]
    weights = [np.log([nothing_prior])]
    for k in range(1, size + 1):
        chosen = np.array(list(combinations(range(len(items)), k)), dtype=np.intp)
        owners = np.sort(owner[chosen], axis=1)
        distinct = np.all(np.diff(owners, axis=1) > 0, axis=1)
        chosen, prior = chosen[distinct], problem.log_prior[chosen[distinct]].sum(axis=1)
        count = np.log(comb(size, k)) + k * np.log1p(-null) + (size - k) * np.log(null)
        weights.append(count + prior - logsumexp(prior) + _joint_factors(problem, chosen))
        models.extend(map(tuple, owners[distinct].tolist()))
    log_evidence = float(logsumexp(np.concatenate(weights)))
    posterior = dict.fromkeys(models, 0.0)
    for model, p in zip(models, np.exp(np.concatenate(weights) - log_evidence), strict=True):
        posterior[model] += float(p)
    counts, inclusion = np.zeros(size + 1), np.zeros(problem.member.shape[1])
    for model, p in posterior.items():
        counts[len(model)] += p
        inclusion[list(model)] += p
    ranked = dict(sorted(posterior.items(), key=lambda entry: (-entry[1], entry[0])))
    return Enumeration(counts, inclusion, ranked, log_evidence)


def _joint_factors(problem: _Problem, chosen: Index) -> Array:
    """Log Bayes factors (N,) of combinations (N, k) of items, in bounded memory."""
    columns = np.sort(problem.columns[chosen].reshape(len(chosen), -1), axis=1)  # padding last
    widths = (columns < problem.score.size - 1).sum(axis=1)
    factors = np.zeros(len(chosen))
    for width in np.unique(widths):
        alike = np.flatnonzero(widths == width)
        for part in np.array_split(alike, 1 + alike.size * int(width) ** 2 // 2_000_000):
            blocks = _Blocks(problem.information, columns[part, :width])
            factors[part] = blocks.effects(problem.score)[0]
    return factors


def _row_null(nothing_prior: float, rows: int) -> float:
    if not 0 < nothing_prior < 1:
        raise InputError(f"'nothing_prior' must lie between 0 and 1, got {nothing_prior}.")
    return nothing_prior ** (1 / rows)


def _problem(
    score: ArrayLike,
    information: ArrayLike,
    prior_variance: ArrayLike,
    items: Sequence[Item],
    candidate_prior: ArrayLike | None,
) -> _Problem:
    """Check everything and bring it to unit priors."""
    u, full, variance = (np.asarray(a, float) for a in (score, information, prior_variance))
    p = u.size
    if (u.shape, full.shape, variance.shape) != ((p,), (p, p), (p,)):
        raise InputError(
            "Score (P,), information (P, P) and prior variance (P,) must agree; their shapes are "
            f"{u.shape}, {full.shape} and {variance.shape}."
        )
    for name, array in (("score", u), ("information", full), ("prior variance", variance)):
        if not np.isfinite(array).all():
            where = np.argwhere(~np.isfinite(array))[0].tolist()
            raise InputError(f"The {name} is not finite at {where}: every prior must be proper.")
    if (variance < 0).any():
        raise InputError(f"The prior variance is negative at {int(variance.argmin())}.")
    scale = np.append(np.sqrt(variance), 0.0)
    unit = scale[:, None] * np.pad(full, (0, 1)) * scale
    if not np.allclose(unit, unit.T, rtol=0, atol=1e-6 * max(1.0, np.abs(unit).max())):
        raise InputError("The information is not symmetric: give X'V⁻¹X.")
    member, log_prior = _prior(items, p, candidate_prior)
    columns = np.full((len(items), max(len(item.columns) for item in items)), p, dtype=np.intp)
    for row, item in zip(columns, items, strict=True):
        row[: len(item.columns)] = item.columns
    return _Problem(
        np.append(u, 0.0) * scale, (unit + unit.T) / 2, scale, columns, member, log_prior
    )


def _prior(items: Sequence[Item], p: int, candidate_prior: ArrayLike | None) -> tuple[Array, Array]:
    """Membership (n, C) and log prior (n,) of the items."""
    if not items:
        raise InputError("There are no items: give at least one candidate.")
    for i, item in enumerate(items):
        inside = item.candidate >= 0 and all(0 <= column < p for column in item.columns)
        if not inside or not 1 <= len(set(item.columns)) == len(item.columns):
            raise InputError(
                f"Item {i} of candidate {item.candidate} has the columns {item.columns}: they "
                f"must be distinct, at least one, and within 0 ... {p - 1}."
            )
    owner = np.array([item.candidate for item in items])
    member = (owner[:, None] == np.arange(owner.max() + 1)).astype(float)
    weight = np.array([item.weight for item in items], float)
    if (weight < 0).any() or not np.allclose(weight @ member, 1.0, rtol=0, atol=1e-6):
        raise InputError(
            "Grid weights must not be negative and must sum to one in each candidate; here they "
            f"sum to {(weight @ member).tolist()}."
        )
    prior = np.asarray(
        np.ones(len(member.T)) if candidate_prior is None else candidate_prior, float
    )
    if prior.shape != (len(member.T),) or not (prior >= 0).all() or not 0 < prior.sum() < np.inf:
        raise InputError(
            f"The candidate prior needs {len(member.T)} weights, none negative, not all zero; got "
            f"{prior.tolist()}."
        )
    with np.errstate(divide="ignore"):  # a weight of zero shuts an item out
        return member, np.log(prior[owner] / prior.sum()) + np.log(weight)


def _search(
    problem: _Problem, blocks: _Blocks, rows: int, null: float, tolerance: float, most: int
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
    problem: _Problem,
    blocks: _Blocks,
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
            total = np.logaddexp(log_null, logsumexp(log_prior + log_factor))
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
    return _Fit(log_alpha, null, means, fitted, bound, settled, sweep)


def _given_candidate(problem: _Problem, fit: _Fit) -> Array:
    """Mean coefficients (L, C, P + 1) of each row given each candidate, shapes averaged."""
    owner = problem.member.argmax(axis=1)
    mean = np.zeros((len(fit.null), len(problem.member.T), problem.score.size))
    for row, log_alpha in enumerate(fit.log_alpha):
        peak = np.where(problem.member.T > 0, log_alpha, -np.inf).max(axis=1)
        part = np.exp(log_alpha - np.where(np.isfinite(peak), peak, 0.0)[owner])
        part /= np.maximum(part @ problem.member, np.finfo(float).tiny)[owner]
        np.add.at(mean[row], (owner[:, None], problem.columns), part[:, None] * fit.fitted[row])
    return mean


def _read_sets(problem: _Problem, fit: _Fit) -> list[CredibleSet]:
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
