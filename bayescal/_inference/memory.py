"""Memory that is free again, handed back to the system."""

from __future__ import annotations

import ctypes
import sys


def trim() -> None:
    """Have glibc hand freed memory back, of which it keeps hundreds of MB after a search; elsewhere do nothing."""
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)
