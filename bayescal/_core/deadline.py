"""When work has to end: one deadline, made at a command's door and asked by everything that may go on for long.

Two things end work early: its time limit, and Ctrl-C. Loops ask between their pieces (`ask`), and hand over what stands
as a result before they begin (`offer`). A compiled call cannot be asked: so under a deadline work is done in a thread
of its own (`within`), whose door waits until then and a little longer, takes what was handed over last, and leaves the
call behind. Ctrl-C comes at no moment that work can reckon with: what is left to be done of a result then is done in a
time that begins with it (`grace`), unless it is pressed again.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from dataclasses import dataclass, field, replace
from types import FrameType
from typing import Any, TypeVar

from bayescal._core.errors import TimeIsUp

TICK_SECONDS = 0.02  # s between looks at the clock
LATE_SECONDS = 0.2  # s beyond the deadline, in which work may end by itself;
OUTERMOST_SECONDS = 0.4  # more at the door of all
FIRST_SECONDS = 4.0  # where a time limit has passed and nothing stands yet, of the 5 s that it may be exceeded by
T = TypeVar("T")


@dataclass(frozen=True)
class Deadline:
    """A moment by which work ends.

    Attributes:
        ends_at: by `time.monotonic`, s.
        limit: what sets it, in words; empty where nothing does.
        apart: whether work is done in a thread of its own, which can be left.
        ended: set by Ctrl-C.
    """

    ends_at: float = math.inf
    limit: str = ""
    apart: bool = False
    ended: threading.Event = field(default_factory=threading.Event)

    @property
    def left(self) -> float:
        """Seconds; none after Ctrl-C."""
        return 0.0 if self.interrupted else max(0.0, self.ends_at - time.monotonic())

    @property
    def over(self) -> bool:
        return self.left <= 0.0

    @property
    def interrupted(self) -> bool:
        return self.ended.is_set()

    @property
    def why(self) -> str:
        """What leaves no time, in words."""
        return "interrupted" if self.interrupted else self.limit

    def ask(self) -> None:
        """Go on, if there is time.

        Raises:
            TimeIsUp: there is none.
        """
        if self.over:
            raise TimeIsUp(self.why)


_NONE = Deadline()
_CURRENT: ContextVar[Deadline] = ContextVar("deadline", default=_NONE)


def current() -> Deadline:
    """The deadline of what is running; one that never comes where none was made."""
    return _CURRENT.get()


@contextmanager
def until(
    limit: float | None = None, *, words: str = "time limit of {:g} s", apart: bool = False
) -> Iterator[Deadline]:
    """A deadline for what is inside: `limit` seconds from now, or that which stands already, if it is earlier.

    Args:
        limit: None for none of its own.
        words: for it.
        apart: whether calls that cannot be asked are left at Ctrl-C; at a limit they always are.
    """
    outer = current()
    ends_at = math.inf if limit is None else time.monotonic() + limit
    sooner = ends_at < outer.ends_at
    # Nested deadlines share one event: Ctrl-C ends all of them, and a deadline inside is never later than that
    # outside.
    made = Deadline(
        ends_at if sooner else outer.ends_at,
        words.format(limit) if sooner else outer.limit,
        apart or sooner or outer.apart,
        threading.Event() if outer is _NONE else outer.ended,
    )
    with _holding(made), _ended_by_ctrl_c(made):
        yield made


@contextmanager
def _ended_by_ctrl_c(end: Deadline) -> Iterator[None]:
    """Ctrl-C sets `ended` of a deadline whose work is apart, and raises KeyboardInterrupt too where none has begun.

    By itself Python raises it wherever the main thread stands. In a callback that cannot raise, such as JAX's at each
    collection of garbage, it is printed and lost; while JAX is loaded it ends the process by a signal. So it waits
    until the thread is out of JAX.
    """
    own = threading.current_thread() is threading.main_thread()
    if not (end.apart and own and signal.getsignal(signal.SIGINT) is signal.default_int_handler):
        yield
        return

    def pressed(_: int, frame: FrameType | None) -> None:
        if not _begun.is_set() and _in_jax(frame):
            threading.Timer(TICK_SECONDS, signal.raise_signal, (signal.SIGINT,)).start()
            return
        again = end.interrupted
        end.ended.set()
        if again or not _begun.is_set():
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, pressed)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _begun.clear()


def _in_jax(frame: FrameType | None) -> bool:
    while frame is not None and not str(frame.f_globals.get("__name__")).startswith("jax"):
        frame = frame.f_back
    return frame is not None


@contextmanager
def share(part: float = 1.0, keep: float = 0.0) -> Iterator[Deadline]:
    """An earlier deadline for what is inside: a part of the time left, and not its last `keep` seconds."""
    outer, now = current(), time.monotonic()
    left = max(0.0, outer.ends_at - now)  # also after Ctrl-C, of which `grace` takes its part
    allowed = max(0.0, min(part * left, left - keep))
    with _holding(replace(outer, ends_at=min(outer.ends_at, now + allowed))) as made:
        yield made


@contextmanager
def grace(seconds: float) -> Iterator[Deadline]:
    """After Ctrl-C, so much time for what makes a result of what there is; else the deadline that stands."""
    end = current()
    allow(seconds)
    if end.interrupted:
        ends_at = min(time.monotonic() + seconds, end.ends_at)
        end = replace(end, ends_at=ends_at, limit=end.why, ended=threading.Event())
    with _holding(end):
        yield end


def allow(seconds: float) -> None:
    """From here on the doors wait so long after Ctrl-C, for a result to be made; pressed once more, they do not."""
    own = _DOOR.get()
    while own is not None:
        own.grace, own = max(own.grace, seconds), own.outer


@contextmanager
def _holding(made: Deadline) -> Iterator[Deadline]:
    token = _CURRENT.set(made)
    try:
        yield made
    finally:
        _CURRENT.reset(token)


@dataclass(eq=False)
class Handover:
    """Where work hands over what stands as a result: a function of words for what left no time to go on."""

    outer: Handover | None = None
    offered: Callable[[str], Any] | None = None
    grace: float = 0.0  # s that it waits longer after Ctrl-C, if it is not pressed again
    shut: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)

    @contextmanager
    def offering(self, result: Callable[[str], Any]) -> Iterator[None]:
        """Hand over a result; the door does not shut while what is inside tells of it.

        Raises:
            TimeIsUp: the door is shut: nobody waits for it any more.
        """
        with self.lock:
            if self.shut:
                raise TimeIsUp("left behind")
            self.offered = result
            yield

    @property
    def anything(self) -> bool:
        """Whether something was handed over, here or farther out."""
        return self.offered is not None or (self.outer is not None and self.outer.anything)

    def taken(self, early: TimeIsUp) -> Any:
        """What was handed over last.

        Raises:
            TimeIsUp: nothing was.
        """
        with self.lock:
            self.shut = True
        if self.offered is None:
            raise early
        return self.offered(early.why)


_DOOR: ContextVar[Handover | None] = ContextVar("door", default=None)
_begun = threading.Event()  # work apart: Ctrl-C need not be raised, for its end is waited for


def door() -> Handover:
    """That of the work that is running; one that leads nowhere where there is none."""
    return _DOOR.get() or Handover()


def offer(result: Callable[[str], Any]) -> None:
    """Hand over what stands as a result of the work that is running, made from words for what leaves no time."""
    with door().offering(result):
        pass


def within(work: Callable[[], T]) -> T:
    """What work gives or, where the deadline comes first, what it handed over last.

    Raises:
        TimeIsUp: it had handed over nothing.
        KeyboardInterrupt: nor had it when Ctrl-C was pressed; or it was pressed a second time.
    """
    end, outer = current(), _DOOR.get()
    own = Handover(outer)
    token = _DOOR.set(own)
    try:
        if end.apart:
            return _apart(work, end, own)
        return work()
    except TimeIsUp as early:
        if outer is None and end.interrupted and own.offered is None:
            raise KeyboardInterrupt from early
        return own.taken(early)
    except KeyboardInterrupt:
        if end.interrupted or own.offered is None or end is _NONE:
            raise
        end.ended.set()
        return own.taken(TimeIsUp(end.why))
    finally:
        _DOOR.reset(token)


def _patience(end: Deadline, own: Handover) -> float:
    """Seconds beyond the deadline: the door of all waits longest, so that those within are left first."""
    farther_out = OUTERMOST_SECONDS if own.outer is None else 0.0
    more = own.grace if end.interrupted else 0.0 if own.anything else FIRST_SECONDS
    return LATE_SECONDS + farther_out + more


def finish(work: Callable[[], T]) -> T:
    """Write a result: the first Ctrl-C waits for it, the second does not."""
    return _apart(work, current(), None) if current().apart else work()


def _apart(work: Callable[[], T], end: Deadline, own: Handover | None) -> T:
    """Do work in a thread; at a second Ctrl-C, and some time after the deadline if it has a door, leave it.

    Raises:
        TimeIsUp: it was left.
    """
    made, failed, done = list[T](), list[BaseException](), threading.Event()

    def run() -> None:
        try:
            made.append(work())
        except BaseException as error:
            failed.append(error)
        finally:
            done.set()

    thread = threading.Thread(target=copy_context().run, args=(run,), name="bayescal")
    if threading.current_thread() is threading.main_thread():
        _begun.set()
    thread.start()
    # Counted from when the time was found to be up: Ctrl-C comes at no deadline, and work has as long to end then
    # too.
    since = math.inf  # when the time was found to be up
    while not done.is_set():
        try:
            while not done.wait(TICK_SECONDS):
                since = min(since, time.monotonic()) if end.over else math.inf
                if own is not None and time.monotonic() - since > _patience(end, own):
                    raise TimeIsUp(end.why)
        except KeyboardInterrupt:  # a second one, or a first where another has the signal
            if end.interrupted and (own is None or not own.grace):
                raise
            if own is not None and end.interrupted:
                own.grace = 0.0
            end.ended.set()
    if failed:
        raise failed[0]
    return made[0]
