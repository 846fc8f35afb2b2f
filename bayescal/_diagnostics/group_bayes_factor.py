"""Groups of candidate columns: their Bayes factors, and every model of a few of them.

Inside, each column is multiplied by its prior standard deviation: priors are then standard normal,
and no answer depends on the unit in which an effect is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayescal._core.errors import InputError

Array = NDArray[np.float64]
Index = NDArray[np.intp]

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
class Problem:
    """The statistics under unit priors; a last column of zeros pads the narrow items."""

    score: Array  # (P + 1,)
    information: Array  # (P + 1, P + 1)
    scale: Array  # (P + 1,) prior standard deviations
    columns: Index  # (n, m)
    member: Array  # (n, C) one where the item belongs to the candidate
    log_prior: Array  # (n,) log of candidate prior times grid weight


class Blocks:
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
    u, unit, _ = _in_prior_units(score, information, prior_variance)
    return float(Blocks(unit, np.arange(u.size)[None]).effects(u)[0][0])


def log_bayes_factors(score: ArrayLike, information: ArrayLike, sizes: Sequence[float]) -> Array:
    """Those of one group of columns at several prior standard deviations, each common to all of its columns."""
    u, unit, _ = _in_prior_units(score, information, np.ones(np.size(score)))
    values, vectors = np.linalg.eigh(unit)
    variance = np.square(np.asarray(sizes, float))[:, None]
    spread = variance * values
    seen = spread > np.maximum(INVISIBLE, ROUNDING * spread[:, -1:])
    spread = np.where(seen, spread, 0.0)
    energy = np.where(seen, variance * (vectors.T @ u) ** 2, 0.0) / (1 + spread)
    return 0.5 * np.sum(energy - np.log1p(spread), axis=1)


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
    problem = make_problem(score, information, prior_variance, items, candidate_prior)
    size = min(max_effects, int(problem.member[np.isfinite(problem.log_prior)].any(axis=0).sum()))
    number = sum(comb(len(items), k) for k in range(1, size + 1))
    if not 1 <= number <= MOST_MODELS:
        raise InputError(
            f"Up to {max_effects} effects of {len(items)} items make {number:,} combinations, "
            f"not 1 to {MOST_MODELS:,}: change 'max_effects' or thin the shape grids."
        )
    null = row_null(nothing_prior, size)
    owner = problem.member.argmax(axis=1)
    models: list[tuple[int, ...]] = [()]
    weights = [np.log([nothing_prior])]
    for k in range(1, size + 1):
        chosen = np.array(list(combinations(range(len(items)), k)), dtype=np.intp)
        owners = np.sort(owner[chosen], axis=1)
        distinct = np.all(np.diff(owners, axis=1) > 0, axis=1)
        chosen, prior = chosen[distinct], problem.log_prior[chosen[distinct]].sum(axis=1)
        count = np.log(comb(size, k)) + k * np.log1p(-null) + (size - k) * np.log(null)
        weights.append(count + prior - np.logaddexp.reduce(prior) + _joint_factors(problem, chosen))
        models.extend(map(tuple, owners[distinct].tolist()))
    log_evidence = float(np.logaddexp.reduce(np.concatenate(weights)))
    posterior = dict.fromkeys(models, 0.0)
    for model, p in zip(models, np.exp(np.concatenate(weights) - log_evidence), strict=True):
        posterior[model] += float(p)
    counts, inclusion = np.zeros(size + 1), np.zeros(problem.member.shape[1])
    for model, p in posterior.items():
        counts[len(model)] += p
        inclusion[list(model)] += p
    ranked = dict(sorted(posterior.items(), key=lambda entry: (-entry[1], entry[0])))
    return Enumeration(counts, inclusion, ranked, log_evidence)


def _joint_factors(problem: Problem, chosen: Index) -> Array:
    """Log Bayes factors (N,) of combinations (N, k) of items, in bounded memory."""
    columns = np.sort(problem.columns[chosen].reshape(len(chosen), -1), axis=1)  # padding last
    widths = (columns < problem.score.size - 1).sum(axis=1)
    factors = np.zeros(len(chosen))
    for width in np.unique(widths):
        alike = np.flatnonzero(widths == width)
        for part in np.array_split(alike, 1 + alike.size * int(width) ** 2 // 2_000_000):
            blocks = Blocks(problem.information, columns[part, :width])
            factors[part] = blocks.effects(problem.score)[0]
    return factors


def row_null(nothing_prior: float, rows: int) -> float:
    if not 0 < nothing_prior < 1:
        raise InputError(f"'nothing_prior' must lie between 0 and 1, got {nothing_prior}.")
    return nothing_prior ** (1 / rows)


def make_problem(
    score: ArrayLike,
    information: ArrayLike,
    prior_variance: ArrayLike,
    items: Sequence[Item],
    candidate_prior: ArrayLike | None,
) -> Problem:
    """Check everything and bring it to unit priors."""
    u, unit, scale = _in_prior_units(score, information, prior_variance)
    p = u.size
    member, log_prior = _prior(items, p, candidate_prior)
    columns = np.full((len(items), max(len(item.columns) for item in items)), p, dtype=np.intp)
    for row, item in zip(columns, items, strict=True):
        row[: len(item.columns)] = item.columns
    padded = (np.append(u, 0.0), np.pad(unit, (0, 1)), np.append(scale, 0.0))
    return Problem(*padded, columns, member, log_prior)


def _in_prior_units(
    score: ArrayLike, information: ArrayLike, prior_variance: ArrayLike
) -> tuple[Array, Array, Array]:
    """Score and information per prior standard deviation, and these, checked."""
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
    scale = np.sqrt(variance)
    unit = scale[:, None] * full * scale
    largest = np.abs(unit).max(initial=1.0)
    if np.abs(unit - unit.T).max(initial=0.0) > 1e-6 * largest:
        raise InputError("The information is not symmetric: give X'V⁻¹X.")
    return u * scale, (unit + unit.T) / 2, scale


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
