"""The session: one person's work on one set of readings, independent of the browser.

Changes of a model by name; and the outputs of a session, report and exports, as the command line makes them.
"""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partialmethod, reduce
from operator import sub
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.workbench import session_store as store
from bayescal._annexes.workbench.session_store import Origin, SearchOptions, State, path_to, script


class Preview:
    """The result of a model, compared with an existing step.

    Attributes:
        curve: change of the expected output of each reading, all coefficients estimated again, output unit, (n,).
            Residuals less this curve are the residuals of the new model.
        rms: of these, output unit.
        in_words: summary, with the size of the effect that is added.
    """

    def __init__(self, before: ws.Step, after: bc.Calibration, added: str | None) -> None:
        fitted = bc.check(after).residuals
        self.curve, self.rms = before.check.residuals - fitted, float(np.sqrt(np.mean(fitted**2)))
        text = f"residuals from {ws.number(before.rmse_fitted)} to {ws.number(self.rms)}"
        text += f" {ws.unit_label(after.unit)} rms"
        evidence_before, evidence = before.calibration.log_evidence, after.log_evidence
        if evidence_before is not None and evidence is not None:
            text += f", log Bayes factor {evidence[0] - evidence_before[0]:z.1f}"
        if added is not None:
            effect = after.model.effect(added)
            grouped = effect.coefficients[0].group_sd is not None
            name = effect.group_sd_name(0) if grouped else effect.coefficient_name(0)
            draws = after.samples(effect.measure_name or name)
            draws = draws if draws.ndim == 1 else np.sqrt(np.mean(draws**2, axis=1))
            size = ws.with_error(float(draws.mean()), float(draws.std()))
            unit = ws.unit_label(effect.coefficients[0].unit)
            text = f"{added} would be {f'{size} {unit}'.rstrip()}: {text}"
        self.in_words = text


@dataclass(frozen=True)
class Change:
    """A model, and its difference from the former one."""

    model: bc.Model  # what comes of it
    added: str | None = None  # effect that was added; None where something else was done
    in_words: str = ""  # that, in words; empty where an effect was added


REPORT = "report.html"
SEARCHES = 4  # number of the latest searches in the cache


def _structure_of(model: bc.Model, search: ws.StepwiseSearch) -> ws.Structure | None:
    """Return the structure of a search that equals a model, among the subsets of its choice; else None."""
    structures, goal = search.structures, search.chosen_structure
    base, candidates = structures.base, structures.candidates
    names = frozenset(model.names) - {*base.names}
    laws = {n: structures.noise_law(ws.Structure(noise=n)) for n in ("", goal.noise)}
    law = next((n for n, noise in laws.items() if noise == model.noise), None)
    if law is None or not names <= goal.effects or model.fixed != base.fixed:
        return None
    if any(e != model.effect(e.name) for e in base.effects if e.name in model.names):
        return None
    if not {*base.names} <= {*model.names} or not search.steps[0].calibration.verdict.ok:
        return None
    added = (model.effect(n) for n in names)
    matches = all(_as_searched(e, candidates[e.name]) for e in added)
    return ws.Structure(names, law) if matches else None


def _as_searched(effect: bc.Effect, form: bc.Effect) -> bool:
    """Return whether an effect is as known, or has one of the sizes that its evidence is averaged over."""
    first = form.coefficients[0]
    factor = 1.0 if first.flat else effect.coefficients[0].size / first.size
    return effect.is_placeholder or effect == form or round(factor, 9) in ws.SIZE_FACTORS


@dataclass(eq=False)
class Session:
    """One person's work on one set of readings: a tree of states in a folder, one of which is current.

    Its methods may be called from any thread. Methods that make a state are serialised; previews and searches run in
    parallel. Every state is on the disk before it is the current one.

    Attributes:
        readings, holdout: what is fitted, and the hold-out data; spikes set aside.
        folder: that keeps the states.
        settings: as of `calibrate`.
        origin: where readings and effects come from.
        effects: of the user's own, by name.
        on_change: called when a state is made or gone to, by whichever page, from whatever thread.
    """

    readings: bc.Measurements
    holdout: bc.Measurements | None
    folder: Path
    settings: SearchOptions
    origin: Origin
    effects: dict[str, bc.Effect]
    on_change: list[Callable[[], None]] = field(default_factory=list)
    _states: dict[int, State] = field(default_factory=dict)
    _at: int = 0
    _loops: list[ws.StepwiseSearch] = field(default_factory=list)  # with evaluated structures
    _trails: dict[int, bc.SearchPath] = field(default_factory=dict)
    _lock: threading.RLock = field(default_factory=threading.RLock)  # of the tree
    _fitting: threading.Lock = field(default_factory=threading.Lock)
    _looking: threading.RLock = field(default_factory=threading.RLock)  # of the structures weighed
    _end: ws.deadline.Deadline | None = None  # of the search that is under way

    @classmethod
    def open(
        cls,
        model: bc.Model,
        readings: bc.Measurements,
        *,
        holdout: bc.Measurements | None = None,
        effects: Sequence[bc.Effect] = (),
        folder: str | Path | None = None,
        origin: Origin | None = None,
        **settings: Any,
    ) -> Session:
        """Open a session: its first state is a model fitted to readings, or it resumes that in its folder.

        No code in a folder is run: instruments and effects are given here.

        Args:
            model, readings, holdout, effects: as of `calibrate`.
            folder: where every state is kept; None: a temporary one.
            origin: where all this comes from; None: readings in memory.
            settings: of `calibrate`, see `SearchOptions`.

        Raises:
            ModelError: the readings lack what the model needs.
            InputError: the folder cannot be written to, holds a session of other readings or an effect that is not
                given, or something in it was changed.
        """
        options = SearchOptions(**settings)
        spikes, held_out = options.keep_spikes, None
        model.require(readings)
        if holdout is not None:
            model.require(holdout)
            held_out = bc.set_aside(holdout, spikes)
        folder = Path(tempfile.mkdtemp(prefix="bayescal-") if folder is None else folder)
        with ws.result_folder(folder):
            name = model.instrument.name
            origin = origin or Origin(name if name in ws.installed_names() else "")
            used, by_name = bc.set_aside(readings, spikes), {e.name: e for e in effects}
            session = cls(used, held_out, folder, options, origin, by_name)
            if (folder / store.SESSION).is_file():
                session._go_on(model)
            else:
                session._become(Change(model), None)
        return session

    def _go_on(self, model: bc.Model) -> None:
        """Resume from the states in the folder, even after a crash."""
        saved, effects = store.load_session(self.folder), tuple(self.effects.values())
        uninstalled = () if model.instrument.name in ws.installed_names() else (model.instrument,)
        for n, entry in enumerate(saved.states):
            path = store.fit_path(self.folder, n)
            calibration = bc.load(path, effects=effects, instruments=uninstalled)
            if not calibration.readings.same_as(self.readings):
                raise bc.InputError(
                    f"{self.folder} holds a session of other readings, {calibration.readings.file}: give another "
                    "folder (--out), or remove it"
                )
            step = ws.step_of(calibration, self.holdout, self.settings.accept_conflicts)
            step = replace(step, added=entry.added, description=entry.description)
            self._states[n] = State(n, entry.parent, step)
            typed = [e for e in calibration.model.effects if isinstance(e.basis, ws.Formula)]
            self.effects |= {e.name: e for e in typed}
        self._at = saved.current
        store.fit_path(self.folder, len(self._states)).unlink(missing_ok=True)  # a torn state

    @property
    def states(self) -> Mapping[int, State]:
        """Return all states, by number."""
        with self._lock:
            return MappingProxyType(dict(self._states))

    @property
    def current(self) -> State:
        return self._states[self._at]

    def path(self, number: int | None = None) -> list[State]:
        """Return the states from the first to one, by default the current one."""
        return [
            self._states[n] for n in path_to(self._states, self._at if number is None else number)
        ]

    def go_to(self, number: int) -> State:
        """Make another state the current one; what is done next branches off there."""
        with self._lock:
            return self._set_current(number)

    def preview(self, kind: str, *arguments: Any) -> Preview:
        """Return a preview of `act`: the changed model is fitted, and made no state."""
        change, loop, before = self._changed(kind, *arguments), self._loop, self.current.step
        fit = before.calibration
        start = {n: float(v) for n, v in fit.problem.hyper(fit.mode.v).items()}
        how: dict[str, Any] = {"seed": loop.seed, "reference": loop.reference, "start": start}
        method = loop.step_method(change.model)
        after = bc.fit(change.model, self.readings, method, strict=False, **how)
        return Preview(before, after, change.added)

    def _changed(self, kind: str, *arguments: Any) -> Change:
        """Return the current model with a change."""
        model = self.current.model
        match (kind, *arguments):
            case ("add", str(name)):
                return self._changed(
                    "add", self._named().get(name) or model.instrument.effect(name)
                )
            case ("add", bc.Effect() as effect):
                return Change(model + effect, added=effect.name)
            case ("take_out", str(name)):
                return Change(model - name, in_words=f"− {name}")
            case ("free", str(name)):
                return Change(model.free(name), in_words=f"{name} estimated again")
            case ("noise", str(name)):
                first = self.states[0].calibration
                laws = ws.laws_over(first.model, first.frame)  # that the readings identify
                law = {first.model.noise.name: first.model.noise, **laws}[name]
                return Change(model.with_noise(law), in_words=f"noise: {law.in_words}")
            case ("fix", str(name), value):
                text = f"{name} = {ws.number(float(value), 6)} fixed"
                return Change(model.fix({name: float(value)}), in_words=text)
            case ("resize", str(name), value):
                unit = ws.unit_label(model.effect(name).coefficients[0].unit)
                text = f"{name} of plausible size {ws.number(float(value))} {unit}".rstrip()
                return Change(model.resize(name, float(value)), in_words=text)
        raise bc.InputError(f"{kind!r} with {len(arguments)} argument(s) is no change of a model")

    def act(self, kind: str, *arguments: Any) -> State:
        """Change the current model, and fit it as the new current state.

        An effect of a discovery is added in its likeliest form and size.

        Raises:
            ModelError, InputError: the model cannot be changed so.
        """
        return self._become(self._changed(kind, *arguments), self.current.number)

    def _named(self) -> dict[str, bc.Effect]:
        """Return the effects that differ from the instrument's, by the name in requests.

        They are the user's own, and those of a discovery in their likeliest form and size.
        """
        named = {e.name: e for e in ws.with_forms(self.effects.values())}
        if (look := self.current.discovery) is None:
            return named
        library, best = self.current.model.instrument.effect, [e for e in look.best if not e.open]
        forms = {c.effect: named.get(c.form) or library(c.form) for c in look.candidates if c.form}
        return {**named, **forms, **{e.family_name: e for e in best}, **{e.name: e for e in best}}

    add = partialmethod(act, "add")  # (effect)
    take_out = partialmethod(act, "take_out")  # (effect)
    fix = partialmethod(act, "fix")  # (coefficient, value in the unit in which it is reported)
    free = partialmethod(act, "free")  # (coefficient)
    resize = partialmethod(act, "resize")  # (effect, plausible size of its first coefficient)
    noise = partialmethod(act, "noise")  # (name of one that the readings identify)

    def look(self) -> bc.Discovery:
        """Search for effects missing from the current state; the discovery is cached in the state."""
        number = self.current.number
        with self._in_time():  # another page may look for the same
            if (discovery := self.states[number].discovery) is None:
                loop, at = self._weighed(self.states[number])
                discovery = loop.find_missing(at)
                self._keep_found(number, discovery)
        return discovery

    def find_all(self, follow: Callable[[bc.SearchPath], None] = lambda _: None) -> None:
        """Search from the current state on, as `calibrate` does; each step becomes a state.

        It returns at the end, or soon after `stop`; `follow` is called with the trail so far, as by `calibrate`.

        Raises:
            ModelError: nothing can be learnt from the current model.
        """
        begin = self.current
        if begin.step.failures and not self._loop.free_contradicted(begin.step):
            raise bc.ModelError(f"nothing is looked for: {' '.join(begin.step.failures)}")
        with self._in_time():
            loop, at = self._weighed(begin, follow)
            steps, number = [begin.step], begin.number
            for before, to, discovery in loop.iterate_path(loop.chosen_structure, at):
                if before is None:
                    self._keep_found(number, discovery)
                    continue
                steps.append(loop.fit_structure(to, before))
                number = self._append(steps[-1], number, discovery).number
                follow(loop.build_path(steps=steps))

    @contextmanager
    def _in_time(self) -> Iterator[None]:
        """Hold the lock of the search, within the time limit."""
        with self._looking, ws.deadline.until(self.settings.time_limit) as self._end:
            yield

    def _weighed(
        self, state: State, follow: Callable[[bc.SearchPath], None] | None = None
    ) -> tuple[ws.StepwiseSearch, ws.Structure]:
        """Return the search for effects missing from a state, and the state's structure in it.

        It is that of `calibrate` over the first model, so that states towards its choice share one posterior with it.
        For a state with other effects, or other forms of them, it is a search over the state's model.

        Args:
            state: which.
            follow: told how it goes on; a search that was stopped goes on only where somebody follows.
        """
        first, loop = self.states[0], self._loop
        effects = [e for e in first.model.effects if loop.is_reconsidered(e, first.model)]
        search = self._searched(reduce(sub, effects, first.model), effects, follow)
        if (at := _structure_of(state.model, search)) is None:
            search, at = self._searched(state.model, (), follow), ws.Structure()
        return search, at

    def _searched(
        self,
        core: bc.Model,
        effects: Sequence[bc.Effect],
        follow: Callable[[bc.SearchPath], None] | None,
    ) -> ws.StepwiseSearch:
        """Evaluate structures over a model, those with given effects among them; cached."""
        search = next((s for s in self._loops if s.steps[0].calibration.model == core), None)
        if is_new := search is None:
            same = (s.step for s in self.states.values() if s.model == core)
            search = replace(self._loop, reconsidered=tuple(effects), stopped="not begun")
            first = next(same, None) or search.fit_step(core, search.step_method(core))
            extra = (*self.effects.values(), *search.free_contradicted(self.states[0].step))
            search.list_structures(first, extra, self.settings.widen_noise)
        if search.stopped and (is_new or follow is not None):
            with ws.deadline.sooner(ws.SEARCH_TIME_SHARE):
                search.run_search(lambda: None if follow is None else follow(search.build_path()))
            self._loops = [*(s for s in self._loops if s is not search), search][-SEARCHES:]
        return search

    def stop(self) -> None:
        """Stop a search with the best model so far."""
        if self._end is not None:
            self._end.interrupt.requested = True

    def typed(self, line: str) -> bc.Effect:
        """Return the effect of a typed formula, as `bc.effect` takes it.

        Raises:
            InputError: it is invalid; the position is marked.
        """
        return bc.effect(line, readings=self.readings, instrument=self.current.model.instrument)

    def add_typed(self, line: str) -> State:
        """Add the effect of a typed formula to the candidates and to the model; drop cached searches."""
        effect = self.typed(line)
        _ = self.current.model + effect  # its slot and groups are there
        self.effects[effect.name] = effect
        self._loops.clear()
        self._trails.clear()
        with self._lock:
            states = {n: replace(s, discovery=None) for n, s in self._states.items()}
            self._set_current(self._at, states)
        return self.add(effect.name)

    def script(self) -> str:
        """Return Python that reproduces the current state, with equal numbers."""
        return self._script(self.path())

    def trail(self, state: State | None = None) -> bc.SearchPath:
        """Return the search path to a state (None: the current one), in the form that `calibrate` returns; cached.

        Its last model is fitted by the requested method. Where the search is complete, the result in use is averaged
        over the evaluated structures.
        """
        state = state or self.current
        with self._fitting:
            if state.number not in self._trails:
                self._trails[state.number] = self._judged(state)
            return self._trails[state.number]

    def _judged(self, state: State) -> bc.SearchPath:
        loop, way = self._loop, self.path(state.number)
        step = loop.fit_step(state.model, loop.method, state.calibration.start or {})
        step = replace(step, added=state.step.added, description=state.step.description)
        weighed = None
        if step.calibration.verdict.ok:
            with suppress(ws.deadline.TimeIsUp), self._in_time():
                weighed = self._weighed(state)
                self._keep_found(state.number, weighed[0].find_missing(weighed[1]))
                way = self.path(state.number)
        steps = [*(s.step for s in way[:-1]), step]
        steps = [replace(s, discovery=w.discovery) for s, w in zip(steps, way, strict=True)]
        if weighed is None or weighed[1].effects != weighed[0].chosen_structure.effects:
            return bc.SearchPath(*ws.assess_steps(steps), self.holdout)
        with self._looking:
            return weighed[0].average_path(steps, weighed[1])

    def verdict(self) -> str:
        """State whether the current model may be used, and the verdict of its fit."""
        trail = self.trail()
        use = "This result may be used." if trail.ok else "Not to be used as it is."
        texts = (use, trail.gate.reason, str(trail.final.calibration.verdict))
        return "\n\n".join([*(ws.folded(t, "") for t in texts if t), str(trail)])

    def compare(self, number: int) -> str:
        """Compare the current model with another step's: `bc.compare`, then coefficients, noise and shapes ± u.

        Raises:
            InputError: they were fitted to other readings.
        """
        both = self.current, self.states[number]
        fits = {f"{s.number} {s.title}": s.calibration for s in both}
        tables = [ws.unknown_rows(c) for c in fits.values()]
        units = {name: row[2] for table in tables for name, row in table.items()}
        rows = [
            [name, *(table[name][1] if name in table else "–" for table in tables), unit]
            for name, unit in units.items()
        ]
        return f"{bc.compare(fits)}\n\n{ws.plain_table(['', *fits, 'unit'], rows)}"

    def write(self, file: str) -> Path:
        """Write the report or an export of the current model, as `bayescal report` and `export` do.

        It stands in a folder beside the result of `bayescal calibrate --out`.

        Args:
            file: report.html; or a name whose suffix is an export's format.

        Raises:
            InputError, ModelError: there is no such format, or the model cannot be exported so.
        """
        state = self.current
        trail, folder = self.trail(state), self.folder / f"result_{state.number:03d}"
        folder.mkdir(exist_ok=True)
        with suppress(bc.NotDrawn):  # a report says itself what is not drawn, an export needs none
            ws.save_search(trail, folder)
        if file == REPORT:
            return bc.report([trail], folder / file, effects=tuple(self.effects.values()))
        return bc.compensator(trail.calibration).export(folder / file)

    @property
    def _loop(self) -> ws.StepwiseSearch:
        s = self.settings
        options = (self.readings, self.holdout, s.method, s.seed, s.reference, s.max_effects)
        return ws.StepwiseSearch(*options, accepted_conflicts=frozenset(s.accept_conflicts))

    def _become(self, change: Change, parent: int | None) -> State:
        """Fit a model as a child of a state, and make it the current one."""
        loop = self._loop
        step = loop.fit_step(change.model, loop.step_method(change.model))
        return self._append(replace(step, added=change.added, description=change.in_words), parent)

    def _append(
        self, step: ws.Step, parent: int | None, discovery: bc.Discovery | None = None
    ) -> State:
        """Save a step as a child of a state, and make it the current one."""
        with self._lock:
            number = len(self._states)
            state = State(number, parent, step, discovery)
            if (file := store.fit_path(self.folder, number)).exists():
                raise bc.InputError(
                    f"{file} was made meanwhile: another workbench goes on here. End one"
                )
            state.calibration.save(file)
            try:
                self._set_current(number, {**self._states, number: state})
            except bc.InputError:
                file.unlink()
                raise
            return state

    def _set_current(self, number: int, states: dict[int, State] | None = None) -> State:
        """Make a state the current one; replace all states by `states` if given."""
        states = self._states if states is None else states
        way = [states[n] for n in path_to(states, number)]
        store.save_session(self.folder, states, number, self._script(way))
        self._states, self._at = states, number
        for call in tuple(self.on_change):
            call()
        return self.current

    def _keep_found(self, number: int, discovery: bc.Discovery | None) -> None:
        with self._lock:
            self._states[number] = replace(self._states[number], discovery=discovery)

    def _script(self, way: list[State]) -> str:
        return script(way, self.origin, self.settings, self.folder.resolve())
