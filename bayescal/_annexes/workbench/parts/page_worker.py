"""Worker threads of the page, which run long jobs while the page stays responsive."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Any

import panel as pn

import bayescal as bc

N_THREADS = 4  # for a job, a search, and previews


class PageWorker:
    """Worker pool of one page; results and error messages are delivered in the page's own thread."""

    def __init__(self, show: Callable[[str, bool], None], set_busy: Callable[[bool], None]) -> None:
        """Start the pool.

        Args:
            show: `show(text, is_error)` shows the running jobs ("" for none), or an error message.
            set_busy: `set_busy(is_busy)` is called when jobs begin and end.
        """
        self._show, self._set_busy = show, set_busy
        self._document: Any = pn.state.curdoc
        # Jobs use the settings that were in force when the page was created.
        self._context = copy_context()
        self._pool = ThreadPoolExecutor(N_THREADS, thread_name_prefix="workbench")
        self._latest_preview = object()
        self._jobs: list[tuple[str, bool]] = []  # status, whether it may change the session

    @property
    def busy(self) -> bool:
        """Return whether a job that may change the session is running."""
        return any(is_change for _, is_change in self._jobs)

    def call_on_page(self, callback: Callable[[], Any]) -> None:
        """Schedule a call in the page's own thread; may be called from any thread."""
        if self._document is not None and self._document.session_context is not None:
            self._document.add_next_tick_callback(callback)
        else:
            callback()

    def run(
        self,
        job: Callable[[], Any],
        on_result: Callable[[Any], None],
        *,
        status: str = "",
        is_change: bool = False,
        on_error: Callable[[], None] = lambda: None,
        is_current: Callable[[], bool] = lambda: True,
    ) -> None:
        """Run a job in a thread, then call `on_result(result)`, or `on_error()` after an error, on the page.

        Args:
            job, on_result, on_error: function to run, and functions that are called after its success or failure.
            status: description of the job, shown on the page; "" for none.
            is_change: whether the job may change the session; if so, the page is busy while it runs.
            is_current: function that returns whether the result is still needed; if not, it is discarded.
        """

        def run_job() -> None:
            result, error, is_skipped = None, "", not is_current()
            try:
                result = None if is_skipped else job()
            except bc.BayescalError as caught:
                error = str(caught) or type(caught).__name__
            except Exception as caught:
                logging.getLogger("bayescal").error("in the workbench", exc_info=caught)
                error = f"{type(caught).__name__}: {caught}"
            self.call_on_page(lambda: finish(result, error, is_skipped))

        def finish(result: Any, error: str, is_skipped: bool) -> None:
            if status:
                self._jobs.remove(entry)
                self._show_jobs()
            if error and is_current():
                self._show(error, True)
                on_error()
            elif is_current() and not is_skipped:
                on_result(result)

        entry = status, is_change
        if status:
            self._jobs.append(entry)
            self._show_jobs()
        self._pool.submit(self._context.copy().run, run_job)

    def preview(self, job: Callable[[], Any], on_result: Callable[[Any], None]) -> None:
        """Run a job for a preview; its result is discarded if another preview is requested meanwhile."""
        token = self._latest_preview = object()
        self.run(job, on_result, is_current=lambda: token is self._latest_preview)

    def forget_preview(self) -> None:
        """Discard the result of the running preview."""
        self._latest_preview = object()

    def close(self) -> None:
        """Shut down the pool; jobs that have not begun are cancelled."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _show_jobs(self) -> None:
        """Show the running jobs, and disable changes of the model while a job may change the session."""
        self._set_busy(self.busy)
        self._show("; ".join(status for status, _ in self._jobs), False)
