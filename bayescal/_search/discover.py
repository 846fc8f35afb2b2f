"""Which effect is missing: the posterior over structures that hold the fitted model's effects."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.claim import Claim
from bayescal._calibration.fit import fit
from bayescal._calibration.sensor_noise import SHOWN_PROBABILITY
from bayescal._core import deadline
from bayescal._core.errors import InputError, ModelError
from bayescal._core.formatting import folded, number, probability, with_error
from bayescal._core.renamed import renamed
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.linear_model import amplitude_range, fill_amplitudes
from bayescal._inference.method import Method
from bayescal._inference.record import record_of
from bayescal._model.effect import READING, Effect, with_forms
from bayescal._model.frame import Reference, list_covariates
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model, why_untestable
from bayescal._model.noise_law import Noise
from bayescal._model.parameters import bind
from bayescal._model.unknown_effect import FORMS, IN_TIME
from bayescal._search.candidate import (
    Candidate,
    best_form,
    indistinguishable,
    judge,
    kind_of,
    off_scale_claims,
)
from bayescal._search.equivalence import claims_of_equivalents, with_spans
from bayescal._search.library import Library
from bayescal._search.noise_laws import laws_over
from bayescal._search.posterior import Finding, Posterior
from bayescal._search.scores import View
from bayescal._search.structure_average import averaged, with_form, with_latent
from bayescal._search.structures import Structure, Structures
from bayescal._search.walk import explore

# Of the time that the first model leaves, for the walk: the rest tells what it found, fits that, samples and checks it.
SEARCH = 2 / 3
ENDED = "not stated, as the search was ended early"
RIVALS = 4  # effects that an experiment is asked to tell apart, at most


@dataclass(frozen=True)
class LawProbability:
    """A noise law and its probability."""

    law: str
    in_words: str
    probability: float

    def __str__(self) -> str:
        return f"{self.in_words} {probability(self.probability)}"


@renamed(sets="findings")
@dataclass(frozen=True, repr=False)
class Discovery(Printed):
    """The answer to "which effect is missing?".

    Attributes:
        nothing_missing: probability that the model is complete: that none of the candidates that these readings can
            show is missing, and that no description stands for what has no name; None where the search cannot say.
        findings: sets of which one is missing, the most probable first.
        candidates: every candidate, the most probable first.
        best: the effects to add, so that `model + discovery.best` is the model to use; empty for none.
        noise: every noise law with its probability, the most probable first; empty where the readings cannot tell.
        stopped: why the search ended before its end; empty where it did not.
        unstated: why the search cannot say that, in words; empty where it can.
        unnamed: descriptions in the model that carry more than a small part of it: something is missing that has no
            name here.
        off_scale: candidates a million times smaller or larger than the noise at their plausible size.
        rivals: effects to tell apart by another experiment: the members of the first set; where it has one alone,
            with those that come nearest; without a set, the leads.
        latent: effects of the model that these readings cannot tell from its others.
        equivalent: sets of effects that these readings cannot tell apart, those of the model first.
    """

    nothing_missing: float | None
    findings: tuple[Finding, ...]
    candidates: tuple[Candidate, ...]
    best: tuple[Effect, ...]
    rivals: tuple[Effect, ...] = ()
    noise: tuple[LawProbability, ...] = ()
    stopped: str = ""
    off_scale: tuple[Claim, ...] = ()
    unstated: str = ""
    unnamed: tuple[str, ...] = ()
    latent: tuple[str, ...] = ()
    equivalent: tuple[Claim, ...] = ()
    _average: Callable[..., Calibration] | None = field(default=None, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the structures that were searched, for pickle."""
        return {**vars(self), "_average": None}

    def fit(self, method: Method | None = None, *, seed: Any = 0) -> Calibration:
        """Fit the model with what is missing, averaged over the structures that may be the right one.

        Its predictions count what a fit of `model + discovery.best` does not: that another structure may be right, and
        that none of them may be (`form_factor`).

        Args:
            method: of the fits; `Marginal()` if not given.
            seed: of every random number.

        Raises:
            ModelError: it is part of a `SearchPath`, whose `calibration` is that average, or of another process.
        """
        if self._average is None:
            raise ModelError(
                "only what bc.discover returns can be fitted, in the process that found it: of a search take "
                "path.calibration, of a discovery that was sent elsewhere fit model + discovery.best"
            )
        return self._average(method, seed)

    def not_stated(self, why: str) -> Discovery:
        """Return the discovery without a probability that the model is complete."""
        return replace(self, nothing_missing=None, unstated=why)

    @property
    def unseen(self) -> tuple[str, ...]:
        """Return named candidates that these readings can say nothing of."""
        return tuple(c.effect for c in self.candidates if c.unseen and c.role != "unnamed")

    @property
    def complete_in_words(self) -> str:
        """Return in words the probability that the model is complete, and how many effects are unseen."""
        text = self.unstated or probability(self.nothing_missing)
        if self.unstated or not self.unseen:
            return text
        return f"{text}, as far as this experiment can see; effects not testable or not detectable: {len(self.unseen)}"

    @property
    def correlated_noise(self) -> float | None:
        """Return the probability of correlated noise, of any law; None where the readings cannot tell."""
        probabilities = [n.probability for n in self.noise if Noise.correlates(n.law)]
        return sum(probabilities) if probabilities else None

    def _parts(self) -> list[str | ResultTable]:
        """Return what is missing and the table of candidates, the most probable first."""
        lines: list[str | ResultTable] = [folded(claim) for claim in self.equivalent]
        lines += map(folded, _findings(self))
        if self.noise:
            laws = [n for n in self.noise if n.probability >= SHOWN_PROBABILITY]
            lines.append(folded(f"noise law (probability): {', '.join(map(str, laws))}"))
        lines += [self.stopped, *(folded(f"unit? {w}", "") for w in self.off_scale)]
        everyone = [vars(c) for c in self.candidates]
        table = candidates_table(everyone)
        lines += [table] if table.rows else []
        if any(c["source"] == "refit" for c in table.rows):
            lines.append("* log Bayes factor by a refit; the others are approximate (score test)")
        lines += [folded(f"confounded: {', '.join(group)}") for group in confounded(everyone)]
        by_reason = not_tested(everyone).items()
        lines += [folded(f"not testable, {why}: {', '.join(names)}") for why, names in by_reason]
        return [line for line in lines if line]

    def _brief(self) -> str:
        return "; ".join(_findings(self))

    def _columns(self) -> dict[str, list[Any]]:
        """Return a row for each candidate, also for those that are not printed; sizes in `unit`."""
        names = ("effect", "probability", "log_bayes_factor", "size", "size_sd", "unit")
        names = (*names, "minimum_detectable", "kind", "reason")
        return {name: [getattr(c, name) for c in self.candidates] for name in names}


def discover(
    calibration: Calibration,
    *,
    effects: Sequence[Effect] = (),
    max_effects: int = 5,
    widen_noise: bool = True,
    time_limit: float | None = None,
    ignore: Collection[str] = (),
    covariates: Collection[str] | None = None,
) -> Discovery:
    """Find the effects that are missing from a fitted model.

    Args:
        calibration: a converged fit.
        effects: further candidates of the user's own, beside the instrument's.
        max_effects: most effects that may be missing at once.
        widen_noise: False holds the noise law as it is.
        time_limit: seconds for everything; the search ends with the best so far, as it does at Ctrl-C.
        ignore: columns that are no causes.
        covariates: of the columns that the instrument does not know, those that may be causes; None for all but other
            channels of the unit.

    Raises:
        InputError: there is no such column.
    """
    model = calibration.model
    readings = with_causes(calibration.readings, model.instrument, ignore, covariates)

    with deadline.until(time_limit):
        structures, shut = structures_over(
            model, readings, calibration.reference, effects=effects, widen_noise=widen_noise
        )
        library = Library(structures)
        with deadline.sooner(SEARCH):
            stopped = explore(library, max_effects)
        discovery = missing(library, Structure(), shut, stopped)
        with_latent_effects = structures.unsized(model, discovery.latent)
        goal = Posterior.of(structures).chosen

        def average(method: Method | None, seed: Any) -> Calibration:
            at, of = structures.weigh(goal), calibration.reference
            last = fit(at.sized_model, readings, method, seed=seed, reference=of, start=at.phi)
            mixed, _ = averaged(last, structures, goal.noise, last.seed)
            _, used = with_latent(last, mixed, structures, goal)
            complete = missing(library, goal, shut, stopped).nothing_missing
            return with_form(used, complete, structures, goal)

        best = (*(with_latent_effects.effect(n) for n in discovery.latent), *discovery.best)
        return replace(discovery, best=best, _average=average)


def missing(library: Library, at: Structure, shut: Sequence[Candidate], stopped: str) -> Discovery:
    """Return what is missing from a structure; without time for scores, by the evaluated structures alone."""
    with suppress(deadline.TimeIsUp), deadline.sooner(1 / 2) as end:
        end.ask()
        return discovery_at(library, at, shut, stopped)
    with deadline.finishing():
        return discovery_at(library, at, shut, stopped, scored=False)


def structures_over(
    model: Model,
    readings: Measurements,
    reference: Reference,
    *,
    effects: Sequence[Effect] = (),
    widen_noise: bool = True,
    latent: bool = True,
) -> tuple[Structures, list[Candidate]]:
    """Return all structures over a model, and families that these readings cannot test, with reasons.

    They hold what these readings cannot tell from their effects, if `latent`.
    """
    instrument = model.instrument
    listed = (*instrument.candidates, *instrument.effects)
    by_name = {e.name: e for e in with_forms((*listed, *effects))}
    by_name |= {e.name: e for e in placeholders(model, readings) if e.name not in by_name}
    given_names = {e.name for e in effects}  # who gives an effect says what it depends on
    slots = {s.name for s in instrument.slots}

    def untestable(effect: Effect) -> str | None:
        unknown = (c for c in effect.coefficients if not c.known)
        if any((c.slot or effect.slot) not in slots or c.per == READING for c in unknown):
            return "corrects a column or single readings, which no search weighs: add it yourself"
        gone = sorted(readings.no_causes.intersection(effect.columns))
        if gone and effect.name not in given_names:
            return f"the column {', '.join(gone)} is left out"
        return why_untestable(effect, readings)

    # Of a family that the model has in one form, no other is missing.
    had = {e.reported for e in model.effects}
    reasons = {n: untestable(e) for n, e in by_name.items() if e.reported not in had}
    open_ = {n: by_name[n] for n, reason in reasons.items() if reason is None}
    tested, shut = {by_name[n].reported for n in open_}, dict[str, Candidate]()
    for name, reason in reasons.items():
        family = by_name[name].reported
        if reason and not by_name[name].is_placeholder and family not in tested:
            shut.setdefault(family, Candidate(family, kind="not testable", reason=reason))
    record = record_of(instrument, readings, reference)
    frame = record.frame
    model = fill_amplitudes(model, readings, record)
    plausible = amplitude_range(model, readings, record)
    open_ = {n: e.sized(*plausible) for n, e in open_.items()}
    record.require_finite((*open_.values(), *model.effects))
    laws = laws_over(model, frame) if widen_noise else {}
    layout = bind(model, readings, open_.values(), reference)[0]
    structures = Structures(model, layout, record, open_, laws)
    if latent:
        with deadline.finishing():  # what is latent is in the first model, whatever the time limit
            structures = with_spans(structures, plausible[0] * math.sqrt(record.size))
    return structures, list(shut.values())


def with_causes(
    readings: Measurements,
    instrument: Instrument,
    ignore: Collection[str],
    covariates: Collection[str] | None,
) -> Measurements:
    """Return readings in which nothing depends on the columns to ignore, and on none but those given, if any is."""
    if both := sorted({*ignore}.intersection(covariates or ())):
        raise InputError(f"{', '.join(both)}: to be ignored, and a covariate: say one of the two")
    if covariates is not None:
        for name in covariates:
            readings[name]
        of_instrument = {c.name for c in instrument.columns} | {"output_uncertainty"}
        further = {n for n in readings.columns if readings.unit(n) is not None} - of_instrument
        readings = readings.without_causes(further - {*covariates}, others=False)
    return readings.without_causes(ignore)


def placeholders(model: Model, readings: Measurements) -> list[Effect]:
    """Return unknown dependences on each covariate, in all their forms."""
    instrument = model.instrument
    if all(s.unit != instrument.unit for s in instrument.slots):
        return []
    names = [name for name, values in list_covariates(readings).items() if np.ptp(values) > 0]
    forms = [*IN_TIME] if "time" in names else []
    columns = [name for name in names if readings.has(name) and name != "time"]
    straight = {n for effect in model.effects for n in effect.varies}  # a line along them is there
    forms += [f"{n}, {f}" for n in columns for f in FORMS if f != "line" or n not in straight]
    return [instrument.unknown(name) for name in (*names, *forms)]


def discovery_at(
    library: Library,
    at: Structure,
    shut: Sequence[Candidate],
    stopped: str = "",
    scored: bool = True,
) -> Discovery:
    """Return what is missing from a structure by the posterior, candidates `scored` beside it, which takes time.

    Of a walk that `stopped` early nothing further is evaluated, and P(complete) is not stated.
    """
    structures = library.structures
    posterior = Posterior.of(structures, at.effects)
    base = structures.weigh(at)
    had = posterior.space.families(at.effects | structures.latent(at))
    names = [n for n in library.points if scored and structures.family(n) not in had]
    points = View(library, base).without().scores(names) if names else {}
    # Of forms that have a score the one that has the best speaks for its family.
    points = best_form(structures, points)
    same = indistinguishable(points) if points else {}
    findings = posterior.findings
    in_sets = {name: set(f.effects) for f in findings for name in f.effects}
    unscored = structures.unscored if scored else structures.candidates
    judged = []
    for name in (*points, *sorted(posterior.space.families(unscored) - had)):
        scores, form = points.get(name, ()), posterior.form(name)
        if not scores:
            form = form if form in structures.candidates else structures.forms[name][0]
            if scored and not stopped:
                structures.weigh(at.plus(form), base)
        candidate = judge(library, name, form, scores, base, structures.visited.get(at.plus(form)))
        # Confounded are those whose fitted contributions are parallel, and those that share a finding.
        near = same.get(name, set()).union(in_sets.get(name, ())) - {name}
        candidate = replace(
            candidate,
            # Without a score, a walk that ended early may have met no structure with it: nothing is known of it then.
            probability=posterior.probability_of_names(name) or (0.0 if scores else None),
            indistinguishable_from=tuple(sorted(near)),
        )
        effect = structures.candidates[scores[0].effect] if scores else None
        judged.append(kind_of(candidate, name in in_sets, effect))
    ranked = sorted(judged, key=lambda c: (-(c.probability or 0.0), -(c.log_bayes_factor or 0.0)))
    chosen = posterior.best if stopped else posterior.chosen
    new, model = chosen.effects - at.effects, structures.weigh(chosen).sized_model
    best = [model.effect(name) for name in structures.candidates if name in new]
    stated = scored and not stopped
    # What another experiment should tell apart, the most probable first.
    first = list(findings[0].effects) if findings else []
    leads = [c.effect for c in ranked if c.kind == "lead"] if len(first) < 2 else []
    rivals = list(dict.fromkeys(first + leads))[:RIVALS]
    laws = {"": structures.base.noise, **structures.laws} if structures.laws else {}
    law_rows = [LawProbability(n.name, n.in_words, posterior.noise(k)) for k, n in laws.items()]
    unseen, noise = [c.effect for c in judged if c.unseen], base.problem.noise.name
    return Discovery(
        nothing_missing=posterior.complete(unseen) if stated else None,
        unnamed=(*sorted(structures.matters(base)), *[f"{noise} noise"] * base.noise_describes),
        latent=tuple(sorted(structures.latent(base.structure))),
        equivalent=claims_of_equivalents(structures, base.structure),
        findings=findings,
        candidates=(*ranked, *shut),
        best=tuple(best),
        rivals=tuple(structures.candidates[posterior.form(n)] for n in rivals),
        noise=tuple(sorted(law_rows, key=lambda law: -law.probability)),
        stopped=stopped,
        unstated="" if stated else ENDED,
        off_scale=off_scale_claims(library, points, base),
    )


def _findings(discovery: Discovery) -> list[str]:
    lines = [f"probability that the model is complete: {discovery.complete_in_words}"]
    if discovery.unnamed:
        lines.append(
            f"something is missing that has no name here: {' and '.join(discovery.unnamed)} "
            f"{'stands' if len(discovery.unnamed) == 1 else 'stand'} for it"
        )
    for s in discovery.findings:
        names = " or ".join(s.effects)
        tail = "" if len(s.effects) == 1 else " (one of these; these readings cannot tell which)"
        form = next((c.form for c in discovery.candidates if (c.effect,) == s.effects), "")
        if form not in ("", *s.effects):
            tail = f" (most probable form: {form.removeprefix(f'{s.effects[0]}.')})"
        lines.append(f"missing: {names}, probability {probability(s.probability)}{tail}")
    for c in discovery.candidates:
        if c.role == "freed" and c.probability is not None:
            others = (r for r in discovery.candidates if r.role != "freed")
            rivals = [r for r in others if (r.probability or 0.0) >= SHOWN_PROBABILITY][:1]
            lines.append(
                f"{c.frees} contradicts its prior: its stated value is wrong "
                f"({probability(c.probability)})"
            )
            for r in rivals:
                lines[-1] += f", or {r.effect} is missing ({probability(r.probability)})"
    return lines


def candidates_table(candidates: Sequence[Mapping[str, Any]]) -> ResultTable:
    """Return the table of testable candidates of a result.json, without curves that lack evidence."""

    def factor(c: Mapping[str, Any]) -> str:
        value = c["log_bayes_factor"]
        text = "–" if value is None else f"{value:z.1f}"
        return text + ("*" if c["source"] == "refit" else " ")

    def size(c: Mapping[str, Any]) -> str:
        name = "".join(f"{n} = " for n in [*c["shape"]][: c["unit"] == "s"])  # a body's time
        return name + with_error(c["size"] or 0.0, c["size_sd"] or 0.0)

    def detectable(c: Mapping[str, Any]) -> str:
        return number(None if c["unit"] == "s" else c["minimum_detectable"], 2)

    def remark(kind: str | None) -> str:
        return "not detectable in this experiment" if kind == "not visible" else kind or ""

    columns = (
        TableColumn("candidate", "effect"),
        TableColumn("probability", "probability", probability),
        TableColumn("log BF", factor),
        TableColumn("expected size", size),
        TableColumn("detectable size", detectable),
        TableColumn("unit", "unit", unit_label, left=True),
        TableColumn("remark", "kind", remark),
    )
    tested = [c for c in candidates if c["kind"] != "not testable" and not is_quiet(c)]
    return ResultTable(columns, tested, fold=29)


def is_quiet(c: Mapping[str, Any]) -> bool:
    """Return whether a candidate is an unknown dependence without evidence, left out of tables and plots."""
    return c["role"] == "unnamed" and c["kind"] in (None, "not visible")


def confounded(candidates: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return maximal groups of candidates, of a result.json, that the readings cannot tell apart."""
    groups: list[tuple[str, ...]] = []
    for c in candidates:
        members = (c["effect"], *c["indistinguishable_from"])
        if len(members) > 1 and not any({*members} <= {*group} for group in groups):
            groups.append(members)
    return groups


def not_tested(candidates: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Return, by reason, the candidates of a result.json that could not be tested."""
    by_reason: dict[str, list[str]] = {}
    for c in candidates:
        if c["kind"] == "not testable":
            by_reason.setdefault(c["reason"], []).append(c["effect"])
    return by_reason
