"""Overlapping Allan deviation of a record whose readings are evenly spaced in time within each run.

IEEE Std 952 (Annex C) and 1139; W. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008). The noise
coefficients N, B and K have the names and units of IEEE Std 952 (gyroscopes) and 1293 (accelerometers).
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
from bayescal._core.result_table import make_table
from bayescal._data.measurements import Measurements
from bayescal._data.records import EVEN_STEPS
from bayescal._data.unit_conversion import parse, unit_label

# Minimum number of readings of the longest run; fewer do not determine a slope of the Allan deviation.
MIN_RUN_READINGS = 30
MIN_PRESENT_SHARE = 0.5  # minimum share of an average's readings that are present
# Largest range of the deviations of time stamps from a grid, in steps; two readings with one stamp exceed 1.
MAX_STAMP_RANGE_STEPS = 1.5
MAX_LOST_SHARE = 0.2  # share of a run's grid points without a reading; drivers lose some per cent


class DataSheetTerms(NamedTuple):
    """Data-sheet names and units of an output's noise coefficients N, B, K, and the unit of quantisation noise Q."""

    names: tuple[str, str, str]
    units: tuple[str, str, str]
    q_unit: str


ACCELEROMETER_TERMS = ("velocity random walk", "bias instability", "acceleration random walk")


def choose_noise_terms(unit: str) -> DataSheetTerms:
    """Return the data-sheet names and units of the noise coefficients N, B and K of an output in `unit`.

    Noise densities refer to the two-sided spectrum, as in IEEE 952, so that N per √Hz equals N·√s; a one-sided spectrum
    gives √2 times this value.
    """
    base, powers = unit or "1", dict(parse(unit or "1").powers)
    if powers == {"rad": 1, "s": -1}:
        names = ("angle random walk", "bias instability", "rate random walk")
        return DataSheetTerms(names, ("deg/h^0.5", "deg/h", "deg/h/h^0.5"), "arcsec")
    if powers == {"ug": 1}:
        return DataSheetTerms(ACCELEROMETER_TERMS, ("ug/Hz^0.5", "ug", "ug/h^0.5"), "ug*s")
    if powers == {"m": 1, "s": -2}:
        return DataSheetTerms(ACCELEROMETER_TERMS, ("m/s/h^0.5", "m/s^2", "m/s^2/h^0.5"), "m/s")
    names = ("white noise", "bias instability", "random walk")
    return DataSheetTerms(names, (f"{base}/Hz^0.5", base, f"{base}/s^0.5"), f"{base}*s")


MIN_RUN_RATIO = 4  # of the longest run to the longest averaging time, as Riley recommends
CONFIDENCE = 0.95  # coverage probability of every interval


class EvenRuns(NamedTuple):
    """Evenly spaced time grids of runs: index of the reading at each grid point (−1 if lost), and the time step, s."""

    rows: tuple[np.ndarray, ...]
    step: float

    def arrange(self, values: Float[np.ndarray, "n"]) -> list[Float[np.ndarray, "k"]]:
        """Return values (n,) of readings at the grid points of each run, NaN for lost readings."""
        return [np.where(rows < 0, np.nan, values[rows]) for rows in self.rows]

    @property
    def lengths(self) -> tuple[int, ...]:
        return tuple(len(r) for r in self.rows)

    @property
    def lost(self) -> float:
        """Return the share of grid points, of all runs, that have no reading."""
        return sum(int(np.sum(r < 0)) for r in self.rows) / sum(self.lengths)

    @property
    def factors(self) -> Float[np.ndarray, "k"]:
        """Return the averaging factors, readings per average (k,): octaves up to a quarter of the longest run."""
        return 2.0 ** np.arange(int(np.log2(max(self.lengths) // MIN_RUN_RATIO)) + 1)


@dataclass(frozen=True)
class AllanDeviation:
    """Allan deviation of a record, in the unit of the output.

    Attributes:
        step: time between readings, s.
        runs: number of combined runs, weighted by their numbers of differences.
        tau: averaging times (k,), s.
        deviation, low, high: Allan deviation (k,), and the limits of its 95 % confidence interval.
        differences: numbers of differences of adjacent averages (k,).
        edf: equivalent degrees of freedom (k,) of the Allan variance, by Greenhall & Riley (2003).
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
        return str(make_table(["τ [s]", "Allan deviation", "95 % interval"], rows, left=0))


def allan_deviation(
    readings: Measurements,
    values: Float[np.ndarray, "n"] | None = None,
    runs: EvenRuns | None = None,
) -> AllanDeviation:
    """Compute the overlapping Allan deviation of the output, or of `values` (n,) in its unit, such as residuals.

    Averaging times are octaves from one step to a quarter of the longest run. Differences of averages do not extend
    over two runs; runs are weighted by their numbers of differences. `runs`: time grids, by default from `even_runs`.

    Raises:
        InputError: no column `time`, no run of 30 readings, time steps that differ by over 5 %, or constant values.
    """
    values = np.asarray(readings["output"] if values is None else values, float)
    runs = even_runs(readings) if runs is None else runs
    variance, differences = allan_variances(values, runs)
    if not np.all(variance > 0):
        raise InputError(
            f"{readings.file}: the Allan deviation is zero: the output is constant over some averaging time"
        )
    edf = compute_edf(runs, classify_noise(variance))
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
    """Return the evenly spaced time grids of a record's runs, with the reading at each grid point.

    Time stamps may be truncated to milliseconds, or shared by readings that arrived together: if none deviates from an
    even grid by a step, the step of this grid is used. Else, longer steps are gaps of lost readings.

    Raises:
        InputError: no column `time`, no run of 30 readings, mostly repeated times, time steps that differ by more than
            5 % from multiples of the median step, or a run of which more than a fifth is lost.
    """
    text = f"Allan deviation of {readings.file} needs"
    if not readings.has("time"):
        raise InputError(f"{text} the column 'time'")
    names, rows = readings.records.names, readings.records.in_time
    if max(len(run_rows) for run_rows in rows) < MIN_RUN_READINGS:
        raise InputError(f"{text} a run of {MIN_RUN_READINGS} readings or more")
    steps = [np.diff(readings["time"][run_rows]) for run_rows in rows]
    median = float(np.median(np.concatenate(steps)))
    if (step := _fit_step(readings["time"], rows, median)) is not None:
        return EvenRuns(tuple(rows), step)
    if not median > 0:
        raise InputError(
            f"{text} distinct times: most equal the preceding one. Record the time with more digits, or give a sample "
            "counter as the column 'time'"
        )
    grids = list[np.ndarray]()
    for name, run_steps, run_rows in zip(names, steps, rows, strict=True):
        step_counts = np.maximum(np.round(run_steps / median), 1.0)
        positions = np.concatenate([[0], np.cumsum(step_counts)]).astype(int)
        expected = step_counts * median
        bad_steps = np.flatnonzero(np.abs(run_steps - expected) > EVEN_STEPS * expected)
        if not len(bad_steps) and len(run_rows) < (1 - MAX_LOST_SHARE) * (positions[-1] + 1):
            bad_steps = np.flatnonzero(step_counts > 1)
        if len(bad_steps):
            run = f" in run {name}" if len(rows) > 1 else ""
            raise InputError(
                f"{text} readings evenly spaced in time: {len(bad_steps)} of {len(run_steps)} steps{run}, such as "
                f"{number(float(run_steps[bad_steps[0]]))} s, differ from the median {number(median)} s. "
                "Give runs without gaps"
            )
        grids.append(np.full(positions[-1] + 1, -1))
        grids[-1][positions] = run_rows
    return EvenRuns(tuple(grids), median)


def _fit_step(time: np.ndarray, rows: Sequence[np.ndarray], median: float) -> float | None:
    """Return the step, s, of the even grid of rounded time stamps; None if they are exact, or readings may be lost.

    A lost reading causes a step of a multiple of the median; rounded time stamps are near their regression line.
    """
    grid_steps = list[float]()
    for run_rows in rows:
        stamps = time[run_rows]
        if len(run_rows) < MIN_RUN_READINGS:
            return None
        steps = np.diff(stamps) / median if median else np.array([0.5])
        step_counts = np.maximum(np.round(steps), 1.0)
        positions = np.arange(len(run_rows))
        grid_step = float(np.polyfit(positions, stamps - stamps[0], 1)[0])
        if (
            np.all(abs(steps - step_counts) <= EVEN_STEPS)
            or np.ptp(stamps - grid_step * positions) > MAX_STAMP_RANGE_STEPS * grid_step
        ):
            return None
        grid_steps.append(grid_step)
    common = float(np.median(grid_steps))
    return common if all(abs(step - common) < EVEN_STEPS * common for step in grid_steps) else None


def allan_variances(
    values: Float[np.ndarray, "n"] | Float[np.ndarray, "n q"], runs: EvenRuns
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Return the Allan variance over all runs (k,), summed over columns of `values`, and the numbers of differences.

    If readings were lost, averages of at least half of their readings are used, and differences are scaled to the
    variance of white noise without losses; a random walk is underestimated by at most the lost share.
    """
    square_sums, count = np.zeros(len(runs.factors)), np.zeros(len(runs.factors))
    for rows in runs.rows:
        columns = values[rows].reshape(len(rows), -1)
        is_present = rows >= 0
        columns = np.where(is_present[:, None], columns - columns[is_present].mean(axis=0), 0.0)
        sums = np.zeros((len(rows) + 1, columns.shape[1] + 1))
        np.cumsum(np.column_stack([columns, is_present]), axis=0, out=sums[1:])
        for k, m in enumerate(runs.factors.astype(int)):
            if len(rows) + 1 - 2 * m > 1:
                window_sums = sums[m:] - sums[:-m]
                present_counts = window_sums[:, -1:]
                later, earlier = present_counts[m:], present_counts[:-m]
                is_valid = (np.minimum(later, earlier) >= MIN_PRESENT_SHARE * m)[:, 0]
                means = window_sums[:, :-1] / np.maximum(present_counts, 1)
                differences = (means[m:] - means[:-m])[is_valid]
                # scaled to the variance that white noise has without lost readings
                differences *= np.sqrt(2 / m / (1 / later[is_valid] + 1 / earlier[is_valid]))
                square_sums[k] += np.einsum("ij,ij->", differences, differences) / 2
                count[k] += len(differences)
    return square_sums / count, count


def classify_noise(variance: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Classify noise (k,) by the slope of the Allan variance at each octave: 0 white, −1 flicker, −2 random walk.

    An Allan variance proportional to τ^μ corresponds to a spectrum proportional to f^(−1 − μ).
    """
    return np.clip(np.round(-1 - np.gradient(np.log2(variance))), -2, 0)


def compute_edf(runs: EvenRuns, noise_classes: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Return the equivalent degrees of freedom (k,) of the mean of the runs, times the share of readings not lost.

    An estimate of v from run i has the variance 2·v²/eᵢ (Greenhall & Riley, 2003), a weighted mean 2·v²·Σ wᵢ²/eᵢ.
    """
    lengths, counts = np.unique(runs.lengths, return_counts=True)
    edfs = []
    for m, noise_type in zip(runs.factors.astype(int), noise_classes.astype(int), strict=True):
        differences = lengths + 1 - 2 * m
        has_variance = differences > 1
        weights = differences[has_variance] / (differences[has_variance] @ counts[has_variance])
        edf = np.array([_run_edf(int(noise_type), int(m), int(n)) for n in lengths[has_variance]])
        edfs.append(1 / (counts[has_variance] @ (weights**2 / edf)))
    return (1 - runs.lost) * np.array(edfs)


# Coefficients a₀, a₁ of `_edf` for more than 100 overlap terms, by noise type: white, flicker and random walk.
ASYMPTOTIC_EDF = {0: (2 / 3, 1 / 3), -1: (0.852, 0.375), -2: (1.079, 0.368)}
MAX_OVERLAP_TERMS = 100  # terms of the sum over overlaps, above which it is approximated


def _run_edf(noise_type: int, m: int, readings: int) -> float:
    """Return the equivalent degrees of freedom of the overlapping Allan variance of a run, m readings per average.

    C. Greenhall & W. Riley, "Uncertainty of stability variances based on finite differences", 35th PTTI meeting
    (2003), equations 7 to 10 and table 2, for second differences whose filter width equals their stride.
    """
    differences = readings + 1 - 2 * m
    terms, ratio = min(differences, 3 * m), differences / m
    if terms > MAX_OVERLAP_TERMS and ratio > 3:
        a0, a1 = ASYMPTOTIC_EDF[noise_type]
        return ratio / (a0 - a1 / ratio)
    stride, filter_width = float(m), m if 3 * m <= MAX_OVERLAP_TERMS else math.inf
    if terms > MAX_OVERLAP_TERMS:
        terms, differences, stride = MAX_OVERLAP_TERMS, MAX_OVERLAP_TERMS, MAX_OVERLAP_TERMS / ratio
    j = np.arange(terms + 1)
    squares = _compute_covariance(j / stride, filter_width, noise_type) ** 2
    weights = np.where(j > 0, 2.0, 1.0) * (1 - j / differences)
    weights[-1] /= 2
    return float(differences * squares[0] / (weights @ squares))


def _compute_covariance(t: np.ndarray, filter_width: float, noise_type: int) -> np.ndarray:
    """Return the autocovariance, up to a factor, of second differences at lags `t`, in averaging times, (j,)."""

    def evaluate(t: np.ndarray) -> np.ndarray:
        power = 3 - noise_type if math.isfinite(filter_width) else 1 - noise_type
        abs_t = np.abs(t)
        return abs_t**power * (np.log(np.where(abs_t > 0, abs_t, 1.0)) if power % 2 == 0 else 1.0)

    def average(t: np.ndarray) -> np.ndarray:
        if not math.isfinite(filter_width):
            return evaluate(t)
        lag = 1 / filter_width
        return 2 * evaluate(t) - evaluate(t - lag) - evaluate(t + lag)

    return sum(c * average(t + k) for k, c in zip(range(-2, 3), (1, -4, 6, -4, 1), strict=True))
