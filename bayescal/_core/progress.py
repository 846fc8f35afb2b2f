"""One line on stderr for anything that takes over a second."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def stage(what: str, after: float = 1.0) -> Iterator[None]:
    """Say on stderr what is going on, once it has taken `after` seconds."""
    timer = threading.Timer(
        after, lambda: print(f"bayescal: {what} …", file=sys.stderr, flush=True)
    )
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
