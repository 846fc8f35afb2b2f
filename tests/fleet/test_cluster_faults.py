"""Workers and schedulers killed at any moment: the same command ends with the same numbers, bit for bit."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import bayescal as bc
from tests.support.inside import cluster_of
from tests.support.made_up.gyro_lot import MODEL, table

pytest.importorskip("distributed", reason="needs Dask: pip install 'bayescal[fleet]'")
pytestmark = pytest.mark.nightly
COPIES = 30  # partitions, each of some readings


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("many")
    for i in range(COPIES):
        own = table(seed=i)
        own.assign(device=f"P{i:02d}-" + own.device).to_parquet(made / f"lot-{i:02d}.parquet")
    return made


@pytest.fixture(scope="module")
def expected(folder, tmp_path_factory) -> pd.DataFrame:
    out = tmp_path_factory.mktemp("expected") / "out"
    return bc.fit_batch(MODEL, folder, out=out, partition_rows=600).rows()


def fit(folder: Path, out: Path, client) -> bc.FleetResult:
    return bc.fit_batch(MODEL, folder, out=out, partition_rows=600, client=client)


def done(out: Path) -> int:
    return len(list((out / "devices").glob("part-*.parquet")))


def when(out: Path, count: int, act) -> threading.Thread:
    """Do something once so many partitions are written."""

    def wait() -> None:
        while done(out) < count:
            time.sleep(0.01)
        act()

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


def test_killed_workers_change_nothing(folder, expected, tmp_path) -> None:
    out = tmp_path / "out"
    with cluster_of(2) as client:
        own: Any = client.run(os.getpid)

        def kill() -> None:
            for process in own.values():
                os.kill(process, signal.SIGKILL)

        killer = when(out, 3, kill)
        found = fit(folder, out, client)
        killer.join(timeout=10)
        now: Any = client.run(os.getpid)
        assert not set(own.values()) & set(now.values())
    assert found.missing == {}
    pd.testing.assert_frame_equal(found.rows(), expected, check_exact=True)
