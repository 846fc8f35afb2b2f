"""Where tasks run: in this process, or on the workers of a Dask cluster. Results are the same bit for bit.

Whoever reaches a scheduler or a worker of Dask can have it run code. A local one listens on the loopback interface
alone, takes only those who hold a key that never leaves memory (TLS, both sides), and serves no page.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bayescal as bc
from bayescal import workshop as ws

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

INSTALL = "Fleets run on Dask: pip install 'bayescal[fleet]'"
LOOPBACK = "127.0.0.1"
ANSWER_SECONDS = 20.0  # seconds within which a scheduler answers
RETRIES = 2  # of a task that failed; a worker that died does not count
POLL_SECONDS = 2.0  # between looks at the deadline and the workers
WORKER_TIMEOUT = 200.0  # seconds without a worker, after which a run is given up
LARGEST_TASKS = "4GB"  # which a scheduler takes without a warning: twice what a file may hold
NOT_REACHED = "not reached ({}): give more time"


@contextmanager
def open_cluster(
    workers: int | None, scheduler: str | None = None, files: Sequence[Path] = ()
) -> Iterator[Client]:
    """Open a client of so many local processes, or of the cluster at an address; close it at the end.

    Its workers get Python files of the user's own.

    Raises:
        InputError: Dask is not installed, or nobody answers at the address.
    """
    if not all(map(importlib.util.find_spec, ("distributed", "cryptography"))):
        raise bc.InputError(INSTALL)
    from distributed import Client

    with nullcontext(scheduler) if scheduler else _local_cluster(workers) as place:
        try:
            client = Client(place, timeout=ANSWER_SECONDS)
        except (OSError, ValueError, TimeoutError) as error:
            raise bc.InputError(
                f"no scheduler answers at {scheduler!r} ({error}): start one with `dask scheduler`, and workers with "
                "`dask worker`"
            ) from None
        with client:
            for file in files:
                client.upload_file(str(file))
            yield client


def _local_cluster(workers: int | None) -> LocalCluster:
    """Open a local worker pool that accepts tasks from this process only."""
    import dask.config
    from distributed import LocalCluster
    from distributed.security import Security

    # Its processes start without the current folder first in their module path.
    os.environ["PYTHONSAFEPATH"] = "1"
    settings = {f"distributed.{part}.http.routes": [] for part in ("scheduler", "worker")}
    settings["distributed.worker.preload"] = [__name__]  # has each worker call `dask_setup`
    with dask.config.set(settings):
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host=LOOPBACK,
            security=Security.temporary(),
            dashboard_address=f"{LOOPBACK}:0",
            scheduler_kwargs={"dashboard": False},
        )


def dask_setup(_: Any) -> None:
    """Prepare a local worker before its first task."""
    ws.obey_no_folder()


# Place of a task, what it returned, why it failed: empty where it did not.
Outcome = tuple[int, Any, str]


def run_tasks(
    client: Client | None, function: Callable[..., Any], tasks: Sequence[tuple]
) -> Iterator[Outcome]:
    """Run a function on each of several arguments, and yield outcomes as they come in.

    Tasks that the deadline leaves out fail with that reason.
    """
    end = ws.deadline.current()
    if client is None:
        for index, task in enumerate(tasks):
            missed = index and end.over
            value, why = (
                (None, NOT_REACHED.format(end.why)) if missed else run_guarded(function, task)
            )
            yield index, value, why
        return
    import dask.config

    executor = client.get_executor(pure=False, retries=RETRIES)
    # Devices that were read are part of a task.
    with dask.config.set({"distributed.admin.large-graph-warning-threshold": LARGEST_TASKS}):
        futures = {executor.submit(run_guarded, function, t): i for i, t in enumerate(tasks)}
    idle = 0.0  # s without a worker
    while futures and not end.over and idle <= WORKER_TIMEOUT:
        done, _ = wait(futures, POLL_SECONDS, FIRST_COMPLETED)
        idle = 0.0 if done or client.nthreads() else idle + POLL_SECONDS
        for future in done:
            index = futures.pop(future)
            try:
                yield index, *future.result()
            except Exception as error:  # whatever a cluster says of tasks it gave up
                yield index, None, f"the cluster gave it up: {str(error) or type(error).__name__}"
            end.defer_interrupt()
    lost = "the cluster has no worker left: start workers"
    why = NOT_REACHED.format(end.why) if end.over else lost
    for future, index in futures.items():
        future.cancel()
        yield index, None, why


def run_guarded(function: Callable[..., Any], task: tuple) -> tuple[Any, str]:
    """Return a task's value; or why it failed, if the readings or a file are the cause."""
    try:
        return function(*task), ""
    except (bc.BayescalError, OSError) as error:
        return None, str(error)
