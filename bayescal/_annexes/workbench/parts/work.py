"""Work beside the page: what takes longer than a frame runs in a thread, and the page goes on.

What is under way is told with the time that it has taken.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import partial
from typing import Any

import panel as pn

import bayescal as bc

Then = Callable[[Any], None]


def nothing() -> None:
    """What follows where nothing does."""


def in_words(error: Exception) -> str:
    """An error of a thread, which would be lost: for the page, and in the log if it is none of a user's making."""
    if isinstance(error, bc.BayescalError):
        return str(error)
    logging.getLogger("bayescal").error("in the workbench", exc_info=error)
    return f"{type(error).__name__}: {error}"


class Work:
    """One page's work: jobs one after the other, beside them questions that only read, a look, and at most one preview,
    the one asked for last.

    Results, and refusals in words, come back to the page's own thread.
    """

    def __init__(self, tell: Callable[[str, bool], None], busy: Callable[[bool], None]) -> None:
        """Args:
        tell: `tell(words, refused)` says what is being done, "" when it is done, or why it could not be.
        busy: told when the first job begins and the last ends.
        """
        self._tell, self._busy = tell, busy
        self._document: Any = pn.state.curdoc
        # Settings in force where the page was made hold for its work.
        self._context = copy_context()
        kinds = ("job", "question", "look", "preview")
        self._pools = {k: ThreadPoolExecutor(1, thread_name_prefix=f"workbench {k}") for k in kinds}
        self._previewed, self._ticking = object(), None
        # Words, when it began, whether it only reads.
        self._under_way: list[tuple[str, float, bool]] = []

    @property
    def busy(self) -> bool:
        """Whether a job is under way that may change something."""
        return not all(reads for _, _, reads in self._under_way)

    def on_page(self, call: Callable[[], Any]) -> None:
        """Call something in the page's own thread, soon; from any thread."""
        if self._served:
            self._document.add_next_tick_callback(call)
        else:
            call()

    @property
    def _served(self) -> bool:
        return self._document is not None and self._document.session_context is not None

    def begin(
        self,
        words: str,
        job: Callable[[], Any],
        then: Then,
        failed: Callable[[], None] = nothing,
        *,
        reads: bool = False,
    ) -> None:
        """Begin a job, after those that are under way; `then(result)`, or `failed()`, follows on the page.

        Args:
            words: what is said of it.
            job, then, failed: see above.
            reads: it changes nothing, and waits for no job that does.
        """
        under_way = words, time.monotonic(), reads

        def ended() -> None:
            self._under_way.remove(under_way)
            self._follow()

        self._under_way.append(under_way)
        self._follow()
        self._submit("question" if reads else "job", job, then, failed, ended)

    def look(self, job: Callable[[], Any], then: Then) -> None:
        """Look for something beside everything else; what is pressed meanwhile is not refused."""
        self._submit("look", job, then)

    def preview(self, job: Callable[[], Any], then: Then) -> None:
        """Compute a preview; one that another has overtaken is dropped."""
        own = self._previewed = object()
        self._submit("preview", job, then, wanted=lambda: own is self._previewed)

    def forget_preview(self) -> None:
        """Drop the preview that is under way."""
        self._previewed = object()

    def close(self) -> None:
        """Take no further work; what has not begun is dropped."""
        for pool in self._pools.values():
            pool.shutdown(wait=False, cancel_futures=True)

    def _submit(
        self,
        kind: str,
        job: Callable[[], Any],
        then: Then,
        failed: Callable[[], None] = nothing,
        ended: Callable[[], None] = nothing,
        wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        """Do a job in a thread, and on the page what follows, while it is wanted."""

        def run() -> None:
            if not wanted():
                return
            try:
                follow = partial(then, job())
            except Exception as error:
                follow = partial(self._refused, in_words(error), failed)
            if wanted():
                self.on_page(lambda: (ended(), follow()))

        self._pools[kind].submit(self._context.copy().run, run)

    def _refused(self, why: str, failed: Callable[[], None]) -> None:
        self._tell(why, True)
        failed()

    def _follow(self) -> None:
        """Work began or ended: shut or open what changes the model, and tell of the time while there is some."""
        self._busy(self.busy)
        self._say()
        if self._served and self._under_way and self._ticking is None:
            self._ticking = self._document.add_periodic_callback(self._say, 1000)
        elif not self._under_way and self._ticking is not None:
            self._document.remove_periodic_callback(self._ticking)
            self._ticking = None

    def _say(self) -> None:
        now = time.monotonic()
        taken = [(words, now - begun) for words, begun, _ in self._under_way]
        self._tell("; ".join(f"{w} {s:.0f} s" if s >= 1 else w for w, s in taken), False)
