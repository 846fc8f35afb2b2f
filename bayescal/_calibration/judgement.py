"""Acceptance checks of a fit: what it may not be, and what its own readings say against it.

Each is a function of a fit and what was computed to judge it, its thresholds and words in `claims.toml`. What is
missing from a model only a search tells; what it gets wrong shows in its residuals.
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
from bayescal._inference.laplace import across, find_mode, prior_draws
from bayescal._inference.newton import Nearby
from bayescal._inference.problem import Problem
from bayescal._model.effect import Effect
from bayescal._model.model import Model, testable
from bayescal._model.noise_law import WHITE, Noise
from bayescal._model.parameters import bind
from bayescal._model.terms import ColumnsOf

PRIOR = "prior.contradicted"
FREE_SIZES = 1e3  # times a plausible size, which is none any more
STARTS_TRIED = 3  # starts of the search for another mode


@dataclass(frozen=True)
class Subject:
    """A fit, and what was computed to judge it."""

    fit: Fitted
    accepted: Collection[str] = ()  # coefficients or effects that may contradict their priors
    noise_floor: float = math.inf  # noise that no model could remove, output unit
    check: Any = None  # its `Check`, where it fails; None, as `left_out`, where no check asks
    left_out: LeaveOneGroupOut | None = None  # each group predicted from the others
    doubts: tuple[Claim, ...] = ()  # of its mode
    first: Model | None = None  # that a search began with, whose thermometers count
    # What may be missing where residuals still depend on something: a cure, and what it names.
    missing: Mapping[str, str] = field(default_factory=lambda: {"cure": "search"})

    def accepts(self, *names: str) -> bool:
        return not {*self.accepted}.isdisjoint(names)


def conflicts(subject: Subject) -> list[Claim]:
    """Return what may not be, whatever the residuals: readings that contradict the model."""
    found = [*contradicted(subject), *widened(subject)]
    return [*found, *too_large(subject), *beyond_the_known(subject)]


def group_conflicts(subject: Subject) -> list[Claim]:
    """Return what members of groups may not be."""
    return [*too_different(subject), *following_members(subject)]


def wrong_question(
    fit: Fitted, noise_floor: float, accepted: Collection[str] = ()
) -> tuple[Claim, ...]:
    """Return why nothing can be learnt from a model: readings that contradict it, or rounded more than they vary."""
    freed = (n for e in fit.model.effects if e.frees for n in (e.name, e.frees))
    subject = Subject(fit, {*accepted, *freed}, noise_floor)
    found = conflicts(subject) or contradicted_alone(subject)
    return (*found, *rounded(subject))


def residual_claims(subject: Subject) -> list[Claim]:
    """Return what a fit's own residuals say against it; of one that did not converge, or is fixed to it, that alone."""
    if found := [*not_converged(subject)]:
        return found
    found += [*not_finite(subject), *subject.doubts, *describing(subject), *scattered(subject)]
    return [*found, *depending(subject), *steps_between_runs(subject), *correlated(subject)]


def against(subject: Subject) -> list[Claim]:
    """Return what stands against a fit that no search judged."""
    found = [*group_conflicts(subject), *residual_claims(subject)]
    return [*found, *odd_thermometers(subject), *surprising(subject)]


def not_converged(subject: Subject) -> Iterator[Claim]:
    verdict = subject.fit.verdict
    if not verdict.ok:
        yield Claim("fit.not_converged", reasons=" ".join(verdict.reasons))
    elif subject.check and (fixed := subject.check.fixed) and fixed.wrong:
        unit = subject.check.unit
        yield Claim("fixed.wrong", rms=fixed.rms, unit=unit, times=fixed.rms / fixed.noise)


def contradicted(subject: Subject) -> Iterator[Claim]:
    """Coefficients that stand far from their priors' means."""
    return _against_priors(subject, {r["name"]: (r["mean"], 0.0) for r in summary(subject.fit)[0]})


def contradicted_alone(subject: Subject) -> list[Claim]:
    """Where the readings by themselves would put the first model's coefficients, if that is far from their priors.

    A prior that the readings contradict strongly enough wins: the noise takes up what the coefficient may not, and the
    fit shows nothing. So biases and scale factors of the instrument's own effects get a thousand times their widths.
    """
    fit, instrument = subject.fit, subject.fit.model.instrument
    single = (e for e in instrument.effects if len(e.coefficients) == 1)
    own = {e.name for e in single if instrument.slot(e.slot).unit in (instrument.unit, "1")}
    problem = Problem(fit.layout, fit.problem.record, dict.fromkeys(own, FREE_SIZES))
    starts = [fit.mode.v, np.zeros_like(fit.mode.v)]
    near = Nearby(fit.mode.v, np.linalg.pinv(fit.mode.covariance))
    mode = find_mode(problem, starts, fit.mode.x, still=0.01, near=near)
    _, found = Density(problem, mode.x, mode.flat, mode.v).at(mode.v)
    if found is None:
        return []
    mean, error = found.mean, limit(PRIOR, "sd") * np.sqrt(np.diag(found.covariance))
    stands = {
        u.name: (u.block.origin + float(mean[u.x]), float(error[u.x]))
        for u in fit.unknowns
        if u.x is not None and u.block is not None and u.effect in own
    }
    return [*_against_priors(subject, stands)]


def _against_priors(subject: Subject, stands: Mapping[str, tuple[float, float]]) -> Iterator[Claim]:
    """Coefficients that stand far from their priors' means, each (where, by how much it may be off)."""
    baseline = {e.name for e in subject.fit.model.instrument.effects}
    most, far = limit(PRIOR, "coefficients"), limit(PRIOR, "sd")
    for u in subject.fit.unknowns:
        if u.block is None or u.prior_sd is None or u.held:
            continue
        effect, c = u.block.effect, u.block.coefficient
        if len(effect.coefficients) > most or subject.accepts(effect.name, u.name):
            continue
        where, give = stands.get(u.name, (c.mean, 0.0))
        away = abs(where - c.mean) / c.size
        sizes = 1 if effect.name in baseline else limit(PRIOR, "candidate_sizes")
        if away - give / c.size > far * sizes:
            cure = "scale" if effect.slot.partition("_")[0] == "scale" else "zero and scale"
            told = {"where": where, "mean": c.mean, "size": c.size, "unit": c.unit, "away": away}
            told |= {"fall": 0.5 * away**2, "cure": cure if effect.kind == "constant" else "units"}
            yield Claim(PRIOR, u.name, effect.name, **told)


def widened(subject: Subject) -> Iterator[Claim]:
    """Coefficients known worse than before, but for what a confounder widens."""
    keys = {name for one in subject.fit.confounders for name in one.coefficients}
    wider = {u.name for u in subject.fit.unknowns if u.key in keys}
    # Of coefficients alone: what is positive may well be larger than thought, and then wider.
    for row in summary(subject.fit)[0]:
        name, found = row["name"], row["contraction"]
        accepted = name in wider or subject.accepts(name, row["effect"])
        least = limit("prior.widened", "contraction")
        if not accepted and found is not None and found < least:
            yield Claim("prior.widened", name, contraction=found)


def too_large(subject: Subject) -> Iterator[Claim]:
    """Standard deviations of the output itself beyond its whole range: no lengths, places, times or relative ones."""
    fit = subject.fit
    sizes = set(fit.model.noise.amplitudes)
    for effect in fit.model.effects:
        for i, c in enumerate(effect.coefficients):
            if fit.model.instrument.slot(c.slot or effect.slot).unit == fit.unit:
                sizes.add(effect.group_sd_name(i))
    # An amplitude is a scale of coefficients, hardly told where there is one; what it makes of the output is judged.
    sizes -= {e.measure_name for e in fit.model.effects}
    reach = float(np.ptp(fit.readings["output"]))
    for row in summary(fit)[1]:
        of_output = row["name"] in sizes and row["unit"] == fit.unit and row["mean"] > reach > 0
        if of_output and not subject.accepts(row["name"], row["effect"]):
            told = {"mean": row["mean"], "reach": reach, "unit": fit.unit}
            yield Claim("size.beyond_output", row["name"], **told)


def beyond_the_known(subject: Subject) -> Iterator[Claim]:
    """Dependences without a name that are larger than all that is known of the instrument could make together.

    A wrong sign or unit of an input is no missing effect, though a free curve along that input follows it.
    """
    fit, instrument, readings = subject.fit, subject.fit.model.instrument, subject.fit.readings
    unnamed = [e for e in fit.model.effects if e.is_placeholder and not subject.accepts(e.name)]
    if not unnamed:
        return
    # How much the instrument's own effects plausibly change the output over these readings, rms, output unit.
    own = (*instrument.effects, *instrument.candidates)
    effects = tuple(e for e in own if testable(e, readings) is None)
    layout = bind(Model(instrument, effects, fit.model.noise), readings)[0]
    problem = Problem(layout, fit.problem.record)
    hyper = problem.hyper(np.zeros(len(problem.hypers)))
    prior = problem.prior(hyper, np.ones(problem.size))
    slopes = problem.linearise(problem.start, hyper).jacobian * (prior.sd * prior.weight)
    known = float(np.sqrt(np.sum(np.var(slopes, axis=0))))
    for effect in unnamed:
        here = float(np.std(fit.linear.contribution(effect.name)))
        if known and here > limit("curve.beyond_known", "sizes") * known:
            yield Claim("curve.beyond_known", effect.name, here=here, known=known, unit=fit.unit)


def rounded(subject: Subject) -> Iterator[Claim]:
    grid = rounding_step(subject.fit.readings["output"])
    if subject.noise_floor < limit("output.rounded", "steps") * grid:
        yield Claim("output.rounded", grid=grid, unit=subject.fit.unit)


def too_different(subject: Subject) -> Iterator[Claim]:
    """Members of a group that differ far more than is plausible: the worst of each group.

    A spread that is learned takes up any difference, so that a sign or a unit that is another in one of them shows
    nowhere else. Of a model that lacks an effect it says nothing: members take up what is missing.
    """
    fit = subject.fit
    rows = (r for r in summary(fit)[0] if not subject.accepts(r["name"], r["effect"]))
    stands = {row["name"]: row["mean"] for row in rows}
    for b in fit.layout.blocks:
        c = b.coefficient
        own = [n for n in b.member_names(fit.levels) if n in stands]
        if c.group_sd is None or b.effect.weights is not None or not own:
            continue
        name = max(own, key=lambda n: abs(stands[n] - c.mean))
        away = abs(stands[name] - c.mean) / c.size
        if away > limit("group.too_different", "sizes"):
            told = {"where": stands[name], "mean": c.mean, "size": c.size, "unit": c.unit}
            whose = {"member": name, "group": c.per, "away": away}
            yield Claim("group.too_different", b.effect.name, **whose, **told)


def following_members(subject: Subject) -> Iterator[Claim]:
    """Deviations of a group's members that follow what a term of the same slot follows.

    A term has one coefficient, within members as between them. Where a thermometer is late or noisy, the readings of
    a member deny what the members' means show, and their deviations take it up: the coefficient is of within alone,
    small and with a small uncertainty, and no residual is left. Deviations that are by chance follow nothing.
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
        own = record.codes[str(b.coefficient.per)]
        values = np.array([means[name] for name in names])
        for term in (e for e in single if e.slot == b.effect.slot and not subject.accepts(e.name)):
            column = record.columns(ColumnsOf.of(term), ())[:, 0]
            count = np.bincount(own[own >= 0], minlength=len(values))
            total = np.bincount(own[own >= 0], column[own >= 0], minlength=len(values))
            there = count > 0
            mean, deviations = total[there] / count[there], values[there]
            if len(mean) < 3 or not (np.ptp(mean) and np.ptp(deviations)):
                continue
            r, chance = correlation(mean, deviations)
            if chance < limit("group.follows_column", "p"):
                told = {"term": term.name, "along": term.varies, "group": b.coefficient.per}
                told |= {"r": r, "p": chance}
                names_of = b.effect.name, term.name
                yield Claim("group.follows_column", *names_of, **told, members=int(there.sum()))


def correlation(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Pearson's correlation of two columns, and its p-value if they are independent."""
    r, free = float(np.corrcoef(one, other)[0, 1]), len(one) - 2
    t = np.sqrt(free / np.float64((1 - r) * (1 + r))) if abs(r) < 1 else np.inf
    return r, float(2 * stdtr(free, -abs(r) * t))


def too_few(subject: Subject) -> Iterator[Claim]:
    """Readings too few to tell a noise that nobody stated from the unknowns."""
    fit, there = subject.fit, subject.fit.inclusion
    # Of an average over structures as many as there are on average.
    nuisances = {e.name for e in fit.model.instrument.nuisances}
    names = [b.effect.name for b in fit.layout.blocks if b.place in ("x", "phi")]
    free = round(sum(there[name] for name in names if name not in nuisances))
    enough = free + limit("readings.too_few", "freedom")
    if len(fit.readings) < enough and fit.layout.positions("noise"):
        yield Claim("readings.too_few", count=len(fit.readings), free=free)


def off_scale(effect: Effect, contribution: float, noise: float, unit: str) -> list[Claim]:
    """Return what to look at where an effect at its plausible size is far too small or large for these readings.

    Its contribution is prior size times basis, the largest over the readings, in the unit of the noise. Nothing is said
    of an effect without a fixed plausible size or a basis of columns.
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
def doubts_of_the_mode(fit: Fitted) -> list[Claim]:
    """Return why the Gaussian fit about a mode, on which the evidence stands, does not describe the posterior.

    The curvature is not positive definite; or shapes far from the mode's explain the readings nearly as well, which is
    looked for from the best of some prior draws, and along shapes whose evidence has many maxima.
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
    tried = np.concatenate([prior_draws(problem), *across(problem, mode.v)])
    # Another hill has other shapes: all else begins where it is.
    tried = np.where(np.isin(np.arange(len(sd)), shapes), tried, mode.v)
    starts = [v for v in tried if far(v).any()] if shapes else []
    near = Nearby(mode.v, np.linalg.pinv(mode.covariance), True)
    for start in np.array(starts)[np.argsort(-density.values(np.array(starts)))[:STARTS_TRIED]]:
        least = mode.log_density - 20.0
        other = find_mode(problem, [start], mode.x, still=0.1, wanted_from=least, near=near)
        behind = mode.log_evidence - other.log_evidence
        if far(other.v).any() and behind < limit("mode.two", "nats"):
            names = [problem.hypers[i].name for i in np.array(shapes)[far(other.v)]]
            here, there = problem.hyper(mode.v), problem.hyper(other.v)
            units = {h.name: h.unit for h in problem.hypers}
            values = tuple(f"{n} {number(here[n])} or {number(there[n])} {units[n]}" for n in names)
            return [Claim("mode.two", *names, behind=behind, values=values)]
    return []


def noiseless(fit: Fitted) -> str:
    """Return that a model explains readings to their last digit, or that no fit is finite; empty for others.

    There is no noise then to tell anything by, nor to check.
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


def surprising(subject: Subject) -> Iterator[Claim]:
    """A group that the others do not expect, although their uncertainty counts: something in it was different.

    What is missing from a model is missing in every group, and counts as their noise. There is a test for each group.
    """
    out = subject.left_out
    if out is None or not np.isfinite(out.by_chance).any():
        return
    worst = int(np.nanargmin(out.by_chance))
    # The largest of as many tests as there are groups: its p-value counts that often (C. Bonferroni).
    beyond = out.by_chance[worst] * out.count < settings().holdout_p
    if beyond and (times := float(out.surprise[worst])) > limit("group.surprising", "ratio"):
        which = {"group": out.group.capitalize(), "member": out.members[worst]}
        yield Claim("group.surprising", out.group, **which, times=times, scheme=scheme(out.group))


def odd_thermometers(subject: Subject) -> Iterator[Claim]:
    """What is odd in the column of a thermometer that the coefficients of a model hang on."""
    readings, model = subject.fit.readings, subject.first or subject.fit.model
    for one in readings.oddities:
        if one.column in model.columns and readings.unit(one.column) == "degC":
            yield Claim("column.odd", one.column, one.code, said=one.description)


def describes(noise: Noise, values: Mapping[str, Any]) -> bool:
    """Return whether correlated noise is so slow and large that it stands for something without a name."""
    white = values.get(WHITE, math.inf)
    return noise.lasting_deviation(values) > limit("noise.describes", "sd") * white


def describing(subject: Subject) -> Iterator[Claim]:
    fit = subject.fit
    noise, values = fit.model.noise, fit.problem.hyper(fit.mode.v)
    if not noise.independent and describes(noise, values):
        size = noise.lasting_deviation(values)
        told = {"size": size, "unit": fit.unit, "times": size / values[WHITE]}
        yield Claim("noise.describes", noise.name, words=noise.in_words, **told)


def scattered(subject: Subject) -> Iterator[Claim]:
    """What the leave-one-out tests say against the noise law."""
    check, rare = subject.check, limit("group.follows_column", "p")
    if along := [name for name, chance in check.scatter_with.items() if chance < rare]:
        yield Claim("noise.scatter", *along)
    elif check.one_sided < rare:
        yield Claim("noise.one_sided", p=check.one_sided)
    elif check.pit_p < rare:
        outside = f", {len(check.outliers)} of them outliers" if check.outliers else ""
        yield Claim("noise.tails", p=check.pit_p, outside=outside)


def depending(subject: Subject) -> list[Claim]:
    """What the residuals still depend on; or that readings are too few to tell noise from unknowns."""
    check = subject.check
    rows = [(e.log_bayes_factor, (e.against,)) for e in check.entries]
    rows += [(p.log_bayes_factor, p.against) for p in check.pairs]
    factor, depended = max(rows, default=(0.0, ()))
    found = [*too_few(subject)]
    if not found and factor > limit("residuals.depend", "nats"):
        found = [Claim("residuals.depend", *depended, factor=factor, **subject.missing)]
    return found


def steps_between_runs(subject: Subject) -> Iterator[Claim]:
    """A function of time that only tells runs apart: of which of them a new run would be is not known."""
    fit = subject.fit
    for effect in fit.model.effects:
        if effect.kind in ("jump", "cycle") and effect.covariate == "time":
            added = fit.linear.contribution(effect.name)
            means, within = of_runs(fit, added)
            if only_between_runs(added - added.mean(), within):
                apart = float(np.ptp(means))
                yield Claim("runs.apart", effect.name, apart=apart, unit=fit.unit)
                return


def of_runs(fit: Fitted, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of each run, and what a value of each reading is more than its run's."""
    _, codes = fit.readings.groups("run")
    means = np.bincount(codes, values) / np.bincount(codes)
    return means, values - means[codes]


def only_between_runs(values: np.ndarray, within: np.ndarray) -> bool:
    """Return whether values do nothing but tell runs apart: next to none of their squares are those within runs."""
    return bool(np.sum(within**2) < limit("runs.apart", "within_share") * np.sum(values**2))


def not_finite(subject: Subject) -> Iterator[Claim]:
    """Evidence that is no number."""
    evidence = subject.fit.log_evidence
    if evidence is not None and not math.isfinite(evidence[0]):
        yield Claim("evidence.not_finite")


def correlated(subject: Subject) -> Iterator[Claim]:
    """Neighbouring residuals that are no independent noise."""
    coefficient, z = subject.check.autocorrelation
    code = "noise.correlated"
    if abs(z) > limit(code, "z") and abs(coefficient) > limit(code, "coefficient"):
        yield Claim(code, coefficient=coefficient, z=z)
