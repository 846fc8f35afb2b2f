"""Simulation-based calibration: data sets drawn from the priors, ranks of the truth among posterior draws, their test.

Over data sets drawn from the priors that the fit uses, the rank of the truth among the posterior draws is uniform for
every unknown, if model, simulator and inference agree.

Source: A. Talts et al., arXiv:1804.06788 (2018); the band: T. Säilynoja, P.-C. Bürkner, A. Vehtari, Statistics
and Computing 32 (2022) 32, arXiv:2103.10522.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy import stats

import bayescal as bc
from bayescal._inference.nuts import to_numpyro_distribution as law
from bayescal._model import forward
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import Layout, Unknowns, bind

MEMBERS = 4  # of each group: the others are exchangeable with them
POINTS = 50  # at which an ECDF is compared with its band
INTERVAL = 0.95


def draw_prior(layout: Layout, key: Array) -> tuple[Array, Array]:
    """Draw (x, v) from the prior.

    Raises:
        ValueError: a prior is flat.
    """
    if layout.is_improper:
        raise ValueError("a flat prior cannot be sampled: give a proper prior to simulate from it")
    # One more than is needed: a seed stands for the data set that it always gave.
    keys = jax.random.split(key, len(layout.hypers) + 2)
    pairs = zip((h.prior for h in layout.hypers), keys, strict=False)
    v = jnp.array([p.coordinate(law(p).sample(key)) for p, key in pairs], dtype=float)
    sd = forward.prior_sd(layout, layout.hyper(v))
    return layout.mean_of_x + sd * jax.random.normal(keys[-1], (layout.size,)), v


def drawn(
    model: bc.Model, count: int, plan: bc.Measurements, seed: int
) -> tuple[list[bc.Measurements], dict[str, np.ndarray]]:
    """Draw data sets from the model's priors and noise; return them with the truth of every unknown, (count, …).

    Args:
        model: model with proper priors.
        count: number of data sets.
        plan: readings with the columns; the output is replaced.
        seed: seed of all random numbers.
    """
    layout, _ = bind(model, plan)
    frame = build_frame(plan, reference_of(plan))

    def draw_one(key):
        k1, k2 = jax.random.split(key)
        x, v = draw_prior(layout, k1)
        return forward.draw_readings(layout, frame, x, v, k2), x, v

    outputs, x, v = jax.jit(jax.vmap(draw_one))(jax.random.split(jax.random.key(seed), count))
    unknowns = Unknowns.of(layout)
    values = unknowns.values(np.asarray(x), np.asarray(v))
    data = [plan.with_column("output", np.asarray(y)) for y in outputs]
    return data, {name: unknowns.select(values, name) for name in unknowns.by_key}


class Posterior(NamedTuple):
    """Weighted draws of one data set.

    Attributes:
        weights: normalised weights, (s,).
        samples: draws of every unknown, (s,) or (s, members).
    """

    weights: np.ndarray
    samples: dict[str, np.ndarray]


def ranks(
    posteriors: Iterable[Posterior], truth: dict[str, np.ndarray], seed: int = 0
) -> dict[str, list[float]]:
    """Compute the weighted fraction of draws below the truth, per unknown and group member, one per data set.

    Of S equally weighted draws the truth's rank is uniform over 0 … S; with a uniform number U added,
    (rank + U)/(S + 1) is uniform over [0, 1]. S is Kish's effective sample size.
    """
    random = np.random.default_rng(seed)
    rank_lists: dict[str, list[float]] = {}
    for i, (weight, samples) in enumerate(posteriors):
        effective_size = 1 / np.sum(weight**2)
        for name, draws in samples.items():
            single = draws.ndim == 1
            draws = draws[:, None] if single else draws
            actual = np.atleast_1d(truth[name][i])
            for member in range(min(draws.shape[1], MEMBERS)):
                below = min(weight[draws[:, member] < actual[member]].sum(), 1.0)
                place = (effective_size * below + random.random()) / (effective_size + 1)
                label = name if single else f"{name}({member})"
                rank_lists.setdefault(label, []).append(float(place))
    return rank_lists


class Band(NamedTuple):
    """Limits of the counts of ranks at or below each point, within which all lie with a given probability."""

    points: np.ndarray
    low: np.ndarray
    high: np.ndarray


@cache
def band(count: int, level: float) -> Band:
    """Compute the simultaneous band of the ECDF of `count` uniform numbers, exact at its points.

    The count at each point is binomial. All points have central intervals of the same tail probability, the largest for
    which all counts are inside with probability 1 − `level`.

    Args:
        count: number of ranks.
        level: probability that uniform numbers leave the band.
    """
    points = np.arange(1, POINTS) / POINTS
    low_tail, high_tail = np.log(level / (2 * POINTS)) - 1.0, np.log(level / 2)
    for _ in range(30):
        middle = 0.5 * (low_tail + high_tail)
        if _inside(count, points, *_limits(count, points, np.exp(middle))) >= 1 - level:
            low_tail = middle
        else:
            high_tail = middle
    return Band(points, *_limits(count, points, np.exp(low_tail)))


def _limits(count: int, points: np.ndarray, tail: float) -> tuple[np.ndarray, np.ndarray]:
    law = stats.binom(count, points)
    return law.ppf(tail).astype(int), law.isf(tail).astype(int)


def _inside(count: int, points: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Compute the probability that uniform counts are within limits at all points, by a Markov chain."""
    counts, probability, at = np.array([0]), np.array([1.0]), 0.0
    for point, lowest, highest in zip(points, low, high, strict=True):
        next_counts = np.arange(lowest, highest + 1)
        # Of those that are above `at`, a binomial number lies between it and the next point.
        step = stats.binom.pmf(
            next_counts[None, :] - counts[:, None], count - counts[:, None], (point - at) / (1 - at)
        )
        counts, probability, at = next_counts, probability @ step, point
    return float(probability.sum())


def expected_counts(total: int, chance: float, level: float) -> tuple[int, int]:
    """Return limits of a binomial count, outside of which it falls with probability at most `level`.

    Args:
        total: number of events.
        chance: probability of each event.
        level: significance level; at most half of it beyond each limit, since counts are integers.
    """
    law = stats.binom(total, chance)
    return int(law.ppf(level / 2)), int(law.isf(level / 2))


class Judgement(NamedTuple):
    """Tests of the ranks of one unknown.

    Attributes:
        count: number of data sets.
        uniform: whether the ECDF is within its band.
        distance: Kolmogorov–Smirnov distance from the uniform distribution.
        covered: number of data sets whose 95 % interval contains the truth.
        coverage_holds: whether `covered` is within its binomial limits.
    """

    count: int
    uniform: bool
    distance: float
    covered: int
    coverage_holds: bool

    @property
    def ok(self) -> bool:
        return self.uniform and self.coverage_holds


def judge(values: np.ndarray | list[float], level: float) -> Judgement:
    """Test the ranks of one unknown, each of two tests at half of `level`."""
    values = np.asarray(values)
    count = len(values)
    limits = band(count, level / 2)
    counts = np.searchsorted(np.sort(values), limits.points, side="right")
    uniform = bool(np.all((limits.low <= counts) & (counts <= limits.high)))
    covered = int(np.sum(np.abs(values - 0.5) < INTERVAL / 2))
    low, high = expected_counts(count, INTERVAL, level / 2)
    return Judgement(
        count=count,
        uniform=uniform,
        distance=float(stats.kstest(values, "uniform").statistic),
        covered=covered,
        coverage_holds=low <= covered <= high,
    )
