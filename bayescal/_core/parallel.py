"""Threads and memory: BLAS on a single thread, faster for matrices of ten to a hundred rows; release of memory."""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

import numpy as np
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")

_get_thread_pools = cache(ThreadpoolController)


def run_on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function to run with BLAS on one thread and floating-point warnings ignored."""

    @wraps(function)
    def run_limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _get_thread_pools().limit(limits=1, user_api="blas"), np.errstate(all="ignore"):
            return function(*args, **kwargs)

    return run_limited


def release_memory() -> None:
    """Collect reference cycles and return freed memory to the system (glibc): up to a GB after a channel's search."""
    gc.collect()
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)
