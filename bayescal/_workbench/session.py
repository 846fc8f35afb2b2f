"""A session: what one person does to one set of readings. It knows no browser."""

from __future__ import annotations

import textwrap
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partialmethod
from pathlib import Path
from typing import Any

import numpy as np

from bayescal._core import deadline
from bayescal._core.errors import BayescalError
from bayescal._core.formatting import WIDTH
from bayescal._data.measurements import Measurements
from bayescal._data.set_aside import set_aside
from bayescal._model.effect import Effect
from bayescal._model.model import Model
from bayescal._model.noise_law import Noise
from bayescal._report.save_search import save_search
from bayescal._search.calibrate import Loop
from bayescal._search.describe import Draft, describe
from bayescal._search.discover import Discovery, discover
from bayescal._search.noise_laws import laws_over
from bayescal._search.own_files import user_effects
from bayescal._search.plan_readings import ReadingPlan, plan_readings
from bayescal._search.posterior import ShownStructure
from bayescal._search.preview import Preview, Previews
from bayescal._search.search_path import SearchPath, Step
from bayescal._use.budget import Budget, budget
from bayescal._use.decide import decide
from bayescal._use.decision import Decisions
from bayescal._workbench import kept, take_away
from bayescal._workbench.change import Change, changed
from bayescal._workbench.origin import Origin, Settings
from bayescal._workbench.search_thread import RunningSearch
from bayescal._workbench.side_by_side import side_by_side
from bayescal._workbench.state import State
from bayescal._workbench.tree import Tree


@dataclass(eq=False)
class Session:
    """One person's work on one set of readings.

    Its methods may be called from any thread. What makes a state takes one caller at a time; previews and looks go on
    beside it. Every state is on the disk before it is the current one.

    Attributes:
        readings, holdout: what is fitted, and the hold-out data; spikes set aside.
        tree: the states, and the folder that keeps them.
        own: effects of the user's own, by name.
    """

    readings: Measurements
    holdout: Measurements | None
    tree: Tree
    own: dict[str, Effect] = field(default_factory=dict)
    _previews: dict[int, Previews] = field(default_factory=dict)
    _seeds: dict[int, tuple[ShownStructure, ...]] = field(default_factory=dict)
    _finals: dict[int, Step] = field(default_factory=dict)
    _decisions: dict[int, Decisions] = field(default_factory=dict)
    _fitting: threading.Lock = field(default_factory=threading.Lock)
    _beside: threading.RLock = field(default_factory=threading.RLock)
    _looking: threading.Lock = field(default_factory=threading.Lock)
    _ending: threading.Event = field(default_factory=threading.Event)

    @classmethod
    def begin(
        cls,
        model: Model,
        readings: Measurements,
        *,
        holdout: Measurements | None = None,
        effects: Sequence[Effect] = (),
        folder: str | Path | None = None,
        origin: Origin | None = None,
        **settings: Any,
    ) -> Session:
        """A session whose first state is a model fitted to readings.

        Args:
            model, readings, holdout, effects: as of `calibrate`.
            folder: where every state is kept; None: a temporary one.
            origin: where all this comes from; None: readings are written to the folder.
            settings: of `calibrate`; see `Settings`.

        Raises:
            ModelError: the readings lack what the model needs.
            InputError: the folder cannot be written to, or holds a session.
        """
        asked = Settings.of(**settings)
        model.require(readings)
        if holdout is not None:
            model.require(holdout)
        tree = Tree.begin(folder, asked)
        tree.origin = origin or Origin.kept(
            model.instrument, readings, holdout, tree.folder, asked.keep_spikes
        )
        apart = None if holdout is None else set_aside(holdout, asked.keep_spikes)
        session = cls(set_aside(readings, asked.keep_spikes), apart, tree)
        session.own = {e.name: e for e in effects}
        session._become(Change(model), None)
        return session

    @classmethod
    def resume(
        cls,
        folder: str | Path,
        effects: Sequence[Effect] = (),
        of: Origin | None = None,
        trust: Sequence[str | Path] = (),
    ) -> Session:
        """A session as its folder has it: every state that was made, whatever ended it.

        Args:
            folder: that was given to `begin`.
            effects: of the user's own that were given there as Python objects; those in files are run again.
            of: what it must be of; None: anything.
            trust: Python files that it may run, beside those that `of` names.

        Raises:
            InputError: it holds no session, one of something else, something in it was changed, or it names a Python
                file that is not to be trusted.
        """
        own = {e.name: e for e in effects}
        tree, own, holdout = Tree.resume(Path(folder), own, of, trust)
        return cls(tree.states[0].calibration.readings, holdout, tree, own)

    def with_readings(self, readings: Measurements, model: Model | None = None) -> Session:
        """A new session on other readings of the same instrument, in a folder beside this one's; this one stays.

        Raises:
            ModelError: the readings lack what the model needs.
        """
        first: Model = self.states[0].model if model is None else model
        if first.instrument.tailor is not None:
            first = first.instrument.for_readings(readings).baseline()
        first.require(readings)
        folder, settings = kept.fresh_folder(self.folder.parent), self.tree.settings
        origin = Origin.kept(first.instrument, readings, None, folder, settings.keep_spikes)
        origin = replace(origin, effect_files=self.tree.origin.effect_files)
        own = tuple(self.own.values())
        return Session.begin(
            first, readings, effects=own, folder=folder, origin=origin, **vars(settings)
        )

    @property
    def folder(self) -> Path:
        return self.tree.folder

    @property
    def states(self) -> Mapping[int, State]:
        """All states, by number."""
        return self.tree.states

    @property
    def current(self) -> State:
        return self.tree.current

    def path(self) -> list[State]:
        """The states from the first to the current one."""
        return self.tree.path()

    def go_to(self, number: int) -> State:
        """Make another state the current one; what is done next branches off there."""
        return self.tree.go_to(number)

    @property
    def before(self) -> int | None:
        """The state that `undo` goes back to; None where nothing was done."""
        return self.tree.before

    def undo(self) -> State:
        """Go back to the state that was current before; what was done since stays, as a branch."""
        return self.tree.undo()

    @property
    def on_change(self) -> list[Callable[[], None]]:
        """Called when a state is made or gone to, by whichever page."""
        return self.tree.on_change

    @property
    def laws(self) -> Mapping[str, Noise]:
        """Noise laws that the readings can tell, by name, that of the first model among them."""
        first = self.states[0].calibration
        return {first.model.noise.name: first.model.noise, **laws_over(first.model, first.frame)}

    def preview(self, effect: str) -> Preview:
        """What adding an effect to the current state would do: `bc.preview`, whose refusals it has; kept."""
        with self._beside:
            return self._previews_of(self.current).of(self.current.sized.get(effect, effect))

    def consequences(self, kind: str, *arguments: Any) -> Preview:
        """What `act` would do, before it is done: `bc.preview` of the model that would come of it."""
        if kind == "add":
            return self.preview(*arguments)
        state = self.current
        wanted = changed(state.model, kind, arguments, self.own, self.laws)
        with self._beside:
            return self._previews_of(state).of_model(wanted.model)

    def act(self, kind: str, *arguments: Any) -> State:
        """Change the current model, and fit it; the state that comes of it is the current one.

        What a look found is added at the size that it found likeliest.

        Raises:
            ModelError, InputError: the model cannot be changed so.
        """
        state = self.current
        wanted = changed(state.model, kind, arguments, {**self.own, **state.sized}, self.laws)
        return self._become(wanted, state.number)

    add = partialmethod(act, "add")  # (effect)
    take_out = partialmethod(act, "take_out")  # (effect)
    fix = partialmethod(act, "fix")  # (coefficient, value in the unit in which it is reported)
    free = partialmethod(act, "free")  # (coefficient)
    resize = partialmethod(act, "resize")  # (effect, plausible size of its first coefficient)
    noise = partialmethod(act, "noise")  # (name, of `laws`)

    def look(self) -> Discovery:
        """What is missing from the current state, with probabilities: `bc.discover`; kept in the state."""
        number, asked = self.current.number, self.tree.settings
        with self._looking:  # another page may look for the same
            state = self.states[number]
            if state.discovery is not None:
                return state.discovery
            found = discover(
                state.calibration,
                effects=tuple(self.own.values()),
                max_effects=asked.max_effects,
                widen_noise=asked.widen_noise,
                time_limit=asked.time_limit,
            )
            self.tree.found(number, found)
        return found

    def find_all(self, follow: Callable[[SearchPath], None] = lambda _: None) -> None:
        """Search from the current state on, as `calibrate` does; each step on the way becomes a state.

        It returns at the end, or soon after `stop`; `follow` is called with the trail so far, as it goes on.

        Raises:
            ModelError: nothing can be learnt from the current model.
        """
        self._ending.clear()
        begin = self.current
        search = RunningSearch(self._loop, begin.step, self._ending, follow)
        search.open(tuple(self.own.values()), self.tree.settings.widen_noise)
        with deadline.until(self.tree.settings.time_limit):
            search.look(self._seeds.get(begin.number, ()))
        self._seeds[begin.number] = search.seeds
        number = begin.number
        for step, discovery in search.steps():
            if step is begin.step:
                self.tree.found(number, discovery)
            else:
                number = self.tree.append(step, number, discovery).number

    def stop(self) -> None:
        """End `find_all` with the best so far."""
        self._ending.set()

    def describe(self, rows: Sequence[int] | np.ndarray, against: str = "") -> Draft:
        """What selected readings (numbers from 0) show that the current model lacks, with the draft of an effect.

        `against` is the covariate that they were selected along; empty: whichever explains them best.
        """
        state = self.current
        with self._beside:
            previews = self._previews_of(state)
            return describe(state.calibration, rows, against, previews=previews)

    def load_draft(self, code: str) -> tuple[str, ...]:
        """Run code that defines effects, as --effects does, and have them among the candidates; their names.

        Raises:
            InputError, ModelError: it fails, or what it defines is of no use here; says where.
        """
        path = kept.keep_draft(self.folder, code)
        try:
            found = user_effects(path)
            _ = [self.current.model + effect for effect in found]  # its slot and groups are there
        except BayescalError:
            path.unlink()
            raise
        self.own |= {e.name: e for e in found}
        self._previews.clear()
        self._seeds.clear()
        self.tree.with_effects(path)
        return tuple(e.name for e in found)

    def script(self) -> str:
        """Python that does what was clicked on the way to the current state, with equal numbers."""
        return self.tree.script(self.path())

    def final(self) -> Step:
        """The current model fitted by the method that was asked for, as `calibrate` leaves its last; kept."""
        state = self.current
        with self._fitting:
            if state.number not in self._finals:
                loop = self._loop
                step = loop.step(state.model, method=loop.method)
                step = replace(step, added=state.step.added, changed=state.step.changed)
                self._finals[state.number] = step
            return self._finals[state.number]

    def verdict(self) -> str:
        """Whether the current model may be used as it is, and how its fit went."""
        trail = self._trail()
        verdict = trail.final.calibration.verdict
        said = "This result may be used." if trail.ok else "Not to be used as it is."
        return "\n\n".join(
            [
                *(textwrap.fill(t, WIDTH) for t in (said, trail.gate.reason, str(verdict)) if t),
                str(trail),
            ]
        )

    def compare(self, number: int) -> str:
        """The current model beside another step's: `bc.compare`, and their coefficients side by side."""
        return side_by_side(self.current, self.states[number])

    def budget(self, at: Mapping[str, float]) -> Budget:
        """`bc.budget` of the current model."""
        return budget(self.final().calibration, at)

    def plan(self, limit: str, count: int) -> ReadingPlan:
        """`bc.plan_readings` for the current model."""
        return plan_readings(self.final().calibration, limit, count=count)

    def decide(self, limits: Sequence[str], **how: Any) -> Decisions:
        """`bc.decide` about the current model; its report begins with it."""
        number, found = self.current.number, decide(self.final().calibration, limits, **how)
        self._decisions[number] = found
        return found

    def report(self, certificate: str | Path | None = None) -> Path:
        """The report for sign-off, in the folder: what `bayescal report` writes of it, with what was decided."""
        folder, _ = self._result()
        decided = self._decisions.get(self.current.number)
        return take_away.write_report(folder, self.tree.origin, self.own, certificate, decided)

    def export(self, what: str, certificate: str | Path | None = None) -> Path:
        """An export of the current model, in the folder: what `bayescal export` writes; `what` is one of its formats.

        Raises:
            InputError, ModelError: there is no such format, or the model cannot be exported so.
        """
        take_away.refuse_unknown(what)
        folder, trail = self._result()
        decided = self._decisions.get(self.current.number)
        return take_away.write_export(folder, trail, what, certificate, decided)

    @property
    def _loop(self) -> Loop:
        return self.tree.settings.loop(self.readings, self.holdout)

    def _previews_of(self, state: State) -> Previews:
        """Of the effects over one state; the caller holds `_beside`."""
        if state.number not in self._previews:
            made = Previews(state.calibration, own=tuple(self.own.values()))
            self._previews[state.number] = made
        return self._previews[state.number]

    def _become(self, wanted: Change, parent: int | None) -> State:
        """Fit a model as a child of a state, and make it the current one."""
        loop = self._loop
        step = loop.step(wanted.model, method=loop.quick(wanted.model))
        return self.tree.append(replace(step, added=wanted.added, changed=wanted.in_words), parent)

    def _result(self) -> tuple[Path, SearchPath]:
        """The current state's folder of results as `bayescal calibrate --out` leaves it, made anew; the trail in it."""
        trail, number = self._trail(), self.current.number
        folder = self.folder / f"result_{number:03d}"
        folder.mkdir(exist_ok=True)
        save_search(trail, folder)
        return folder, trail

    def _trail(self) -> SearchPath:
        return take_away.trail_of(self.path(), self.final(), self.holdout)
