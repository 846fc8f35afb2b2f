"""Noise of a sensor at rest: Q, N, B and K of IEEE 952 with intervals, by the likelihood of sums of noise terms.

Every sum is fitted by the Kalman filter to the readings themselves, levels of runs and a cubic over temperature
integrated out beside it (restricted likelihood); the sums are weighed by their evidence, and the parameters of the
most probable one drawn by importance sampling. Of a long log the filter takes the means of blocks of readings, by
their exact law, and some stretches of single readings.

Sources: D. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood); IEEE Std 952-1997, Annex C.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.special import gammaln, ndtri, softmax

from bayescal._core.errors import InputError
from bayescal._core.importance_weights import effective_size, resample
from bayescal._core.parallel import on_one_thread
from bayescal._core.settings import settings
from bayescal._data.allan_deviation import EvenRuns, even_runs, overlapping
from bayescal._data.measurements import Measurements
from bayescal._inference.laplace import curvature
from bayescal._inference.programs import padded_length
from bayescal._model.noise_law import LOG_2PI, WHITE
from bayescal._model.noise_terms import FLAT, TERMS
from bayescal._model.prior import HalfCauchy
from bayescal._model.state_space import filtered, of_means
from bayescal._model.summed_noise import SummedNoise

# Share of the probability of the likeliest noise law of a sensor at rest, from which another one has its share of the
# draws; a tenth of them would be too few for figures of its own.
DRAWN_SHARE = 0.1
# Standard deviations by which the correlation of neighbouring readings must leave that of readings farther apart,
# before noise of neighbours alone (rounding, or the sensor's own averaging) is tried.
NEIGHBOURS_SD = 2.0
# Standard deviations by which a frequency must stand above its neighbours in a record's spectrum, before a tone is
# tried.
LINE_SD = 4.5
# Standard deviations of either, from which every sum has that term; the best one is weighed without it all the same.
SURE_SD = 6.0
# °C, range of a temperature at rest, below which it is taken as constant: two steps of a thermometer that is read to
# 0.1 °C.
STIRRED_DEGREES = 0.2

Terms = tuple[str, ...]  # names of those of a sum, beside white noise
LONG = 16_384  # readings, above which means of blocks are taken: the filter then takes a tenth of a second
STRETCHES = 8  # of single readings beside the means, as many readings as there are means at most
ALONE = ("walk", "flicker", "correlated")  # terms that are weighed one by one, then in pairs
TONE: Terms = ("noise.tone", "noise.tone.frequency", "noise.tone.time")
ROUNDED, AVERAGED = "quantisation", "averaging"  # of neighbouring readings alone; one of them more
# Of five values at 2 to 6: what the straight line through them has at 1.
LINE = 0.2 - 0.3 * np.arange(-2, 3)
WINDOW = 64  # readings of the shortest spectra in which a line is looked for; others are twice as long, and so on
WINDOWS = 8  # of the longest, at least
# Places of a spectrum from a line to what it stands above: a window's own width is 2.
BESIDE = np.array([3, 4, 5, 6])
SMOOTH = 0.02  # relative, of a spectrum without lines over as many places: it bends where one noise takes over another
DEGREE = 3  # of the polynomial over temperature: a sensor's own law is rarely of more in one soak
STARTS = 2  # of the starts tried, those from which a maximum is looked for
SETTLED = 1e-3  # nats that a step of a search for a maximum gains, below which it is found; at 1e-2 0.4 were left
SHIFT = 1e-3  # of a coordinate, for curvatures from slopes
LEAST = 0.05  # curvature of a coordinate, below which its prior has taken over
DRAWS = 512  # of a heavy-tailed Gaussian about the mode
FEWEST = 0.25  # of them, for a sum of little probability or a bound
KEPT = 2048  # of these, drawn anew by their weights, over all sums together
TAILS = 5.0  # its degrees of freedom
ENOUGH = 48.0  # draws of equal weight that tell as much: ends of 95 % are then known to four tenths of a deviation
ROUNDS = 4  # of draws at most, until they tell as much
TOGETHER = 4  # draws whose filters run in one loop: more leave the cache


class _Part(NamedTuple):
    """Readings, or means of as many as said elsewhere, padded by runs of one row of zeros."""

    table: Float[Any, "n q"]  # a level, what else is integrated out, and the output
    first: Float[Any, "n"]  # where runs begin
    within: Float[Any, "n r"]  # 1 for the run that a row is of; none for rows that pad


class RestNoise(NamedTuple):
    """A sum of noise terms fitted to a channel at rest.

    Attributes:
        terms: beside white noise.
        draws: parameters by name, in output units and seconds (d,); equally probable.
        law: with these parameters.
    """

    terms: tuple[str, ...]
    draws: dict[str, np.ndarray]
    law: SummedNoise | None

    def allan_variance(self, factors: Float[np.ndarray, "k"], step: float) -> np.ndarray:
        """Of the law at each draw (d, k), output unit squared."""
        white = self.draws[WHITE] ** 2
        if self.law is None:
            return white[:, None] / factors
        total = white + self.law.slow_variance(self.draws)
        return self.law.allan_variance(self.draws, total, factors, step)


class _AtRest(NamedTuple):
    """A channel in units of its own: the scatter of differences, and steps."""

    parts: tuple[_Part, ...]
    counts: tuple[int, ...]
    size: float  # output units
    step: float  # s
    longest: float  # steps, a power of two
    factors: np.ndarray
    allan: np.ndarray  # variances, in units of size²
    line: Mapping[str, float] = {}  # a tone to begin with, in output units and steps; none if empty

    def law(self, terms: tuple[str, ...]) -> SummedNoise | None:
        return SummedNoise(1.0, self.longest, terms) if terms else None

    def physical(self, terms: tuple[str, ...], own: dict[str, np.ndarray]) -> RestNoise:
        """Parameters in output units and seconds."""
        root = math.sqrt(self.step)
        factors = {"diffusion": self.size / root, "walk": self.size / root}
        factors |= {ROUNDED: self.size * self.step, "time": self.step, "place": 1.0}
        factors["frequency"] = 1 / self.step
        found = {n: v * factors.get(n.rpartition(".")[2], self.size) for n, v in own.items()}
        law = SummedNoise(self.step, self.longest * self.step, terms) if terms else None
        return RestNoise(terms, found, law)


class WeighedNoise(NamedTuple):
    """Sums of noise terms, weighed.

    Attributes:
        drawn: the sums that are probable, the most probable first, each with draws in proportion to its probability.
        walk: the most probable one with a random walk added if it has none: a bound, where none is seen.
        probabilities: of each sum, by its terms, the most probable first.
        notes: what was done to the record, in words.
        runs: of it.
    """

    drawn: tuple[RestNoise, ...]
    walk: RestNoise
    probabilities: dict[tuple[str, ...], float]
    notes: tuple[str, ...]
    runs: EvenRuns


@on_one_thread
def weigh_noise(readings: Measurements, seed: int = 0) -> WeighedNoise:
    """Sums of noise terms on a channel at rest, the first with draws of its parameters.

    Args:
        readings: evenly spaced in time within runs; a column `temperature` is taken out as a cubic, if it moves.
        seed: of the draws.

    Raises:
        InputError: no column `time`, no run of 30 readings, uneven steps, or an output that is rounded too coarsely.
    """
    runs = even_runs(readings)
    channel, notes = _channel(readings, runs)
    fits: dict[Terms, _Fit] = {(): _fit(channel, ())}
    output = np.asarray(readings["output"], float)
    (brief, surely), (clear, line) = _of_neighbours(output, runs), _line(output, runs)
    channel = channel._replace(line=line)
    limits = {brief: (surely, NEIGHBOURS_SD), "tone": (clear, LINE_SD)}
    further = tuple(term for term, (sigmas, limit) in limits.items() if sigmas > limit)
    kept = tuple(term for term in further if limits[term][0] > SURE_SD)
    among = (*ALONE, *further)
    for term in among:
        terms = (term,) if term in further else _sorted((*kept, term))
        fits[terms] = _fit(channel, terms)
    looked: Terms = ()
    while (best := max(fits, key=lambda t: _total(fits, t))) != looked:
        looked = best
        known = dict(zip(_priors(channel.law(best)), fits[best].mode, strict=True))
        for terms in _beside(best, among):
            if terms not in fits:
                fits[terms] = _fit(channel, terms, known)
    # What is correlated over a few readings looks like them too.
    for term in kept:
        if (without := tuple(t for t in best if t != term)) not in fits:
            fits[without] = _fit(channel, without)
    sampled: dict[Terms, _Sampled] = {}
    while True:
        order = sorted(fits, key=lambda t: -_total(fits, t))
        totals = np.array([_total(fits, t) for t in order])
        probabilities = dict(zip(order, softmax(totals).tolist(), strict=True))
        least = DRAWN_SHARE * probabilities[order[0]]
        probable = [t for t in order if probabilities[t] > least]
        if not (fresh := [t for t in probable if t not in sampled]):
            break
        # By the weights of draws a sum whose posterior is bent has less evidence than by its curvature at the mode.
        for terms in fresh:
            sampled[terms] = _sampled(channel, terms, fits[terms], seed, probabilities[terms])
            fits[terms] = fits[terms]._replace(log_evidence=sampled[terms].log_evidence)
    drawn = [_drawn(channel, t, sampled[t], seed, probabilities[t]) for t in probable]
    walk = drawn[0]
    if "walk" not in walk.terms:
        further = _sorted((*walk.terms, "walk"))
        if further not in sampled:
            fit = fits.get(further) or _fit(channel, further)
            sampled[further] = _sampled(channel, further, fit, seed, FEWEST)
        walk = _drawn(channel, further, sampled[further], seed, FEWEST)
    return WeighedNoise(tuple(drawn), walk, probabilities, tuple(notes), runs)


def _sorted(terms: Terms) -> Terms:
    """As a sum has them."""
    return tuple(sorted(terms, key=list(TERMS).index))


def _beside(terms: Terms, among: Terms) -> Iterator[Terms]:
    """Sums of one term more; and where there are two slow terms, the most that there may be, with one exchanged.

    Noise of neighbours is of the shortest times and says nothing of the slow terms: it does not count.
    """
    slow = [at for at, term in enumerate(terms) if term in ALONE]
    shorter = [terms[:at] + terms[at + 1 :] for at in slow] if len(slow) > 1 else [terms]
    for term in among:
        for rest in shorter if term in ALONE else [terms]:
            if term not in rest or term == "correlated":
                yield _sorted((*rest, term))


def _of_neighbours(output: Float[np.ndarray, "n"], runs: EvenRuns) -> tuple[str, float]:
    """The noise of neighbouring readings alone that a record may have, and how surely, in standard deviations.

    Half the mean square of differences k readings apart is γ₀ − γₖ, which slow noise lets rise steadily: where it
    begins above or below what it comes to from two apart on, neighbours alone are correlated.
    """
    squares, counts = np.zeros(len(LINE) + 1), np.zeros(len(LINE) + 1)
    for rows in runs.rows:
        for k in range(1, min(len(rows), len(squares) + 1)):
            apart = output[rows[k:]] - output[rows[:-k]]
            squares[k - 1] += 0.5 * float(apart @ apart)
            counts[k - 1] += len(apart)
    rise = squares / counts
    expected = float(LINE @ rise[1:])
    # Each γₖ of n readings of white noise, of the variance γ₀, has the variance γ₀²/n.
    deviation = abs(expected) * math.sqrt((1 + float(LINE @ LINE)) / counts[0])
    surely = (rise[0] - expected) / deviation
    return (ROUNDED if surely > 0 else AVERAGED), abs(surely)


def _line(output: Float[np.ndarray, "n"], runs: EvenRuns) -> tuple[float, dict[str, float]]:
    """How surely the longest run has a narrow line, in standard deviations; and a tone to begin with, for one reading.

    A frequency counts against the geometric mean of both sides, which takes out any slope of the spectrum; of the mean
    of k windows, the logarithm of this ratio has a standard deviation of about 1/√k.
    """
    run, best, found = output[max(runs.rows, key=len)], 0.0, dict[str, float]()
    length = WINDOW
    while (count := len(run) // length) >= WINDOWS:
        parts = run[: count * length].reshape(count, length)
        window = np.hanning(length)
        lines = np.fft.rfft((parts - parts.mean(axis=1)[:, None]) * window, axis=1)
        # One-sided, so that its mean over frequencies to ½ per reading is twice the variance.
        power = 2 * np.mean(np.abs(lines) ** 2, axis=0) / float(window @ window)
        at = np.arange(BESIDE[-1] + 1, len(power) - BESIDE[-1] - 1)
        low, high = (power[at[:, None] + sign * BESIDE].mean(axis=1) for sign in (-1, 1))
        around = np.sqrt(low * high)
        sigmas = np.log(power[at] / around) / (1 / math.sqrt(count) + SMOOTH)
        if sigmas[k := int(np.argmax(sigmas))] > best:
            # Such a window spreads a line over 1.5 places.
            size = math.sqrt(1.5 * float(power[at[k]] - around[k]) / length)
            best, tone = float(sigmas[k]), (size, float(at[k]) / length, float(length))
            found = dict(zip(TONE, tone, strict=True))
        length *= 2
    return best, found


def _total(fits: dict[Terms, _Fit], terms: tuple[str, ...]) -> float:
    """Log evidence and log prior: white noise has one half of it, other sums that are weighed share the rest."""
    others, nothing = max(1, len(fits) - 1), settings().prior_complete
    return fits[terms].log_evidence + math.log(nothing if not terms else (1 - nothing) / others)


def _channel(readings: Measurements, runs: EvenRuns) -> tuple[_AtRest, list[str]]:
    output, notes = np.asarray(readings["output"], float), []
    rows = [r for r in runs.rows if len(r) > 1]
    jumps = np.concatenate([np.diff(output[r]) for r in rows])
    size = float(np.median(np.abs(jumps - np.median(jumps)))) * 1.4826 / math.sqrt(2)
    if not size > 0:
        raise InputError(
            f"{readings.file}: more than half of the readings are equal to their neighbours, so the output is rounded "
            "more coarsely than its noise: record it with more digits"
        )
    columns = [np.ones(len(output))]
    if readings.has("temperature") and float(np.ptp(readings["temperature"])) > STIRRED_DEGREES:
        t = np.asarray(readings["temperature"], float)
        t = 2 * (t - t.min()) / np.ptp(t) - 1
        columns += list(np.polynomial.legendre.legvander(t, DEGREE)[:, 1:].T)
        notes.append(
            f"a polynomial of degree {DEGREE} over temperature was taken out beside the noise"
        )
    table = np.column_stack([*columns, (output - np.median(output)) / size])
    total = sum(len(r) for r in rows)
    count = 2 ** max(0, math.ceil(math.log2(total / LONG)))
    parts, counts = [], []
    if count > 1:
        whole = [r[: len(r) // count * count].reshape(-1, count) for r in rows if len(r) >= count]
        parts.append(_part([table[r].mean(axis=1) for r in whole]))
        counts.append(count)
        rows = _stretches(rows, LONG // STRETCHES)
        notes.append(
            f"of {total} readings the filter took {sum(map(len, whole))} means of {count} by their exact law, and "
            f"{len(rows)} stretches of {len(rows[0])} single readings"
        )
    parts.append(_part([table[r] for r in rows]))
    counts.append(1)
    longest = 2.0 ** math.ceil(math.log2(max(len(r) for r in runs.rows)))
    variance, _ = overlapping(output / size, runs)
    made = _AtRest(tuple(parts), tuple(counts), size, runs.step, longest, runs.factors, variance)
    return made, notes


def _stretches(rows: Sequence[np.ndarray], length: int) -> list[np.ndarray]:
    """Stretches of neighbours, evenly over the runs."""
    each = max(1, STRETCHES // len(rows))
    found = []
    for r in sorted(rows, key=len, reverse=True)[:STRETCHES]:
        size = min(length, len(r) // each)
        starts = np.linspace(0, len(r) - size, each).astype(int)
        found += [r[s : s + size] for s in starts]
    return found


def _part(runs: Sequence[Float[np.ndarray, "k q"]]) -> _Part:
    lengths = [len(run) for run in runs]
    total = sum(lengths)
    more = padded_length(total) - total
    first = np.ones(total + more, bool)
    first[:total] = False
    first[np.cumsum([0, *lengths[:-1]])] = True
    within = np.repeat(np.eye(len(runs)), lengths, axis=0)
    table = np.concatenate(runs)
    return _Part(np.pad(table, ((0, more), (0, 0))), first, np.pad(within, ((0, more), (0, 0))))


# one sum -------------------------------------------------------------------------------------------------------------


class _Fit(NamedTuple):
    log_evidence: float
    mode: Float[np.ndarray, "d"]
    covariance: Float[np.ndarray, "d d"]


def _priors(law: SummedNoise | None) -> dict[str, Any]:
    return {WHITE: HalfCauchy(1.0)} if law is None else law.parameters()


def _log_posterior(
    law: SummedNoise | None, counts: tuple[int, ...], parts: tuple[_Part, ...], v: Array
) -> Array:
    """Of coordinates v, levels and the polynomial integrated out under a flat prior."""
    priors = _priors(law)
    values = {name: prior.value(v[i]) for i, (name, prior) in enumerate(priors.items())}
    total = sum(prior.log_density(v[i]) for i, prior in enumerate(priors.values()))
    gram: Any = 0.0
    for part, count in zip(parts, counts, strict=True):
        own = jnp.full(part.first.shape, values[WHITE] ** 2 / count)
        if law is None:
            white, log_sd = part.table / jnp.sqrt(own)[:, None], 0.5 * jnp.log(own)
        else:
            if count == 1:
                states = law.states(values, jnp.where(part.first, -1.0, 1.0))
            else:
                one = law.states(values, jnp.array([-1.0, 1.0]))
                states = of_means(one, count, part.first)
            white, log_sd = filtered(states, own, part.table)
        # Runs are independent: one column of ones, whitened, is the levels of them all, and these are orthogonal.
        level, rest = white[:, 0], white[:, 1:]
        precision = part.within.T @ level**2
        shared = part.within.T @ (level[:, None] * rest)
        gram = gram + rest.T @ rest - shared.T @ (shared / precision[:, None])
        total = total - part.within.sum(axis=1) @ log_sd - 0.5 * jnp.sum(jnp.log(precision))
    factor = jnp.linalg.cholesky(gram)  # its last row: what the other columns leave of the output
    return total - jnp.sum(jnp.log(jnp.diag(factor)[:-1])) - 0.5 * factor[-1, -1] ** 2


@partial(jax.jit, static_argnums=(0, 1))
def _with_slopes(law, counts, parts, v):
    return jax.value_and_grad(lambda at: _log_posterior(law, counts, parts, at))(v)


@partial(jax.jit, static_argnums=(0, 1))
def _abreast(law, counts, parts, vs):
    return jax.vmap(lambda v: _log_posterior(law, counts, parts, v))(vs)


def _several(channel: _AtRest, law: SummedNoise | None, vs: np.ndarray) -> np.ndarray:
    """Log posteriors of many, some at once: as many in each call, so that one program serves."""
    found = []
    for start in range(0, len(vs), TOGETHER):
        pick = np.minimum(np.arange(start, start + TOGETHER), len(vs) - 1)
        made = np.asarray(_abreast(law, channel.counts, channel.parts, vs[pick]))
        found.append(made[: len(vs) - start])
    return np.nan_to_num(np.concatenate(found), nan=-np.inf)


def _fit(channel: _AtRest, terms: Terms, known: Mapping[str, float] | None = None) -> _Fit:
    """The mode and the curvature there.

    Args:
        terms: of the sum.
        known: coordinates at the mode of a part of it, by name: a search begins there and at the best start beside.
    """
    law = channel.law(terms)
    priors = _priors(law)

    def down(v: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = _with_slopes(law, channel.counts, channel.parts, v)
        if not math.isfinite(float(value)):
            return math.inf, np.zeros(len(v))
        return -float(value), -np.asarray(slope)

    # By the same program as the slopes: one for values alone would take longer to compile than it saves here.
    starts = list(_starts(channel, terms, priors))
    if known is not None:
        least = starts[-1]  # further terms as small as any start has them
        starts.append(np.array([known.get(n, v) for n, v in zip(priors, least, strict=True)]))
    there = [down(start)[0] for start in starts]
    settled = {"ftol": SETTLED / max(1.0, min(map(abs, there)))}
    tries = [
        minimize(down, starts[i], jac=True, method="L-BFGS-B", options=settled)
        for i in np.argsort(there)[:STARTS]
    ]
    best = min(tries, key=lambda t: t.fun)
    weights, vectors = np.linalg.eigh(curvature(lambda at: -down(at)[1], best.x, SHIFT))
    weights = np.maximum(weights, LEAST)
    evidence = -float(best.fun) + 0.5 * len(best.x) * LOG_2PI - 0.5 * float(np.sum(np.log(weights)))
    return _Fit(evidence, best.x, (vectors / weights) @ vectors.T)


def _starts(
    channel: _AtRest, terms: tuple[str, ...], priors: dict[str, Any]
) -> Iterator[np.ndarray]:
    """Coordinates, from the Allan curve: each term as large as the curve lets it be, times in several places."""
    m, allan = channel.factors, channel.allan
    walk = math.sqrt(3 * allan[-1] / m[-1])
    sizes = {
        "noise.walk": walk,
        "noise.flicker": math.sqrt(float(np.min(allan)) / FLAT),
        "noise.quantisation": math.sqrt(allan[0] / 3),
        "noise.averaging": math.sqrt(allan[0]),
    }
    if channel.line:
        sizes |= {TONE[0]: channel.line[TONE[0]] / channel.size, TONE[1]: channel.line[TONE[1]]}
    places = [0.2, 0.5, 0.8]
    alike, memories = terms.count("correlated"), (0.25, 2.0) if "tone" in terms else (1.0,)
    several = itertools.combinations(places, alike) if alike else [()]
    for shares, memory in itertools.product(several, memories):
        times = [channel.longest**share for share in shares]
        values = {WHITE: math.sqrt(allan[0]), **sizes}
        values |= {TONE[2]: memory * channel.line[TONE[2]]} if channel.line else {}
        before = 1.0
        for k, time in enumerate(times, 1):
            variance = 1.6 * float(np.interp(math.log(2 * time), np.log(m), allan))
            values[f"noise.correlated{k}.diffusion"] = math.sqrt(2 * variance / time)
            values[f"noise.correlated{k}.time"] = time
            part = math.log(time / before) / math.log(channel.longest / before)
            values[f"noise.correlated{k}.place"] = float(ndtri(np.clip(part, 5e-4, 1 - 5e-4)))
            before = time
        for factor in (1.0, 0.3):
            held = (".time", ".place", ".frequency")
            kept = {n for n in values if n == WHITE or n.endswith(held)}
            scaled = {n: v * (1 if n in kept else factor) for n, v in values.items()}
            yield np.array([float(p.coordinate(scaled[n])) for n, p in priors.items()])


def _log_density(
    v: Float[np.ndarray, "n d"], middle: Float[np.ndarray, "d"], root: Float[np.ndarray, "d d"]
) -> Float[np.ndarray, "n"]:
    """Of the heavy-tailed Gaussian, Student's t."""
    moved, d = solve_triangular(root, (v - middle).T, lower=True), v.shape[1]
    far = np.log1p(np.sum(moved**2, axis=0) / TAILS)
    volume = 0.5 * d * math.log(math.pi * TAILS) + float(np.sum(np.log(np.diag(root))))
    of_tails = float(gammaln((TAILS + d) / 2) - gammaln(TAILS / 2))
    return of_tails - volume - 0.5 * (TAILS + d) * far


class _Sampled(NamedTuple):
    v: Float[np.ndarray, "n d"]
    weight: Float[np.ndarray, "n"]
    log_evidence: float


def _sampled(channel: _AtRest, terms: Terms, fit: _Fit, seed: int, share: float) -> _Sampled:
    """Coordinates by importance sampling from heavy-tailed Gaussians, the first about the mode.

    All rounds count together, each draw against the mean density of all Gaussians (J.-M. Cornuet et al., Adaptive
    multiple importance sampling, Scand. J. Stat. 39 (2012) 798).

    Args:
        share: of all draws; a sum of little probability has few of those that are kept.
    """
    law, random = channel.law(terms), np.random.default_rng(seed)
    share, d = max(share, FEWEST), len(fit.mode)
    enough, tried = ENOUGH * share, TOGETHER * math.ceil(DRAWS / TOGETHER * share)
    about: list[tuple[np.ndarray, np.ndarray]] = []  # middles and roots
    v, posterior = np.zeros((0, d)), np.zeros(0)
    middle, covariance = fit.mode, fit.covariance
    for _ in range(ROUNDS):
        about.append((middle, np.linalg.cholesky(covariance)))
        stretch = np.sqrt(TAILS / random.chisquare(TAILS, tried))
        new = middle + (random.standard_normal((tried, d)) * stretch[:, None]) @ about[-1][1].T
        v, posterior = np.concatenate([v, new]), np.append(posterior, _several(channel, law, new))
        log_weight = posterior - np.logaddexp.reduce([_log_density(v, *one) for one in about])
        weight = softmax(log_weight)
        if effective_size(weight) >= enough:
            break
        # Where the posterior bends away from its curvature at the mode, the next draws lie as all so far do by their
        # weights, flattened to a power at which enough of them count.
        likely = np.isfinite(log_weight)
        power, some = 1.0, v[likely]
        while effective_size(flat := softmax(power * log_weight[likely])) < min(
            enough, len(some) / 2
        ):
            power *= 0.8
        middle, covariance = flat @ some, np.cov(some.T, aweights=flat).reshape(d, d)
    return _Sampled(v, weight, float(np.logaddexp.reduce(log_weight)) - math.log(tried))


def _drawn(channel: _AtRest, terms: Terms, sampled: _Sampled, seed: int, share: float) -> RestNoise:
    """Parameters of equal probability, drawn anew by their weights.

    Args:
        share: of all draws that are kept.
    """
    count = max(1, round(share * KEPT))
    chosen = sampled.v[np.sort(resample(sampled.weight, count, seed))]
    priors = _priors(channel.law(terms))
    own = {n: np.asarray(p.value(chosen[:, i])) for i, (n, p) in enumerate(priors.items())}
    return channel.physical(terms, own)
