"""A Dask cluster: processes of this machine, or one that runs elsewhere."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from bayescal._core.errors import InputError

if TYPE_CHECKING:
    from distributed import Client

INSTALL = "Fleets run on Dask: pip install 'bayescal[fleet]'"
ANSWER = 20.0  # seconds within which a scheduler answers


@contextmanager
def open_cluster(workers: int | None, scheduler: str | None = None) -> Iterator[Client]:
    """A client of so many processes of this machine, or of the cluster at an address; closed at the end.

    Raises:
        InputError: Dask is not installed, or nobody answers at the address.
    """
    if importlib.util.find_spec("distributed") is None:
        raise InputError(INSTALL)
    from distributed import Client, LocalCluster

    if scheduler is None:
        shown = importlib.util.find_spec("bokeh") is not None
        with (
            LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address=":0" if shown else None,  # pyright: ignore[reportArgumentType]
            ) as cluster,
            Client(cluster) as client,
        ):
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
