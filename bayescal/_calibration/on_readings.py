"""What joint draws say of readings: expected outputs, densities, readings simulated from them. All on the host."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.parallel import on_one_thread
from bayescal._inference.noise_on_record import Each, log_densities, samples, variances
from bayescal._inference.problem import Problem
from bayescal._model.effect import Coefficient
from bayescal._model.prior import Known
from bayescal._model.terms import Term

CELLS = 2_000_000  # draws × readings worked out together


class Vectors(NamedTuple):
    """Joint draws: coefficients, coordinates of φ."""

    x: Float[np.ndarray, "b p"]
    v: Float[np.ndarray, "b d"]


class PredictiveMoments(NamedTuple):
    """Moments of readings over draws, (n,) each."""

    mean: Float[np.ndarray, "n"]  # of the expected output,
    variance: Float[np.ndarray, "n"]  # and its variance
    noise: Float[np.ndarray, "n"]  # mean variance of the noise,
    beside: Float[np.ndarray, "n"]  # and of what is not known of a reading's inputs and groups


@on_one_thread
def moments(
    problem: Problem, draws: Vectors, carried: Callable[[np.ndarray], np.ndarray] | None = None
) -> PredictiveMoments:
    """Return moments of readings, noise on inputs and members of groups that are not known (of code −1) included.

    Draws are taken a stretch at a time and never held together; sums are of differences from the first. What known
    readings say of the correlated noise of all, by what each draw expects of them (b, n), is `carried`: it is added to
    the mean, and its variance is no part of that of the noise.
    """
    count, size = len(draws.x), problem.record.size
    total, squares, noise, beside = np.zeros((4, size))
    first: Any = None
    for part, own, some, hyper in _stretches(problem, draws):
        acting = [t for t in own.terms if t.place == "input" or _unseen(own, t).any()]
        mean, spreads = _mean_and_spreads(own, some, hyper, acting)
        own_noise = variances(problem.noise, hyper, problem.record)
        if carried is not None:
            mean = mean + carried(mean)
            own_noise = own_noise - np.atleast_1d(problem.noise.slow_variance(hyper))[:, None]
        first = mean[0].copy() if first is None else first
        away = mean - first
        total += np.sum(away, axis=0)
        squares += np.einsum("bn,bn->n", away, away)
        noise += len(part) * np.mean(own_noise, axis=0)
        if spreads:
            squared = np.broadcast_to(sum(s**2 for s in spreads), mean.shape)
            beside += len(part) * np.mean(squared, axis=0)
    away = total / count
    variance = np.maximum(squares / count - away**2, 0.0)
    return PredictiveMoments(first + away, variance, noise / count, beside / count)


@on_one_thread
def pointwise(problem: Problem, draws: Vectors) -> Float[np.ndarray, "b n"]:
    """Log likelihood of each reading under each draw: under correlated noise, given those before it in its run."""
    found = np.empty((len(draws.x), problem.record.size))
    for part, own, some, hyper in _stretches(problem, draws):
        record, (mean, extra) = own.record, own.expected_and_extra(some.x, hyper)
        found[part] = log_densities(own.noise, record, record.y - mean, hyper, extra)
    return found


@on_one_thread
def replicate(
    problem: Problem,
    draws: Vectors,
    random: np.random.Generator,
    members: Mapping[str, np.ndarray] | None = None,
) -> Float[np.ndarray, "b n"]:
    """Readings simulated by the model's own equation and noise, from each draw once.

    Of members of groups that the fit does not know deviations are drawn from their prior; `members` has, by group, a
    code of each reading's member (n,).
    """
    found, members = np.empty((len(draws.x), problem.record.size)), members or {}
    for part, own, some, hyper in _stretches(problem, draws):
        acting = [t for t in own.terms if t.place == "input" or t.known.per in members]
        mean, spreads = _mean_and_spreads(own, some, hyper, acting)
        for t, spread in zip(acting, spreads, strict=True):
            codes = np.arange(mean.shape[1]) if t.place == "input" else members[str(t.known.per)]
            normal = random.standard_normal((len(mean), int(codes.max()) + 2))
            mean = mean + spread * normal[:, codes]  # −1: the last
        seed = int(random.integers(2**31))
        found[part] = samples(problem.noise, problem.record, mean, hyper, seed)
    return found


def _stretches(
    problem: Problem, draws: Vectors
) -> Iterator[tuple[np.ndarray, Problem, Vectors, Each]]:
    """Which draws, some at a time; the structure that they are of, and they in its terms; their φ by name."""
    many = max(1, CELLS // max(1, problem.record.size))
    for places, own, those in _by_structure(problem, draws):
        for start in range(0, len(places), many):
            part = slice(start, start + many)
            some = Vectors(*(np.asarray(a)[part] for a in those))
            values = own.hyper(some.v.T)
            each = {k: np.broadcast_to(value, len(some.x)) for k, value in values.items()}
            yield places[part], own, some, each


def _by_structure(
    problem: Problem, draws: Vectors
) -> Iterator[tuple[np.ndarray, Problem, Vectors]]:
    """Draws of an average, together those of structures whose columns are the same: of each draw that has them known
    coefficients are what they are by definition, and zero of others."""
    layout = problem.layout
    held = [b for b in layout.x_blocks if b.index in b.effect.held]
    if not held:
        yield np.arange(len(draws.x)), problem, draws
        return
    there = np.asarray(draws.x)[:, [b.start for b in held]] != 0
    patterns, which = np.unique(there, axis=0, return_inverse=True)
    for k, has in enumerate(patterns):
        gone = {b.effect.name for b, one in zip(held, has, strict=True) if not one}
        effects = tuple(
            replace(e, coefficients=tuple(map(_by_definition, e.coefficients)))
            for e in layout.model.effects
            if e.name not in gone
        )
        own = replace(layout, model=replace(layout.model, effects=effects))
        in_x, in_v = layout.entries_in(own)
        places = np.flatnonzero(which.reshape(-1) == k)
        those = Vectors(draws.x[places][:, in_x], draws.v[places][:, in_v])
        yield places, Problem(own, problem.record), those


def _by_definition(c: Coefficient) -> Coefficient:
    return replace(c, prior=Known(c.mean)) if isinstance(c.prior, Known) else c


def _mean_and_spreads(
    problem: Problem, draws: Vectors, hyper: Each, terms: Sequence[Term]
) -> tuple[Float[np.ndarray, "b n"], list[Any]]:
    """Return expected outputs, and the standard deviation that each of some terms adds: noise on an input, or a member
    that is not known (zero at readings whose member is)."""
    if not terms:
        return problem.expected(draws.x, hyper), []
    mean, slopes = problem.expected_with_slopes(draws.x, hyper, terms)
    spreads = list[Any]()
    for t, slope in zip(terms, slopes, strict=True):
        sd = t.prior_sd
        if t.place != "input":
            # Of an effect that a draw's structure has not, all coefficients are exactly zero.
            own = [o.at for o in problem.terms if o.place == "x" and o.known.of == t.known.of]
            there = (
                np.any([np.any(draws.x[:, at] != 0, axis=1) for at in own], axis=0) if own else 1.0
            )
            member_sd = problem.member_sd(t, hyper, len(draws.x)) * there
            sd = np.where(_unseen(problem, t), member_sd[:, None], 0.0)
        spreads.append(slope * sd)
    return mean, spreads


def _unseen(problem: Problem, term: Term) -> np.ndarray:
    """Which readings belong to a member of the term's group that is not known."""
    if term.known.per is None or term.place == "fixed":
        return np.zeros(1, dtype=bool)
    return problem.record.codes[term.known.per] < 0
