"""The tree of states of a session, kept in a folder: a state is on the disk before anyone sees it."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType

from bayescal._core.errors import InputError
from bayescal._data.measurements import Measurements
from bayescal._data.set_aside import set_aside
from bayescal._model.effect import Effect
from bayescal._search.calibrate import step_of
from bayescal._search.discover import Discovery
from bayescal._search.own_files import refuse_unnamed
from bayescal._search.search_path import Step
from bayescal._workbench import kept
from bayescal._workbench.origin import Origin, Settings, refuse_other
from bayescal._workbench.script import folder_name, script
from bayescal._workbench.state import State

NOWHERE = Origin("", ())


@dataclass(eq=False)
class Tree:
    """States, each with its parent, and which one is current.

    Attributes:
        folder: that keeps them.
        settings: as of `calibrate`.
        origin: where readings and effects come from.
        on_change: called when a state is made or gone to, from whatever thread.
    """

    folder: Path
    settings: Settings
    origin: Origin = NOWHERE
    on_change: list[Callable[[], None]] = field(default_factory=list)
    _states: dict[int, State] = field(default_factory=dict)
    _at: int = 0
    _been: list[int] = field(default_factory=list)  # current states before this one, the last last
    _lock: threading.RLock = field(default_factory=threading.RLock)

    @classmethod
    def begin(cls, folder: str | Path | None, settings: Settings) -> Tree:
        """A tree without a state, in a folder; None: a temporary one.

        Raises:
            InputError: the folder cannot be made, or holds a session.
        """
        folder = Path(tempfile.mkdtemp(prefix="bayescal-") if folder is None else folder)
        if (folder / kept.SESSION).is_file():
            raise InputError(f"{folder} holds a session already: resume it, or give another folder")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot write to the folder {folder}: {error.strerror}") from None
        return cls(folder, settings)

    @classmethod
    def resume(
        cls,
        folder: Path,
        effects: Mapping[str, Effect],
        of: Origin | None = None,
        trust: Iterable[str | Path] = (),
    ) -> tuple[Tree, dict[str, Effect], Measurements | None]:
        """The tree in a folder, effects of the user's own, and the hold-out data.

        Args:
            folder: of a session.
            effects: that are in no file.
            of: what it must be of.
            trust: Python files that it may name, beside those of `of`.

        Raises:
            InputError: it holds no session, something in it was changed, or it names a Python file that is not to be
                trusted.
        """
        told = kept.session_in(folder)
        if of is not None:
            refuse_other(told["origin"], of, folder)
        tree = cls(folder, told["settings"], told["origin"])
        named = (*trust, *(of.python_files if of else ()))
        refuse_unnamed(tree.origin.python_files, named, folder / kept.SESSION)
        instrument, spikes = tree.origin.open_instrument(), tree.settings.keep_spikes
        own = {**effects, **tree.origin.open_effects()}
        found = list(kept.states_in(folder, own, instrument))
        if not found or found[0][0]["number"]:
            raise InputError(f"{folder} holds no first step that is whole: begin in another folder")
        holdout = tree.origin.open_holdout(instrument or found[0][1].model.instrument)
        holdout = None if holdout is None else set_aside(holdout, spikes)
        for said, calibration in found:
            step = step_of(calibration, holdout, tree.settings.accept_conflicts)
            step = replace(step, added=said["added"], changed=said["changed"])
            state = State(said["number"], said["parent"], said["title"], step, said["at"])
            tree._states[state.number] = state
        at = told["current"]
        tree._at = at if at in tree._states else max(tree._states)
        return tree, own, holdout

    @property
    def states(self) -> Mapping[int, State]:
        """All states, by number."""
        with self._lock:
            return MappingProxyType(dict(self._states))

    @property
    def current(self) -> State:
        return self._states[self._at]

    def path(self, number: int | None = None) -> list[State]:
        """The states from the first to one, the current one if none is named."""
        found = [self._states[self._at if number is None else number]]
        while found[0].parent is not None:
            found.insert(0, self._states[found[0].parent])
        return found

    def go_to(self, number: int) -> State:
        """Make a state the current one.

        Raises:
            InputError: there is no such state.
        """
        with self._lock:
            if number not in self._states:
                raise InputError(f"there is no step {number}: there are 0 to {max(self._states)}")
            self._been.append(self._at)
            self._be(number)
            return self.current

    @property
    def before(self) -> int | None:
        """The state that was current before this one, its parent if that is not known; None for a first one."""
        return self._been[-1] if self._been else self.current.parent

    def undo(self) -> State:
        """Make the state current that was so before; what was done since stays, as a branch.

        Raises:
            InputError: nothing was done.
        """
        with self._lock:
            if (before := self.before) is None:
                raise InputError("nothing was done that could be undone")
            del self._been[-1:]
            self._be(before)
            return self.current

    def _be(self, number: int) -> None:
        """Make a state the current one."""
        self._at = number
        self._keep()
        for call in tuple(self.on_change):
            call()

    def append(self, step: Step, parent: int | None, discovery: Discovery | None = None) -> State:
        """A step as a child of a state: kept, and then the current one.

        Raises:
            InputError: it cannot be written.
        """
        with self._lock:
            number = max(self._states, default=-1) + 1
            state = State(number, parent, step.title, step, datetime.now(UTC), discovery)
            path = [] if parent is None else self.path(parent)
            if not number:
                self._keep()
            kept.keep_state(self.folder, folder_name(number), state, self.script([*path, state]))
            self._states[number] = state
            if number:
                self._been.append(self._at)
            self._be(number)
            return state

    def found(self, number: int, discovery: Discovery | None) -> None:
        """Keep what was found to be missing from a state."""
        with self._lock:
            self._states[number] = replace(self._states[number], discovery=discovery)

    def with_effects(self, path: Path) -> None:
        """A file more of effects of the user's own: what is missing is to be looked for again."""
        with self._lock:
            self.origin = self.origin.with_effects(path)
            self._states = {n: replace(s, discovery=None) for n, s in self._states.items()}
            self._keep()

    def script(self, path: list[State]) -> str:
        """Python that does what was done along a path."""
        s = self.settings
        return script(path, self.origin, s.method, s.seed, s.reference, self.folder.resolve())

    def _keep(self) -> None:
        kept.keep_session(self.folder, self.origin, self.settings.data(), self._at)
