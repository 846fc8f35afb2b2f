"""All sets of at most two candidates: sizes and shapes are integrated on grids, under a grid of noise laws.

Written from README and data sheet alone, as an outsider could. The data sheet gives the prior: the stated shares of
tracks, sizes between a third and three times the plausible one, at most two effects, five kinds of noise, or white
noise and a single thing outside. A hypothesis is a noise law, a set, and a node of its shapes; given these everything
is Gaussian. Base terms are integrated out with their stated sizes, and so is the noise's standard deviation (prior
1/σ). The prior of a single coefficient is a mixture of normal distributions that covers ± its range; that of several
coefficients is a mixture of zero-mean normals of several sizes. Student-t noise is Gaussian given the weights of its
readings, which are taken at the best fit of all terms. Predictions are averaged over all hypotheses.

Sources: linear model with normal priors, D. Lindley & A. Smith, J. R. Stat. Soc. B 34 (1972) 1; weights of Student-t
noise, K. Lange et al., JASA 84 (1989) 881.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
from scipy.linalg import cholesky, solve_triangular
from scipy.stats import t as student

from missing_effect import prior
from missing_effect.regression import grid
from missing_effect.task import OUTSIDE, Task, Term

Array = np.ndarray
NODES = 13  # of a shape
FINE = 4  # frequencies tried for each that the readings tell from others
NEAR = 12.0  # nats behind the best noise law, up to which one's pairs are weighed
MIN_PROBABILITY = 1e-4  # probability of a hypothesis that counts in the prediction
DEGREES = 4.0  # of Student-t noise, by the data sheet
MIDDLES = np.array([0.39, 0.60, 0.93, 1.43, 2.21])  # of normal distributions that tile 1/3 to 3
WIDTH = 0.27  # of each, in its middle
SPREADS = np.array([0.4, 0.7, 1.2, 2.1])  # of several coefficients together


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of one candidate times its plausible size, at each node of its shape: (nodes, n, k), (nodes, m, k)."""

    name: str
    train: Array
    later: Array

    @property
    def mixture(self) -> tuple[Array, Array]:
        """Return means and variances of its coefficients' mixture prior, (j, k) each; components have equal weight."""
        k = self.train.shape[2]
        if k > 1:
            return np.zeros((SPREADS.size, k)), np.repeat(SPREADS[:, None] ** 2, k, axis=1)
        middles = np.concatenate([MIDDLES, -MIDDLES])[:, None]
        return middles, (WIDTH * middles) ** 2


@dataclass(frozen=True)
class Law:
    """A noise law: covariance of the training readings (None: white) and variance of later readings, both for σ = 1.

    `beside` are further columns on both parts, with standard normal coefficients, and `named` the set they represent.
    """

    kind: str
    weight: float = 1.0
    covariance: Array | None = None
    later: float | Array = 1.0
    beside: tuple[Array, Array] | None = None
    named: tuple[str, ...] = ()
    gained: float = 0.0  # nats of its true density against the Gaussian one with this covariance


@dataclass(frozen=True)
class Weighed:
    """A hypothesis without its prior: nodes × components of the mixture."""

    law: Products
    chosen: tuple[Columns, ...]
    evidence: Array  # (nodes, components)
    mean: Array  # of coefficients, (nodes, components, k)
    precision: Array  # of coefficients, (nodes, components, k, k)
    noise: Array  # variance of the noise, (nodes,)


class Products:
    """Inner products of readings and columns under a noise law, with base terms integrated out."""

    def __init__(self, law: Law, y: Array, base: tuple[Array, Array], terms: Sequence[Columns]):
        self.law, self.n = law, y.size
        self._base = (
            [np.hstack(pair) for pair in zip(base, law.beside, strict=True)] if law.beside else base
        )
        flat = [c.train.transpose(1, 0, 2).reshape(self.n, -1) for c in terms]
        ends = np.cumsum([1, *(f.shape[1] for f in flat)])
        self._begin = dict(zip(terms, ends, strict=False))
        all_ = np.column_stack([y, *flat, self._base[0]])
        self.half_log = 0.0  # of the determinant
        if law.covariance is not None:
            root = cholesky(law.covariance, lower=True)
            all_ = solve_triangular(root, all_, lower=True)
            self.half_log = float(np.sum(np.log(np.diag(root))))
        base_xy, x = all_[:, : ends[-1]], all_[:, ends[-1] :]
        self._root = cholesky(np.eye(x.shape[1]) + x.T @ x, lower=True)
        self.half_log += float(np.sum(np.log(np.diag(self._root))))
        self._inner = solve_triangular(self._root, x.T @ base_xy, lower=True)
        self._own = base_xy
        self.squares = float(base_xy[:, 0] @ base_xy[:, 0] - self._inner[:, 0] @ self._inner[:, 0])

    def _columns(self, chosen: Sequence[Columns]) -> Array:
        """Return the indices of a set's columns at all combinations of nodes, (nodes, k)."""
        rows = np.zeros((1, 0), int)
        for c in chosen:
            nodes, _, k = c.train.shape
            places = self._begin[c] + np.arange(nodes * k).reshape(nodes, k)
            rows = np.hstack([np.repeat(rows, nodes, axis=0), np.tile(places, (len(rows), 1))])
        return rows

    def weigh(self, chosen: tuple[Columns, ...]) -> Weighed:
        """Compute the log evidence of a set; for the empty set, that of the base alone."""
        at = self._columns(chosen)
        cross, inner = self._own.T[at], self._inner.T[at]  # (nodes, k, n)
        gram = cross @ cross.transpose(0, 2, 1) - inner @ inner.transpose(0, 2, 1)
        right = cross @ self._own[:, 0] - inner @ self._inner[:, 0]
        k = at.shape[1]
        gram += 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(k)
        fitted = np.sum(right * np.linalg.solve(gram, right[:, :, None])[:, :, 0], axis=1)
        rss = np.maximum(self.squares - fitted, 1e-9 * self.squares)
        noise = rss / self.n
        mean, variance = _together([c.mixture for c in chosen])
        precision = (gram / noise[:, None, None])[:, None] + np.eye(k) / variance[:, None, :]
        pull = (right / noise[:, None])[:, None] + mean / variance
        solution = np.linalg.solve(precision, pull[..., None])[..., 0]
        gain = (np.sum(pull * solution, axis=2) - np.linalg.slogdet(precision)[1]) / 2
        gain = gain - np.sum(np.log(variance) + mean**2 / variance, axis=1) / 2
        evidence = gain - (fitted / noise)[:, None] / 2 - self.n / 2 * np.log(rss)[:, None]
        evidence = evidence - self.half_log + self.law.gained - np.log(evidence.size)
        return Weighed(self, chosen, evidence, solution, precision, noise)

    def predict(self, w: Weighed, node: int, mean: Array, spread: Array) -> tuple[Array, Array]:
        """Return mean and variance of later readings, given mean and covariance of a set's coefficients."""
        at, later = self._columns(w.chosen)[node], self._base[1]
        places = np.unravel_index(node, [c.train.shape[0] for c in w.chosen]) if w.chosen else ()
        predictions = [c.later[i] for c, i in zip(w.chosen, places, strict=True)]
        through = solve_triangular(self._root, later.T, lower=True).T
        beyond = np.hstack([np.zeros((len(later), 0)), *predictions]) - through @ self._inner[:, at]
        variance = w.noise[node] * self.law.later + np.sum(through**2, axis=1)
        variance = variance + np.einsum("mi,ij,mj->m", beyond, spread, beyond)
        return through @ self._inner[:, 0] + beyond @ mean, variance


def solve(task: Task) -> dict[str, Any]:
    output = task.train["output"].to_numpy(float)
    scale, base, extra = _base(task, output)
    y, fleet = output / scale, "device" in task.train
    terms = [_term(t, task, scale) for t in task.candidates if not t.group]
    groups = [_term(t, task, scale) for t in task.candidates if t.group]
    white = Law("white")
    laws = [Products(law, y, base, terms) for law in (white, *_group_laws(groups))]
    if not fleet:
        residuals = _residuals(y, base, terms)
        laws += [Products(law, y, base, terms) for law in _coloured(task, residuals)]
    count, pair = len(task.candidates), prior.rivals(task)
    hypotheses = list(_weighed(laws, terms, count, pair))
    if not fleet and not pair:
        for some in _outside(task):
            products = Products(white, y, base, some)
            prior_weight = prior.weight("outside", 0, count) / (4 * len(some))
            hypotheses += [(prior_weight, products.weigh((c,))) for c in some]
    return _answer(hypotheses, scale, extra)


def _weighed(
    laws: Sequence[Products], terms: Sequence[Columns], count: int, pair: tuple[str, ...]
) -> Iterator[tuple[float, Weighed]]:
    """Yield prior and evidence of noise laws with sets; pairs only under laws whose evidence is near the highest."""
    fleet = any(p.law.named for p in laws)
    weighed = []
    for p in laws:  # the best candidate alone, and with each other
        of_law = {(): p.weigh(()), **{(c,): p.weigh((c,)) for c in terms}}
        (first,) = max(list(of_law)[1:], key=lambda s: of_law[s].evidence.max())
        for c in combinations(terms, 2):
            if first in c:
                of_law[c] = p.weigh(c)
        weighed.append((max(float(w.evidence.max()) for w in of_law.values()), p, of_law))
    best = max(top for top, _, _ in weighed)
    for top, p, of_law in weighed:
        if p.law.kind == "white" or top > best - NEAR:
            of_law |= {c: p.weigh(c) for c in combinations(terms, 2) if c not in of_law}
        for w in of_law.values():
            names = {*p.law.named, *(c.name for c in w.chosen)}
            prior_weight = prior.weight(p.law.kind, len(names), count, fleet)
            if pair and not (p.law.kind == "white" and len(names) == 1 and names <= {*pair}):
                prior_weight *= prior.ELSE
            yield prior_weight * p.law.weight, w


def _answer(weighed: Sequence[tuple[float, Weighed]], scale: float, extra: float) -> dict[str, Any]:
    """Return the probabilities of sets, and the prediction averaged over all probable hypotheses."""
    total = [np.log(max(weight, 1e-300)) + w.evidence for weight, w in weighed]
    top = max(t.max() for t in total)
    weights = [np.exp(t - top) for t in total]
    mass = sum(w.sum() for w in weights)
    sets: dict[tuple[str, ...], float] = {}
    parts = []
    for weight, (_, w) in zip(weights, weighed, strict=True):
        key = tuple(sorted({*w.law.law.named, *(c.name for c in w.chosen)}))
        sets[key] = sets.get(key, 0.0) + float(weight.sum() / mass)
        for node in np.flatnonzero(weight.sum(axis=1) > MIN_PROBABILITY * mass):
            share = weight[node] / weight[node].sum()
            mean = share @ w.mean[node]
            off = w.mean[node] - mean
            spread = np.einsum("j,jab->ab", share, np.linalg.inv(w.precision[node]))
            spread = spread + np.einsum("j,ja,jb->ab", share, off, off)
            parts.append((weight[node].sum(), *w.law.predict(w, node, mean, spread)))
    share = np.array([p for p, _, _ in parts]) / sum(p for p, _, _ in parts)
    means, variances = np.array([m for _, m, _ in parts]), np.array([v for _, _, v in parts])
    mean = share @ means
    sd = np.sqrt(share @ (variances + (means - mean) ** 2) + extra)
    return {"sets": sets, "mean": mean * scale, "sd": sd * scale}


def _together(mixtures: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return means and variances of several candidates' coefficients, for all combinations of their components."""
    mean, variance = np.zeros((1, 0)), np.zeros((1, 0))
    for m, v in mixtures:
        again = len(m)
        mean, variance = (
            np.hstack([np.repeat(a, again, axis=0), np.tile(b, (len(a), 1))])
            for a, b in ((mean, m), (variance, v))
        )
    return mean, variance


def _base(task: Task, output: Array) -> tuple[float, tuple[Array, Array], float]:
    """Return an estimate of the noise σ, the base's columns times sizes over σ, and the variance of unseen offsets."""
    train = np.hstack([t.size * t.columns(task.train) for t in task.base])
    later = np.hstack([t.size * t.columns(task.holdout) for t in task.base])
    middle = [t.size * t.columns(task.train) for t in task.candidates if not t.group]
    scale = float(np.std(_without(np.hstack([train, *middle]), output)))
    new = sum(t.size**2 for t in task.base if t.group and not t.columns(task.holdout).any())
    return scale, (train / scale, later / scale), new / scale**2


def _without(columns: Array, y: Array) -> Array:
    """Return the least-squares residuals of readings."""
    x = columns / np.maximum(np.sqrt(np.sum(columns**2, axis=0)), 1e-300)
    return y - x @ np.linalg.solve(x.T @ x + 1e-9 * np.eye(x.shape[1]), x.T @ y)


def _residuals(y: Array, base: tuple[Array, Array], terms: Sequence[Columns]) -> Array:
    """Return the residuals of a fit of base and all candidates, each at three nodes of its shape."""
    some = [c.train[i] for c in terms for i in sorted({0, len(c.train) // 2, len(c.train) - 1})]
    return _without(np.hstack([base[0], *some]), y)


def _term(term: Term, task: Task, scale: float) -> Columns:
    """Return a candidate's columns, times its plausible size and in units of the noise's standard deviation."""
    train, later = (
        np.array([t.columns(f, **s) for s in grid(t, NODES)]) * t.size / scale
        for t, f in ((term, task.train), (term, task.holdout))
    )
    return Columns(term.name, train, later)


def _group_laws(groups: Sequence[Columns]) -> Iterator[Law]:
    """Yield laws with columns per device for a candidate of devices, at several standard deviations between devices."""
    for c in groups:
        for s in np.geomspace(1 / 3, 3, 7):
            yield Law("white", 1 / 7, beside=(s * c.train[0], s * c.later[0]), named=(c.name,))


def _coloured(task: Task, residuals: Array) -> Iterator[Law]:
    """Yield the coloured noise laws, with equal total weight for each of the five kinds; parameters on grids."""
    (time, run), (later, _) = map(_times, (task.train, task.holdout))
    lags, same, n = np.abs(time[:, None] - time), run[:, None] == run, time.size

    def mixed(correlation: Array, part: float) -> Array:
        return (1 - part) * np.eye(n) + part * correlation * same

    parts, memories = (0.3, 0.6, 0.9, 1.0), (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
    for part in parts:
        for memory in memories:
            weight = 0.2 / len(parts) / len(memories)
            yield Law("coloured", weight, mixed(np.exp(-lags / memory), part))
    decades = np.mean([np.exp(-lags / m) for m in (0.5, 1.5, 4.5, 13.5, 40.0, 120.0)], axis=0)
    for part in parts:
        yield Law("coloured", 0.2 / len(parts), mixed(decades, part))
    walk = np.minimum(time[:, None], time) * same
    for step in (0.1, 0.2, 0.4, 0.8):  # between readings, against the white noise
        yield Law("coloured", 0.2 / 4, np.eye(n) + step**2 * walk, 1 + step**2 * later)
    yield _student(residuals)
    waves = _waves(task)
    first = _strongest(waves, residuals, 8)
    second = _strongest(waves, _without(waves.train[first[0]], residuals), 8)
    chance = FINE / len(waves.train)  # of a peak
    for size in SPREADS:
        for i in first:
            yield _wave(waves, [i], 0.1 * chance / SPREADS.size, size)
        for i in second:
            yield _wave(waves, [first[0], i], 0.1 * 2 * chance**2 / SPREADS.size, size)


def _times(data: pd.DataFrame) -> tuple[Array, Array]:
    """Return times from the start of a run, in steps, and labels of runs."""
    run = data["run"].to_numpy() if "run" in data else np.zeros(len(data))
    time = data["time"].to_numpy(float) if "time" in data else np.arange(len(data), dtype=float)
    since = np.concatenate([time[run == r] - time[run == r][0] for r in dict.fromkeys(run)])
    return since / np.median(np.diff(since)), run


def _student(residuals: Array) -> Law:
    """Return Student-t noise as Gaussian noise with the weights of the readings at the best fit of all terms."""
    scale = float(np.std(residuals)) / 2**0.5
    for _ in range(30):
        weights = (DEGREES + 1) / (DEGREES + (residuals / scale) ** 2)
        scale = float(np.sqrt(np.mean(weights * residuals**2)))
    true = float(np.sum(student.logpdf(residuals / scale, DEGREES) - np.log(scale)))
    squares, n = float(weights @ residuals**2), residuals.size
    as_gaussian = np.sum(np.log(weights)) / 2 - n / 2 * (np.log(2 * np.pi * squares / n) + 1)
    later = DEGREES / (DEGREES - 2)
    return Law("coloured", 0.2, np.diag(1 / weights), later, gained=true - float(as_gaussian))


def _waves(task: Task) -> Columns:
    """Return cosines and sines of the reading's number, at all frequencies up to half a cycle per reading."""
    n, m = len(task.train), len(task.holdout)
    turn = np.pi * np.arange(FINE, FINE * n)[:, None] / (FINE * n)
    at = np.arange(n + m)
    both = np.stack([np.cos(turn * at), np.sin(turn * at)], axis=2) * 2**0.5
    return Columns(OUTSIDE, both[:, :n], both[:, n:])


def _strongest(waves: Columns, residuals: Array, count: int) -> list[int]:
    """Return the indices of the highest peaks of the residuals' periodogram."""
    power = np.sum((waves.train.transpose(0, 2, 1) @ residuals) ** 2, axis=1)
    peaks = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] > power[2:])) + 1
    return [int(i) for i in peaks[np.argsort(-power[peaks])][:count]]


def _wave(waves: Columns, chosen: Sequence[int], weight: float, size: float) -> Law:
    """Return white noise with tones of these frequencies."""
    nuisances = size * np.hstack(waves.train[chosen]), size * np.hstack(waves.later[chosen])
    return Law("coloured", weight, beside=nuisances)


def _outside(task: Task) -> Iterator[list[Columns]]:
    """Yield the kinds of disturbance that no candidate describes, at plausible places, scaled to unit rms."""
    yield [_waves(task)]
    n = len(task.train)
    after = np.arange(n + len(task.holdout)) - np.arange(2, n - 2, 2)[:, None]
    for memories in ((math.inf,), (3.0, 8.0, 20.0)):  # a step, a shock
        shapes = [np.where(after >= 0, np.exp(-np.maximum(after, 0) / m), 0.0) for m in memories]
        yield [_even(s[:, :n], s[:, n:]) for s in shapes]
    if "temperature" in task.train:
        x, z = (f["temperature"].to_numpy(float) for f in (task.train, task.holdout))
        centres = np.linspace(x.min(), x.max(), 40)[:, None]
        yield [
            _even(*(_resonance((t - centres) / width) for t in (x, z)))
            for width in np.ptp(x) * np.array([0.01, 0.02, 0.04, 0.08])
        ]


def _resonance(x: Array) -> Array:
    """Return in-phase and quadrature columns, (nodes, n, 2)."""
    return np.stack([1 / (1 + x**2), x / (1 + x**2)], axis=2)


def _even(train: Array, later: Array) -> Columns:
    """Return columns scaled to a mean square of one on the training readings."""
    train, later = (a.reshape(*a.shape[:2], -1).astype(float) for a in (train, later))
    size = np.sqrt(np.mean(train**2, axis=1, keepdims=True)) + 1e-6
    return Columns(OUTSIDE, train / size, later / size)
