"""Workbench session: one user's work on one set of readings, independent of the browser.

Actions add and remove effects by name; reports and exports are identical to those of the command line.
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
from bayescal._annexes.workbench.session_store import Origin, SearchOptions, State


class Preview:
    """Preview of a changed model: its result compared with an existing step.

    Attributes:
        curve: change of the expected output of each reading, all coefficients re-estimated, output unit, (n,).
            Residuals less this curve are the residuals of the new model.
        rms: rms residual of the new model, output unit.
        summary: change of the rms residual and the log Bayes factor, with the size of an added effect.
    """

    def __init__(self, step: ws.Step, calibration: bc.Calibration, added: str | None) -> None:
        fitted = bc.check(calibration).residuals
        self.curve, self.rms = step.check.residuals - fitted, float(np.sqrt(np.mean(fitted**2)))
        text = f"residuals from {ws.number(step.rmse_fitted)} to {ws.number(self.rms)}"
        text += f" {ws.unit_label(calibration.unit)} rms"
        evidence_before, evidence = step.calibration.log_evidence, calibration.log_evidence
        if evidence_before is not None and evidence is not None:
            text += f", log Bayes factor {evidence[0] - evidence_before[0]:z.1f}"
        if added is not None:
            effect = calibration.model.effect(added)
            is_grouped = effect.coefficients[0].group_sd is not None
            name = effect.group_sd_name(0) if is_grouped else effect.coefficient_name(0)
            draws = calibration.samples(effect.measure_name or name)
            draws = draws if draws.ndim == 1 else np.sqrt(np.mean(draws**2, axis=1))
            size = ws.format_value(float(draws.mean()), float(draws.std()))
            unit = ws.unit_label(effect.coefficients[0].unit)
            text = f"{added} would be {f'{size} {unit}'.rstrip()}: {text}"
        self.summary = text


@dataclass(frozen=True)
class Change:
    """A change of the current model."""

    model: bc.Model  # the changed model
    added: str | None = None  # name of the added effect; None for another change
    description: str = ""  # of another change; empty for an added effect


REPORT = "report.html"
MAX_CACHED_SEARCHES = 4  # the latest ones


def _find_structure(model: bc.Model, search: ws.StepwiseSearch) -> ws.Structure | None:
    """Return the structure in a search that equals `model`, if it is a subset of the chosen structure, else None."""
    structures, chosen_structure = search.structures, search.chosen_structure
    base, candidates = structures.base, structures.candidates
    names = frozenset(model.names) - {*base.names}
    laws = {n: structures.noise_law(ws.Structure(noise=n)) for n in ("", chosen_structure.noise)}
    law = next((n for n, noise in laws.items() if noise == model.noise), None)
    if law is None or not names <= chosen_structure.effects or model.fixed != base.fixed:
        return None
    if any(e != model.effect(e.name) for e in base.effects if e.name in model.names):
        return None
    if not {*base.names} <= {*model.names} or not search.steps[0].calibration.verdict.ok:
        return None
    added = (model.effect(n) for n in names)
    matches = all(_matches_candidate(e, candidates[e.name]) for e in added)
    return ws.Structure(names, law) if matches else None


def _matches_candidate(effect: bc.Effect, form: bc.Effect) -> bool:
    """Return whether an effect equals a candidate's form, apart from plausible sizes that the search averages over."""
    first_coefficient = form.coefficients[0]
    factor = 1.0 if first_coefficient.flat else effect.coefficients[0].size / first_coefficient.size
    return effect.is_placeholder or effect == form or round(factor, 9) in ws.SIZE_FACTORS


@dataclass(eq=False)
class Session:
    """One user's work on one set of readings: a tree of states in a folder, one of which is current.

    Its methods may be called from any thread. Methods that create a state are serialised; previews and searches run in
    parallel. Every state is saved to disk before it becomes the current one.

    Attributes:
        readings, holdout: readings to fit, and hold-out data; spikes are set aside unless `settings` keep them.
        folder: folder with the saved states.
        settings: options of the search, as in `calibrate`.
        origin: sources of readings and effects.
        effects: user-defined effects, by name.
        on_change: callbacks when a state is created or becomes current, called from any thread.
    """

    readings: bc.Measurements
    holdout: bc.Measurements | None
    folder: Path
    settings: SearchOptions
    origin: Origin
    effects: dict[str, bc.Effect]
    on_change: list[Callable[[], None]] = field(default_factory=list)
    _states: dict[int, State] = field(default_factory=dict)
    _current_number: int = 0  # number of the current state
    _searches: list[ws.StepwiseSearch] = field(default_factory=list)  # cached searches
    _paths: dict[int, bc.SearchPath] = field(default_factory=dict)
    _tree_lock: threading.RLock = field(default_factory=threading.RLock)  # of the tree
    _fit_lock: threading.Lock = field(default_factory=threading.Lock)
    _search_lock: threading.RLock = field(default_factory=threading.RLock)  # of the searches
    _deadline: ws.deadline.Deadline | None = None  # deadline of the running search

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
        """Open a session: fit the model as its first state, or resume the session saved in `folder`.

        No code in the folder is executed: instruments and effects are arguments.

        Args:
            model, readings, holdout, effects: as in `calibrate`.
            folder: folder for the states; None for a temporary one.
            origin: sources of readings and effects; None for readings in memory.
            settings: options of `calibrate`, see `SearchOptions`.

        Raises:
            ModelError: the readings lack a column that the model needs.
            InputError: the folder cannot be written to, has a session of other readings or an effect that is not
                given, or a file in it was changed.
        """
        options = SearchOptions(**settings)
        spikes, held_out = options.keep_spikes, None
        model.require(readings)
        if holdout is not None:
            model.require(holdout)
            held_out = bc.exclude_faults(holdout, spikes)
        folder = Path(tempfile.mkdtemp(prefix="bayescal-") if folder is None else folder)
        with ws.create_result_folder(folder):
            name = model.instrument.name
            origin = origin or Origin(name if name in ws.list_installed() else "")
            readings, by_name = bc.exclude_faults(readings, spikes), {e.name: e for e in effects}
            session = cls(readings, held_out, folder, options, origin, by_name)
            if (folder / store.SESSION_FILE).is_file():
                session._resume(model)
            else:
                session._fit_change(Change(model), None)
        return session

    def _resume(self, model: bc.Model) -> None:
        """Load the states saved in the folder; remove a state that a crash left incomplete."""
        saved_session, effects = store.load_session(self.folder), tuple(self.effects.values())
        instruments = () if model.instrument.name in ws.list_installed() else (model.instrument,)
        for n, entry in enumerate(saved_session.states):
            path = store.locate_calibration(self.folder, n)
            calibration = bc.load(path, effects=effects, instruments=instruments)
            if not calibration.readings.same_as(self.readings):
                raise bc.InputError(
                    f"{self.folder} has a session of other readings, {calibration.readings.file}: give another folder "
                    "(--out), or remove it"
                )
            step = ws.check_step(calibration, self.holdout, self.settings.accept_conflicts)
            step = replace(step, added=entry.added, description=entry.description)
            self._states[n] = State(n, entry.parent, step)
            formulas = [e for e in calibration.model.effects if isinstance(e.basis, ws.Formula)]
            self.effects |= {e.name: e for e in formulas}
        self._current_number = saved_session.current
        store.locate_calibration(self.folder, len(self._states)).unlink(missing_ok=True)

    @property
    def states(self) -> Mapping[int, State]:
        """Return all states, by number."""
        with self._tree_lock:
            return MappingProxyType(dict(self._states))

    @property
    def current(self) -> State:
        return self._states[self._current_number]

    def path(self, number: int | None = None) -> list[State]:
        """Return the states from the first one to state `number`, by default the current one."""
        number = self._current_number if number is None else number
        return [self._states[n] for n in store.list_path(self._states, number)]

    def go_to(self, number: int) -> State:
        """Make another state the current one; further changes branch off from it."""
        with self._tree_lock:
            return self._set_current(number)

    def preview(self, kind: str, *arguments: Any) -> Preview:
        """Fit the model changed as by `act` without creating a state; return its results."""
        change, search, step = self._change(kind, *arguments), self._blank_search, self.current.step
        fit = step.calibration
        start = {n: float(v) for n, v in fit.problem.hyper(fit.mode.v).items()}
        options: dict[str, Any] = {"seed": search.seed, "reference": search.reference}
        options |= {"start": start, "strict": False}
        method = search.step_method(change.model)
        changed_fit = bc.fit(change.model, self.readings, method, **options)
        return Preview(step, changed_fit, change.added)

    def _change(self, kind: str, *arguments: Any) -> Change:
        """Apply a change of a kind, such as "add", to the current model."""
        model = self.current.model
        match (kind, *arguments):
            case ("add", str(name)):
                effect = self._effects_by_name().get(name) or model.instrument.effect(name)
                return self._change("add", effect)
            case ("add", bc.Effect() as effect):
                return Change(model + effect, added=effect.name)
            case ("take_out", str(name)):
                return Change(model - name, description=f"− {name}")
            case ("free", str(name)):
                return Change(model.free(name), description=f"{name} freed")
            case ("noise", str(name)):
                first = self.states[0].calibration
                laws = ws.list_laws(first.model, first.frame)  # that the readings identify
                law = {first.model.noise.name: first.model.noise, **laws}[name]
                return Change(model.with_noise(law), description=f"noise: {law.in_words}")
            case ("fix", str(name), value):
                text = f"{name} = {ws.number(float(value), 6)} fixed"
                return Change(model.fix({name: float(value)}), description=text)
            case ("resize", str(name), value):
                unit = ws.unit_label(model.effect(name).coefficients[0].unit)
                text = f"{name} of plausible size {ws.number(float(value))} {unit}".rstrip()
                return Change(model.resize(name, float(value)), description=text)
        raise bc.InputError(
            f"{kind!r} with {len(arguments)} argument(s) is not a change of a model"
        )

    def act(self, kind: str, *arguments: Any) -> State:
        """Change the current model, and fit it as the new current state.

        A candidate of the discovery is added in its most probable form and size.

        Raises:
            ModelError, InputError: the change is not possible.
        """
        return self._fit_change(self._change(kind, *arguments), self.current.number)

    def _effects_by_name(self) -> dict[str, bc.Effect]:
        """Return user-defined effects, and candidates of the discovery in their most probable form and size."""
        effects = {e.name: e for e in ws.list_forms(self.effects.values())}
        if (discovery := self.current.discovery) is None:
            return effects
        library, best = self.current.model.instrument.effect, discovery.best
        candidates, best = discovery.candidates, [e for e in best if not e.open]
        forms = {c.effect: effects.get(c.form) or library(c.form) for c in candidates if c.form}
        by_name = {e.family_name: e for e in best} | {e.name: e for e in best}
        return {**effects, **forms, **by_name}

    add = partialmethod(act, "add")  # (effect)
    take_out = partialmethod(act, "take_out")  # (effect)
    fix = partialmethod(act, "fix")  # (coefficient, value in the unit in which it is reported)
    free = partialmethod(act, "free")  # (coefficient)
    resize = partialmethod(act, "resize")  # (effect, plausible size of its first coefficient)
    noise = partialmethod(act, "noise")  # (name of a noise law that the readings identify)

    def find_missing(self) -> bc.Discovery:
        """Search for effects missing from the current state; return the discovery, which is kept in the state."""
        number = self.current.number
        with self._exclude_searches():  # another page may run the same search
            if (discovery := self.states[number].discovery) is None:
                search, structure = self._find_search(self.states[number])
                discovery = search.find_missing(structure)
                self._cache_discovery(number, discovery)
        return discovery

    def find_all(self, report: Callable[[bc.SearchPath], None] = lambda _: None) -> None:
        """Search from the current state as `calibrate` does; each step becomes a state.

        The search ends soon after a call of `stop`. `report` is called with the search path so far, as by `calibrate`.

        Raises:
            ModelError: the fit of the current model has failed.
        """
        state = self.current
        if state.step.failures and not self._blank_search.free_contradicted(state.step):
            raise bc.ModelError(f"no search is possible: {' '.join(state.step.failures)}")
        with self._exclude_searches():
            search, structure = self._find_search(state, report)
            steps, number = [state.step], state.number
            for last, chosen, discovery in search.iterate_path(search.chosen_structure, structure):
                if last is None:
                    self._cache_discovery(number, discovery)
                    continue
                steps.append(search.fit_structure(chosen, last))
                number = self._append(steps[-1], number, discovery).number
                report(search.build_path(steps=steps))

    @contextmanager
    def _exclude_searches(self) -> Iterator[None]:
        """Hold the lock of searches, with the time limit as deadline."""
        with self._search_lock, ws.deadline.limit(self.settings.time_limit) as self._deadline:
            yield

    def _find_search(
        self, state: State, report: Callable[[bc.SearchPath], None] | None = None
    ) -> tuple[ws.StepwiseSearch, ws.Structure]:
        """Return the search for effects missing from a state, and the state's structure in it.

        It is the search of `calibrate` from the first model, whose posterior is shared by all states on the way to its
        chosen structure. For a state with other effects, or other forms of them, it starts at the state's model.

        Args:
            state: state to search from.
            report: callback with the search path so far; only with it is a stopped search continued.
        """
        first, blank_search = self.states[0], self._blank_search
        effects = [e for e in first.model.effects if blank_search.is_reconsidered(e, first.model)]
        search = self._run_search(reduce(sub, effects, first.model), effects, report)
        if (structure := _find_structure(state.model, search)) is None:
            search, structure = self._run_search(state.model, (), report), ws.Structure()
        return search, structure

    def _run_search(
        self,
        core: bc.Model,
        effects: Sequence[bc.Effect],
        report: Callable[[bc.SearchPath], None] | None,
    ) -> ws.StepwiseSearch:
        """Return the search over models that add some of `effects` and candidates to `core`; run it unless cached."""
        search = next((s for s in self._searches if s.steps[0].calibration.model == core), None)
        if is_new := search is None:
            steps = (s.step for s in self.states.values() if s.model == core)
            search = replace(self._blank_search, reconsidered=tuple(effects), stopped="not begun")
            first = next(steps, None) or search.fit_step(core, search.step_method(core))
            extra = (*self.effects.values(), *search.free_contradicted(self.states[0].step))
            search.list_structures(first, extra, self.settings.widen_noise)
        if search.stopped and (is_new or report is not None):
            with ws.deadline.shorten(ws.SEARCH_TIME_SHARE):
                search.run_search(lambda: None if report is None else report(search.build_path()))
            searches = [*(s for s in self._searches if s is not search), search]
            self._searches = searches[-MAX_CACHED_SEARCHES:]
        return search

    def stop(self) -> None:
        """Stop the running search, with the best model so far."""
        if self._deadline is not None:
            self._deadline.interrupt.is_requested = True

    def parse_formula(self, line: str) -> bc.Effect:
        """Return the effect that a formula defines, in the syntax of `bc.effect`.

        Raises:
            InputError: the formula is invalid; the message marks the position.
        """
        return bc.effect(line, readings=self.readings, instrument=self.current.model.instrument)

    def add_formula(self, line: str) -> State:
        """Add the effect that a formula defines to the candidates and to the model; discard cached searches."""
        effect = self.parse_formula(line)
        _ = self.current.model + effect  # raises if its slot or a group does not exist
        self.effects[effect.name] = effect
        self._searches.clear()
        self._paths.clear()
        with self._tree_lock:
            states = {n: replace(s, discovery=None) for n, s in self._states.items()}
            self._set_current(self._current_number, states)
        return self.add(effect.name)

    def script(self) -> str:
        """Return a Python script that reproduces the current state, with identical numbers."""
        return self._generate_script(self.path())

    def search_path(self, state: State | None = None) -> bc.SearchPath:
        """Return the search path to a state (None: the current one), in the form that `calibrate` returns; cached.

        Its last model is fitted by the requested method. After a complete search, the calibration of the path is an
        average over the evaluated structures.
        """
        state = state or self.current
        with self._fit_lock:
            if state.number not in self._paths:
                self._paths[state.number] = self._build_search_path(state)
            return self._paths[state.number]

    def _build_search_path(self, state: State) -> bc.SearchPath:
        blank, path = self._blank_search, self.path(state.number)
        step = blank.fit_step(state.model, blank.method, state.calibration.start or {})
        step = replace(step, added=state.step.added, description=state.step.description)
        search = structure = None
        if step.calibration.verdict.ok:
            with suppress(ws.deadline.TimeIsUp), self._exclude_searches():
                search, structure = self._find_search(state)
                self._cache_discovery(state.number, search.find_missing(structure))
                path = self.path(state.number)
        steps = [*(s.step for s in path[:-1]), step]
        steps = [replace(s, discovery=p.discovery) for s, p in zip(steps, path, strict=True)]
        if not search or not structure or structure.effects != search.chosen_structure.effects:
            return bc.SearchPath(*ws.assess_steps(steps), self.holdout)
        with self._search_lock:
            return search.average_path(steps, structure)

    def verdict(self) -> str:
        """Format the verdict: whether the current model may be used, and the verdict of its fit."""
        trail = self.search_path()
        use_text = "This result may be used." if trail.ok else "Not to be used as it is."
        texts = (use_text, trail.gate.reason, str(trail.final.calibration.verdict))
        return "\n\n".join([*(ws.wrap(t, "") for t in texts if t), str(trail)])

    def compare(self, number: int) -> str:
        """Compare the current model with that of state `number` by `bc.compare`, and list the unknowns of both.

        Raises:
            InputError: they were fitted to different readings.
        """
        states = self.current, self.states[number]
        fits = {f"{s.number} {s.title}": s.calibration for s in states}
        tables = [ws.format_rows(c) for c in fits.values()]
        units = {name: row[2] for table in tables for name, row in table.items()}
        rows = [
            [name, *(table[name][1] if name in table else "–" for table in tables), unit]
            for name, unit in units.items()
        ]
        return f"{bc.compare(fits)}\n\n{ws.make_table(['', *fits, 'unit'], rows)}"

    def write(self, file: str) -> Path:
        """Write the report or an export of the current model, as `bayescal report` and `export` do; return its path.

        The files of `bayescal calibrate --out` are written to the same folder.

        Args:
            file: "report.html", or a file name whose suffix is that of an export's format.

        Raises:
            InputError, ModelError: an unknown format, or the model cannot be exported in it.
        """
        state = self.current
        trail, folder = self.search_path(state), self.folder / f"result_{state.number:03d}"
        folder.mkdir(exist_ok=True)
        with suppress(bc.NotDrawn):  # a report states missing pictures, an export needs none
            ws.save_search(trail, folder)
        if file == REPORT:
            return bc.report([trail], folder / file, effects=tuple(self.effects.values()))
        return bc.compensator(trail.calibration).export(folder / file)

    @property
    def _blank_search(self) -> ws.StepwiseSearch:
        """Return a search with the session's options, without structures."""
        s = self.settings
        options = (self.readings, self.holdout, s.method, s.seed, s.reference, s.max_effects)
        return ws.StepwiseSearch(*options, accepted_conflicts=frozenset(s.accept_conflicts))

    def _fit_change(self, change: Change, parent: int | None) -> State:
        """Fit the changed model as a child of state `parent`, and make it the current one."""
        search = self._blank_search
        step = search.fit_step(change.model, search.step_method(change.model))
        step = replace(step, added=change.added, description=change.description)
        return self._append(step, parent)

    def _append(
        self, step: ws.Step, parent: int | None, discovery: bc.Discovery | None = None
    ) -> State:
        """Save a step as a child of state `parent`, and make it the current one."""
        with self._tree_lock:
            number = len(self._states)
            state = State(number, parent, step, discovery)
            if (file := store.locate_calibration(self.folder, number)).exists():
                raise bc.InputError(
                    f"{file} was created meanwhile by another workbench in this folder: end one of them"
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
        path = [states[n] for n in store.list_path(states, number)]
        store.save_session(self.folder, states, number, self._generate_script(path))
        self._states, self._current_number = states, number
        for callback in tuple(self.on_change):
            callback()
        return self.current

    def _cache_discovery(self, number: int, discovery: bc.Discovery | None) -> None:
        with self._tree_lock:
            self._states[number] = replace(self._states[number], discovery=discovery)

    def _generate_script(self, path: list[State]) -> str:
        return store.generate_script(path, self.origin, self.settings, self.folder.resolve())
