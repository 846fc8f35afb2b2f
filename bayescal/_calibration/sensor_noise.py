"""The noise of a sensor at rest as data sheets and filters want it: Q, N, B, K with intervals, and the Allan curve."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._calibration.claim import Claim
from bayescal._calibration.noise_at_rest import (
    AVERAGED,
    ROUNDED,
    RestingSum,
    WeighedNoise,
    weigh_noise,
)
from bayescal._core import deadline
from bayescal._core.errors import InputError
from bayescal._core.formatting import number, probability
from bayescal._core.result_table import Printed, ResultTable, plain_table
from bayescal._data.allan_deviation import (
    ALLAN_READINGS,
    CONFIDENCE,
    FULL_SHARE,
    AllanDeviation,
    EvenRuns,
    degrees_of_freedom,
    even_runs,
    habit,
    noise_types,
    of_runs,
)
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import STANDARD_GRAVITY, parse, unit_label
from bayescal._model.noise_law import WHITE
from bayescal._model.noise_terms import FLAT

SHOWN_PROBABILITY = 0.01  # probability from which a noise law is printed
# Quantile of the posterior of N and K that a filter is given: noise taken as too small makes it overconfident.
FILTER_QUANTILE = 0.95
# Share of the law's Allan deviation, that a filter's two terms must reach at every averaging time.
FILTER_REACHES_SHARE = 0.95
# Times the usual change between neighbouring averages at rest, beyond which one is an event and no noise: of thirty
# that are normal, the largest reaches it once in ten thousand records.
EVENT_RATIO = 7.0

NORMAL_MEDIAN = 0.6745  # standard deviations: the median absolute value of a normal number
SHOWN_SUMS = 4  # sums that are printed with their probabilities
# Averaging times at which a record may lie outside the law's 95 % interval: one in 20 does, and neighbours together.
MAX_OUTSIDE = 2


@dataclass(frozen=True)
class NoiseFigure:
    """A number of a noise law with its 95 % credible interval, in the unit of data sheets and in SI units.

    Attributes:
        symbol: of IEEE 952, or what else it is.
        name: as a data sheet says it.
        unit, si_unit: of data sheets; and in base units.
        value, low, high: median and interval, in `unit`.
        si: the same three in `si_unit`.
        bound: whether nothing of it is seen in the record: `high` alone is known, or not even that (infinite).
    """

    symbol: str
    name: str
    unit: str
    value: float
    low: float
    high: float
    si_unit: str
    si: tuple[float, float, float]
    bound: bool = False

    def row(self) -> list[str]:
        """As printed."""
        value, si = f"{number(self.value)}", f"{number(self.si[0])}"
        extent = f"{number(self.low)} to {number(self.high)}"
        if self.bound and not math.isfinite(self.high):
            return [f"{self.name} {self.symbol}", "", "not seen", ""]
        if self.bound:
            value, extent, si = f"< {number(self.high)}", "not seen", f"< {number(self.si[2])}"
        said = f"{value} {unit_label(self.unit)}", extent, f"{si} {unit_label(self.si_unit)}"
        return [f"{self.name} {self.symbol}".strip(), *(s.strip() for s in said)]


@dataclass(frozen=True, repr=False)
class SensorNoise(Printed):
    """Noise of a channel at rest.

    Attributes:
        file: that was read.
        unit: of the output.
        step: between readings, s.
        terms: of the most probable sum beside white noise, as `SummedNoise` names them.
        probabilities: of the sums, by their words, the most probable first.
        figures: Q, N, B, K and what else the law has.
        measured: Allan deviation of the record.
        expected: of the law (k,), the median of its posterior; output unit.
        low, high: 95 % posterior band of that (k,).
        estimate_low, estimate_high: between which 95 % of Allan deviations of such a record lie under the law (k,).
        claims: what was done to the record, and what stands against the law.
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
        """The most probable sum of noise terms, in words."""
        return _words(self.terms)

    @property
    def notes(self) -> tuple[str, ...]:
        """The claims in words."""
        return tuple(map(str, self.claims))

    def _parts(self) -> list[str | ResultTable]:
        rows = [figure.row() for figure in self.figures]
        terms = plain_table(["term", "value", "95 % interval", "SI"], rows, fold=40)
        likely = [(w, p) for w, p in self.probabilities.items() if p >= SHOWN_PROBABILITY][
            :SHOWN_SUMS
        ]
        laws = ", ".join(f"{words} {probability(p)}" for words, p in likely)
        said = [f"Noise law: {laws}.", *(f"Note: {note}" for note in self.notes)]
        unit = unit_label(self.unit)
        m = self.measured
        head = ["τ [s]", "Allan deviation", "noise law", "95 % of such records"]
        columns = (m.tau, m.deviation, self.expected, self.estimate_low, self.estimate_high)
        curve = [
            [number(t), f"{number(d)} {unit}".strip(), number(e), f"{number(a)} to {number(b)}"]
            for t, d, e, a, b in zip(*columns, strict=True)
        ]
        lines = [line for one in said for line in ("", one)]
        return [terms, *lines, "", plain_table(head, curve, left=0)]

    def _brief(self) -> str:
        return f"{self.law}; " + ", ".join(
            f"{f.symbol} = {number(f.value)} {f.unit}" for f in self.figures
        )

    def _columns(self) -> dict[str, list[Any]]:
        names = ("name", "symbol", "value", "low", "high", "unit")
        return {name: [getattr(f, name) for f in self.figures] for name in names}

    def for_filter(self, quantile: float | None = None) -> tuple[float, float]:
        """N and K that a filter of white noise and a random walk is given, output unit times √s and per √s.

        Where noise is correlated both together reach 95 % of the law's Allan deviation at every averaging time up to
        `horizon`, and of those that do they exceed it least: density takes the place of what lasts a few steps, a
        random walk of what lasts longer.

        Args:
            quantile: of the posterior; that of the settings if None.
        """
        quantile = FILTER_QUANTILE if quantile is None else quantile
        n, k = (float(np.quantile(d, quantile)) for d in self.densities)
        return n, k

    def data(self) -> dict[str, Any]:
        """Plain numbers, for JSON."""
        m = self.measured
        names = ("tau", "deviation", "low", "high", "law", "law_low", "law_high")
        columns = (m.tau, m.deviation, m.low, m.high, self.expected, self.low, self.high)
        n, k = self.for_filter()
        return {
            "file": self.file,
            "unit": self.unit,
            "step": self.step,
            "law": self.law,
            "probabilities": dict(self.probabilities),
            "figures": [{**vars(f), "si": list(f.si)} for f in self.figures],
            "curve": [
                dict(zip(names, map(float, row), strict=True)) for row in zip(*columns, strict=True)
            ],
            "for_filter": {
                **{"quantile": FILTER_QUANTILE, "N": n, "K": k},
                "horizon": self.horizon,
            },
            "claims": [claim.data() for claim in self.claims],
        }


def noise(readings: Measurements, *, seed: int = 0, time_limit: float | None = None) -> SensorNoise:
    """Noise density, bias instability and random walk of a sensor at rest, with 95 % intervals.

        print(bc.noise(bc.read("still.csv", still_sensor.INSTRUMENT)))

    Sums of white noise, as it is or averaged by the sensor itself, quantisation noise, a random walk, flicker noise and
    one or two Ornstein–Uhlenbeck processes are weighed by their evidence; levels of runs and a cubic over a column
    `temperature` are taken out beside them.

    Args:
        readings: of one channel, evenly spaced in time within runs.
        seed: of the draws.
        time_limit: seconds, after which the sums fitted so far are what there is, as at Ctrl-C; a note says so.

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
        found = weigh_noise(readings, seed)
    step = even_runs(readings).step
    readings, runs, unit = found.readings, found.runs, readings.unit("output") or ""
    measured = of_runs(readings, np.asarray(readings["output"], float), runs)
    draws = np.concatenate([one.allan_variance(runs.factors, runs.step) for one in found.drawn])
    tail = 0.5 * (1 - CONFIDENCE)
    low, middle, high = np.sqrt(np.quantile(draws, [tail, 0.5, 1 - tail], axis=0))
    edf = degrees_of_freedom(runs, noise_types(np.median(draws, axis=0)))
    random = np.random.default_rng(seed)
    spread = np.sqrt(draws * random.chisquare(edf, draws.shape) / edf)
    estimate_low, estimate_high = np.quantile(spread, [tail, 1 - tail], axis=0)
    outside = (measured.deviation < estimate_low) | (measured.deviation > estimate_high)
    claims = [*found.claims, *_events(readings, runs)]
    if found.count is None:
        claims.insert(0, Claim("noise.no_level", "N", name=habit(unit).names[0]))
    elif found.count > 1:
        claims.insert(0, Claim("noise.means", "N", time=runs.step, count=found.count))
    held = runs.step / (found.count or 1) / step
    if held > 1:
        claims.insert(0, Claim("noise.held", "N", times=held))
    if outside.sum() > MAX_OUTSIDE:
        at = tuple(number(t) for t in measured.tau[outside])
        claims.append(Claim("noise.outside", count=len(at), times=len(outside), taus=at))
    return SensorNoise(
        file=readings.file,
        unit=unit,
        step=step,
        terms=found.drawn[0].terms,
        probabilities={_words(t): p for t, p in found.probabilities.items()},
        figures=_figures(found, unit, draws),
        measured=measured,
        expected=middle,
        low=low,
        high=high,
        estimate_low=estimate_low,
        estimate_high=estimate_high,
        claims=tuple(claims),
        densities=_for_filter(found),
        horizon=float(runs.factors[-1] * runs.step),
    )


def _events(readings: Measurements, runs: EvenRuns) -> tuple[Claim, ...]:
    """The largest change between neighbouring averages, if stationary Gaussian noise has none such."""
    output, times = (runs.of(np.asarray(readings[name], float)) for name in ("output", "time"))
    worst, said = EVENT_RATIO, ()
    for own, time in zip(output, times, strict=True):
        for m in runs.factors.astype(int):
            count = len(own) // m
            if count <= ALLAN_READINGS:
                break
            parts = own[: count * m].reshape(count, m)
            full = np.flatnonzero(np.isfinite(parts).mean(axis=1) >= FULL_SHARE)
            jumps = np.abs(np.diff(np.nanmean(parts[full], axis=1)))
            usual = float(np.median(jumps)) / NORMAL_MEDIAN
            at = int(np.argmax(jumps))
            if jumps[at] > worst * usual > 0:
                worst, when = (
                    float(jumps[at]) / usual,
                    float(time[0] + runs.step * m * full[at + 1]),
                )
                event = {"at": when, "over": runs.step * m, "change": float(jumps[at])}
                unit = readings.unit("output") or ""
                said = (Claim("noise.event", **event, unit=unit, times=worst),)
    return said


def _words(terms: tuple[str, ...]) -> str:
    return RestingSum(1.0, 2.0, terms).in_words


def _for_filter(found: WeighedNoise) -> tuple[np.ndarray, np.ndarray]:
    """Draws of N, and of K; where no correlated noise is seen, the K that a random walk may still have."""
    factors, step = found.runs.factors, found.runs.step
    of_walk = step * (2 * factors**2 + 1) / (6 * factors)
    densities, walks = [], []
    for one in found.drawn:
        own = one.density(step) / step**0.5
        rounded = one.draws.get("noise.quantisation", 0.0) / step
        own = np.sqrt(own**2 + 3 * rounded**2)  # falls more slowly than Q, and is as much at first
        if not {*one.terms} - {ROUNDED, AVERAGED}:
            densities.append(own * step**0.5)
            walks.append(np.resize(found.walk.draws["noise.walk"], len(own)))
            continue
        whole = one.allan_variance(factors, step)
        reached = FILTER_REACHES_SHARE**2 * whole
        # Correlated noise of a few steps is density to a filter, and of many a random walk: of the densities that
        # reach the law at one averaging time, that with whose walk the sum exceeds it least (d, densities, times).
        white = np.maximum(np.column_stack([0 * own, reached * factors]), own[:, None] ** 2)
        lacking = (reached[:, None] - white[..., None] / factors) / of_walk
        walk = np.maximum(
            lacking.max(axis=2), np.square(one.draws.get("noise.walk", 0.0))[..., None]
        )
        both = white[..., None] / factors + walk[..., None] * of_walk
        least = np.argmin(np.log(both / whole[:, None]).sum(axis=2), axis=1)[:, None]
        densities.append(np.sqrt(np.take_along_axis(white, least, 1)[:, 0] * step))
        walks.append(np.sqrt(np.take_along_axis(walk, least, 1)[:, 0]))
    return np.concatenate(densities), np.concatenate(walks)


def _figures(
    found: WeighedNoise, unit: str, curve: Float[np.ndarray, "d k"]
) -> tuple[NoiseFigure, ...]:
    """Each over all probable sums that have it, if it is more probably there than not."""
    names, best, step = habit(unit), found.drawn[0], found.runs.step
    own = unit or "1"
    density, walk = f"{own}/Hz^0.5", f"{own}/s^0.5"

    def over_all(name: str) -> np.ndarray | None:
        having = [one.draws[name] for one in found.drawn if name in one.draws]
        every = sum(len(one.draws[WHITE]) for one in found.drawn)
        return np.concatenate(having) if 2 * sum(map(len, having)) > every else None

    made = []
    if (q := over_all("noise.quantisation")) is not None:
        made.append(_figure("Q", "quantisation noise", names.rounded, f"{own}*s", q))
    white = np.concatenate([one.density(step) for one in found.drawn])
    n = _figure("N", names.names[0], names.units[0], density, white)
    if not found.count:
        unknown = {"value": math.nan, "low": 0.0, "high": math.inf, "si": (math.nan, 0.0, math.inf)}
        n = replace(n, **unknown, bound=True)
    made.append(n)
    if (b := over_all("noise.flicker")) is not None:
        made.append(_figure("B", f"{names.names[1]} (flicker)", names.units[1], own, b))
    lowest = np.argmin(np.median(curve, axis=0))
    if 0 < lowest < curve.shape[1] - 1:
        floor = np.sqrt(np.min(curve, axis=1) / FLAT)
        name = f"{names.names[1]} (lowest Allan deviation over 0.664)"
        made.append(_figure("", name, names.units[1], own, floor))
    k = over_all("noise.walk")
    bound = found.walk.draws["noise.walk"]
    named = ("K", names.names[2], names.units[2], walk)
    made.append(_figure(*named, bound, bound=True) if k is None else _figure(*named, k))
    if (tone := over_all("noise.tone")) is not None:
        made.append(_figure("", "tone, size", names.units[1], own, tone))
        for what, words, of in (
            ("frequency", "frequency", "Hz"),
            ("time", "correlation time", "s"),
        ):
            draws = over_all(f"noise.tone.{what}")
            assert draws is not None
            made.append(_figure("", f"tone, {words}", of, of, draws))
    for place in range(1, 1 + best.terms.count("correlated")):
        derived = {**best.draws, **best.law.derived(best.draws)}
        size, time = (derived[f"noise.correlated{place}.{what}"] for what in ("size", "time"))
        name = f"Ornstein–Uhlenbeck {place}"
        made.append(_figure("", f"{name}, size", names.units[1], own, size))
        made.append(_figure("", f"{name}, correlation time", "s", "s", time))
    return tuple(made)


def _figure(
    symbol: str, name: str, unit: str, own: str, draws: np.ndarray, bound: bool = False
) -> NoiseFigure:
    """Draws in the unit `own` as a figure in another one and in base units."""
    tail = 0.5 * (1 - CONFIDENCE)
    low, middle, high = np.quantile(draws, [tail, 0.5, 1 - tail])
    if bound:  # all of what is left below
        low, high = 0.0, np.quantile(draws, CONFIDENCE)
    factor = parse(own).factor / parse(unit).factor
    base, to_base = _base(own)
    value, lowest, highest = (float(v) * factor for v in (middle, low, high))
    si = (float(middle) * to_base, float(low) * to_base, float(high) * to_base)
    return NoiseFigure(symbol, name, unit, value, lowest, highest, base, si, bound)


def _base(unit: str) -> tuple[str, float]:
    """A unit in base units, in words that people use; and the factor to it."""
    end = next((e for e in ("/Hz^0.5", "/s^0.5") if unit.endswith(e)), "")
    parsed, g = parse(unit.removesuffix(end)), STANDARD_GRAVITY * 1e-6
    known = {  # by powers of base units: in words, and the factor from the base unit
        (("ug", 1),): (f"m/s^2{end}", g),
        (("rad", 1), ("s", -1)): (f"rad/s{end}", 1.0),
        (("rad", 1),): ("rad", 1.0),
        (("s", 1), ("ug", 1)): ("m/s", g),
    }
    powers = tuple(sorted(parsed.powers.items()))
    if powers not in known:
        return unit, 1.0
    words, factor = known[powers]
    return words, parsed.factor * factor
