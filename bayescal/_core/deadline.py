"""Deadlines of computations: a time limit, or Ctrl-C.

Long computations check the deadline between steps (`Deadline.raise_if_over`); a caller with a partial result catches
`TimeIsUp` and completes the result (`suspend`). No step takes longer than some seconds, so none has to be aborted.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from types import FrameType

RETRY_SECONDS = 0.02  # delay after which a Ctrl-C that arrived inside JAX is raised again


class TimeIsUp(Exception):
    """Raised when the time limit is reached or Ctrl-C was pressed; the message is the reason."""


@dataclass(eq=False)
class Interrupt:
    """State of the handler of Ctrl-C, during a command or a call from Python."""

    is_requested: bool = False  # whether a deferred Ctrl-C, or a thread, has requested an end
    is_deferred: bool = False  # whether a first Ctrl-C is deferred to the next check, because a partial result exists

    def handle(self, _: int, frame: FrameType | None) -> None:
        """Record a first Ctrl-C if it is deferred; else raise KeyboardInterrupt, once no JAX code is running.

        An exception in JAX's garbage-collection callbacks is lost; during JAX's import, it ends the process.
        """
        if self.is_deferred and not self.is_requested:
            self.is_requested = True
            return
        while frame is not None:
            if str(frame.f_globals.get("__name__")).startswith("jax"):
                threading.Timer(RETRY_SECONDS, signal.raise_signal, (signal.SIGINT,)).start()
                return
            frame = frame.f_back
        raise KeyboardInterrupt


@dataclass(frozen=True)
class Deadline:
    """Time at which a computation must end, and the handling of Ctrl-C."""

    ends_at: float = math.inf  # s, of `time.monotonic`
    limit_reason: str = ""  # what limits the time, for messages: "time limit of 60 s"
    interrupt: Interrupt = field(default_factory=Interrupt)  # Ctrl-C
    is_interruptible: bool = True  # whether Ctrl-C ends the computation

    @property
    def is_interrupted(self) -> bool:
        return self.is_interruptible and self.interrupt.is_requested

    @property
    def is_over(self) -> bool:
        return self.is_interrupted or time.monotonic() >= self.ends_at

    @property
    def reason(self) -> str:
        """Return why the computation ends: the name of the time limit, or "interrupted" after Ctrl-C."""
        return "interrupted" if self.is_interrupted else self.limit_reason

    def raise_if_over(self) -> None:
        """Raise TimeIsUp if the deadline has passed or Ctrl-C was pressed."""
        if self.is_over:
            raise TimeIsUp(self.reason)

    def defer_interrupt(self) -> None:
        """Defer a first Ctrl-C to the next `raise_if_over`, because a partial result exists."""
        self.interrupt.is_deferred = True


_NO_DEADLINE = Deadline()
_CURRENT: ContextVar[Deadline] = ContextVar("deadline", default=_NO_DEADLINE)
current = _CURRENT.get


@contextmanager
def limit(seconds: float | None = None, words: str = "time limit of {:g} s") -> Iterator[Deadline]:
    """Set a deadline in `seconds` (None: no new one) for the `with` block, unless an earlier one is set.

    `words`, formatted with `seconds`, is its `limit_reason`. The outermost `limit` of the main thread handles Ctrl-C.
    """
    deadline = Deadline() if current() is _NO_DEADLINE else current()
    if seconds is not None and (ends_at := time.monotonic() + seconds) < deadline.ends_at:
        deadline = replace(deadline, ends_at=ends_at, limit_reason=words.format(seconds))
    default, main = signal.default_int_handler, threading.main_thread()
    handles = threading.current_thread() is main and signal.getsignal(signal.SIGINT) is default
    if handles:
        signal.signal(signal.SIGINT, deadline.interrupt.handle)
    try:
        with _use_deadline(deadline):
            yield deadline
    finally:
        if handles:
            signal.signal(signal.SIGINT, default)


def shorten(fraction: float) -> AbstractContextManager[Deadline]:
    """Set an earlier deadline within the `with` block: `fraction` of the remaining time from now."""
    deadline, now = current(), time.monotonic()
    return _use_deadline(replace(deadline, ends_at=now + fraction * (deadline.ends_at - now)))


def suspend() -> AbstractContextManager[Deadline]:
    """Suspend the deadline within the `with` block, which completes a result; a second Ctrl-C is raised at once."""
    return _use_deadline(replace(current(), ends_at=math.inf, is_interruptible=False))


@contextmanager
def _use_deadline(deadline: Deadline) -> Iterator[Deadline]:
    token = _CURRENT.set(deadline)
    try:
        yield deadline
    finally:
        _CURRENT.reset(token)
