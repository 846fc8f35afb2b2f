"""Where tasks run: in this process, or on the workers of a Dask cluster. Results are the same bit for bit.

Retries, restarts and the placing of tasks are the scheduler's (`distributed`); here its futures are waited for. A
cluster is processes of this machine, or one that runs elsewhere.

Whoever reaches a scheduler or a worker of Dask can have it run code. A local one listens on the loopback interface
alone, takes only those who hold a key that never leaves memory (TLS, both sides), and serves no page.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import bayescal as bc
from bayescal import workshop as ws

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

INSTALL = "Fleets run on Dask: pip install 'bayescal[fleet]'"
LOOPBACK = "127.0.0.1"
ANSWER_SECONDS = 20.0  # seconds within which a scheduler answers
RETRIES = 2  # of a task that failed; a worker that died does not count
POLL_SECONDS = 2.0  # between looks at the workers
WORKER_TIMEOUT = 200.0  # seconds without a worker, after which a run is given up
LARGEST_TASKS = "4GB"  # which a scheduler takes without a warning: twice what a file may hold
NOT_REACHED = "not reached ({}): give more time"


@contextmanager
def open_cluster(workers: int | None, scheduler: str | None = None) -> Iterator[Client]:
    """Open a client of so many local processes, or of the cluster at an address; close it at the end.

    Raises:
        InputError: Dask is not installed, or nobody answers at the address.
    """
    if importlib.util.find_spec("distributed") is None:
        raise bc.InputError(INSTALL)
    from distributed import Client

    if scheduler is None:
        with _local_cluster(workers) as cluster, Client(cluster) as client:
            yield client
        return
    try:
        client = Client(scheduler, timeout=ANSWER_SECONDS)
    except (OSError, ValueError, TimeoutError) as error:
        raise bc.InputError(
            f"no scheduler answers at {scheduler!r} ({error}): start one with `dask scheduler`, and workers with "
            "`dask worker`"
        ) from None
    with client:
        yield client


@contextmanager
def _local_cluster(workers: int | None) -> Iterator[LocalCluster]:
    """Open a local worker pool that accepts tasks from this process only."""
    import dask.config
    from distributed import LocalCluster
    from distributed.security import Security

    sealed = importlib.util.find_spec("cryptography") is not None
    if not sealed:
        note = (
            "any user of this computer can have the workers run code as long as they run, because they have no keys: "
            "pip install cryptography"
        )
        ws.print_notes([note])
    settings = {f"distributed.{part}.http.routes": [] for part in ("scheduler", "worker")}
    settings["distributed.worker.preload"] = [__name__]  # has each worker call `dask_setup`
    with (
        _modules_of_no_folder(),
        dask.config.set(settings),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host=LOOPBACK,
            security=Security.temporary() if sealed else None,
            dashboard_address=f"{LOOPBACK}:0",
            scheduler_kwargs={"dashboard": False},
        ) as cluster,
    ):
        yield cluster  # pyright: ignore[reportReturnType]


@contextmanager
def _modules_of_no_folder() -> Iterator[None]:
    """Start Python processes without the current folder first in their module path."""
    before = os.environ.get("PYTHONSAFEPATH", "")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        os.environ["PYTHONSAFEPATH"] = before  # empty is as not set


def dask_setup(_: Any) -> None:
    """Prepare a local worker before its first task."""
    ws.obey_no_folder()


# Which task, what it returned, why it failed: empty where it did not.
Outcome = tuple[int, Any, str]


def run_tasks(
    client: Client | None, function: Callable[..., Any], tasks: Sequence[tuple]
) -> Iterator[Outcome]:
    """Run a function on each of several arguments, and yield outcomes as they come in.

    Tasks that the deadline leaves out, and those of a cluster that is gone, fail with that reason.
    """
    end = ws.deadline.current()
    if client is None:
        for index, task in enumerate(tasks):
            if index and end.over:
                yield index, None, NOT_REACHED.format(end.why)
                continue
            try:
                yield index, function(*task), ""
            except (bc.BayescalError, OSError) as error:
                yield index, None, str(error)
        return
    import dask.config
    from distributed import as_completed

    # Devices that were read are part of a task.
    with dask.config.set({"distributed.admin.large-graph-warning-threshold": LARGEST_TASKS}):
        futures = client.map(function, *zip(*tasks, strict=True), pure=False, retries=RETRIES)
    pending, idle, why = {future: i for i, future in enumerate(futures)}, 0.0, ""
    while pending and not why:
        try:
            for future in as_completed(list(pending), timeout=POLL_SECONDS):
                yield pending.pop(future), *_outcome(client, future)
                future.release()
                end.defer_interrupt()
                if end.over:
                    break
        except TimeoutError:
            idle = 0.0 if client.nthreads() else idle + POLL_SECONDS
        if end.over:
            why = NOT_REACHED.format(end.why)
        elif idle > WORKER_TIMEOUT:
            why = "the cluster has no worker left: start workers"
    client.cancel(list(pending))
    yield from ((index, None, why) for index in pending.values())


def _outcome(client: Client, future: Any) -> tuple[Any, str]:
    """Return a task's result; why, if it failed for good, or the scheduler is gone."""
    from distributed.scheduler import KilledWorker

    try:
        return future.result(), ""
    except (Exception, CancelledError) as error:  # whatever a cluster says of tasks it gave up
        why = str(error) or type(error).__name__
        gone = client.status != "running" or future.status in ("cancelled", "lost")
        if isinstance(error, KilledWorker):
            why = "the workers that it ran on died one after the other: is there memory enough?"
        elif gone and not isinstance(error, bc.BayescalError):
            address = "" if client.scheduler is None else f" at {client.scheduler.address}"
            why = f"the scheduler{address} is gone: start it again"
        return None, why
