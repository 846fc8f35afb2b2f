"""Residual checks: residuals against every covariate, with a log Bayes factor and the worst region in physical units.

A covariate's log Bayes factor says whether the residuals hold structure against it: the score test of a variance
component, in the metric in which all nuisances are marginalised, averaged over the length and amplitude of an unknown
dependence by the columns of `unknown(covariate)`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.special import bdtr, kolmogorov, logsumexp, ndtr

from bayescal._calibration import judgement
from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fit import fit
from bayescal._calibration.fitted import Fitted
from bayescal._calibration.leave_group_out import leave_one_group_out
from bayescal._core.formatting import folded, number
from bayescal._core.parallel import on_one_thread
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._core.settings import settings
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.linear_model import explained_sum_of_squares
from bayescal._model.unknown_effect import RESOLUTION, process_columns, process_weights

SIGNIFICANT_P = 1e-3  # p-value of the tests without a Bayes factor


@dataclass(frozen=True)
class Region:
    """A part of a covariate where the residuals are systematically positive or negative."""

    low: float  # of the covariate, in `covariate_unit`
    high: float
    group: str | None  # the run, of one run alone; the member, where the covariate is a group
    size: float  # mean residual there (weighted by the noise law), output unit
    z: float  # size over its standard uncertainty
    covariate_unit: str


@dataclass(frozen=True)
class Entry:
    """Log Bayes factor of one covariate, or group of readings (`by_group`): run, cell, axis, device."""

    against: str
    log_bayes_factor: float
    worst: Region
    by_group: bool = False

    def data(self, unit: str) -> dict[str, Any]:
        """Return the record in result.json; sizes in the output's unit, places in the covariate's."""
        worst = dict(vars(self.worst))
        place = {"from": worst.pop("low"), "to": worst.pop("high"), "unit": unit}
        return {**vars(self), "worst": {**place, **worst}}


@dataclass(frozen=True)
class Pair:
    """Two covariates: log Bayes factor of an interaction not explained by additive terms."""

    against: tuple[str, str]
    log_bayes_factor: float


@dataclass(frozen=True)
class FixedComparison:
    """Reference noise for the residuals of a model with fixed coefficients, output unit."""

    noise: float  # standard deviation used as the measure
    rms: float  # of the residuals
    free_fit: float  # noise of the same model with free coefficients

    @property
    def wrong(self) -> bool:
        """Return whether the rms is more than twice the noise of the same model with free coefficients."""
        return self.rms > 2 * self.noise


@dataclass(frozen=True, repr=False)
class Check(Printed):
    """Residual checks of a model.

    Attributes:
        entries: one per covariate, the strongest evidence first.
        pairs: of covariates, likewise.
        unit: of the output.
        rms: of the residuals, output unit.
        noise: standard deviation of the noise that they are compared with.
        autocorrelation: (lag-1 coefficient within runs beyond what the fit itself leaves, its z).
        scatter_with: covariates with which the scatter changes, and the p-value of each.
        outliers: (row, leave-one-out standard deviations).
        pit_p: p-value of uniform leave-one-out probability integral transforms.
        one_sided: p-value of the sign test on the readings farthest from the model.
        fixed: only for models with fixed coefficients.
        residuals: (n,), output unit.
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
    fixed: FixedComparison | None
    residuals: np.ndarray = field(repr=False)
    one_sided: float = 1.0

    def _parts(self) -> list[str | ResultTable]:
        return check_parts(self)

    def data(self) -> list[dict[str, Any]]:
        """Return one record per covariate, as in result.json."""
        return [e.data(self.unit) for e in self.entries]

    def _brief(self) -> str:
        unit = unit_label(self.unit)
        text = f"residuals {self.rms:.3g} {unit} rms, noise {self.noise:.3g} {unit}"
        for entry in self.entries[:1]:
            factor = f"log Bayes factor {entry.log_bayes_factor:z.1f}"
            text += f"; most against {entry.against}, {factor}"
        return text

    def _columns(self) -> dict[str, list[Any]]:
        """Return one row per covariate or group; sizes in the output's unit, places in the covariate's."""
        return check_table(self.data()).data()


def check_table(rows: Sequence[Mapping[str, Any]]) -> ResultTable:
    """Tabulate residuals against each covariate, from the rows of result.json."""

    def signed(places: str) -> Callable[[float | None], str]:
        return lambda value: "–" if value is None else f"{value:{places}}"

    def worst_mean(row: Any) -> str:
        return f"{signed('+.3g')(row['worst']['size'])} {unit_label(row['worst']['unit'])}"

    columns = (
        TableColumn("residuals against", "against"),
        TableColumn("log Bayes factor", "log_bayes_factor", signed("z.1f")),
        TableColumn("worst mean", worst_mean, name=""),
        TableColumn("worst mean", lambda r: r["worst"]["size"], None),
        TableColumn("z", lambda r: r["worst"]["z"], signed("+.1f")),
        TableColumn("where", place_in_words, name=""),
        TableColumn("from", lambda r: r["worst"]["from"], None),
        TableColumn("to", lambda r: r["worst"]["to"], None),
        TableColumn("group", lambda r: r["worst"]["group"] or "", None),
        TableColumn("unit", lambda r: r["worst"]["unit"], None),
    )
    return ResultTable(columns, rows, fold=25)


def check_parts(check: Check, most: int | None = None) -> list[str | ResultTable]:
    """List a model's residual checks, the worst covariate first; without autocorrelation and PIT if cut to `most`."""
    unit, rows = unit_label(check.unit), check.data()[:most]
    noise = f"judged against noise of {check.noise:.3g} {unit}"
    lines: list[str | ResultTable] = [f"residuals {check.rms:.3g} {unit} rms, {noise}"]
    if check.fixed:
        lines += [_fixed_text(check.fixed, check.residuals, unit), ""]
    lines.append(check_table(rows) if rows else "no covariate varies")
    strong = settings().strong_evidence
    depends = ", ".join(e.against for e in check.entries if e.log_bayes_factor > strong)
    lines.append(folded(f"log Bayes factor above {strong:g}: {depends or 'none'}"))
    strongest = max(strong, *(e.log_bayes_factor for e in check.entries), -math.inf)
    lines += [
        f"{' and '.join(p.against)} together: interaction not explained by additive terms (log Bayes factor "
        f"{p.log_bayes_factor:.1f})"
        for p in check.pairs[:2]
        if p.log_bayes_factor > strongest
    ]
    if most is None:
        coefficient, z = check.autocorrelation
        lines.append(f"neighbours in time: correlation {coefficient:.2f} (z = {z:.1f})")
    lines += [
        f"scatter changes with {name} (p = {p:.1g})" for name, p in check.scatter_with.items()
    ]
    if check.outliers:
        listed = ", ".join(f"row {i + 1} ({z:+.1f} sd)" for i, z in check.outliers[:5])
        lines.append(f"outliers: {listed}{' …' if len(check.outliers) > 5 else ''}")
    if most is None:
        lines.append(f"leave-one-out probabilities: test of uniformity p = {check.pit_p:.2g}")
    if check.one_sided < SIGNIFICANT_P:
        lines.append(f"readings far from the model stand on one side (p = {check.one_sided:.1g})")
    return lines


def place_in_words(row: Mapping[str, Any]) -> str:
    """Describe the worst region of a covariate: "48.7 to 79.74 °C in run 2", "run 2", "rows 3 to 8"."""
    against, region = row["against"], row["worst"]
    low, high, group = region["from"], region["to"], region["group"]
    if row.get("by_group", against == "run"):  # which results of before 0.4 do not say
        return f"{against} {group}"
    if against == "order":
        return f"row {low:.0f}" if low == high else f"rows {low:.0f} to {high:.0f}"
    unit = unit_label(region["covariate_unit"])
    place = f"at {number(low, 4)}" if low == high else f"{number(low, 4)} to {number(high, 4)}"
    return f"{place} {unit}".rstrip() + (f" in run {group}" if group else "")


def _fixed_text(f: FixedComparison, residuals: np.ndarray, unit: str) -> str:
    return (
        f"with the fixed coefficients: {np.sum(residuals > 0)} of {residuals.size} residuals are positive, mean "
        f"{residuals.mean():.2f} ({residuals.min():.2f} to {residuals.max():.2f}) {unit}, rms {f.rms:.2f}\n"
        f"the same model with free coefficients leaves {f.free_fit:.3g} {unit}: "
        f"the rms is {f.rms / f.noise:.1f} times that"
    )


SAME_COVARIATE_CORRELATION = 0.95  # rank correlation from which two covariates count as the same
# Expected lag-1 autocorrelation above which the fit itself determines it, as with two readings about a free level.
TIED_CORRELATION = 0.99
FARTHEST_SHARE = 0.1  # share of the readings, those farthest from the model, whose signs are tested
DUOS = 15  # pairs of covariates, at most
MEMBERS = 64  # of a group that is looked at member by member, at most
ROUNDING_SHARE = 1e-9  # of a sum, below which it is the rounding of its terms
RUN_REGION_READINGS = 8  # readings that a run needs for a region of its own where a model fails
BINS = 12  # of a covariate
SCALES = (3, 4)  # lengths of the process over their plausible range; in time, where that is wider
AMPLITUDES = tuple(np.geomspace(0.15, 15.0, 7))  # in noise standard deviations
WAVES = 2  # along each of two covariates together


@on_one_thread
def check(calibration: Calibration) -> Check:
    """Check a fitted model's residuals against every covariate.

    With fixed coefficients the reference is the noise of the same model with free ones, not noise inflated by misfit.
    """
    judged, free = _with_free_noise(calibration)
    linear, fixed = judged.linear, None
    residual, white = linear.conditional_residuals, linear.scores
    noise, rms = float(np.sqrt(np.mean(linear.variance))), float(np.sqrt(np.mean(residual**2)))
    covariates = covariates_of(judged)
    two = _covariate_pairs(covariates)
    factors = log_bayes_factors(judged, covariates, noise)
    of_two = log_bayes_factors(judged, [_interaction(a, b) for a, b in two], noise)
    scored = zip(covariates, factors, strict=True)
    entries = [Entry(c.name, f, _worst_region(judged, c), bool(c.levels)) for c, f in scored]
    pairs = [Pair((a.name, b.name), f) for (a, b), f in zip(two, of_two, strict=True)]
    # Each reading predicted from the others, in standard deviations of that prediction: V⁻¹r over the root of V⁻¹'s
    # diagonal, both from the leverages. Under correlated noise: from those before it in its run.
    loo = white
    if judged.model.noise.independent:
        loo = white / np.sqrt(np.maximum(1 - np.sum(linear.directions**2, axis=1), 1e-12))
    # Where the mean is off, so are size and side of the residuals: these are judged only where it is not.
    scatter, one_sided = dict[str, float](), 1.0
    if max(factors, default=0.0) < settings().strong_evidence:
        scatter = _scatter_p_values(covariates, white, calibration.readings["output"] - residual)
        if count := int(FARTHEST_SHARE * len(loo)):  # sign test
            above = int(np.sum(loo[np.argsort(-np.abs(loo))[:count]] > 0))
            one_sided = min(1.0, 2 * float(bdtr(min(above, count - above), count, 0.5)))
    if free is not None:
        fixed = FixedComparison(noise, rms, free)
    far = settings().outlier_sd
    return Check(
        entries=tuple(sorted(entries, key=lambda e: -e.log_bayes_factor)),
        pairs=tuple(sorted(pairs, key=lambda p: -p.log_bayes_factor)),
        unit=calibration.unit,
        rms=rms,
        noise=noise,
        autocorrelation=autocorrelation(judged, white),
        scatter_with=scatter,
        outliers=tuple((i, z) for i, z in enumerate(loo.tolist()) if abs(z) > far),
        pit_p=_normality_p_value(loo),
        one_sided=one_sided,
        fixed=fixed,
        residuals=residual,
    )


def why_not(calibration: Calibration) -> str:
    """Return why a calibration must not be used, empty if it may; an unchecked one is checked first."""
    verdict = calibration.verdict
    if verdict.checked or not verdict.reliable:
        return verdict.why_not
    cache = vars(calibration)  # cached with the other computed attributes
    if "why_not" not in cache:
        cache["why_not"] = judgement.noiseless(calibration) or " ".join(_failures(calibration))
    return cache["why_not"]


def _failures(calibration: Calibration) -> Sequence[judgement.Claim]:
    if wrong := judgement.wrong_question(calibration, noise_floor(calibration)):
        return wrong
    doubts = tuple(judgement.multimodality(calibration))
    parts = {"left_out": leave_one_group_out(calibration), "doubts": doubts}
    return judgement.failures(judgement.Subject(calibration, check=check(calibration), **parts))


def _with_free_noise(calibration: Calibration) -> tuple[Calibration, float | None]:
    """Return the calibration with its reference noise; and the free fit's noise, if coefficients are fixed."""
    # Coefficients fixed at stated values; not those known by definition.
    fixed_names = {b.name for b in calibration.layout.blocks} & {*dict(calibration.model.fixed)}
    if not fixed_names:
        return calibration, None
    method, reference = LeastSquares(draws=400), calibration.reference
    model, readings = calibration.model.free(*fixed_names), calibration.readings
    free = fit(model, readings, method, reference=reference, strict=False)
    v = np.array(calibration.mode.v)
    for i in calibration.layout.phi_indices("noise"):
        v[i] = free.mode.v[free.layout.index_in_phi[calibration.layout.hypers[i].name]]
    judged_fit = replace(calibration, mode=calibration.mode._replace(v=v))
    return judged_fit, float(np.sqrt(np.mean(free.linear.variance)))


@dataclass(frozen=True)
class Covariate:
    """A covariate and its basis columns."""

    name: str
    values: np.ndarray  # (n,); of a group the numbers of its members
    columns: np.ndarray  # (n, k)
    weights: tuple[np.ndarray, ...]  # (k,) that make columns of unit amplitude, at each length
    unit: str = ""
    levels: tuple[str, ...] = ()  # names of a group's members

    @classmethod
    def smooth(
        cls, name: str, values: np.ndarray, unit: str = "", *, in_time: bool = False
    ) -> Covariate:
        """Build a smooth dependence on a covariate that takes several values."""
        terms, plausible = RESOLUTION[in_time]
        position = (values - values.min()) / (np.ptp(values) or 1.0)
        lengths = np.geomspace(*plausible, SCALES[in_time])
        weights = tuple(process_weights(length, terms) for length in lengths)
        return cls(name, values, process_columns(position, terms), weights, unit)


def covariates_of(calibration: Calibration) -> list[Covariate]:
    """List the recorded and derived covariates that residuals are tested against."""
    readings, frame, smooth = calibration.readings, calibration.frame, Covariate.smooth
    excluded = {"output", "output_uncertainty", "temperature_point", *readings.no_causes}
    covariates = []
    for name in readings.columns:
        unit = readings.unit(name)
        if unit is not None and name not in excluded and np.ptp(readings[name]) > 0:
            covariates.append(smooth(name, readings[name], unit, in_time=name == "time"))
    if "temperature" in frame.rates and np.ptp(np.asarray(frame.rates["temperature"])) > 0:
        rate = np.asarray(frame.rates["temperature"]) * 60
        covariates.append(smooth("temperature rate", rate, "degC/min"))
    if len(readings.groups("run")[0]) > 1 and "elapsed" in frame.columns:
        elapsed = np.asarray(frame.columns["elapsed"])
        covariates.append(smooth("elapsed", elapsed, "s", in_time=True))
    for group in calibration.levels:
        levels, codes = readings.groups(group)
        if 1 < len(levels) <= MEMBERS:  # a level for each member
            columns = (codes[:, None] == np.unique(codes[codes >= 0])).astype(float)
            even = (np.ones(columns.shape[1]),)
            covariates.append(Covariate(group, codes.astype(float), columns, even, levels=levels))
    if not readings.has("time"):
        covariates.append(smooth("order", np.arange(1.0, len(readings) + 1), in_time=True))
    return covariates


def _covariate_pairs(covariates: list[Covariate]) -> list[tuple[Covariate, Covariate]]:
    """List pairs of covariates whose rank correlation is below 0.95."""
    varied = (c for c in covariates if not c.levels and np.ptp(c.values) > 0)
    pairs = combinations([(c, _ranks(c.values)) for c in varied], 2)
    rows = ((a, b, judgement.correlation(first, second)[0]) for (a, first), (b, second) in pairs)
    return [(a, b) for a, b, r in rows if abs(r) < SAME_COVARIATE_CORRELATION][:DUOS]


def _ranks(values: np.ndarray) -> np.ndarray:
    """Return ranks from 1; ties get their mean rank."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - 0.5 * (counts - 1))[inverse]


def _normality_p_value(values: np.ndarray) -> float:
    """Return the Kolmogorov p-value of standard normality (M. Stephens, J. R. Stat. Soc. B 32 (1970) 115)."""
    root, p = np.sqrt(len(values)), ndtr(np.sort(values))
    steps = np.arange(len(values) + 1) / len(values)
    distance = max(np.max(steps[1:] - p), np.max(p - steps[:-1]))
    return float(kolmogorov((root + 0.12 + 0.11 / root) * distance))


def _interaction(first: Covariate, second: Covariate) -> Covariate:
    """Build an interaction of two covariates: products of low-order Legendre polynomials along them."""

    def waves(values: np.ndarray) -> np.ndarray:
        low, high = values.min(), values.max()
        return np.polynomial.legendre.legvander(2 * (values - low) / (high - low) - 1, WAVES)[:, 1:]

    first_waves, second_waves = waves(first.values), waves(second.values)
    basis = (first_waves[:, :, None] * second_waves[:, None, :]).reshape(len(first_waves), -1)
    scale = np.sqrt(np.mean(np.sum(basis**2, axis=1)))
    weights = (np.full(basis.shape[1], 1 / max(scale, 1e-300)),)
    return Covariate(f"{first.name} × {second.name}", first.values, basis, weights)


def log_bayes_factors(
    calibration: Calibration, covariates: Sequence[Covariate], noise: float
) -> list[float]:
    """Return each covariate's log Bayes factor of a dependence against none, over lengths and amplitudes.

    Amplitudes are prior standard deviations common to all of its columns, in units of the noise (output unit).
    """
    factors = list[float]()
    for covariate in covariates:
        u, information = calibration.linear.score(covariate.columns * noise)
        sizes = np.concatenate([np.outer(AMPLITUDES, weight) for weight in covariate.weights])
        scaled = sizes[:, :, None] * information * sizes[:, None, :]
        volume, squares = explained_sum_of_squares(sizes * u, scaled)
        factors.append(float(logsumexp(0.5 * squares - volume) - np.log(np.size(volume))))
    return factors


def autocorrelation(calibration: Calibration, standardised: np.ndarray) -> tuple[float, float]:
    """Return the lag-1 autocorrelation within runs in excess of that induced by the fit, and its z.

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
    expected, sd = _white_autocorrelation(calibration.linear.directions[order], first)
    product, squares = float(before @ after), 0.5 * float(before @ before + after @ after)
    lag_one = product / size
    if sd == 0 or abs(expected) > TIED_CORRELATION:
        return 0.0, 0.0
    coefficient = float(np.clip((lag_one - expected) / (1 - lag_one * expected), -1, 1))
    return coefficient, (product / squares - expected) / sd


def _white_autocorrelation(directions: np.ndarray, first: np.ndarray) -> tuple[float, float]:
    """Return mean and standard deviation of the lag-1 autocorrelation of e ~ N(0, C), C = I − G·Gᵀ.

    G are the directions (n, q), in the order of time. The sum over neighbours of eᵢ·eᵢ₊₁ is eᵀBe, that of their
    squares, halved, eᵀDe. Their means have the ratio ρ = tr(BC)/tr(DC), and the variance of eᵀKe, K = B − ρ·D, is
    2·tr(KCKC). `first` is where the first of each two neighbours stands.
    """
    halves = 0.5 * np.bincount(np.append(first, first + 1), minlength=len(directions))  # D
    squares = float(halves @ (1 - np.sum(directions**2, axis=1)))
    if squares < ROUNDING_SHARE * first.size:
        return 0.0, 0.0
    expected = -float(np.sum(directions[first] * directions[first + 1])) / squares
    kg = -expected * halves[:, None] * directions
    kg[first] += 0.5 * directions[first + 1]
    kg[first + 1] += 0.5 * directions[first]
    square_trace = 0.5 * first.size + expected**2 * float(halves @ halves)  # tr(KK)
    trace = square_trace - 2 * float(np.sum(kg**2)) + float(np.sum((directions.T @ kg) ** 2))
    if trace < ROUNDING_SHARE * first.size:
        return expected, 0.0
    return expected, float(np.sqrt(2 * trace)) / squares


def _scatter_p_values(
    covariates: list[Covariate], standardised: np.ndarray, expected: np.ndarray
) -> dict[str, float]:
    """Return covariates with which the residuals' size changes (rank correlation), with p-values."""
    orders = {c.name: c.values for c in covariates if not c.levels}
    # Noise in proportion to a signal of both signs grows on both sides: no column's ranking shows it.
    orders["the output's distance from its median"] = np.abs(expected - np.median(expected))
    varied = {n: values for n, values in orders.items() if np.ptp(values) > 0 and len(values) > 2}
    sizes = _ranks(np.abs(standardised))
    p_values = {n: judgement.correlation(sizes, _ranks(values))[1] for n, values in varied.items()}
    return {name: p for name, p in p_values.items() if p < SIGNIFICANT_P}


def noise_floor(calibration: Fitted) -> float:
    """Return the noise that no model of smooth effects could remove, output unit.

    From each residual against the mean of its two neighbours (in time within a run; in temperature where there
    is no time), as in a von Neumann ratio: what varies slowly cancels.
    """
    residual = calibration.linear.conditional_residuals
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


def _worst_region(calibration: Calibration, covariate: Covariate) -> Region:
    """Find the range of bins whose mean residual is largest over its uncertainty, in all runs or one.

    Means and uncertainties follow the noise law: under correlated noise a long range counts for less.
    """
    levels, codes = calibration.readings.groups("run")
    region = _worst_range(calibration, covariate, np.ones(len(codes), bool), None)
    if covariate.levels:
        return replace(region, group=covariate.levels[int(region.low)])
    for k, level in enumerate(levels if len(levels) > 1 else ()):
        if np.sum(codes == k) >= RUN_REGION_READINGS:
            of_run = _worst_range(calibration, covariate, codes == k, level)
            # A single run's region must be clearly worse than the common one.
            if abs(of_run.z) - 1 > abs(region.z) - (region.group is not None):
                region = of_run
    return region


def _worst_range(
    calibration: Calibration, covariate: Covariate, mask: np.ndarray, run: str | None
) -> Region:
    """Find the worst range among the masked readings."""
    values = covariate.values[mask]
    distinct, bins = np.unique(values), np.full(len(mask), -1)
    if covariate.levels or len(distinct) <= BINS:
        bins[mask], count = np.searchsorted(distinct, values), len(distinct)
    else:
        edges = np.quantile(values, np.linspace(0, 1, BINS + 1)[1:-1])
        bins[mask], count = np.searchsorted(edges, values, side="right"), BINS
    score, weight = calibration.linear.normal_eqs((bins[:, None] == np.arange(count)).astype(float))
    starts, ends = np.triu_indices(count + 1, 1)
    short = ends - starts <= (1 if covariate.levels else max(1, (2 * count) // 3))
    starts, ends = starts[short], ends[short]
    score_sums = np.append(0.0, np.cumsum(score))
    weights = np.pad(weight.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    total = score_sums[ends] - score_sums[starts]
    information = (weights[ends, ends] - weights[starts, ends]) - (
        weights[ends, starts] - weights[starts, starts]
    )
    informed = information > 0
    scores = np.where(informed, total, 0.0) / np.sqrt(np.where(informed, information, 1.0))
    at = int(np.argmax(np.abs(scores)))
    z = float(scores[at])
    inside = (bins >= starts[at]) & (bins < ends[at])
    values = covariate.values[inside] if inside.any() else covariate.values
    size = float(total[at] / information[at]) if z != 0 else 0.0
    return Region(float(values.min()), float(values.max()), run, size, z, covariate.unit)
