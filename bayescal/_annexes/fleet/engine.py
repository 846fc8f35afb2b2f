"""Execution of tasks in this process or on the workers of a Dask cluster, with bit-identical results.

Any client of a Dask scheduler or worker can execute code on it. A local cluster therefore listens on the loopback
interface only, requires mutual TLS with a key that is kept in memory, and serves no dashboard.
"""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bayescal as bc
from bayescal import workshop as ws

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

INSTALL_ADVICE = "Fleets run on Dask: pip install 'bayescal[fleet]'"
LOOPBACK_ADDRESS = "127.0.0.1"
CONNECTION_TIMEOUT_S = 20.0  # within which a scheduler must answer
MAX_TASK_RETRIES = 2  # of a failed task; tasks of a worker that died do not count
POLL_INTERVAL_S = 2.0  # between checks of the deadline and of the workers
REPORT_INTERVAL_S = 9.0  # between progress messages
WORKER_TIMEOUT_S = 200.0  # without a worker, after which a run is abandoned
MAX_TASK_SIZE = "4GB"  # with its readings, twice the maximum of a file; Dask warns of larger tasks
NOT_PROCESSED = "not processed ({}): give more time"


@contextmanager
def open_cluster(
    workers: int | None, scheduler: str | None = None, files: Sequence[Path] = ()
) -> Iterator[Client]:
    """Open a client of a local Dask cluster, or of the cluster with the address `scheduler`; close it on exit.

    `workers`: number of local processes, by default one per core; `files`: the user's code, copied to the workers.

    Raises:
        InputError: Dask is not installed, or no scheduler answers at the address.
    """
    if not all(map(importlib.util.find_spec, ("distributed", "cryptography"))):
        raise bc.InputError(INSTALL_ADVICE)
    from distributed import Client

    with nullcontext(scheduler) if scheduler else _open_local_cluster(workers) as cluster:
        try:
            client = Client(cluster, timeout=CONNECTION_TIMEOUT_S)
        except (OSError, ValueError, TimeoutError) as error:
            raise bc.InputError(
                f"no scheduler answers at {scheduler!r} ({error}): start one with `dask scheduler`, and workers with "
                "`dask worker`"
            ) from None
        with client:
            for file in files:
                client.upload_file(str(file))
            yield client


def _open_local_cluster(worker_count: int | None) -> LocalCluster:
    """Open a local worker pool that accepts tasks from this process only; None: a worker per core."""
    import dask.config
    from distributed import LocalCluster
    from distributed.security import Security

    # Its processes start without the current folder first in their module path.
    os.environ["PYTHONSAFEPATH"] = "1"
    settings = {f"distributed.{part}.http.routes": [] for part in ("scheduler", "worker")}
    settings["distributed.worker.preload"] = [__name__]  # has each worker call `dask_setup`
    options = {"n_workers": worker_count, "threads_per_worker": 1, "processes": True}
    options |= {"host": LOOPBACK_ADDRESS, "dashboard_address": f"{LOOPBACK_ADDRESS}:0"}
    options |= {"security": Security.temporary(), "scheduler_kwargs": {"dashboard": False}}
    with dask.config.set(settings):
        return LocalCluster(**options)


def dask_setup(_: Any) -> None:
    """Make a local worker ignore configuration files in its current folder; Dask calls this first."""
    ws.ignore_local_configuration()


Outcome = tuple[Any, str]  # a task's value, and its error message (empty on success)


def run_tasks(
    client: Client | None, function: Callable[..., Any], tasks: Sequence[tuple], plural_noun: str
) -> list[Outcome]:
    """Run a function with each task's arguments under this process's settings; return the outcomes in order.

    Progress lines count the completed tasks, called `plural_noun`. The outcome of a task that is not completed before
    the deadline is an error message.
    """
    outcomes = dict[int, Outcome]()
    start = last_report = time.monotonic()
    for index, outcome in _iterate_outcomes(client, function, tasks):
        outcomes[index] = outcome
        now, fraction = time.monotonic(), len(outcomes) / len(tasks)
        if now > last_report + REPORT_INTERVAL_S and fraction < 1:
            last_report, seconds = now, (now - start) * (1 / fraction - 1)
            progress = f"{len(outcomes):,} of {len(tasks):,} {plural_noun}"
            ws.notify(f"{progress}, about {seconds:,.0f} s left", fraction)
    return [outcomes[index] for index in range(len(tasks))]


def _iterate_outcomes(
    client: Client | None, function: Callable[..., Any], tasks: Sequence[tuple]
) -> Iterator[tuple[int, Outcome]]:
    """Yield the index and the outcome of each task when it completes."""
    deadline, settings = ws.deadline.current(), ws.settings()
    if client is None:
        for index, task in enumerate(tasks):
            if index and deadline.is_over:
                yield index, (None, NOT_PROCESSED.format(deadline.reason))
            else:
                yield index, run_guarded(function, task, settings)
        return
    import dask.config

    submit = client.get_executor(pure=False, retries=MAX_TASK_RETRIES).submit
    with dask.config.set({"distributed.admin.large-graph-warning-threshold": MAX_TASK_SIZE}):
        futures = {submit(run_guarded, function, t, settings): i for i, t in enumerate(tasks)}
    last_active = now = time.monotonic()  # last time with a worker, s
    while futures and not deadline.is_over and now <= last_active + WORKER_TIMEOUT_S:
        completed_futures, _ = wait(futures, POLL_INTERVAL_S, FIRST_COMPLETED)
        now = time.monotonic()
        last_active = now if completed_futures or client.nthreads() else last_active
        for future in completed_futures:
            index = futures.pop(future)
            try:
                yield index, future.result()
            except Exception as error:  # any error of a cluster that abandons a task
                reason = f"the task was abandoned: {str(error) or type(error).__name__}"
                yield index, (None, reason)
            deadline.defer_interrupt()
    no_worker = "the cluster has no worker left: start workers"
    reason = NOT_PROCESSED.format(deadline.reason) if deadline.is_over else no_worker
    for future, index in futures.items():
        future.cancel()
        yield index, (None, reason)


def run_guarded(function: Callable[..., Any], task: tuple, settings: bc.Settings) -> Outcome:
    """Run a function for a task under settings; return its value, or the message of an error in readings or files."""
    try:
        with bc.use_settings(settings):
            return function(*task), ""
    except (bc.BayescalError, OSError) as error:
        return None, str(error)
