"""A process that is killed as it writes."""

from __future__ import annotations

import os
import signal
import sys
from typing import Any

TOUCHING = {
    *("open", "os.rename", "os.link", "os.mkdir", "os.rmdir", "os.remove", "os.symlink"),
    *("os.truncate", "shutil.rmtree"),
}


def killed_at(place: str, count: int) -> None:
    """Have this process killed just before the `count`-th thing that it does to a file under `place`, to write."""
    seen = 0

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        if event not in TOUCHING or not isinstance(arguments[0], str | bytes | os.PathLike):
            return
        if place not in os.path.abspath(os.fsdecode(arguments[0])):
            return
        if event == "open" and not arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            return
        seen += 1
        if seen == count:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)
