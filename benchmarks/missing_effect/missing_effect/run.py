"""Run an entry: each task in its own process, in a copied folder without the truth, with a limit of processor time.

Where the user may create namespaces (Linux, `unshare`), the process has no network and sees an empty folder in place
of the tasks, and its child processes end with it. On all systems it has the audit hook of `child.py`. Each answer
records which isolation was used.
"""

from __future__ import annotations

import json
import os
import resource
import runpy
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from missing_effect.child import as_json
from missing_effect.edition import FILES
from missing_effect.task import OUTSIDE, Task

LIMIT = 60.0  # s of processor a task
PATIENCE = 5.0  # times that on the clock: for what only waits
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
SHIPPED = Path(__file__).parent / "entries"
UNSHARE = (
    *("unshare", "--user", "--map-root-user", "--net", "--mount"),
    *("--pid", "--fork", "--kill-child", "--mount-proc"),
)
# The shell stays: as the first process of a namespace, the entry's would be deaf to the limit's signal.
HIDE = 'mount -t tmpfs none "$1" && shift && { "$@"; exit $?; }'


class InputError(Exception):
    """An error in a command's arguments or input files, reported to the user."""


def entry_file(name: str) -> Path:
    """Return the file of an entry, given its path or the name of a shipped one.

    Raises:
        InputError: there is no such entry.
    """
    for file in (Path(name), SHIPPED / f"{name}.py"):
        if file.suffix == ".py" and file.is_file():
            return file.resolve()
    shipped = ", ".join(sorted(p.stem for p in SHIPPED.glob("[!_]*.py")))
    raise InputError(f"no entry {name!r}: give a Python file with solve(task), or one of {shipped}")


def task_folders(tasks: Path, size: int | None = None) -> list[Path]:
    """Return the first `size` task folders in a folder; all if None.

    Raises:
        InputError: there is none, or fewer than `size`.
    """
    folders = sorted(p.parent for p in tasks.glob("*/task.json"))
    if len(folders) < (size or 1):
        raise InputError(
            f"{tasks} has {len(folders)} tasks, not {size or 'one'}: make them with "
            f"`python -m missing_effect generate {tasks} --size {size or 10}`"
        )
    return folders[:size]


def run(
    entry: Path,
    tasks: Path,
    results: Path,
    size: int | None,
    limit: float = LIMIT,
    trusted: bool = False,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Solve the tasks that have no answer yet; yield the name and the answer of each.

    Args:
        entry: a Python file with the function `solve`.
        tasks: folder of the tasks.
        results: folder of the answers: results/ENTRY/TASK.json.
        size: number of tasks, from the first; None: all.
        limit: processor time per task, s.
        trusted: run in this process without isolation: faster, for your own entries. A task beyond the limit is not
            interrupted but counts as failed. The processor time of starting a process is measured once and added to
            that of each task.

    Raises:
        InputError: there are no such tasks; or a trusted entry lacks `solve` or a package.
    """
    solves = _loaded(entry) if trusted else None
    begin = started(entry) if trusted else 0.0
    for folder in task_folders(tasks, size):
        place = results / entry.stem / f"{folder.name}.json"
        if place.is_file():
            continue
        answer = (
            solve(entry, folder, tasks, limit)
            if solves is None
            else solve_in_process(solves, folder, limit, begin)
        )
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(json.dumps(answer), "utf-8")
        yield folder.name, answer


def solve(entry: Path, folder: Path, tasks: Path, limit: float = LIMIT) -> dict[str, Any]:
    """Solve a task; return its answer (sets, mean, sd, or the reason `failed`) with `seconds` and `isolation`."""
    with tempfile.TemporaryDirectory() as folder_name:
        copy, answer = Path(folder_name) / folder.name, Path(folder_name) / "answer.json"
        copy.mkdir()
        for name in FILES:
            shutil.copy(folder / name, copy)
        hidden = can_hide()
        argv = [
            sys.executable,
            "-m",
            "missing_effect.child",
            str(entry),
            str(copy),
            str(answer),
            str(round(limit)),
        ]
        command = (
            [*UNSHARE, "sh", "-c", HIDE, "sh", str(tasks.resolve()), *argv] if hidden else argv
        )
        seconds, status, stderr = _ended(command, limit)
        failed = _why(status, stderr, limit) if status else ""
        answer_data: dict[str, Any] = {}
        if not failed:
            answer_data = json.loads(answer.read_text("utf-8"))
            failed = wrong(answer_data, copy)
    isolation = "namespaces and audit hook" if hidden else "audit hook alone"
    record = {"failed": failed} if failed else answer_data
    return {**record, "seconds": round(seconds, 2), "isolation": isolation}


def _loaded(entry: Path) -> Callable[[Task], dict[str, Any]]:
    try:
        return runpy.run_path(str(entry))["solve"]
    except ImportError as error:
        raise InputError(
            f"{entry.stem} needs a package that is not installed: {error} (README.md lists those of shipped entries)"
        ) from None
    except KeyError:
        raise InputError(f"{entry} has no function solve(task)") from None


def started(entry: Path) -> float:
    """Return the processor time, s, of starting a process and loading an entry."""
    command = [sys.executable, "-m", "missing_effect.child", str(entry)]
    return _ended(command, LIMIT)[0]


def solve_in_process(
    solves: Callable[[Task], dict[str, Any]], folder: Path, limit: float, begin: float = 0.0
) -> dict[str, Any]:
    """Solve a task in this process, without isolation; `begin`, s, is added to its processor time."""
    start = time.process_time()
    try:
        answer = as_json(solves(Task.read(folder)))
        failed = wrong(answer, folder)
    except Exception as error:  # whatever an entry raises is its answer
        answer, failed = {}, f"{type(error).__name__}: {error}"
    seconds = begin + time.process_time() - start
    if seconds > limit:
        failed = f"took {seconds:.0f} s of processor time, more than {limit:g} s"
    record = {"failed": failed} if failed else answer
    return {**record, "seconds": round(seconds, 2), "isolation": "none"}


@cache
def can_hide() -> bool:
    """Return whether this user may create network and mount namespaces."""
    if shutil.which("unshare") is None:
        return False
    with tempfile.TemporaryDirectory() as folder:
        tried = [*UNSHARE, "sh", "-c", HIDE, "sh", folder, "true"]
        return subprocess.run(tried, capture_output=True, check=False).returncode == 0


def wrong(answer: dict[str, Any], folder: Path) -> str:
    """Return why an answer is invalid; empty if it is valid."""
    task = json.loads((folder / "task.json").read_text("utf-8"))
    names = {c["name"] for c in task["candidates"]} | {OUTSIDE}
    rows = len((folder / "holdout.csv").read_text("utf-8").splitlines()) - 1
    for sets, probability in answer["sets"] or []:
        if strange := sorted(set(sets) - names):
            return f"a set contains {', '.join(strange)}, which is not a candidate"
        if not 0 <= probability <= 1:
            return f"a set has the probability {probability:g}"
    total = sum(p for _, p in answer["sets"] or [])
    if total > 1 + 1e-6:
        return f"the probabilities of the sets sum to {total:g}"
    for name in ("mean", "sd"):
        values = np.asarray(answer[name], float)
        if values.shape != (rows,) or not np.isfinite(values).all():
            return f"{name} must be {rows} finite numbers; it has the shape {values.shape}"
    return "" if min(answer["sd"]) > 0 else "sd must be positive"


def _ended(command: list[str], limit: float) -> tuple[float, int, str]:
    """Run a command; return its processor time, s, exit status (negative: signal) and standard error."""
    path = os.pathsep.join([str(SHIPPED.parents[1]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": path.rstrip(os.pathsep)}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with subprocess.Popen(
        command,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    ) as process:
        try:
            _, stderr = process.communicate(timeout=PATIENCE * limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            _, stderr = process.communicate()
    with suppress(ProcessLookupError):  # what it left running where there are no namespaces
        os.killpg(process.pid, signal.SIGKILL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return seconds, process.returncode, stderr


def _why(status: int, stderr: str, limit: float) -> str:
    last = next((line for line in reversed(stderr.splitlines()) if line.strip()), "")
    number = -status if status < 0 else status - 128  # a shell adds 128 to its child's
    if number > 0:
        times = f"{limit:g} s of processor time, or {PATIENCE:g} times that of elapsed time"
        return f"ended by signal {number}: exceeded {times}"
    return last.strip() or f"ended with status {status}"
