"""Allan deviation of a record: overlapping, over the runs whose readings are evenly spaced in time.

IEEE Std 952 (Annex C) and 1139; W. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import InputError
from bayescal._core.formatting import number, table
from bayescal._data.allan_terms import AllanTerm, Curve, terms_of
from bayescal._data.measurements import Measurements
from bayescal._data.record_settings import recording
from bayescal._data.time_in_runs import run_codes
from bayescal._data.unit_conversion import unit_label

SHARE = 4  # of the longest run that is averaged, at most: Riley's stop ratio of this estimator
CONFIDENCE = 0.95


class EvenRuns(NamedTuple):
    """Rows of each run in the order of time, and the step between them, s."""

    rows: tuple[np.ndarray, ...]
    step: float

    @property
    def lengths(self) -> tuple[int, ...]:
        return tuple(len(r) for r in self.rows)

    @property
    def factors(self) -> Float[np.ndarray, "k"]:
        """How many readings are averaged: octaves up to a quarter of the longest run."""
        return 2.0 ** np.arange(int(np.log2(max(self.lengths) // SHARE)) + 1)


@dataclass(frozen=True)
class AllanDeviation:
    """Allan deviation of a record.

    Attributes:
        unit: of the output.
        step: between readings, s.
        runs: that were combined, weighted by their numbers of differences.
        tau: averaging times (k,), s.
        deviation: (k,), output unit.
        low, high: ends of its 95 % confidence interval (k,), output unit.
        differences: of neighbouring averages (k,).
        edf: equivalent degrees of freedom (k,) of the squared deviation, by Greenhall & Riley (2003).
        terms: N, B and K in the units of data sheets.
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
    terms: tuple[AllanTerm, ...]

    def __str__(self) -> str:
        unit = unit_label(self.unit)
        rows = [
            [number(t), f"{number(d)} {unit}".rstrip(), f"{number(low)} to {number(high)}"]
            for t, d, low, high in zip(self.tau, self.deviation, self.low, self.high, strict=True)
        ]
        curve = table(["τ [s]", "Allan deviation", "95 % interval"], rows, left=0)
        return f"{table(['term', 'value'], [[f'{t.name} {t.symbol}', str(t)] for t in self.terms], fold=25)}\n\n{curve}"


def allan_deviation(
    readings: Measurements, values: Float[np.ndarray, "n"] | None = None
) -> AllanDeviation:
    """Overlapping Allan deviation of the output, or of other values of the same readings, such as residuals.

    Averaging times are octaves from one step to a quarter of the longest run. Each run is taken by itself, and the
    runs are combined by their numbers of differences.

    Args:
        readings: with a column `time`, evenly spaced within each run.
        values: in the place of the output, in its unit (n,).

    Raises:
        InputError: no column `time`, no run of 30 readings, or steps that differ by more than 5 %.
    """
    values = np.asarray(readings["output"] if values is None else values, float)
    return of_runs(readings, values, even_runs(readings))


def of_runs(
    readings: Measurements, values: Float[np.ndarray, "n"], runs: EvenRuns
) -> AllanDeviation:
    """The same, of runs that are known to be even.

    Raises:
        InputError: the values do not change.
    """
    factors, unit = runs.factors, readings.unit("output") or ""
    variance, differences = overlapping(values, runs)
    if not np.all(variance > 0):
        raise InputError(
            f"{readings.file} has no Allan deviation: the output does not change over some averaging time"
        )
    edf = degrees_of_freedom(runs, noise_types(variance))
    low, high = np.array([_interval(v, e) for v, e in zip(variance, edf, strict=True)]).T
    curve = Curve(factors, runs.step, max(runs.lengths), variance, edf)
    return AllanDeviation(
        unit=unit,
        step=runs.step,
        runs=sum(n >= 3 for n in runs.lengths),
        tau=factors * runs.step,
        deviation=np.sqrt(variance),
        low=low,
        high=high,
        differences=differences,
        edf=edf,
        terms=terms_of(curve, unit),
    )


def even_runs(readings: Measurements) -> EvenRuns:
    """The runs of a record, each in the order of time.

    Raises:
        InputError: no column `time`, no run of 30 readings, or steps that differ by more than 5 %.
    """
    need = f"Allan deviation of {readings.file} needs"
    if not readings.has("time"):
        raise InputError(f"{need} the column 'time'")
    levels, codes = run_codes(readings)
    order = np.lexsort((readings["time"], codes))
    rows = np.split(order, 1 + np.flatnonzero(np.diff(codes[order])))
    if max(len(r) for r in rows) < recording().allan_readings:
        raise InputError(f"{need} a run of {recording().allan_readings} readings or more")
    steps = [np.diff(readings["time"][r]) for r in rows]
    usual = float(np.median(np.concatenate(steps)))
    for own, r in zip(steps, rows, strict=True):
        odd = np.flatnonzero(np.abs(own - usual) > recording().even * usual)
        if len(odd):
            run = f" in run {levels[codes[r[0]]]}" if len(rows) > 1 else ""
            raise InputError(
                f"{need} readings evenly spaced in time: {len(odd)} of {len(own)} steps{run}, such as "
                f"{number(float(own[odd[0]]))} s, differ from the usual {number(usual)} s. Give runs without gaps"
            )
    return EvenRuns(tuple(rows), usual)


def overlapping(
    values: Float[np.ndarray, "n"] | Float[np.ndarray, "n q"], runs: EvenRuns
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Allan variances of all runs together, and how many differences each is the mean of; of several columns their sum.

    Args:
        values: of the readings.
        runs: of these.
    """
    squares, count = np.zeros(len(runs.factors)), np.zeros(len(runs.factors))
    for rows in runs.rows:
        own = values[rows].reshape(len(rows), -1)
        sums = np.zeros((len(rows) + 1, own.shape[1]))
        np.cumsum(own - own.mean(axis=0), axis=0, out=sums[1:])
        for k, m in enumerate(runs.factors.astype(int)):
            if (differences := len(rows) + 1 - 2 * m) > 1:
                second = sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m]
                squares[k] += np.einsum("ij,ij->", second, second) / (2 * m**2)
                count[k] += differences
    return squares / count, count


def noise_types(variance: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """The power-law noise nearest to the slope of a curve in octaves: 0 white, −1 flicker, −2 random walk.

    An Allan variance that goes with τ to the power μ is of a spectrum that goes with the frequency to −1 − μ.
    """
    return np.clip(np.round(-1 - np.gradient(np.log2(variance))), -2, 0)


def degrees_of_freedom(runs: EvenRuns, types: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Equivalent degrees of freedom of the runs together, of each run by Greenhall & Riley (2003).

    A mean of estimates of the variance 2·v²/eᵢ with weights wᵢ has the variance 2·v²·Σ wᵢ²/eᵢ.
    """
    lengths, counts = np.unique(runs.lengths, return_counts=True)
    found = []
    for m, kind in zip(runs.factors.astype(int), types.astype(int), strict=True):
        differences = lengths + 1 - 2 * m
        there = differences > 1
        weight = differences[there] / (differences[there] @ counts[there])
        edf = np.array([_edf(int(kind), int(m), int(n)) for n in lengths[there]])
        found.append(1 / (counts[there] @ (weight**2 / edf)))
    return np.array(found)


@lru_cache(maxsize=4096)
def _edf(kind: int, m: int, readings: int) -> float:
    import allantools  # late: it imports all of scipy.stats

    return float(allantools.edf_greenhall(kind, 2, m, readings + 1, overlapping=True))


def _interval(variance: float, edf: float) -> tuple[float, float]:
    import allantools  # late, as above

    low, high = allantools.confidence_interval(np.sqrt(variance), edf, CONFIDENCE)
    return float(low), float(high)
