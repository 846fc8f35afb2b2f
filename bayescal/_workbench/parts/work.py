"""Work beside the page: what takes longer than a frame runs in a thread, and the page goes on."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from threading import Lock
from typing import Any

import panel as pn

from bayescal._core.errors import BayescalError

Then = Callable[[Any], None]


def nothing() -> None:
    """What follows where nothing does."""


def in_words(error: Exception) -> str:
    """An error of a thread, which would be lost: for the page, and in the log if it is none of a user's making."""
    if isinstance(error, BayescalError):
        return str(error)
    logging.getLogger("bayescal").error("in the workbench", exc_info=error)
    return f"{type(error).__name__}: {error}"


class Work:
    """One page's work: jobs one after the other, beside them a look, and at most one preview, the one asked for last.

    Results, and refusals in words, come back to the page's own thread.
    """

    def __init__(self, tell: Callable[[str, bool], None], busy: Callable[[bool], None]) -> None:
        """Args:
        tell: `tell(words, refused)` says what is being done, "" when it is done, or why it could not be.
        busy: told when the first job begins and the last ends.
        """
        self._tell, self._busy = tell, busy
        self._document = pn.state.curdoc
        # Settings in force where the page was made hold for its work.
        self._context = copy_context()
        kinds = ("job", "look", "preview")
        self._pools = {k: ThreadPoolExecutor(1, thread_name_prefix=f"workbench {k}") for k in kinds}
        self._lock, self._wanted, self._under_way = Lock(), 0, 0

    @property
    def busy(self) -> bool:
        """Whether a job is under way."""
        return bool(self._under_way)

    def on_page(self, call: Callable[[], None]) -> None:
        """Call something in the page's own thread, soon; from any thread."""
        document = self._document
        if document is not None and document.session_context is not None:
            document.add_next_tick_callback(call)
        else:
            call()

    def begin(
        self,
        words: str,
        job: Callable[[], Any],
        then: Then,
        failed: Callable[[], None] = nothing,
    ) -> None:
        """Begin a job, after those that are under way; `then(result)`, or `failed()`, follows on the page."""

        def ended() -> None:
            self._count(-1)
            self._tell("", False)

        self._count(1)
        self._tell(words, False)
        self._submit("job", job, then, failed=failed, ended=ended)

    def look(self, job: Callable[[], Any], then: Then) -> None:
        """Look for something beside everything else; what is pressed meanwhile is not refused."""
        self._submit("look", job, then)

    def preview(self, job: Callable[[], Any], then: Then) -> None:
        """Compute a preview; one that another has overtaken is dropped."""
        ticket = self.forget_preview()
        self._submit("preview", job, then, wanted=lambda: ticket == self._wanted)

    def forget_preview(self) -> int:
        """Drop the preview that is under way; the number of the next."""
        with self._lock:
            self._wanted += 1
            return self._wanted

    def close(self, wait: bool = False) -> None:
        """Take no further work; what has not begun is dropped, unless it is waited for."""
        for pool in self._pools.values():
            pool.shutdown(wait=wait, cancel_futures=not wait)

    def _submit(
        self,
        kind: str,
        job: Callable[[], Any],
        then: Then,
        *,
        failed: Callable[[], None] = nothing,
        ended: Callable[[], None] = nothing,
        wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        """Do a job in a thread; what follows on the page does so only if it is still wanted."""

        def run() -> None:
            if not wanted():
                return
            result, wrong = None, None
            try:
                result = job()
            except Exception as error:
                wrong = in_words(error)

            def done() -> None:
                ended()
                if wrong is None:
                    then(result)
                else:
                    self._tell(wrong, True)
                    failed()

            if wanted():
                self.on_page(done)

        self._pools[kind].submit(self._context.copy().run, run)

    def _count(self, more: int) -> None:
        before, self._under_way = self.busy, self._under_way + more
        if before != self.busy:
            self._busy(self.busy)
