"""Residuals as noise in time: the floor that neighbours set, and the Allan deviation beside that of the noise law."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import chdtr, chdtrc, chdtri

from bayescal._calibration.fitted import Fitted
from bayescal._core.errors import InputError
from bayescal._core.formatting import number
from bayescal._core.result_table import ResultTable, plain_table
from bayescal._data.allan_deviation import (
    CONFIDENCE,
    AllanDeviation,
    AllanTerm,
    degrees_of_freedom,
    even_runs,
    noise_types,
    of_runs,
    overlapping,
    term,
)
from bayescal._data.unit_conversion import unit_label
from bayescal._model.noise_law import WHITE, Noise

SIGNIFICANT_P = 1e-3  # p-value of the tests without a Bayes factor

DRAWS = 100  # of a correlated law's parameters
RANKS = 50  # of a χ², equally probable, that stand for it


@dataclass(frozen=True)
class AllanCheck:
    """The Allan deviation of residuals beside that which the fitted noise law lets one expect of them."""

    measured: AllanDeviation  # of the residuals
    law: str  # name of the noise law
    expected: np.ndarray = field(repr=False)  # under it, of the residuals of such a fit (k,)
    low: np.ndarray = field(repr=False)  # between which it puts 95 % of such estimates (k,)
    high: np.ndarray = field(repr=False)
    law_terms: tuple[AllanTerm, ...]  # N, and K where the noise is correlated, as the law has them
    apart: int | None  # averaging time at which the two differ the most; None where they agree

    def __str__(self) -> str:
        return f"{self.table()}\n{self.sentence()}"

    def table(self) -> ResultTable:
        """The terms of the noise law in the units of data sheets."""
        rows = [[f"{t.name} {t.symbol}", str(t)] for t in self.law_terms]
        return plain_table([f"noise law ({self.law_name})", "value"], rows)

    @property
    def law_name(self) -> str:
        """As a person reads it."""
        named = (law for law in Noise.known.values() if law.law == self.law)
        return next((law.words for law in named if law.words), self.law)

    def sentence(self) -> str:
        """Where the two differ the most, or over which times they agree."""
        m, unit, k = self.measured, unit_label(self.measured.unit), self.apart
        if k is None:
            times = f"{number(m.tau[0])} to {number(m.tau[-1])} s"
            return f"Allan deviation and noise law ({self.law_name}) agree from {times}"
        more = "more" if m.deviation[k] > self.expected[k] else "less"
        return (
            f"at {number(m.tau[k])} s the Allan deviation is {number(m.deviation[k])} {unit}, the noise law "
            f"({self.law_name}) says {number(self.low[k])} to {number(self.high[k])} {unit} (95 %): the residuals "
            f"change {more} over this time than such noise would"
        )

    def data(self) -> dict[str, Any]:
        """As in result.json."""
        return {
            "unit": self.measured.unit,
            "runs": self.measured.runs,
            "curve": allan_rows(self.measured, self.expected, self.low, self.high),
            "terms": [vars(t) for t in self.law_terms],
            "agrees": self.apart is None,
            "in_words": self.sentence(),
        }


def allan_rows(
    measured: AllanDeviation, law: np.ndarray, low: np.ndarray, high: np.ndarray
) -> list[dict[str, float]]:
    """An Allan deviation beside that of a noise law, time by time, as in JSON."""
    m, names = measured, ("tau", "deviation", "low", "high", "law", "law_low", "law_high")
    rows = zip(m.tau, m.deviation, m.low, m.high, law, low, high, strict=True)
    return [dict(zip(names, map(float, row), strict=True)) for row in rows]


def allan_check(calibration: Fitted) -> AllanCheck | None:
    """The Allan deviation of a fit's residuals; None where readings are not evenly spaced in time, or too few."""
    linear, readings, noise = calibration.linear, calibration.readings, calibration.model.noise
    try:
        runs = even_runs(readings)
        measured = of_runs(readings, linear.settled, runs)
    except InputError:
        return None
    mode = calibration.problem.hyper(calibration.mode.v)
    variance = float(np.mean(linear.variance))
    law = noise.allan_variance(mode, variance, runs.factors, runs.step)
    taken, _ = overlapping(linear.taken, runs)
    left = np.maximum(1 - taken / law, 0.0)  # what a fit has absorbed is not in its residuals
    draws = _drawn(calibration, mode, variance, runs.factors, runs.step) * left
    edf = degrees_of_freedom(runs, noise_types(law))
    ranks = (np.arange(RANKS) + 0.5) / RANKS
    estimates = draws[:, None] * (chdtri(edf, ranks[:, None]) / edf)
    tail = 0.5 * (1 - CONFIDENCE)
    low, high = np.sqrt(np.quantile(estimates, [tail, 1 - tail], axis=(0, 1)))
    terms = _law_terms(calibration, mode, variance, runs.step)
    apart = _apart(measured, draws, edf) if noise.gaussian else None
    return AllanCheck(measured, noise.law, np.sqrt(law * left), low, high, terms, apart)


def _drawn(
    calibration: Fitted, mode: dict[str, Any], variance: float, factors: np.ndarray, step: float
) -> Float[np.ndarray, "d k"]:
    """Allan variances under the law's parameters drawn from the posterior, or at the mode.

    White noise is known better than any of its averages, and stays at the mode. So does a law that was taken over from
    the same model with free coefficients.
    """
    law = calibration.model.noise
    names = set(law.parameters())
    varying = names & calibration.unknowns.by_key.keys()
    if law.independent or not varying or calibration.layout.stated:
        return law.allan_variance(mode, variance, factors, step)[None]
    every = -(-len(calibration.samples(min(varying))) // DRAWS)
    values = {n: np.asarray(mode[n]) for n in names}
    values |= {n: calibration.samples(n)[::every] for n in varying}
    known = max(variance - float(mode[WHITE]) ** 2 - float(law.slow_variance(mode)), 0.0)
    total = values[WHITE] ** 2 + np.asarray(law.slow_variance(values)) + known
    return law.allan_variance(values, total, factors, step)


def _apart(
    measured: AllanDeviation, draws: Float[np.ndarray, "d k"], edf: Float[np.ndarray, "k"]
) -> int | None:
    """Where the measured curve is the rarest under the law, if it is rare among all averaging times (Bonferroni)."""
    with np.errstate(divide="ignore"):
        ratio = edf * measured.deviation**2 / draws
    sides = np.stack([chdtr(edf, ratio).mean(axis=0), chdtrc(edf, ratio).mean(axis=0)])
    rare = 2 * sides.min(axis=0) * len(edf) < SIGNIFICANT_P
    # Of several that are all but impossible, the one that is the most standard deviations off.
    off = np.abs(np.log(np.median(ratio, axis=0) / edf)) * np.sqrt(edf / 2)
    return int(np.argmax(np.where(rare, off, -1.0))) if rare.any() else None


def _law_terms(
    calibration: Fitted, mode: dict[str, Any], variance: float, step: float
) -> tuple[AllanTerm, ...]:
    """N = √(σ²·Δ) of the white part, and K = q of correlated noise, with the posterior's standard deviations."""
    law, unit = calibration.model.noise, calibration.unit
    names = {WHITE, *law.coefficients_in_time} & calibration.unknowns.by_key.keys()
    error = {name: float(calibration.samples(name).std()) for name in names}
    size = float(np.sqrt(max(variance - float(law.slow_variance(mode)), 0.0)))
    # Of σ² = σ₀² + what is known, only σ₀ is uncertain.
    own = float(mode[WHITE]) / size * error.get(WHITE, 0.0) if size > 0 and WHITE in mode else 0.0
    slow = law.coefficients_in_time.items()
    return (
        term("N", unit, size * step**0.5, own * step**0.5),
        *(term(symbol, unit, float(mode[n]), error.get(n, 0.0)) for n, symbol in slow),
    )


def noise_floor(calibration: Fitted) -> float:
    """Noise that no model of smooth effects could remove, output unit.

    From each residual against the mean of its two neighbours (in time within a run; in temperature where there
    is no time), as in a von Neumann ratio: what varies slowly cancels.
    """
    residual = calibration.linear.settled
    readings = calibration.readings
    if readings.has("time"):
        order, step = calibration.problem.record.in_time
        linked = step >= 0
    else:
        key = readings["temperature"] if readings.has("temperature") else np.arange(len(readings))
        order, linked = np.argsort(key, kind="stable"), np.ones(len(readings), bool)
        linked[0] = False
    r = residual[order]
    inner = linked[1:-1] & linked[2:]
    bend = (r[1:-1] - 0.5 * (r[:-2] + r[2:]))[inner]
    if bend.size < 3:
        return float(np.sqrt(np.mean(residual**2)))
    return float(np.sqrt(np.mean(bend**2) / 1.5))
