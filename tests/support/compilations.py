"""What JAX compiles while something runs: what the tests of trace counts share."""

from __future__ import annotations

import logging
from collections.abc import Callable

import jax


def compiled(work: Callable[[], object]) -> list[str]:
    """What JAX compiles, or takes from its cache on disk, while `work` runs."""
    found: list[str] = []

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            text = record.getMessage()
            if text.startswith("Compiling "):
                found.append(text[:80])

    log, listener = logging.getLogger("jax"), Listener()
    log.addHandler(listener)
    before = log.propagate
    log.propagate = False
    try:
        with jax.log_compiles():
            work()
    finally:
        log.removeHandler(listener)
        log.propagate = before
    return found
