"""Where the model fails: residuals against every covariate, with evidence and the worst region in physical units.

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
from bayescal._core.formatting import number
from bayescal._core.parallel import on_one_thread
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._core.settings import settings
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.linear_model import taken_up
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
    """One covariate, or group of readings (`by_group`): a run, a cell, an axis, a device."""

    against: str
    log_bayes_factor: float
    worst: Region
    by_group: bool = False

    def data(self, unit: str) -> dict[str, Any]:
        """As in result.json; sizes in the output's unit, places in the covariate's."""
        worst = dict(vars(self.worst))
        place = {"from": worst.pop("low"), "to": worst.pop("high"), "unit": unit}
        return {**vars(self), "worst": {**place, **worst}}


@dataclass(frozen=True)
class Pair:
    """Two covariates: evidence of an interaction not explained by additive terms."""

    against: tuple[str, str]
    log_bayes_factor: float


@dataclass(frozen=True)
class FixedComparison:
    """What residuals of a model with fixed coefficients are judged against, output unit."""

    noise: float  # standard deviation used as the measure
    rms: float  # of the residuals
    free_fit: float  # noise of the same model with free coefficients

    @property
    def wrong(self) -> bool:
        """Whether the fixed coefficients leave clearly more than the noise of the same model with free coefficients."""
        return self.rms > 2 * self.noise


@dataclass(frozen=True, repr=False)
class Check(Printed):
    """Where a model fails.

    Attributes:
        entries: a covariate each, the strongest evidence first.
        pairs: of covariates, likewise.
        unit: of the output.
        rms: of the residuals, output unit.
        noise: standard deviation that they are judged against.
        autocorrelation: (lag-1 coefficient within runs beyond what the fit itself leaves, its z).
        scatter_with: covariates with which the scatter changes, and the p-value of each.
        outliers: (row, leave-one-out standard deviations).
        pit_p: p-value of uniform leave-one-out probability integral transforms.
        one_sided: p-value of as many readings far above the model as far below it.
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
        """Each covariate, as in result.json."""
        return [e.data(self.unit) for e in self.entries]

    def _brief(self) -> str:
        unit = unit_label(self.unit)
        said = f"residuals {self.rms:.3g} {unit} rms, noise {self.noise:.3g} {unit}"
        for most in self.entries[:1]:
            said += f"; most against {most.against}, log Bayes factor {most.log_bayes_factor:z.1f}"
        return said

    def _columns(self) -> dict[str, list[Any]]:
        """A row for each covariate or group; sizes in the output's unit, places in the covariate's."""
        return check_table(self.data()).data()


def check_table(rows: Sequence[Mapping[str, Any]]) -> ResultTable:
    """Residuals against each covariate; of its rows as they stand in result.json."""

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
    """Where a model fails, the worst covariate first.

    Of `most` covariates alone, what always stands below them (neighbours in time, probabilities of single readings) is
    left out too.
    """
    unit, rows = unit_label(check.unit), check.data()[:most]
    noise = f"judged against noise of {check.noise:.3g} {unit}"
    lines: list[str | ResultTable] = [f"residuals {check.rms:.3g} {unit} rms, {noise}"]
    if check.fixed:
        lines += [_fixed_text(check.fixed, check.residuals, unit), ""]
    lines.append(check_table(rows) if rows else "no covariate varies")
    strong = settings().strong_evidence
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
        shown = ", ".join(f"row {i + 1} ({z:+.1f} sd)" for i, z in check.outliers[:5])
        lines.append(f"outliers: {shown}{' …' if len(check.outliers) > 5 else ''}")
    if most is None:
        lines.append(f"leave-one-out probabilities uniform: p = {check.pit_p:.2g}")
    if check.one_sided < SIGNIFICANT_P:
        lines.append(f"readings far from the model stand on one side (p = {check.one_sided:.1g})")
    return lines


def place_in_words(row: Mapping[str, Any]) -> str:
    """Where the worst region of a covariate is: "48.7 to 79.74 °C in run 2", "run 2", "rows 3 to 8"."""
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


SAME_COVARIATE_CORRELATION = 0.95  # rank correlation from which two covariates are taken for one
# Expected lag-1 autocorrelation, from which neighbours are what the fit leaves, such as two about a free level, and
# say nothing of the noise.
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
    """Where a fitted model fails.

    A model with fixed coefficients is judged against the noise of the same model with free coefficients, not against a
    noise inflated to cover its misfit.
    """
    judged, free = _judged(calibration)
    linear, fixed = judged.linear, None
    residual, white = linear.settled, linear.scores
    noise, rms = float(np.sqrt(np.mean(linear.variance))), float(np.sqrt(np.mean(residual**2)))
    covariates = covariates_of(judged)
    duos = _duos(covariates)
    factors = log_bayes_factors(judged, covariates, noise)
    of_duos = log_bayes_factors(judged, [_together(a, b) for a, b in duos], noise)
    each = zip(covariates, factors, strict=True)
    entries = [Entry(c.name, f, _worst_region(judged, c), bool(c.levels)) for c, f in each]
    pairs = [Pair((a.name, b.name), f) for (a, b), f in zip(duos, of_duos, strict=True)]
    # Each reading predicted from the others, in standard deviations of that prediction: V⁻¹r over the root of V⁻¹'s
    # diagonal, both from the leverages. Under correlated noise: from those before it in its run.
    loo = white
    if judged.model.noise.independent:
        loo = white / np.sqrt(np.maximum(1 - np.sum(linear.directions**2, axis=1), 1e-12))
    # Where the mean is off, so are size and side of the residuals: these are judged only where it is not.
    scatter, one_sided = dict[str, float](), 1.0
    if max(factors, default=0.0) < settings().strong_evidence:
        scatter = _scatter_with(covariates, white, calibration.readings["output"] - residual)
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
        pit_p=_normal(loo),
        one_sided=one_sided,
        fixed=fixed,
        residuals=residual,
    )


def why_not(calibration: Calibration) -> str:
    """Return why a calibration is not to be used; empty where it may be. One that nobody checked is checked."""
    verdict = calibration.verdict
    if verdict.checked or not verdict.reliable:
        return verdict.why_not
    known = vars(calibration)  # kept with what else is computed of it
    if "why_not" not in known:
        known["why_not"] = judgement.noiseless(calibration) or " ".join(_against(calibration))
    return known["why_not"]


def _against(calibration: Calibration) -> Sequence[judgement.Claim]:
    if wrong := judgement.wrong_question(calibration, noise_floor(calibration)):
        return wrong
    doubts = tuple(judgement.doubts_of_the_mode(calibration))
    asked = {"left_out": leave_one_group_out(calibration), "doubts": doubts}
    return judgement.against(judgement.Subject(calibration, check=check(calibration), **asked))


def _judged(calibration: Calibration) -> tuple[Calibration, float | None]:
    """The calibration with the noise to judge by; and the free fit's noise, if coefficients are fixed."""
    # Coefficients fixed at values that were stated; those that are known by definition are none of them.
    held = {b.name for b in calibration.layout.blocks} & {*dict(calibration.model.fixed)}
    if not held:
        return calibration, None
    method, reference = LeastSquares(draws=400), calibration.reference
    model, readings = calibration.model.free(*held), calibration.readings
    free = fit(model, readings, method, reference=reference, strict=False)
    v = np.array(calibration.mode.v)
    for i in calibration.layout.positions("noise"):
        v[i] = free.mode.v[free.layout.index_in_phi[calibration.layout.hypers[i].name]]
    judged = replace(calibration, mode=calibration.mode._replace(v=v))
    return judged, float(np.sqrt(np.mean(free.linear.variance)))


@dataclass(frozen=True)
class Covariate:
    """A covariate and its columns."""

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
        """A smooth dependence on a covariate that takes several values."""
        terms, plausible = RESOLUTION[in_time]
        position = (values - values.min()) / (np.ptp(values) or 1.0)
        lengths = np.geomspace(*plausible, SCALES[in_time])
        weights = tuple(process_weights(length, terms) for length in lengths)
        return cls(name, values, process_columns(position, terms), weights, unit)


def covariates_of(calibration: Calibration) -> list[Covariate]:
    """Everything recorded or derived that residuals can be laid against."""
    readings, frame, smooth = calibration.readings, calibration.frame, Covariate.smooth
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
        if 1 < len(levels) <= MEMBERS:  # a level for each member
            columns = (codes[:, None] == np.unique(codes[codes >= 0])).astype(float)
            even = (np.ones(columns.shape[1]),)
            found.append(Covariate(group, codes.astype(float), columns, even, levels=levels))
    if not readings.has("time"):
        found.append(smooth("order", np.arange(1.0, len(readings) + 1), in_time=True))
    return found


def _duos(covariates: list[Covariate]) -> list[tuple[Covariate, Covariate]]:
    """Pairs of covariates that are not nearly one and the same."""
    varied = (c for c in covariates if not c.levels and np.ptp(c.values) > 0)
    pairs = combinations([(c, _ranks(c.values)) for c in varied], 2)
    apart = ((a, b, judgement.correlation(one, two)[0]) for (a, one), (b, two) in pairs)
    return [(a, b) for a, b, r in apart if abs(r) < SAME_COVARIATE_CORRELATION][:DUOS]


def _ranks(values: np.ndarray) -> np.ndarray:
    """Ranks from 1; equal values share the mean of theirs."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - 0.5 * (counts - 1))[inverse]


def _normal(values: np.ndarray) -> float:
    """p-value of standard normal values (Kolmogorov; for few by M. Stephens, J. R. Stat. Soc. B 32 (1970) 115)."""
    root, p = np.sqrt(len(values)), ndtr(np.sort(values))
    steps = np.arange(len(values) + 1) / len(values)
    apart = max(np.max(steps[1:] - p), np.max(p - steps[:-1]))
    return float(kolmogorov((root + 0.12 + 0.11 / root) * apart))


def _together(first: Covariate, second: Covariate) -> Covariate:
    """An interaction of two covariates, not explained by additive terms: products of long waves along them."""

    def waves(values: np.ndarray) -> np.ndarray:
        low, high = values.min(), values.max()
        return np.polynomial.legendre.legvander(2 * (values - low) / (high - low) - 1, WAVES)[:, 1:]

    one, two = waves(first.values), waves(second.values)
    basis = (one[:, :, None] * two[:, None, :]).reshape(len(one), -1)
    scale = np.sqrt(np.mean(np.sum(basis**2, axis=1)))
    weights = (np.full(basis.shape[1], 1 / max(scale, 1e-300)),)
    return Covariate(f"{first.name} × {second.name}", first.values, basis, weights)


def log_bayes_factors(
    calibration: Calibration, covariates: Sequence[Covariate], noise: float
) -> list[float]:
    """For each covariate the log Bayes factor of a dependence on it against none, over lengths and amplitudes.

    Amplitudes are prior standard deviations common to all of its columns, in units of the noise (output unit).
    """
    found = list[float]()
    for covariate in covariates:
        u, information = calibration.linear.score(covariate.columns * noise)
        sizes = np.concatenate([np.outer(AMPLITUDES, weight) for weight in covariate.weights])
        volume, squares = taken_up(sizes * u, sizes[:, :, None] * information * sizes[:, None, :])
        terms = 0.5 * squares - volume
        found.append(float(logsumexp(terms) - np.log(np.size(terms))))
    return found


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
    expected, sd = _of_independent_noise(calibration.linear.directions[order], first)
    product, squares = float(before @ after), 0.5 * float(before @ before + after @ after)
    found = product / size
    if sd == 0 or abs(expected) > TIED_CORRELATION:
        return 0.0, 0.0
    coefficient = float(np.clip((found - expected) / (1 - found * expected), -1, 1))
    return coefficient, (product / squares - expected) / sd


def _of_independent_noise(directions: np.ndarray, first: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation of the lag-1 autocorrelation of residuals e ~ N(0, C), C = I − G·Gᵀ.

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
    own = 0.5 * first.size + expected**2 * float(halves @ halves)  # tr(KK)
    trace = own - 2 * float(np.sum(kg**2)) + float(np.sum((directions.T @ kg) ** 2))
    if trace < ROUNDING_SHARE * first.size:
        return expected, 0.0
    return expected, float(np.sqrt(2 * trace)) / squares


def _scatter_with(
    covariates: list[Covariate], standardised: np.ndarray, expected: np.ndarray
) -> dict[str, float]:
    """Covariates along which the size of the residuals changes (rank correlation), with p-values."""
    along = {c.name: c.values for c in covariates if not c.levels}
    # Noise in proportion to a signal of both signs grows on both sides, which a ranking along no column shows.
    along["the output's distance from its median"] = np.abs(expected - np.median(expected))
    varied = {n: values for n, values in along.items() if np.ptp(values) > 0 and len(values) > 2}
    sizes = _ranks(np.abs(standardised))
    found = {n: judgement.correlation(sizes, _ranks(values))[1] for n, values in varied.items()}
    return {name: p for name, p in found.items() if p < SIGNIFICANT_P}


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


def _worst_region(calibration: Calibration, covariate: Covariate) -> Region:
    """The range of neighbouring bins whose mean residual is worst against its uncertainty, of all runs or of one.

    Means and uncertainties follow the noise law: under correlated noise a long range counts for less.
    """
    levels, codes = calibration.readings.groups("run")
    region = _worst(calibration, covariate, np.ones(len(codes), bool), None)
    if covariate.levels:
        return replace(region, group=covariate.levels[int(region.low)])
    for k, level in enumerate(levels if len(levels) > 1 else ()):
        if np.sum(codes == k) >= RUN_REGION_READINGS:
            own = _worst(calibration, covariate, codes == k, level)
            # One run's own region must be clearly worse than the common one to be named.
            if abs(own.z) - 1 > abs(region.z) - (region.group is not None):
                region = own
    return region


def _worst(
    calibration: Calibration, covariate: Covariate, own: np.ndarray, run: str | None
) -> Region:
    """The worst range of the readings that a mask names."""
    values = covariate.values[own]
    distinct, bins = np.unique(values), np.full(len(own), -1)
    if covariate.levels or len(distinct) <= BINS:
        bins[own], count = np.searchsorted(distinct, values), len(distinct)
    else:
        edges = np.quantile(values, np.linspace(0, 1, BINS + 1)[1:-1])
        bins[own], count = np.searchsorted(edges, values, side="right"), BINS
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
    size = float(total[at] / information[at]) if z != 0 else 0.0
    return Region(float(values.min()), float(values.max()), run, size, z, covariate.unit)
