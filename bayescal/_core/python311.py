"""Backports for Python 3.11. They go in October 2027, when 3.11 ends, and `pyproject.toml`'s lines for it too."""

import os
import sys

MIN_WORKERS = 16  # with 8 JAX sometimes hung, with 16 never


def set_workers() -> None:
    """Give JAX at least `MIN_WORKERS` worker threads, unless the user has set `NPROC`.

    JAX before 0.12, which Python 3.11 gets, runs independent operations of a program side by side, each on a worker; a
    batched Cholesky or triangular solve then shares its batch out to the same workers and waits for them. When every
    worker waits, in a loop over independent factorisations, the program hangs for ever, at random: with 2 or 4 workers
    nearly always, with 8 sometimes, with 16 never. More of them than cores cost a little.
    """
    affinity = getattr(os, "sched_getaffinity", None)  # not on macOS and Windows
    if (len(affinity(0)) if affinity else os.cpu_count() or 1) < MIN_WORKERS:
        os.environ.setdefault("NPROC", str(MIN_WORKERS))


if sys.version_info < (3, 12):
    set_workers()
