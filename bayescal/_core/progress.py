"""Lines on stderr that tell how far it is: one for anything that takes over a second, one for each step of a search."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager


def tell(what: str) -> None:
    """Say on stderr how far it is."""
    print(f"bayescal: {what} …", file=sys.stderr, flush=True)


def note(what: str) -> None:
    """Say on stderr what the user should know of and no reason to stop."""
    print(f"bayescal: note: {what}", file=sys.stderr, flush=True)


@contextmanager
def stage(what: str) -> Iterator[None]:
    """Say on stderr what is going on, once it has taken a second."""
    timer = threading.Timer(1.0, tell, [what])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
