"""Missing effects of a fitted model, by the posterior over structures that have the model's effects."""

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
from bayescal._calibration.sensor_noise import MIN_PROBABILITY
from bayescal._core import deadline
from bayescal._core.errors import InputError, ModelError
from bayescal._core.formatting import format_value, number, probability, wrap
from bayescal._core.renamed import renamed
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._core.settings import settings
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.linear_model import fill_amplitudes, guess_amplitudes
from bayescal._inference.method import Method
from bayescal._inference.record import record_of
from bayescal._model.effect import READING, Effect, list_forms
from bayescal._model.frame import Reference, list_covariates
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model, why_untestable
from bayescal._model.noise_law import Noise
from bayescal._model.parameters import bind
from bayescal._model.unknown_effect import FORMS, TIME_FORMS
from bayescal._search.candidate import (
    Candidate,
    classify_candidate,
    find_indistinguishable,
    flag_off_scale,
    select_forms,
    summarise_candidate,
)
from bayescal._search.equivalence import add_spans, list_equivalence_claims
from bayescal._search.library import Library
from bayescal._search.noise_laws import list_laws
from bayescal._search.posterior import Finding, Posterior
from bayescal._search.scores import Scorer
from bayescal._search.structure_average import add_inadequacy, add_latent_effects, average_models
from bayescal._search.structures import Structure, Structures
from bayescal._search.walk import explore

# Share of the time after the first fit for the search; the rest is for scores, the last fit, sampling and checks.
SEARCH_TIME_SHARE = 2 / 3
P_COMPLETE = "probability that no testable candidate is missing"
UNSTATED_TEXT = "not stated, as the search was ended early"
LOG_BF = "log BF: log Bayes factor of this effect alone, added to the fitted model; probability: over all structures"
SIZE_NOTE = "size: first of several coefficients; of deviations of runs or cells, their sd (prior: half-normal)"
MAX_RIVALS = 4  # effects to be distinguished by an experiment
REMARKS = {"not visible": "not detectable in this experiment"}


@dataclass(frozen=True)
class LawProbability:
    """A noise law and its probability."""

    law: str
    in_words: str
    probability: float

    def __str__(self) -> str:
        return f"{self.in_words} {probability(self.probability)}"


@renamed(sets="findings", not_stated="without_completeness")
@dataclass(frozen=True, repr=False)
class Discovery(Printed):
    """Effects missing from a model, with their probabilities.

    Attributes:
        nothing_missing: probability that the model is complete: that no testable candidate is missing and no unnamed
            effect is substantial; None if the search cannot state it.
        findings: sets of effects of which at least one is missing, the most probable first.
        candidates: all candidates, the most probable first.
        best: effects to add, so that `model + discovery.best` is the model to use; empty for none.
        noise: all noise laws with their probabilities, the most probable first; empty if only one was evaluated.
        stopped: why the search ended early; empty if it was completed.
        unstated: why `nothing_missing` is None; empty if it is stated.
        unnamed: substantial unnamed effects in the model, which describe a missing effect that is not a candidate.
        off_scale: claims on candidates a million times smaller or larger than the noise at their plausible size.
        rivals: effects to distinguish by another experiment: members of the first finding, and leads (effects of
            probability 0.2 to 0.95) if it has only one member; without a finding, the leads.
        latent: effects added to the model because these readings cannot distinguish them from others in it.
        equivalent: claims on sets of effects that these readings cannot distinguish, those of the model first.
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
        """Return the state for pickle, without the searched structures."""
        return {**vars(self), "_average": None}

    def fit(self, method: Method | None = None, *, seed: Any = 0) -> Calibration:
        """Fit the model with its missing effects, averaged over the probable structures.

        Unlike those of a fit of `model + discovery.best`, its predictions include the uncertainty of the structure, and
        the possibility that none of the structures is right (`form_factor`).

        Args:
            method: method of the fits; `Marginal()` if not given.
            seed: seed of the random-number generator.

        Raises:
            ModelError: it is part of a `SearchPath` (use its `calibration`), or was made by another process.
        """
        if self._average is None:
            raise ModelError(
                "this discovery belongs to a search or to another process, and cannot be fitted: use path.calibration "
                "of the search, or fit model + discovery.best"
            )
        return self._average(method, seed)

    def without_completeness(self, why: str) -> Discovery:
        """Return the discovery without a probability that the model is complete; `why`: the reason."""
        return replace(self, nothing_missing=None, unstated=why)

    @property
    def unseen(self) -> tuple[str, ...]:
        """Return the named candidates on which these readings have no information."""
        return tuple(c.effect for c in self.candidates if c.unseen and c.role != "unnamed")

    @property
    def complete_in_words(self) -> str:
        """Return as text the probability that the model is complete, and the number of effects not tested."""
        text = self.unstated or probability(self.nothing_missing)
        if self.unstated or not self.unseen:
            return text
        return f"{text}; not testable or not detectable: {len(self.unseen)}"

    @property
    def correlated_noise(self) -> float | None:
        """Return the probability of correlated noise, over all laws; None if no other law was evaluated."""
        probabilities = [n.probability for n in self.noise if Noise.correlates(n.law)]
        return sum(probabilities) if probabilities else None

    def _list_parts(self) -> list[str | ResultTable]:
        """Return the printed parts: summary, table of candidates by probability, collinear and untestable ones."""
        lines: list[str | ResultTable] = [wrap(claim) for claim in self.equivalent]
        lines += map(wrap, _describe_findings(self))
        if self.noise:
            laws = ", ".join(str(n) for n in self.noise if n.probability >= MIN_PROBABILITY)
            lines.append(wrap(f"noise law with missing effects (probability): {laws}"))
        lines += [self.stopped, *(wrap(f"unit? {w}", "") for w in self.off_scale)]
        rows = [vars(c) for c in self.candidates]
        table, power = candidates_table(rows), f"{100 * settings().power:g} %, residuals as noise"
        note = f"± standard uncertainty (k = 1); detectable: size found with probability {power}\n{SIZE_NOTE}"
        has_refits = any(c["source"] == "refit" for c in table.rows)
        if table.rows:
            lines += [table, note, LOG_BF, "* log BF by refit, others by score test" * has_refits]
        lines += [wrap(f"partly collinear: {', '.join(g)}") for g in group_confounded(rows)]
        reasons = group_untested(rows).items()
        lines += [wrap(f"not testable, {r}: {', '.join(names)}") for r, names in reasons]
        return [line for line in lines if line]

    def _format_summary(self) -> str:
        return "; ".join(_describe_findings(self))

    def _list_columns(self) -> dict[str, list[Any]]:
        """Return columns by name, an entry per candidate, including those not printed; sizes in `unit`."""
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
        effects: user-defined effects, additional candidates.
        max_effects: largest number of missing effects.
        widen_noise: whether noise laws other than the model's are evaluated.
        time_limit: limit on the call, s; the search then ends with the best structure so far, as it does at Ctrl-C.
        ignore: columns that no candidate effect may depend on.
        covariates: undeclared columns that candidate effects may depend on; None: all but other outputs.

    Raises:
        InputError: a column of `ignore` or `covariates` does not exist.
    """
    model = calibration.model
    readings = restrict_causes(calibration.readings, model.instrument, ignore, covariates)

    with deadline.limit(time_limit):
        structures, untestable = enumerate_structures(
            model, readings, calibration.reference, effects=effects, widen_noise=widen_noise
        )
        library = Library(structures)
        with deadline.shorten(SEARCH_TIME_SHARE):
            stopped = explore(library, max_effects)
        discovery = find_missing(library, Structure(), untestable, stopped)
        latent_model = structures.with_wide_priors(model, discovery.latent)
        median = Posterior.from_structures(structures).median_structure

        def average(method: Method | None, seed: Any) -> Calibration:
            evaluation, reference = structures.evaluate(median), calibration.reference
            options = {"seed": seed, "reference": reference, "start": evaluation.phi}
            fitted = fit(evaluation.sized_model, readings, method, **options)
            average_fit, _ = average_models(fitted, structures, median.noise, fitted.seed)
            _, latent_fit = add_latent_effects(fitted, average_fit, structures, median)
            completeness = find_missing(library, median, untestable, stopped).nothing_missing
            return add_inadequacy(latent_fit, completeness, structures, median)

        best = (*(latent_model.effect(n) for n in discovery.latent), *discovery.best)
        return replace(discovery, best=best, _average=average)


def find_missing(
    library: Library, structure: Structure, untestable: Sequence[Candidate], stopped: str
) -> Discovery:
    """Find the effects missing from a structure; without scores if these take more than half of the remaining time."""
    with suppress(deadline.TimeIsUp), deadline.shorten(1 / 2) as limit:
        limit.raise_if_over()
        return summarise_discovery(library, structure, untestable, stopped)
    with deadline.suspend():
        return summarise_discovery(library, structure, untestable, stopped, include_scores=False)


def enumerate_structures(
    model: Model,
    readings: Measurements,
    reference: Reference,
    *,
    effects: Sequence[Effect] = (),
    widen_noise: bool = True,
    include_latent: bool = True,
) -> tuple[Structures, list[Candidate]]:
    """Return the structures to search over a model, and the effects that these readings cannot test, with reasons.

    If `include_latent`, the structures include latent effects, which these readings cannot distinguish from others.
    """
    instrument = model.instrument
    instrument_effects = (*instrument.candidates, *instrument.effects)
    by_name = {e.name: e for e in list_forms((*instrument_effects, *effects))}
    by_name |= {e.name: e for e in list_placeholders(model, readings) if e.name not in by_name}
    given_names = {e.name for e in effects}  # effects whose columns are used even if ignored
    slots = {s.name for s in instrument.slots}

    def untestable(effect: Effect) -> str | None:
        coefficients = (c for c in effect.coefficients if not c.known)
        if any((c.slot or effect.slot) not in slots or c.per == READING for c in coefficients):
            return "corrects a column or single readings, which no search evaluates: add it to the model"
        ignored = sorted(readings.no_causes.intersection(effect.columns))
        if ignored and effect.name not in given_names:
            return f"depends on excluded columns: {', '.join(ignored)}"
        return why_untestable(effect, readings)

    # A family that the model has in one form is not missing in another.
    base_families = {e.family_name for e in model.effects}
    reasons = {n: untestable(e) for n, e in by_name.items() if e.family_name not in base_families}
    testable_effects = {n: by_name[n] for n, reason in reasons.items() if reason is None}
    families, untested = {by_name[n].family_name for n in testable_effects}, dict[str, Candidate]()
    for name, reason in reasons.items():
        family = by_name[name].family_name
        if reason and not by_name[name].is_placeholder and family not in families:
            untested.setdefault(family, Candidate(family, kind="not testable", reason=reason))
    record = record_of(instrument, readings, reference)
    frame, model = record.frame, fill_amplitudes(model, readings, record)
    amplitudes = guess_amplitudes(model, readings, record)
    testable_effects = {n: e.with_open_ranges(*amplitudes) for n, e in testable_effects.items()}
    record.require_finite((*testable_effects.values(), *model.effects))
    laws = list_laws(model, frame) if widen_noise else {}
    layout = bind(model, readings, testable_effects.values(), reference)[0]
    structures = Structures(model, layout, record, testable_effects, laws)
    if include_latent:
        with deadline.suspend():  # the first model needs them, whatever the time limit
            structures = add_spans(structures, amplitudes[0] * math.sqrt(record.size))
    return structures, list(untested.values())


def restrict_causes(
    readings: Measurements,
    instrument: Instrument,
    ignore: Collection[str],
    covariates: Collection[str] | None,
) -> Measurements:
    """Return readings with columns marked as no causes: `ignore`, and undeclared ones that given `covariates` omit."""
    if names := sorted({*ignore}.intersection(covariates or ())):
        raise InputError(
            f"{', '.join(names)}: given in both ignore and covariates; remove each from one of them"
        )
    if covariates is not None:
        for name in covariates:
            readings[name]
        declared_names = {c.name for c in instrument.columns} | {"output_uncertainty"}
        undeclared = {n for n in readings.columns if readings.unit(n) is not None} - declared_names
        readings = readings.without_causes(undeclared - {*covariates}, keep_excluded=False)
    return readings.without_causes(ignore)


def list_placeholders(model: Model, readings: Measurements) -> list[Effect]:
    """Return the placeholder effects: an unknown dependence on each covariate, in each form."""
    instrument = model.instrument
    if all(s.unit != instrument.unit for s in instrument.slots):
        return []
    names = [name for name, values in list_covariates(readings).items() if np.ptp(values) > 0]
    forms = [*TIME_FORMS] if "time" in names else []
    columns = [name for name in names if readings.has(name) and name != "time"]
    linear = {n for effect in model.effects for n in effect.varies}  # have a linear term already
    forms += [f"{n}, {f}" for n in columns for f in FORMS if f != "line" or n not in linear]
    return [instrument.unknown(name) for name in (*names, *forms)]


def summarise_discovery(
    library: Library,
    structure: Structure,
    untestable: Sequence[Candidate],
    stopped: str = "",
    include_scores: bool = True,
) -> Discovery:
    """Summarise the effects missing from a structure, by the posterior and by the candidates' scores.

    Scores take time; without them (not `include_scores`) only evaluated structures count. After a search that `stopped`
    early, no further structure is evaluated, and the probability that the model is complete is not stated.
    """
    structures = library.structures
    posterior = Posterior.from_structures(structures, structure.effects)
    evaluation = structures.evaluate(structure)
    families = posterior.space.families(structure.effects | structures.latent_effects(structure))
    names = [n for n in library.points if include_scores and structures.family(n) not in families]
    points = Scorer(library, evaluation).reduced_model().score_candidates(names) if names else {}
    points = select_forms(structures, points)
    parallel = find_indistinguishable(points) if points else {}
    findings = posterior.findings
    findings_by_name = {name: set(f.effects) for f in findings for name in f.effects}
    unscored_names = structures.unscored_candidates if include_scores else structures.candidates
    tested = []
    for name in (*points, *sorted(posterior.space.families(unscored_names) - families)):
        scores, form = points.get(name, ()), posterior.most_probable_form(name)
        if not scores:
            form = form if form in structures.candidates else structures.forms[name][0]
            if include_scores and not stopped:
                structures.evaluate(structure.with_effects(form), evaluation)
        refit = structures.visited.get(structure.with_effects(form))
        candidate = summarise_candidate(library, name, form, scores, evaluation, refit)
        # Confounded candidates have parallel fitted contributions, or share a finding.
        confounded_names = parallel.get(name, set()).union(findings_by_name.get(name, ())) - {name}
        candidate = replace(
            candidate,
            # None: no score, and no structure with it was evaluated before the search ended early.
            probability=posterior.probability_of_names(name) or (0.0 if scores else None),
            indistinguishable_from=tuple(sorted(confounded_names)),
        )
        effect = structures.candidates[scores[0].name] if scores else None
        tested.append(classify_candidate(candidate, findings_by_name.get(name, set()), effect))
    ranking = sorted(tested, key=lambda c: (-(c.probability or 0.0), -(c.log_bayes_factor or 0.0)))
    final = posterior.best if stopped else posterior.median_structure
    added_names, model = final.effects - structure.effects, structures.evaluate(final).sized_model
    best_effects = [model.effect(name) for name in structures.candidates if name in added_names]
    is_stated = include_scores and not stopped
    # Effects that another experiment should tell apart, the most probable first.
    first_finding = list(findings[0].effects) if findings else []
    leads = [c.effect for c in ranking if c.kind == "lead"] if len(first_finding) < 2 else []
    rivals = list(dict.fromkeys(first_finding + leads))[:MAX_RIVALS]
    laws = {"": structures.base.noise, **structures.noise_laws} if structures.noise_laws else {}
    pairs = ((law, posterior.law_probability(name)) for name, law in laws.items())
    law_rows = [LawProbability(law.name, law.in_words, p) for law, p in pairs]
    unseen_names, unnamed = [c.effect for c in tested if c.unseen], structures.substantial_unnamed
    noise_names = [f"{evaluation.problem.noise.name} noise"] * evaluation.has_unnamed_noise
    return Discovery(
        nothing_missing=posterior.completeness(unseen_names) if is_stated else None,
        unnamed=(*sorted(unnamed(evaluation)), *noise_names),
        latent=tuple(sorted(structures.latent_effects(evaluation.structure))),
        equivalent=list_equivalence_claims(structures, evaluation.structure),
        findings=findings,
        candidates=(*ranking, *untestable),
        best=tuple(best_effects),
        rivals=tuple(structures.candidates[posterior.most_probable_form(n)] for n in rivals),
        noise=tuple(sorted(law_rows, key=lambda law: -law.probability)),
        stopped=stopped,
        unstated="" if is_stated else UNSTATED_TEXT,
        off_scale=flag_off_scale(library, points, evaluation),
    )


def _describe_findings(discovery: Discovery) -> list[str]:
    lines = [f"{P_COMPLETE}, P(complete): {discovery.complete_in_words}"]
    if discovery.unnamed:
        lines.append(
            "an effect is missing that no candidate names; described by "
            f"{' and '.join(discovery.unnamed)}"
        )
    for s in discovery.findings:
        names = " or ".join(s.effects)
        suffix = "" if len(s.effects) == 1 else " (one of these; these readings cannot tell which)"
        form = next((c.form for c in discovery.candidates if (c.effect,) == s.effects), "")
        if form not in ("", *s.effects):
            suffix = f" (most probable form: {form.removeprefix(f'{s.effects[0]}.')})"
        lines.append(f"missing: {names}, probability {probability(s.probability)}{suffix}")
    for c in discovery.candidates:
        if c.role == "freed" and c.probability is not None:
            others = (r for r in discovery.candidates if r.role != "freed")
            rivals = [r for r in others if (r.probability or 0.0) >= MIN_PROBABILITY][:1]
            text = f"{c.frees} contradicts its prior: its stated value is wrong ({probability(c.probability)})"
            for r in rivals:
                text += f", or {r.effect} is missing ({probability(r.probability)})"
            lines.append(text)
    return lines


def candidates_table(candidates: Sequence[Mapping[str, Any]]) -> ResultTable:
    """Tabulate the testable candidates (`Candidate` as mappings) without curves that lack evidence."""

    def format_factor(c: Mapping[str, Any]) -> str:
        value = c["log_bayes_factor"]
        return ("–" if value is None else f"{value:z.1f}") + " *"[c["source"] == "refit"]

    def format_size(c: Mapping[str, Any]) -> str:
        prefix = "".join(f"{n} = " for n in [*c["shape"]][: c["unit"] == "s"])  # a body's time
        return prefix + format_value(c["size"] or 0.0, c["size_sd"] or 0.0)

    def format_detectable(c: Mapping[str, Any]) -> str:
        return number(None if c["unit"] == "s" else c["minimum_detectable"], 2)

    columns = (
        TableColumn("candidate", "effect"),
        TableColumn("probability", "probability", probability),
        TableColumn("log BF", format_factor),
        TableColumn("size if added", format_size),
        TableColumn("detectable size", format_detectable),
        TableColumn("unit", "unit", unit_label, left=True),
        TableColumn("remark", "kind", lambda kind: REMARKS.get(kind, kind or "")),
    )
    tested_candidates = [c for c in candidates if c["kind"] != "not testable" and not is_quiet(c)]
    return ResultTable(columns, tested_candidates, width=29)


def is_quiet(c: Mapping[str, Any]) -> bool:
    """Return whether a candidate is an unknown dependence without evidence, which tables and plots omit."""
    return c["role"] == "unnamed" and c["kind"] in (None, "not visible")


def group_confounded(candidates: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return the maximal groups of confounded candidates (`Candidate` as mappings)."""
    groups: list[tuple[str, ...]] = []
    for c in candidates:
        members = (c["effect"], *c["indistinguishable_from"])
        if len(members) > 1 and not any({*members} <= {*group} for group in groups):
            groups.append(members)
    return groups


def group_untested(candidates: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Return, by reason, the names of candidates (`Candidate` as mappings) that could not be tested."""
    by_reason: dict[str, list[str]] = {}
    for c in candidates:
        if c["kind"] == "not testable":
            by_reason.setdefault(c["reason"], []).append(c["effect"])
    return by_reason
