"""Noise of a sensor at rest: Q, N, B and K of IEEE 952 with intervals, by the likelihood of sums of noise terms.

Every sum is fitted to the spectrum of the readings, levels of runs and a cubic over temperature integrated out beside
it (restricted likelihood); the sums are weighed by their evidence, and the parameters of the probable ones drawn by
importance sampling. Lost readings are drawn from the noise law, given the others, and the sums fitted anew (data
augmentation).

N is the density along which the Allan deviation falls with slope −½ (IEEE 952, C.1.2). A low-pass, a moving average, an
interpolation or a held output correlates readings over times shorter than those: where the deviation falls so only from
means of m readings on, all is read from these means. Of a process that is short against T they are white noise, but for
a correlation of neighbours.

Sources: D. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood); M. Tanner and W. Wong, J. Am. Stat.
Assoc. 82 (1987) 528 (data augmentation); IEEE Std 952-1997, Annex C.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.polynomial.legendre import legvander
from scipy.fft import dct, idct
from scipy.special import ndtri, softmax

from bayescal._calibration.claim import Claim
from bayescal._core import deadline
from bayescal._core.errors import InputError
from bayescal._core.importance_weights import resample
from bayescal._core.parallel import on_one_thread
from bayescal._core.settings import settings
from bayescal._data.allan_deviation import EvenRuns, degrees_of_freedom, even_runs, overlapping
from bayescal._data.measurements import Measurements
from bayescal._inference.density import NOWHERE
from bayescal._inference.newton import ByValues, GaussianFit, climb, gaussian_fit
from bayescal._inference.noise_nodes import EvenSpectrum
from bayescal._inference.sampling import importance_draws
from bayescal._model.noise_law import WHITE
from bayescal._model.noise_spectrum import eigenvalues
from bayescal._model.noise_terms import FLAT, TERMS
from bayescal._model.prior import HalfCauchy, Positive
from bayescal._model.summed_noise import SummedNoise, SumOfTerms

# Share of the probability of the likeliest noise law of a sensor at rest, from which another one has its share of the
# draws; a tenth of them would be too few for figures of its own.
DRAWN_SHARE = 0.1
# Standard deviations by which the correlation of neighbouring readings must leave that of readings farther apart,
# before quantisation noise is tried, or means are taken.
NEIGHBOURS_SD = 2.0
# Standard deviations by which a frequency must stand above its neighbours in a record's spectrum, before a tone is
# tried.
LINE_SD = 4.5
# Standard deviations of either, from which every sum has that term; the best one is weighed without it all the same.
SURE_SD = 6.0
# Slope of the Allan deviation over two octaves where it falls along N: of what is left of a low-pass of the time T it
# is so steep from means over 3.4·T on, of which only neighbours are correlated by more than a hundredth.
LEVEL_SLOPE = -0.35
FEWEST_MEANS = 64  # whose slope is known to 0.1
HELD_SHARE = 0.05  # of neighbours that are equal, from which an output with digits enough is held
MAX_HELD_RATIO = 4.0  # of the time for which a value stands, to the mean
SHORT_STEPS = 3.0  # correlation time, below which a process is part of N: its density is level over these octaves
# °C, range of a temperature at rest, below which it is taken as constant: two steps of a thermometer that is read to
# 0.1 °C.
STIRRED_DEGREES = 0.2


Terms = tuple[str, ...]  # names of those of a sum, beside white noise
DEGREE = 3  # of the polynomial over temperature: a sensor's own law is rarely of more in one soak
IMPUTATIONS = 6  # of lost readings; the first begins far from them and does not count
SLOW = ("walk", "flicker", "correlated")  # terms of which a sum has two at most,
NOT_TWICE = (("walk", "walk"), ("flicker", "flicker"))  # but none of these
TONE: Terms = ("noise.tone", "noise.tone.frequency", "noise.tone.time")
ROUNDED, AVERAGED = "quantisation", "averaging"  # of neighbouring readings alone
# Of five values at 2 to 6: what the straight line through them has at 1.
LINE = 0.2 - 0.3 * np.arange(-2, 3)
WINDOW = 64  # readings of the shortest spectra in which a line is looked for; others are twice as long, and so on
WINDOWS = 8  # of the longest, at least
# Places of a spectrum from a line to what it stands above: a window's own width is 2.
BESIDE = np.array([3, 4, 5, 6])
LINE_BLOCKS = 256  # of a run, along which the phase of a line is followed
COHERENT_SHARE = 0.25  # of the longest run, for which a line keeps its phase
SMOOTH = 0.02  # relative, of a spectrum without lines over as many places: it bends where one noise takes over another
STARTS = 2  # of the starts tried, those from which a maximum is looked for
DRAWS = 2048  # of each sum
KEPT = 2048  # of them by their weights, over all sums together


class RestingSum(SumOfTerms):
    """A sum of terms on evenly spaced readings; unlike `SummedNoise` it may be white noise alone.

    Attributes:
        shortest, longest: the step between readings, and about that of the longest run, s.
        terms: beside white noise; there may be none.
        scale, correlated: priors of standard deviations, output unit.
    """

    shortest: float
    longest: float
    terms: tuple[str, ...]
    scale: Positive = HalfCauchy(1.0)
    correlated: Positive = HalfCauchy(1.0)
    gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "sum_at_rest"
    independent: ClassVar[bool] = False


class RestNoise(NamedTuple):
    """A sum of noise terms fitted to a channel at rest.

    Attributes:
        terms: beside white noise.
        draws: parameters by name, in output units and seconds (d,); equally probable.
        law: with these parameters.
    """

    terms: tuple[str, ...]
    draws: dict[str, np.ndarray]
    law: SumOfTerms

    def density(self, step: float) -> Float[np.ndarray, "d"]:
        """Return N at each draw, output unit times √s, of readings `step` s apart.

        White noise, as it is or averaged, and each Ornstein–Uhlenbeck process of a few steps: of the variance s² and a
        correlation ρ of neighbours it has the spectral density s²·(1 + ρ)/(1 − ρ) per reading at low frequencies.
        """
        variance = self.draws[WHITE] ** 2 + self.draws.get(f"noise.{AVERAGED}", 0.0) ** 2
        derived = {**self.draws, **self.law.derived(self.draws)}
        for place in range(1, 1 + self.terms.count("correlated")):
            size, time = (derived[f"noise.correlated{place}.{what}"] for what in ("size", "time"))
            short = time <= SHORT_STEPS * step
            variance = variance + np.where(short, size**2 / np.tanh(0.5 * step / time), 0.0)
        return np.sqrt(variance * step)

    def allan_variance(self, factors: Float[np.ndarray, "k"], step: float) -> np.ndarray:
        """Of the law at each draw (d, k), output unit squared."""
        total = self.draws[WHITE] ** 2 + self.law.slow_variance(self.draws)
        return self.law.allan_variance(self.draws, total, factors, step)


class _AtRest(NamedTuple):
    """A channel at rest.

    Attributes:
        columns: of its runs (n, r), the last the output, the others taken out.
        spectrum: of these.
        size: standard deviation of neighbours, output unit.
        longest: run, a power of two of steps, s.
        tau: averaging times, s,
        allan: and variances, output unit squared.
        line: a tone to begin with; none if empty.
    """

    columns: Sequence[Float[np.ndarray, "n r"]]
    spectrum: EvenSpectrum
    size: float
    longest: float
    tau: np.ndarray
    allan: np.ndarray
    line: Mapping[str, float]

    def law(self, terms: Terms) -> RestingSum:
        scale = HalfCauchy(self.size)
        return RestingSum(self.spectrum.step, self.longest, terms, scale, scale)

    def log_density(self, terms: Terms) -> Callable[[Float[np.ndarray, "s d"]], np.ndarray]:
        """Return the log posterior density of coordinates of a sum's parameters, levels and curve integrated out."""
        law = self.law(terms)
        priors = law.parameters()

        def values(v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
            own = {n: p.value(v[:, i]) for i, (n, p) in enumerate(priors.items())}
            prior = sum(p.log_density(v[:, i]) for i, p in enumerate(priors.values()))
            found = self.spectrum.log_likelihood(law, own) + prior
            return np.where(np.isfinite(found), found, NOWHERE)

        return values


class WeighedNoise(NamedTuple):
    """Sums of noise terms, weighed.

    Attributes:
        drawn: the sums that are probable, the most probable first, each with draws in proportion to its probability.
        walk: the most probable one with a random walk added if it has none: a bound, where none is seen.
        probabilities: of each sum, by its terms, the most probable first.
        claims: what was done to the record.
        readings: the record, or means of it, that the sums are of.
        runs: of these.
        count: readings in each mean; None where the Allan deviation nowhere falls with slope −½.
    """

    drawn: tuple[RestNoise, ...]
    walk: RestNoise
    probabilities: dict[tuple[str, ...], float]
    claims: tuple[Claim, ...]
    readings: Measurements
    runs: EvenRuns
    count: int | None


@on_one_thread
def weigh_noise(readings: Measurements, seed: int = 0) -> WeighedNoise:
    """Sums of noise terms on a channel at rest, the probable ones with draws of their parameters.

    Args:
        readings: evenly spaced in time within runs; a column `temperature` is taken out as a cubic, if it moves.
        seed: of the draws.

    Raises:
        InputError: no column `time`, no run of 30 readings, uneven steps, or an output that is rounded too coarsely.
    """
    output = np.asarray(readings["output"], float)
    runs = _without_repeats(output, even_runs(readings))
    count = _level_count(output, runs)
    # Means of a process that is short against their time are white, but for what neighbours share.
    base: Terms = ()
    if count is not None and count > 1:
        readings, runs = _means_of(readings, runs, count)
        base = (AVERAGED,)
    columns, size, claims = _columns(readings, runs)
    output = np.asarray(readings["output"], float)
    clear, line = _line(output, runs)
    limits = {"tone": (clear, LINE_SD)}
    if not base:
        negative = _negative(output, runs)
        limits[ROUNDED if negative > 0 else AVERAGED] = abs(negative), NEIGHBOURS_SD
    further = tuple(term for term, (sigmas, limit) in limits.items() if sigmas > limit)
    kept = tuple(term for term in further if limits[term][0] > SURE_SD)
    variance, _ = overlapping(output, runs)
    longest = runs.step * 2.0 ** math.ceil(math.log2(max(runs.lengths)))
    per_reading = dict(zip(TONE, (1.0, 1 / runs.step, runs.step), strict=True))
    line = {name: per_reading[name] * value for name, value in line.items()}
    made = size, longest, runs.factors * runs.step, variance, line
    law, values = RestingSum(runs.step, longest, ("walk",)), {WHITE: size}
    values["noise.walk"] = math.sqrt(3 * variance[-1] / (runs.factors[-1] * runs.step))
    random, found = np.random.default_rng(seed), list[WeighedNoise]()
    end = deadline.current()
    end.defer_interrupt()
    for k in range(IMPUTATIONS if runs.lost else 1):
        filled = [_filled(own, law, values, runs.step, random) for own in columns]
        lines = [line[TONE[1]]] if "tone" in further else []
        channel = _AtRest(filled, EvenSpectrum(filled, runs.step, lines), *made)
        fits: dict[Terms, GaussianFit] = {base: _fit(channel, base, {})}
        try:
            for terms in _sums(fits, base, further, kept):
                end.ask()
                fits[terms] = _fit(channel, terms, fits)
        except deadline.TimeIsUp:
            claims.append(Claim("noise.ended", why=end.why))
        drawn, walk, probabilities = _drawn_sums(channel, fits, seed + k)
        found.append(WeighedNoise(tuple(drawn), walk, probabilities, (), readings, runs, count))
        law, values = drawn[0].law, {n: float(d[0]) for n, d in drawn[0].draws.items()}
        if end.over:
            break
    return _pooled(found[-(IMPUTATIONS - 1) :])._replace(claims=tuple(claims))


def _pooled(parts: Sequence[WeighedNoise]) -> WeighedNoise:
    """Return the mixture of what several imputations of lost readings say."""
    mean = Counter[Terms]()
    for one in parts:
        mean.update({terms: p / len(parts) for terms, p in one.probabilities.items()})
    drawn = sorted((n for one in parts for n in one.drawn), key=lambda n: -mean[n.terms])
    bound = {"noise.walk": np.concatenate([one.walk.draws["noise.walk"] for one in parts])}
    last, walk = parts[-1], parts[-1].walk._replace(draws=bound)
    return last._replace(drawn=tuple(drawn), walk=walk, probabilities=dict(mean.most_common()))


def _sums(
    fits: Mapping[Terms, GaussianFit], base: Terms, further: Terms, kept: Terms
) -> Iterator[Terms]:
    """Yield the sums that are weighed beside the least one: of two slow terms at most, and any of `further`.

    Args:
        fits: of those before.
        base: terms of the least sum, which every sum has;
        further: terms of neighbouring readings, or a tone, that may be there;
        kept: and those of them that every other sum has; the best one is weighed without each of them at the end.
    """
    pairs = [p for p in itertools.combinations_with_replacement(SLOW, 2) if p not in NOT_TWICE]
    brief = [
        {*some, *kept}
        for k in range(len(further) + 1)
        for some in itertools.combinations(further, k)
    ]
    slow = [(), *((term,) for term in SLOW), *pairs]
    sums = {_sorted((*base, *one, *b)) for one in slow for b in brief} - {base}
    yield from sorted(sums, key=lambda terms: (len(terms), terms))
    # What is correlated over a few readings looks like these terms too.
    best = next(iter(_totals(fits)))
    yield from {tuple(t for t in best if t != term) for term in kept} - {*fits}


def _drawn_sums(
    channel: _AtRest, fits: dict[Terms, GaussianFit], seed: int
) -> tuple[list[RestNoise], RestNoise, dict[Terms, float]]:
    """Draws of the probable sums, of the most probable one with a random walk, and the probability of each."""
    sampled = dict[Terms, tuple[np.ndarray, np.ndarray]]()  # and their weights

    def sample(terms: Terms) -> float:
        values = channel.log_density(terms)
        v, weights, evidence = importance_draws(values, fits[terms], seed, DRAWS)
        sampled[terms] = v, weights
        return evidence

    while True:
        totals = _totals(fits)
        shares = softmax(list(totals.values()))
        probabilities = dict(zip(totals, shares.tolist(), strict=True))
        probable = [t for t, share in probabilities.items() if share > DRAWN_SHARE * shares[0]]
        if not (fresh := [t for t in probable if t not in sampled]):
            break
        # By the weights of draws a sum whose posterior is bent has less evidence than by its curvature at the mode.
        for terms in fresh:
            fits[terms] = fits[terms]._replace(log_evidence=sample(terms))
    drawn = [_drawn(channel, t, *sampled[t], seed, probabilities[t]) for t in probable]
    walk = drawn[0]
    if "walk" not in walk.terms:
        further = _sorted((*walk.terms, "walk"))
        if further not in fits:
            fits[further] = _fit(channel, further, fits)
        if further not in sampled:
            sample(further)
        walk = _drawn(channel, further, *sampled[further], seed, 1.0)
    return drawn, walk, probabilities


def _changes(output: Float[np.ndarray, "n"], runs: EvenRuns) -> Float[np.ndarray, "k"]:
    """Return the differences of neighbouring readings."""
    changes = np.concatenate([np.diff(own) for own in runs.of(output)])
    return changes[np.isfinite(changes)]


def _without_repeats(output: Float[np.ndarray, "n"], runs: EvenRuns) -> EvenRuns:
    """Return the first reading of each value of a held output, at their mean step; of another one, all readings.

    Of neighbours that differ by about m, 0.27·g/m are equal by rounding to steps of g; of a held output many more are,
    and no value stands much longer than others, as in one that is stuck for a while.
    """
    changes = np.abs(_changes(output, runs))
    changed = changes[changes > 0]
    least = np.min(np.diff(np.unique(output)), initial=math.inf)
    rounded = least / np.median(changed) if len(changed) else 1.0
    there = [r[r >= 0] for r in runs.rows]
    first = [np.append(True, np.diff(output[own]) != 0) for own in there]
    longest = max(int(np.diff(np.flatnonzero(f), append=len(f)).max()) for f in first)
    held = len(changed) < (1 - max(HELD_SHARE, rounded)) * len(changes)
    if not held or longest * len(changed) > MAX_HELD_RATIO * len(changes):
        return runs
    span = sum(len(r) - 1 for r in runs.rows) * runs.step
    rows = tuple(own[f] for own, f in zip(there, first, strict=True))
    return EvenRuns(rows, span / sum(len(r) - 1 for r in rows))


def _level_count(output: Float[np.ndarray, "n"], runs: EvenRuns) -> int | None:
    """Return how many readings a mean has from which on the Allan deviation falls with slope −½; None if none has.

    A narrow line is left out: its Allan deviation rises and falls over a period. Single readings are taken where they
    may be level, by two standard deviations, and are not correlated with their neighbours: with others they were, too.
    """
    clear, line = _line(output, runs)
    variance, _ = overlapping(output, runs)
    if clear > LINE_SD:
        law = SummedNoise(1.0, 2.0 * len(output), ("tone",))
        variance -= law.allan_variance({WHITE: 0.0, **line}, line[TONE[0]] ** 2, runs.factors, 1.0)
    limit = 4.0 ** (2 * LEVEL_SLOPE) * variance[:-2]
    limit[:1] *= 1 + NEIGHBOURS_SD * np.sqrt(
        2 / degrees_of_freedom(runs, np.zeros(len(variance)))[2:3]
    )
    level = variance[2:] <= limit
    level[1:] &= sum(runs.lengths) >= FEWEST_MEANS * runs.factors[1:-2]
    level[:1] &= clear > LINE_SD or _negative(output, runs) > -NEIGHBOURS_SD
    return int(runs.factors[np.argmax(level)]) if level.any() else None


def _means_of(readings: Measurements, runs: EvenRuns, count: int) -> tuple[Measurements, EvenRuns]:
    """Return means of `count` readings that follow each other; one of fewer than half of them is lost."""
    parts = [r[: len(r) // count * count].reshape(-1, count) for r in runs.rows if len(r) >= count]
    there = [2 * np.sum(part >= 0, axis=1) >= count for part in parts]
    full = np.concatenate([part[own] for part, own in zip(parts, there, strict=True)])
    means = readings.select(full.max(axis=1))
    for name in readings.columns:
        if readings.unit(name) is not None:
            means = means.with_column(name, _means(readings[name], full))
    place = np.split(np.cumsum(np.concatenate(there)) - 1, np.cumsum([len(t) for t in there])[:-1])
    rows = tuple(np.where(own, at, -1) for own, at in zip(there, place, strict=True))
    return means, EvenRuns(rows, count * runs.step)


def _sorted(terms: Terms) -> Terms:
    """As a sum has them."""
    return tuple(sorted(terms, key=list(TERMS).index))


def _negative(output: Float[np.ndarray, "n"], runs: EvenRuns) -> float:
    """Return how surely neighbours are correlated negatively, as rounded angles are, in standard deviations.

    Half the mean square of differences k readings apart is γ₀ − γₖ, which slow noise lets rise steadily: where it
    begins above what it comes to from two apart on (or below), neighbours are correlated negatively (or positively).
    """
    squares, counts = np.zeros(len(LINE) + 1), np.zeros(len(LINE) + 1)
    for own in runs.of(output):
        for k in range(1, min(len(own), len(squares) + 1)):
            apart = own[k:] - own[:-k]
            apart = apart[np.isfinite(apart)]
            squares[k - 1] += 0.5 * float(apart @ apart)
            counts[k - 1] += len(apart)
    rise = squares / counts
    expected = float(LINE @ rise[1:])
    # Each γₖ of n readings of white noise, of the variance γ₀, has the variance γ₀²/n.
    deviation = abs(expected) * math.sqrt((1 + float(LINE @ LINE)) / counts[0])
    return float(rise[0] - expected) / deviation


def _line(output: Float[np.ndarray, "n"], runs: EvenRuns) -> tuple[float, dict[str, float]]:
    """How surely the longest run has a narrow line, in standard deviations; and a tone to begin with, for one reading.

    A frequency counts against the geometric mean of both sides, which takes out any slope of the spectrum; of the mean
    of k windows, the logarithm of this ratio has a standard deviation of about 1/√k.
    """
    run, best, found = max(runs.of(output), key=len), 0.0, dict[str, float]()
    run = np.where(np.isfinite(run), run, np.nanmean(run))
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
    if found:  # at the strongest place of the whole run's spectrum within that window's width
        power = np.abs(np.fft.rfft((run - run.mean()) * np.hanning(len(run))))
        low, high = (round((found[TONE[1]] + side / found[TONE[2]]) * len(run)) for side in (-1, 1))
        found[TONE[1]] = (max(low, 1) + float(np.argmax(power[max(low, 1) : high]))) / len(run)
    return best, found


def _totals(fits: Mapping[Terms, GaussianFit]) -> dict[Terms, float]:
    """Return log evidence and log prior of sums, the most probable first.

    The least sum, the first, has one half of the prior; of the others those of one term more have half as much,
    together.
    """
    (base, *others), level = fits, settings().prior_complete
    counts = Counter(map(len, others))
    share = {terms: 2.0 ** -len(terms) / counts[len(terms)] for terms in others}
    prior = {base: level} | {t: (1 - level) * s / sum(share.values()) for t, s in share.items()}
    totals = {terms: fit.log_evidence + math.log(prior[terms]) for terms, fit in fits.items()}
    return dict(sorted(totals.items(), key=lambda item: -item[1]))


def _columns(
    readings: Measurements, runs: EvenRuns
) -> tuple[list[Float[np.ndarray, "n r"]], float, list[Claim]]:
    """Return the curve over temperature, if it moves, and the output of each run, NaN where a reading was lost;

    with the standard deviation of neighbours, output unit, and what was done.
    """
    output, claims = np.asarray(readings["output"], float), list[Claim]()
    changes = _changes(output, runs)
    size = float(np.median(np.abs(changes - np.median(changes)))) * 1.4826 / math.sqrt(2)
    if not size > 0:
        raise InputError(
            f"{readings.file}: more than half of the readings are equal to their neighbours, so the output is rounded "
            "more coarsely than its noise: record it with more digits"
        )
    columns = (output - np.median(output))[:, None]
    if readings.has("temperature") and float(np.ptp(readings["temperature"])) > STIRRED_DEGREES:
        temperature = np.asarray(readings["temperature"], float)
        place = 2 * (temperature - temperature.min()) / np.ptp(temperature) - 1
        columns = np.column_stack([legvander(place, DEGREE)[:, 1:], columns])
        claims.append(Claim("noise.temperature", "temperature", degree=DEGREE))
    if runs.lost:
        claims.append(Claim("noise.lost", share=runs.lost))
    parts = [np.where((r < 0)[:, None], np.nan, columns[r]) for r in runs.rows if len(r) > 1]
    return parts, size, claims


def _filled(
    columns: Float[np.ndarray, "n r"],
    law: SumOfTerms,
    values: Mapping[str, float],
    step: float,
    random: np.random.Generator,
) -> Float[np.ndarray, "n r"]:
    """Return a run whose lost readings are drawn from a noise law, given the others; its curve is interpolated.

    With the precision Q = CᵀD⁻¹C, C the cosine transform and D the density in frequency (but for a run's ends), and m
    the lost places, Q_mm·x_m = (CᵀD^(−½)·ε)_m − (Q·x)_m, where x is zero at m and ε standard normal, has their mean
    and their covariance Q_mm⁻¹. The level is free: 1/D is taken as zero at frequency zero.

    Source: G. Papandreou and A. Yuille, Advances in Neural Information Processing Systems 23 (2010) 1858.
    """
    lost, n = np.isnan(columns[:, -1]), len(columns)
    if not lost.any():
        return columns
    from scipy.sparse.linalg import LinearOperator, cg  # a third of a second that most do without

    places, (m,) = np.arange(n), np.nonzero(lost)
    curve = [np.interp(places, places[~lost], one[~lost]) for one in columns.T[:-1]]
    design = np.column_stack([np.ones(n), *curve])
    mean = design @ np.linalg.lstsq(design[~lost], columns[~lost, -1], rcond=None)[0]
    own = {name: np.array([[value]]) for name, value in values.items()}
    terms = law.spectrum(own, step, eigenvalues(n, np.arange(n)))
    density = own[WHITE] ** 2 + sum((term.symbol for term in terms), np.zeros((1, n)))
    weight = np.append(0.0, 1 / density[0, 1:])

    def precise(x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "m"]:
        return np.asarray(idct(weight * dct(x, norm="ortho"), norm="ortho"))[m]

    q = LinearOperator((len(m), len(m)), lambda x: precise(np.bincount(m, x.ravel(), n)))
    noise = np.where(lost, 0.0, columns[:, -1] - mean)
    right = idct(np.sqrt(weight) * random.standard_normal(n), norm="ortho")[m] - precise(noise)
    noise[m], _ = cg(q, right, rtol=1e-6)
    return np.column_stack([*curve, mean + noise])


def _means(values: Float[np.ndarray, "n"], part: Int[np.ndarray, "k c"]) -> np.ndarray:
    """Of the readings that are there, −1 where one was lost (k,); zero where none is."""
    there = part >= 0
    return np.where(there, values[part], 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1)


# one sum -------------------------------------------------------------------------------------------------------------


def _fit(channel: _AtRest, terms: Terms, fits: Mapping[Terms, GaussianFit]) -> GaussianFit:
    """Return the mode of a sum and its Laplace evidence.

    Args:
        channel: what is fitted.
        terms: of the sum.
        fits: of other sums: a search begins at the modes of those that have one term less, too.
    """
    priors, values = channel.law(terms).parameters(), channel.log_density(terms)
    starts = list(_starts(channel, terms, priors))
    least = starts[-1]  # further terms as small as any start has them
    for part in {terms[:i] + terms[i + 1 :] for i in range(len(terms))} & {*fits}:
        known = dict(zip(channel.law(part).parameters(), fits[part].v, strict=True))
        starts.append(np.array([known.get(n, v) for n, v in zip(priors, least, strict=True)]))
    scale = np.ones(len(priors))
    if "tone" in terms:  # a line is known to a part of its width
        near = channel.line[TONE[1]] - np.array([0.1 / channel.line[TONE[2]], 0.0])
        scale[list(priors).index(TONE[1])] = np.diff(priors[TONE[1]].coordinate(near))[0]
    order = np.argsort(-values(np.array(starts)))[:STARTS]
    densities = [(ByValues(values, scale), starts[i]) for i in order]
    fits_here = (gaussian_fit(density, climb(density, at)) for density, at in densities)
    return max(fits_here, key=lambda fit: fit.log_density)


def _starts(channel: _AtRest, terms: Terms, priors: dict[str, Any]) -> Iterator[np.ndarray]:
    """Coordinates, from the Allan curve: each term as large as the curve lets it be, times in several places."""
    tau, allan, step, line = channel.tau, channel.allan, channel.spectrum.step, channel.line
    sizes = {
        WHITE: math.sqrt(allan[0]),
        "noise.walk": math.sqrt(3 * allan[-1] / tau[-1]),
        "noise.flicker": math.sqrt(float(np.min(allan)) / FLAT),
        "noise.quantisation": tau[0] * math.sqrt(allan[0] / 3),
        "noise.averaging": math.sqrt(allan[0]),
        **line,
    }
    several = itertools.combinations([0.2, 0.5, 0.8], terms.count("correlated"))
    memories = (0.25, 2.0, 100.0) if "tone" in terms else (1.0,)
    for shares, memory, factor in itertools.product(several, memories, (1.0, 0.3)):
        values, before = {n: v if n == WHITE else factor * v for n, v in sizes.items()}, step
        if line:
            values[TONE[1]] = line[TONE[1]]
            values[TONE[2]] = min(memory * line[TONE[2]], 0.7 * channel.longest)
        for k, share in enumerate(shares, 1):
            time = step * (channel.longest / step) ** share
            variance = 1.6 * float(np.interp(math.log(2 * time), np.log(tau), allan))
            values[f"noise.correlated{k}.diffusion"] = factor * math.sqrt(2 * variance / time)
            values[f"noise.correlated{k}.time"] = time
            part = math.log(time / before) / math.log(channel.longest / before)
            values[f"noise.correlated{k}.place"], before = float(ndtri(part)), time
        yield np.array([float(p.coordinate(values[n])) for n, p in priors.items()])


def _line_size(y: Float[np.ndarray, "n"], turn: float) -> float:
    """Return the root mean square of a line in a run, less what other noise has at its frequency, output unit.

    Where its phase lasts as long as the record a line is one amplitude, of which a law knows the order of magnitude and
    the readings all: with c the largest coefficient of the periodogram near its frequency, |c|²/2 is its mean square.

    Args:
        y: output.
        turn: about its frequency, cycles per reading.
    """
    n = len(y)
    edges = np.linspace(0, n, min(LINE_BLOCKS, n) + 1).astype(int)
    slow = np.add.reduceat((y - y.mean()) * np.exp(-2j * math.pi * turn * np.arange(n)), edges[:-1])
    place = 0.5 * (edges[:-1] + edges[1:]) / n

    def power(offset: float) -> float:
        """Return the periodogram, so many cycles per run from the frequency."""
        return float(2 * abs(slow @ np.exp(-2j * math.pi * offset * place)) ** 2 / n)

    offset = 0.0
    for width in (0.8, 0.1):
        offset = max(offset + width * np.linspace(-1, 1, 9), key=power)
    around = np.mean([power(offset + k) for k in (*BESIDE, *-BESIDE)])
    return math.sqrt(max(power(offset) - float(around), 0.0) / n)


def _drawn(
    channel: _AtRest, terms: Terms, v: np.ndarray, weights: np.ndarray, seed: int, share: float
) -> RestNoise:
    """Return parameters of equal probability, drawn anew by the weights of v; `share` of all draws that are kept."""
    chosen, law = v[resample(weights, max(1, round(share * KEPT)), seed)], channel.law(terms)
    priors = law.parameters()
    own = {n: np.asarray(p.value(chosen[:, i])) for i, (n, p) in enumerate(priors.items())}
    if "tone" in terms:
        coherent = own[TONE[2]] > COHERENT_SHARE * channel.longest
        if coherent.any():
            turn = float(np.median(own[TONE[1]][coherent])) * channel.spectrum.step
            run = max(channel.columns, key=len)[:, -1]
            error = own[WHITE] / math.sqrt(len(run))
            error = error * np.random.default_rng(seed).standard_normal(len(error))
            size = np.abs(_line_size(run, turn) + error)
            own[TONE[0]] = np.where(coherent, size, own[TONE[0]])
    return RestNoise(terms, own, law)
