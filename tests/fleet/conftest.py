"""A lot of gyros, read once and fitted once for the tests of many devices; a cluster that they share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.made_up.gyro_lot import MODEL, table

if TYPE_CHECKING:
    from distributed import Client

PARTS = 5


@pytest.fixture(scope="session")
def readings(tmp_path_factory) -> bc.Devices:
    file = tmp_path_factory.mktemp("lot") / "lot.parquet"
    made = table()
    order = np.random.default_rng(1).permutation(len(made))  # devices need not stand in order
    made.iloc[order].to_parquet(file)
    return bc.split_devices(file, mems_gyro.INSTRUMENT)


@pytest.fixture(scope="session")
def result(readings) -> bc.BatchResult:
    return bc.fit_batch(MODEL, readings)


@pytest.fixture(scope="session")
def lot_folder(tmp_path_factory) -> Path:
    """The same devices in a folder of several Parquet files."""
    folder = tmp_path_factory.mktemp("partitioned")
    made = table()
    names = sorted(made.device.unique())
    for i in range(PARTS):
        own = made[made.device.isin(names[i::PARTS])]
        own.to_parquet(folder / f"lot-{i}.parquet")
    return folder


@pytest.fixture(scope="session")
def client() -> Iterator[Client]:
    """A cluster of two processes, for all tests of this session."""
    pytest.importorskip("distributed", reason="needs Dask: pip install 'bayescal[fleet]'")
    from distributed import Client, LocalCluster

    given = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(**given) as cluster, Client(cluster) as client:  # pyright: ignore[reportArgumentType]
        yield client
