"""Allan deviation of a record, overlapping, over the runs whose readings are evenly spaced in time.

IEEE Std 952 (Annex C) and 1139; W. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008). Terms of noise
are N, B and K as data sheets give them, with names and units of IEEE Std 952 (gyroscopes) and 1293 (accelerometers).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import gammaincinv

from bayescal._core.errors import InputError
from bayescal._core.formatting import number
from bayescal._core.result_table import plain_table
from bayescal._data.measurements import Measurements
from bayescal._data.records import EVEN_STEPS
from bayescal._data.unit_conversion import parse, unit_label

# Fewest readings of the longest run: below, no slope of an Allan deviation can be told from another.
ALLAN_READINGS = 30
MIN_PRESENT_SHARE = 0.5  # of the readings of an average, that must be present
# Largest range of time stamps about a grid, in its steps; two readings on one stamp are over 1.
MAX_STAMP_RANGE_STEPS = 1.5
MAX_LOST_SHARE = 0.2  # of the places of a run's grid, without a reading: drivers lose some per cent


class Habit(NamedTuple):
    """Names and units on data sheets of the noise terms N, B, K of one kind of output; `rounded` is the unit of Q."""

    names: tuple[str, str, str]
    units: tuple[str, str, str]
    rounded: str


WALKS = ("velocity random walk", "bias instability", "acceleration random walk")


def habit(unit: str) -> Habit:
    """Return names and units of the terms for an output in `unit`.

    Noise densities are of the spectrum on both sides of zero frequency, as in IEEE 952, so that N per √Hz is N·√s;
    a data sheet with a one-sided spectrum prints √2 times as much.
    """
    base, powers = unit or "1", dict(parse(unit or "1").powers)
    if powers == {"rad": 1, "s": -1}:
        names = ("angle random walk", "bias instability", "rate random walk")
        return Habit(names, ("deg/h^0.5", "deg/h", "deg/h/h^0.5"), "arcsec")
    if powers == {"ug": 1}:
        return Habit(WALKS, ("ug/Hz^0.5", "ug", "ug/h^0.5"), "ug*s")
    if powers == {"m": 1, "s": -2}:
        return Habit(WALKS, ("m/s/h^0.5", "m/s^2", "m/s^2/h^0.5"), "m/s")
    names = ("white noise", "bias instability", "random walk")
    return Habit(names, (f"{base}/Hz^0.5", base, f"{base}/s^0.5"), f"{base}*s")


STOP_RATIO = 4  # of the longest run to the longest average: Riley's for this estimator
CONFIDENCE = 0.95  # of its intervals, as of every interval here


class EvenRuns(NamedTuple):
    """Index of the reading at each place of each run's time grid, −1 where it was lost; and the grid's step, s."""

    rows: tuple[np.ndarray, ...]
    step: float

    def of(self, values: Float[np.ndarray, "n"]) -> list[Float[np.ndarray, "k"]]:
        """Return values of the readings of each run in the order of time, NaN where one was lost."""
        return [np.where(rows < 0, np.nan, values[rows]) for rows in self.rows]

    @property
    def lengths(self) -> tuple[int, ...]:
        return tuple(len(r) for r in self.rows)

    @property
    def lost(self) -> float:
        """Return the share of the places without a reading."""
        return sum(int(np.sum(r < 0)) for r in self.rows) / sum(self.lengths)

    @property
    def factors(self) -> Float[np.ndarray, "k"]:
        """Return the numbers of readings averaged (k,): octaves up to a quarter of the longest run."""
        return 2.0 ** np.arange(int(np.log2(max(self.lengths) // STOP_RATIO)) + 1)


@dataclass(frozen=True)
class AllanDeviation:
    """Allan deviation of a record, in the unit of the output.

    Attributes:
        step: between readings, s.
        runs: that were combined, weighted by their numbers of differences.
        tau: averaging times (k,), s.
        deviation, low, high: (k,), and the ends of its 95 % confidence interval.
        differences: of neighbouring averages (k,).
        edf: equivalent degrees of freedom (k,) of the squared deviation, by Greenhall & Riley (2003).
    """

    unit: str
    step: float
    runs: int
    tau: np.ndarray = field(repr=False)
    deviation: np.ndarray = field(repr=False)
    low: np.ndarray = field(repr=False)
    high: np.ndarray = field(repr=False)
    differences: np.ndarray = field(repr=False)
    edf: np.ndarray = field(repr=False)

    def __str__(self) -> str:
        unit = unit_label(self.unit)
        rows = [
            [number(t), f"{number(d)} {unit}".rstrip(), f"{number(low)} to {number(high)}"]
            for t, d, low, high in zip(self.tau, self.deviation, self.low, self.high, strict=True)
        ]
        return str(plain_table(["τ [s]", "Allan deviation", "95 % interval"], rows, left=0))


def allan_deviation(
    readings: Measurements,
    values: Float[np.ndarray, "n"] | None = None,
    runs: EvenRuns | None = None,
) -> AllanDeviation:
    """Compute the overlapping Allan deviation of the output, or of `values` (n,) in its unit, such as residuals.

    Averaging times are octaves from one step to a quarter of the longest run. Each run is taken by itself, and the
    runs are combined by their numbers of differences. `runs` as of `even_runs`, where they are known.

    Raises:
        InputError: no column `time`, no run of 30 readings, steps that differ by more than 5 %, or values that do not
            change.
    """
    values = np.asarray(readings["output"] if values is None else values, float)
    runs = even_runs(readings) if runs is None else runs
    variance, differences = overlapping(values, runs)
    if not np.all(variance > 0):
        raise InputError(
            f"{readings.file} has no Allan deviation: the output does not change over some averaging time"
        )
    edf = degrees_of_freedom(runs, noise_types(variance))
    tail = 0.5 * (1 - CONFIDENCE)
    low, high = (np.sqrt(variance * edf / (2 * gammaincinv(edf / 2, p))) for p in (1 - tail, tail))
    return AllanDeviation(
        unit=readings.unit("output") or "",
        step=runs.step,
        runs=sum(n >= 3 for n in runs.lengths),
        tau=runs.factors * runs.step,
        deviation=np.sqrt(variance),
        low=low,
        high=high,
        differences=differences,
        edf=edf,
    )


def even_runs(readings: Measurements) -> EvenRuns:
    """Place the readings of each run of a record on a grid even in time.

    Stamps that were cut to whole milliseconds, or are shared by readings that arrived together, are those of an even
    grid, where no reading is a step off it: the grid's step is taken. A step that is several usual ones has lost the
    readings between.

    Raises:
        InputError: no column `time`, no run of 30 readings, times most of which equal the one before, steps that differ
            by more than 5 % from whole numbers of the usual one, or more than a fifth of a run lost.
    """
    need = f"Allan deviation of {readings.file} needs"
    if not readings.has("time"):
        raise InputError(f"{need} the column 'time'")
    names, rows = readings.records.names, readings.records.in_time
    if max(len(r) for r in rows) < ALLAN_READINGS:
        raise InputError(f"{need} a run of {ALLAN_READINGS} readings or more")
    steps = [np.diff(readings["time"][r]) for r in rows]
    usual = float(np.median(np.concatenate(steps)))
    if (grid := _grid(readings["time"], rows, usual)) is not None:
        return EvenRuns(tuple(rows), grid)
    if not usual > 0:
        raise InputError(
            f"{need} readings in time: most have the time of the one before. Record the time with more digits, or give "
            "a column that counts"
        )
    placed = list[np.ndarray]()
    for name, run_steps, r in zip(names, steps, rows, strict=True):
        multiples = np.maximum(np.round(run_steps / usual), 1.0)
        places = np.concatenate([[0], np.cumsum(multiples)]).astype(int)
        odd = np.flatnonzero(np.abs(run_steps - multiples * usual) > EVEN_STEPS * multiples * usual)
        if not len(odd) and len(r) < (1 - MAX_LOST_SHARE) * (places[-1] + 1):
            odd = np.flatnonzero(multiples > 1)
        if len(odd):
            run = f" in run {name}" if len(rows) > 1 else ""
            raise InputError(
                f"{need} readings evenly spaced in time: {len(odd)} of {len(run_steps)} steps{run}, such as "
                f"{number(float(run_steps[odd[0]]))} s, differ from the usual {number(usual)} s. Give runs without gaps"
            )
        placed.append(np.full(places[-1] + 1, -1))
        placed[-1][places] = r
    return EvenRuns(tuple(placed), usual)


def _grid(time: np.ndarray, rows: Sequence[np.ndarray], usual: float) -> float | None:
    """Return the step, s, of the grid that the stamps of all runs are cut from; None where readings may have been lost.

    A lost reading leaves a multiple of the usual step; stamps that were cut stay near the line through all.
    """
    grid_steps = list[float]()
    for r in rows:
        stamps = time[r]
        if len(r) < ALLAN_READINGS:
            return None
        steps = np.diff(stamps) / usual if usual else np.array([0.5])
        whole = np.maximum(np.round(steps), 1.0)
        places = np.arange(len(r))
        grid = float(np.polyfit(places, stamps - stamps[0], 1)[0])
        if (
            np.all(abs(steps - whole) <= EVEN_STEPS)
            or np.ptp(stamps - grid * places) > MAX_STAMP_RANGE_STEPS * grid
        ):
            return None
        grid_steps.append(grid)
    grid = float(np.median(grid_steps))
    return grid if all(abs(step - grid) < EVEN_STEPS * grid for step in grid_steps) else None


def overlapping(
    values: Float[np.ndarray, "n"] | Float[np.ndarray, "n q"], runs: EvenRuns
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Return Allan variances of all runs together (of several columns their sum), and their numbers of differences.

    Where readings were lost, averages are of those that are there, half of their number at least, and their differences
    are taken down to what white noise of all would have: a random walk comes out lower, by the lost share at most.
    """
    squares, count = np.zeros(len(runs.factors)), np.zeros(len(runs.factors))
    for rows in runs.rows:
        columns = values[rows].reshape(len(rows), -1)
        present = rows >= 0
        columns = np.where(present[:, None], columns - columns[present].mean(axis=0), 0.0)
        sums = np.zeros((len(rows) + 1, columns.shape[1] + 1))
        np.cumsum(np.column_stack([columns, present]), axis=0, out=sums[1:])
        for k, m in enumerate(runs.factors.astype(int)):
            if len(rows) + 1 - 2 * m > 1:
                parts = sums[m:] - sums[:-m]
                present_counts = parts[:, -1:]
                later, sooner = present_counts[m:], present_counts[:-m]
                full = (np.minimum(later, sooner) >= MIN_PRESENT_SHARE * m)[:, 0]
                means = parts[:, :-1] / np.maximum(present_counts, 1)
                second = (means[m:] - means[:-m])[full]
                # Of white noise, means of fewer readings scatter by as much more.
                second *= np.sqrt(2 / m / (1 / later[full] + 1 / sooner[full]))
                squares[k] += np.einsum("ij,ij->", second, second) / 2
                count[k] += len(second)
    return squares / count, count


def noise_types(variance: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Return the power-law noise nearest to the slope of a curve in octaves (k,): 0 white, −1 flicker, −2 random walk.

    An Allan variance that goes with τ to the power μ is of a spectrum that goes with the frequency to −1 − μ.
    """
    return np.clip(np.round(-1 - np.gradient(np.log2(variance))), -2, 0)


def degrees_of_freedom(runs: EvenRuns, types: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Return equivalent degrees of freedom of the runs together, by Greenhall & Riley (2003); less the share lost.

    A mean of estimates of the variance 2·v²/eᵢ with weights wᵢ has the variance 2·v²·Σ wᵢ²/eᵢ.
    """
    lengths, counts = np.unique(runs.lengths, return_counts=True)
    edfs = []
    for m, kind in zip(runs.factors.astype(int), types.astype(int), strict=True):
        differences = lengths + 1 - 2 * m
        usable = differences > 1
        weight = differences[usable] / (differences[usable] @ counts[usable])
        edf = np.array([_edf(int(kind), int(m), int(n)) for n in lengths[usable]])
        edfs.append(1 / (counts[usable] @ (weight**2 / edf)))
    return (1 - runs.lost) * np.array(edfs)


# a₀ and a₁ of `_edf` where averages overlap in more than 100 terms: white, flicker and random-walk noise.
ASYMPTOTIC_EDF = {0: (2 / 3, 1 / 3), -1: (0.852, 0.375), -2: (1.079, 0.368)}
MAX_OVERLAP_TERMS = 100  # of a sum over the overlaps, above which it is approximated


def _edf(kind: int, m: int, readings: int) -> float:
    """Return equivalent degrees of freedom of the overlapping Allan variance of a run, averages of m readings each.

    C. Greenhall & W. Riley, "Uncertainty of stability variances based on finite differences", 35th PTTI meeting
    (2003), equations 7 to 10 and table 2, for second differences of a filter as wide as their stride.
    """
    differences = readings + 1 - 2 * m
    terms, ratio = min(differences, 3 * m), differences / m
    if terms > MAX_OVERLAP_TERMS and ratio > 3:
        a0, a1 = ASYMPTOTIC_EDF[kind]
        return ratio / (a0 - a1 / ratio)
    stride, width = float(m), m if 3 * m <= MAX_OVERLAP_TERMS else math.inf
    if terms > MAX_OVERLAP_TERMS:
        terms, differences, stride = MAX_OVERLAP_TERMS, MAX_OVERLAP_TERMS, MAX_OVERLAP_TERMS / ratio
    j = np.arange(terms + 1)
    squares = _covariance(j / stride, width, kind) ** 2
    weights = np.where(j > 0, 2.0, 1.0) * (1 - j / differences)
    weights[-1] /= 2
    return float(differences * squares[0] / (weights @ squares))


def _covariance(t: Float[np.ndarray, "j"], width: float, kind: int) -> Float[np.ndarray, "j"]:
    """Return the autocovariance, up to a factor, of second differences at lags `t` (averaging times of `width`)."""

    def generalised(t: np.ndarray) -> np.ndarray:
        power = 3 - kind if math.isfinite(width) else 1 - kind
        size = np.abs(t)
        return size**power * (np.log(np.where(size > 0, size, 1.0)) if power % 2 == 0 else 1.0)

    def averaged(t: np.ndarray) -> np.ndarray:
        if not math.isfinite(width):
            return generalised(t)
        return 2 * generalised(t) - generalised(t - 1 / width) - generalised(t + 1 / width)

    return sum(c * averaged(t + k) for k, c in zip(range(-2, 3), (1, -4, 6, -4, 1), strict=True))
