"""Files of many devices: read by device, written and loaded again, by Python and by the command."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.made_up.gyro_lot import MODEL, table


def test_files_are_devices_and_labels_may_have_another_name(tmp_path, result) -> None:
    made = table(count=3)
    for name, own in made.groupby("device"):
        own.drop(columns="device").to_csv(tmp_path / f"{name}.csv", index=False)
    files = sorted(tmp_path.glob("*.csv"))
    found = bc.fit_batch(MODEL, files)
    assert found.devices == ("D00", "D01", "D02")
    file = tmp_path / "serial.csv"
    made.rename(columns={"device": "serial"}).to_csv(file, index=False)
    split = bc.split_devices(file, mems_gyro.INSTRUMENT, columns={"device": "serial"})
    again = bc.fit_batch(MODEL, split)
    for name in found.devices:
        np.testing.assert_allclose(found[name].mean, result[name].mean, rtol=1e-10)
        np.testing.assert_allclose(again[name].mean, result[name].mean, rtol=1e-10)
    made.to_csv(tmp_path / "lot.csv", index=False)
    split = bc.split_devices([*files, tmp_path / "lot.csv"], mems_gyro.INSTRUMENT)
    assert set(split.rejection_reasons) == {*found.devices}


def test_a_saved_batch_is_the_same(tmp_path, readings) -> None:
    broken = readings["D02"].with_column("output", np.full(len(readings["D02"]), np.nan))
    given = {"good": readings["D00"], "broken": broken}
    given |= {"also": readings["D01"], "3": readings["D03"]}
    found = bc.fit_batch(MODEL, given)
    back = bc.load_batch(found.save(tmp_path / "lot_result.parquet"))
    pd.testing.assert_frame_equal(back.table(), found.table())
    np.testing.assert_array_equal(back["good"].covariance, found["good"].covariance)
    assert (back.configuration, back.devices) == (found.configuration, found.devices)
    assert str(back) == str(found)
    long = found.table()
    assert list(long.columns) == ["device", "coefficient", "mean", "sd", "unit", "ok", "reason"]
    assert list(dict.fromkeys(long.device)) == list(given)
    assert long[long.device == "broken"].shape[0] == 1
    other, whole = tmp_path / "other.parquet", pq.read_table(tmp_path / "lot_result.parquet")
    other.write_bytes(b"nothing")
    with pytest.raises(bc.InputError):
        bc.load_batch(other)
    for changed in (pa.table({"a": [1]}), whole.slice(1), whole.take([0, 3, 1, 2])):
        pq.write_table(changed, other, write_page_checksum=True)
        with pytest.raises(bc.InputError):
            bc.load_batch(other)
