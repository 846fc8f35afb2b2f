"""Lines on stderr that tell how far it is: for anything that takes over a second, and then at least every ten seconds.

A line says what is being done, and for how long by now.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from bayescal._core.quoting import one_line

SOON, EVERY = 1.0, 9.0  # s, until a stage is first told of, and from a line to the next

_open: list[threading.Event] = []  # stages, by what ends them, the innermost last
_told = 0.0  # when the last line was


def tell(what: str) -> None:
    """Say on stderr how far it is."""
    global _told
    _told = time.monotonic()
    print(f"bayescal: {what} …", file=sys.stderr, flush=True)


def quiet() -> float:
    """Time since the last such line, s."""
    return time.monotonic() - _told


def print_notes(notes: Iterable[str]) -> None:
    """Say on stderr what the user should know of and no reason to stop."""
    for note in notes:
        print(f"bayescal: note: {one_line(note)}", file=sys.stderr, flush=True)


@contextmanager
def stage(what: str, first: float = SOON) -> Iterator[None]:
    """Say on stderr what is going on, once it has taken `first` seconds, and again where nothing else is told."""
    begun, done = time.monotonic(), threading.Event()

    def watch() -> None:
        pause, told = first, first >= EVERY
        while not done.wait(pause):
            now = time.monotonic()
            quiet = now - max(_told, begun)
            if _open[-1:] == [done] and (quiet >= EVERY or not told):
                so_far = f", {now - begun:.0f} s so far" if told else ""
                tell(f"{what}{so_far}")
                quiet, told = 0.0, True
            pause = max(EVERY - quiet, 0.5)

    _open.append(done)
    threading.Thread(target=watch, daemon=True, name="bayescal progress").start()
    try:
        yield
    finally:
        done.set()
        _open.remove(done)
