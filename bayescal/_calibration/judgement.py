"""Acceptance checks of a fit: what it may not be, and what its own readings say against it.

Each is a function of a fit and what was computed to judge it, with its limits and the codes of its claims in one of
the tables at the end. What is missing from a model only a search tells; what it gets wrong shows in its residuals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtr

from bayescal._calibration.check_result import Check
from bayescal._calibration.claim import Claim
from bayescal._calibration.fitted import Fitted
from bayescal._calibration.leave_group_out import LeaveOneGroupOut, scheme
from bayescal._calibration.mixture import inclusion
from bayescal._calibration.summary import summary
from bayescal._core.formatting import number
from bayescal._core.parallel import on_one_thread
from bayescal._core.settings import settings
from bayescal._data.dataset_checks import rounding_step
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.density import Density
from bayescal._inference.laplace import across, find_mode, prior_draws
from bayescal._inference.problem import Problem
from bayescal._model.effect import Effect
from bayescal._model.model import Model, testable
from bayescal._model.noise_law import WHITE, Noise
from bayescal._model.parameters import bind
from bayescal._model.prior import LogUniform
from bayescal._model.terms import ColumnsOf

# p-value of a test that asks once for each covariate and in every step: hundreds in one session.
RARE_P = 1e-5
FREE_SIZES = 1e3  # times a plausible size, which is none any more
# Allan deviation of correlated noise over a tenth to a half of a run, in standard deviations of a reading's own noise,
# from which it describes how the output goes, as a curve does: bias instability of sensors at rest stays below.
DESCRIBING_SD = 2.5
# Share of the squares of a step between runs, that lie within runs where it is one between them.
WITHIN_RUNS_SHARE = 0.05
# Standard deviations of the lag-1 autocorrelation, above which noise is not what its law says; one record in 30,000 by
# chance.
CORRELATED_SD = 4.0
# Times the noise: what contributes less or more at a plausible size is in a wrong unit.
SCALE_RANGE = (1e-6, 1e6)
# Coefficients of an effect whose sizes are judged; more of them stand for a function, whose values are not sizes of a
# law.
LAW_COEFFICIENTS = 2
STARTS_TRIED = 3  # starts of the search for another mode
PRIOR = "prior.contradicted"


@dataclass(frozen=True)
class Subject:
    """A fit, and what was computed to judge it.

    Attributes:
        fit: the fit.
        accepted: coefficients or effects that may contradict their priors.
        noise_floor: noise that no model could remove, output unit.
        check: where the fit fails; None, as `left_out`, where no check asks.
        left_out: each group predicted from the others.
        doubts: of its mode.
        first: the model that a search began with, whose thermometers count.
        missing: what may be missing where residuals still depend on something: a cure, and what it names.
    """

    fit: Fitted
    accepted: Collection[str] = ()
    noise_floor: float = math.inf
    check: Check | Any = None
    left_out: LeaveOneGroupOut | None = None
    doubts: tuple[Claim, ...] = ()
    first: Model | None = None
    missing: Mapping[str, str] = field(default_factory=lambda: {"cure": "search"})

    def accepts(self, *names: str) -> bool:
        return not {*self.accepted}.isdisjoint(names)


class AcceptanceCheck(NamedTuple):
    """A test with its limits.

    Attributes:
        codes: of the claims that it makes, with spaces between.
        test: makes them, of a subject (of a search: its steps) and the limits.
        limits: by name, as the table gives them.
    """

    codes: str
    test: Callable[..., Iterable[Claim]]
    limits: Mapping[str, float] = {}


def claims(checks: Iterable[AcceptanceCheck], subject: Any) -> list[Claim]:
    """Return all that some checks say of a subject, in their order."""
    return [claim for one in checks for claim in one.test(subject, **one.limits)]


def wrong_question(
    fit: Fitted, noise_floor: float, accepted: Collection[str] = ()
) -> tuple[Claim, ...]:
    """Return why nothing can be learnt from a model: readings that contradict it, or rounded more than they vary."""
    free = [e for e in fit.model.effects if e.frees]
    freed = (n for e in free for n in (e.name, e.frees))
    subject = Subject(fit, {*accepted, *freed}, noise_floor)
    found = claims(CONFLICTS, subject) or claims(WITHOUT_PRIORS, subject)
    return (*found, *claims(ROUNDING, subject))


def residual_claims(subject: Subject) -> list[Claim]:
    """Return what a fit's own residuals say against it; of one that did not converge, or is fixed to it, that alone."""
    return claims(CONVERGENCE, subject) or claims(RESIDUALS, subject)


def not_converged(subject: Subject) -> Iterator[Claim]:
    verdict = subject.fit.verdict
    if not verdict.ok:
        yield Claim("fit.not_converged", reasons=" ".join(verdict.reasons))
    elif subject.check and (fixed := subject.check.fixed) and fixed.wrong:
        unit = subject.check.unit
        yield Claim("fixed.wrong", rms=fixed.rms, unit=unit, times=fixed.rms / fixed.noise)


# What a fit may not be -------------------------------------------------------------------------------------------


def contradicted(subject: Subject, sd: float, candidate_sizes: float) -> Iterator[Claim]:
    """Coefficients that stand far from their priors' means."""
    stands = {row["name"]: (row["mean"], 0.0) for row in summary(subject.fit)[0]}
    yield from _against_priors(subject, stands, sd, candidate_sizes)


def contradicted_alone(subject: Subject, sd: float, candidate_sizes: float) -> Iterator[Claim]:
    """Where the readings by themselves would put the first model's coefficients, if that is far from their priors.

    A prior that the readings contradict strongly enough wins: the noise takes up what the coefficient may not, and the
    fit shows nothing. So biases and scale factors of the instrument's own effects get a thousand times their widths.
    """
    fit, instrument = subject.fit, subject.fit.model.instrument
    own = {
        e.name
        for e in instrument.effects
        if len(e.coefficients) == 1 and instrument.slot(e.slot).unit in (instrument.unit, "1")
    }
    problem = Problem(fit.layout, fit.problem.record, dict.fromkeys(own, FREE_SIZES))
    there = fit.mode
    starts = [there.v, np.zeros_like(there.v)]
    mode = find_mode(problem, starts, there.x, still=0.01)
    _, found = Density(problem, mode.x, mode.flat, mode.v).at(mode.v)
    if found is None:
        return
    mean, error = found.mean, np.sqrt(np.diag(found.covariance))
    stands = {
        u.name: (u.block.origin + float(mean[u.x]), sd * float(error[u.x]))
        for u in fit.unknowns
        if u.x is not None and u.block is not None and u.effect in own
    }
    yield from _against_priors(subject, stands, sd, candidate_sizes)


def _against_priors(
    subject: Subject, stands: Mapping[str, tuple[float, float]], sd: float, candidate_sizes: float
) -> Iterator[Claim]:
    """Coefficients that stand far from their priors' means, each (where, by how much it may be off)."""
    baseline = {e.name for e in subject.fit.model.instrument.effects}
    for u in subject.fit.unknowns:
        if u.block is None or u.prior_sd is None:
            continue
        effect, c = u.block.effect, u.block.coefficient
        law = len(effect.coefficients) <= LAW_COEFFICIENTS
        if u.held or not law or subject.accepts(effect.name, u.name):
            continue
        where, give = stands.get(u.name, (c.mean, 0.0))
        away = abs(where - c.mean) / c.size
        if away - give / c.size > sd * (1 if effect.name in baseline else candidate_sizes):
            sizes = {"where": where, "mean": c.mean, "size": c.size, "unit": c.unit}
            sizes |= {"away": away, "fall": 0.5 * away**2}
            cure = "scale" if effect.quantity == "scale" else "zero and scale"
            cure = cure if effect.kind == "constant" else "units"
            yield Claim(PRIOR, u.name, effect.name, **sizes, cure=cure)


def widened(subject: Subject, contraction: float) -> Iterator[Claim]:
    """Coefficients known worse than before, but for what a confounder widens."""
    keys = {name for one in subject.fit.confounders for name in one.coefficients}
    wider = {u.name for u in subject.fit.unknowns if u.key in keys}
    for row in summary(subject.fit)[
        0
    ]:  # what is positive may well be larger than thought, and then wider
        name, found = row["name"], row["contraction"]
        if name in wider or subject.accepts(name, row["effect"]) or found is None:
            continue
        if found < contraction:
            yield Claim("prior.widened", name, contraction=found)


def too_large(subject: Subject, records: float) -> Iterator[Claim]:
    """Sizes of the output's quantity beyond its whole range, times of the model beyond some records."""
    fit, rows = subject.fit, summary(subject.fit)[1]
    rows = [r for r in rows if not subject.accepts(r["name"], r["effect"])]
    reach, sizes = float(np.ptp(fit.readings["output"])), _sizes_of_output(fit)
    # An amplitude is a scale of coefficients, hardly told where there is one; what it makes of the output is judged.
    amplitudes = {e.measure_name for e in fit.model.effects}
    for row in rows:
        if (
            row["name"] in sizes - amplitudes
            and row["unit"] == fit.unit
            and row["mean"] > reach > 0
        ):
            told = {"mean": row["mean"], "reach": reach, "unit": fit.unit}
            yield Claim("size.beyond_output", row["name"], **told)
    record = float(np.ptp(fit.readings["time"])) if fit.readings.has("time") else 0.0
    bounded = {h.name for h in fit.layout.hypers if isinstance(h.prior, LogUniform)}  # by a run
    for row in rows:
        of_time = row["unit"] == "s" and row["name"] not in sizes | bounded
        if of_time and record > 0 and row["mean"] > records * record:
            yield Claim("time.beyond_record", row["name"], mean=row["mean"], records=records)


def _sizes_of_output(fit: Fitted) -> set[str]:
    """Names of standard deviations and amplitudes of the output itself: no lengths, places, times or relative ones."""
    sizes = set(fit.model.noise.amplitudes)
    for effect in fit.model.effects:
        for i, c in enumerate(effect.coefficients):
            if fit.model.instrument.slot(c.slot or effect.slot).unit == fit.unit:
                sizes |= {effect.group_sd_name(i), effect.measure_name}
    return sizes


def beyond_the_known(subject: Subject, sizes: float) -> Iterator[Claim]:
    """Dependences without a name that are larger than all that is known of the instrument could make together.

    A wrong sign or unit of an input is no missing effect, though a free curve along that input follows it.
    """
    fit = subject.fit
    unnamed = [e for e in fit.model.effects if e.is_placeholder and not subject.accepts(e.name)]
    known = _known_effects(fit) if unnamed else 0.0
    for effect in unnamed:
        here = float(np.std(fit.linear.contribution(effect.name)))
        if known and here > sizes * known:
            yield Claim("curve.beyond_known", effect.name, here=here, known=known, unit=fit.unit)


def _known_effects(fit: Fitted) -> float:
    """How much the instrument's own effects plausibly change the output over these readings, rms, output unit."""
    model, readings = fit.model, fit.readings
    own = (*model.instrument.effects, *model.instrument.candidates)
    effects = tuple(e for e in own if testable(e, readings) is None)
    layout = bind(Model(model.instrument, effects, model.noise), readings)[0]
    problem = Problem(layout, fit.problem.record)
    hyper = problem.hyper(np.zeros(len(problem.hypers)))
    prior = problem.prior(hyper, np.ones(problem.size))
    slopes = problem.linearise(problem.start, hyper).jacobian * (prior.sd * prior.weight)
    return float(np.sqrt(np.sum(np.var(slopes, axis=0))))


def rounded(subject: Subject, steps: float) -> Iterator[Claim]:
    grid = rounding_step(subject.fit.readings["output"])
    if subject.noise_floor < steps * grid:
        yield Claim("output.rounded", grid=grid, unit=subject.fit.unit)


def too_different(subject: Subject, sizes: float) -> Iterator[Claim]:
    """Members of a group that differ far more than is plausible: the worst of each group.

    A spread that is learned takes up any difference, so that a sign or a unit that is another in one of them shows
    nowhere else. Of a model that lacks an effect it says nothing: members take up what is missing.
    """
    fit = subject.fit
    stands = {
        row["name"]: row["mean"]
        for row in summary(fit)[0]
        if not subject.accepts(row["name"], row["effect"])
    }
    for b in fit.layout.blocks:
        c = b.coefficient
        own = [n for n in b.member_names(fit.levels) if n in stands]
        if c.group_sd is None or b.effect.weights is not None or not own:
            continue
        name = max(own, key=lambda n: abs(stands[n] - c.mean))
        away = abs(stands[name] - c.mean) / c.size
        if away > sizes:
            told = {"where": stands[name], "mean": c.mean, "size": c.size, "unit": c.unit}
            whose = {"member": name, "group": c.per, "away": away}
            yield Claim("group.too_different", b.effect.name, **whose, **told)


def following_members(subject: Subject, p: float) -> Iterator[Claim]:
    """Deviations of a group's members that follow what a term of the same slot follows.

    A term has one coefficient, within members as between them. Where a thermometer is late or noisy, the readings of
    a member deny what the members' means show, and their deviations take it up: the coefficient is of within alone,
    small and with a small uncertainty, and no residual is left. Deviations that are by chance follow nothing.
    Source: Y. Mundlak, Econometrica 46 (1978) 69.
    """
    fit = subject.fit
    means = {row["name"]: row["mean"] for row in summary(fit)[0]}
    codes = fit.problem.record.codes
    for b in (b for b in fit.layout.blocks if b.coefficient.per in codes):
        names = b.member_names(fit.levels)
        plain = b.coefficient.group_sd is not None and b.effect.weights is None
        if not plain or subject.accepts(b.effect.name) or not means.keys() >= {*names}:
            continue
        own, values = codes[str(b.coefficient.per)], np.array([means[name] for name in names])
        for term in fit.model.effects:
            one = len(term.coefficients) == 1 and not (term.shapes or term.coefficients[0].per)
            if (
                not (one and term.varies)
                or term.slot != b.effect.slot
                or subject.accepts(term.name)
            ):
                continue
            column = fit.problem.record.columns(ColumnsOf.of(term), ())[:, 0]
            count = np.bincount(own[own >= 0], minlength=len(values))
            total = np.bincount(own[own >= 0], column[own >= 0], minlength=len(values))
            there = count > 0
            mean, own_values = total[there] / count[there], values[there]
            if (chance := uncorrelated(mean, own_values)) < p:
                r = float(np.corrcoef(mean, own_values)[0, 1])
                told = {"term": term.name, "along": term.varies, "group": b.coefficient.per}
                told |= {"r": r, "p": chance, "members": int(there.sum())}
                yield Claim("group.follows_column", b.effect.name, term.name, **told)


def uncorrelated(one: np.ndarray, other: np.ndarray) -> float:
    """Return the p-value of two uncorrelated columns, by Student's t; not a number where one is constant."""
    free = len(one) - 2
    if np.ptp(one) == 0 or np.ptp(other) == 0 or free < 1:
        return float("nan")
    r = float(np.clip(np.corrcoef(one, other)[0, 1], -1, 1))
    with np.errstate(divide="ignore"):
        return float(2 * stdtr(free, -abs(r) * np.sqrt(free / np.float64((1 - r) * (1 + r)))))


def too_few(subject: Subject, freedom: float) -> Iterator[Claim]:
    """Readings too few to tell a noise that nobody stated from the unknowns."""
    fit, there = subject.fit, inclusion(subject.fit)
    # Of an average over structures as many as there are on average.
    nuisances = {e.name for e in fit.model.instrument.nuisances}
    names = [b.effect.name for b in fit.layout.blocks if b.place in ("x", "phi")]
    free = round(sum(there[name] for name in names if name not in nuisances))
    size = len(fit.readings)
    if size < free + freedom and fit.layout.positions("noise"):
        yield Claim("readings.too_few", count=size, free=free)


def off_scale(effect: Effect, contribution: float, noise: float, unit: str) -> list[Claim]:
    """Return what to look at where an effect at its plausible size is far too small or large for these readings.

    Args:
        effect: with a fixed plausible size and a basis of columns; nothing is said of others.
        contribution: prior size times basis, the largest over the readings, in `unit`.
        noise: standard deviation, likewise.
    """
    first = effect.coefficients[0]
    if not effect.columns or effect.is_placeholder or first.group_sd is not None or first.flat:
        return []
    low, high = SCALE_RANGE
    if contribution == 0 or noise == 0 or low <= contribution / noise <= high:
        return []
    sizes = {"contribution": float(contribution), "noise": float(noise)}
    return [Claim("effect.off_scale", effect.name, **sizes, unit=unit, own=first.unit)]


def effects_off_scale(fit: Fitted) -> tuple[Claim, ...]:
    """Return `off_scale` of the effects of a fitted model; nothing where its readings are too few."""
    line, found = fit.linear, list[Claim]()
    noise = math.sqrt(float(np.median(line.variance)))
    for effect in fit.model.effects if not claims(FEW, Subject(fit)) else ():
        own = [i for i in range(fit.layout.size) if line.owners[i] == effect.name]
        if own:
            most = float(np.max(np.abs(line.nuisance[:, own])))
            found += off_scale(effect, most, noise, fit.unit)
    return tuple(found)


@on_one_thread
def doubts_of_the_mode(fit: Fitted, apart_sd: float = 3.0, nearly_nats: float = 3.0) -> list[Claim]:
    """Return why the Gaussian fit about a mode, on which the evidence stands, does not describe the posterior.

    The curvature is not positive definite; or shapes far from the mode's explain the readings nearly as well, which is
    looked for from the best of some prior draws, and along shapes whose evidence has many maxima.

    Args:
        fit: the fit.
        apart_sd: standard deviations between two modes, from which one does not describe the other.
        nearly_nats: between two modes, below which one does not stand for both.
    """
    problem, mode = fit.problem, fit.mode
    if not math.isfinite(mode.log_evidence):
        return []
    if mode.indefinite:
        return [Claim("mode.indefinite")]
    shapes = [i for i, h in enumerate(problem.hypers) if h.kind == "shape"]
    sd = np.sqrt(np.diag(mode.covariance))

    def far(v: np.ndarray) -> np.ndarray:
        return np.abs(v - mode.v)[shapes] > apart_sd * sd[shapes]

    density = Density(problem, mode.x, mode.flat, mode.v)
    tried = np.concatenate([prior_draws(problem), *across(problem, mode.v)])
    starts = [v for v in tried if far(v).any()] if shapes else []
    for start in np.array(starts)[np.argsort(-density.values(np.array(starts)))[:STARTS_TRIED]]:
        other = find_mode(problem, [start], mode.x, still=0.01)
        behind = mode.log_evidence - other.log_evidence
        if far(other.v).any() and behind < nearly_nats:
            apart = (problem.hypers[i] for i in np.array(shapes)[far(other.v)])
            here, there = problem.hyper(mode.v), problem.hyper(other.v)
            values = {
                h.name: f"{h.name} {number(here[h.name])} or {number(there[h.name])} {h.unit}"
                for h in apart
            }
            return [Claim("mode.two", *values, behind=behind, values=tuple(values.values()))]
    return []


# What a fit's own readings say against it ------------------------------------------------------------------------


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


def surprising(subject: Subject, ratio: float) -> Iterator[Claim]:
    """A group that the others do not expect, although their uncertainty counts: something in it was different.

    What is missing from a model is missing in every group, and counts as their noise. There is a test for each group.
    """
    out = subject.left_out
    if out is None or not np.isfinite(out.by_chance).any():
        return
    worst = int(np.nanargmin(out.by_chance))
    # The largest of as many tests as there are groups: its p-value counts that often (C. Bonferroni).
    beyond = out.by_chance[worst] * out.count < settings().holdout_p
    if beyond and (times := float(out.surprise[worst])) > ratio:
        which = {"group": out.group.capitalize(), "member": out.members[worst]}
        yield Claim("group.surprising", out.group, **which, times=times, scheme=scheme(out.group))


def odd_thermometers(subject: Subject) -> Iterator[Claim]:
    """What is odd in the column of a thermometer that the coefficients of a model hang on."""
    readings, model = subject.fit.readings, subject.first or subject.fit.model
    for one in readings.oddities:
        if one.column in model.columns and readings.unit(one.column) == "degC":
            yield Claim("column.odd", one.column, one.code, said=one.said)


def evidence_not_finite(subject: Subject) -> Iterator[Claim]:
    evidence = subject.fit.log_evidence
    if evidence is not None and not math.isfinite(evidence[0]):
        yield Claim("evidence.not_finite")


def describes(noise: Noise, values: Mapping[str, Any], sd: float = DESCRIBING_SD) -> bool:
    """Return whether correlated noise is so slow and large that it stands for something without a name."""
    return noise.lasting_deviation(values) > sd * values.get(WHITE, math.inf)


def describing(subject: Subject, sd: float) -> Iterator[Claim]:
    fit = subject.fit
    noise, values = fit.model.noise, fit.problem.hyper(fit.mode.v)
    if not noise.independent and describes(noise, values, sd):
        size = noise.lasting_deviation(values)
        told = {"size": size, "unit": fit.unit, "times": size / values[WHITE]}
        yield Claim("noise.describes", noise.name, words=noise.in_words, **told)


def scattered(subject: Subject, p: float) -> Iterator[Claim]:
    """What the leave-one-out tests say against the noise law."""
    check = subject.check
    if along := [name for name, chance in check.scatter_with.items() if chance < p]:
        yield Claim("noise.scatter", *along)
    elif check.one_sided < p:
        yield Claim("noise.one_sided", p=check.one_sided)
    elif check.pit_p < p:
        outside = f", {len(check.outliers)} of them outliers" if check.outliers else ""
        yield Claim("noise.tails", p=check.pit_p, outside=outside)


def depending(subject: Subject, nats: float) -> Iterator[Claim]:
    """What the residuals still depend on; or that readings are too few to tell noise from unknowns."""
    check = subject.check
    few = claims(FEW, subject)
    rows = [(e.log_bayes_factor, (e.against,)) for e in check.entries]
    rows += [(p.log_bayes_factor, p.against) for p in check.pairs]
    factor, against = max(rows, default=(0.0, ()))
    yield from few
    if not few and factor > nats:
        yield Claim("residuals.depend", *against, factor=factor, **subject.missing)


def steps_between_runs(subject: Subject, within_share: float) -> Iterator[Claim]:
    """A function of time that only tells runs apart: of which of them a new run would be is not known."""
    fit = subject.fit
    for effect in fit.model.effects:
        if effect.kind in ("jump", "cycle") and effect.covariate == "time":
            added = fit.linear.contribution(effect.name)
            means, within = of_runs(fit, added)
            if only_between_runs(added - added.mean(), within, within_share):
                apart = float(np.ptp(means))
                yield Claim("runs.apart", effect.name, apart=apart, unit=fit.unit)
                return


def of_runs(fit: Fitted, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of each run, and what a value of each reading is more than its run's."""
    _, codes = fit.readings.groups("run")
    means = np.bincount(codes, values) / np.bincount(codes)
    return means, values - means[codes]


def only_between_runs(
    values: np.ndarray, within: np.ndarray, share: float = WITHIN_RUNS_SHARE
) -> bool:
    """Return whether values do nothing but tell runs apart: next to none of their squares are those within runs."""
    return bool(np.sum(within**2) < share * np.sum(values**2))


def correlated(subject: Subject, sd: float, coefficient: float) -> Iterator[Claim]:
    found, z = subject.check.autocorrelation
    if abs(z) > sd and abs(found) > coefficient:
        yield Claim("noise.correlated", coefficient=found, z=z)


# The tables ------------------------------------------------------------------------------------------------------

A = AcceptanceCheck
# Prior standard deviations from the prior's mean, beyond which readings and prior contradict each other; a candidate's
# plausible size is known to an order of magnitude.
AWAY = {"sd": 4.0, "candidate_sizes": 10.0}
CONFLICTS = (
    A(PRIOR, contradicted, AWAY),
    # Below −1 the posterior is wider than the prior can be.
    A("prior.widened", widened, {"contraction": -1.0}),
    A("size.beyond_output time.beyond_record", too_large, {"records": 10.0}),
    A("curve.beyond_known", beyond_the_known, {"sizes": 4.0}),
)
WITHOUT_PRIORS = (A(PRIOR, contradicted_alone, AWAY),)
# Noise of 0.3 steps leaves a staircase of 0.05 (B. Widrow and I. Kollár, Quantization Noise, 2008), with the rounding's
# own 1/√12.
ROUNDING = (A("output.rounded", rounded, {"steps": 0.42}),)
GROUPS = (
    A("group.too_different", too_different, {"sizes": 40.0}),  # known to an order of magnitude
    A("group.follows_column", following_members, {"p": RARE_P}),
)
FEW = (A("readings.too_few", too_few, {"freedom": 3}),)
THERMOMETERS = (A("column.odd", odd_thermometers),)
LEFT_OUT = (A("group.surprising", surprising, {"ratio": 3.0}),)  # times what the others expect
CONVERGENCE = (A("fit.not_converged fixed.wrong", not_converged),)
RESIDUALS = (
    A("evidence.not_finite", evidence_not_finite),
    A("mode.indefinite mode.two", lambda subject: subject.doubts),
    A("noise.describes", describing, {"sd": DESCRIBING_SD}),
    A("noise.scatter noise.one_sided noise.tails", scattered, {"p": RARE_P}),
    # Twice what is very strong, since the largest of many covariates counts.
    A("readings.too_few residuals.depend", depending, {"nats": 10.0}),
    A("runs.apart", steps_between_runs, {"within_share": WITHIN_RUNS_SHARE}),
    # A smaller coefficient changes no standard uncertainty by more than a tenth.
    A("noise.correlated", correlated, {"sd": CORRELATED_SD, "coefficient": 0.1}),
)
