"""The process in which an entry solves one task: `python -m missing_effect.child ENTRY FOLDER ANSWER LIMIT`.

Given an entry alone, the process only loads it, so that the cost of a start can be measured.

An audit hook, set before the entry is loaded, refuses sockets, other processes, files named truth.json (to open, link
or rename) and the package that makes tasks. Python code cannot remove the hook; machine code supplied with an entry
could bypass it.
"""

from __future__ import annotations

import json
import os
import resource
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np

from missing_effect.task import Task

PROGRAMS = (
    "subprocess.Popen",
    "os.system",
    "os.exec",
    "os.fork",
    "os.forkpty",
    "os.posix_spawn",
    "os.spawn",
    "os.startfile",
)
MAKER = "missing_effect_maker"


def watch(event: str, arguments: tuple[Any, ...]) -> None:
    """End the process at an audit event that an entry does not need."""
    if event.startswith("socket.") and event not in ("socket.__new__", "socket.gethostname"):
        refuse(f"the network ({event})")
    if event in PROGRAMS:
        refuse(f"another process ({event})")
    if any(map(_sealed, arguments)):
        refuse(f"a sealed truth.json ({event})")
    if event == "import" and arguments[0].split(".")[0] == MAKER:
        refuse(f"the package that makes tasks ({arguments[0]})")


def _sealed(argument: Any) -> bool:
    """Return whether a path is that of a truth file, which must be neither linked nor renamed."""
    path = isinstance(argument, str | bytes | os.PathLike)
    return path and os.path.basename(os.fsdecode(argument)).lower() == "truth.json"


def refuse(what: str) -> None:
    """Print the reason to standard error and end the process at once, since an exception could be caught."""
    sys.stderr.write(f"refused: the entry reached for {what}\n")
    sys.stderr.flush()
    os._exit(3)


def main(entry: str, folder: str = "", answer: str = "", limit: str = "") -> int:
    """Solve a task within `limit` s of processor time and write the answer as JSON; without a folder load the entry."""
    if not folder:
        runpy.run_path(entry)
        return 0
    resource.setrlimit(resource.RLIMIT_CPU, (int(limit), int(limit) + 1))
    task = Task.read(Path(folder))
    os.chdir(folder)
    sys.addaudithook(watch)
    solve = runpy.run_path(entry)["solve"]
    Path(answer).write_text(json.dumps(as_json(solve(task))), "utf-8")
    return 0


def as_json(answer: dict[str, Any]) -> dict[str, Any]:
    """Convert the answer of `solve` to JSON data, with sets as pairs of names and probability."""
    sets = answer.get("sets")
    return {
        "sets": None if sets is None else [[list(s), float(p)] for s, p in sets.items()],
        "mean": np.asarray(answer["mean"], float).tolist(),
        "sd": np.asarray(answer["sd"], float).tolist(),
    }


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
