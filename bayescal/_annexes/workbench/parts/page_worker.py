"""Worker threads of the page: long jobs run in a thread while the page stays responsive."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import partial
from typing import Any

import panel as pn

import bayescal as bc

Then = Callable[[Any], None]


def do_nothing() -> None:
    """Do nothing."""


def in_words(error: Exception) -> str:
    """Return a thread's error in words for the page; log it if it is not a BayescalError."""
    if isinstance(error, bc.BayescalError):
        return str(error)
    logging.getLogger("bayescal").error("in the workbench", exc_info=error)
    return f"{type(error).__name__}: {error}"


class PageWorker:
    """Worker pools of one page: jobs in sequence; in parallel, read-only questions, a search, and the latest preview.

    Results, and errors in words, are delivered in the page's own thread.
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
        self._previewed = object()
        self._under_way: list[tuple[str, bool]] = []  # words, whether it only reads

    @property
    def busy(self) -> bool:
        """Return whether a job that may change the session is running."""
        return not all(reads for _, reads in self._under_way)

    def on_page(self, call: Callable[[], Any]) -> None:
        """Schedule a call in the page's own thread; from any thread."""
        if self._document is not None and self._document.session_context is not None:
            self._document.add_next_tick_callback(call)
        else:
            call()

    def begin(
        self,
        words: str,
        job: Callable[[], Any],
        then: Then,
        failed: Callable[[], None] = do_nothing,
        *,
        reads: bool = False,
    ) -> None:
        """Queue a job; `then(result)`, or `failed()`, follows on the page.

        Args:
            words: what is said of it.
            job, then, failed: see above.
            reads: it changes nothing, and waits for no job that does.
        """
        under_way = words, reads

        def ended() -> None:
            self._under_way.remove(under_way)
            self._follow()

        self._under_way.append(under_way)
        self._follow()
        self._submit("question" if reads else "job", job, then, failed, ended)

    def look(self, job: Callable[[], Any], then: Then) -> None:
        """Run a search in parallel to all other jobs."""
        self._submit("look", job, then)

    def preview(self, job: Callable[[], Any], then: Then) -> None:
        """Compute a preview, which a later one replaces."""
        token = self._previewed = object()
        self._submit("preview", job, then, current=lambda: token is self._previewed)

    def forget_preview(self) -> None:
        """Drop the running preview."""
        self._previewed = object()

    def close(self) -> None:
        """Shut the pools down; jobs that have not begun are dropped."""
        for pool in self._pools.values():
            pool.shutdown(wait=False, cancel_futures=True)

    def _submit(
        self,
        kind: str,
        job: Callable[[], Any],
        then: Then,
        failed: Callable[[], None] = do_nothing,
        ended: Callable[[], None] = do_nothing,
        current: Callable[[], bool] = lambda: True,
    ) -> None:
        """Run a job in a thread, then its continuation on the page, unless it is superseded."""

        def run() -> None:
            if not current():
                return
            try:
                follow = partial(then, job())
            except Exception as error:
                follow = partial(self._refused, in_words(error), failed)
            if current():
                self.on_page(lambda: (ended(), follow()))

        self._pools[kind].submit(self._context.copy().run, run)

    def _refused(self, why: str, failed: Callable[[], None]) -> None:
        self._tell(why, True)
        failed()

    def _follow(self) -> None:
        """Disable or enable changes of the model, and say what is under way."""
        self._busy(self.busy)
        self._tell("; ".join(words for words, _ in self._under_way), False)
