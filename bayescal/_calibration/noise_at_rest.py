"""Noise of a sensor at rest: Q, N, B and K of IEEE 952 with intervals, by the likelihood of sums of noise terms.

Every sum is fitted by the Kalman filter to the readings themselves, levels of runs and a cubic over temperature
integrated out beside it (restricted likelihood); the sums are weighed by their evidence, and the parameters of the
most probable one drawn by importance sampling. Of a long log the filter takes the means of blocks of readings, by
their exact law, and some stretches of single readings.

N is the density along which the Allan deviation falls with slope −½ (IEEE 952, C.1.2). A low-pass, a moving average, an
interpolation or a held output correlates readings over times shorter than those: where the deviation falls so only from
means of m readings on, all is read from these means. Of a process that is short against T they are white noise, but for
a correlation of neighbours.

Sources: D. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood); IEEE Std 952-1997, Annex C.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtri, softmax

from bayescal._calibration.claim import Claim
from bayescal._core import deadline
from bayescal._core.errors import InputError
from bayescal._core.importance_weights import resample, smoothed
from bayescal._core.parallel import on_one_thread
from bayescal._core.settings import settings
from bayescal._data.allan_deviation import EvenRuns, degrees_of_freedom, even_runs, overlapping
from bayescal._data.column import UNCERTAINTY
from bayescal._data.measurements import Measurements
from bayescal._inference.density import Density
from bayescal._inference.laplace import Mode, find_mode, flat_scales, with_fit
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._inference.sampling import WeightedDraws, weighted_draws
from bayescal._inference.trust import FEWEST_DRAWS, unevenness
from bayescal._model.channel_at_rest import CHANNEL, CURVE, DEGREE, LEVEL
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.independent_noise import White
from bayescal._model.model import Model
from bayescal._model.noise_law import WHITE
from bayescal._model.noise_terms import FLAT, TERMS
from bayescal._model.parameters import Layout, bind
from bayescal._model.prior import HalfCauchy, Positive
from bayescal._model.state_space import filtered, of_means
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
# Readings above which means of blocks are taken: the filter then takes a tenth of a second.
BLOCK_MEANS_READINGS = 16_384
NOTHING = 1e6  # times the scatter of neighbours: the uncertainty of a place without a reading
STRETCHES = 8  # of single readings beside the means, as many readings as there are means at most
ALONE = ("walk", "flicker", "correlated")  # terms that are weighed one by one, then in pairs
TONE: Terms = ("noise.tone", "noise.tone.frequency", "noise.tone.time")
ROUNDED, AVERAGED = "quantisation", "averaging"  # of neighbouring readings alone
# Of five values at 2 to 6: what the straight line through them has at 1.
LINE = 0.2 - 0.3 * np.arange(-2, 3)
WINDOW = 64  # readings of the shortest spectra in which a line is looked for; others are twice as long, and so on
WINDOWS = 8  # of the longest, at least
# Places of a spectrum from a line to what it stands above: a window's own width is 2.
BESIDE = np.array([3, 4, 5, 6])
SMOOTH = 0.02  # relative, of a spectrum without lines over as many places: it bends where one noise takes over another
STARTS = 2  # of the starts tried, those from which a maximum is looked for
SETTLED = 0.02  # standard deviations that a climb's last step moves by: 1e-3 nats of the maximum
DRAWS = 1024  # proposals of each round
FEWEST_SHARE = 0.25  # of them, for a sum of little probability or a bound
KEPT = 2048  # draws by their weights, over all sums together
ROUNDS = 4  # of proposals at most, until their weights are sound


class RestingSum(SumOfTerms):
    """A sum of terms on evenly spaced readings, of which the first rows are means of blocks, by their exact law.

    Attributes:
        shortest, longest: the step between readings, and about that of the longest run, s.
        terms: beside white noise; there may be none.
        count: readings in each mean.
        means: how many rows are means; the rest are single readings.
        scale, correlated: priors of standard deviations, output unit.
    """

    shortest: float
    longest: float
    terms: tuple[str, ...]
    count: int = 1
    means: int = 0
    scale: Positive = HalfCauchy(1.0)
    correlated: Positive = HalfCauchy(1.0)
    gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "sum_at_rest"
    independent: ClassVar[bool] = False

    def whiten(self, columns, extra, parameters, frame):
        m, step = self.means, frame.step
        own = self._own_variance(parameters, frame) + extra
        own = own.at[:m].divide(self.count)
        if not self.terms:
            sd = jnp.sqrt(own)
            return columns / sd[:, None], jnp.log(sd)
        single = filtered(self.states(parameters, step[m:]), own[m:], columns[m:])
        if not m:
            return single
        one = self.states(parameters, jnp.stack([-1.0, step[m + 1]]))
        of_blocks = filtered(of_means(one, self.count, step[:m] < 0), own[:m], columns[:m])
        return tuple(map(jnp.concatenate, zip(of_blocks, single, strict=True)))


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
    """A channel, as rows that are means of blocks and single readings."""

    layout: Layout
    record: Record
    count: int  # readings in a mean,
    means: int  # and how many rows of the record are means
    size: float  # standard deviation of neighbours, output unit
    step: float  # s
    longest: float  # a power of two of steps, s
    tau: np.ndarray  # averaging times, s,
    allan: np.ndarray  # and variances, output unit squared
    line: Mapping[str, float] = {}  # a tone to begin with, for steps of one second; none if empty

    def law(self, terms: Terms) -> RestingSum:
        scale = HalfCauchy(self.size)
        return RestingSum(self.step, self.longest, terms, self.count, self.means, scale, scale)

    def problem(self, terms: Terms) -> Problem:
        """Levels, the curve over temperature and this sum, on the readings."""
        model = self.layout.model.with_noise(self.law(terms))
        return Problem(replace(self.layout, model=model), self.record)


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
    """Sums of noise terms on a channel at rest, the first with draws of its parameters.

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
    channel, claims = _channel(readings, runs)
    output = np.asarray(readings["output"], float)
    clear, line = _line(output, runs)
    channel = channel._replace(line=line)
    with deadline.finishing():
        fits: dict[Terms, Mode] = {base: _fit(channel, base)}
    limits = {"tone": (clear, LINE_SD)}
    if not base:
        negative = _negative(output, runs)
        limits[ROUNDED if negative > 0 else AVERAGED] = abs(negative), NEIGHBOURS_SD
    further = tuple(term for term, (sigmas, limit) in limits.items() if sigmas > limit)
    kept = tuple(term for term in further if limits[term][0] > SURE_SD)
    end = deadline.current()
    end.defer_interrupt()
    try:
        end.ask()
        for _ in _fitted_sums(channel, fits, base, further, kept):
            end.ask()
    except deadline.TimeIsUp:
        claims += (Claim("noise.ended", why=end.why),)
    with deadline.finishing():
        drawn, walk, probabilities = _drawn_sums(channel, fits, seed)
    return WeighedNoise(tuple(drawn), walk, probabilities, claims, readings, runs, count)


def _fitted_sums(
    channel: _AtRest, fits: dict[Terms, Mode], base: Terms, further: Terms, kept: Terms
) -> Iterator[Terms]:
    """Fit sums until none beside the most probable one is left; yield each.

    Args:
        channel: what is fitted.
        fits: the least sum alone; the others are put there.
        base: terms of that sum, which every sum has;
        further: terms of neighbouring readings, or a tone, that may be there;
        kept: and those of them that every sum has.
    """
    among = (*ALONE, *further)
    for term in among:
        terms = _sorted((*base, *(() if term in further else kept), term))
        fits[terms] = _fit(channel, terms)
        yield terms
    looked: Terms | None = None
    while (best := max(fits, key=lambda t: _total(fits, t))) != looked:
        looked = best
        known = dict(zip(channel.law(best).parameters(), fits[best].v, strict=True))
        for terms in _beside(best, among):
            if terms not in fits:
                fits[terms] = _fit(channel, terms, known)
                yield terms
    # What is correlated over a few readings looks like them too.
    for term in kept:
        if (without := tuple(t for t in best if t != term)) not in fits:
            fits[without] = _fit(channel, without)
            yield without


def _drawn_sums(
    channel: _AtRest, fits: dict[Terms, Mode], seed: int
) -> tuple[list[RestNoise], RestNoise, dict[Terms, float]]:
    """Draws of the probable sums, of the most probable one with a random walk, and the probability of each."""
    sampled: dict[Terms, WeightedDraws] = {}
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
            sampled[further] = _sampled(channel, further, fit, seed, FEWEST_SHARE)
        walk = _drawn(channel, further, sampled[further], seed, FEWEST_SHARE)
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
    return best, found


def _total(fits: dict[Terms, Mode], terms: tuple[str, ...]) -> float:
    """Log evidence and log prior: level noise, the first, has one half of it; other sums share the rest."""
    others, level = max(1, len(fits) - 1), settings().prior_complete
    share = level if terms == next(iter(fits)) else (1 - level) / others
    return fits[terms].log_evidence + math.log(share)


def _channel(readings: Measurements, runs: EvenRuns) -> tuple[_AtRest, tuple[Claim, ...]]:
    output, claims = np.asarray(readings["output"], float), list[Claim]()
    rows = [r for r in runs.rows if len(r) > 1]
    changes = _changes(output, runs)
    size = float(np.median(np.abs(changes - np.median(changes)))) * 1.4826 / math.sqrt(2)
    if not size > 0:
        raise InputError(
            f"{readings.file}: more than half of the readings are equal to their neighbours, so the output is rounded "
            "more coarsely than its noise: record it with more digits"
        )
    given = {"output": output - np.median(output)}
    effects = [LEVEL]
    if readings.has("temperature") and float(np.ptp(readings["temperature"])) > STIRRED_DEGREES:
        given["temperature"] = np.asarray(readings["temperature"], float)
        effects.append(CURVE)
        claims.append(Claim("noise.temperature", "temperature", degree=DEGREE))
    if runs.lost:
        claims.append(Claim("noise.lost", share=runs.lost))
    total = sum(len(r) for r in rows)
    count = 2 ** max(0, math.ceil(math.log2(total / BLOCK_MEANS_READINGS)))
    blocks: list[np.ndarray] = []
    if count > 1:
        blocks = [r[: len(r) // count * count].reshape(-1, count) for r in rows if len(r) >= count]
        rows = _stretches(rows, BLOCK_MEANS_READINGS // STRETCHES)
        taken = {"readings": total, "means": sum(map(len, blocks)), "count": count}
        claims.append(Claim("noise.blocks", **taken, stretches=len(rows), length=len(rows[0])))
    parts = [*blocks, *(r[:, None] for r in rows)]
    lengths = [len(part) for part in parts]
    beside: dict[str, Any] = (
        {UNCERTAINTY: np.concatenate([_of_lost(p, size) for p in parts])} if runs.lost else {}
    )
    columns: dict[str, Any] = {
        n: np.concatenate([_means(v, part) for part in parts]) for n, v in given.items()
    }
    still = Measurements.from_arrays(
        CHANNEL,
        run=np.repeat([f"{k:06d}" for k in range(len(parts))], lengths),
        time=runs.step * np.concatenate([np.arange(length) for length in lengths]),
        **columns,
        **beside,
    )
    reference = reference_of(still)
    frame = build_frame(still, reference)
    layout, _ = bind(Model(CHANNEL, tuple(effects), White()), still, reference=reference)
    longest = runs.step * 2.0 ** math.ceil(math.log2(max(len(r) for r in runs.rows)))
    variance, _ = overlapping(output, runs)
    record = Record(CHANNEL, frame, np.asarray(frame["output"]))
    own = (size, runs.step, longest, runs.factors * runs.step, variance)
    return _AtRest(layout, record, count, sum(map(len, blocks)), *own), tuple(claims)


def _means(values: Float[np.ndarray, "n"], part: Int[np.ndarray, "k c"]) -> np.ndarray:
    """Of the readings that are there, −1 where one was lost (k,); zero where none is."""
    there = part >= 0
    return np.where(there, values[part], 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1)


def _of_lost(part: Int[np.ndarray, "k c"], size: float) -> np.ndarray:
    """Uncertainty, in each of the c readings of a mean, that says as much as that some are lost (k,).

    A mean of n has c/n times the white variance of one of c. Where fewer than half are there it says nothing.
    """
    count, there = part.shape[1], np.sum(part >= 0, axis=1)
    missing = count / np.maximum(there, 1) - 1
    return size * np.where(2 * there < count, NOTHING, np.sqrt(missing))


def _stretches(rows: Sequence[np.ndarray], length: int) -> list[np.ndarray]:
    """Stretches of neighbours, evenly over the runs."""
    each = max(1, STRETCHES // len(rows))
    found = []
    for r in sorted(rows, key=len, reverse=True)[:STRETCHES]:
        size = min(length, len(r) // each)
        starts = np.linspace(0, len(r) - size, each).astype(int)
        found += [r[s : s + size] for s in starts]
    return found


# one sum -------------------------------------------------------------------------------------------------------------


def _fit(channel: _AtRest, terms: Terms, known: Mapping[str, float] | None = None) -> Mode:
    """The mode of a sum, levels and the curve integrated out, and its Laplace evidence.

    Args:
        terms: of the sum.
        known: coordinates at the mode of a part of it, by name: a search begins there and at the best start beside.
    """
    problem = channel.problem(terms)
    priors = problem.noise.parameters()
    starts = list(_starts(channel, terms, priors))
    if known is not None:
        least = starts[-1]  # further terms as small as any start has them
        starts.append(np.array([known.get(n, v) for n, v in zip(priors, least, strict=True)]))
    order = np.argsort(-_density(problem).values(np.array(starts)))[:STARTS]
    tries = list[Mode]()
    for i in order:
        deadline.current().ask()
        tries.append(find_mode(problem, [starts[i]], curved=False, wanted_from=math.inf))
    best = max(tries, key=lambda t: t.log_density)
    best = find_mode(problem, [best.v], best.covariance, still=SETTLED, curved=False)
    return with_fit(problem, best)


def _starts(
    channel: _AtRest, terms: tuple[str, ...], priors: dict[str, Any]
) -> Iterator[np.ndarray]:
    """Coordinates, from the Allan curve: each term as large as the curve lets it be, times in several places."""
    tau, allan, step, line = channel.tau, channel.allan, channel.step, channel.line
    walk = math.sqrt(3 * allan[-1] / tau[-1])
    sizes = {
        "noise.walk": walk,
        "noise.flicker": math.sqrt(float(np.min(allan)) / FLAT),
        "noise.quantisation": tau[0] * math.sqrt(allan[0] / 3),
        "noise.averaging": math.sqrt(allan[0]),
    }
    if line:
        sizes[TONE[0]] = line[TONE[0]]
    places = [0.2, 0.5, 0.8]
    alike, memories = terms.count("correlated"), (0.25, 2.0) if "tone" in terms else (1.0,)
    several = itertools.combinations(places, alike) if alike else [()]
    for shares, memory in itertools.product(several, memories):
        times = [step * (channel.longest / step) ** share for share in shares]
        amplitudes, held = dict(sizes), {WHITE: math.sqrt(allan[0])}
        if line:
            held |= {TONE[1]: line[TONE[1]] / step, TONE[2]: memory * line[TONE[2]] * step}
        before = step
        for k, time in enumerate(times, 1):
            variance = 1.6 * float(np.interp(math.log(2 * time), np.log(tau), allan))
            amplitudes[f"noise.correlated{k}.diffusion"] = math.sqrt(2 * variance / time)
            held[f"noise.correlated{k}.time"] = time
            part = math.log(time / before) / math.log(channel.longest / before)
            held[f"noise.correlated{k}.place"] = float(ndtri(np.clip(part, 5e-4, 1 - 5e-4)))
            before = time
        for factor in (1.0, 0.3):
            values = held | {n: factor * amplitude for n, amplitude in amplitudes.items()}
            yield np.array([float(p.coordinate(values[n])) for n, p in priors.items()])


def _density(problem: Problem) -> Density:
    """Of the sum's coordinates, levels and the curve integrated out."""
    nothing = np.zeros(len(problem.hypers))
    return Density(problem, problem.start, flat_scales(problem, problem.start, nothing))


def _sampled(channel: _AtRest, terms: Terms, mode: Mode, seed: int, share: float) -> WeightedDraws:
    """Draws by importance sampling, as in every fit, until their weights are sound or have been tried often enough.

    Args:
        share: of all draws; a sum of little probability has few of those that are kept.
    """
    problem, share, found = channel.problem(terms), max(share, FEWEST_SHARE), None
    for _ in range(ROUNDS):
        found = weighted_draws(problem, mode, seed, math.ceil(DRAWS * share), ROUNDS, earlier=found)
        weights, k_hat = smoothed(found.log_weight)
        if not unevenness(weights, k_hat, enough=FEWEST_DRAWS * share):
            break
    assert found is not None
    return found


def _drawn(
    channel: _AtRest, terms: Terms, sampled: WeightedDraws, seed: int, share: float
) -> RestNoise:
    """Parameters of equal probability, drawn anew by their weights.

    Args:
        share: of all draws that are kept.
    """
    weight, _ = smoothed(sampled.log_weight)
    chosen = sampled.v[np.sort(resample(weight, max(1, round(share * KEPT)), seed))]
    priors = channel.law(terms).parameters()
    own = {n: np.asarray(p.value(chosen[:, i])) for i, (n, p) in enumerate(priors.items())}
    return RestNoise(terms, own, channel.law(terms))
