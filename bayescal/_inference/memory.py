"""Return freed memory to the operating system."""

from __future__ import annotations

import ctypes
import sys


def trim() -> None:
    """Return freed memory to the system by glibc's malloc_trim: hundreds of MB after a search; no-op elsewhere."""
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)
