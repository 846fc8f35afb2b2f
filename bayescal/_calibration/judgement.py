"""Acceptance checks of a fit: implausible values, and misfit in its own readings.

Each check is a function of a `Subject`; thresholds and messages: `claims.toml`. A search identifies missing effects.
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
from bayescal._core.parallel import run_on_one_thread
from bayescal._core.settings import settings
from bayescal._data.dataset_checks import find_rounding_step
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.density import Density
from bayescal._inference.laplace import draw_starts, find_mode, make_scan_grids
from bayescal._inference.newton import HessianGuess
from bayescal._inference.problem import Problem
from bayescal._model.effect import Effect
from bayescal._model.model import Model, why_untestable
from bayescal._model.noise_law import WHITE, Noise
from bayescal._model.parameters import bind
from bayescal._model.terms import ColumnSpec

PRIOR_CODE = "prior.contradicted"
FREE_SD_FACTOR = 1e3  # on a prior sd, to make the prior uninformative
MAX_STARTS = 3  # starting points of the search for a second mode


@dataclass(frozen=True)
class Subject:
    """A fit and the computations that its acceptance checks use."""

    fit: Fitted
    accepted: Collection[str] = ()  # coefficients or effects that may contradict their priors
    check: Any = None  # residual checks (`Check`); None if no check needs them
    leave_one_group_out: LeaveOneGroupOut | None = None  # None if no check needs it
    mode_claims: tuple[Claim, ...] = ()  # claims of `multimodality`
    first_model: Model | None = None  # first model of the search, whose thermometers are checked
    # Fields of claim "residuals.depend": its remedy and the names in it.
    remedy: Mapping[str, str] = field(default_factory=lambda: {"cure": "search"})

    def accepts(self, *names: str) -> bool:
        return not {*self.accepted}.isdisjoint(names)


def conflicts(subject: Subject) -> list[Claim]:
    """Return claims on contradictions between readings and priors, which do not depend on the residual checks."""
    means = {row["name"]: (row["mean"], 0.0) for row in summary(subject.fit)[0]}
    claims = [*_check_priors(subject, means), *find_widened_coefficients(subject)]
    return [*claims, *find_sds_beyond_range(subject), *find_implausible_curves(subject)]


def group_conflicts(subject: Subject) -> list[Claim]:
    """Return claims on implausible deviations of group members."""
    return [*find_implausible_members(subject), *find_members_following_terms(subject)]


def contradictions(
    fit: Fitted, noise_floor: float, accepted: Collection[str] = ()
) -> tuple[Claim, ...]:
    """Return claims that prevent a search: readings contradict the model's priors, or rounding exceeds the noise.

    noise_floor: noise sd that no smooth effect could explain, output unit. accepted: names that may contradict priors.
    """
    freed_names = (n for e in fit.model.effects if e.frees for n in (e.name, e.frees))
    subject = Subject(fit, {*accepted, *freed_names})
    claims = conflicts(subject) or find_contradicted_priors(subject)
    step = find_rounding_step(fit.readings["output"])
    if noise_floor < limit("output.rounded", "steps") * step:
        claims.append(Claim("output.rounded", grid=step, unit=fit.unit))
    return tuple(claims)


def residual_claims(subject: Subject) -> list[Claim]:
    """Return failed residual checks; a single claim if the fit did not converge or fixed coefficients are wrong."""
    verdict, evidence, check = subject.fit.verdict, subject.fit.log_evidence, subject.check
    if not verdict.ok:
        return [Claim("fit.not_converged", reasons=" ".join(verdict.reasons))]
    if check.contradicts_fixed:
        return [Claim("fixed.wrong", rms=check.rms, unit=check.unit, times=check.rms / check.noise)]
    is_infinite = evidence is not None and not math.isfinite(evidence[0])
    claims = [Claim("evidence.not_finite")] if is_infinite else []
    # A missing effect, which can cause the misfits after it, comes first.
    claims += [*subject.mode_claims, *find_dependence(subject), *find_slow_noise(subject)]
    claims += [*find_steps_between_runs(subject), *autocorrelation(subject)]
    return [*claims, *find_nonnormality(subject)]


def failures(subject: Subject) -> list[Claim]:
    """Return all failed checks of a fit outside a search."""
    claims = [*group_conflicts(subject), *residual_claims(subject)]
    return [*claims, *find_thermometer_anomalies(subject), *find_outlying_group(subject)]


def find_contradicted_priors(subject: Subject) -> list[Claim]:
    """Return claims on coefficients whose estimates under uninformative priors are far from their prior means.

    A strong prior that contradicts the readings inflates the noise instead of moving the coefficient. The biases and
    scale factors of the instrument's own effects are therefore fitted with prior sd a thousand times as large.
    """
    fit, instrument = subject.fit, subject.fit.model.instrument
    single = (e for e in instrument.effects if len(e.coefficients) == 1)
    freed_names = {e.name for e in single if instrument.slot(e.slot).unit in (instrument.unit, "1")}
    problem = Problem(fit.layout, fit.problem.record, dict.fromkeys(freed_names, FREE_SD_FACTOR))
    starts = [fit.mode.v, np.zeros_like(fit.mode.v)]
    guess = HessianGuess(fit.mode.v, np.linalg.pinv(fit.mode.covariance))
    mode = find_mode(problem, starts, fit.mode.x, xtol=0.01, guess=guess)
    _, posterior = Density(problem, mode.x, mode.flat, mode.v).condition_at(mode.v)
    if posterior is None:
        return []
    mean, width = posterior.mean, limit(PRIOR_CODE, "sd") * np.sqrt(np.diag(posterior.covariance))
    estimates = {
        u.name: (u.block.origin + float(mean[u.x]), float(width[u.x]))
        for u in fit.unknowns
        if u.x is not None and u.block is not None and u.effect in freed_names
    }
    return [*_check_priors(subject, estimates)]


def _check_priors(subject: Subject, values: Mapping[str, tuple[float, float]]) -> Iterator[Claim]:
    """Yield claims on estimates far from their prior means; `values`: name → (estimate, half-width of its interval)."""
    baseline_names = {e.name for e in subject.fit.model.instrument.effects}
    max_coefficients, max_z = limit(PRIOR_CODE, "coefficients"), limit(PRIOR_CODE, "sd")
    for u in subject.fit.unknowns:
        if u.block is None or u.prior_sd is None or u.held:
            continue
        effect, c = u.block.effect, u.block.coefficient
        if len(effect.coefficients) > max_coefficients or subject.accepts(effect.name, u.name):
            continue
        value, half_width = values.get(u.name, (c.mean, 0.0))
        z = abs(value - c.mean) / c.size
        size_factor = 1 if effect.name in baseline_names else limit(PRIOR_CODE, "candidate_sizes")
        if z - half_width / c.size > max_z * size_factor:
            cure = "scale" if effect.slot.partition("_")[0] == "scale" else "zero and scale"
            numbers = {"where": value, "mean": c.mean, "size": c.size, "unit": c.unit, "away": z}
            numbers |= {"fall": 0.5 * z**2, "cure": cure if effect.kind == "constant" else "units"}
            yield Claim(PRIOR_CODE, u.name, effect.name, **numbers)


def find_widened_coefficients(subject: Subject) -> Iterator[Claim]:
    """Yield claims on coefficients whose posterior is wider than the prior, unless a confounder is the cause."""
    keys = {name for confounder in subject.fit.confounders for name in confounder.coefficients}
    confounded_names = {u.name for u in subject.fit.unknowns if u.key in keys}
    # Coefficients only: a positive unknown may be larger than expected, and then wider.
    for row in summary(subject.fit)[0]:
        name, contraction = row["name"], row["contraction"]
        is_accepted = name in confounded_names or subject.accepts(name, row["effect"])
        if not is_accepted and (contraction or 0.0) < limit("prior.widened", "contraction"):
            yield Claim("prior.widened", name, contraction=contraction)


def find_sds_beyond_range(subject: Subject) -> Iterator[Claim]:
    """Yield a claim for each noise amplitude and between-group standard deviation that exceeds the output's range."""
    fit, sd_names = subject.fit, set(subject.fit.model.noise.amplitudes)
    for effect in fit.model.effects:
        for i, c in enumerate(effect.coefficients):
            if fit.model.instrument.slot(c.slot or effect.slot).unit == fit.unit:
                sd_names.add(effect.group_sd_name(i))
    # An amplitude that scales coefficients is weakly identified: `implausible_curves` tests its effect instead.
    sd_names -= {e.measure_name for e in fit.model.effects}
    output_range = float(np.ptp(fit.readings["output"]))
    for row in summary(fit)[1]:
        name, mean = row["name"], row["mean"]
        exceeds_range = name in sd_names and row["unit"] == fit.unit and mean > output_range > 0
        if exceeds_range and not subject.accepts(name, row["effect"]):
            yield Claim("size.beyond_output", name, mean=mean, reach=output_range, unit=fit.unit)


def find_implausible_curves(subject: Subject) -> Iterator[Claim]:
    """Yield claims on unknown dependences larger than all of the instrument's known effects together.

    They indicate a wrong sign or unit of an input, which a free curve over this input can fit.
    """
    fit, instrument, readings = subject.fit, subject.fit.model.instrument, subject.fit.readings
    curves = [e for e in fit.model.effects if e.is_placeholder and not subject.accepts(e.name)]
    if not curves:
        return
    # Prior standard deviation of the output over these readings, by the instrument's own effects, output unit.
    catalogue = (*instrument.effects, *instrument.candidates)
    effects = tuple(e for e in catalogue if why_untestable(e, readings) is None)
    layout = bind(Model(instrument, effects, fit.model.noise), readings)[0]
    problem = Problem(layout, fit.problem.record)
    hyper = problem.hyper(np.zeros(len(problem.hypers)))
    prior = problem.prior(hyper, np.ones(problem.size))
    prior_effects = problem.linearise(problem.start, hyper).jacobian * (prior.sd * prior.weight)
    prior_rms = float(np.sqrt(np.sum(np.var(prior_effects, axis=0))))
    for effect in curves:
        rms = float(np.std(fit.linear.contribution(effect.name)))
        if prior_rms and rms > limit("curve.beyond_known", "sizes") * prior_rms:
            yield Claim("curve.beyond_known", effect.name, here=rms, known=prior_rms, unit=fit.unit)


def find_implausible_members(subject: Subject) -> Iterator[Claim]:
    """Yield a claim on the member with the largest deviation in each group, if it is implausibly large.

    The estimated between-group standard deviation absorbs a wrong sign or unit of one member, which no other check
    reveals. Members absorb missing effects as well; the claim does not test for those.
    """
    fit = subject.fit
    rows = (r for r in summary(fit)[0] if not subject.accepts(r["name"], r["effect"]))
    means = {row["name"]: row["mean"] for row in rows}
    for b in fit.layout.blocks:
        c, members = b.coefficient, [n for n in b.member_names(fit.levels) if n in means]
        if c.group_sd is None or b.effect.weights is not None or not members:
            continue
        name = max(members, key=lambda n: abs(means[n] - c.mean))
        deviation = abs(means[name] - c.mean) / c.size
        if deviation > limit("group.too_different", "sizes"):
            numbers = {"where": means[name], "mean": c.mean, "size": c.size, "unit": c.unit}
            member_numbers = {"member": name, "group": c.per, "away": deviation}
            yield Claim("group.too_different", b.effect.name, **member_numbers, **numbers)


def find_members_following_terms(subject: Subject) -> Iterator[Claim]:
    """Yield claims on groups whose members' deviations correlate with a term of the same slot.

    A term has one coefficient, within and between members. With a late or noisy thermometer, the regression slope
    within members is attenuated, and the deviations absorb the slope between members: coefficient and uncertainty are
    too small, and the residuals show nothing. Random deviations are uncorrelated with the term.
    Source: Y. Mundlak, Econometrica 46 (1978) 69.
    """
    fit, record = subject.fit, subject.fit.problem.record
    means = {row["name"]: row["mean"] for row in summary(fit)[0]}
    linear_effects = (e for e in fit.model.effects if len(e.coefficients) == 1 and not e.shapes)
    terms = [e for e in linear_effects if e.varies and not e.coefficients[0].per]
    for b in (b for b in fit.layout.blocks if b.coefficient.per in record.codes):
        names = b.member_names(fit.levels)
        is_scalar = b.coefficient.group_sd is not None and b.effect.weights is None
        if not is_scalar or subject.accepts(b.effect.name) or not means.keys() >= {*names}:
            continue
        codes = record.codes[str(b.coefficient.per)]
        has_member, deviations = codes >= 0, np.array([means[name] for name in names])
        for term in (e for e in terms if e.slot == b.effect.slot and not subject.accepts(e.name)):
            column = record.columns(ColumnSpec.from_effect(term), ())[:, 0]
            sums = np.bincount(codes[has_member], column[has_member])
            term_means = sums / np.bincount(codes[has_member])
            if len(term_means) < 3 or not (np.ptp(term_means) and np.ptp(deviations)):
                continue
            r, p = correlation(term_means, deviations)
            if p < limit("group.follows_column", "p"):
                numbers = {"term": term.name, "along": term.varies, "group": b.coefficient.per}
                numbers |= {"r": r, "p": p, "members": len(names)}
                yield Claim("group.follows_column", b.effect.name, term.name, **numbers)


def correlation(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Return Pearson's correlation of two columns and its p-value under independence."""
    r, dof = float(np.corrcoef(first, second)[0, 1]), len(first) - 2
    t = abs(r) * np.sqrt(dof / np.float64((1 - r) * (1 + r))) if abs(r) < 1 else np.inf
    return r, float(2 * stdtr(dof, -t))


def check_reading_count(subject: Subject) -> Iterator[Claim]:
    """Yield a claim if readings are too few to separate an unstated noise from the unknowns."""
    fit, inclusion = subject.fit, subject.fit.inclusion
    # The number of unknowns; in an average over structures, its expectation.
    nuisances = {e.name for e in fit.model.instrument.nuisances}
    names = [b.effect.name for b in fit.layout.blocks if b.place in ("x", "phi")]
    unknown_count = round(sum(inclusion[name] for name in names if name not in nuisances))
    sufficient_count = unknown_count + limit("readings.too_few", "freedom")
    if len(fit.readings) < sufficient_count and fit.layout.phi_indices("noise"):
        yield Claim("readings.too_few", count=len(fit.readings), free=unknown_count)


def check_scale(effect: Effect, contribution: float, noise: float, unit: str) -> list[Claim]:
    """Return a claim if an effect's prior standard deviation is implausibly small or large in these readings.

    `contribution` is prior standard deviation times basis, the maximum over the readings, in the unit of the noise.
    Effects with a flat or hierarchical prior, or without columns, are not tested.
    """
    c = effect.coefficients[0]
    if not effect.columns or effect.is_placeholder or c.group_sd is not None or c.flat:
        return []
    low, high = (limit("effect.off_scale", end) for end in ("smallest", "largest"))
    if contribution == 0 or noise == 0 or low <= contribution / noise <= high:
        return []
    numbers = {"contribution": float(contribution), "noise": float(noise)}
    return [Claim("effect.off_scale", effect.name, **numbers, unit=unit, own=c.unit)]


@run_on_one_thread
def multimodality(fit: Fitted) -> list[Claim]:
    """Return claims that the Laplace approximation of the evidence is invalid: an indefinite Hessian, a second mode.

    A second mode has other nonlinear parameters and nearly the same evidence. The search for it starts from the prior
    draws of highest density and from grids along nonlinear parameters whose evidence has many maxima.
    """
    problem, mode = fit.problem, fit.mode
    if not math.isfinite(mode.log_evidence):
        return []
    if mode.indefinite:
        return [Claim("mode.indefinite")]
    shapes = [i for i, h in enumerate(problem.hypers) if h.kind == "shape"]
    sd = np.sqrt(np.diag(mode.covariance))

    def is_far(v: np.ndarray) -> np.ndarray:
        return np.abs(v - mode.v)[shapes] > limit("mode.two", "apart_sd") * sd[shapes]

    density = Density(problem, mode.x, mode.flat, mode.v)
    candidates = np.concatenate([draw_starts(problem), *make_scan_grids(problem, mode.v)])
    # The starts differ from the mode in the nonlinear parameters ("shapes") only.
    candidates = np.where(np.isin(np.arange(len(sd)), shapes), candidates, mode.v)
    starts = [v for v in candidates if is_far(v).any()] if shapes else []
    guess = HessianGuess(mode.v, np.linalg.pinv(mode.covariance), True)
    for start in np.array(starts)[np.argsort(-density.values(np.array(starts)))[:MAX_STARTS]]:
        floor = mode.log_density - 20.0
        second_mode = find_mode(problem, [start], mode.x, xtol=0.1, coarse_below=floor, guess=guess)
        log_bayes_factor = mode.log_evidence - second_mode.log_evidence
        if is_far(second_mode.v).any() and log_bayes_factor < limit("mode.two", "nats"):
            names = [problem.hypers[i].name for i in np.array(shapes)[is_far(second_mode.v)]]
            phi, phi2 = problem.hyper(mode.v), problem.hyper(second_mode.v)
            units = {h.name: h.unit for h in problem.hypers}
            values = tuple(f"{n} {number(phi[n])} or {number(phi2[n])} {units[n]}" for n in names)
            return [Claim("mode.two", *names, behind=log_bayes_factor, values=values)]
    return []


def explain_missing_noise(fit: Fitted) -> str:
    """Return a message if noise is below the output's precision or not finite, so that no check is possible; or ""."""
    output, variance = fit.readings["output"], fit.linear.variance
    noise, unit = math.sqrt(float(np.median(variance))), unit_label(fit.unit)
    if noise > np.spacing(np.max(np.abs(output))):
        return ""
    if math.isnan(noise):
        return (
            f"{fit.readings.file}: every fit of the model gave non-finite values: the output spans "
            f"{number(np.ptp(output))} {unit}, more than the model can represent. Check the output's unit, nominal "
            "zero and scale (--unit, --nominal-zero, --nominal-scale)"
        )
    step = find_rounding_step(output)
    rounding_text = f" The output is rounded in steps of {step:.3g} {unit}." if step else ""
    return (
        f"{fit.readings.file}: the model of {len(fit.layout.blocks)} unknowns fits all {len(output)} readings to the "
        f"last digit: noise and uncertainties cannot be estimated.{rounding_text} Record the output with more digits"
    )


def find_outlying_group(subject: Subject) -> Iterator[Claim]:
    """Yield a claim on the group with the largest leave-one-group-out error, if it is significant.

    An effect missing from the model is missing in every group, and inflates the noise of the reference.
    """
    loo = subject.leave_one_group_out
    if loo is None or not np.isfinite(loo.p_value).any():
        return
    worst_index = int(np.nanargmin(loo.p_value))
    is_significant = loo.p_value[worst_index] * loo.count < settings().holdout_p  # Bonferroni
    times, code = float(loo.error_ratio[worst_index]), "group.surprising"
    if is_significant and times > limit(code, "ratio"):
        numbers = {"times": times, "scheme": scheme(loo.group), "cure": subject.remedy["cure"]}
        if numbers["cure"] == "nothing" and depends_on_covariate(subject):
            numbers["cure"] = "lead"
        group, member = loo.group.capitalize(), loo.members[worst_index]
        yield Claim(code, loo.group, group=group, member=member, **numbers)


def find_thermometer_anomalies(subject: Subject) -> Iterator[Claim]:
    """Yield anomalies in the columns of thermometers that the model depends on."""
    readings, model = subject.fit.readings, subject.first_model or subject.fit.model
    for anomaly in readings.anomalies:
        if anomaly.column in model.columns and readings.unit(anomaly.column) == "degC":
            yield Claim("column.odd", anomaly.column, anomaly.code, said=anomaly.description)


def may_hide_effect(noise: Noise, values: Mapping[str, Any]) -> bool:
    """Return whether correlated noise is slow and large enough to represent a missing effect."""
    white_sd = values.get(WHITE, math.inf)
    return noise.lasting_deviation(values) > limit("noise.describes", "sd") * white_sd


def find_slow_noise(subject: Subject) -> Iterator[Claim]:
    fit = subject.fit
    noise, values = fit.model.noise, fit.problem.hyper(fit.mode.v)
    if not noise.independent and may_hide_effect(noise, values):
        deviation = noise.lasting_deviation(values)
        numbers = {"size": deviation, "unit": fit.unit, "times": deviation / values[WHITE]}
        yield Claim("noise.describes", noise.name, words=noise.in_words, **numbers)


def find_nonnormality(subject: Subject) -> Iterator[Claim]:
    """Yield a claim if leave-one-out residuals are not normal: heteroscedastic, one-sided or heavy-tailed."""
    check, threshold = subject.check, limit("group.follows_column", "p")
    if covariates := [name for name, p in check.scatter_with.items() if p < threshold]:
        yield Claim("noise.scatter", *covariates)
    elif check.one_sided < threshold:
        yield Claim("noise.one_sided", p=check.one_sided)
    elif check.pit_p < threshold:
        outlier_text = f", {len(check.outliers)} of them outliers" if check.outliers else ""
        remedy = "heavy" if check.excess_kurtosis > 0 else "light"
        remedy = "missing" if depends_on_covariate(subject) else remedy
        yield Claim("noise.tails", p=check.pit_p, outside=outlier_text, cure=remedy)


def depends_on_covariate(subject: Subject) -> bool:
    """Return whether residuals depend on a covariate, so that a missing effect can cause their other misfits."""
    return any(claim.code == "residuals.depend" for claim in find_dependence(subject))


def find_dependence(subject: Subject) -> list[Claim]:
    """Return a claim on the covariate on which residuals depend most, or one that there are too few readings."""
    check = subject.check
    rows = [(e.log_bayes_factor, (e.covariate,)) for e in check.entries]
    rows += [(p.log_bayes_factor, p.covariates) for p in check.pairs]
    factor, covariates = max(rows, default=(0.0, ()))
    claims = [*check_reading_count(subject)]
    if not claims and factor > limit("residuals.depend", "nats"):
        claims = [Claim("residuals.depend", *covariates, factor=factor, **subject.remedy)]
    return claims


def find_steps_between_runs(subject: Subject) -> Iterator[Claim]:
    """Yield a claim on an effect of time that is constant within runs, so that a new run cannot be predicted."""
    fit = subject.fit
    for effect in fit.model.effects:
        if effect.kind in ("jump", "cycle") and effect.covariate == "time":
            contribution = fit.linear.contribution(effect.name)
            means, deviations = split_by_run(fit, contribution)
            if is_between_runs_only(contribution - contribution.mean(), deviations):
                yield Claim("runs.apart", effect.name, apart=float(np.ptp(means)), unit=fit.unit)
                return


def split_by_run(fit: Fitted, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each run's mean, and each value's deviation from its run's mean."""
    _, codes = fit.readings.groups("run")
    means = np.bincount(codes, values) / np.bincount(codes)
    return means, values - means[codes]


def is_between_runs_only(values: np.ndarray, deviations: np.ndarray) -> bool:
    """Return whether the sum of squares within runs is a negligible part of the total."""
    return bool(np.sum(deviations**2) < limit("runs.apart", "within_share") * np.sum(values**2))


def autocorrelation(subject: Subject) -> Iterator[Claim]:
    """Yield a claim if neighbouring residuals are autocorrelated."""
    (coefficient, z), code = subject.check.autocorrelation, "noise.correlated"
    if abs(z) > limit(code, "z") and abs(coefficient) > limit(code, "coefficient"):
        cure = "missing" if depends_on_covariate(subject) else subject.remedy["cure"]
        yield Claim(code, coefficient=coefficient, z=z, cure=cure)
