"""The loop: compare with the readings, see where it fails, learn what is missing, add it, watch the error fall."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import pairwise
from operator import sub
from typing import Any

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import check
from bayescal._calibration.fit import fit
from bayescal._calibration.guards import PRIOR, following_members, too_different
from bayescal._calibration.holdout_contradiction import HoldoutTest
from bayescal._calibration.judgement import noiseless, wrong_question
from bayescal._calibration.leave_group_out import leave_one_group_out, scheme
from bayescal._calibration.noise_in_time import noise_floor
from bayescal._calibration.predict import predict
from bayescal._core import deadline
from bayescal._core.deadline import Handover
from bayescal._core.errors import InputError, TimeIsUp
from bayescal._core.formatting import probability
from bayescal._core.progress import stage, tell
from bayescal._core.settings import settings
from bayescal._data.measurements import Measurements
from bayescal._data.set_aside import said_of, set_aside
from bayescal._data.time_in_runs import going_on
from bayescal._inference.laplace import NOTHING_KNOWN
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.marginal import NOT_SAMPLED
from bayescal._inference.method import Method
from bayescal._model.effect import Effect
from bayescal._model.frame import Reference
from bayescal._model.model import Model, testable
from bayescal._model.unknown_effect import freed
from bayescal._search.candidate import Candidate
from bayescal._search.discover import (
    ENDED,
    WORK,
    discovery_at,
    placeholders,
    structures_over,
    walked,
    with_causes,
)
from bayescal._search.gate import judged, left_out_better
from bayescal._search.library import Library
from bayescal._search.posterior import OtherPath, Posterior, Search, ShownStructure
from bayescal._search.search_path import Gate, SearchPath, Step
from bayescal._search.structure_average import averaged
from bayescal._search.structures import Structure, Structures
from bayescal._search.walk import STOPPED, path

QUICK = LeastSquares(draws=500)
NOT_LOOKED = "Nothing was looked for."
CUT = "The search was ended after {:.0f} s ({}), {}: more time may find more."
NO_SECOND = "before a second structure was weighed"
# For a larger model to be fitted and checked: times what the first step took, s more, and s more still after Ctrl-C.
FITTED, SOONEST, PATIENT = 3.0, 3.0, 10.0
UNJUDGED = "Whether the last model is to be used was not judged ({})."
UNDER_WAY = Gate(False, "The search is under way: this model is not its end.")


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
    seed: int = 0,
    reference: Reference | None = None,
    time_limit: float | None = None,
    seeds: Sequence[Structure | ShownStructure] = (),
    accept_conflicts: Collection[str] = (),
    ignore: Collection[str] = (),
    covariates: Collection[str] | None = None,
    follow: Callable[[SearchPath], None] = lambda _: None,
) -> SearchPath:
    """Fit, check, find what is missing, add it and fit again: the most probable structure, and the way to it.

    The structures weighed differ by the effects added and by the noise law. What is more probable than not is in the
    model shown, and called missing from a probability of 0.95; what is used is the average over the structures. The
    steps lead from the model given to the one shown, at each what gains most.

    Args:
        model: to begin with. What it has beside the instrument's baseline is where the search begins, and weighed anew
            with all else, so that every model on the way leads to one end. What stays: effects that are no candidates
            of the instrument, that these readings cannot test, or of which an unknown is fixed; all named ones of a
            model that lacks a part of the baseline; and all where `max_effects` is 0.
        readings: to fit.
        holdout: hold-out data: read after the last step, and never used to choose an effect.
        effects: further candidates of the user's own.
        method: of the last fit; `Marginal()` if not given. Steps on the way are fitted by least squares.
        max_effects: most effects to add.
        widen_noise: False leaves the noise law as given, whatever the residuals look like.
        keep_spikes: False sets single readings far from both neighbours aside, and those at which a thermometer that
            the model needs was wrong, and flags them; clipped ones always.
        seed: of every random number.
        reference: constants of the bases to use in place of the readings' own.
        time_limit: seconds for everything; the search gets six tenths of them, and what was left out is said. Ctrl-C
            ends with what there is at any time.
        seeds: structures to weigh first: `trail.search.structures` of a search of these readings that was ended early.
        accept_conflicts: coefficients or effects that may differ greatly from their priors; else nothing is looked for.
        ignore: columns that are no causes.
        covariates: of the columns that the instrument does not know, those that may be causes; None for all but other
            channels of the unit.
        follow: called with the trail so far, as soon as the first model stands and whenever it grows.

    Raises:
        ModelError: the readings lack what the model needs.
        InputError: there is no such column to ignore or to allow.
        TimeIsUp: the time limit came before the first model was fitted.
    """

    def run() -> SearchPath:
        causes = with_causes(readings, model.instrument, ignore, covariates)
        used = set_aside(causes, keep_spikes, model.columns)
        kept = None if holdout is None else set_aside(holdout, keep_spikes, model.columns)
        used, accepted = _said_of_holdout(used, kept), frozenset(accept_conflicts)
        loop = Loop(used, kept, method, seed, reference, max_effects, accepted, resumed=len(seeds))
        loop, first = loop.begin(model)
        # Stated values that the readings contradict: the value may be wrong, or an effect missing; the search weighs
        # both.
        more = loop.freed(first)
        if first.against and not more:
            return loop.not_looked(first)
        loop, structures, shut = loop.open(first, (*effects, *more), widen_noise)
        tell = partial(loop.tell, [first], structures, deadline.door(), follow)
        tell()
        deadline.allow(loop.grace)
        try:
            library, stopped = loop.look(Library(structures), seeds, tell)
        except TimeIsUp as early:
            return loop.not_searched(first, early.why)
        return loop.to_best(first, library, shut, stopped, follow)

    if holdout is not None:
        model.require(holdout)
    with deadline.until(time_limit), deadline.share(WORK):
        return deadline.within(run)


@dataclass(frozen=True)
class Loop:
    """What stays the same from step to step: see `calibrate`."""

    readings: Measurements
    holdout: Measurements | None
    method: Method | None
    seed: int
    reference: Reference | None
    max_effects: int
    accepted: frozenset[str]
    begun: float = 0.0  # of the search
    step_takes: float = 0.0  # s, as the first one did
    given: tuple[Effect, ...] = ()  # of the model given, to be weighed anew
    resumed: int = 0  # structures of an earlier search, which are weighed first

    def begin(self, model: Model) -> tuple[Loop, Step]:
        """The first step, of the model without what is weighed anew.

        Whether an effect belongs there is what the search is to say: kept because the search began with it, it would
        hide rivals that the same search finds from the baseline.
        """
        before = time.monotonic()
        # Where nothing is looked for, nothing is weighed.
        looked_at = model.effects if self.max_effects > 0 else ()
        given = [e for e in looked_at if self.weighs(e, model)]
        model = reduce(sub, given, model)
        first = self.step(model, method=self.quick(model))
        now = time.monotonic()
        most = max(self.max_effects, len(given))
        taken = {"begun": now, "step_takes": now - before, "given": tuple(given)}
        reference = first.calibration.reference
        return replace(self, max_effects=most, reference=reference, **taken), first

    def weighs(self, effect: Effect, model: Model, further: Collection[str] = ()) -> bool:
        """Return whether an effect of a model is weighed anew; `further` candidates are, beside the instrument's."""
        instrument, readings = model.instrument, self.readings
        if effect.is_placeholder:
            return effect.name in {e.name for e in placeholders(model, readings)}
        on_the_way = {e.name for e in instrument.effects} <= {*model.names}
        catalogued = {*instrument.known, *further} - {e.name for e in instrument.effects}
        free = (model - effect).fixed == model.fixed
        testable_here = testable(effect, readings) is None
        return on_the_way and effect.name in catalogued and free and testable_here

    def open(
        self, first: Step, effects: Sequence[Effect], widen_noise: bool
    ) -> tuple[Loop, Structures, list[Candidate]]:
        """The structures to look at beyond the first step, and the candidates that these readings cannot test."""
        loop, c, fixed = self, first.calibration, first.check.fixed
        # Without convergence there are no probabilities; and a published calibration that fails is not saved.
        if not c.verdict.ok or (fixed is not None and fixed.wrong):
            loop, widen_noise = replace(self, max_effects=0), False
        # Of the same name as one of the catalogue, the given one counts: its size may be the user's own.
        named = [e for e in self.given if not e.is_placeholder]
        structures, shut = structures_over(
            c.model, self.readings, c.reference, effects=(*effects, *named), widen_noise=widen_noise
        )
        return loop, structures, shut

    def freed(self, first: Step) -> tuple[Effect, ...]:
        """Effects of the first model once more, free of stated values that the readings contradict.

        None where something else stands against the model. A contradiction is a finding: the value is wrong, or an
        effect is missing that it stands in for, and the search weighs both.
        """
        if any(one.code != PRIOR for one in first.against):
            return ()
        model, away = first.calibration.model, dict[str, float]()
        for one in first.against:
            effect = one.of[1]
            away[effect] = max(one.numbers["away"], away.get(effect, 0.0))
        named = {name: model.effect(name) for name in away}
        if any(e.shapes or e.is_placeholder or e.coefficients[0].per for e in named.values()):
            return ()
        # As wide as the next power of ten above the distance: the width is part of the evidence, and to be stated,
        # not tuned.
        return tuple(freed(e, 10 ** math.ceil(math.log10(away[n]))) for n, e in named.items())

    @property
    def finish_takes(self) -> float:
        """How long the fit of a larger model, its checks and its judgement may take, s."""
        return SOONEST + FITTED * self.step_takes

    @property
    def grace(self) -> float:
        """What these are allowed after Ctrl-C, s."""
        return PATIENT + self.finish_takes

    def quick(self, model: Model) -> Method | None:
        """How steps on the way are fitted: not sampled, for their errors and evidence need no draws.

        Under a heavy-tailed law they do, if there is time.
        """
        limited = deadline.current().ends_at < math.inf
        return QUICK if model.noise.gaussian or limited else self.method

    def not_looked(self, first: Step) -> SearchPath:
        """What is left of the loop where nothing can be learnt from the first model."""
        search = Search(
            (), 0, complete=True, stopped=f"{NOT_LOOKED} {' '.join(map(str, first.against))}"
        )
        return SearchPath(*judged((first,)), self.holdout, None, search)

    def look(
        self,
        library: Library,
        seeds: Sequence[Structure | ShownStructure] = (),
        tell: Callable[[], None] = lambda: None,
    ) -> tuple[Library, str]:
        """Walk over the structures: these as weighed, and why the walk ended early, if it did.

        Raises:
            TimeIsUp: not even the first model was weighed.
        """
        structures = library.structures
        asked = dict.fromkeys(Structure(frozenset(s.effects), s.noise) for s in seeds)
        known = [s for s in asked if self._may_be(s, structures)]
        given = Structure(frozenset(e.name for e in self.given))
        last = given if given.effects and self._may_be(given, structures) else None
        keep = min(self.finish_takes, 0.5 * deadline.current().left)
        return walked(library, self.max_effects, lambda _: tell(), known, last, keep)

    def _may_be(self, s: Structure, structures: Structures) -> bool:
        return (
            s.effects <= set(structures.candidates)
            and s.effects.isdisjoint(structures.barred(s))
            and len(s.effects) <= self.max_effects
            and s.noise in ("", *structures.laws)
        )

    def to_best(
        self,
        first: Step,
        library: Library,
        shut: Sequence[Candidate],
        stopped: str,
        follow: Callable[[SearchPath], None] = lambda _: None,
    ) -> SearchPath:
        """Fit the models on the way to the most probable structure; where Ctrl-C leaves no time for them, it alone.

        Raises:
            TimeIsUp: a time limit came, or Ctrl-C once more.
        """

        def steps(hurried: bool, why: str = stopped) -> SearchPath:
            return self.steps_to_best(first, library, shut, why, follow, hurried)

        hurried = deadline.current().interrupted
        with deadline.grace(self.grace) as end:
            try:
                return steps(hurried)
            except (TimeIsUp, KeyboardInterrupt) as early:
                if hurried or (isinstance(early, TimeIsUp) and not end.interrupted):
                    raise
        with deadline.grace(self.grace):
            return steps(True, stopped or STOPPED.format(time.monotonic() - self.begun))

    def steps_to_best(
        self,
        first: Step,
        library: Library,
        shut: Sequence[Candidate],
        stopped: str,
        follow: Callable[[SearchPath], None] = lambda _: None,
        hurried: bool = False,
    ) -> SearchPath:
        """Fit the models on the way to the most probable structure; that alone, and as it is, where this is hurried."""
        structures, steps, to = library.structures, [first], deadline.door()
        chosen = Posterior.of(structures).chosen
        # As long as the first step took, each: what further effects cost is not known before they are fitted.
        takes = self.step_takes * (1 + len(chosen.effects) + bool(chosen.noise))
        in_time = takes < deadline.current().left and not hurried
        way = path(library, chosen) if in_time else [*dict.fromkeys([Structure(), chosen])]
        # Where a limit may end sampling, the last model stands before it begins; after Ctrl-C it is fitted anew.
        limited = deadline.current().ends_at < math.inf
        twice = limited and not isinstance(self.method, LeastSquares)
        if hurried and len(way) > 1:
            best = " + ".join(sorted(chosen.effects)) or "the first model under another noise law"
            tell(f"interrupted: fitting the best so far, {best}; Ctrl-C again does not wait for it")
        for before, at in pairwise(way):
            weighed = structures.weigh(at)
            model = weighed.sized_model
            once = at == way[-1] and not (twice or hurried)
            method = self.method if once else self.quick(model)
            steps.append(self.step(model, before, at, method=method, start=weighed.phi))
            self.tell(steps, structures, to, follow)
        if hurried and self.method != QUICK:
            steps[-1] = steps[-1].noted([NOT_SAMPLED.format(deadline.current().limit)])
        elif self.method != QUICK and (len(way) == 1 or twice):
            steps[-1] = self.sampled(steps[-1], structures.weigh(way[-1]).phi)
            self.tell(steps, structures, to)
        if first.calibration.verdict.ok and self.max_effects > 0:  # else nothing was looked for
            steps = [
                replace(s, discovery=discovery_at(library, at, shut, stopped))
                for s, at in zip(steps, way, strict=False)
            ]
        return self.averaged(steps, structures, way[-1].noise, stopped)

    def averaged(
        self, steps: Sequence[Step], structures: Structures, noise: str, stopped: str = ""
    ) -> SearchPath:
        """Judge the last of some steps, and average it over the structures that were weighed.

        Args:
            steps: on the way to the structure that the posterior chooses, each with what is missing from it.
            structures: that were weighed.
            noise: law of the last step.
            stopped: why the search ended early; empty where it did not.
        """
        steps = list(steps)
        if found := steps[-1].discovery:
            if why := ENDED if stopped else self.incomplete(steps):
                steps[-1] = replace(steps[-1], discovery=found.not_stated(why))
            steps[-1] = self.said_of_given(steps[-1])
        last, shares = steps[-1].calibration, ()
        used = last
        if self.max_effects > 0 and last.verdict.ok:
            with suppress(TimeIsUp):  # what is used of it is an average over the structures
                used, shares = averaged(last, structures, noise, self.seed)
        steps[-1] = self.held_against(steps[-1], used, structures)
        trail = self.trail(steps, structures, complete=not stopped, stopped=stopped)
        if used is last:
            return replace(trail, shares=shares)
        verdict = trail.final.calibration.verdict
        notes = dict.fromkeys((*verdict.notes, *used.verdict.notes))
        of_last = {"against": verdict.against, "checked": verdict.checked}
        used = used.with_verdict(**of_last, notes=tuple(notes))
        return replace(trail, average=used, shares=shares)

    def held_against(self, step: Step, used: Calibration, structures: Structures) -> Step:
        """The last step, whose hold-out data are held against what is used of it."""
        if self.holdout is None or step.holdout_test is None:
            return step
        known = {c.effect: c for c in (step.discovery.candidates if step.discovery else ())}
        unseen = []
        for name, effect in structures.base.instrument.known.items():
            c = effect.coefficients[0]
            if c.per != "run" or c.group_sd is None or effect.shapes or name in used.model.names:
                continue
            seen = known.get(name)
            least = None if seen is None or seen.kind == "not testable" else seen.minimum_detectable
            unseen.append((effect, c.size if least is None else min(c.size, least)))
        found = predict(used, self.holdout)
        return replace(step, holdout_test=HoldoutTest(used, self.holdout, found, tuple(unseen)))

    def said_of_given(self, step: Step) -> Step:
        """The last step, noting what the model given has and the one to use has not."""
        c = step.calibration
        known = (
            {x.effect: x.probability for x in step.discovery.candidates} if step.discovery else {}
        )
        left = [e.name for e in self.given if e.name not in c.model.names]
        if not left:
            return step
        each = ", ".join(f"{n} (probability {probability(known.get(n))})" for n in left)
        note = f"Weighed anew and left out of the model given: {each}."
        return replace(step, calibration=c.with_verdict(notes=(*c.verdict.notes, note)))

    def sampled(self, step: Step, start: Mapping[str, float] = NOTHING_KNOWN) -> Step:
        """A step with its posterior sampled, as far as there is time for that and for checking it anew."""
        with deadline.share(keep=self.step_takes) as end:
            try:
                end.ask()
                found = self.step(step.calibration.model, method=self.method, start=start)
            except TimeIsUp as early:
                notes = (NOT_SAMPLED.format(early.why), *step.calibration.verdict.notes)
                return replace(step, calibration=step.calibration.with_verdict(notes=notes))
        return replace(found, added=step.added, changed=step.changed)

    def tell(
        self,
        steps: Sequence[Step],
        structures: Structures,
        to: Handover,
        follow: Callable[[SearchPath], None] = lambda _: None,
    ) -> None:
        """Hand over the trail so far, and say it to who follows."""
        steps = tuple(steps)
        so_far = self.trail(steps, structures, complete=False)
        with to.offering(lambda why: self.cut(steps, so_far.search, why)):
            follow(so_far)

    def not_searched(self, first: Step, why: str) -> SearchPath:
        """The first model alone, sampled and judged, where no second structure was weighed in time."""
        said = CUT.format(time.monotonic() - self.begun, why, NO_SECOND)
        search = Search((), 0, complete=False, stopped=said)
        if not isinstance(self.method, LeastSquares):
            first = self.sampled(first)
        return SearchPath(*judged((first,)), self.holdout, None, search)

    def cut(self, steps: Sequence[Step], search: Search | None, why: str) -> SearchPath:
        """A trail that was ended before its last model was found or judged."""
        search = search or Search((), 0, complete=False)
        best, at = next(iter(search.structures), None), "with this as the best so far"
        # Whether what was found most probable is what the last step holds decides what can be promised of it.
        if best is None:
            at = NO_SECOND
        elif not {*best.effects} <= {*steps[-1].calibration.model.names}:
            at = f"when {best} was the most probable so far, and was not fitted yet"
        ended = replace(search, stopped=CUT.format(time.monotonic() - self.begun, why, at))
        return self._unjudged(steps, Gate(False, UNJUDGED.format(why)), ended)

    def _unjudged(self, steps: Sequence[Step], gate: Gate, search: Search) -> SearchPath:
        """A trail whose last model says what stands against its use: that it is not the end."""
        steps = (*steps[:-1], steps[-1].judged((gate.reason,)))
        return SearchPath(steps, gate, self.holdout, None, search)

    def incomplete(self, steps: Sequence[Step]) -> str:
        """Why the last model may not be called complete, whatever its probability; empty where it may."""
        added, last = sum(s.added is not None for s in steps), steps[-1]
        candidates = last.discovery.candidates if last.discovery else ()
        tested = any(c.probability is not None for c in candidates)
        # At the bound, P(complete) is of what may be added no more: it would be high because nothing further is
        # allowed.
        if 0 < self.max_effects <= added and tested:
            return (
                f"not stated, as the search added the {added} effects that it may (--max-effects)"
            )
        if last.left_out and left_out_better(last, steps[:-1]):
            return f"not stated, as the {scheme(last.left_out.group)} error has risen on the way"
        return ""

    def step(
        self,
        model: Model,
        before: Structure | None = None,
        at: Structure | None = None,
        *,
        method: Method | None,
        start: Mapping[str, float] = NOTHING_KNOWN,
    ) -> Step:
        """Fit a model and check it, looking for its mode at `start` first."""
        how: dict[str, Any] = {"seed": self.seed, "reference": self.reference, "start": start}
        calibration = fit(model, self.readings, method, strict=False, **how)
        added, changed = None, ""
        if before is not None and at is not None:
            added = " + ".join(sorted(at.effects - before.effects)) or None
            if at.noise != before.noise:
                changed = f"noise widened: {model.noise.in_words}"
        with stage("checking"):
            found = step_of(calibration, self.holdout, self.accepted)
        return replace(found, added=added, changed=changed)

    def trail(
        self, steps: Sequence[Step], structures: Structures, *, complete: bool, stopped: str = ""
    ) -> SearchPath:
        search = Search.of(
            structures,
            complete=complete,
            stopped=stopped,
            seconds=time.monotonic() - self.begun,
            max_effects=self.max_effects,
            resumed=self.resumed,
        )
        if not (complete or stopped):
            return self._unjudged(steps, UNDER_WAY, search)
        return SearchPath(*judged(steps), self.holdout, _other_path(structures), search)


def step_of(
    calibration: Calibration,
    holdout: Measurements | None = None,
    accepted: Collection[str] = (),
) -> Step:
    """A fit as a step: checked, with its errors; what is missing from it is not asked yet.

    Args:
        calibration: the fit.
        holdout: hold-out data.
        accepted: coefficients or effects that may contradict their priors.

    Raises:
        InputError: the readings show no noise.
    """
    if said := noiseless(calibration):
        raise InputError(said)
    checked, floor, kept, test = check(calibration), noise_floor(calibration), None, None
    if holdout is not None:
        kept = predict(calibration, holdout)
        test = HoldoutTest(calibration, holdout, kept)
    return Step(
        calibration=calibration,
        added=None,
        rmse=predict(calibration).rmse,
        rmse_fitted=float(np.sqrt(np.mean(checked.residuals**2))),
        holdout_rmse=None if kept is None else kept.rmse,
        holdout_test=test,
        left_out=leave_one_group_out(calibration),
        noise_floor=floor,
        check=checked,
        discovery=None,
        against=wrong_question(calibration, floor, accepted),
        different=(
            *too_different(calibration, accepted),
            *following_members(calibration, accepted),
        ),
    )


def _said_of_holdout(readings: Measurements, holdout: Measurements | None) -> Measurements:
    """The readings with a flag, where hold-out data continue their record, or are a part of it."""
    if holdout is None:
        return readings
    said = said_of(readings, holdout)
    if not said and (going := going_on(readings, holdout)[0]):
        said = (
            f"{readings.file}: {sum(map(len, going.values()))} readings of the hold-out data continue its run "
            f"{', '.join(going)}: they are predicted with the record's past, so lags, hysteresis and correlated noise "
            "go on"
        )
    return replace(readings, flags=(*readings.flags, said)) if said else readings


def _other_path(structures: Structures) -> OtherPath | None:
    """The runner-up model: the best under another noise law, if it differs and is nearly as probable."""
    best = structures.best
    ends = [w for w in structures.visited.values() if w.structure.noise != best.structure.noise]
    other = max(ends, key=lambda w: w.total, default=None)
    if other is None or not other.total > best.total - settings().strong_evidence:
        return None
    # The same effects under another law are no other conclusion.
    if other.structure.effects == best.structure.effects:
        return None
    law, effects = other.problem.noise, tuple(sorted(other.structure.effects))
    correlated = law.independent != best.problem.noise.independent
    return OtherPath(law.name, effects, other.total - best.total, law.in_words, correlated)
