"""Where tasks run: in this process, or on the workers of a Dask cluster. Results are the same bit for bit.

Retries, restarts and the placing of tasks are the scheduler's (`distributed`); here tasks are only handed to it, a few
for each worker at a time, so that neither it nor this process holds more than what is under way.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

from bayescal._core.errors import BayescalError, InputError

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")
AHEAD = 4  # tasks for each thread of the cluster that the scheduler holds
RETRIES = 2  # of a task that failed; a worker that died does not count
LOOK, PATIENCE = (
    20.0,
    200.0,
)  # seconds between looks at the workers; without one, until it is given up
ARITY = 16  # sums that are added up at once


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


class Engine(Protocol):
    """Where tasks run."""

    def each(self, function: Callable[..., Any], tasks: Sequence[tuple]) -> Iterator[TaskOutcome]:
        """Run a function on each of several arguments; outcomes as they come in."""
        ...

    def tree(self, function: Callable[..., T], tasks: Sequence[tuple]) -> T:
        """The sum of a function over several arguments, added up as a tree in their order."""
        ...


class LocalEngine:
    """This process."""

    def each(self, function: Callable[..., Any], tasks: Sequence[tuple]) -> Iterator[TaskOutcome]:
        for index, task in enumerate(tasks):
            try:
                yield TaskOutcome(index, function(*task), "")
            except (BayescalError, OSError) as error:
                yield TaskOutcome(index, None, str(error))

    def tree(self, function: Callable[..., T], tasks: Sequence[tuple]) -> T:
        level = [function(*task) for task in tasks]
        while len(level) > 1:
            level = [added(*level[i : i + ARITY]) for i in range(0, len(level), ARITY)]
        return level[0]


class OnDask:
    """The workers of a cluster."""

    def __init__(self, client: Client) -> None:
        self.client = client

    def each(self, function: Callable[..., Any], tasks: Sequence[tuple]) -> Iterator[TaskOutcome]:
        """Run a function on each of several arguments.

        Raises:
            InputError: the scheduler is gone; what was written stays.
        """
        waiting = iter(enumerate(tasks))
        running: dict[Any, int] = {}

        def submit(count: int) -> None:
            for _, (index, task) in zip(range(count), waiting, strict=False):
                future = self.client.submit(function, *task, pure=False, retries=RETRIES)
                running[future] = index

        threads: Any = self.client.nthreads()
        submit(AHEAD * max(sum(threads.values()), 1))
        while running:
            for future in self._ended(list(running)):
                yield self._outcome(running.pop(future), future)
                submit(1)

    def _ended(self, running: list[Any]) -> list[Any]:
        """Those of the tasks that have ended, as soon as one has.

        Raises:
            InputError: there is no worker, and none has come for some minutes.
        """
        from distributed import wait

        alone = 0.0
        while True:
            try:
                found: Any = wait(running, timeout=LOOK, return_when="FIRST_COMPLETED")
                return list(found.done)
            except TimeoutError:
                alone = 0.0 if self.client.nthreads() else alone + LOOK
            except CancelledError:
                raise InputError(_gone(self.client)) from None
            if alone > PATIENCE:
                raise InputError(
                    "the cluster has no worker left. The partitions that were finished are kept: start workers, and "
                    "the same command goes on from there"
                )

    def _outcome(self, index: int, future: Any) -> TaskOutcome:
        error = future.exception()
        if future.status == "finished":
            try:
                return TaskOutcome(index, future.result(), "")
            except (OSError, CancelledError):  # the scheduler died between the word and the result
                raise InputError(_gone(self.client)) from None
        if self.client.status != "running" or future.status in ("cancelled", "lost"):
            raise InputError(_gone(self.client))
        return TaskOutcome(index, None, _in_words(error))

    def tree(self, function: Callable[..., T], tasks: Sequence[tuple]) -> T:
        """The sum of a function over several arguments.

        Raises:
            InputError: a part of it failed for good, or the scheduler is gone.
        """
        submit = functools.partial(self.client.submit, pure=False, retries=RETRIES)
        level = [submit(function, *task) for task in tasks]
        while len(level) > 1:
            level = [submit(added, *level[i : i + ARITY]) for i in range(0, len(level), ARITY)]
        try:
            return level[0].result()
        except BayescalError:
            raise
        except Exception as error:  # whatever a cluster says of tasks that it gave up
            if self.client.status != "running" or level[0].status in ("cancelled", "lost"):
                raise InputError(_gone(self.client)) from None
            raise InputError(
                f"a part of the sum over partitions failed: {_in_words(error)}"
            ) from None


def added(*parts: Any) -> Any:
    """The sum of parts, from the first to the last."""
    return functools.reduce(lambda a, b: a + b, parts)


def _gone(client: Client) -> str:
    scheduler = client.scheduler.address if client.scheduler is not None else "the scheduler"
    return (
        f"the scheduler at {scheduler} is gone. The partitions that were finished are kept: start it again, and the "
        "same command goes on from there"
    )


def _in_words(error: BaseException | None) -> str:
    """Why a task was given up: what it raised, or that its workers died."""
    from distributed.scheduler import KilledWorker

    if isinstance(error, KilledWorker):
        return "the workers that it ran on died one after the other: is there memory enough for a partition?"
    return str(error) or type(error).__name__
