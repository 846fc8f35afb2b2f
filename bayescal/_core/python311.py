"""Workarounds for Python 3.11; remove them, and its lines in `pyproject.toml`, at its end of life, October 2027."""

import os
import sys

MIN_WORKERS = 16  # with 8 JAX sometimes hung, with 16 never


def set_worker_count() -> None:
    """Give JAX at least `MIN_WORKERS` worker threads, unless the user has set `NPROC`.

    JAX before 0.12, the last for Python 3.11, runs independent operations concurrently, each on a worker; a batched
    Cholesky or triangular solve then distributes its batch to the same workers and waits for them. If all workers wait,
    the program deadlocks: nearly always with 2 or 4, sometimes with 8, never with 16. More than cores cost little.
    """
    affinity = getattr(os, "sched_getaffinity", None)  # not on macOS and Windows
    if (len(affinity(0)) if affinity else os.cpu_count() or 1) < MIN_WORKERS:
        os.environ.setdefault("NPROC", str(MIN_WORKERS))


if sys.version_info < (3, 12):
    set_worker_count()
