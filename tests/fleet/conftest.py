"""A lot of gyros, read once and fitted once for the tests of many devices."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.made_up.gyro_lot import MODEL, table


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
