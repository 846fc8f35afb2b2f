"""The whole search from a state on, as `calibrate` makes it; it can be stopped, and gone on with."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

from bayescal._core.errors import ModelError
from bayescal._model.effect import Effect
from bayescal._search.calibrate import Loop
from bayescal._search.candidate import Candidate
from bayescal._search.discover import Discovery, discovery_at
from bayescal._search.library import Library
from bayescal._search.posterior import Posterior, Search, ShownStructure
from bayescal._search.search_path import SearchPath, Step
from bayescal._search.walk import path


class RunningSearch:
    """One search.

    Attributes:
        seeds: the structures weighed, to go on with.
    """

    seeds: tuple[ShownStructure, ...] = ()

    def __init__(
        self, loop: Loop, first: Step, ending: threading.Event, follow: Callable[[SearchPath], None]
    ) -> None:
        """Args:
        loop: what stays the same.
        first: the step to search from.
        ending: set, it ends the search with the best so far.
        follow: called with the trail so far.

        Raises:
            ModelError: nothing can be learnt from that step.
        """
        self._freed = loop.freed(first)
        if first.against and not self._freed:
            raise ModelError(f"nothing is looked for: {' '.join(first.against)}")
        self.loop, self.first = replace(loop, begun=time.monotonic()), first
        self._ending, self._follow, self._stopped = ending, follow, ""

    def open(self, effects: Sequence[Effect], widen_noise: bool) -> None:
        """Lay out the structures over the first step's model."""
        more = (*effects, *self._freed)
        self.loop, structures, shut = self.loop.open(self.first, more, widen_noise)
        self._shut: list[Candidate] = shut
        self._library = Library(structures)

    def look(self, seeds: Sequence[ShownStructure]) -> None:
        """Walk over the structures until the end, or until it is stopped."""
        structures = self._library.structures

        def tell() -> None:
            self._follow(self.loop.trail([self.first], structures, complete=False))
            if self._ending.is_set():
                raise KeyboardInterrupt  # ends the walk with the best so far, as Ctrl-C does

        self._library, self._stopped = self.loop.look(self._library, seeds, tell)
        structures = self._library.structures
        self.seeds = Search.of(structures, complete=not self._stopped).structures

    def steps(self) -> Iterator[tuple[Step, Discovery | None]]:
        """The first step and those on the way to the most probable structure, each with what is missing from it."""
        structures = self._library.structures
        way = path(self._library, Posterior.of(structures).chosen)
        steps = [self.first]
        yield self.first, self._missing(way[0])
        for before, at in pairwise(way):
            weighed = structures.weigh(at)
            model, start = weighed.sized_model, weighed.phi
            method = self.loop.quick(model)
            steps.append(self.loop.step(model, before, at, method=method, start=start))
            yield steps[-1], self._missing(at)
            self._follow(self.loop.trail(steps, structures, complete=False))

    def _missing(self, at) -> Discovery | None:
        if not self.first.calibration.verdict.ok:
            return None
        return discovery_at(self._library, at, self._shut, self._stopped)
