"""Calibration by stepwise search: fit a model, check it, find missing effects, add them, fit again."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import sub
from typing import Any

import numpy as np

from bayescal._calibration import judgement
from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import check, noise_floor
from bayescal._calibration.fit import fit
from bayescal._calibration.leave_group_out import leave_one_group_out, scheme
from bayescal._calibration.predict import HoldoutTest, predict
from bayescal._core import deadline
from bayescal._core.errors import InputError
from bayescal._core.formatting import probability
from bayescal._core.progress import track
from bayescal._core.settings import settings, to_seed
from bayescal._data.measurements import Measurements
from bayescal._data.set_aside import exclude_faults, flag_fitted_holdout
from bayescal._inference.laplace import NO_START
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.method import Method
from bayescal._model.effect import Effect
from bayescal._model.frame import Reference
from bayescal._model.model import Model, why_untestable
from bayescal._model.unknown_effect import freed
from bayescal._search import discover
from bayescal._search.candidate import Candidate
from bayescal._search.gate import assess_steps, find_better_left_out
from bayescal._search.library import Library
from bayescal._search.posterior import OtherPath, Posterior, Search
from bayescal._search.search_path import Gate, SearchPath, Step
from bayescal._search.structure_average import add_inadequacy, add_latent_effects, average_models
from bayescal._search.structures import Structure, Structures
from bayescal._search.walk import explore, find_path

QUICK = LeastSquares(draws=500)
UNFINISHED = Gate(False, "The search is not finished: this model is preliminary.")


def calibrate(
    model: Model,
    readings: Measurements,
    *,
    holdout: Measurements | None = None,
    effects: Sequence[Effect] = (),
    method: Method | None = None,
    max_effects: int = 5,
    widen_noise: bool = True,
    keep_spikes: bool = False,
    seed: int | np.random.Generator = 0,
    reference: Reference | None = None,
    time_limit: float | None = None,
    accept_conflicts: Collection[str] = (),
    ignore: Collection[str] = (),
    covariates: Collection[str] | None = None,
    follow: Callable[[SearchPath], None] = lambda _: None,
) -> SearchPath:
    """Fit and check a model, find missing effects, add them and fit again, up to the most probable structure.

    Structures differ by their added effects and their noise law. An effect is in the last model if its probability is
    above one half, and called missing if it reaches 0.95; the calibration to use is averaged over structures. The steps
    lead from the given model to the last one, each by the change of highest evidence.

    Args:
        model: the first model. Its effects beyond the instrument's baseline are evaluated anew, so that the result does
            not depend on them, except those that are no candidates, that these readings cannot test or that have a
            fixed unknown; all named ones if it lacks a part of the baseline; all effects if `max_effects` is 0.
        readings: readings to fit.
        holdout: hold-out data, predicted after the last step and never used to choose an effect.
        effects: user-defined effects, additional candidates.
        method: inference method of the last fit; None: `Marginal()`. Earlier steps are fitted by least squares.
        max_effects: largest number of effects to add.
        widen_noise: False keeps the given noise law, whatever the distribution of the residuals.
        keep_spikes: False excludes, with a flag, single readings far from both neighbours, and readings with a wrong
            value of a thermometer that the model needs. Clipped readings are always excluded.
        seed: seed of all random numbers.
        reference: constants of the basis functions, instead of those computed from the readings.
        time_limit: limit on the call, s. The search has two thirds of the time after the first fit; the result states
            what was omitted. The first model and the most probable evaluated structure are always fitted, which may
            take longer. Ctrl-C ends the search with the best structure so far; pressed again, without a result.
        accept_conflicts: coefficients or effects that may differ greatly from their priors; others prevent the search.
        ignore: columns that no candidate effect may depend on.
        covariates: undeclared columns that candidate effects may depend on; None: all but other outputs.
        follow: called with the search path so far, once a second, at the end of the search and after each later fit.

    Raises:
        ModelError: the readings lack what the model needs.
        InputError: no such column of `ignore` or `covariates`; or only one of readings and hold-out data has dates.
    """
    with deadline.limit(time_limit):
        measurements = prepare_readings(model, readings, holdout, keep_spikes, ignore, covariates)
        options = method, to_seed(seed), reference, max_effects
        search = StepwiseSearch(*measurements, *options, frozenset(accept_conflicts))
        search.fit_first_step(model, effects, widen_noise)
        follow(search.build_path())
        with deadline.shorten(discover.SEARCH_TIME_SHARE):
            search.run_search(lambda: follow(search.build_path()))
        return search.fit_path(follow)


@dataclass(eq=False)
class StepwiseSearch:
    """State of one stepwise search, with the options of `calibrate`."""

    readings: Measurements
    holdout: Measurements | None
    method: Method | None
    seed: int
    reference: Reference | None
    max_effects: int
    accepted_conflicts: frozenset[str]
    start_time: float = 0.0  # time by `time.monotonic` at which the search began, s
    reconsidered: tuple[Effect, ...] = ()  # effects of the given model that are evaluated anew
    steps: list[Step] = field(default_factory=list)  # models fitted so far
    library: Library | None = None  # candidates and evaluated structures; None without a search
    untestable: Sequence[Candidate] = ()  # candidates that these readings cannot test
    stopped: str = ""  # why the search ended early; empty where it was completed

    def fit_first_step(self, model: Model, effects: Sequence[Effect], widen_noise: bool) -> None:
        """Fit the first step, a model without the effects that are evaluated anew, and set the structures to search.

        An effect kept only because the given model has it would hide substitutes that a search from the baseline finds.
        """
        known_names = (*model.names, *model.instrument.known, *(e.name for e in effects), "noise")
        for name in self.accepted_conflicts:
            if not any(name == k or name.startswith((f"{k}[", f"{k}.")) for k in known_names):
                effect_names = ", ".join(model.names)
                raise InputError(
                    f"no effect or coefficient is called {name!r}; the model has {effect_names}"
                )
        # Without a search all effects are kept.
        candidates = model.effects if self.max_effects > 0 else ()
        self.reconsidered = tuple(e for e in candidates if self.is_reconsidered(e, model))
        model = reduce(sub, self.reconsidered, model)
        with deadline.suspend():  # whatever the time limit
            step = self.fit_step(model, self.step_method(model))
        deadline.current().defer_interrupt()
        self.max_effects = max(self.max_effects, len(self.reconsidered))
        self.reference = step.calibration.reference
        self.steps, freed_effects = [step], self.free_contradicted(step)
        if freed_effects or not step.failures:
            self.list_structures(step, (*effects, *freed_effects), widen_noise)

    def is_reconsidered(self, effect: Effect, model: Model) -> bool:
        """Return whether the search evaluates an effect of the given model anew."""
        instrument, readings = model.instrument, self.readings
        if effect.is_placeholder:
            return effect.name in {e.name for e in discover.list_placeholders(model, readings)}
        has_baseline = {e.name for e in instrument.effects} <= {*model.names}
        baseline_effects = (*instrument.effects, *instrument.nuisances)
        candidate_names = {*instrument.known} - {e.name for e in baseline_effects}
        is_free = (model - effect).fixed == model.fixed
        is_testable = why_untestable(effect, readings) is None
        return has_baseline and effect.name in candidate_names and is_free and is_testable

    def list_structures(self, step: Step, effects: Sequence[Effect], widen_noise: bool) -> None:
        """Set the structures to search (`library`) and the untestable candidates, from a fitted first step."""
        self.start_time = time.monotonic()
        self.steps, c = [step], step.calibration
        # Probabilities need a converged fit; a published calibration that fails its check is not extended by effects.
        if not c.verdict.ok or step.check.contradicts_fixed:
            self.max_effects, widen_noise = 0, False
        # A given effect takes the place of the catalogue's effect of that name: its size may be the user's own.
        named_effects = [e for e in self.reconsidered if not e.is_placeholder]
        options = {"widen_noise": widen_noise, "include_latent": self.max_effects > 0}
        structures, self.untestable = discover.enumerate_structures(
            c.model, self.readings, c.reference, effects=(*effects, *named_effects), **options
        )
        self.library = Library(structures)

    def free_contradicted(self, step: Step) -> tuple[Effect, ...]:
        """Return, with wide priors, the effects of the first model whose stated values the readings contradict.

        Either the stated value is wrong or an effect is missing; the search compares both. No effect is returned if the
        model also fails for another reason.
        """
        if any(claim.code != judgement.PRIOR_CODE for claim in step.failures):
            return ()
        model, distances = step.calibration.model, dict[str, float]()
        for claim in step.failures:
            effect = claim.subjects[1]
            distances[effect] = max(claim.numbers["away"], distances.get(effect, 0.0))
        named = {name: model.effect(name) for name in distances}
        if any(e.shapes or e.is_placeholder or e.coefficients[0].per for e in named.values()):
            return ()
        # The prior's width is the next power of ten above the distance: it affects the evidence and must not be tuned.
        return tuple(freed(e, 10 ** math.ceil(math.log10(distances[n]))) for n, e in named.items())

    def step_method(self, model: Model) -> Method | None:
        """Return the method of steps before the last: least squares, or `method` for heavy tails without a deadline."""
        has_limit = deadline.current().ends_at < math.inf
        return QUICK if model.noise.is_gaussian or has_limit else self.method

    def run_search(self, follow: Callable[[], None] = lambda: None) -> None:
        """Search the structures until the search is complete or the deadline has passed."""
        if self.library is not None:
            effects, structures = frozenset(e.name for e in self.reconsidered), self.structures
            start = Structure(effects) if effects and effects <= {*structures.candidates} else None
            if start and not effects.isdisjoint(structures.excluded_candidates(start)):
                start = None
            self.stopped = explore(self.library, self.max_effects, start, follow)

    @property
    def structures(self) -> Structures:
        """Return the structures over the first model, with the evaluated ones."""
        assert self.library is not None
        return self.library.structures

    @property
    def chosen_structure(self) -> Structure:
        """Return the selected structure: the median probability model, or the best one if the search ended early."""
        posterior = Posterior.from_structures(self.structures)
        return posterior.best if self.stopped else posterior.median_structure

    def find_missing(self, structure: Structure) -> discover.Discovery:
        """Find the effects missing from a structure."""
        assert self.library is not None
        return discover.find_missing(self.library, structure, self.untestable, self.stopped)

    def iterate_path(
        self, goal: Structure, start: Structure | None = None
    ) -> Iterator[tuple[Structure | None, Structure, discover.Discovery | None]]:
        """Yield (previous structure, structure, missing effects) of each step to a goal; fewer if time is short."""
        assert self.library is not None
        has_discovery = self.max_effects > 0 and self.steps[0].calibration.verdict.ok
        previous, steps = None, [start or Structure(), goal]
        with suppress(deadline.TimeIsUp), deadline.shorten(1 / 2) as half_limit:
            steps = steps if self.stopped else find_path(self.library, goal, steps[0])
        for structure in dict.fromkeys(steps):
            if previous is None or structure == goal or not half_limit.is_over:
                yield previous, structure, self.find_missing(structure) if has_discovery else None
                previous = structure

    def fit_path(self, follow: Callable[[SearchPath], None] = lambda _: None) -> SearchPath:
        """Fit each model on the path to the selected structure, or the best one after an early end; return the path."""
        if self.library is None:
            reason = f"The search was not run. {' '.join(map(str, self.steps[0].failures))}"
            search = Search((), 0, complete=True, stopped=reason)
            return SearchPath(*assess_steps(self.steps), self.holdout, None, search)
        # If the search ended early nothing more is evaluated: the best structure at its end is used.
        search = self.summarise_search(stopped=self.stopped) if self.stopped else None
        goal, discoveries = self.chosen_structure, list[discover.Discovery | None]()
        for previous, structure, discovery in self.iterate_path(goal):
            discoveries.append(discovery)
            if previous is not None:
                self.steps += [self.fit_structure(structure, previous, structure == goal)]
                follow(self.build_path(search))
        if len(self.steps) == 1 and self.method != QUICK:
            self.steps = [self.fit_structure(goal, None, is_last=True)]
        pairs = zip(self.steps, discoveries, strict=True)
        path = self.average_path([replace(s, discovery=d) for s, d in pairs], goal, search)
        self.library.cached_columns.clear()
        self.structures.clear_cache()
        return path

    def average_path(
        self, steps: Sequence[Step], goal: Structure, search: Search | None = None
    ) -> SearchPath:
        """Return the search path of given steps; the last one is assessed, and averaged over the structures."""
        structures, (*earlier, last) = self.structures, steps
        if (discovery := last.discovery) is not None:
            if reason := "" if self.stopped else self.why_incomplete(steps):
                last = replace(last, discovery=discovery.without_completeness(reason))
            probabilities = {c.effect: c.probability for c in discovery.candidates}
            names = {e.name: probabilities.get(e.name) for e in self.reconsidered}
            dropped = {n: p for n, p in names.items() if n not in last.calibration.model.names}
            listing = ", ".join(f"{n} (probability {probability(p)})" for n, p in dropped.items())
            note = f"Effects of the given model that the search removed: {listing}."
            last = last.with_notes([note] * bool(listing))
        average, shares = last.calibration, ()
        if self.max_effects > 0 and average.verdict.ok:
            try:
                average, shares = average_models(average, structures, goal.noise, self.seed)
            except deadline.TimeIsUp as early:
                last = last.with_notes([f"Not averaged over structures ({early})."])
                average = last.calibration
            single_fit, average = add_latent_effects(last.calibration, average, structures, goal)
            last = replace(last, calibration=single_fit)
        is_single = last.calibration is average
        steps, gate = assess_steps([*earlier, self.test_on_holdout(last, average, structures)])
        if self.max_effects > 0 and average.verdict.ok:
            discovery = last.discovery
            completeness = discovery.nothing_missing if discovery and gate.ok else None
            *earlier, last = steps
            pair = last.calibration, average
            single_fit, average = (add_inadequacy(c, completeness, structures, goal) for c in pair)
            steps = [*earlier, replace(last, calibration=single_fit)]
        search = search or self.summarise_search(complete=not self.stopped, stopped=self.stopped)
        options = {"other_path": _find_other_path(structures), "search": search, "shares": shares}
        path = SearchPath(tuple(steps), gate, self.holdout, **options)
        if is_single:
            return path
        verdict = path.final.calibration.verdict
        notes = dict.fromkeys((*verdict.notes, *average.verdict.notes))
        last_verdict = {"against": verdict.against, "checked": verdict.checked}
        return replace(path, average=average.with_verdict(**last_verdict, notes=tuple(notes)))

    def test_on_holdout(self, step: Step, in_use: Calibration, structures: Structures) -> Step:
        """Return the step with a test of the calibration to use, `in_use`, on the hold-out data, if there are any."""
        if self.holdout is None or step.holdout_test is None:
            return step
        candidates = step.discovery.candidates if step.discovery else ()
        tested_candidates = (c for c in candidates if c.kind != "not testable")
        detectable_sizes = {c.effect: c.minimum_detectable for c in tested_candidates}
        deviations = []
        for name, effect in structures.base.instrument.known.items():
            c = effect.coefficients[0]
            if c.per != "run" or c.group_sd is None or effect.shapes or name in in_use.model.names:
                continue
            min_size = detectable_sizes.get(name)
            deviations.append((effect, c.size if min_size is None else min(c.size, min_size)))
        test = HoldoutTest(in_use, self.holdout, predict(in_use, self.holdout), tuple(deviations))
        return replace(step, holdout_test=test)

    def fit_structure(
        self, structure: Structure, previous: Structure | None, is_last: bool = False
    ) -> Step:
        """Fit and check a structure as the step that follows `previous`; fit the last step by the user's method."""
        evaluation = self.structures.evaluate(structure)
        model = evaluation.sized_model
        method = self.method if is_last else self.step_method(model)
        step, added, description = self.fit_step(model, method, evaluation.phi), None, ""
        if previous is not None:
            added = " + ".join(sorted(structure.effects - previous.effects)) or None
            if structure.noise != previous.noise:
                description = f"noise widened: {model.noise.in_words}"
        return replace(step, added=added, description=description)

    def build_path(self, search: Search | None = None, steps: Sequence[Step] = ()) -> SearchPath:
        """Return the search path so far; the verdict on its last model says that the search is still running."""
        *earlier, last = steps or self.steps
        steps = (*earlier, last.with_reasons((UNFINISHED.reason,)))
        return SearchPath(steps, UNFINISHED, self.holdout, None, search or self.summarise_search())

    def why_incomplete(self, steps: Sequence[Step]) -> str:
        """Return why the probability that the last model is complete is not stated; empty if it can be stated."""
        added_count, last = sum(s.added is not None for s in steps), steps[-1]
        candidates = last.discovery.candidates if last.discovery else ()
        has_probability = any(c.probability is not None for c in candidates)
        # At the bound on effects P(complete) would be high only because no further effect is allowed.
        if 0 < self.max_effects <= added_count and has_probability:
            return f"not stated, as the search added its maximum of {added_count} effects (--max-effects)"
        if last.leave_one_group_out and find_better_left_out(last, steps[:-1]):
            return f"not stated, as the {scheme(last.leave_one_group_out.group)} error is above an earlier step's"
        return ""

    def fit_step(
        self, model: Model, method: Method | None, start: Mapping[str, float] = NO_START
    ) -> Step:
        """Fit a model, from starting values of φ if given, and check it; return the step."""
        options: dict[str, Any] = {"seed": self.seed, "reference": self.reference, "start": start}
        calibration = fit(model, self.readings, method, strict=False, **options)
        with track("checking"):
            return check_step(calibration, self.holdout, self.accepted_conflicts)

    def summarise_search(self, *, complete: bool = False, stopped: str = "") -> Search | None:
        """Return a summary of the search so far; None if no search is run."""
        if self.library is None:
            return None
        how = {"seconds": time.monotonic() - self.start_time, "max_effects": self.max_effects}
        return Search.summarise(self.library.structures, complete=complete, stopped=stopped, **how)


def check_step(
    calibration: Calibration, holdout: Measurements | None = None, accepted: Collection[str] = ()
) -> Step:
    """Check a fit and return it as a step with its errors; InputError if noise is below the output's precision."""
    if message := judgement.explain_missing_noise(calibration):
        raise InputError(message)
    checks, floor_sd, prediction, test = check(calibration), noise_floor(calibration), None, None
    if holdout is not None:
        prediction = predict(calibration, holdout)
        test = HoldoutTest(calibration, holdout, prediction)
    return Step(
        calibration=calibration,
        added=None,
        rmse=predict(calibration).rmse,
        rmse_fitted=float(np.sqrt(np.mean(checks.residuals**2))),
        holdout_rmse=None if prediction is None else prediction.rmse,
        holdout_test=test,
        leave_one_group_out=leave_one_group_out(calibration),
        noise_floor=floor_sd,
        check=checks,
        discovery=None,
        failures=judgement.contradictions(calibration, floor_sd, accepted),
        outlying_groups=tuple(judgement.group_conflicts(judgement.Subject(calibration, accepted))),
    )


def prepare_readings(
    model: Model,
    readings: Measurements,
    holdout: Measurements | None,
    keep_spikes: bool,
    *causes: Any,
) -> tuple[Measurements, Measurements | None]:
    """Return readings and hold-out data on a common clock, without outliers, with a flag if the data share readings."""
    readings = discover.restrict_causes(readings, model.instrument, *causes)
    clean = exclude_faults(readings, keep_spikes, model.columns)
    if holdout is None:
        return clean, None
    model.require(holdout)
    time_effects = "effects that may be found, such as a drift" * readings.has("time")
    aligned_holdout = holdout.align_clock(readings.since, lambda: time_effects)
    clean_holdout = exclude_faults(aligned_holdout, keep_spikes, model.columns)
    flag = flag_fitted_holdout(clean, clean_holdout)
    if not flag and (runs := clean.find_continuations(clean_holdout)):
        flag = (
            f"{clean.file}: {sum(map(len, runs.values()))} readings of the hold-out data continue its run "
            f"{', '.join(runs)}: they are predicted with the record's past (lags, hysteresis, correlated noise)"
        )
    return (replace(clean, flags=(*clean.flags, flag)) if flag else clean), clean_holdout


def _find_other_path(structures: Structures) -> OtherPath | None:
    """Return the best model under another noise law, if its effects differ and it is nearly as probable."""
    best, window = structures.best, settings().strong_evidence
    others = [w for w in structures.visited.values() if w.structure.noise != best.structure.noise]
    other_fit = max(others, key=lambda w: w.log_posterior, default=None)
    if other_fit is None or not structures.is_in_window(other_fit.log_posterior, window):
        return None
    if other_fit.structure.effects == best.structure.effects:
        return None
    law, log_ratio = other_fit.problem.noise, other_fit.log_posterior - best.log_posterior
    is_correlated = law.independent != best.problem.noise.independent
    effects = tuple(sorted(other_fit.structure.effects))
    return OtherPath(law.name, effects, log_ratio, law.in_words, is_correlated)
