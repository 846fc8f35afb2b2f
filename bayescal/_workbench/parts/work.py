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


class Work:
    """One page's work: jobs one after the other, beside them a look, and at most one preview, the one asked for last.

    Results, and refusals in words, come back to the page's own thread.
    """

    def __init__(self, tell: Callable[[str, bool], None]) -> None:
        """`tell(words, refused)` says what is being done, "" when it is done, or why it could not be."""
        self._tell = tell
        self._document = pn.state.curdoc
        self._context = (
            copy_context()
        )  # settings in force where the page was made hold for its work
        self._jobs = ThreadPoolExecutor(1, thread_name_prefix="workbench job")
        self._looks = ThreadPoolExecutor(1, thread_name_prefix="workbench look")
        self._previews = ThreadPoolExecutor(1, thread_name_prefix="workbench preview")
        self._lock, self._wanted = Lock(), 0
        self.on_busy: list[Callable[[bool], None]] = []
        self._under_way = 0

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
        then: Callable[[Any], None],
        failed: Callable[[], None] = lambda: None,
    ) -> None:
        """Begin a job, after those that are under way; `then(result)`, or `failed()`, follows on the page."""
        self._count(1)
        self._tell(words, False)

        def done(result: Any, error: BaseException | None) -> None:
            self._count(-1)
            self._tell("" if error is None else _in_words(error), error is not None)
            if error is None:
                then(result)
            else:
                failed()

        self._submit(self._jobs, job, done)

    def look(self, job: Callable[[], Any], then: Callable[[Any], None]) -> None:
        """Look for something beside everything else; what is pressed meanwhile is not refused."""

        self._submit(self._looks, job, lambda *outcome: self._ended(then, *outcome))

    def preview(self, job: Callable[[], Any], then: Callable[[Any], None]) -> None:
        """Compute a preview; one that another has overtaken is dropped."""
        with self._lock:
            self._wanted += 1
            ticket = self._wanted

        def wanted() -> bool:
            return ticket == self._wanted

        self._submit(self._previews, job, lambda *outcome: self._ended(then, *outcome), wanted)

    def forget_preview(self) -> None:
        """Drop the preview that is under way."""
        with self._lock:
            self._wanted += 1

    def close(self, wait: bool = False) -> None:
        """Take no further work; what has not begun is dropped, unless it is waited for."""
        for pool in (self._jobs, self._looks, self._previews):
            pool.shutdown(wait=wait, cancel_futures=not wait)

    def _submit(
        self,
        pool: ThreadPoolExecutor,
        job: Callable[[], Any],
        done: Callable[[Any, BaseException | None], None],
        wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        """Have a pool do a job; `done(result, error)` follows on the page, both only if it is still wanted."""

        def run() -> None:
            if not wanted():
                return
            outcome = _outcome(job)
            if wanted():
                self.on_page(lambda: done(*outcome))

        pool.submit(self._context.copy().run, run)

    def _ended(self, then: Callable[[Any], None], result: Any, error: BaseException | None) -> None:
        if error is None:
            then(result)
        else:
            self._tell(_in_words(error), True)

    def _count(self, more: int) -> None:
        before, self._under_way = self._under_way, self._under_way + more
        if bool(before) != bool(self._under_way):
            for call in self.on_busy:
                call(bool(self._under_way))


def _outcome(job: Callable[[], Any]) -> tuple[Any, BaseException | None]:
    try:
        return job(), None
    except Exception as error:  # a thread's error would be lost: the page says it
        if not isinstance(error, BayescalError):
            logging.getLogger("bayescal").exception("in the workbench")
        return None, error


def _in_words(error: BaseException) -> str:
    return str(error) if isinstance(error, BayescalError) else f"{type(error).__name__}: {error}"
