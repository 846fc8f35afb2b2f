"""Work beside the page: what takes longer than a frame runs in a thread, and the page goes on.

What is under way is told with the time that it has taken and, once the like of it was done here, about how long it
still takes.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass
from threading import Lock
from typing import Any

import panel as pn

from bayescal import BayescalError

Then = Callable[[Any], None]


def nothing() -> None:
    """What follows where nothing does."""


def in_words(error: Exception) -> str:
    """An error of a thread, which would be lost: for the page, and in the log if it is none of a user's making."""
    if isinstance(error, BayescalError):
        return str(error)
    logging.getLogger("bayescal").error("in the workbench", exc_info=error)
    return f"{type(error).__name__}: {error}"


@dataclass(eq=False)
class UnderWay:
    """A job: what is said of it, s that the last of its kind took and that it may take at most, whether it only reads,
    and when it began."""

    words: str
    usual: float | None
    most: float | None
    reads: bool = False
    begun: float | None = None

    def told(self, now: float) -> str:
        """What is being done, for how long by now, and about how long it still takes."""
        taken = 0.0 if self.begun is None else now - self.begun
        left = [end - taken for end in (self.usual, self.most) if end is not None]
        said = f"{self.words} {taken:.0f} s" if taken >= 1 else self.words
        if not left:
            return said
        rest = min(left)
        return f"{said}, about {rest:.0f} s left" if rest >= 1 else f"{said}, longer than usual"


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
        self._document = pn.state.curdoc
        # Settings in force where the page was made hold for its work.
        self._context = copy_context()
        kinds = ("job", "question", "look", "preview")
        self._pools = {k: ThreadPoolExecutor(1, thread_name_prefix=f"workbench {k}") for k in kinds}
        self._lock, self._wanted, self._ticking = Lock(), 0, None
        self._under_way: list[UnderWay] = []
        self._took: dict[str, float] = {}  # s, by the first word of what is said of a job

    @property
    def busy(self) -> bool:
        """Whether a job is under way that may change something."""
        return not all(one.reads for one in self._under_way)

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
        *,
        reads: bool = False,
        most: float | None = None,
    ) -> None:
        """Begin a job, after those that are under way; `then(result)`, or `failed()`, follows on the page.

        Args:
            words: what is said of it; its first word is its kind.
            job, then, failed: see above.
            reads: it changes nothing, and waits for no job that does.
            most: s that it may take.
        """
        kind = words.split()[0]
        own = UnderWay(words, self._took.get(kind), most, reads)

        def timed() -> Any:
            own.begun = time.monotonic()
            return self._timed(kind, job)

        def ended() -> None:
            self._under_way.remove(own)
            self._follow()

        self._under_way.append(own)
        self._follow()
        self._submit("question" if reads else "job", timed, then, failed=failed, ended=ended)

    def _timed(self, kind: str, job: Callable[[], Any]) -> Any:
        begun = time.monotonic()
        result = job()
        self._took[kind] = time.monotonic() - begun
        return result

    def look(self, job: Callable[[], Any], then: Then) -> None:
        """Look for something beside everything else; what is pressed meanwhile is not refused."""
        self._submit("look", lambda: self._timed("Finding", job), then)

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

    def _follow(self) -> None:
        """Work began or ended: shut or open what changes the model, and tell of the time while there is some."""
        self._busy(self.busy)
        self._say()
        document = self._document
        if document is None or document.session_context is None:
            return
        if self._under_way and self._ticking is None:
            self._ticking = document.add_periodic_callback(self._say, 1000)
        elif not self._under_way and self._ticking is not None:
            document.remove_periodic_callback(self._ticking)
            self._ticking = None

    def _say(self) -> None:
        now = time.monotonic()
        self._tell("; ".join(one.told(now) for one in self._under_way), False)
