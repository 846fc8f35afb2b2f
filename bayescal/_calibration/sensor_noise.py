"""Noise of a sensor at rest: Q, N, B and K of IEEE 952 with intervals, by the likelihood of sums of noise terms.

Every sum is fitted to the spectrum of the readings, with run levels and a cubic over temperature integrated out
(restricted likelihood); the sums are weighted by their evidence, and the parameters of the probable ones drawn by
importance sampling. Lost readings are imputed from the noise law, given the others, and the sums fitted again (data
augmentation).

N is the density along which the Allan deviation falls with slope −½ (IEEE 952, C.1.2). A low-pass, a moving average, an
interpolation or a held output correlates readings over shorter times: where the slope −½ begins only at means of m
readings, these means are analysed. Of a process that is short against T they are white noise, but for a correlation of
neighbours.

Sources: D. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood); M. Tanner and W. Wong, J. Am. Stat.
Assoc. 82 (1987) 528 (data augmentation); IEEE Std 952-1997, Annex C.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.polynomial.legendre import legvander
from scipy.fft import dct, idct
from scipy.special import ndtri, softmax

from bayescal._calibration.claim import Claim, limit
from bayescal._core import deadline
from bayescal._core.errors import InputError
from bayescal._core.formatting import folded, number, probability
from bayescal._core.importance_weights import resample
from bayescal._core.parallel import on_one_thread
from bayescal._core.result_table import Printed, ResultTable, plain_table
from bayescal._core.settings import seed_of, settings
from bayescal._data import allan_deviation as allan
from bayescal._data.allan_deviation import CONFIDENCE, AllanDeviation, EvenRuns
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import STANDARD_GRAVITY, parse, unit_label
from bayescal._inference.newton import NOWHERE, ByValues, GaussianFit, climb, gaussian_fit
from bayescal._inference.noise_nodes import EvenSpectrum
from bayescal._inference.sampling import importance_draws
from bayescal._model.noise_law import WHITE
from bayescal._model.noise_spectrum import eigenvalues
from bayescal._model.noise_terms import FLICKER_FLOOR, TERMS
from bayescal._model.prior import HalfCauchy
from bayescal._model.summed_noise import SummedNoise

# Share of the most probable noise law's probability, above which another law is drawn from.
DRAWN_SHARE = 0.1
# Standard deviations between the correlation of neighbours and that of readings farther apart, before quantisation
# noise is tried, or means are taken.
NEIGHBOURS_SD = 2.0
# Standard deviations of a spectral line above its neighbours, before a tone is tried.
LINE_SD = 4.5
# Standard deviations of either, above which every sum has that term; the best one is also evaluated without it.
SURE_SD = 6.0
# Slope of the Allan deviation over two octaves where it falls along N. After a low-pass of time T it is so steep for
# means over 3.4·T, of which only neighbours correlate by more than 0.01.
LEVEL_SLOPE = -0.35
FEWEST_MEANS = 64  # for a slope known to 0.1
SHORT_STEPS = 3.0  # correlation time, below which a process is part of N: its density is level over these octaves


Terms = tuple[str, ...]  # names of a sum's terms, besides white noise
DEGREE = 3  # of the polynomial over temperature
IMPUTATIONS = 6  # of lost readings; the first is burn-in
SLOW = ("walk", "flicker", "correlated")  # slow terms: a sum has two at most,
NOT_TWICE = (("walk", "walk"), ("flicker", "flicker"))  # but none of these
TONE: Terms = ("noise.tone", "noise.tone.frequency", "noise.tone.time")
ROUNDED, AVERAGED = "quantisation", "averaging"  # of neighbouring readings alone
# Weights of five values at 2 to 6 in the extrapolation of their regression line to 1.
LINE = 0.2 - 0.3 * np.arange(-2, 3)
WINDOW = 64  # readings of the shortest window in which a line is sought; the others double
WINDOWS = 8  # fewest windows, of the longest length
# Frequency offsets, in bins, of a line's background; a window's width is 2.
BACKGROUND = np.array([3, 4, 5, 6])
LINE_BLOCKS = 256  # of a run, along which the phase of a line is followed
COHERENT_SHARE = 0.25  # of the longest run, for which a line keeps its phase
SMOOTH = 0.02  # relative curvature of a spectrum without lines over so many bins
STARTS = 2  # best starting points, from which a maximum is sought
DRAWS = 2048  # of each sum
RESAMPLED = 2048  # draws by their weights, over all sums together
SHOWN_PROBABILITY = 0.01  # probability from which a noise law is printed
# Posterior quantile of N and K for a filter: underestimated noise makes it overconfident.
FILTER_QUANTILE = 0.95
# Share of the law's Allan deviation that a filter's two terms must reach at every averaging time.
FILTER_REACHES_SHARE = 0.95
SHOWN_SUMS = 4  # sums that are printed with their probabilities
CURVE = ("tau", "deviation", "low", "high", "law", "law_low", "law_high")  # in JSON


@dataclass(frozen=True)
class NoiseFigure:
    """A number of a noise law with its 95 % credible interval, in the unit of data sheets and in SI units."""

    symbol: str  # of IEEE 952; empty for others
    name: str  # as in data sheets
    unit: str  # of data sheets
    value: float  # the median
    low: float
    high: float
    si_unit: str
    si: tuple[float, float, float]  # the same three in base units
    bound: bool = False  # not seen: `high` is an upper bound, infinite if there is none

    def row(self) -> list[str]:
        """Return the printed row: name, value, interval, SI value."""
        name = f"{self.name} {self.symbol}".strip()
        extent = f"{number(self.low)} to {number(self.high)}"
        value, si = number(self.value), number(self.si[0])
        if self.bound and not math.isfinite(self.high):
            return [name, "", "not determined", ""]
        if self.bound:
            value, extent, si = f"< {number(self.high)}", "one-sided", f"< {number(self.si[2])}"
        units = unit_label(self.unit), unit_label(self.si_unit)
        return [name, f"{value} {units[0]}".strip(), extent, f"{si} {units[1]}".strip()]


@dataclass(frozen=True, repr=False)
class SensorNoise(Printed):
    """Noise of a channel at rest.

    Attributes:
        file: that was read.
        unit: of the output.
        step: between readings, s.
        terms: of the most probable sum beside white noise, as `SummedNoise` names them.
        probabilities: of the sums, by description, the most probable first.
        figures: Q, N, B, K and the law's other parameters.
        measured: Allan deviation of the record.
        expected: of the law (k,), the median of its posterior; output unit.
        low, high: 95 % posterior band of that (k,).
        estimate_low, estimate_high: between which 95 % of Allan deviations of such a record lie under the law (k,).
        claims: processing of the record, and the law's failed checks.
        densities: posterior draws of the N and the K that a filter is given, output unit times and per √s.
        horizon: the longest averaging time that this K holds for, s.
    """

    file: str
    unit: str
    step: float
    terms: tuple[str, ...]
    probabilities: Mapping[str, float]
    figures: tuple[NoiseFigure, ...]
    measured: AllanDeviation = field(repr=False)
    expected: np.ndarray = field(repr=False)
    low: np.ndarray = field(repr=False)
    high: np.ndarray = field(repr=False)
    estimate_low: np.ndarray = field(repr=False)
    estimate_high: np.ndarray = field(repr=False)
    claims: tuple[Claim, ...]
    densities: tuple[np.ndarray, np.ndarray] = field(repr=False)
    horizon: float

    @property
    def law(self) -> str:
        """Return the most probable sum of noise terms, in words."""
        return SummedNoise(1.0, 2.0, self.terms).in_words

    def _parts(self) -> list[str | ResultTable]:
        rows = [figure.row() for figure in self.figures]
        likely = [
            f"{w} {probability(p)}" for w, p in self.probabilities.items() if p >= SHOWN_PROBABILITY
        ]
        doubts = [f"Not to be used as they are: {c}" for c in self.claims if c.severity != "note"]
        term = "term" + " of a law that does not fit" * bool(doubts)
        terms = plain_table([term, "value", "95 % interval", "SI"], rows, fold=40)
        which = "Best noise law, which does not fit" if doubts else "Noise law (probability)"
        notes = [*doubts, f"{which}: {', '.join(likely[:SHOWN_SUMS])}."]
        notes += [f"Note: {claim}" for claim in self.claims if claim.severity == "note"]
        m, unit = self.measured, unit_label(self.unit) or "1"
        head = ["τ [s]", f"Allan deviation [{unit}]", "noise law", "95 % of records of that law"]
        columns = (m.tau, m.deviation, self.expected, self.estimate_low, self.estimate_high)
        curve = [
            [number(t), number(d), number(e), f"{number(a)} to {number(b)}"]
            for t, d, e, a, b in zip(*columns, strict=True)
        ]
        lines = [line for note in notes for line in ("", folded(note, ""))]
        return [terms, *lines, "", plain_table(head, curve, left=0)]

    def _brief(self) -> str:
        figures = (f"{f.symbol} {f.row()[1] or f.row()[2]}" for f in self.figures)
        return f"{self.law}; {', '.join(figures)}"

    def _columns(self) -> dict[str, list[Any]]:
        names = ("name", "symbol", "value", "low", "high", "unit")
        return {name: [getattr(f, name) for f in self.figures] for name in names}

    def for_filter(self, quantile: float | None = None) -> tuple[float, float]:
        """Return N and K for a filter of white noise and a random walk, output unit times √s and per √s.

        Where noise is correlated they are the pair of least excess whose Allan deviation reaches 95 % of the law's at
        every averaging time up to `horizon`: density replaces noise of a few steps, a random walk slower noise.

        Args:
            quantile: of the posterior; that of the settings if None.
        """
        quantile = FILTER_QUANTILE if quantile is None else quantile
        n, k = (float(np.quantile(d, quantile)) for d in self.densities)
        return n, k

    def data(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        (n, k), m = self.for_filter(), self.measured
        law = (self.expected, self.low, self.high)
        columns = [column.tolist() for column in (m.tau, m.deviation, m.low, m.high, *law)]
        return {
            "file": self.file,
            "unit": self.unit,
            "step": self.step,
            "law": self.law,
            "probabilities": dict(self.probabilities),
            "figures": [{**vars(f), "si": list(f.si)} for f in self.figures],
            "curve": [dict(zip(CURVE, row, strict=True)) for row in zip(*columns, strict=True)],
            "for_filter": {"quantile": FILTER_QUANTILE, "N": n, "K": k, "horizon": self.horizon},
            "claims": [claim.data() for claim in self.claims],
        }


def noise(readings: Measurements, *, seed: Any = 0, time_limit: float | None = None) -> SensorNoise:
    """Estimate noise density, bias instability and random walk of a sensor at rest, with 95 % intervals.

        print(bc.noise(bc.read("still.csv", still_sensor.INSTRUMENT)))

    Sums of white noise, as it is or averaged by the sensor itself, quantisation noise, a random walk, flicker noise and
    one or two Ornstein–Uhlenbeck processes are weighted by their evidence; run levels and a cubic over a column
    `temperature` are integrated out.

    Args:
        readings: of one channel, evenly spaced in time within runs.
        seed: of the draws.
        time_limit: seconds, after which the sums fitted so far are the result, as at Ctrl-C; a note says so.

    Raises:
        InputError: readings of several devices, no column `time`, no run of 30 readings, uneven steps, or an output
            that is rounded too coarsely.
    """
    for group in ("device", "axis"):
        if len(levels := readings.groups(group)[0]) > 1:
            raise InputError(
                f"{readings.file}: each {group} has noise of its own ({', '.join(levels)}): give the readings of one, "
                f"as readings.select(readings[{group!r}] == {levels[0]!r})"
            )
    with deadline.until(time_limit):
        seed = seed_of(seed)
        weighed = _evaluate_sums(readings, seed)
    step = allan.even_runs(readings).step
    readings, runs, unit = weighed.readings, weighed.runs, readings.unit("output") or ""
    measured = allan.of_runs(readings, np.asarray(readings["output"], float), runs)
    draws = np.concatenate([law.allan_variance(runs.factors, runs.step) for law in weighed.drawn])
    tail = 0.5 * (1 - CONFIDENCE)
    low, middle, high = np.sqrt(np.quantile(draws, [tail, 0.5, 1 - tail], axis=0))
    edf = allan.degrees_of_freedom(runs, allan.noise_types(np.median(draws, axis=0)))
    random = np.random.default_rng(seed)
    spread = np.sqrt(draws * random.chisquare(edf, draws.shape) / edf)
    estimate_low, estimate_high = np.quantile(spread, [tail, 1 - tail], axis=0)
    claims, repeats = list(weighed.claims), runs.step / (weighed.count or 1) / step
    if weighed.count is None:
        claims.insert(0, Claim("noise.no_level", "N", name=allan.habit(unit).names[0]))
    elif weighed.count > 1:
        claims.insert(0, Claim("noise.means", "N", time=runs.step, count=weighed.count))
    if repeats > 1:
        claims.insert(0, Claim("noise.held", "N", times=repeats))
    outside = (measured.deviation < estimate_low) | (measured.deviation > estimate_high)
    if outside.sum() > limit("noise.outside", "times"):
        at = tuple(number(t) for t in measured.tau[outside])
        claims.append(Claim("noise.outside", count=len(at), times=len(outside), taus=at))
    return SensorNoise(
        file=readings.file,
        unit=unit,
        step=step,
        terms=weighed.drawn[0].terms,
        probabilities={
            SummedNoise(1.0, 2.0, t).in_words: p for t, p in weighed.probabilities.items()
        },
        figures=_figures(weighed, unit, draws),
        measured=measured,
        expected=middle,
        low=low,
        high=high,
        estimate_low=estimate_low,
        estimate_high=estimate_high,
        claims=tuple(claims),
        densities=_filter_densities(weighed),
        horizon=float(runs.factors[-1] * runs.step),
    )


class RestNoise(NamedTuple):
    """A sum of noise terms fitted to a channel at rest."""

    terms: Terms  # beside white noise
    draws: dict[str, np.ndarray]  # parameters, in output units and seconds (d,); equally probable
    law: SummedNoise  # with these parameters

    @property
    def processes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return size, output unit, and correlation time, s, of each Ornstein–Uhlenbeck process (d,)."""
        parameters = {**self.draws, **self.law.derived(self.draws)}
        names = (f"noise.correlated{k + 1}" for k in range(self.terms.count("correlated")))
        return [(parameters[f"{name}.size"], parameters[f"{name}.time"]) for name in names]

    def density(self, step: float) -> Float[np.ndarray, "d"]:
        """Return N at each draw, output unit times √s, of readings `step` s apart.

        White noise, as it is or averaged, and each Ornstein–Uhlenbeck process of a few steps: of the variance s² and a
        correlation ρ of neighbours it has the spectral density s²·(1 + ρ)/(1 − ρ) per reading at low frequencies.
        """
        variance = self.draws[WHITE] ** 2 + self.draws.get(f"noise.{AVERAGED}", 0.0) ** 2
        for size, time in self.processes:
            short = time <= SHORT_STEPS * step
            variance = variance + np.where(short, size**2 / np.tanh(0.5 * step / time), 0.0)
        return np.sqrt(variance * step)

    def allan_variance(self, factors: Float[np.ndarray, "k"], step: float) -> np.ndarray:
        """Return the law's Allan variance at each draw (d, k), output unit squared."""
        total = self.draws[WHITE] ** 2 + self.law.slow_variance(self.draws)
        return self.law.allan_variance(self.draws, total, factors, step)


class _AtRest(NamedTuple):
    """Runs, spectrum and scales of a channel at rest."""

    columns: Sequence[np.ndarray]  # of its runs (n, r): integrated out, and last the output
    spectrum: EvenSpectrum
    size: float  # standard deviation of neighbours, output unit
    longest: float  # run, a power of two of steps, s
    tau: np.ndarray  # averaging times, s,
    allan: np.ndarray  # and variances, output unit squared
    line: Mapping[str, float]  # starting values of a tone; none if empty

    def law(self, terms: Terms) -> SummedNoise:
        scale = HalfCauchy(self.size)
        return SummedNoise(self.spectrum.step, self.longest, terms, scale, scale)

    def log_density(self, terms: Terms) -> Callable[[Float[np.ndarray, "s d"]], np.ndarray]:
        """Return a sum's log posterior density over parameter coordinates, levels and curve integrated out."""
        law = self.law(terms)
        priors = law.parameters()

        def values(v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
            parameters = {n: p.value(v[:, i]) for i, (n, p) in enumerate(priors.items())}
            prior = sum(p.log_density(v[:, i]) for i, p in enumerate(priors.values()))
            total = self.spectrum.log_likelihood(law, parameters) + prior
            return np.where(np.isfinite(total), total, NOWHERE)

        return values


class EvaluatedSums(NamedTuple):
    """Sums of noise terms with their probabilities and draws."""

    drawn: Sequence[RestNoise]  # the probable sums, draws in proportion to their probability
    walk: np.ndarray  # draws of a random walk in the most probable sum: a bound, where it has none
    probabilities: dict[Terms, float]  # the most probable first
    claims: tuple[Claim, ...]  # processing of the record
    readings: Measurements  # the record, or means of it
    runs: EvenRuns  # of these
    count: int | None  # readings in a mean; None where no Allan deviation falls with slope −½


@on_one_thread
def _evaluate_sums(readings: Measurements, seed: int) -> EvaluatedSums:
    """Evaluate sums of noise terms on a channel at rest, and draw the probable ones' parameters; see `noise`."""
    output = np.asarray(readings["output"], float)
    runs = _first_of_repeats(output, allan.even_runs(readings))
    clear, line = _find_line(output, runs)
    count = _level_count(output, runs, clear, line)
    # Means of a process that is short against their time are white, but for correlated neighbours.
    base: Terms = ()
    if count is not None and count > 1:
        readings, runs = _means_of(readings, runs, count)
        base = (AVERAGED,)
        output = np.asarray(readings["output"], float)
        clear, line = _find_line(output, runs)
    columns, size, claims = _columns(readings, runs)
    limits = {"tone": (clear, LINE_SD)}
    if not base:
        negative = _negative_correlation_sd(output, runs)
        limits[ROUNDED if negative > 0 else AVERAGED] = abs(negative), NEIGHBOURS_SD
    further = tuple(term for term, (sigmas, limit) in limits.items() if sigmas > limit)
    certain = tuple(term for term in further if limits[term][0] > SURE_SD)
    variance, _ = allan.overlapping(output, runs)
    longest = runs.step * 2.0 ** math.ceil(math.log2(max(runs.lengths)))
    per_reading = dict(zip(TONE, (1.0, 1 / runs.step, runs.step), strict=True))
    line = {name: per_reading[name] * value for name, value in line.items()}
    statistics = size, longest, runs.factors * runs.step, variance, line
    law, values = SummedNoise(runs.step, longest, ("walk",)), {WHITE: size}
    values["noise.walk"] = math.sqrt(3 * variance[-1] / (runs.factors[-1] * runs.step))
    random, mean = np.random.default_rng(seed), Counter[Terms]()
    parts = list[tuple[list[RestNoise], np.ndarray, dict[Terms, float]]]()
    end = deadline.current()
    end.defer_interrupt()
    for k in range(IMPUTATIONS if runs.lost else 1):
        filled = [_impute_run(run, law, values, runs.step, random) for run in columns]
        lines = [line[TONE[1]]] if "tone" in further else []
        channel = _AtRest(filled, EvenSpectrum(filled, runs.step, lines), *statistics)
        fits: dict[Terms, GaussianFit] = {base: _fit(channel, base, {})}
        try:
            for terms in _sums(fits, base, further, certain):
                end.ask()
                fits[terms] = _fit(channel, terms, fits)
        except deadline.TimeIsUp:
            claims.append(Claim("noise.ended", why=end.why))
        parts.append(_drawn_sums(channel, fits, seed + k))
        best = parts[-1][0][0]
        law, values = best.law, {n: float(d[0]) for n, d in best.draws.items()}
        if end.over:
            break
    # The mixture over imputations of lost readings.
    parts = parts[-(IMPUTATIONS - 1) :]
    for *_, probabilities in parts:
        mean.update({terms: p / len(parts) for terms, p in probabilities.items()})
    drawn = sorted((n for run, *_ in parts for n in run), key=lambda n: -mean[n.terms])
    walk = np.concatenate([walk for _, walk, _ in parts])
    probable: dict[Terms, Any] = dict(mean.most_common())
    return EvaluatedSums(drawn, walk, probable, tuple(claims), readings, runs, count)


def _sums(
    fits: Mapping[Terms, GaussianFit], base: Terms, further: Terms, certain: Terms
) -> Iterator[Terms]:
    """Yield the sums to evaluate besides the smallest, `base`: of two slow terms at most, and any of `further`.

    All but the smallest have the terms `certain`; the best sum is last evaluated without each of these, as noise
    correlated over a few readings resembles them.
    """
    pairs = [p for p in itertools.combinations_with_replacement(SLOW, 2) if p not in NOT_TWICE]
    counts = range(len(further) + 1)
    brief = [{*chosen, *certain} for k in counts for chosen in itertools.combinations(further, k)]
    slow_sums = [(), *((term,) for term in SLOW), *pairs]
    sums = {_in_term_order((*base, *s, *b)) for s in slow_sums for b in brief} - {base}
    yield from sorted(sums, key=lambda terms: (len(terms), terms))
    best = next(iter(_totals(fits)))
    yield from {tuple(t for t in best if t != term) for term in certain} - {*fits}


def _drawn_sums(
    channel: _AtRest, fits: dict[Terms, GaussianFit], seed: int
) -> tuple[list[RestNoise], np.ndarray, dict[Terms, float]]:
    """Draw the probable sums and the most probable one's random walk; return them and all probabilities."""
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
        if not (unsampled := [t for t in probable if t not in sampled]):
            break
        # Importance sampling corrects the Laplace evidence of skewed posteriors.
        for terms in unsampled:
            fits[terms] = fits[terms]._replace(log_evidence=sample(terms))
    drawn = [_draw_parameters(channel, t, *sampled[t], seed, probabilities[t]) for t in probable]
    walk = drawn[0]
    if "walk" not in walk.terms:
        further = _in_term_order((*walk.terms, "walk"))
        if further not in fits:
            fits[further] = _fit(channel, further, fits)
        if further not in sampled:
            sample(further)
        walk = _draw_parameters(channel, further, *sampled[further], seed, 1.0)
    return drawn, walk.draws["noise.walk"], probabilities


def _changes(output: Float[np.ndarray, "n"], runs: EvenRuns) -> Float[np.ndarray, "k"]:
    """Return the differences of neighbouring readings."""
    changes = np.concatenate([np.diff(run) for run in runs.of(output)])
    return changes[np.isfinite(changes)]


def _first_of_repeats(output: Float[np.ndarray, "n"], runs: EvenRuns) -> EvenRuns:
    """Reduce a held output to the first reading of each value, at their mean step; return other outputs whole.

    Of neighbours that differ by about m, 0.27·g/m are equal by rounding to steps of g; of a held output many more are,
    and no value lasts much longer than others, unlike in an output that is stuck for a while.
    """
    changes = np.abs(_changes(output, runs))
    changed = changes[changes > 0]
    least = np.min(np.diff(np.unique(output)), initial=math.inf)
    rounded = least / np.median(changed) if len(changed) else 1.0
    recorded = [r[r >= 0] for r in runs.rows]
    first = [np.append(True, np.diff(output[rows_of_run]) != 0) for rows_of_run in recorded]
    longest = max(int(np.diff(np.flatnonzero(f), append=len(f)).max()) for f in first)
    repeated = len(changed) < (1 - max(limit("noise.held", "share"), rounded)) * len(changes)
    if not repeated or longest * len(changed) > limit("noise.held", "ratio") * len(changes):
        return runs
    span = sum(len(r) - 1 for r in runs.rows) * runs.step
    rows = tuple(rows_of_run[f] for rows_of_run, f in zip(recorded, first, strict=True))
    return EvenRuns(rows, span / sum(len(r) - 1 for r in rows))


def _level_count(
    output: Float[np.ndarray, "n"], runs: EvenRuns, clear: float, line: Mapping[str, float]
) -> int | None:
    """Return the readings per mean at which the Allan deviation begins to fall with slope −½; None if it never does.

    A narrow line is subtracted: its Allan deviation rises and falls over a period. Single readings are accepted where
    the slope is −½ within two standard deviations and neighbours are uncorrelated.
    """
    variance, _ = allan.overlapping(output, runs)
    if clear > LINE_SD:
        law = SummedNoise(1.0, 2.0 * len(output), ("tone",))
        variance -= law.allan_variance({WHITE: 0.0, **line}, line[TONE[0]] ** 2, runs.factors, 1.0)
    limit = 4.0 ** (2 * LEVEL_SLOPE) * variance[:-2]
    freedom = allan.degrees_of_freedom(runs, np.zeros(len(variance)))
    limit[:1] *= 1 + NEIGHBOURS_SD * np.sqrt(2 / freedom[2:3])
    level = variance[2:] <= limit
    level[1:] &= sum(runs.lengths) >= FEWEST_MEANS * runs.factors[1:-2]
    level[:1] &= clear > LINE_SD or _negative_correlation_sd(output, runs) > -NEIGHBOURS_SD
    return int(runs.factors[np.argmax(level)]) if level.any() else None


def _means_of(readings: Measurements, runs: EvenRuns, count: int) -> tuple[Measurements, EvenRuns]:
    """Average `count` consecutive readings; a mean of fewer than half of them is lost."""
    parts = [r[: len(r) // count * count].reshape(-1, count) for r in runs.rows if len(r) >= count]
    valid = [2 * np.sum(part >= 0, axis=1) >= count for part in parts]
    full = np.concatenate([part[mask] for part, mask in zip(parts, valid, strict=True)])
    means = readings.select(full.max(axis=1))
    for name in readings.columns:
        if readings.unit(name) is not None:
            values = np.where(full >= 0, readings[name][full], 0.0)
            means = means.with_column(name, values.sum(axis=1) / np.sum(full >= 0, axis=1))
    place = np.split(np.cumsum(np.concatenate(valid)) - 1, np.cumsum([len(t) for t in valid])[:-1])
    rows = tuple(np.where(mask, at, -1) for mask, at in zip(valid, place, strict=True))
    return means, EvenRuns(rows, count * runs.step)


def _in_term_order(terms: Terms) -> Terms:
    """Sort terms into the canonical order of a sum."""
    return tuple(sorted(terms, key=list(TERMS).index))


def _negative_correlation_sd(output: Float[np.ndarray, "n"], runs: EvenRuns) -> float:
    """Return the significance of a negative correlation of neighbours, as of rounded angles, in standard deviations.

    Half the mean square of differences k readings apart is γ₀ − γₖ, linear in k under slow noise: if its value at k = 1
    is above (below) the extrapolation from k ≥ 2, neighbours are correlated negatively (positively).
    """
    squares, counts = np.zeros(len(LINE) + 1), np.zeros(len(LINE) + 1)
    for run in runs.of(output):
        for k in range(1, min(len(run), len(squares) + 1)):
            differences = run[k:] - run[:-k]
            differences = differences[np.isfinite(differences)]
            squares[k - 1] += 0.5 * float(differences @ differences)
            counts[k - 1] += len(differences)
    rise = squares / counts
    expected = float(LINE @ rise[1:])
    # Each γₖ of n readings of white noise, of the variance γ₀, has the variance γ₀²/n.
    deviation = abs(expected) * math.sqrt((1 + float(LINE @ LINE)) / counts[0])
    return float(rise[0] - expected) / deviation


def _find_line(output: Float[np.ndarray, "n"], runs: EvenRuns) -> tuple[float, dict[str, float]]:
    """Find the longest run's strongest spectral line: its significance in standard deviations, and a tone's start.

    A frequency is compared with the geometric mean of both sides, which cancels the spectrum's slope; of the mean of k
    windows, the logarithm of this ratio has a standard deviation of about 1/√k.
    """
    run, best, line = max(runs.of(output), key=len), 0.0, dict[str, float]()
    run = np.where(np.isfinite(run), run, np.nanmean(run))
    length = WINDOW
    while (count := len(run) // length) >= WINDOWS:
        # One-sided, so that its mean over frequencies to ½ per reading is twice the variance.
        window, parts = np.hanning(length), run[: count * length].reshape(count, length)
        spectra = np.abs(np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * window)) ** 2
        power = 2 * spectra.mean(axis=0) / np.sum(window**2)
        places = np.arange(BACKGROUND[-1] + 1, len(power) - BACKGROUND[-1] - 1)
        low, high = (power[places[:, None] + sign * BACKGROUND].mean(axis=1) for sign in (-1, 1))
        around = np.sqrt(low * high)
        sigmas = np.log(power[places] / around) / (1 / math.sqrt(count) + SMOOTH)
        if sigmas[k := int(np.argmax(sigmas))] > best:
            # A Hann window spreads a line over 1.5 bins.
            size = math.sqrt(1.5 * float(power[places[k]] - around[k]) / length)
            best, entries = float(sigmas[k]), (size, float(places[k]) / length, float(length))
            line = dict(zip(TONE, entries, strict=True))
        length *= 2
    if line:  # at the maximum of the whole run's spectrum within that window's width
        power = np.abs(np.fft.rfft((run - run.mean()) * np.hanning(len(run))))
        low, high = (round((line[TONE[1]] + side / line[TONE[2]]) * len(run)) for side in (-1, 1))
        line[TONE[1]] = (max(low, 1) + float(np.argmax(power[max(low, 1) : high]))) / len(run)
    return best, line


def _totals(fits: Mapping[Terms, GaussianFit]) -> dict[Terms, float]:
    """Return log evidence plus log prior of sums, the most probable first.

    The smallest sum has one half of the prior; each further term halves the joint prior of the sums of that size.
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
    """Return each run's columns (temperature polynomial, if it varies, and output; NaN where a reading was lost), the
    standard deviation of neighbours, output unit, and claims of the processing."""
    output, claims = np.asarray(readings["output"], float), list[Claim]()
    changes = _changes(output, runs)
    size = float(np.median(np.abs(changes - np.median(changes)))) * 1.4826 / math.sqrt(2)
    if not size > 0:
        raise InputError(
            f"{readings.file}: more than half of the readings are equal to their neighbours, so the output is rounded "
            "more coarsely than its noise: record it with more digits"
        )
    columns = (output - np.median(output))[:, None]
    least_range = limit("noise.temperature", "degrees")
    if readings.has("temperature") and float(np.ptp(readings["temperature"])) > least_range:
        temperature = np.asarray(readings["temperature"], float)
        place = 2 * (temperature - temperature.min()) / np.ptp(temperature) - 1
        columns = np.column_stack([legvander(place, DEGREE)[:, 1:], columns])
        claims.append(Claim("noise.temperature", "temperature", degree=DEGREE))
    if runs.lost:
        claims.append(Claim("noise.lost", share=runs.lost))
    parts = [np.where((r < 0)[:, None], np.nan, columns[r]) for r in runs.rows if len(r) > 1]
    return parts, size, claims


def _impute_run(
    columns: Float[np.ndarray, "n r"],
    law: SummedNoise,
    values: Mapping[str, float],
    step: float,
    random: np.random.Generator,
) -> Float[np.ndarray, "n r"]:
    """Draw a run's lost readings from a noise law, given the others; its temperature columns are interpolated.

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
    curve = [np.interp(places, places[~lost], column[~lost]) for column in columns.T[:-1]]
    design = np.column_stack([np.ones(n), *curve])
    mean = design @ np.linalg.lstsq(design[~lost], columns[~lost, -1], rcond=None)[0]
    parameters = {name: np.array([[value]]) for name, value in values.items()}
    terms = law.spectrum(parameters, step, eigenvalues(n, np.arange(n)))
    density = parameters[WHITE] ** 2 + sum((term.symbol for term in terms), np.zeros((1, n)))
    weight = np.append(0.0, 1 / density[0, 1:])

    def precise(x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "m"]:
        return np.asarray(idct(weight * dct(x, norm="ortho"), norm="ortho"))[m]

    q = LinearOperator((len(m), len(m)), lambda x: precise(np.bincount(m, x.ravel(), n)))
    noise = np.where(lost, 0.0, columns[:, -1] - mean)
    right = idct(np.sqrt(weight) * random.standard_normal(n), norm="ortho")[m] - precise(noise)
    noise[m], _ = cg(q, right, rtol=1e-6)
    return np.column_stack([*curve, mean + noise])


def _fit(channel: _AtRest, terms: Terms, fits: Mapping[Terms, GaussianFit]) -> GaussianFit:
    """Find a sum's mode, also from the modes of sums of one term less; return it with its Laplace evidence."""
    priors, values = channel.law(terms).parameters(), channel.log_density(terms)
    starts = list(_starts(channel, terms, priors))
    least = starts[-1]  # further terms as small as any start has them
    for part in {terms[:i] + terms[i + 1 :] for i in range(len(terms))} & {*fits}:
        coordinates = dict(zip(channel.law(part).parameters(), fits[part].v, strict=True))
        starts.append(np.array([coordinates.get(n, v) for n, v in zip(priors, least, strict=True)]))
    scale = np.ones(len(priors))
    if "tone" in terms:  # a line is known to a part of its width
        frequency_range = channel.line[TONE[1]] - np.array([0.1 / channel.line[TONE[2]], 0.0])
        scale[list(priors).index(TONE[1])] = np.diff(priors[TONE[1]].coordinate(frequency_range))[0]
    order = np.argsort(-values(np.array(starts)))[:STARTS]
    densities = [(ByValues(values, scale), starts[i]) for i in order]
    fits_here = (gaussian_fit(density, climb(density, at)) for density, at in densities)
    return max(fits_here, key=lambda fit: fit.log_density)


def _starts(channel: _AtRest, terms: Terms, priors: dict[str, Any]) -> Iterator[np.ndarray]:
    """Yield starting coordinates from the Allan curve: each term as large as it allows, several time constants."""
    tau, curve, step, line = channel.tau, channel.allan, channel.spectrum.step, channel.line
    sizes = {
        WHITE: math.sqrt(curve[0]),
        "noise.walk": math.sqrt(3 * curve[-1] / tau[-1]),
        "noise.flicker": math.sqrt(float(np.min(curve)) / FLICKER_FLOOR),
        "noise.quantisation": tau[0] * math.sqrt(curve[0] / 3),
        "noise.averaging": math.sqrt(curve[0]),
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
            variance = 1.6 * float(np.interp(math.log(2 * time), np.log(tau), curve))
            values[f"noise.correlated{k}.diffusion"] = factor * math.sqrt(2 * variance / time)
            values[f"noise.correlated{k}.time"] = time
            part = math.log(time / before) / math.log(channel.longest / before)
            values[f"noise.correlated{k}.place"], before = float(ndtri(part)), time
        yield np.array([float(p.coordinate(values[n])) for n, p in priors.items()])


def _line_size(y: Float[np.ndarray, "n"], turn: float) -> float:
    """Return the root mean square of a line in a run, less the noise at its frequency, output unit.

    For a line coherent over the record: with c the largest coefficient of the periodogram near its frequency, about
    `turn` cycles per reading, |c|²/2 is its mean square.
    """
    n = len(y)
    edges = np.linspace(0, n, min(LINE_BLOCKS, n) + 1).astype(int)
    slow = np.add.reduceat((y - y.mean()) * np.exp(-2j * math.pi * turn * np.arange(n)), edges[:-1])
    place = 0.5 * (edges[:-1] + edges[1:]) / n

    def power(offset: float) -> float:
        """Return the periodogram at an offset from the frequency, cycles per run."""
        return float(2 * abs(slow @ np.exp(-2j * math.pi * offset * place)) ** 2 / n)

    offset = 0.0
    for width in (0.8, 0.1):
        offset = max(offset + width * np.linspace(-1, 1, 9), key=power)
    around = np.mean([power(offset + k) for k in (*BACKGROUND, *-BACKGROUND)])
    return math.sqrt(max(power(offset) - float(around), 0.0) / n)


def _draw_parameters(
    channel: _AtRest, terms: Terms, v: np.ndarray, weights: np.ndarray, seed: int, share: float
) -> RestNoise:
    """Resample parameters by the weights of v to equal probability; `share` of all resampled draws."""
    chosen, law = v[resample(weights, max(1, round(share * RESAMPLED)), seed)], channel.law(terms)
    priors = law.parameters()
    parameters = {n: np.asarray(p.value(chosen[:, i])) for i, (n, p) in enumerate(priors.items())}
    if "tone" in terms:
        coherent = parameters[TONE[2]] > COHERENT_SHARE * channel.longest
        if coherent.any():
            turn = float(np.median(parameters[TONE[1]][coherent])) * channel.spectrum.step
            run = max(channel.columns, key=len)[:, -1]
            error = parameters[WHITE] / math.sqrt(len(run))
            error = error * np.random.default_rng(seed).standard_normal(len(error))
            size = np.abs(_line_size(run, turn) + error)
            parameters[TONE[0]] = np.where(coherent, size, parameters[TONE[0]])
    return RestNoise(terms, parameters, law)


def _filter_densities(sums: EvaluatedSums) -> tuple[np.ndarray, np.ndarray]:
    """Return draws of N and of K for a filter; without correlated noise, K is the random walk's bound."""
    factors, step = sums.runs.factors, sums.runs.step
    of_walk = step * (2 * factors**2 + 1) / (6 * factors)
    densities, walks = [], []
    for noise in sums.drawn:
        n = noise.density(step) / step**0.5
        rounded = noise.draws.get("noise.quantisation", 0.0) / step
        n = np.sqrt(n**2 + 3 * rounded**2)  # falls more slowly than Q, and is as much at first
        if not {*noise.terms} - {ROUNDED, AVERAGED}:
            densities.append(n * step**0.5)
            walks.append(np.resize(sums.walk, len(n)))
            continue
        allan_variance = noise.allan_variance(factors, step)
        reached = FILTER_REACHES_SHARE**2 * allan_variance
        # Candidate densities reach the law at one averaging time each; the chosen one, with its walk, exceeds the law
        # least (d, densities, times).
        white = np.maximum(np.column_stack([0 * n, reached * factors]), n[:, None] ** 2)
        lacking = (reached[:, None] - white[..., None] / factors) / of_walk
        walk_variance = np.square(noise.draws.get("noise.walk", 0.0))[..., None]
        walk = np.maximum(lacking.max(axis=2), walk_variance)
        total = white[..., None] / factors + walk[..., None] * of_walk
        least = np.argmin(np.log(total / allan_variance[:, None]).sum(axis=2), axis=1)[:, None]
        densities.append(np.sqrt(np.take_along_axis(white, least, 1)[:, 0] * step))
        walks.append(np.sqrt(np.take_along_axis(walk, least, 1)[:, 0]))
    return np.concatenate(densities), np.concatenate(walks)


def _figures(
    sums: EvaluatedSums, unit: str, curve: Float[np.ndarray, "d k"]
) -> tuple[NoiseFigure, ...]:
    """Return each term's figure over the probable sums that have it, if these are more than half."""
    names, best, step, base = (allan.habit(unit), sums.drawn[0], sums.runs.step, unit or "1")
    (density, bias, walk), (of_density, of_bias, of_walk) = names.names, names.units
    draw_count = sum(len(noise.draws[WHITE]) for noise in sums.drawn)

    def over_all(name: str) -> np.ndarray | None:
        samples = [noise.draws[name] for noise in sums.drawn if name in noise.draws]
        return np.concatenate(samples) if 2 * sum(map(len, samples)) > draw_count else None

    white = np.concatenate([noise.density(step) for noise in sums.drawn])
    white = white if sums.count else np.full(1, math.nan)  # not even a bound
    inside = 0 < np.argmin(np.median(curve, axis=0)) < curve.shape[1] - 1
    floor = np.sqrt(np.min(curve, axis=1) / FLICKER_FLOOR) if inside else None
    k = over_all("noise.walk")
    # Where most sums have no walk, the bound is over all sums, with their own walk or the added one.
    bound = [
        noise.draws.get("noise.walk", np.resize(sums.walk, len(noise.draws[WHITE])))
        for noise in sums.drawn
    ]
    rows = [
        ("Q", "quantisation noise", names.rounded, f"{base}*s", over_all("noise.quantisation")),
        ("N", density, of_density, f"{base}/Hz^0.5", white),
        ("B", f"{bias} (flicker)", of_bias, base, over_all("noise.flicker")),
        ("", f"{bias} (lowest Allan deviation over 0.664)", of_bias, base, floor),
        ("K", walk, of_walk, f"{base}/s^0.5", np.concatenate(bound) if k is None else k),
        ("", "tone, size", of_bias, base, over_all("noise.tone")),
        ("", "tone, frequency", "Hz", "Hz", over_all("noise.tone.frequency")),
        ("", "tone, correlation time", "s", "s", over_all("noise.tone.time")),
    ]
    for place, (size, time) in enumerate(best.processes, 1):
        name = f"Ornstein–Uhlenbeck {place}"
        rows.append(("", f"{name}, size", of_bias, base, size))
        rows.append(("", f"{name}, correlation time", "s", "s", time))
    bounded = {"K": k is None, "N": not sums.count}
    visible = ((*row, bounded.get(row[0], False)) for row in rows if row[-1] is not None)
    return tuple(itertools.starmap(_figure, visible))


def _figure(
    symbol: str, name: str, unit: str, draw_unit: str, draws: np.ndarray, bound: bool = False
) -> NoiseFigure:
    """Summarise draws in `draw_unit` as a figure in `unit` and in base units."""
    tail = 0.5 * (1 - CONFIDENCE)
    low, middle, high = np.quantile(draws, [tail, 0.5, 1 - tail])
    if bound:  # one-sided
        low, high = 0.0, np.nan_to_num(np.quantile(draws, CONFIDENCE), nan=math.inf)
    (base, to_base), factor = _to_base_unit(draw_unit), parse(draw_unit).factor / parse(unit).factor
    values = np.array([middle, low, high])
    (value, least, most), (*si,) = (factor * values).tolist(), (to_base * values).tolist()
    return NoiseFigure(symbol, name, unit, value, least, most, base, (si[0], si[1], si[2]), bound)


def _to_base_unit(unit: str) -> tuple[str, float]:
    """Return a unit's base unit, as customarily written, and the factor to it."""
    end = next((e for e in ("/Hz^0.5", "/s^0.5") if unit.endswith(e)), "")
    parsed, g = parse(unit.removesuffix(end)), STANDARD_GRAVITY * 1e-6
    named_units = {  # by powers of base units: in words, and the factor from the base unit
        (("ug", 1),): (f"m/s^2{end}", g),
        (("rad", 1), ("s", -1)): (f"rad/s{end}", 1.0),
        (("rad", 1),): ("rad", 1.0),
        (("s", 1), ("ug", 1)): ("m/s", g),
    }
    powers = tuple(sorted(parsed.powers.items()))
    if powers not in named_units:
        return unit, 1.0
    words, factor = named_units[powers]
    return words, parsed.factor * factor
