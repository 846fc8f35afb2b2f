"""Partition by partition a fleet has the numbers of one process, each device once, whatever stands in its files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

import bayescal as bc
from tests.support.made_up.gyro_lot import MODEL, table

SMALL = 100  # readings in a partition: some five devices


def fitted(folder: Path, out: Path, **more) -> bc.FleetResult:
    return bc.fit_batch(MODEL, folder, out=out, partition_rows=SMALL, **more)


def same(found: bc.FleetResult, expected: bc.BatchResult, rtol: float = 1e-10) -> None:
    """The same devices, each once, with the same numbers."""
    ours = found.rows().sort_values(["device", "coefficient"]).reset_index(drop=True)
    theirs = expected.table().sort_values(["device", "coefficient"]).reset_index(drop=True)
    pd.testing.assert_frame_equal(ours, theirs, rtol=rtol, atol=0)


@pytest.mark.slow
def test_partitions_give_what_one_process_gives(lot_folder, result, tmp_path) -> None:
    found = fitted(lot_folder, tmp_path / "out")
    assert found.about["partitions"] == 5
    same(found, result)
    assert (len(found), found.fitted, found.missing) == (24, 24, {})
    mean = result.table().query("coefficient == 'bias.temperature'")["mean"]
    row = found.table.set_index("coefficient").loc["bias.temperature"]
    assert row["mean"] == pytest.approx(mean.mean(), rel=1e-12)
    assert row["between devices"] == pytest.approx(mean.std(ddof=0), rel=1e-9)
    np.testing.assert_allclose(found["D07"].mean, result["D07"].mean, rtol=1e-10)
    with pytest.raises(bc.InputError):
        found["D99"]
    back = bc.load_fleet(tmp_path / "out")
    assert str(back) == str(found)
    covariance = pq.read_table(tmp_path / "out" / "devices").column("covariance")
    assert len(covariance) == 72


@pytest.mark.slow
def test_a_population_over_partitions_is_that_of_one_process(lot_folder, tmp_path) -> None:
    files = sorted(lot_folder.glob("*.parquet"))
    one = bc.fit_batch(MODEL, files, population=True)
    found = fitted(lot_folder, tmp_path / "out", population=True)
    assert one.population is not None and found.population is not None
    numbers = ["mean", "mean_sd", "group_sd", "group_sd_sd"]
    np.testing.assert_allclose(
        found.population.table[numbers], one.population.table[numbers], rtol=1e-10
    )
    same(found, one)
    again = bc.load_fleet(tmp_path / "out")
    assert str(again) == str(found)


def test_all_that_a_folder_holds_is_read_or_named(result, tmp_path) -> None:
    """A device a file; `d7.log2`, `.csv.gz`, `_d7.csv`, links and pipes were left out without a word."""
    folder = tmp_path / "in"
    (folder / "below" / "_kept").mkdir(parents=True)
    outside = tmp_path / "outside"
    outside.mkdir()
    for name, own in table().groupby("device"):
        own.drop(columns="device").to_csv(folder / "below" / f"{name}.csv", index=False)
    one = (folder / "below" / "D03.csv").read_bytes()
    for name in ("d7.log2", "d8.csv.gz", "_d7.csv", ".d9.csv", "README", "below/_kept/d1.csv"):
        (folder / name).write_bytes(one)
    (folder / "gone.csv").symlink_to(tmp_path / "nowhere.csv")
    (folder / "link").symlink_to(outside, target_is_directory=True)
    os.mkfifo(folder / "pipe.csv")
    found = fitted(folder, tmp_path / "out")
    expected = {
        "d7.log2": ".log2 is none of the formats",
        "d8.csv.gz": "packed (.gz): unpack it",
        "_d7.csv": "begins with . or _",
        ".d9.csv": "begins with . or _",
        "README": "no suffix is none",
        "below/_kept": "begins with . or _",
        "gone.csv": "a link to nothing",
        "link": "a link to a folder",
        "pipe.csv": "a pipe or a device",
    }
    assert found.left_out.keys() == expected.keys()
    for name, why in expected.items():
        assert why in found.left_out[name]
    same(found, result)
    assert bc.load_fleet(tmp_path / "out").left_out == found.left_out
    for path in (folder / "below").glob("*.csv"):
        path.unlink()
    with pytest.raises(bc.InputError):
        fitted(folder, tmp_path / "empty")
