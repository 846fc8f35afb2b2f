"""Acceptance checks of a fit: implausible values, and evidence against it in its own readings.

Each is a function of a `Subject`; thresholds and words are in `claims.toml`. Which effect is missing only a search
tells; that one is missing shows in the residuals.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import stdtr

from bayescal._calibration.claim import Claim, limit
from bayescal._calibration.fitted import Fitted
from bayescal._calibration.leave_group_out import LeaveOneGroupOut, scheme
from bayescal._calibration.summary import summary
from bayescal._core.formatting import number
from bayescal._core.parallel import on_one_thread
from bayescal._core.settings import settings
from bayescal._data.dataset_checks import rounding_step
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.density import Density
from bayescal._inference.laplace import find_mode, prior_draws, scan_ragged
from bayescal._inference.newton import Nearby
from bayescal._inference.problem import Problem
from bayescal._model.effect import Effect
from bayescal._model.model import Model, why_untestable
from bayescal._model.noise_law import WHITE, Noise
from bayescal._model.parameters import bind
from bayescal._model.terms import ColumnSpec

PRIOR = "prior.contradicted"
FREE_SIZES = 1e3  # factor on a plausible size that makes its prior uninformative
STARTS_TRIED = 3  # starts of the search for another mode


@dataclass(frozen=True)
class Subject:
    """A fit and the computations that its acceptance checks use."""

    fit: Fitted
    accepted: Collection[str] = ()  # coefficients or effects that may contradict their priors
    noise_floor: float = math.inf  # noise that no model could remove, output unit
    check: Any = None  # its `Check`; None, as `left_out`, where no check needs it
    left_out: LeaveOneGroupOut | None = None  # each group predicted from the others
    doubts: tuple[Claim, ...] = ()  # of its mode
    first: Model | None = None  # the search's first model, whose thermometers are checked
    # The cure where residuals depend on a covariate, and the names in it.
    missing: Mapping[str, str] = field(default_factory=lambda: {"cure": "search"})

    def accepts(self, *names: str) -> bool:
        return not {*self.accepted}.isdisjoint(names)


def conflicts(subject: Subject) -> list[Claim]:
    """Return the contradictions of readings and model that hold whatever the residuals."""
    claims = [*contradicted_priors(subject), *widened_coefficients(subject)]
    return [*claims, *too_large(subject), *implausible_curves(subject)]


def group_conflicts(subject: Subject) -> list[Claim]:
    """Return the claims against members of groups."""
    return [*too_different(subject), *members_following_terms(subject)]


def wrong_question(
    fit: Fitted, noise_floor: float, accepted: Collection[str] = ()
) -> tuple[Claim, ...]:
    """Return why a search is pointless: readings that contradict the model, or rounded coarser than noise."""
    freed = (n for e in fit.model.effects if e.frees for n in (e.name, e.frees))
    subject = Subject(fit, {*accepted, *freed}, noise_floor)
    claims = conflicts(subject) or priors_contradicted_by_data(subject)
    return (*claims, *rounded(subject))


def residual_claims(subject: Subject) -> list[Claim]:
    """Return the failed residual checks; of a fit that did not converge, or is fixed wrongly, that alone."""
    if claims := [*not_converged(subject)]:
        return claims
    claims += [*not_finite(subject), *subject.doubts, *slow(subject), *scatter(subject)]
    return [*claims, *dependence(subject), *steps_between_runs(subject), *correlated(subject)]


def failures(subject: Subject) -> list[Claim]:
    """Return the failed checks of a fit that no search judged."""
    claims = [*group_conflicts(subject), *residual_claims(subject)]
    return [*claims, *odd_thermometers(subject), *unexpected_groups(subject)]


def not_converged(subject: Subject) -> Iterator[Claim]:
    verdict = subject.fit.verdict
    if not verdict.ok:
        yield Claim("fit.not_converged", reasons=" ".join(verdict.reasons))
    elif subject.check and (fixed := subject.check.fixed) and fixed.wrong:
        unit = subject.check.unit
        yield Claim("fixed.wrong", rms=fixed.rms, unit=unit, times=fixed.rms / fixed.noise)


def contradicted_priors(subject: Subject) -> Iterator[Claim]:
    """Yield coefficients far from their prior means."""
    return _against_priors(subject, {r["name"]: (r["mean"], 0.0) for r in summary(subject.fit)[0]})


def priors_contradicted_by_data(subject: Subject) -> list[Claim]:
    """Return coefficients whose estimates from the readings alone are far from their priors.

    A prior that the readings contradict strongly enough wins: the noise takes up what the coefficient may not, and the
    fit shows nothing. So biases and scale factors of the instrument's own effects get a thousand times their widths.
    """
    fit, instrument = subject.fit, subject.fit.model.instrument
    single = (e for e in instrument.effects if len(e.coefficients) == 1)
    freed = {e.name for e in single if instrument.slot(e.slot).unit in (instrument.unit, "1")}
    problem = Problem(fit.layout, fit.problem.record, dict.fromkeys(freed, FREE_SIZES))
    starts = [fit.mode.v, np.zeros_like(fit.mode.v)]
    near = Nearby(fit.mode.v, np.linalg.pinv(fit.mode.covariance))
    mode = find_mode(problem, starts, fit.mode.x, xtol=0.01, near=near)
    _, posterior = Density(problem, mode.x, mode.flat, mode.v).condition_at(mode.v)
    if posterior is None:
        return []
    mean, error = posterior.mean, limit(PRIOR, "sd") * np.sqrt(np.diag(posterior.covariance))
    positions = {
        u.name: (u.block.origin + float(mean[u.x]), float(error[u.x]))
        for u in fit.unknowns
        if u.x is not None and u.block is not None and u.effect in freed
    }
    return [*_against_priors(subject, positions)]


def _against_priors(subject: Subject, at: Mapping[str, tuple[float, float]]) -> Iterator[Claim]:
    """Yield coefficients far from their prior means, of (value, error) each."""
    baseline = {e.name for e in subject.fit.model.instrument.effects}
    most_coefficients, far_sd = limit(PRIOR, "coefficients"), limit(PRIOR, "sd")
    for u in subject.fit.unknowns:
        if u.block is None or u.prior_sd is None or u.held:
            continue
        effect, c = u.block.effect, u.block.coefficient
        if len(effect.coefficients) > most_coefficients or subject.accepts(effect.name, u.name):
            continue
        value, error = at.get(u.name, (c.mean, 0.0))
        z = abs(value - c.mean) / c.size
        sizes = 1 if effect.name in baseline else limit(PRIOR, "candidate_sizes")
        if z - error / c.size > far_sd * sizes:
            cure = "scale" if effect.slot.partition("_")[0] == "scale" else "zero and scale"
            data = {"where": value, "mean": c.mean, "size": c.size, "unit": c.unit, "away": z}
            data |= {"fall": 0.5 * z**2, "cure": cure if effect.kind == "constant" else "units"}
            yield Claim(PRIOR, u.name, effect.name, **data)


def widened_coefficients(subject: Subject) -> Iterator[Claim]:
    """Yield coefficients less certain than before the fit, unless a confounder widens them."""
    keys = {name for confounder in subject.fit.confounders for name in confounder.coefficients}
    wider = {u.name for u in subject.fit.unknowns if u.key in keys}
    # Coefficients only: a positive unknown may be larger than expected, and then wider.
    for row in summary(subject.fit)[0]:
        name, contraction = row["name"], row["contraction"]
        accepted = name in wider or subject.accepts(name, row["effect"])
        least = limit("prior.widened", "contraction")
        if not accepted and contraction is not None and contraction < least:
            yield Claim("prior.widened", name, contraction=contraction)


def too_large(subject: Subject) -> Iterator[Claim]:
    """Yield standard deviations in the output's unit that exceed the output's whole range."""
    fit = subject.fit
    sizes = set(fit.model.noise.amplitudes)
    for effect in fit.model.effects:
        for i, c in enumerate(effect.coefficients):
            if fit.model.instrument.slot(c.slot or effect.slot).unit == fit.unit:
                sizes.add(effect.group_sd_name(i))
    # An amplitude scales coefficients and is hardly identified by one: its effect on the output is judged.
    sizes -= {e.measure_name for e in fit.model.effects}
    span = float(np.ptp(fit.readings["output"]))
    for row in summary(fit)[1]:
        of_output = row["name"] in sizes and row["unit"] == fit.unit and row["mean"] > span > 0
        if of_output and not subject.accepts(row["name"], row["effect"]):
            numbers = {"mean": row["mean"], "reach": span, "unit": fit.unit}
            yield Claim("size.beyond_output", row["name"], **numbers)


def implausible_curves(subject: Subject) -> Iterator[Claim]:
    """Yield unnamed dependences larger than all of the instrument's known effects together.

    A wrong sign or unit of an input is no missing effect, though a free curve along that input fits it.
    """
    fit, instrument, readings = subject.fit, subject.fit.model.instrument, subject.fit.readings
    unnamed = [e for e in fit.model.effects if e.is_placeholder and not subject.accepts(e.name)]
    if not unnamed:
        return
    # How much the instrument's own effects plausibly change the output over these readings, rms, output unit.
    catalogue = (*instrument.effects, *instrument.candidates)
    effects = tuple(e for e in catalogue if why_untestable(e, readings) is None)
    layout = bind(Model(instrument, effects, fit.model.noise), readings)[0]
    problem = Problem(layout, fit.problem.record)
    hyper = problem.hyper(np.zeros(len(problem.hypers)))
    prior = problem.prior(hyper, np.ones(problem.size))
    slopes = problem.linearise(problem.start, hyper).jacobian * (prior.sd * prior.weight)
    expected = float(np.sqrt(np.sum(np.var(slopes, axis=0))))
    for effect in unnamed:
        size = float(np.std(fit.linear.contribution(effect.name)))
        if expected and size > limit("curve.beyond_known", "sizes") * expected:
            yield Claim("curve.beyond_known", effect.name, here=size, known=expected, unit=fit.unit)


def rounded(subject: Subject) -> Iterator[Claim]:
    grid = rounding_step(subject.fit.readings["output"])
    if subject.noise_floor < limit("output.rounded", "steps") * grid:
        yield Claim("output.rounded", grid=grid, unit=subject.fit.unit)


def too_different(subject: Subject) -> Iterator[Claim]:
    """Yield each group's member that differs most, if far more than is plausible.

    A learned standard deviation between members absorbs a wrong sign or unit of one of them, which shows nowhere else.
    Not a test for missing effects: members absorb those too.
    """
    fit = subject.fit
    rows = (r for r in summary(fit)[0] if not subject.accepts(r["name"], r["effect"]))
    positions = {row["name"]: row["mean"] for row in rows}
    for b in fit.layout.blocks:
        c = b.coefficient
        members = [n for n in b.member_names(fit.levels) if n in positions]
        if c.group_sd is None or b.effect.weights is not None or not members:
            continue
        name = max(members, key=lambda n: abs(positions[n] - c.mean))
        distance = abs(positions[name] - c.mean) / c.size
        if distance > limit("group.too_different", "sizes"):
            numbers = {"where": positions[name], "mean": c.mean, "size": c.size, "unit": c.unit}
            whose = {"member": name, "group": c.per, "away": distance}
            yield Claim("group.too_different", b.effect.name, **whose, **numbers)


def members_following_terms(subject: Subject) -> Iterator[Claim]:
    """Yield groups whose members' deviations correlate with a term of the same slot.

    A term has one coefficient, within and between members. Where a thermometer is late or noisy the slope within
    members is attenuated, and the members' deviations absorb the slope between them: the coefficient is small, its
    uncertainty too, and no residual is left. Random deviations correlate with nothing.
    Source: Y. Mundlak, Econometrica 46 (1978) 69.
    """
    fit, record = subject.fit, subject.fit.problem.record
    means = {row["name"]: row["mean"] for row in summary(fit)[0]}
    linear = (e for e in fit.model.effects if len(e.coefficients) == 1 and not e.shapes)
    single = [e for e in linear if e.varies and not e.coefficients[0].per]
    for b in (b for b in fit.layout.blocks if b.coefficient.per in record.codes):
        names = b.member_names(fit.levels)
        plain = b.coefficient.group_sd is not None and b.effect.weights is None
        if not plain or subject.accepts(b.effect.name) or not means.keys() >= {*names}:
            continue
        codes = record.codes[str(b.coefficient.per)]
        values = np.array([means[name] for name in names])
        for term in (e for e in single if e.slot == b.effect.slot and not subject.accepts(e.name)):
            column = record.columns(ColumnSpec.from_effect(term), ())[:, 0]
            count = np.bincount(codes[codes >= 0], minlength=len(values))
            total = np.bincount(codes[codes >= 0], column[codes >= 0], minlength=len(values))
            filled = count > 0
            mean, deviations = total[filled] / count[filled], values[filled]
            if len(mean) < 3 or not (np.ptp(mean) and np.ptp(deviations)):
                continue
            r, p = correlation(mean, deviations)
            if p < limit("group.follows_column", "p"):
                data = {"term": term.name, "along": term.varies, "group": b.coefficient.per}
                data |= {"r": r, "p": p}
                names_of = b.effect.name, term.name
                yield Claim("group.follows_column", *names_of, **data, members=int(filled.sum()))


def correlation(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Return Pearson's correlation of two columns and its p-value under independence."""
    r, freedom = float(np.corrcoef(first, second)[0, 1]), len(first) - 2
    t = np.sqrt(freedom / np.float64((1 - r) * (1 + r))) if abs(r) < 1 else np.inf
    return r, float(2 * stdtr(freedom, -abs(r) * t))


def too_few(subject: Subject) -> Iterator[Claim]:
    """Yield a claim if readings are too few to separate an unstated noise from the unknowns."""
    fit, inclusion = subject.fit, subject.fit.inclusion
    # In an average over structures, their expected number.
    nuisances = {e.name for e in fit.model.instrument.nuisances}
    names = [b.effect.name for b in fit.layout.blocks if b.place in ("x", "phi")]
    free = round(sum(inclusion[name] for name in names if name not in nuisances))
    enough = free + limit("readings.too_few", "freedom")
    if len(fit.readings) < enough and fit.layout.phi_indices("noise"):
        yield Claim("readings.too_few", count=len(fit.readings), free=free)


def off_scale(effect: Effect, contribution: float, noise: float, unit: str) -> list[Claim]:
    """Return a claim where an effect at its plausible size is far too small or large for these readings.

    Its contribution is prior size times basis, the largest over the readings, in the unit of the noise; empty for an
    effect without a fixed plausible size or a basis of columns.
    """
    first = effect.coefficients[0]
    if not effect.columns or effect.is_placeholder or first.group_sd is not None or first.flat:
        return []
    low, high = (limit("effect.off_scale", end) for end in ("smallest", "largest"))
    if contribution == 0 or noise == 0 or low <= contribution / noise <= high:
        return []
    sizes = {"contribution": float(contribution), "noise": float(noise)}
    return [Claim("effect.off_scale", effect.name, **sizes, unit=unit, own=first.unit)]


@on_one_thread
def multimodality(fit: Fitted) -> list[Claim]:
    """Return why the Laplace approximation, on which the evidence rests, does not describe the posterior.

    The Hessian is not positive definite; or another mode of other shapes is nearly as probable, sought from the best of
    some prior draws and along shapes whose evidence has many maxima.
    """
    problem, mode = fit.problem, fit.mode
    if not math.isfinite(mode.log_evidence):
        return []
    if mode.indefinite:
        return [Claim("mode.indefinite")]
    shapes = [i for i, h in enumerate(problem.hypers) if h.kind == "shape"]
    sd = np.sqrt(np.diag(mode.covariance))

    def far(v: np.ndarray) -> np.ndarray:
        return np.abs(v - mode.v)[shapes] > limit("mode.two", "apart_sd") * sd[shapes]

    density = Density(problem, mode.x, mode.flat, mode.v)
    tried = np.concatenate([prior_draws(problem), *scan_ragged(problem, mode.v)])
    # Another mode has other shapes: all else starts at this mode.
    tried = np.where(np.isin(np.arange(len(sd)), shapes), tried, mode.v)
    starts = [v for v in tried if far(v).any()] if shapes else []
    near = Nearby(mode.v, np.linalg.pinv(mode.covariance), True)
    for start in np.array(starts)[np.argsort(-density.values(np.array(starts)))[:STARTS_TRIED]]:
        least = mode.log_density - 20.0
        other = find_mode(problem, [start], mode.x, xtol=0.1, coarse_below=least, near=near)
        behind = mode.log_evidence - other.log_evidence
        if far(other.v).any() and behind < limit("mode.two", "nats"):
            names = [problem.hypers[i].name for i in np.array(shapes)[far(other.v)]]
            a, b = problem.hyper(mode.v), problem.hyper(other.v)
            units = {h.name: h.unit for h in problem.hypers}
            values = tuple(f"{n} {number(a[n])} or {number(b[n])} {units[n]}" for n in names)
            return [Claim("mode.two", *names, behind=behind, values=values)]
    return []


def noiseless(fit: Fitted) -> str:
    """Return the message that a fit has no residual noise, or is not finite; empty for others.

    Without noise nothing can be tested.
    """
    output, variance = fit.readings["output"], fit.linear.variance
    noise, unit = math.sqrt(float(np.median(variance))), unit_label(fit.unit)
    if noise > np.spacing(np.max(np.abs(output))):
        return ""
    if math.isnan(noise):
        return (
            f"{fit.readings.file}: no fit of the model to these readings is finite: the output covers "
            f"{number(np.ptp(output))} {unit}, which the model cannot be. Check its unit, the nominal zero and scale "
            "(--unit, --nominal-zero, --nominal-scale)"
        )
    grid = rounding_step(output)
    rounded = f" It is rounded in steps of {grid:.3g} {unit}." if grid else ""
    return (
        f"{fit.readings.file}: a model of {len(fit.layout.blocks)} unknowns explains the output to its last digit in "
        f"all {len(output)} readings, which then show no noise and no uncertainty.{rounded} Record it with more digits"
    )


def unexpected_groups(subject: Subject) -> Iterator[Claim]:
    """Yield the group that the others predict worst, if beyond their uncertainty.

    An effect missing from the model is missing in every group, and counts as noise. There is one test per group.
    """
    out = subject.left_out
    if out is None or not np.isfinite(out.by_chance).any():
        return
    worst = int(np.nanargmin(out.by_chance))
    # Bonferroni correction: one test per group.
    beyond = out.by_chance[worst] * out.count < settings().holdout_p
    if beyond and (times := float(out.surprise[worst])) > limit("group.surprising", "ratio"):
        which = {"group": out.group.capitalize(), "member": out.members[worst]}
        yield Claim("group.surprising", out.group, **which, times=times, scheme=scheme(out.group))


def odd_thermometers(subject: Subject) -> Iterator[Claim]:
    """Yield anomalies in the columns of thermometers that the model depends on."""
    readings, model = subject.fit.readings, subject.first or subject.fit.model
    for anomaly in readings.oddities:
        if anomaly.column in model.columns and readings.unit(anomaly.column) == "degC":
            yield Claim("column.odd", anomaly.column, anomaly.code, said=anomaly.description)


def describes(noise: Noise, values: Mapping[str, Any]) -> bool:
    """Return whether correlated noise is so slow and large that it stands in for a missing effect."""
    white = values.get(WHITE, math.inf)
    return noise.lasting_deviation(values) > limit("noise.describes", "sd") * white


def slow(subject: Subject) -> Iterator[Claim]:
    fit = subject.fit
    noise, values = fit.model.noise, fit.problem.hyper(fit.mode.v)
    if not noise.independent and describes(noise, values):
        size = noise.lasting_deviation(values)
        numbers = {"size": size, "unit": fit.unit, "times": size / values[WHITE]}
        yield Claim("noise.describes", noise.name, words=noise.in_words, **numbers)


def scatter(subject: Subject) -> Iterator[Claim]:
    """Yield the noise law's failed leave-one-out tests."""
    check, rare = subject.check, limit("group.follows_column", "p")
    if along := [name for name, chance in check.scatter_with.items() if chance < rare]:
        yield Claim("noise.scatter", *along)
    elif check.one_sided < rare:
        yield Claim("noise.one_sided", p=check.one_sided)
    elif check.pit_p < rare:
        outside = f", {len(check.outliers)} of them outliers" if check.outliers else ""
        yield Claim("noise.tails", p=check.pit_p, outside=outside)


def dependence(subject: Subject) -> list[Claim]:
    """Return the covariate that residuals depend on; or that readings are too few to separate noise."""
    check = subject.check
    rows = [(e.log_bayes_factor, (e.against,)) for e in check.entries]
    rows += [(p.log_bayes_factor, p.against) for p in check.pairs]
    factor, depended = max(rows, default=(0.0, ()))
    claims = [*too_few(subject)]
    if not claims and factor > limit("residuals.depend", "nats"):
        claims = [Claim("residuals.depend", *depended, factor=factor, **subject.missing)]
    return claims


def steps_between_runs(subject: Subject) -> Iterator[Claim]:
    """Yield a function of time that only distinguishes runs: it predicts no new run."""
    fit = subject.fit
    for effect in fit.model.effects:
        if effect.kind in ("jump", "cycle") and effect.covariate == "time":
            added = fit.linear.contribution(effect.name)
            means, within = of_runs(fit, added)
            if only_between_runs(added - added.mean(), within):
                distance = float(np.ptp(means))
                yield Claim("runs.apart", effect.name, apart=distance, unit=fit.unit)
                return


def of_runs(fit: Fitted, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each run's mean, and each value's deviation from its run's mean."""
    _, codes = fit.readings.groups("run")
    means = np.bincount(codes, values) / np.bincount(codes)
    return means, values - means[codes]


def only_between_runs(values: np.ndarray, within: np.ndarray) -> bool:
    """Return whether values only distinguish runs: their sum of squares within runs is negligible."""
    return bool(np.sum(within**2) < limit("runs.apart", "within_share") * np.sum(values**2))


def not_finite(subject: Subject) -> Iterator[Claim]:
    """Yield a claim if the evidence is not finite."""
    evidence = subject.fit.log_evidence
    if evidence is not None and not math.isfinite(evidence[0]):
        yield Claim("evidence.not_finite")


def correlated(subject: Subject) -> Iterator[Claim]:
    """Yield a claim if neighbouring residuals are autocorrelated."""
    coefficient, z = subject.check.autocorrelation
    code = "noise.correlated"
    if abs(z) > limit(code, "z") and abs(coefficient) > limit(code, "coefficient"):
        yield Claim(code, coefficient=coefficient, z=z)
