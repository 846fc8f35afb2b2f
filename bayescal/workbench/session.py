"""A session: what one person does to one set of readings, as a tree of states. It knows no browser."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any

from bayescal._core.errors import InputError
from bayescal._discovery.calibrate import Loop
from bayescal._discovery.discover import Discovery, discover
from bayescal._discovery.preview import Preview, Previews
from bayescal._model.effect import Effect
from bayescal._model.model import Model
from bayescal._readings.measurements import Measurements
from bayescal._recording.set_aside import set_aside
from bayescal._search.noise_laws import laws_over
from bayescal.workbench.state import State


@dataclass(frozen=True)
class Settings:
    """What `calibrate` is asked with, apart from model and readings; see there."""

    method: Any = None
    max_effects: int = 5
    widen_noise: bool = True
    keep_spikes: bool = False
    seed: int = 0
    reference: Mapping[str, Any] | None = None
    time_limit: float | None = None
    accept_conflicts: tuple[str, ...] = ()


@dataclass(eq=False)
class Session:
    """One person's work. Its methods may be called from any thread; one at a time does the work.

    Attributes:
        readings, holdout: what is fitted, and what is kept apart; spikes set aside.
        settings: as of `calibrate`.
        folder: where every state is kept; None for nowhere.
    """

    readings: Measurements
    holdout: Measurements | None
    settings: Settings
    folder: Path | None = None
    _own: dict[str, Effect] = field(default_factory=dict)
    _states: dict[int, State] = field(default_factory=dict)
    _at: int = 0
    _previews: dict[int, Previews] = field(default_factory=dict)
    _lock: threading.RLock = field(default_factory=threading.RLock)

    @classmethod
    def begin(
        cls,
        model: Model,
        readings: Measurements,
        *,
        holdout: Measurements | None = None,
        effects: Sequence[Effect] = (),
        folder: str | Path | None = None,
        **settings: Any,
    ) -> Session:
        """A session whose first state is a model fitted to readings.

        Args:
            model: to begin with.
            readings: to fit.
            holdout: readings kept apart.
            effects: further candidates of the user's own.
            folder: where every state is kept.
            settings: of `calibrate`: method, max_effects, widen_noise, keep_spikes, seed, reference, time_limit,
                accept_conflicts.

        Raises:
            ModelError: the readings lack what the model needs.
        """
        asked = Settings(**settings)
        model.require(readings)
        if holdout is not None:
            model.require(holdout)
            holdout = set_aside(holdout, asked.keep_spikes)
        session = cls(
            set_aside(readings, asked.keep_spikes),
            holdout,
            asked,
            None if folder is None else Path(folder),
            {e.name: e for e in effects},
        )
        session._become(model, "baseline", None)
        return session

    @property
    def states(self) -> Mapping[int, State]:
        """All states, by number."""
        return MappingProxyType(dict(self._states))

    @property
    def current(self) -> State:
        return self._states[self._at]

    def path(self) -> list[State]:
        """The states from the first to the current one."""
        found = [self.current]
        while found[0].parent is not None:
            found.insert(0, self._states[found[0].parent])
        return found

    def go_to(self, number: int) -> State:
        """Make another state the current one; what is done next branches off there.

        Raises:
            InputError: there is no such state.
        """
        if number not in self._states:
            raise InputError(f"there is no state {number}: there are 0 to {len(self._states) - 1}")
        self._at = number
        return self.current

    @property
    def laws(self) -> Mapping[str, Any]:
        """Noise laws that the readings can tell, by name, that of the first model among them."""
        first = self._states[0].calibration
        return {first.model.noise.name: first.model.noise, **laws_over(first.model, first.frame)}

    def preview(self, effect: str) -> Preview:
        """What adding an effect to the current state would do: `bc.preview`; kept, so that asking again costs nothing.

        Raises:
            ModelError: it is in the model already, unknown, or these readings cannot test it.
        """
        with self._lock:
            state = self.current
            if state.number not in self._previews:
                self._previews[state.number] = Previews(
                    state.calibration, own=tuple(self._own.values())
                )
            return self._previews[state.number].of(effect)

    def look(self) -> Discovery:
        """What is missing from the current state, with probabilities: `bc.discover`; kept in the state."""
        with self._lock:
            state, asked = self.current, self.settings
            if state.discovery is None:
                found = discover(
                    state.calibration,
                    effects=tuple(self._own.values()),
                    max_effects=asked.max_effects,
                    widen_noise=asked.widen_noise,
                    time_limit=asked.time_limit,
                )
                state = self._states[state.number] = replace(state, discovery=found)
            assert state.discovery is not None
            return state.discovery

    def add(self, effect: str) -> State:
        """The current model with an effect more.

        Raises:
            ModelError: as `model + effect`.
        """
        return self._become(self.current.model + self._own.get(effect, effect), f"+ {effect}")

    def take_out(self, effect: str) -> State:
        """The current model without an effect.

        Raises:
            ModelError: it is not in the model.
        """
        return self._become(self.current.model - effect, f"− {effect}")

    @property
    def _loop(self) -> Loop:
        s = self.settings
        return Loop(
            self.readings,
            self.holdout,
            s.method,
            s.seed,
            s.reference,
            s.max_effects,
            frozenset(s.accept_conflicts),
            s.time_limit,
        )

    def _become(self, model: Model, title: str, parent: int | None = -1) -> State:
        """Fit a model as a child of the current state, and make it the current one."""
        with self._lock:
            loop, parent = self._loop, self._at if parent == -1 else parent
            step = loop.step(model, method=loop.quick(model))
            number = len(self._states)
            state = State(number, parent, title, step, datetime.now(UTC))
            self._states[number], self._at = state, number
            return state
