"""Residual checks: test residuals for dependence on every covariate, by a log Bayes factor and the worst region.

A covariate's log Bayes factor compares a smooth dependence of the residuals on it, with the columns of
`unknown(covariate)`, with none. It is the score test of a variance component with nuisance parameters integrated out,
averaged over the correlation length and amplitude of the dependence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, Self

import numpy as np
from scipy.special import bdtr, kolmogorov, logsumexp, ndtr

from bayescal._calibration import judgement
from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fit import fit
from bayescal._calibration.fitted import Fitted
from bayescal._calibration.leave_group_out import leave_one_group_out
from bayescal._core.formatting import number, wrap
from bayescal._core.parallel import run_on_one_thread
from bayescal._core.renamed import renamed
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._core.settings import settings
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.linear_model import explained_sum_of_squares
from bayescal._model.unknown_effect import RESOLUTION, make_process_columns, make_process_weights

SIGNIFICANCE_LEVEL = 1e-3  # p-value of the tests without a Bayes factor

Z_NOTE = "log Bayes factor (natural): smooth dependence common to all runs (run: their differences); strong from {:g}"
Z_NOTE += "\nz: worst mean/standard error, if residuals are uncorrelated"


@dataclass(frozen=True)
class Region:
    """A range of a covariate in which the mean residual differs from zero."""

    low: float  # lower end of the range, in `covariate_unit`
    high: float  # upper end
    group: str | None  # run, if the range is of one run; member, if the covariate is a group
    size: float  # mean residual in the range, weighted by the noise model, output unit
    z: float  # mean residual over its standard uncertainty
    covariate_unit: str


@renamed(against="covariate", data="to_json_data")
@dataclass(frozen=True)
class Entry:
    """Log Bayes factor of a dependence of the residuals on a covariate or group, and its worst region."""

    covariate: str  # name of the covariate or group
    log_bayes_factor: float
    worst: Region  # region with the largest |z|
    by_group: bool = False  # a dependence on a group: run, cell, axis or device

    def to_json_data(self, unit: str) -> dict[str, Any]:
        """Return the entry's record in result.json; `unit`: output unit, that of the mean residual."""
        entry, worst = dict(vars(self)), dict(vars(self.worst))
        place = {"from": worst.pop("low"), "to": worst.pop("high"), "unit": unit}
        return {"against": entry.pop("covariate"), **entry, "worst": {**place, **worst}}


@renamed(against="covariates")
@dataclass(frozen=True)
class Pair:
    """Log Bayes factor of a residual interaction of two covariates."""

    covariates: tuple[str, str]  # their names
    log_bayes_factor: float


@dataclass(frozen=True, repr=False)
class Check(Printed):
    """Residual checks of a model.

    Attributes:
        entries: log Bayes factor and worst region of each covariate, in descending order of the factor.
        pairs: log Bayes factor of the interaction of each tested pair of covariates, in descending order.
        unit: output unit.
        rms: root mean square of the residuals, output unit.
        noise: noise standard deviation that the residuals are compared with, output unit.
        autocorrelation: lag-1 autocorrelation within runs in excess of that induced by the fit, and its z.
        scatter_with: p-values of the covariates with which the absolute residuals correlate significantly, by name.
        outliers: row number from 0, and leave-one-out residual in standard deviations, of each outlier.
        pit_p: p-value of the test that the leave-one-out probability integral transforms are uniform.
        excess_kurtosis: excess kurtosis of the leave-one-out residuals; above 0, tails are heavier than normal.
        one_sided: p-value of the sign test on the tenth of the readings with the largest residuals.
        free_noise: noise sd of the same model with its fixed coefficients freed, output unit; None if none is fixed.
        residuals: residual of each reading (n,), output unit.
    """

    entries: tuple[Entry, ...]
    pairs: tuple[Pair, ...]
    unit: str
    rms: float
    noise: float
    autocorrelation: tuple[float, float]
    scatter_with: dict[str, float]
    outliers: tuple[tuple[int, float], ...]
    pit_p: float
    free_noise: float | None
    residuals: np.ndarray = field(repr=False)
    one_sided: float = 1.0
    excess_kurtosis: float = 0.0

    @property
    def contradicts_fixed(self) -> bool:
        """Return whether the rms residual exceeds twice the noise sd of a refit that frees the fixed coefficients."""
        return self.free_noise is not None and self.rms > 2 * self.noise

    def _list_parts(self) -> list[str | ResultTable]:
        return format_check(self)

    def to_json_data(self) -> list[dict[str, Any]]:
        """Return one record per covariate, as in result.json."""
        return [e.to_json_data(self.unit) for e in self.entries]

    def _format_summary(self) -> str:
        unit = unit_label(self.unit)
        text = f"residuals {self.rms:.3g} {unit} rms, noise {self.noise:.3g} {unit}"
        for e in self.entries[:1]:
            text += f"; most against {e.covariate}, log Bayes factor {e.log_bayes_factor:z.1f}"
        return text

    def _list_columns(self) -> dict[str, list[Any]]:
        """Return columns by name, an entry per covariate; means in the output's unit, ranges in the covariate's."""
        return tabulate_check(self.to_json_data()).to_columns()


def tabulate_check(rows: Sequence[Mapping[str, Any]]) -> ResultTable:
    """Tabulate log Bayes factor and worst region of each covariate; `rows`: records as in result.json."""

    def format_number(number_format: str) -> Callable[[float | None], str]:
        return lambda value: "–" if value is None else f"{value:{number_format}}"

    def format_worst_mean(row: Any) -> str:
        return f"{format_number('+.3g')(row['worst']['size'])} {unit_label(row['worst']['unit'])}"

    columns = (
        TableColumn("residuals against", "against"),
        TableColumn("log Bayes factor", "log_bayes_factor", format_number("z.1f")),
        TableColumn("worst mean", format_worst_mean, name=""),
        TableColumn("worst mean", lambda r: r["worst"]["size"], None),
        TableColumn("z", lambda r: r["worst"]["z"], format_number("+.1f")),
        TableColumn("where", describe_region, name=""),
        TableColumn("from", lambda r: r["worst"]["from"], None),
        TableColumn("to", lambda r: r["worst"]["to"], None),
        TableColumn("group", lambda r: r["worst"]["group"] or "", None),
        TableColumn("unit", lambda r: r["worst"]["unit"], None),
    )
    return ResultTable(columns, rows, width=25)


def format_check(check: Check, max_rows: int | None = None) -> list[str | ResultTable]:
    """Format residual checks, the worst covariate first; `max_rows` also omits the tests of the noise model."""
    unit, rows = unit_label(check.unit), check.to_json_data()[:max_rows]
    noise_text = f"judged against this model's own noise, {check.noise:.3g} {unit}"
    lines: list[str | ResultTable] = [f"residuals {check.rms:.3g} {unit} rms, {noise_text}"]
    if check.free_noise is not None:
        r = check.residuals
        lines += [
            f"with the fixed coefficients: {np.sum(r > 0)} of {r.size} residuals are positive, mean {r.mean():.2f} "
            f"({r.min():.2f} to {r.max():.2f}) {unit}, rms {check.rms:.2f}\n"
            f"the same model with free coefficients leaves {check.free_noise:.3g} {unit}: "
            f"the rms is {check.rms / check.noise:.1f} times that",
            "",
        ]
    limit = settings().strong_evidence
    lines += [tabulate_check(rows), Z_NOTE.format(limit)] if rows else ["no covariate varies"]
    if others := [e.covariate for e in check.entries[len(rows) :] if e.log_bayes_factor > limit]:
        lines.append(wrap(f"also strong: {', '.join(others)}"))
    max_log_factor = max(limit, *(e.log_bayes_factor for e in check.entries), -math.inf)
    lines += [
        f"{' and '.join(p.covariates)} together: not additive (log Bayes factor {p.log_bayes_factor:.1f})"
        for p in check.pairs[:2]
        if p.log_bayes_factor > max_log_factor
    ]
    if max_rows is None:
        text = "neighbours in time: correlation {:.2f} (z = {:.1f})"
        lines.append(text.format(*check.autocorrelation))
        test_text = f"p = {check.pit_p:.2g}, leave-one-out probability integral transform"
        lines.append(f"noise law: {test_text}; excess kurtosis {check.excess_kurtosis:.2g}")
    lines += [f"scatter changes with {n} (p = {p:.1g})" for n, p in check.scatter_with.items()]
    if check.outliers:
        outlier_text = ", ".join(f"row {i + 1} ({z:+.1f} sd)" for i, z in check.outliers[:5])
        lines.append(f"outliers, used in the fit: {outlier_text}{' …' * (len(check.outliers) > 5)}")
    if check.one_sided < SIGNIFICANCE_LEVEL:
        lines.append(f"the largest residuals have mostly one sign (p = {check.one_sided:.1g})")
    return lines


def describe_region(row: Mapping[str, Any]) -> str:
    """Describe the worst region of a covariate: "48.7 to 79.74 °C in run 2", "run 2", "rows 3 to 8"."""
    covariate, region = row["against"], row["worst"]
    low, high, group = region["from"], region["to"], region["group"]
    if row["by_group"]:
        return f"{covariate} {group}"
    if covariate == "order":
        return f"row {low:.0f}" if low == high else f"rows {low:.0f} to {high:.0f}"
    unit = unit_label(region["covariate_unit"])
    interval = f"at {number(low, 4)}" if low == high else f"{number(low, 4)} to {number(high, 4)}"
    return f"{interval} {unit}".rstrip() + (f" in run {group}" if group else "")


SAME_COVARIATE_CORRELATION = 0.95  # rank correlation from which two covariates count as the same
# Magnitude of the lag-1 autocorrelation induced by the fit, above which no autocorrelation of the noise is estimated.
MAX_INDUCED_CORRELATION = 0.99
SIGN_TEST_SHARE = 0.1  # share of the readings, those of largest residuals, in the sign test
MAX_PAIRS = 15  # number of tested pairs of covariates
MAX_MEMBERS = 64  # number of members of a group that is tested
ROUNDING_TOLERANCE = 1e-9  # share of a sum of squares, below which it is rounding error
MIN_RUN_REGION_READINGS = 8  # number of readings of a run, for a worst region within that run
MAX_BINS = 12  # number of bins of a covariate
LENGTH_COUNTS = (3, 4)  # number of correlation lengths in the average: not in time, in time
AMPLITUDES = tuple(np.geomspace(0.15, 15.0, 7))  # prior sds in the average, noise sds
INTERACTION_DEGREE = 2  # degree of the polynomial along each covariate of an interaction


@run_on_one_thread
def check(calibration: Calibration) -> Check:
    """Check residuals for misspecification: dependence on covariates, autocorrelation, outliers, non-normality.

    If coefficients are fixed, residuals are compared with the noise of a refit that frees them: misfit inflates noise.
    """
    judged_fit, free_noise = _fit_reference_noise(calibration)
    linear = judged_fit.linear
    residuals, scores = linear.conditional_residuals, linear.scores
    noise, rms = float(np.sqrt(np.mean(linear.variance))), float(np.sqrt(np.mean(residuals**2)))
    covariates = collect_covariates(judged_fit)
    pairs = _list_covariate_pairs(covariates)
    log_factors = compute_log_bayes_factors(judged_fit, covariates, noise)
    interactions = [_build_interaction(a, b) for a, b in pairs]
    pair_factors = compute_log_bayes_factors(judged_fit, interactions, noise)
    rows = zip(covariates, log_factors, strict=True)
    entries = [Entry(c.name, f, _find_worst_region(judged_fit, c), bool(c.levels)) for c, f in rows]
    pair_rows = [Pair((a.name, b.name), f) for (a, b), f in zip(pairs, pair_factors, strict=True)]
    # Leave-one-out residuals over their predictive standard deviations, V⁻¹r over the root of V⁻¹'s diagonal, from the
    # leverages. Under correlated noise: one-step-ahead residuals within a run.
    loo_z = scores
    if judged_fit.model.noise.independent:
        loo_z = scores / np.sqrt(np.maximum(1 - np.sum(linear.directions**2, axis=1), 1e-12))
    # A wrong mean biases size and sign of the residuals: both are tested only without evidence against the mean.
    p_values, sign_test_p = dict[str, float](), 1.0
    if max(log_factors, default=0.0) < settings().strong_evidence:
        p_values = _test_scatter(covariates, scores, calibration.readings["output"] - residuals)
        if count := int(SIGN_TEST_SHARE * len(loo_z)):  # sign test
            positives = int(np.sum(loo_z[np.argsort(-np.abs(loo_z))[:count]] > 0))
            sign_test_p = min(1.0, 2 * float(bdtr(min(positives, count - positives), count, 0.5)))
    outlier_threshold = settings().outlier_sd
    return Check(
        entries=tuple(sorted(entries, key=lambda e: -e.log_bayes_factor)),
        pairs=tuple(sorted(pair_rows, key=lambda p: -p.log_bayes_factor)),
        unit=calibration.unit,
        rms=rms,
        noise=noise,
        autocorrelation=autocorrelation(judged_fit, scores),
        scatter_with=p_values,
        outliers=tuple((i, z) for i, z in enumerate(loo_z.tolist()) if abs(z) > outlier_threshold),
        pit_p=_test_normality(loo_z),
        one_sided=sign_test_p,
        excess_kurtosis=float(np.mean((loo_z - loo_z.mean()) ** 4) / (np.var(loo_z) ** 2 or 1)) - 3,
        free_noise=free_noise,
        residuals=residuals,
    )


def why_not(calibration: Calibration, checks: Check | None = None) -> str:
    """Return why a calibration is not fit for use, or ""; run the checks if needed (`checks`: result of `check`)."""
    verdict = calibration.verdict
    if verdict.checked or not verdict.reliable:
        return verdict.why_not
    cache = vars(calibration)  # cached with the other computed attributes
    if "why_not" not in cache:
        noise_message = judgement.explain_missing_noise(calibration)
        cache["why_not"] = noise_message or " ".join(_list_failures(calibration, checks))
    return cache["why_not"]


def _list_failures(calibration: Calibration, checks: Check | None) -> Sequence[judgement.Claim]:
    if claims := judgement.contradictions(calibration, noise_floor(calibration)):
        return claims
    mode_claims = tuple(judgement.multimodality(calibration))
    results = checks or check(calibration), leave_one_group_out(calibration), mode_claims
    return judgement.failures(judgement.Subject(calibration, (), *results))


def _fit_reference_noise(calibration: Calibration) -> tuple[Calibration, float | None]:
    """Return the fit with the noise of a refit that frees fixed coefficients, and that noise's sd; None: none fixed."""
    # Coefficients fixed by the user at stated values; not those known by definition.
    fixed_names = {b.name for b in calibration.layout.blocks} & {*dict(calibration.model.fixed)}
    if not fixed_names:
        return calibration, None
    method, constants = LeastSquares(draws=400), calibration.reference
    model, readings = calibration.model.free(*fixed_names), calibration.readings
    freed_fit = fit(model, readings, method, reference=constants, strict=False)
    v = np.array(calibration.mode.v)
    for i in calibration.layout.phi_indices("noise"):
        v[i] = freed_fit.mode.v[freed_fit.layout.index_in_phi[calibration.layout.hypers[i].name]]
    judged_fit = replace(calibration, mode=calibration.mode._replace(v=v))
    return judged_fit, float(np.sqrt(np.mean(freed_fit.linear.variance)))


@dataclass(frozen=True)
class Covariate:
    """A covariate and basis columns of a smooth dependence on it."""

    name: str
    values: np.ndarray  # (n,); member codes of a group
    columns: np.ndarray  # (n, k) basis
    weights: tuple[np.ndarray, ...]  # (k,) prior sd of the columns at unit amplitude, per length
    unit: str = ""
    levels: tuple[str, ...] = ()  # names of a group's members

    @classmethod
    def build(cls, name: str, values: np.ndarray, unit: str = "", is_time: bool = False) -> Self:
        """Return a covariate with basis columns of a smooth dependence, at the resolution for time if `is_time`."""
        term_count, length_range = RESOLUTION[is_time]
        position = (values - values.min()) / (np.ptp(values) or 1.0)
        lengths = np.geomspace(*length_range, LENGTH_COUNTS[is_time])
        weights = tuple(make_process_weights(term_count, length) for length in lengths)
        return cls(name, values, make_process_columns(position, term_count), weights, unit)


def collect_covariates(calibration: Calibration) -> list[Covariate]:
    """List the recorded and derived covariates that residuals are tested against."""
    readings, frame, build = calibration.readings, calibration.frame, Covariate.build
    excluded_names = {"output", "output_uncertainty", "temperature_point", *readings.no_causes}
    covariates = []
    for name in readings.columns:
        unit = readings.unit(name)
        if unit is not None and name not in excluded_names and np.ptp(readings[name]) > 0:
            covariates.append(build(name, readings[name], unit, is_time=name == "time"))
    if np.ptp(rate := 60 * np.asarray(frame.rates.get("temperature", 0.0))) > 0:
        covariates.append(build("temperature rate", rate, "degC/min"))
    if len(readings.groups("run")[0]) > 1 and "elapsed" in frame.columns:
        covariates.append(build("elapsed", np.asarray(frame.columns["elapsed"]), "s", True))
    for group in calibration.levels:
        levels, codes = readings.groups(group)
        if 1 < len(levels) <= MAX_MEMBERS:  # an indicator column per member
            columns = (codes[:, None] == np.unique(codes[codes >= 0])).astype(float)
            ones = (np.ones(columns.shape[1]),)
            covariates.append(Covariate(group, codes.astype(float), columns, ones, levels=levels))
    if not readings.has("time"):
        covariates.append(build("order", np.arange(1.0, len(readings) + 1), is_time=True))
    return covariates


def _list_covariate_pairs(covariates: list[Covariate]) -> list[tuple[Covariate, Covariate]]:
    """List up to 15 pairs of numeric covariates whose rank correlation is below 0.95 in magnitude."""
    numeric_covariates = (c for c in covariates if not c.levels and np.ptp(c.values) > 0)
    pairs = combinations([(c, _rank_values(c.values)) for c in numeric_covariates], 2)
    correlations = ((a, b, judgement.correlation(x, y)[0]) for (a, x), (b, y) in pairs)
    return [(a, b) for a, b, r in correlations if abs(r) < SAME_COVARIATE_CORRELATION][:MAX_PAIRS]


def _rank_values(values: np.ndarray) -> np.ndarray:
    """Return ranks from 1; ties get their mean rank."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - 0.5 * (counts - 1))[inverse]


def _test_normality(values: np.ndarray) -> float:
    """Return the Kolmogorov–Smirnov p-value of standard normality (M. Stephens, J. R. Stat. Soc. B 32 (1970) 115)."""
    root_n, probabilities = np.sqrt(len(values)), ndtr(np.sort(values))
    cdf = np.arange(len(values) + 1) / len(values)
    distance = max(np.max(cdf[1:] - probabilities), np.max(probabilities - cdf[:-1]))
    return float(kolmogorov((root_n + 0.12 + 0.11 / root_n) * distance))


def _build_interaction(first: Covariate, second: Covariate) -> Covariate:
    """Build the interaction of two covariates: products of their Legendre polynomials of degrees 1 and 2."""

    def legendre_columns(values: np.ndarray) -> np.ndarray:
        position = 2 * (values - values.min()) / np.ptp(values) - 1
        return np.polynomial.legendre.legvander(position, INTERACTION_DEGREE)[:, 1:]

    first_columns, second_columns = legendre_columns(first.values), legendre_columns(second.values)
    basis = (first_columns[:, :, None] * second_columns[:, None, :]).reshape(len(first_columns), -1)
    rms_norm = np.sqrt(np.mean(np.sum(basis**2, axis=1)))
    weights = (np.full(basis.shape[1], 1 / max(rms_norm, 1e-300)),)
    return Covariate(f"{first.name} × {second.name}", first.values, basis, weights)


def compute_log_bayes_factors(
    calibration: Calibration, covariates: Sequence[Covariate], noise_sd: float
) -> list[float]:
    """Return the log Bayes factor of a dependence of the residuals on each covariate.

    It is averaged over correlation lengths, and over amplitudes in units of the standard deviation `noise_sd`.
    """
    log_factors = list[float]()
    for covariate in covariates:
        score, information = calibration.linear.score(covariate.columns * noise_sd)
        amplitudes = np.concatenate([np.outer(AMPLITUDES, weight) for weight in covariate.weights])
        scaled_information = amplitudes[:, :, None] * information * amplitudes[:, None, :]
        log_det, squares = explained_sum_of_squares(amplitudes * score, scaled_information)
        log_factors.append(float(logsumexp(0.5 * squares - log_det) - np.log(np.size(log_det))))
    return log_factors


def autocorrelation(calibration: Calibration, scores: np.ndarray) -> tuple[float, float]:
    """Return the lag-1 autocorrelation within runs in excess of that induced by the fit, and its z.

    A fit induces autocorrelation: the residuals of n independent readings about a fitted level have −1/(n − 1). With r
    the residuals' lag-1 autocorrelation and ρ its expectation for independent noise under this model, the coefficient
    is the difference on Fisher's scale, tanh(artanh r − artanh ρ), which is within ±1.
    """
    time_order, time_steps = calibration.problem.record.time_order
    pair_starts = np.flatnonzero((time_steps[1:] >= 0) | (not calibration.readings.has("time")))
    sorted_residuals = scores[time_order]
    r0, r1 = sorted_residuals[pair_starts], sorted_residuals[pair_starts + 1]
    norm_product = float(np.linalg.norm(r0) * np.linalg.norm(r1))
    if not norm_product > 0:
        return 0.0, 0.0
    rho, sd = _expect_autocorrelation(calibration.linear.directions[time_order], pair_starts)
    product, mean_square = float(r0 @ r1), 0.5 * float(r0 @ r0 + r1 @ r1)
    if sd == 0 or abs(rho) > MAX_INDUCED_CORRELATION:
        return 0.0, 0.0
    r = product / norm_product
    coefficient = float(np.clip((r - rho) / (1 - r * rho), -1, 1))
    return coefficient, (product / mean_square - rho) / sd


def _expect_autocorrelation(directions: np.ndarray, starts: np.ndarray) -> tuple[float, float]:
    """Return mean and standard deviation of the lag-1 autocorrelation of e ~ N(0, C), C = I − G·Gᵀ.

    G, `directions` (n, q), has orthonormal columns that the fit projects out, rows in time order. Over pairs of
    neighbours Σ eᵢ·eᵢ₊₁ = eᵀBe and Σ ½(eᵢ² + eᵢ₊₁²) = eᵀDe; the ratio of their means is ρ = tr(BC)/tr(DC), and the
    variance of eᵀKe, K = B − ρ·D, is 2·tr(KCKC). `starts` is the row of each pair's first reading.
    """
    weights = 0.5 * np.bincount(np.append(starts, starts + 1), minlength=len(directions))  # D
    mean_square = float(weights @ (1 - np.sum(directions**2, axis=1)))  # tr(DC)
    if mean_square < ROUNDING_TOLERANCE * starts.size:
        return 0.0, 0.0
    expected_correlation = -float(np.sum(directions[starts] * directions[starts + 1])) / mean_square
    kg = -expected_correlation * weights[:, None] * directions
    kg[starts] += 0.5 * directions[starts + 1]
    kg[starts + 1] += 0.5 * directions[starts]
    square_trace = 0.5 * starts.size + expected_correlation**2 * float(weights @ weights)  # tr(KK)
    trace = square_trace - 2 * float(np.sum(kg**2)) + float(np.sum((directions.T @ kg) ** 2))
    if trace < ROUNDING_TOLERANCE * starts.size:
        return expected_correlation, 0.0
    return expected_correlation, float(np.sqrt(2 * trace)) / mean_square


def _test_scatter(
    covariates: list[Covariate], standardised_residuals: np.ndarray, outputs: np.ndarray
) -> dict[str, float]:
    """Return the significant p-values of rank correlation between absolute residuals and covariates, by name."""
    columns = {c.name: c.values for c in covariates if not c.levels}
    # Noise proportional to |output| is not monotonic in any column if the output has both signs.
    columns["the output's distance from its median"] = np.abs(outputs - np.median(outputs))
    residual_ranks, p_values = _rank_values(np.abs(standardised_residuals)), dict[str, float]()
    for name, values in columns.items():
        if np.ptp(values) > 0 and len(values) > 2:
            p_values[name] = judgement.correlation(residual_ranks, _rank_values(values))[1]
    return {name: p for name, p in p_values.items() if p < SIGNIFICANCE_LEVEL}


def noise_floor(calibration: Fitted) -> float:
    """Estimate the noise standard deviation that no smooth effect could explain, output unit.

    It is the rms second difference of the residuals (of neighbours in time within a run; in temperature without a time
    column), scaled to white noise: slow variation cancels, as in a von Neumann ratio.
    """
    residuals, readings = calibration.linear.conditional_residuals, calibration.readings
    if readings.has("time"):
        order, time_steps = calibration.problem.record.time_order
        has_previous = time_steps >= 0
    else:
        key = readings["temperature"] if readings.has("temperature") else np.arange(len(readings))
        order, has_previous = np.argsort(key, kind="stable"), np.ones(len(readings), bool)
        has_previous[0] = False
    r, has_neighbours = residuals[order], has_previous[1:-1] & has_previous[2:]
    differences = (r[1:-1] - 0.5 * (r[:-2] + r[2:]))[has_neighbours]
    if differences.size < 3:
        return float(np.sqrt(np.mean(residuals**2)))
    return float(np.sqrt(np.mean(differences**2) / 1.5))


def _find_worst_region(calibration: Calibration, covariate: Covariate) -> Region:
    """Find the range of bins whose mean residual has the largest |z|, over all runs or in one run.

    Means and standard uncertainties are generalised least squares estimates under the noise model.
    """
    levels, codes = calibration.readings.groups("run")
    region = _find_worst_range(calibration, covariate, np.ones(len(codes), bool), None)
    if covariate.levels:
        return replace(region, group=covariate.levels[int(region.low)])
    for k, level in enumerate(levels if len(levels) > 1 else ()):
        if np.sum(codes == k) >= MIN_RUN_REGION_READINGS:
            run_region = _find_worst_range(calibration, covariate, codes == k, level)
            # A range of one run is preferred only if its |z| exceeds that of the common range by one.
            if abs(run_region.z) - 1 > abs(region.z) - (region.group is not None):
                region = run_region
    return region


def _find_worst_range(
    calibration: Calibration, covariate: Covariate, mask: np.ndarray, run: str | None
) -> Region:
    """Find the range of bins of the masked readings whose mean residual has the largest |z|."""
    values = covariate.values[mask]
    distinct_values, bins = np.unique(values), np.full(len(mask), -1)
    if covariate.levels or len(distinct_values) <= MAX_BINS:
        bins[mask], count = np.searchsorted(distinct_values, values), len(distinct_values)
    else:
        edges = np.quantile(values, np.linspace(0, 1, MAX_BINS + 1)[1:-1])
        bins[mask], count = np.searchsorted(edges, values, side="right"), MAX_BINS
    score, gram = calibration.linear.normal_eqs((bins[:, None] == np.arange(count)).astype(float))
    starts, ends = np.triu_indices(count + 1, 1)
    is_short_enough = ends - starts <= (1 if covariate.levels else max(1, (2 * count) // 3))
    starts, ends = starts[is_short_enough], ends[is_short_enough]
    cumulative_scores = np.append(0.0, np.cumsum(score))
    gram_sums = np.pad(gram.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    sums = cumulative_scores[ends] - cumulative_scores[starts]
    end_sums, start_sums = (gram_sums[ends, i] - gram_sums[starts, i] for i in (ends, starts))
    information = end_sums - start_sums
    is_informed = information > 0
    scores = np.where(is_informed, sums, 0.0) / np.sqrt(np.where(is_informed, information, 1.0))
    worst_index = int(np.argmax(np.abs(scores)))
    z = float(scores[worst_index])
    is_in_region = (bins >= starts[worst_index]) & (bins < ends[worst_index])
    values = covariate.values[is_in_region] if is_in_region.any() else covariate.values
    mean_residual = float(sums[worst_index] / information[worst_index]) if z != 0 else 0.0
    return Region(float(values.min()), float(values.max()), run, mean_residual, z, covariate.unit)
