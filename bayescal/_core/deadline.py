"""Deadlines of computations: a time limit, or Ctrl-C.

Long computations check the deadline between steps (`Deadline.ask`); a caller with a partial result catches `TimeIsUp`
and completes the result (`finishing`). No step takes longer than some seconds, so none has to be aborted.
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

    requested: bool = False  # whether Ctrl-C was pressed and deferred, or a thread requested an end
    deferred: bool = False  # whether a first Ctrl-C is deferred to the next check, because a partial result exists

    def handle(self, _: int, frame: FrameType | None) -> None:
        """Record a first Ctrl-C if it is deferred; else raise KeyboardInterrupt, once no JAX code is running.

        JAX's callbacks of garbage collection lose an exception; during JAX's import, it terminates the process.
        """
        if self.deferred and not self.requested:
            self.requested = True
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
    limit: str = ""  # the reason of the limit, in words
    interrupt: Interrupt = field(default_factory=Interrupt)  # Ctrl-C
    is_interruptible: bool = True  # whether Ctrl-C ends the computation

    @property
    def interrupted(self) -> bool:
        return self.is_interruptible and self.interrupt.requested

    @property
    def over(self) -> bool:
        return self.interrupted or time.monotonic() >= self.ends_at

    @property
    def why(self) -> str:
        """Return the reason why the time is up: the limit, or "interrupted"."""
        return "interrupted" if self.interrupted else self.limit

    def ask(self) -> None:
        """Raise TimeIsUp if the deadline has passed or Ctrl-C was pressed."""
        if self.over:
            raise TimeIsUp(self.why)

    def defer_interrupt(self) -> None:
        """Defer a first Ctrl-C to the next `ask`, because a partial result exists."""
        self.interrupt.deferred = True


_NONE = Deadline()
_CURRENT: ContextVar[Deadline] = ContextVar("deadline", default=_NONE)
current = _CURRENT.get


@contextmanager
def until(limit: float | None = None, words: str = "time limit of {:g} s") -> Iterator[Deadline]:
    """Set a deadline in `limit` s, unless an earlier one is set, with reason `words`; the outermost handles Ctrl-C."""
    deadline = Deadline() if current() is _NONE else current()
    if limit is not None and (ends_at := time.monotonic() + limit) < deadline.ends_at:
        deadline = replace(deadline, ends_at=ends_at, limit=words.format(limit))
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


def sooner(share: float) -> AbstractContextManager[Deadline]:
    """Set an earlier deadline, when `share` of the remaining time has passed."""
    deadline, now = current(), time.monotonic()
    return _use_deadline(replace(deadline, ends_at=now + share * (deadline.ends_at - now)))


def finishing() -> AbstractContextManager[Deadline]:
    """Suspend the deadline while a result is completed; a second Ctrl-C is raised at once."""
    return _use_deadline(replace(current(), ends_at=math.inf, is_interruptible=False))


@contextmanager
def _use_deadline(deadline: Deadline) -> Iterator[Deadline]:
    token = _CURRENT.set(deadline)
    try:
        yield deadline
    finally:
        _CURRENT.reset(token)
