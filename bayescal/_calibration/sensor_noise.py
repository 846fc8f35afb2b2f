"""Noise of a sensor at rest: Q, N, B and K of IEEE 952 with intervals, by the likelihood of sums of noise terms.

A "sum" is a noise model: white noise plus independent terms. Each is fitted to the spectrum of the readings, with run
levels and a cubic in temperature integrated out (restricted likelihood); sums are weighted by their evidence, and
parameters of probable sums drawn by importance sampling. Lost readings are imputed from the noise model conditional on
the others, and the sums fitted again (data augmentation).

N is the density along which the Allan deviation falls with slope −½ (IEEE 952, C.1.2). A low-pass filter, a moving
average, interpolation or a sample-and-hold output correlates readings over shorter times: if the slope −½ begins only
at means of m readings, these means are analysed. Means over times much longer than a process's correlation time are
white noise, except for a correlation of neighbours.

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
from bayescal._core.formatting import number, probability, wrap
from bayescal._core.importance_weights import resample
from bayescal._core.parallel import run_on_one_thread
from bayescal._core.result_table import Printed, ResultTable, make_table
from bayescal._core.settings import settings, to_seed
from bayescal._data import allan_deviation as allan
from bayescal._data.allan_deviation import CONFIDENCE, AllanDeviation, EvenRuns
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import convert, parse, same_dimension, unit_label
from bayescal._inference.newton import LOG_ZERO, GaussianFit, NumericDensity, fit_gaussian, maximise
from bayescal._inference.noise_nodes import EvenSpectrum
from bayescal._inference.sampling import draw_by_importance
from bayescal._model.noise_law import WHITE
from bayescal._model.noise_spectrum import compute_eigenvalues
from bayescal._model.noise_terms import FLICKER_FLOOR, TERMS
from bayescal._model.prior import HalfCauchy
from bayescal._model.summed_noise import SummedNoise

# Ratio of a sum's probability to the largest one, above which parameters of the sum are drawn.
SAMPLED_RATIO = 0.1
# |z| of the excess correlation of neighbours, above which quantisation or averaging noise is a candidate term.
NEIGHBOUR_Z = 2.0
LINE_Z = 4.5  # z of a spectral line against its neighbours, above which a tone is a candidate term
# z of a candidate term above which every sum includes it; the best sum is also evaluated without it.
REQUIRED_Z = 6.0
# Steepest slope of the Allan deviation over two octaves that counts as −½. After a low-pass of time constant T it is
# reached by means over 3.4·T, of which only neighbours have a correlation above 0.01.
WHITE_SLOPE = -0.35
MIN_MEAN_COUNT = 64  # number of means for an Allan slope known to 0.1
MAX_SHORT_STEPS = 3.0  # correlation time in steps, up to which a process is part of N

Terms = tuple[str, ...]  # names of a sum's terms, besides white noise
CURVE_DEGREE = 3  # of the polynomial in temperature
IMPUTATION_COUNT = 6  # number of imputations of lost readings; the first is burn-in
SLOW_TERMS = ("walk", "flicker", "correlated")  # a sum has two of them at most
OMITTED = (("walk", "walk"), ("flicker", "flicker"))  # pairs of slow terms that no sum has
TONE: Terms = ("noise.tone", "noise.tone.frequency", "noise.tone.time")
TONE_RMS, TONE_FREQ, TONE_TIME = TONE
QUANTISATION, AVERAGING = "quantisation", "averaging"  # terms that correlate neighbours only
# Weights of values at lags 2 to 6 in the extrapolation of their regression line to lag 1.
LAG_WEIGHTS = 0.2 - 0.3 * np.arange(-2, 3)
MIN_WINDOW_LENGTH = 64  # readings in the shortest window of the search for a line; lengths double
MIN_WINDOW_COUNT = 8  # smallest number of windows, at the longest length
# Frequency offsets of a line's background, in bins; the half-width of the window's main lobe is 2.
LINE_OFFSETS = np.array([3, 4, 5, 6])
MAX_PHASE_BLOCKS = 256  # number of blocks of a run in which the phase of a line is computed
COHERENT_SHARE = 0.25  # coherence time of a coherent line over the longest run, at least
BACKGROUND_CURVATURE = 0.02  # relative curvature of a spectrum without lines over these bins
MODE_SEARCH_STARTS = 2  # number of starting points of the search for a mode, the best ones
DRAWS_PER_SUM = 2048  # number of importance-sampling draws of each sum
MIXTURE_DRAWS = 2048  # number of resampled draws, over all sums together
MIN_PROBABILITY = 0.01  # probability from which a sum or a noise law is printed
# Posterior quantile of N and K for a filter: underestimated noise makes it overconfident.
FILTER_QUANTILE = 0.95
# Share of the noise model's Allan deviation that a filter's two terms must reach at every averaging time.
FILTER_RATIO = 0.95
MAX_PRINTED_SUMS = 4  # number of sums that are printed with their probabilities
SI_UNITS = ("rad/s", "rad", "m/s^2", "m/s")
KEYS = ("tau", "deviation", "low", "high", "law", "law_low", "law_high")  # of the curve in JSON


@dataclass(frozen=True)
class NoiseFigure:
    """A parameter of a noise model with its 95 % credible interval, in the unit of data sheets and in SI units."""

    symbol: str  # of IEEE 952; empty for others
    name: str  # as in data sheets
    unit: str  # of data sheets
    value: float  # the median
    low: float
    high: float
    si_unit: str
    si: tuple[float, float, float]  # value, low and high in `si_unit`
    bound: bool = False  # not identified: `high` is an upper bound, infinite if there is none

    def row(self) -> list[str]:
        """Return the printed row: name, value, interval, SI value."""
        name = f"{self.name} {self.symbol}".strip()
        interval = f"{number(self.low)} to {number(self.high)}"
        value, si = number(self.value), number(self.si[0])
        if self.bound and not math.isfinite(self.high):
            return [name, "", "not determined", ""]
        if self.bound:
            value, interval, si = f"< {number(self.high)}", "one-sided", f"< {number(self.si[2])}"
        units = unit_label(self.unit), unit_label(self.si_unit)
        return [name, f"{value} {units[0]}".strip(), interval, f"{si} {units[1]}".strip()]


@dataclass(frozen=True, repr=False)
class SensorNoise(Printed):
    """Noise model of a channel at rest: its parameters, Allan deviation and probability.

    Attributes:
        file: name of the file.
        unit: output unit.
        step: sampling interval, s.
        terms: noise terms of the most probable sum besides white noise, as `SummedNoise` names them.
        probabilities: posterior probabilities of the sums, by description, the most probable first.
        figures: Q, N, B, K and the other parameters of the noise model.
        measured: Allan deviation of the record.
        expected: posterior median of the noise model's Allan deviation (k,), output unit.
        low, high: bounds of its 95 % credible band (k,).
        estimate_low, estimate_high: 95 % bounds of the Allan deviation that a record of this length would give (k,).
        claims: processing of the record, and failed checks of the noise model.
        densities: posterior draws of N and K for a Kalman filter, output unit times √s and per √s.
        horizon: longest averaging time for which the filter's K holds, s.
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

    def _list_parts(self) -> list[str | ResultTable]:
        rows = [figure.row() for figure in self.figures]
        sum_texts = [
            f"{w} {probability(p)}" for w, p in self.probabilities.items() if p >= MIN_PROBABILITY
        ]
        warnings = [f"Not to be used as they are. {c}" for c in self.claims if c.severity != "note"]
        heading = "term" + " of a law that does not fit" * bool(warnings)
        table = make_table([heading, "value", "95 % interval", "SI"], rows, width=40)
        prefix = "Best noise law, which does not fit" if warnings else "Noise law (probability)"
        remarks = [*warnings, f"{prefix}: {', '.join(sum_texts[:MAX_PRINTED_SUMS])}."]
        remarks += [f"Note: {claim}" for claim in self.claims if claim.severity == "note"]
        m, unit = self.measured, unit_label(self.unit) or "1"
        header = ["τ [s]", f"Allan deviation [{unit}]", "noise law", "95 % of simulated records"]
        columns = (m.tau, m.deviation, self.expected, self.estimate_low, self.estimate_high)
        curve_rows = [
            [number(t), number(d), number(e), f"{number(a)} to {number(b)}"]
            for t, d, e, a, b in zip(*columns, strict=True)
        ]
        lines = [line for note in remarks for line in ("", wrap(note, ""))]
        return [table, *lines, "", make_table(header, curve_rows, left=0)]

    def _format_summary(self) -> str:
        figures = (f"{f.symbol} {f.row()[1] or f.row()[2]}" for f in self.figures)
        return f"{self.law}; {', '.join(figures)}"

    def _list_columns(self) -> dict[str, list[Any]]:
        names = ("name", "symbol", "value", "low", "high", "unit")
        return {name: [getattr(f, name) for f in self.figures] for name in names}

    def for_filter(self, quantile: float | None = None) -> tuple[float, float]:
        """Return N and K for a filter of white noise and a random walk, output unit times √s and per √s.

        If noise is correlated, they are the smallest pair whose Allan deviation is at least 95 % of the noise model's
        at every averaging time up to `horizon`: N represents noise correlated over a few steps, K slower noise.

        Args:
            quantile: posterior quantile of N and K; 0.95 if None.
        """
        quantile = FILTER_QUANTILE if quantile is None else quantile
        n, k = (float(np.quantile(d, quantile)) for d in self.densities)
        return n, k

    def to_json_data(self) -> dict[str, Any]:
        """Return the result as a JSON object."""
        (n, k), m = self.for_filter(), self.measured
        band = (self.expected, self.low, self.high)
        columns = [column.tolist() for column in (m.tau, m.deviation, m.low, m.high, *band)]
        return {
            "file": self.file,
            "unit": self.unit,
            "step": self.step,
            "law": self.law,
            "probabilities": dict(self.probabilities),
            "figures": [{**vars(f), "si": list(f.si)} for f in self.figures],
            "curve": [dict(zip(KEYS, row, strict=True)) for row in zip(*columns, strict=True)],
            "for_filter": {"quantile": FILTER_QUANTILE, "N": n, "K": k, "horizon": self.horizon},
            "claims": [claim.to_json_data() for claim in self.claims],
        }


def noise(readings: Measurements, *, seed: Any = 0, time_limit: float | None = None) -> SensorNoise:
    """Estimate noise density, bias instability and random walk of a sensor at rest, with 95 % intervals.

        print(bc.noise(bc.read("still.csv", still_sensor.INSTRUMENT)))

    Sums of white noise (or of noise that the sensor averages), quantisation, a random walk, flicker noise and one or
    two Ornstein–Uhlenbeck processes are weighted by evidence; run levels and a cubic in temperature are integrated out.

    Args:
        readings: readings of one channel, evenly spaced in time within runs.
        seed: seed of the random draws.
        time_limit: seconds, after which only the sums fitted so far are used, with a note; Ctrl-C does the same.

    Raises:
        InputError: several devices or axes, no column `time`, no run of 30 readings, uneven steps, or an output that is
            constant or rounded coarsely.
    """
    for group in ("device", "axis"):
        if len(levels := readings.groups(group)[0]) > 1:
            raise InputError(
                f"{readings.file}: each {group} has its own noise ({', '.join(levels)}): select the readings of one, "
                f"such as readings.select(readings[{group!r}] == {levels[0]!r})"
            )
    with deadline.limit(time_limit):
        fits = _evaluate_sums(readings, seed := to_seed(seed))
    readings, runs, unit = fits.readings, fits.runs, readings.unit("output") or ""
    measured = allan.allan_deviation(readings, fits.residuals, runs)
    draws = np.concatenate([model.allan_variance(runs.factors, runs.step) for model in fits.noises])
    tail = 0.5 * (1 - CONFIDENCE)
    low, median, high = np.sqrt(np.quantile(draws, [tail, 0.5, 1 - tail], axis=0))
    dof = allan.compute_edf(runs, allan.classify_noise(np.median(draws, axis=0)))
    simulated = np.sqrt(draws * np.random.default_rng(seed).chisquare(dof, draws.shape) / dof)
    estimate_low, estimate_high = np.quantile(simulated, [tail, 1 - tail], axis=0)
    claims, step = list(fits.claims), runs.step / (fits.count or 1)
    if fits.count is None:
        claims.insert(0, Claim("noise.no_level", "N", name=allan.choose_noise_terms(unit).names[0]))
    elif fits.count > 1:
        claims.insert(0, Claim("noise.means", "N", time=runs.step, count=fits.count))
    is_outside = (measured.deviation < estimate_low) | (measured.deviation > estimate_high)
    if is_outside.sum() > limit("noise.outside", "times"):
        tau = tuple(number(t) for t in measured.tau[is_outside])
        claims.append(Claim("noise.outside", count=len(tau), times=len(is_outside), taus=tau))
    return SensorNoise(
        file=readings.file,
        unit=unit,
        step=step,
        terms=fits.noises[0].model.terms,
        probabilities={SummedNoise(1.0, 2.0, t).in_words: p for t, p in fits.probabilities.items()},
        figures=_summarise_figures(fits, unit, draws),
        measured=measured,
        expected=median,
        low=low,
        high=high,
        estimate_low=estimate_low,
        estimate_high=estimate_high,
        claims=tuple(claims),
        densities=_find_filter_densities(fits),
        horizon=float(runs.factors[-1] * runs.step),
    )


class RestNoise(NamedTuple):
    """A sum of noise terms fitted to a channel at rest."""

    model: SummedNoise
    draws: dict[str, np.ndarray]  # equally weighted posterior draws (d,) of its parameters
    walk: np.ndarray  # draws of K (d,); of the most probable sum plus a walk if it has none

    @property
    def processes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return standard deviation, output unit, and correlation time, s, of each Ornstein–Uhlenbeck process (d,)."""
        parameters = {**self.draws, **self.model.derived(self.draws)}
        names = (f"noise.correlated{k + 1}" for k in range(self.model.terms.count("correlated")))
        return [(parameters[f"{name}.size"], parameters[f"{name}.time"]) for name in names]

    def noise_density(self, step: float) -> Float[np.ndarray, "d"]:
        """Return N at each draw, output unit times √s, of readings `step` s apart.

        N includes white noise, averaged white noise and Ornstein–Uhlenbeck processes of up to three steps, which have
        the density s²·(1 + ρ)/(1 − ρ) per reading at low frequencies (variance s², correlation ρ of neighbours).
        """
        variance = self.draws[WHITE] ** 2 + self.draws.get(f"noise.{AVERAGING}", 0.0) ** 2
        for size, time in self.processes:
            is_short = time <= MAX_SHORT_STEPS * step
            variance = variance + np.where(is_short, size**2 / np.tanh(0.5 * step / time), 0.0)
        return np.sqrt(variance * step)

    def allan_variance(self, factors: Float[np.ndarray, "k"], step: float) -> np.ndarray:
        """Return the noise model's Allan variance at each draw (d, k), output unit squared."""
        total_variance = self.draws[WHITE] ** 2 + self.model.slow_variance(self.draws)
        return self.model.allan_variance(self.draws, total_variance, factors, step)


class _RestRecord(NamedTuple):
    """Runs, spectrum and scales of a channel at rest."""

    columns: Sequence[np.ndarray]  # of each run (n, r): those to integrate out, then the output
    spectrum: EvenSpectrum
    scale: float  # standard deviation from differences of neighbours, output unit
    max_duration: float  # duration of the longest run, rounded up to 2ᵏ sampling intervals, s
    tau: np.ndarray  # averaging times, s
    allan: np.ndarray  # Allan variances at these, output unit squared
    tone: Mapping[str, float]  # starting values of a tone; none if empty

    def model(self, terms: Terms) -> SummedNoise:
        scale = HalfCauchy(self.scale)
        return SummedNoise(self.spectrum.step, self.max_duration, terms, scale, scale)

    def log_density(self, terms: Terms) -> Callable[[Float[np.ndarray, "s d"]], np.ndarray]:
        """Return the log posterior density of a sum's parameter coordinates, levels and curve integrated out."""
        model = self.model(terms)
        priors = model.parameters()

        def evaluate(v: Float[np.ndarray, "s d"]) -> Float[np.ndarray, "s"]:
            parameters = {n: p.value(v[:, i]) for i, (n, p) in enumerate(priors.items())}
            log_prior = sum(p.log_density(v[:, i]) for i, p in enumerate(priors.values()))
            log_posterior = self.spectrum.log_likelihood(model, parameters) + log_prior
            return np.where(np.isfinite(log_posterior), log_posterior, LOG_ZERO)

        return evaluate


class EvaluatedSums(NamedTuple):
    """Sums of noise terms with their probabilities and draws."""

    noises: Sequence[RestNoise]  # the probable sums, draws in proportion to their probability
    probabilities: dict[Terms, float]  # the most probable first
    claims: tuple[Claim, ...]  # processing of the record
    readings: Measurements  # the record, or means of it
    residuals: Float[np.ndarray, "n"]  # output without its polynomial in temperature, output unit
    runs: EvenRuns  # runs of `readings`
    count: int | None  # readings in a mean; None where no Allan deviation falls with slope −½


@run_on_one_thread
def _evaluate_sums(readings: Measurements, seed: int) -> EvaluatedSums:
    """Compute the evidence of sums of noise terms for a channel at rest; draw the parameters of the probable sums."""
    runs = allan.even_runs(readings)
    columns, output, scale, claims = _list_columns(readings, runs)
    if not np.ptp(columns[:, -1]) > 0:
        raise InputError(f"{readings.file}: the output is constant: the sensor or logger is stuck")
    z, line = _find_line(output, runs)
    count = _count_readings_per_mean(output, runs, z, line)
    # Means over times much longer than a correlation time are white, except for correlated neighbours.
    base_terms: Terms = ()
    if count is not None and count > 1:
        readings, runs = _average(readings, runs, count)
        base_terms = (AVERAGING,)
        columns, output, scale, claims = _list_columns(readings, runs)
        z, line = _find_line(output, runs)
    if not scale > 0:
        raise InputError(
            f"{readings.file}: more than half of the readings are equal to their neighbours, so the output is held, or "
            "rounded more coarsely than its noise: record each value once, with more digits"
        )
    run_columns = [np.where((r < 0)[:, None], np.nan, columns[r]) for r in runs.rows if len(r) > 1]
    criteria = {"tone": (z, LINE_Z)}
    if not base_terms:
        negative_z = _compute_negative_correlation_z(output, runs)
        criteria[QUANTISATION if negative_z > 0 else AVERAGING] = abs(negative_z), NEIGHBOUR_Z
    optional_terms = tuple(term for term, (z_score, limit) in criteria.items() if z_score > limit)
    required_terms = tuple(term for term in optional_terms if criteria[term][0] > REQUIRED_Z)
    allan_variances, _ = allan.allan_variances(output, runs)
    max_duration = runs.step * 2.0 ** math.ceil(math.log2(max(runs.lengths)))
    channel_fields = scale, max_duration, runs.factors * runs.step, allan_variances, line
    walk_density = math.sqrt(3 * allan_variances[-1] / (runs.factors[-1] * runs.step))
    parameters = {WHITE: np.full((1, 1), scale), "noise.walk": np.full((1, 1), walk_density)}
    model = SummedNoise(runs.step, max_duration, ("walk",))
    rng, sum_weights = np.random.default_rng(seed), Counter[Terms]()
    imputations, time_limit = list[tuple[list[RestNoise], dict[Terms, float]]](), deadline.current()
    time_limit.defer_interrupt()
    for k in range(IMPUTATION_COUNT if runs.lost else 1):
        full_runs = [_impute_run(run, model, parameters, runs.step, rng) for run in run_columns]
        tones = [line[TONE_FREQ]] if "tone" in optional_terms else []  # frequencies, Hz
        channel = _RestRecord(full_runs, EvenSpectrum(full_runs, runs.step, tones), *channel_fields)
        fits: dict[Terms, GaussianFit] = {base_terms: _fit_sum(channel, base_terms, {})}
        try:
            for terms in _enumerate_sums(fits, base_terms, optional_terms, required_terms):
                time_limit.raise_if_over()
                fits[terms] = _fit_sum(channel, terms, fits)
        except deadline.TimeIsUp:
            claims.append(Claim("noise.ended", why=time_limit.reason))
        imputations.append(_sample_sums(channel, fits, seed + k))
        best = imputations[-1][0][0]
        model, parameters = best.model, {n: d[:1, None] for n, d in best.draws.items()}
        if time_limit.is_over:
            break
    residuals = columns[:, -1] - columns[:, :-1] @ channel.spectrum.regress(model, parameters)
    # The mixture over imputations of lost readings.
    imputations = imputations[-(IMPUTATION_COUNT - 1) :]
    for _, probabilities in imputations:
        sum_weights.update({terms: p / len(imputations) for terms, p in probabilities.items()})
    noises = [noise for fitted_models, _ in imputations for noise in fitted_models]
    noises.sort(key=lambda noise: -sum_weights[noise.model.terms])
    probable_sums: dict[Terms, Any] = dict(sum_weights.most_common())
    return EvaluatedSums(noises, probable_sums, tuple(claims), readings, residuals, runs, count)


def _enumerate_sums(
    fits: Mapping[Terms, GaussianFit], base_terms: Terms, optional_terms: Terms, required: Terms
) -> Iterator[Terms]:
    """Yield the sums to evaluate besides the smallest, `base_terms`: up to two slow terms and a set of optional terms.

    All but the smallest include the required terms. Finally the best sum is evaluated without each of these, because
    noise that is correlated over a few readings resembles them.
    """
    pairs = [p for p in itertools.combinations_with_replacement(SLOW_TERMS, 2) if p not in OMITTED]
    sizes = range(len(optional_terms) + 1)
    subsets = [{*c, *required} for k in sizes for c in itertools.combinations(optional_terms, k)]
    slow_sums = [(), *((term,) for term in SLOW_TERMS), *pairs]
    sums = {_sort_terms((*base_terms, *s, *b)) for s in slow_sums for b in subsets} - {base_terms}
    yield from sorted(sums, key=lambda terms: (len(terms), terms))
    best_terms = next(iter(_compute_log_posteriors(fits)))
    yield from {tuple(t for t in best_terms if t != term) for term in required} - {*fits}


def _sample_sums(
    channel: _RestRecord, fits: dict[Terms, GaussianFit], seed: int
) -> tuple[list[RestNoise], dict[Terms, float]]:
    """Draw the parameters of the probable sums; return these with draws, and the probabilities of all sums."""
    samples = dict[Terms, tuple[np.ndarray, np.ndarray]]()  # and their weights

    def sample(terms: Terms) -> None:
        """Draw a sum's parameters by importance sampling; replace the Laplace evidence by the resulting estimate."""
        log_density = channel.log_density(terms)
        v, weights, evidence = draw_by_importance(log_density, fits[terms], seed, DRAWS_PER_SUM)
        samples[terms], fits[terms] = (v, weights), fits[terms]._replace(log_evidence=evidence)

    while True:
        log_posteriors = _compute_log_posteriors(fits)
        shares = softmax(list(log_posteriors.values()))
        probabilities = dict(zip(log_posteriors, shares.tolist(), strict=True))
        probable = [t for t, share in probabilities.items() if share > SAMPLED_RATIO * shares[0]]
        if not (unsampled_sums := [t for t in probable if t not in samples]):
            break
        for terms in unsampled_sums:
            sample(terms)
    draws = {t: _draw_parameters(channel, t, *samples[t], seed, probabilities[t]) for t in probable}
    walk_draws = draws[probable[0]].get("noise.walk")
    if walk_draws is None:
        terms = _sort_terms((*probable[0], "walk"))
        if terms not in fits:
            fits[terms] = _fit_sum(channel, terms, fits)
        if terms not in samples:
            sample(terms)
        walk_draws = _draw_parameters(channel, terms, *samples[terms], seed, 1.0)["noise.walk"]
    walks = [d.get("noise.walk", np.resize(walk_draws, len(d[WHITE]))) for d in draws.values()]
    return [*map(RestNoise, map(channel.model, probable), draws.values(), walks)], probabilities


def _count_readings_per_mean(
    output: Float[np.ndarray, "n"], runs: EvenRuns, z: float, line: Mapping[str, float]
) -> int | None:
    """Return the readings per mean at which the Allan deviation begins to fall with slope −½; None if it never does.

    The Allan variance of a narrow spectral line, which oscillates, is subtracted. Single readings are analysed if the
    slope is −½ within two standard deviations and neighbours are uncorrelated.
    """
    variances, _ = allan.allan_variances(output, runs)
    if z > LINE_Z:
        tone_model = SummedNoise(runs.step, 2 * runs.step * len(output), ("tone",))
        values, line_variance = {WHITE: 0.0, **line}, line[TONE_RMS] ** 2
        variances -= tone_model.allan_variance(values, line_variance, runs.factors, runs.step)
    max_variances = 4.0 ** (2 * WHITE_SLOPE) * variances[:-2]
    dof = allan.compute_edf(runs, np.zeros(len(variances)))
    max_variances[:1] *= 1 + NEIGHBOUR_Z * np.sqrt(2 / dof[2:3])
    is_white = variances[2:] <= max_variances
    is_white[1:] &= sum(runs.lengths) >= MIN_MEAN_COUNT * runs.factors[1:-2]
    is_white[:1] &= z > LINE_Z or _compute_negative_correlation_z(output, runs) > -NEIGHBOUR_Z
    return int(runs.factors[np.argmax(is_white)]) if is_white.any() else None


def _average(readings: Measurements, runs: EvenRuns, count: int) -> tuple[Measurements, EvenRuns]:
    """Return means of blocks of `count` readings, and their runs; a block with more than half lost counts as lost."""
    blocks = [r[: len(r) // count * count].reshape(-1, count) for r in runs.rows if len(r) >= count]
    masks = [2 * np.sum(block >= 0, axis=1) >= count for block in blocks]
    row_indices = np.concatenate([block[mask] for block, mask in zip(blocks, masks, strict=True)])
    means = readings.select(row_indices.max(axis=1))
    for name in readings.columns:
        if readings.unit(name) is not None:
            values = np.where(row_indices >= 0, readings[name][row_indices], 0.0)
            means = means.with_column(name, values.sum(axis=1) / np.sum(row_indices >= 0, axis=1))
    row_no = np.split(np.cumsum(np.concatenate(masks)) - 1, np.cumsum([len(t) for t in masks])[:-1])
    rows = tuple(np.where(mask, index, -1) for mask, index in zip(masks, row_no, strict=True))
    return means, EvenRuns(rows, count * runs.step)


def _sort_terms(terms: Terms) -> Terms:
    """Sort terms into the canonical order of a sum."""
    return tuple(sorted(terms, key=list(TERMS).index))


def _compute_negative_correlation_z(output: Float[np.ndarray, "n"], runs: EvenRuns) -> float:
    """Return z of a negative correlation of neighbours, as in rounded angles; negative z is a positive correlation.

    The variogram, half the mean square of differences at lag k, is γ₀ − γₖ, linear in k under slow noise: if its value
    at k = 1 is above (below) the extrapolation from k ≥ 2, neighbours are correlated negatively (positively).
    """
    lags = np.arange(1, len(LAG_WEIGHTS) + 2)
    padded_runs = [np.append(run, np.full(lags[-1], np.nan)) for run in runs.arrange(output)]
    values = np.concatenate(padded_runs)
    differences = [values[k:] - values[:-k] for k in lags]
    variogram = np.array([0.5 * np.nanmean(d**2) for d in differences])
    count, extrapolation = np.isfinite(differences[0]).sum(), float(LAG_WEIGHTS @ variogram[1:])
    # The estimate of γₖ from n readings of white noise with variance γ₀ has the variance γ₀²/n.
    sd = abs(extrapolation) * math.sqrt((1 + float(LAG_WEIGHTS @ LAG_WEIGHTS)) / count)
    return float(variogram[0] - extrapolation) / sd


def _find_line(output: Float[np.ndarray, "n"], runs: EvenRuns) -> tuple[float, dict[str, float]]:
    """Find the longest run's strongest spectral line: return its z, and starting values of a tone.

    The power at a frequency is divided by the geometric mean of that on both sides, which cancels a sloping background;
    averaged over k windows, the logarithm of this ratio has a standard deviation of about 1/√k.
    """
    run, best_z, line = max(runs.arrange(output), key=len), 0.0, (0.0, 0, 0)
    run, length = np.where(np.isfinite(run), run, np.nanmean(run)), MIN_WINDOW_LENGTH
    while (count := len(run) // length) >= MIN_WINDOW_COUNT:
        # One-sided, so that its mean over frequencies to ½ per reading is twice the variance.
        window, blocks = np.hanning(length), run[: count * length].reshape(count, length)
        spectra = np.abs(np.fft.rfft((blocks - blocks.mean(axis=1, keepdims=True)) * window)) ** 2
        power = 2 * spectra.mean(axis=0) / np.sum(window**2)
        bins = np.arange(LINE_OFFSETS[-1] + 1, len(power) - LINE_OFFSETS[-1] - 1)
        low, high = (power[bins[:, None] + sign * LINE_OFFSETS].mean(axis=1) for sign in (-1, 1))
        background = np.sqrt(low * high)
        z = np.log(power[bins] / background) / (1 / math.sqrt(count) + BACKGROUND_CURVATURE)
        if z[k := int(np.argmax(z))] > best_z:
            # A Hann window spreads a line over 1.5 bins.
            rms = math.sqrt(1.5 * float(power[bins[k]] - background[k]) / length)
            best_z, line = float(z[k]), (rms, int(bins[k]), length)
        length *= 2
    if not best_z:
        return 0.0, {}
    # The frequency is that of the maximum of the full run's spectrum within the window's width.
    rms, k, length = line
    low, high = max(round((k - 1) * len(run) / length), 1), round((k + 1) * len(run) / length)
    power = np.abs(np.fft.rfft((run - run.mean()) * np.hanning(len(run))))[low:high]
    frequency = (low + float(np.argmax(power))) / (len(run) * runs.step)
    return best_z, dict(zip(TONE, (rms, frequency, length * runs.step), strict=True))


def _compute_log_posteriors(fits: Mapping[Terms, GaussianFit]) -> dict[Terms, float]:
    """Return the unnormalised log posterior of each sum (log evidence plus log prior), the most probable first.

    The smallest sum has the prior `prior_complete`; each further term halves the joint prior of sums of that length.
    """
    (base_terms, *other_sums), p0 = fits, settings().prior_complete
    counts = Counter(map(len, other_sums))
    share = {terms: 2.0 ** -len(terms) / counts[len(terms)] for terms in other_sums}
    priors = {base_terms: p0} | {t: (1 - p0) * s / sum(share.values()) for t, s in share.items()}
    totals = {terms: fit.log_evidence + math.log(priors[terms]) for terms, fit in fits.items()}
    return dict(sorted(totals.items(), key=lambda item: -item[1]))


def _list_columns(
    readings: Measurements, runs: EvenRuns
) -> tuple[Float[np.ndarray, "n r"], Float[np.ndarray, "n"], float, list[Claim]]:
    """Return centred columns (a polynomial in temperature if it varies; output), residuals, noise scale and claims.

    Residuals: of a least-squares fit of the polynomial. Scale: a robust sd of neighbours' differences, output unit.
    """
    output, claims = np.asarray(readings["output"], float), list[Claim]()
    changes = np.concatenate([np.diff(run) for run in runs.arrange(output)])
    scale = 1.4826 / math.sqrt(2) * float(np.nanmedian(np.abs(changes - np.nanmedian(changes))))
    columns = output[:, None]
    temperature = np.asarray(readings["temperature"] if readings.has("temperature") else [0.0])
    if np.ptp(temperature) > limit("noise.temperature", "degrees"):
        position = 2 * (temperature - temperature.min()) / np.ptp(temperature) - 1
        columns = np.column_stack([legvander(position, CURVE_DEGREE)[:, 1:], columns])
        claims.append(Claim("noise.temperature", "temperature", degree=CURVE_DEGREE))
        claims += [Claim("noise.suspect_temperature", a.column) for a in readings.anomalies[:1]]
    if runs.lost:
        claims.append(Claim("noise.lost", share=runs.lost))
    columns = columns - columns.mean(axis=0)
    polynomial = columns[:, :-1] @ np.linalg.lstsq(columns[:, :-1], columns[:, -1])[0]
    return columns, columns[:, -1] - polynomial, scale, claims


def _impute_run(
    columns: Float[np.ndarray, "n r"],
    model: SummedNoise,
    parameters: Mapping[str, Float[np.ndarray, "1 1"]],
    step: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "n r"]:
    """Draw a run's lost readings from the noise model, conditional on the others; interpolate its temperature columns.

    The precision matrix is Q = CᵀD⁻¹C except for end effects, with C the cosine transform and D the spectral density.
    For m the lost rows, ε standard normal and x zero at m, the solution of Q_mm·x_m = (CᵀD^(−½)·ε)_m − (Q·x)_m has the
    conditional mean and covariance Q_mm⁻¹. The level is free: 1/D is zero at frequency zero.
    Source: G. Papandreou and A. Yuille, Advances in Neural Information Processing Systems 23 (2010) 1858.
    """
    is_lost, n = np.isnan(columns[:, -1]), len(columns)
    if not is_lost.any():
        return columns
    from scipy.sparse.linalg import LinearOperator, cg  # loading takes a third of a second

    indices, (m,) = np.arange(n), np.nonzero(is_lost)
    temperatures = [np.interp(indices, indices[~is_lost], c[~is_lost]) for c in columns.T[:-1]]
    design = np.column_stack([np.ones(n), *temperatures])
    mean = design @ np.linalg.lstsq(design[~is_lost], columns[~is_lost, -1], rcond=None)[0]
    terms = model.spectrum(parameters, step, compute_eigenvalues(n, np.arange(n)))
    spectrum = parameters[WHITE] ** 2 + sum((term.symbol for term in terms), np.zeros((1, n)))
    weight = np.append(0.0, 1 / spectrum[0, 1:])

    def multiply(x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "m"]:
        return np.asarray(idct(weight * dct(x, norm="ortho"), norm="ortho"))[m]

    q = LinearOperator((len(m), len(m)), lambda x: multiply(np.bincount(m, x.ravel(), n)))
    deviations = np.where(is_lost, 0.0, columns[:, -1] - mean)
    rhs = idct(np.sqrt(weight) * rng.standard_normal(n), norm="ortho")[m] - multiply(deviations)
    deviations[m], _ = cg(q, rhs, rtol=1e-6)
    return np.column_stack([*temperatures, mean + deviations])


def _fit_sum(channel: _RestRecord, terms: Terms, fits: Mapping[Terms, GaussianFit]) -> GaussianFit:
    """Return the Laplace approximation of a sum; starting points include modes of the sums with one term less."""
    priors, log_density = channel.model(terms).parameters(), channel.log_density(terms)
    starts = list(_list_starts(channel, terms, priors))
    least = starts[-1]  # further terms as small as any start has them
    for subset in {terms[:i] + terms[i + 1 :] for i in range(len(terms))} & {*fits}:
        coordinates = dict(zip(channel.model(subset).parameters(), fits[subset].v, strict=True))
        starts.append(np.array([coordinates.get(n, v) for n, v in zip(priors, least, strict=True)]))
    scale = np.ones(len(priors))
    if "tone" in terms:  # the line's frequency is known to a tenth of its width
        interval = channel.tone[TONE_FREQ] - np.array([0.1 / channel.tone[TONE_TIME], 0.0])
        scale[list(priors).index(TONE_FREQ)] = np.diff(priors[TONE_FREQ].coordinate(interval))[0]
    order = np.argsort(-log_density(np.array(starts)))[:MODE_SEARCH_STARTS]
    densities = [(NumericDensity(log_density, scale), starts[i]) for i in order]
    fitted_modes = (fit_gaussian(density, maximise(density, start)) for density, start in densities)
    return max(fitted_modes, key=lambda fit: fit.log_density)


def _list_starts(channel: _RestRecord, terms: Terms, priors: dict[str, Any]) -> Iterator[Any]:
    """Yield starting coordinates: each term as large as the Allan variance allows, with several time constants."""
    tau, variances, step, line = channel.tau, channel.allan, channel.spectrum.step, channel.tone
    amplitudes = {
        WHITE: math.sqrt(variances[0]),
        "noise.walk": math.sqrt(3 * variances[-1] / tau[-1]),
        "noise.flicker": math.sqrt(float(np.min(variances)) / FLICKER_FLOOR),
        "noise.quantisation": tau[0] * math.sqrt(variances[0] / 3),
        "noise.averaging": math.sqrt(variances[0]),
        **line,
    }
    time_shares = itertools.combinations([0.2, 0.5, 0.8], terms.count("correlated"))
    coherences = (0.25, 2.0, 100.0) if "tone" in terms else (1.0,)
    for shares, coherence, factor in itertools.product(time_shares, coherences, (1.0, 0.3)):
        values, lower = {n: v if n == WHITE else factor * v for n, v in amplitudes.items()}, step
        if line:
            values[TONE_FREQ] = line[TONE_FREQ]
            values[TONE_TIME] = min(coherence * line[TONE_TIME], 0.7 * channel.max_duration)
        for k, share in enumerate(shares, 1):
            time = step * (channel.max_duration / step) ** share
            variance = 1.6 * float(np.interp(math.log(2 * time), np.log(tau), variances))
            values[f"noise.correlated{k}.diffusion"] = factor * math.sqrt(2 * variance / time)
            values[f"noise.correlated{k}.time"] = time
            fraction = math.log(time / lower) / math.log(channel.max_duration / lower)
            values[f"noise.correlated{k}.place"], lower = float(ndtri(fraction)), time
        yield np.array([float(p.coordinate(values[n])) for n, p in priors.items()])


def _fit_line_rms(y: Float[np.ndarray, "n"], frequency: float) -> float:
    """Return the root mean square of a coherent line in a run, less the noise at its frequency, output unit.

    The mean square is 1/n of the periodogram's maximum near `frequency`, in cycles per reading, less its background.
    """
    n = len(y)
    edges = np.linspace(0, n, min(MAX_PHASE_BLOCKS, n) + 1).astype(int)
    baseband = (y - y.mean()) * np.exp(-2j * math.pi * frequency * np.arange(n))
    bands, block_centres = np.add.reduceat(baseband, edges[:-1]), 0.5 * (edges[:-1] + edges[1:]) / n

    def compute_power(offset: float) -> float:
        """Return the periodogram at an offset from the frequency, cycles per run."""
        return float(2 * abs(bands @ np.exp(-2j * math.pi * offset * block_centres)) ** 2 / n)

    offset = 0.0
    for half_width in (0.8, 0.1):
        offset = max(offset + half_width * np.linspace(-1, 1, 9), key=compute_power)
    background = np.mean([compute_power(offset + k) for k in (*LINE_OFFSETS, *-LINE_OFFSETS)])
    return math.sqrt(max(compute_power(offset) - float(background), 0.0) / n)


def _draw_parameters(
    channel: _RestRecord, terms: Terms, v: np.ndarray, weights: np.ndarray, seed: int, share: float
) -> dict[str, np.ndarray]:
    """Resample noise parameters to equally weighted draws, `share` of `MIXTURE_DRAWS`, by parameter name.

    The rms of a coherent tone is drawn about its estimate from the longest run instead.
    """
    sample = v[resample(weights, max(1, round(share * MIXTURE_DRAWS)), seed)]
    priors = channel.model(terms).parameters()
    parameters = {n: np.asarray(p.value(sample[:, i])) for i, (n, p) in enumerate(priors.items())}
    if "tone" in terms:
        is_coherent = parameters[TONE_TIME] > COHERENT_SHARE * channel.max_duration
        if is_coherent.any():
            frequency = float(np.median(parameters[TONE_FREQ][is_coherent])) * channel.spectrum.step
            run = max(channel.columns, key=len)[:, -1]
            error = parameters[WHITE] / math.sqrt(len(run))
            error = error * np.random.default_rng(seed).standard_normal(len(error))
            amplitude = np.abs(_fit_line_rms(run, frequency) + error)
            parameters[TONE_RMS] = np.where(is_coherent, amplitude, parameters[TONE_RMS])
    return parameters


def _find_filter_densities(sums: EvaluatedSums) -> tuple[np.ndarray, np.ndarray]:
    """Return posterior draws of N and K for a Kalman filter; if noise is uncorrelated, K is the random walk's bound."""
    factors, step = sums.runs.factors, sums.runs.step
    walk_factor, densities, walk_draws = step * (2 * factors**2 + 1) / (6 * factors), [], []
    for noise in sums.noises:
        terms = {*noise.model.terms}
        quantisation = noise.draws.get("noise.quantisation", 0.0) / step
        # Quantisation noise falls more slowly than Q, and is as much at first.
        white = noise.noise_density(step) ** 2 / step + 3 * quantisation**2
        allan_variance = noise.allan_variance(factors, step)
        required = FILTER_RATIO**2 * allan_variance
        # Candidate densities reach the required deviation at one averaging time each; the chosen one, with its random
        # walk, has the least excess over all times (d, densities, times).
        white_var = np.maximum(np.column_stack([0 * white, required * factors]), white[:, None])
        required_walk = (required[:, None] - white_var[..., None] / factors) / walk_factor
        has_correlation = bool(terms - {QUANTISATION, AVERAGING})
        min_walk = 0 * white if has_correlation and "walk" not in terms else noise.walk**2
        walk = np.maximum(required_walk.max(axis=2), min_walk[:, None])
        variance = white_var[..., None] / factors + walk[..., None] * walk_factor
        index = np.argmin(np.log(variance / allan_variance[:, None]).sum(axis=2), axis=1)[:, None]
        densities.append(np.sqrt(np.take_along_axis(white_var, index, 1)[:, 0] * step))
        walk_draws.append(np.sqrt(np.take_along_axis(walk, index, 1)[:, 0]))
    return np.concatenate(densities), np.concatenate(walk_draws)


def _summarise_figures(
    sums: EvaluatedSums, unit: str, allan_variances: Float[np.ndarray, "d k"]
) -> tuple[NoiseFigure, ...]:
    """Summarise Q, N, B, K and other parameters; those of a term only if sums with it have over half of the draws."""
    names, best_noise, base = allan.choose_noise_terms(unit), sums.noises[0], unit or "1"
    (density, bias, walk), (density_unit, bias_unit, walk_unit) = names.names, names.units
    draw_count = sum(len(noise.draws[WHITE]) for noise in sums.noises)

    def pool_draws(name: str) -> np.ndarray | None:
        samples = [noise.draws[name] for noise in sums.noises if name in noise.draws]
        return np.concatenate(samples) if 2 * sum(map(len, samples)) > draw_count else None

    white_density = np.concatenate([noise.noise_density(sums.runs.step) for noise in sums.noises])
    white_density = white_density if sums.count else np.full(1, math.nan)  # not even a bound
    has_minimum = 0 < np.argmin(np.median(allan_variances, axis=0)) < allan_variances.shape[1] - 1
    floor_draws = np.sqrt(np.min(allan_variances, axis=1) / FLICKER_FLOOR) if has_minimum else None
    walk_draws = pool_draws("noise.walk")
    # If most sums have no random walk, the bound pools all sums, with the fitted or the added walk.
    walk_bound = np.concatenate([noise.walk for noise in sums.noises])
    no_flicker = "; no flicker resolved" * (pool_draws("noise.flicker") is None)
    rows = [
        ("Q", "quantisation noise", names.q_unit, f"{base}*s", pool_draws("noise.quantisation")),
        ("N", density, density_unit, f"{base}/Hz^0.5", white_density),
        ("B", f"{bias} (flicker)", bias_unit, base, pool_draws("noise.flicker")),
        ("", f"{bias} (Allan minimum / 0.664{no_flicker})", bias_unit, base, floor_draws),
        ("K", walk, walk_unit, f"{base}/s^0.5", walk_bound if walk_draws is None else walk_draws),
        ("", "tone, rms", bias_unit, base, pool_draws("noise.tone")),
        ("", "tone, frequency", "Hz", "Hz", pool_draws("noise.tone.frequency")),
        ("", "tone, correlation time", "s", "s", pool_draws("noise.tone.time")),
    ]
    for index, (sd, time) in enumerate(best_noise.processes, 1):
        name = f"Ornstein–Uhlenbeck {index}"
        rows.append(("", f"{name}, size", bias_unit, base, sd))
        rows.append(("", f"{name}, correlation time", "s", "s", time))
    is_bound = {"K": walk_draws is None, "N": not sums.count}
    shown_rows = ((*row, is_bound.get(row[0], False)) for row in rows if row[-1] is not None)
    return tuple(itertools.starmap(_summarise_figure, shown_rows))


def _summarise_figure(
    symbol: str, name: str, unit: str, draw_unit: str, draws: np.ndarray, is_limit: bool = False
) -> NoiseFigure:
    """Summarise draws in `draw_unit` as a figure in `unit` and in SI units."""
    tail = 0.5 * (1 - CONFIDENCE)
    low, median, high = np.quantile(draws, [tail, 0.5, 1 - tail])
    if is_limit:  # one-sided
        low, high = 0.0, np.nan_to_num(np.quantile(draws, CONFIDENCE), nan=math.inf)
    (si_unit, to_si), scale = _to_si_unit(draw_unit), parse(draw_unit).factor / parse(unit).factor
    values = np.array([median, low, high])
    (value, lower, upper), (*si,) = (scale * values).tolist(), (to_si * values).tolist()
    return NoiseFigure(
        symbol, name, unit, value, lower, upper, si_unit, (si[0], si[1], si[2]), is_limit
    )


def _to_si_unit(unit: str) -> tuple[str, float]:
    """Return the SI unit (of rates, angles, accelerations, velocities; else the unit itself) and the factor to it."""
    suffix = next((e for e in ("/Hz^0.5", "/s^0.5") if unit.endswith(e)), "")
    stem = unit.removesuffix(suffix)
    si_unit = next((si for si in SI_UNITS if same_dimension(stem, si)), stem)
    return si_unit + suffix, float(convert(1.0, stem, si_unit, difference=True))
