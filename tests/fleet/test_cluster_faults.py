"""Workers and schedulers killed at any moment: the numbers are the same bit for bit, or what is missing is named."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import bayescal as bc
from tests.support.inside import cluster_of
from tests.support.made_up.gyro_lot import MODEL, table

pytest.importorskip("distributed", reason="needs Dask: pip install 'bayescal[fleet]'")
pytestmark = pytest.mark.nightly
COPIES = 30  # files, each of some readings


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("many")
    for i in range(COPIES):
        own = table(seed=i)
        own.assign(device=f"P{i:02d}-" + own.device).to_parquet(made / f"lot-{i:02d}.parquet")
    return made


def fit(folder: Path, **how) -> bc.BatchResult:
    return bc.fit_batch(MODEL, folder, partition_rows=600, **how)


def test_killed_workers_change_nothing(folder) -> None:
    expected = fit(folder)
    with cluster_of(2) as client:
        own: Any = client.run(os.getpid)

        def kill() -> None:
            for process in own.values():
                os.kill(process, signal.SIGKILL)

        killer = threading.Timer(2.0, kill)
        killer.start()
        found = fit(folder, client=client)
        killer.join(timeout=10)
        now: Any = client.run(os.getpid)
        assert not set(own.values()) & set(now.values())
    assert found.missing == {}
    pd.testing.assert_frame_equal(found.table(), expected.table(), check_exact=True)


def test_a_killed_scheduler_is_said(folder) -> None:
    from distributed import Client

    port = _free_port()
    address = f"tcp://127.0.0.1:{port}"
    with _processes(port) as (scheduler, _), Client(address, timeout=60) as client:
        client.wait_for_workers(2, timeout=120)
        killer = threading.Timer(1.0, scheduler.kill)
        killer.start()
        with suppress(bc.InputError):  # before any file was done
            found = fit(folder, client=client)
            assert found.missing and found.fitted == len(found)
        killer.join(timeout=10)


def _free_port() -> int:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return held.getsockname()[1]


@contextmanager
def _processes(port: int) -> Iterator[tuple[subprocess.Popen, list[subprocess.Popen]]]:
    """A scheduler and two workers, processes of their own."""
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    scheduler = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1"]
        + ["--port", str(port), "--no-dashboard"],
        **quiet,
    )
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", f"tcp://127.0.0.1:{port}"]
    worker += ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "60"]
    workers = [subprocess.Popen(worker, **quiet) for _ in range(2)]
    try:
        yield scheduler, workers
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()
