"""A Dask cluster: processes of this machine, or one that runs elsewhere.

Whoever reaches a scheduler or a worker of Dask can have it run code. That of this machine's processes listens on the
loopback interface alone, takes only those who hold a key that is made for it and never leaves memory (TLS, both sides),
and serves no page.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from bayescal._core.errors import InputError
from bayescal._core.progress import note

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

INSTALL = "Fleets run on Dask: pip install 'bayescal[fleet]'"
LOOPBACK = "127.0.0.1"
ANSWER = 20.0  # seconds within which a scheduler answers


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
        client = Client(scheduler, timeout=ANSWER)
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
    no_pages = {f"distributed.{part}.http.routes": [] for part in ("scheduler", "worker")}
    with (
        dask.config.set(no_pages),
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
