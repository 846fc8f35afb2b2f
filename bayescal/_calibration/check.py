"""Where the model fails: residuals against every covariate, with evidence and the worst region in physical units."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.special import bdtr, kolmogorov, ndtr, smirnov

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check_result import Check, Entry, FixedComparison, Pair, Region
from bayescal._calibration.covariate_evidence import (
    Covariate,
    log_bayes_factors,
    members,
    smooth,
    together,
)
from bayescal._calibration.fit import fit
from bayescal._calibration.judgement import uncorrelated
from bayescal._calibration.noise_in_time import SIGNIFICANT_P, allan_check
from bayescal._core.parallel import on_one_thread
from bayescal._core.settings import settings
from bayescal._inference.least_squares import LeastSquares

ONE_SIDED_P = 0.12  # p-value of one side, whose fourth power is about that of both sides at once
SAME_COVARIATE_CORRELATION = 0.95  # rank correlation from which two covariates are taken for one
# Expected lag-1 autocorrelation, from which neighbours are what the fit leaves, such as two about a free level, and
# say nothing of the noise.
TIED_CORRELATION = 0.99
FARTHEST_SHARE = 0.1  # share of the readings, those farthest from the model, whose signs are tested

DUOS = 15  # pairs of covariates, at most
MEMBERS = 64  # of a group that is looked at member by member, at most
ROUNDING = 1e-9  # share of a sum, below which it is the rounding of its terms

RUN_REGION_READINGS = 8  # readings that a run needs for a region of its own where a model fails
BINS = 12  # of a covariate


@on_one_thread
def check(calibration: Calibration) -> Check:
    """Where a fitted model fails.

    A model with fixed coefficients is judged against the noise of the same model with free coefficients (and that is
    set beside the noise known before any fit), not against a noise inflated to cover its misfit.
    """
    judged, free_noise = _judged(calibration)
    residual, white = judged.linear.settled, judged.linear.scores
    noise = float(np.sqrt(np.mean(judged.linear.variance)))
    covariates = covariates_of(judged)
    duos = _duos(covariates)
    factors = log_bayes_factors(judged, covariates, noise)
    of_duos = log_bayes_factors(judged, [together(a, b) for a, b in duos], noise)
    regions = worst_regions(judged, covariates)
    entries = [
        Entry(b.name, f, region, bool(b.levels))
        for b, f, region in zip(covariates, factors, regions, strict=True)
    ]
    pairs = [Pair((a.name, b.name), f) for (a, b), f in zip(duos, of_duos, strict=True)]
    loo = _leave_one_out(judged, white)
    # Where the mean is off, so are size and side of the residuals: these are judged only where it is not.
    off, one_sided = max(factors, default=0.0) >= settings().strong_evidence, 1.0
    if (count := int(FARTHEST_SHARE * len(loo))) and not off:  # sign test (binomial, two-sided)
        above = int(np.sum(loo[np.argsort(-np.abs(loo))[:count]] > 0))
        one_sided = min(1.0, 2 * float(bdtr(min(above, count - above), count, 0.5)))
    return Check(
        entries=tuple(sorted(entries, key=lambda e: -e.log_bayes_factor)),
        pairs=tuple(sorted(pairs, key=lambda p: -p.log_bayes_factor)),
        unit=calibration.unit,
        rms=float(np.sqrt(np.mean(residual**2))),
        noise=noise,
        autocorrelation=autocorrelation(judged, white),
        scatter_with={}
        if off
        else _scatter_with(covariates, white, calibration.readings["output"] - residual),
        outliers=tuple(
            (i, z) for i, z in enumerate(loo.tolist()) if abs(z) > settings().outlier_sd
        ),
        pit_p=_uniform(ndtr(loo)),
        one_sided=one_sided,
        fixed=_compare_fixed(calibration, residual, noise, free_noise),
        residuals=residual,
        allan=allan_check(judged),
    )


def _judged(calibration: Calibration) -> tuple[Calibration, float | None]:
    """The calibration with the noise to judge by; and the free fit's noise, if coefficients are fixed."""
    held = calibration.layout.stated
    if not held:
        return calibration, None
    free = fit(
        calibration.model.free(*held),
        calibration.readings,
        LeastSquares(draws=400),
        reference=calibration.reference,
        strict=False,
    )
    noise, v = calibration.layout.positions("noise"), np.array(calibration.mode.v)
    for i in noise:
        v[i] = free.mode.v[free.layout.index_in_phi[calibration.layout.hypers[i].name]]
    mode = calibration.mode._replace(v=v)
    judged = replace(calibration, mode=mode) if noise else calibration
    return judged, float(np.sqrt(np.mean(free.linear.variance)))


def _compare_fixed(
    calibration: Calibration, residual: np.ndarray, noise: float, free: float | None
) -> FixedComparison | None:
    if free is None:
        return None
    return FixedComparison(
        noise=noise,
        free_fit=free,
        known=known_noise(calibration),
        mean=float(residual.mean()),
        low=float(residual.min()),
        high=float(residual.max()),
        rms=float(np.sqrt(np.mean(residual**2))),
        positive=int((residual > 0).sum()),
        count=residual.size,
    )


def known_noise(calibration: Calibration) -> dict[str, float]:
    """Standard deviations known before any fit, output unit, by name: the output's own, and what the uncertainty of
    another column makes of the slope that the output has over it."""
    readings = calibration.readings
    output = readings[readings.output]
    found = {}
    for column in sorted(calibration.model.instrument.columns, key=lambda c: c.name != "output"):
        if not (column.known and readings.has(column.name)):
            continue
        slope, values = 1.0, readings[column.name]
        if column.name != "output":
            slope = float(np.polyfit(values, output, 1)[0]) if np.ptp(values) > 0 else 0.0
        found |= {name: sd * abs(slope) for name, sd in column.known}
    return found


def covariates_of(calibration: Calibration) -> list[Covariate]:
    """Everything recorded or derived that residuals can be laid against."""
    readings, frame = calibration.readings, calibration.frame
    left_out = {"output", "output_uncertainty", "temperature_point", *readings.no_causes}
    found = []
    for name in readings.columns:
        unit = readings.unit(name)
        if unit is not None and name not in left_out and np.ptp(readings[name]) > 0:
            found.append(smooth(name, readings[name], unit, in_time=name == "time"))
    if "temperature" in frame.rates and np.ptp(np.asarray(frame.rates["temperature"])) > 0:
        rate = np.asarray(frame.rates["temperature"]) * 60
        found.append(smooth("temperature rate", rate, "degC/min"))
    if len(readings.groups("run")[0]) > 1 and "elapsed" in frame.columns:
        elapsed = np.asarray(frame.columns["elapsed"])
        found.append(smooth("elapsed", elapsed, "s", in_time=True))
    for group in calibration.levels:
        levels, codes = readings.groups(group)
        if 1 < len(levels) <= MEMBERS:
            found.append(members(group, codes, levels))
    if not readings.has("time"):
        found.append(smooth("order", np.arange(1.0, len(readings) + 1), in_time=True))
    return found


def _duos(covariates: list[Covariate]) -> list[tuple[Covariate, Covariate]]:
    """Pairs of covariates that are not nearly one and the same."""
    varied = [b for b in covariates if not b.levels]
    rank = {b.name: _ranks(b.values) for b in varied}
    return [
        (a, b)
        for a, b in combinations(varied, 2)
        if abs(np.corrcoef(rank[a.name], rank[b.name])[0, 1]) < SAME_COVARIATE_CORRELATION
    ][:DUOS]


def autocorrelation(calibration: Calibration, standardised: np.ndarray) -> tuple[float, float]:
    """Lag-1 autocorrelation of neighbours in time within runs beyond what the fit itself leaves, and its z.

    A fit takes from residuals what it follows: about a fitted level, n independent readings have −1/(n − 1). With
    r that of the residuals and ρ that expected of independent noise under this model, the coefficient is the
    difference on Fisher's scale, tanh(artanh r − artanh ρ), which is within ±1.
    """
    order, step = calibration.problem.record.in_time
    first = np.flatnonzero((step[1:] >= 0) | (not calibration.readings.has("time")))
    ordered = standardised[order]
    before, after = ordered[first], ordered[first + 1]
    size = float(np.linalg.norm(before) * np.linalg.norm(after))
    if not size > 0:
        return 0.0, 0.0
    directions = calibration.linear.directions[order]
    expected, sd = _of_independent_noise(directions, first)
    product, squares = float(before @ after), 0.5 * float(before @ before + after @ after)
    found = product / size
    if sd == 0 or abs(expected) > TIED_CORRELATION:
        return 0.0, 0.0
    coefficient = float(np.clip((found - expected) / (1 - found * expected), -1, 1))
    return coefficient, (product / squares - expected) / sd


def _of_independent_noise(directions: np.ndarray, first: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation of the lag-1 autocorrelation of residuals e ~ N(0, C), C = I − G·Gᵀ.

    The sum over neighbours of eᵢ·eᵢ₊₁ is eᵀBe, that of their squares, halved, eᵀDe. Their means have the ratio
    ρ = tr(BC)/tr(DC), and the variance of eᵀKe, K = B − ρ·D, is 2·tr(KCKC).

    Args:
        directions: G (n, q), in the order of time.
        first: where the first of each two neighbours stands.
    """
    halves = 0.5 * np.bincount(np.append(first, first + 1), minlength=len(directions))  # D
    squares = float(halves @ (1 - np.sum(directions**2, axis=1)))
    if squares < ROUNDING * first.size:
        return 0.0, 0.0
    expected = -float(np.sum(directions[first] * directions[first + 1])) / squares
    kg = -expected * halves[:, None] * directions
    kg[first] += 0.5 * directions[first + 1]
    kg[first + 1] += 0.5 * directions[first]
    own = 0.5 * first.size + expected**2 * float(halves @ halves)  # tr(KK)
    trace = own - 2 * float(np.sum(kg**2)) + float(np.sum((directions.T @ kg) ** 2))
    if trace < ROUNDING * first.size:
        return expected, 0.0
    return expected, float(np.sqrt(2 * trace)) / squares


def _scatter_with(
    covariates: list[Covariate], standardised: np.ndarray, expected: np.ndarray
) -> dict[str, float]:
    """Covariates along which the size of the residuals changes (rank correlation), with p-values."""
    along = {block.name: block.values for block in covariates if not block.levels}
    # Noise in proportion to a signal of both signs grows on both sides, which a ranking along no column shows.
    along["the output's distance from its median"] = np.abs(expected - np.median(expected))
    sizes = _ranks(np.abs(standardised))
    found = {name: uncorrelated(sizes, _ranks(values)) for name, values in along.items()}
    return {name: p for name, p in found.items() if p < SIGNIFICANT_P}


def _leave_one_out(calibration: Calibration, white: np.ndarray) -> np.ndarray:
    """Each reading predicted from the others, in standard deviations of that prediction.

    Under correlated noise: each reading predicted from those before it in its run.
    """
    if not calibration.model.noise.independent:
        return white
    leverage = np.sum(calibration.linear.directions**2, axis=1)
    # V⁻¹r over the root of V⁻¹'s diagonal, both from the leverages.
    return white / np.sqrt(np.maximum(1 - leverage, 1e-12))


def _ranks(values: np.ndarray) -> np.ndarray:
    """1 for the smallest; equal values share the mean of their ranks."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - 0.5 * (count - 1))[place]


def _uniform(values: np.ndarray) -> float:
    """p-value of values drawn uniformly from 0 to 1, two-sided, by Kolmogorov and Smirnov.

    By the exact one-sided one where both sides at once are rare; else the limit of many values at an argument corrected
    for their number (Vrbik, Pioneer J. Theor. Appl. Stat. 15 (2018) 15). Good to three digits from a hundred values on.
    """
    n, ordered = len(values), np.sort(values)
    steps = np.arange(n + 1) / n
    apart = float(max(np.max(steps[1:] - ordered), np.max(ordered - steps[:-1])))
    one_sided = float(smirnov(n, apart))
    if one_sided < ONE_SIDED_P:
        return 2 * (one_sided - one_sided**4)
    root = np.sqrt(n)
    x = root * apart
    return float(kolmogorov(x + 1 / (6 * root) + (x - 1) / (4 * n)))


def worst_regions(calibration: Calibration, covariates: list[Covariate]) -> list[Region]:
    """For each covariate the range of neighbouring bins whose mean residual is worst against its uncertainty.

    Means and uncertainties follow the noise law: under correlated noise a long range counts for less.
    """
    levels, codes = calibration.readings.groups("run")
    every: list[tuple[str | None, np.ndarray]] = [(None, np.ones(len(codes), bool))]
    runs = [(level, codes == k) for k, level in enumerate(levels)] if len(levels) > 1 else []
    runs = [(level, own) for level, own in runs if own.sum() >= RUN_REGION_READINGS]
    found = []
    for covariate in covariates:
        parts = every if covariate.levels else [*every, *runs]
        regions = [_worst(calibration, covariate, own, run) for run, own in parts]
        # One run's own region must be clearly worse than the common one to be named.
        region = max(regions, key=lambda r: abs(r.z) - (r.group is not None))
        group = covariate.levels[int(region.low)] if covariate.levels else region.group
        found.append(replace(region, group=group))
    return found


def _binned(covariate: Covariate, own: np.ndarray) -> tuple[np.ndarray, int]:
    """The bin of each reading, −1 for those that are not its own; and how many bins there are."""
    values = covariate.values[own]
    distinct, bins = np.unique(values), np.full(len(covariate.values), -1)
    if covariate.levels or len(distinct) <= BINS:
        bins[own] = np.searchsorted(distinct, values)
        return bins, len(distinct)
    edges = np.quantile(values, np.linspace(0, 1, BINS + 1)[1:-1])
    bins[own] = np.searchsorted(edges, values, side="right")
    return bins, BINS


def _worst(
    calibration: Calibration, covariate: Covariate, own: np.ndarray, run: str | None
) -> Region:
    """Of all readings, or one run's own."""
    bins, count = _binned(covariate, own)
    pull, weight = calibration.linear.along((bins[:, None] == np.arange(count)).astype(float))
    starts, ends = np.triu_indices(count + 1, 1)
    short = ends - starts <= (1 if covariate.levels else max(1, (2 * count) // 3))
    starts, ends = starts[short], ends[short]
    pulls = np.append(0.0, np.cumsum(pull))
    weights = np.pad(weight.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    total = pulls[ends] - pulls[starts]
    information = (weights[ends, ends] - weights[starts, ends]) - (
        weights[ends, starts] - weights[starts, starts]
    )
    known = information > 0
    scores = np.where(known, total, 0.0) / np.sqrt(np.where(known, information, 1.0))
    at = int(np.argmax(np.abs(scores)))
    z = float(scores[at])
    inside = (bins >= starts[at]) & (bins < ends[at])
    values = covariate.values[inside] if inside.any() else covariate.values
    return Region(
        low=float(values.min()),
        high=float(values.max()),
        group=run,
        size=float(total[at] / information[at]) if z != 0 else 0.0,
        z=z,
        covariate_unit=covariate.unit,
    )
