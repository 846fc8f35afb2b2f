"""The loop: compare with the readings, see where it fails, learn what is missing, add it, watch the error fall."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fit import fit
from bayescal._calibration.predict import predict
from bayescal._core.progress import stage
from bayescal._diagnostics.check import check
from bayescal._diagnostics.evidence_scale import STRONG
from bayescal._diagnostics.leave_group_out import leave_one_group_out
from bayescal._diagnostics.noise_in_time import noise_floor
from bayescal._discovery.candidate import Candidate
from bayescal._discovery.discover import structures_over, told
from bayescal._discovery.gate import judged, wrong_question
from bayescal._discovery.search_path import Gate, SearchPath, Step
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.method import Method
from bayescal._model.effect import Effect
from bayescal._model.frame import Reference
from bayescal._model.model import Model
from bayescal._readings.measurements import Measurements
from bayescal._recording.set_aside import set_aside
from bayescal._search.library import Library
from bayescal._search.posterior import OtherPath, Posterior, Search, Shown
from bayescal._search.structures import Structure, Structures
from bayescal._search.walk import STOPPED, path, walk

QUICK = LeastSquares(draws=500)
NOT_LOOKED = "Nothing was looked for."
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
    seeds: Sequence[Structure | Shown] = (),
    accept_conflicts: Collection[str] = (),
    follow: Callable[[SearchPath], None] = lambda _: None,
) -> SearchPath:
    """Fit, check, find what is missing, add it and fit again: the most probable structure, and the way to it.

    The structures weighed differ by the effects added and by the noise law. What has a
    probability of 0.95 is added; the steps shown lead from the model given to the one chosen, at each what gains most.

    Args:
        model: to begin with.
        readings: to fit.
        holdout: hold-out data: read after the last step, and never used to choose an effect.
        effects: further candidates of the user's own.
        method: of the last fit; `Marginal()` if not given. Steps on the way are fitted by least squares.
        max_effects: most effects to add.
        widen_noise: False leaves the noise law as given, whatever the residuals look like.
        keep_spikes: False sets single readings far from both neighbours aside, and flags them; clipped ones always.
        seed: of every random number.
        reference: constants of the bases to use in place of the readings' own.
        time_limit: seconds of search after which the best so far is taken; Ctrl-C does the same at any time.
        seeds: structures to weigh first: `trail.search.structures` of a search of these readings that was ended early.
        accept_conflicts: coefficients or effects that may differ greatly from their priors; else nothing is looked for.
        follow: called with the trail so far, as soon as the first model stands and whenever it grows.

    Raises:
        ModelError: the readings lack what the model needs.
    """
    if holdout is not None:
        model.require(holdout)
    readings = set_aside(readings, keep_spikes)
    holdout = None if holdout is None else set_aside(holdout, keep_spikes)
    accepted = frozenset(accept_conflicts)
    loop = Loop(readings, holdout, method, seed, reference, max_effects, accepted, time_limit)
    loop, first = loop.begin(model)
    if first.against:
        return loop.not_looked(first)
    loop, structures, shut = loop.open(first, effects, widen_noise)
    return loop.search(first, Library(structures), shut, seeds, follow)


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
    time_limit: float | None = None
    begun: float = 0.0  # of the search

    def begin(self, model: Model) -> tuple[Loop, Step]:
        """The first step."""
        first = self.step(model, method=self.quick(model))
        return replace(self, begun=time.monotonic()), first

    def open(
        self, first: Step, effects: Sequence[Effect], widen_noise: bool
    ) -> tuple[Loop, Structures, list[Candidate]]:
        """The structures to look at beyond the first step, and the candidates that these readings cannot test."""
        loop = self
        if self.on_trial(first):
            loop, widen_noise = replace(self, max_effects=0), False
        c = first.calibration
        structures, shut = structures_over(
            c.model, self.readings, c.reference, effects=effects, widen_noise=widen_noise
        )
        return loop, structures, shut

    def quick(self, model: Model) -> Method | None:
        """How steps on the way are fitted: not sampled, for their errors and evidence need no draws."""
        return QUICK if model.noise.gaussian else self.method

    @staticmethod
    def on_trial(first: Step) -> bool:
        """Whether nothing may be added: no convergence, no probabilities; and a published calibration is not saved."""
        wrong = first.check.fixed is not None and first.check.fixed.wrong
        return not first.calibration.verdict.ok or wrong

    def not_looked(self, first: Step) -> SearchPath:
        """What is left of the loop where nothing can be learnt from the first model."""
        search = Search((), 0, complete=True, stopped=f"{NOT_LOOKED} {' '.join(first.against)}")
        return SearchPath(*judged((first,)), self.holdout, None, search)

    def search(
        self,
        first: Step,
        library: Library,
        shut: Sequence[Candidate],
        seeds: Sequence[Structure | Shown],
        follow: Callable[[SearchPath], None],
    ) -> SearchPath:
        """Walk over the structures, and fit those on the way to the most probable one."""

        def tell() -> None:
            follow(self.trail([first], library.structures, complete=False))

        tell()
        stopped = self.look(library, seeds, tell)
        return self.steps_to_best(first, library, shut, stopped, follow)

    def look(
        self,
        library: Library,
        seeds: Sequence[Structure | Shown] = (),
        tell: Callable[[], None] = lambda: None,
    ) -> str:
        """Walk over the structures; why that ended early, if it did."""
        with stage("looking for missing effects"):
            known = self._known(seeds, library.structures)
            return walk(library, self.max_effects, self.time_limit, lambda _: tell(), known)

    def steps_to_best(
        self,
        first: Step,
        library: Library,
        shut: Sequence[Candidate],
        stopped: str,
        follow: Callable[[SearchPath], None] = lambda _: None,
    ) -> SearchPath:
        """Fit the models on the way to the most probable structure."""
        structures, steps = library.structures, [first]

        def tell() -> None:
            follow(self.trail(steps, structures, complete=False))

        way = path(library, Posterior.of(structures).chosen)
        try:
            for before, at in pairwise(way):
                model = structures.weigh(at).sized_model
                method = self.method if at == way[-1] else self.quick(model)
                steps.append(self.step(model, before, at, method=method))
                tell()
            if len(way) == 1 and self.method != QUICK:
                steps[0] = self.step(first.calibration.model, method=self.method)
        except KeyboardInterrupt:
            if stopped:
                raise
            stopped = STOPPED.format(time.monotonic() - self.begun)
        if first.calibration.verdict.ok:
            steps = [
                replace(s, discovery=told(library, at, shut, stopped))
                for s, at in zip(steps, way, strict=False)
            ]
        return self.trail(steps, structures, complete=not stopped, stopped=stopped)

    def _known(self, seeds: Sequence[Structure | Shown], structures: Structures) -> list[Structure]:
        """Of an earlier search's structures, those that this one may weigh."""
        given = dict.fromkeys(Structure(frozenset(s.effects), s.noise) for s in seeds)
        return [
            s
            for s in given
            if s.effects <= set(structures.candidates)
            and s.effects.isdisjoint(structures.barred(s))
            and len(s.effects) <= self.max_effects
            and s.noise in ("", *structures.laws)
        ]

    def step(
        self,
        model: Model,
        before: Structure | None = None,
        at: Structure | None = None,
        *,
        method: Method | None,
    ) -> Step:
        """Fit a model and check it."""
        calibration = fit(
            model,
            self.readings,
            method,
            seed=self.seed,
            strict=False,
            reference=self.reference,
        )
        added, changed = None, ""
        if before is not None and at is not None:
            added = next(iter(at.effects - before.effects), None)
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
        )
        if not (complete or stopped):
            under_way = (*steps[:-1], steps[-1].judged((UNDER_WAY.reason,)))
            return SearchPath(under_way, UNDER_WAY, self.holdout, None, search)
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
    """
    checked, floor = check(calibration), noise_floor(calibration)
    kept = None if holdout is None else predict(calibration, holdout)
    return Step(
        calibration=calibration,
        added=None,
        rmse=predict(calibration).rmse,
        rmse_fitted=float(np.sqrt(np.mean(checked.residuals**2))),
        holdout_rmse=None if kept is None else kept.rmse,
        holdout_sd=None if kept is None else float(np.sqrt(np.mean(kept.sd**2))),
        left_out=leave_one_group_out(calibration),
        noise_floor=floor,
        check=checked,
        discovery=None,
        against=wrong_question(calibration, floor, accepted),
    )


def _other_path(structures: Structures) -> OtherPath | None:
    """The runner-up model: the best under another noise law, if it differs and is nearly as probable."""
    best = structures.best
    ends = [w for w in structures.visited.values() if w.structure.noise != best.structure.noise]
    other = max(ends, key=lambda w: w.total, default=None)
    if other is None or not math.isfinite(other.total) or other.total < best.total - STRONG:
        return None
    if other.structure.effects == best.structure.effects:
        return None
    law, effects = other.assembly.noise, tuple(sorted(other.structure.effects))
    return OtherPath(law.name, effects, other.total - best.total, law.in_words)
