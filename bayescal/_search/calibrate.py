"""The loop: compare with the readings, see where it fails, learn what is missing, add it, watch the error fall."""

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
from bayescal._core.progress import stage
from bayescal._core.settings import seed_of, settings
from bayescal._data.measurements import Measurements
from bayescal._data.set_aside import said_of, set_aside
from bayescal._inference.laplace import NOTHING_KNOWN
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.method import Method
from bayescal._model.effect import Effect
from bayescal._model.frame import Reference
from bayescal._model.model import Model, why_untestable
from bayescal._model.unknown_effect import freed
from bayescal._search import discover
from bayescal._search.candidate import Candidate
from bayescal._search.gate import judged, left_out_better
from bayescal._search.library import Library
from bayescal._search.posterior import OtherPath, Posterior, Search
from bayescal._search.search_path import Gate, SearchPath, Step
from bayescal._search.structure_average import averaged, with_form, with_latent
from bayescal._search.structures import Structure, Structures
from bayescal._search.walk import explore, path

QUICK = LeastSquares(draws=500)
NOT_LOOKED = "Nothing was looked for."
NOT_AVERAGED = "Not averaged over the structures ({}): this is the one shown, alone."
BASE = Structure()
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
    seed: int | np.random.Generator = 0,
    reference: Reference | None = None,
    time_limit: float | None = None,
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
        time_limit: seconds for everything; the search gets two thirds of what the first model leaves, and what was left
            out is said. The first model is fitted in any case, and so is the most probable structure that was
            evaluated: they may take longer. Ctrl-C ends at any time with what there is; pressed again, with nothing.
        accept_conflicts: coefficients or effects that may differ greatly from their priors; else nothing is looked for.
        ignore: columns that are no causes.
        covariates: of the columns that the instrument does not know, those that may be causes; None for all but other
            channels of the unit.
        follow: called with the trail so far: once a second while structures are evaluated, when that ends, and with
            each model fitted after it.

    Raises:
        ModelError: the readings lack what the model needs.
        InputError: there is no such column to ignore or to allow; of readings and hold-out data one has dates and the
            other none.
    """
    with deadline.until(time_limit):
        used = prepared(model, readings, holdout, keep_spikes, ignore, covariates)
        how = method, seed_of(seed), reference, max_effects
        loop = Loop(*used, *how, frozenset(accept_conflicts))
        loop.begin(model, effects, widen_noise)
        follow(loop.trail())
        with deadline.sooner(discover.SEARCH):
            loop.look(lambda: follow(loop.trail()))
        return loop.to_best(follow)


@dataclass(eq=False)
class Loop:
    """One search: what is asked (see `calibrate`), and how it stands."""

    readings: Measurements
    holdout: Measurements | None
    method: Method | None
    seed: int
    reference: Reference | None
    max_effects: int
    accepted: frozenset[str]
    started: float = 0.0  # by `time.monotonic`, s
    reconsidered: tuple[Effect, ...] = ()  # effects of the model given that are evaluated anew
    steps: list[Step] = field(default_factory=list)  # models fitted so far
    library: Library | None = None  # structures evaluated; None where nothing can be looked for
    shut: Sequence[Candidate] = ()  # candidates that these readings cannot test
    stopped: str = ""  # why the walk ended early; empty where it did not

    def begin(self, model: Model, effects: Sequence[Effect], widen_noise: bool) -> None:
        """Fit the first step, of the model without what is weighed anew, and open what is to be searched beyond it.

        Whether an effect belongs there is what the search is to say: kept because the search began with it, it would
        hide rivals that the same search finds from the baseline.
        """
        known_names = (*model.names, *model.instrument.known, *(e.name for e in effects), "noise")
        for name in self.accepted:
            if not any(name == k or name.startswith((f"{k}[", f"{k}.")) for k in known_names):
                has = ", ".join(model.names)
                raise InputError(
                    f"no effect or coefficient is called {name!r}; the model has {has}"
                )
        # Where nothing is looked for, nothing is weighed.
        looked_at = model.effects if self.max_effects > 0 else ()
        self.reconsidered = tuple(e for e in looked_at if self.is_reconsidered(e, model))
        model = reduce(sub, self.reconsidered, model)
        with deadline.finishing():  # whatever the time limit
            first = self.step(model, self.quick(model))
        deadline.current().defer_interrupt()
        self.max_effects = max(self.max_effects, len(self.reconsidered))
        self.reference = first.calibration.reference
        self.steps, freed_effects = [first], self.freed(first)
        if freed_effects or not first.failures:
            self.open(first, (*effects, *freed_effects), widen_noise)

    def is_reconsidered(self, effect: Effect, model: Model) -> bool:
        """Return whether an effect of a model is weighed anew."""
        instrument, readings = model.instrument, self.readings
        if effect.is_placeholder:
            return effect.name in {e.name for e in discover.placeholders(model, readings)}
        on_the_way = {e.name for e in instrument.effects} <= {*model.names}
        baseline_effects = (*instrument.effects, *instrument.nuisances)
        catalogued = {*instrument.known} - {e.name for e in baseline_effects}
        free = (model - effect).fixed == model.fixed
        testable_here = why_untestable(effect, readings) is None
        return on_the_way and effect.name in catalogued and free and testable_here

    def open(self, first: Step, effects: Sequence[Effect], widen_noise: bool) -> None:
        """Have structures to look at beyond a step that is fitted."""
        self.started = time.monotonic()
        self.steps, c, fixed = [first], first.calibration, first.check.fixed
        # Without convergence there are no probabilities; and a published calibration that fails is not saved.
        if not c.verdict.ok or (fixed is not None and fixed.wrong):
            self.max_effects, widen_noise = 0, False
        # Of the same name as one of the catalogue, the given one counts: its size may be the user's own.
        named = [e for e in self.reconsidered if not e.is_placeholder]
        how = {"widen_noise": widen_noise, "latent": self.max_effects > 0}
        structures, self.shut = discover.structures_over(
            c.model, self.readings, c.reference, effects=(*effects, *named), **how
        )
        self.library = Library(structures)

    def freed(self, first: Step) -> tuple[Effect, ...]:
        """Return the effects of the first model whose stated values the readings contradict, with wide priors.

        None where something else stands against the model. A contradiction is a finding: the value is wrong, or an
        effect is missing that it stands in for, and the search weighs both.
        """
        if any(claim.code != judgement.PRIOR_CODE for claim in first.failures):
            return ()
        model, away = first.calibration.model, dict[str, float]()
        for claim in first.failures:
            effect = claim.subjects[1]
            away[effect] = max(claim.numbers["away"], away.get(effect, 0.0))
        named = {name: model.effect(name) for name in away}
        if any(e.shapes or e.is_placeholder or e.coefficients[0].per for e in named.values()):
            return ()
        # As wide as the next power of ten above the distance: the width is part of the evidence, stated, not tuned.
        return tuple(freed(e, 10 ** math.ceil(math.log10(away[n]))) for n, e in named.items())

    def quick(self, model: Model) -> Method | None:
        """Return the method of steps on the way: least squares, but under a heavy-tailed law if there is time."""
        limited = deadline.current().ends_at < math.inf
        return QUICK if model.noise.gaussian or limited else self.method

    def look(self, follow: Callable[[], None] = lambda: None) -> None:
        """Walk over the structures, to the end or the deadline."""
        if self.library is not None:
            effects, structures = frozenset(e.name for e in self.reconsidered), self.structures
            start = Structure(effects) if effects and effects <= {*structures.candidates} else None
            if start and not effects.isdisjoint(structures.barred(start)):
                start = None
            self.stopped = explore(self.library, self.max_effects, start, follow)

    @property
    def structures(self) -> Structures:
        """Return the structures over the first model, with what was evaluated of each."""
        assert self.library is not None
        return self.library.structures

    @property
    def goal(self) -> Structure:
        """Return the structure to use; of a walk that ended early the best that it evaluated."""
        posterior = Posterior.of(self.structures)
        return posterior.best if self.stopped else posterior.chosen

    def missing(self, at: Structure) -> discover.Discovery:
        """Return what is missing from a structure."""
        assert self.library is not None
        return discover.missing(self.library, at, self.shut, self.stopped)

    def way(
        self, goal: Structure, start: Structure = BASE
    ) -> Iterator[tuple[Structure | None, Structure, discover.Discovery | None]]:
        """Yield (previous structure, structure, what is missing from it) up to a goal; fewer where time is short."""
        assert self.library is not None
        with_discovery = self.max_effects > 0 and self.steps[0].calibration.verdict.ok
        previous, steps = None, [start, goal]
        with suppress(deadline.TimeIsUp), deadline.sooner(1 / 2) as half:
            steps = steps if self.stopped else path(self.library, goal, start)
        for at in dict.fromkeys(steps):
            if previous is None or at == goal or not half.over:
                yield previous, at, self.missing(at) if with_discovery else None
                previous = at

    def to_best(self, follow: Callable[[SearchPath], None] = lambda _: None) -> SearchPath:
        """Fit the models on the way to the structure to use; of a walk that ended early, the best one alone."""
        if self.library is None:
            why = f"{NOT_LOOKED} {' '.join(map(str, self.steps[0].failures))}"
            search = Search((), 0, complete=True, stopped=why)
            return SearchPath(*judged(self.steps), self.holdout, None, search)
        # What was the best when the walk ended is what is returned: nothing is evaluated after that.
        search = self.search(stopped=self.stopped) if self.stopped else None
        goal, discoveries = self.goal, list[discover.Discovery | None]()
        for before, at, is_missing in self.way(goal):
            discoveries.append(is_missing)
            if before is not None:
                self.steps.append(self.fitted(at, before, last=at == goal))
                follow(self.trail(search))
        if len(self.steps) == 1 and self.method != QUICK:
            self.steps = [self.fitted(goal, None, last=True)]
        pairs = zip(self.steps, discoveries, strict=True)
        return self.averaged([replace(s, discovery=d) for s, d in pairs], goal, search)

    def averaged(
        self, steps: Sequence[Step], goal: Structure, search: Search | None = None
    ) -> SearchPath:
        """Judge the last of some steps, and average it over the structures that were weighed."""
        structures, (*before, last) = self.structures, steps
        if (discovery := last.discovery) is not None:
            if why := "" if self.stopped else self.incomplete(steps):
                last = replace(last, discovery=discovery.not_stated(why))
            probabilities = {c.effect: c.probability for c in discovery.candidates}
            names = {e.name: probabilities.get(e.name) for e in self.reconsidered}
            dropped = {n: p for n, p in names.items() if n not in last.calibration.model.names}
            listing = ", ".join(f"{n} (probability {probability(p)})" for n, p in dropped.items())
            note = f"Weighed anew and left out of the model given: {listing}."
            last = last.noted([note] * bool(listing))
        used, shares = last.calibration, ()
        if self.max_effects > 0 and used.verdict.ok:
            try:
                used, shares = averaged(used, structures, goal.noise, self.seed)
            except deadline.TimeIsUp as early:
                last = last.noted([NOT_AVERAGED.format(early)])
                used = last.calibration
            single, used = with_latent(last.calibration, used, structures, goal)
            last = replace(last, calibration=single)
        is_single = last.calibration is used
        steps, gate = judged([*before, self.with_holdout_test(last, used, structures)])
        if self.max_effects > 0 and used.verdict.ok:
            discovery = last.discovery
            complete = discovery.nothing_missing if discovery and gate.ok else None
            *before, last = steps
            pair = last.calibration, used
            single, used = (with_form(c, complete, structures, goal) for c in pair)
            steps = [*before, replace(last, calibration=single)]
        search = search or self.search(complete=not self.stopped, stopped=self.stopped)
        how = {"other_path": _other_path(structures), "search": search, "shares": shares}
        trail = SearchPath(tuple(steps), gate, self.holdout, **how)
        if is_single:
            return trail
        verdict = trail.final.calibration.verdict
        notes = dict.fromkeys((*verdict.notes, *used.verdict.notes))
        of_last = {"against": verdict.against, "checked": verdict.checked}
        return replace(trail, average=used.with_verdict(**of_last, notes=tuple(notes)))

    def with_holdout_test(self, step: Step, used: Calibration, structures: Structures) -> Step:
        """Return the last step with the hold-out data tested against the calibration in use."""
        if self.holdout is None or step.holdout_test is None:
            return step
        candidates = step.discovery.candidates if step.discovery else ()
        tested = (c for c in candidates if c.kind != "not testable")
        detectable = {c.effect: c.minimum_detectable for c in tested}
        unseen = []
        for name, effect in structures.base.instrument.known.items():
            c = effect.coefficients[0]
            if c.per != "run" or c.group_sd is None or effect.shapes or name in used.model.names:
                continue
            least = detectable.get(name)
            unseen.append((effect, c.size if least is None else min(c.size, least)))
        test = HoldoutTest(used, self.holdout, predict(used, self.holdout), tuple(unseen))
        return replace(step, holdout_test=test)

    def fitted(self, at: Structure, before: Structure | None, last: bool = False) -> Step:
        """Fit and check a structure, which follows another; the last one by the method asked for."""
        weighed = self.structures.weigh(at)
        model = weighed.sized_model
        step = self.step(model, self.method if last else self.quick(model), weighed.phi)
        added, changed = None, ""
        if before is not None:
            added = " + ".join(sorted(at.effects - before.effects)) or None
            changed = f"noise widened: {model.noise.in_words}" if at.noise != before.noise else ""
        return replace(step, added=added, description=changed)

    def trail(self, search: Search | None = None, steps: Sequence[Step] = ()) -> SearchPath:
        """Return the trail so far; its last model's verdict says that the search is under way."""
        *before, last = steps or self.steps
        steps = (*before, last.judged((UNDER_WAY.reason,)))
        return SearchPath(steps, UNDER_WAY, self.holdout, None, search or self.search())

    def incomplete(self, steps: Sequence[Step]) -> str:
        """Return why P(complete) of the last model is not to be stated; empty where it may be."""
        added, last = sum(s.added is not None for s in steps), steps[-1]
        candidates = last.discovery.candidates if last.discovery else ()
        tested = any(c.probability is not None for c in candidates)
        # At the bound P(complete) would be high because nothing further is allowed.
        if 0 < self.max_effects <= added and tested:
            most = f"the {added} effects that it may (--max-effects)"
            return f"not stated, as the search added {most}"
        if last.leave_one_group_out and left_out_better(last, steps[:-1]):
            return f"not stated, as the {scheme(last.leave_one_group_out.group)} error has risen on the way"
        return ""

    def step(
        self, model: Model, method: Method | None, start: Mapping[str, float] = NOTHING_KNOWN
    ) -> Step:
        """Fit a model and check it, looking for its mode at `start` first."""
        how: dict[str, Any] = {"seed": self.seed, "reference": self.reference, "start": start}
        calibration = fit(model, self.readings, method, strict=False, **how)
        with stage("checking"):
            return step_of(calibration, self.holdout, self.accepted)

    def search(self, *, complete: bool = False, stopped: str = "") -> Search | None:
        """Return a summary of the search so far."""
        if self.library is None:
            return None
        how = {"seconds": time.monotonic() - self.started, "max_effects": self.max_effects}
        return Search.of(self.library.structures, complete=complete, stopped=stopped, **how)


def step_of(
    calibration: Calibration, holdout: Measurements | None = None, accepted: Collection[str] = ()
) -> Step:
    """Check a fit, and give it with its errors as a step; refuse readings without noise."""
    if message := judgement.noiseless(calibration):
        raise InputError(message)
    checked, floor, prediction, test = check(calibration), noise_floor(calibration), None, None
    if holdout is not None:
        prediction = predict(calibration, holdout)
        test = HoldoutTest(calibration, holdout, prediction)
    return Step(
        calibration=calibration,
        added=None,
        rmse=predict(calibration).rmse,
        rmse_fitted=float(np.sqrt(np.mean(checked.residuals**2))),
        holdout_rmse=None if prediction is None else prediction.rmse,
        holdout_test=test,
        leave_one_group_out=leave_one_group_out(calibration),
        noise_floor=floor,
        check=checked,
        discovery=None,
        failures=judgement.contradictions(calibration, floor, accepted),
        outlying_groups=tuple(judgement.group_conflicts(judgement.Subject(calibration, accepted))),
    )


def prepared(
    model: Model,
    readings: Measurements,
    holdout: Measurements | None,
    keep_spikes: bool,
    *causes: Any,
) -> tuple[Measurements, Measurements | None]:
    """Return readings, flagged with what hold-out data have in common with them, and those data on their clock."""
    used = set_aside(
        discover.with_causes(readings, model.instrument, *causes), keep_spikes, model.columns
    )
    if holdout is None:
        return used, None
    model.require(holdout)
    finding = "what may be found, such as a drift" * readings.has("time")
    dated = holdout.on_clock(readings.since, lambda: finding)
    heldout = set_aside(dated, keep_spikes, model.columns)
    flag = said_of(used, heldout)
    if not flag and (going := used.continued_in(heldout)):
        flag = (
            f"{used.file}: {sum(map(len, going.values()))} readings of the hold-out data continue its run "
            f"{', '.join(going)}: they are predicted with the record's past (lags, hysteresis, correlated noise)"
        )
    return (replace(used, flags=(*used.flags, flag)) if flag else used), heldout


def _other_path(structures: Structures) -> OtherPath | None:
    """Return the runner-up model: the best under another noise law, if it differs and is nearly as probable."""
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
