"""Where tasks run: in this process, or on the workers of a Dask cluster. Results are the same bit for bit.

Retries, restarts and the placing of tasks are the scheduler's (`distributed`); here its futures are waited for. A
cluster is processes of this machine, or one that runs elsewhere.

Whoever reaches a scheduler or a worker of Dask can have it run code. That of this machine's processes listens on the
loopback interface alone, takes only those who hold a key that is made for it and never leaves memory (TLS, both sides),
and serves no page.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from bayescal import BayescalError, InputError
from bayescal._core import deadline
from bayescal._core.jax_setup import obey_no_folder
from bayescal.workshop import note

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

INSTALL = "Fleets run on Dask: pip install 'bayescal[fleet]'"
LOOPBACK = "127.0.0.1"
ANSWER_SECONDS = 20.0  # seconds within which a scheduler answers


@contextmanager
def open_cluster(workers: int | None, scheduler: str | None = None) -> Iterator[Client]:
    """A client of so many processes of this machine, or of the cluster at an address; closed at the end.

    Raises:
        InputError: Dask is not installed, or nobody answers at the address.
    """
    if importlib.util.find_spec("distributed") is None:
        raise InputError(INSTALL)
    from distributed import Client

    if scheduler is None:
        with _here(workers) as cluster, Client(cluster) as client:
            yield client
        return
    try:
        client = Client(scheduler, timeout=ANSWER_SECONDS)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"no scheduler answers at {scheduler!r} ({error}): start one with `dask scheduler`, and workers with "
            "`dask worker`"
        ) from None
    with client:
        yield client


@contextmanager
def _here(workers: int | None) -> Iterator[LocalCluster]:
    """Processes of this machine, which nobody else has do anything."""
    import dask.config
    from distributed import LocalCluster
    from distributed.security import Security

    sealed = importlib.util.find_spec("cryptography") is not None
    if not sealed:
        note(
            "any user of this computer can have the workers run code as long as they run, because they have no keys: "
            "pip install cryptography"
        )
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
    """Python processes begun meanwhile look for modules where this one does, and not first in the current folder."""
    before = os.environ.get("PYTHONSAFEPATH", "")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        os.environ["PYTHONSAFEPATH"] = before  # empty is as not set


def dask_setup(_: Any) -> None:
    """What each worker of this machine does before its first task."""
    obey_no_folder()


T = TypeVar("T")
RETRIES = 2  # of a task that failed; a worker that died does not count
LOOK_SECONDS = 2.0  # seconds between looks at the workers
NOT_REACHED = "not reached ({}): the same command goes on from there"
PATIENCE = 200.0  # seconds without a worker, after which a run is given up


class TaskOutcome(NamedTuple):
    """How one of several tasks ended.

    Attributes:
        index: which.
        value: what came of it; None where it failed.
        error: why it failed; empty where it did not.
    """

    index: int
    value: Any
    error: str


class _ClusterGone(InputError):
    """The scheduler cannot be reached."""


class Engine:
    """The workers of a client's cluster; this process without a client."""

    def __init__(self, client: Client | None = None) -> None:
        self.client = client

    def each(self, function: Callable[..., Any], tasks: Sequence[tuple]) -> Iterator[TaskOutcome]:
        """Run a function on each of several arguments; outcomes as they come in. At the deadline the rest have none.

        Raises:
            InputError: the scheduler is gone, or no worker has come for some minutes; what was written stays.
        """
        end = deadline.current()
        if self.client is None:
            for index, task in enumerate(tasks):
                try:
                    if index:
                        end.ask()
                    yield TaskOutcome(index, function(*task), "")
                except deadline.TimeIsUp:
                    yield TaskOutcome(index, None, NOT_REACHED.format(end.why))
                except (BayescalError, OSError) as error:
                    yield TaskOutcome(index, None, str(error))
            return
        from distributed import as_completed

        left = {future: index for index, future in enumerate(self._futures(function, tasks))}
        alone = 0.0
        while left:
            try:
                for future in as_completed(list(left), timeout=LOOK_SECONDS):
                    index, value, why = left.pop(future), None, ""
                    try:
                        value = self._value(future)
                    except _ClusterGone:
                        raise
                    except BayescalError as error:
                        why = str(error)
                    future.release()
                    end.defer_interrupt()
                    yield TaskOutcome(index, value, why)
                    end.ask()
            except TimeoutError:
                alone = 0.0 if self.client.nthreads() else alone + LOOK_SECONDS
            except deadline.TimeIsUp:
                self.client.cancel(list(left))
                for index in left.values():
                    yield TaskOutcome(index, None, NOT_REACHED.format(end.why))
                return
            if alone > PATIENCE:
                raise InputError(
                    "the cluster has no worker left. The partitions that were finished are kept: start workers, and "
                    "the same command goes on from there"
                )

    def every(self, function: Callable[..., T], tasks: Sequence[tuple]) -> list[T]:
        """What a function makes of each of several arguments, in their order.

        Raises:
            InputError: one of them fails.
        """
        values: dict[int, T] = {}
        with deadline.finishing():
            for outcome in self.each(function, tasks):
                if outcome.error:
                    raise InputError(outcome.error)
                values[outcome.index] = outcome.value
        return [values[index] for index in range(len(tasks))]

    def _futures(self, function: Callable[..., Any], tasks: Sequence[tuple]) -> list[Any]:
        assert self.client is not None
        return self.client.map(function, *zip(*tasks, strict=True), pure=False, retries=RETRIES)

    def _value(self, future: Any) -> Any:
        """What came of a task; refused in words if it failed for good, or the scheduler is gone."""
        from distributed.scheduler import KilledWorker

        assert self.client is not None
        try:
            return future.result()
        except BayescalError:
            raise
        except (Exception, CancelledError) as error:  # whatever a cluster says of tasks it gave up
            if self.client.status != "running" or future.status in ("cancelled", "lost"):
                scheduler = self.client.scheduler
                address = "the scheduler" if scheduler is None else scheduler.address
                raise _ClusterGone(
                    f"the scheduler at {address} is gone. The partitions that were finished are kept: start it again, "
                    "and the same command goes on from there"
                ) from None
            why = str(error) or type(error).__name__
            if isinstance(error, KilledWorker):
                why = "the workers that it ran on died one after the other: is there memory enough for a partition?"
            raise InputError(why) from None
