"""Commands run where storage is full, or killed as they write: a program of its own, which may die.

    python -m tests.support.spoilt_runs full FOLDER 0.1,0.5 COMMAND …   at these parts of the largest file
    python -m tests.support.spoilt_runs killed PLACE 7 COMMAND …        at the 7th thing done to a file in PLACE

`full` prints a JSON line for each size: status, what was said, whether every file is as it was.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
from pathlib import Path
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


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def full(folder: Path, parts: list[float], command: list[str]) -> None:
    from tests.support.command_line import run

    done = run(*command)
    before = files_in(folder)
    print(json.dumps({"status": done.status, "said": done.said, "as_it_was": True}), flush=True)
    largest = max(map(len, before.values()))
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    for part in parts:
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(part * largest), most))
        try:
            done = run(*command)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
        now = files_in(folder)
        told = {"status": done.status, "said": done.said, "as_it_was": now == before}
        print(json.dumps(told), flush=True)


def main() -> None:
    how, place, numbers, *command = sys.argv[1:]
    if how == "full":
        full(Path(place), [float(part) for part in numbers.split(",")], command)
        return
    from bayescal.__main__ import main as bayescal

    sys.argv = ["bayescal", *command]
    killed_at(os.path.abspath(place), int(numbers))
    bayescal()


if __name__ == "__main__":
    main()
