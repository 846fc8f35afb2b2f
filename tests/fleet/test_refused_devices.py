"""A device that cannot be fitted is refused by itself and spoils no other."""

from __future__ import annotations

import dataclasses

import numpy as np

import bayescal as bc
from tests.support.made_up.gyro_lot import MODEL, table


def test_bad_devices_are_refused_by_themselves(tmp_path, result) -> None:
    made = table()
    first = made.groupby("device").head(1).index
    made = made.astype({"output [deg/s]": object})
    made.loc[first[2], "output [deg/s]"] = float("nan")
    made.loc[first[5], "output [deg/s]"] = "broken"
    made.loc[made.device == "D07", "temperature [degC]"] = 25.0
    made.loc[first[9], "temperature [degC]"] = 4000.0
    made = made.drop(made.index[made.device == "D11"][2:])  # two readings are left
    file = tmp_path / "lot.csv"
    made.to_csv(file, index=False)
    found = bc.fit_batch(MODEL, file)
    said = ("D02", "D05", "D07", "D09", "D11")
    for name in said:
        assert not found[name].ok
    good = sorted(n for n in result.devices if n not in said)
    assert [n for n in found.devices if found[n].ok] == good
    for name in good:
        np.testing.assert_allclose(found[name].mean, result[name].mean, rtol=1e-10)


def test_measurements_that_differ_do_not_stop_each_other(readings, result) -> None:
    lacking, broken = readings["D01"], readings["D02"]
    kept = {n: values for n, values in lacking.values.items() if n != "temperature"}
    lacking = dataclasses.replace(lacking, values=kept)
    broken = broken.with_column("output", np.where(np.arange(len(broken)) == 3, np.nan, 1.0))
    whole, last = readings["D00"], readings["D03"]
    given = {"whole": whole, "lacking": lacking, "broken": broken, "last": last}
    found = bc.fit_batch(MODEL, given)
    np.testing.assert_allclose(found["whole"].mean, result["D00"].mean, rtol=1e-12)
    np.testing.assert_allclose(found["last"].mean, result["D03"].mean, rtol=1e-12)
    assert "Empty" not in str(bc.fit_batch(MODEL, [whole.select(np.arange(2))]))


def test_a_file_that_cannot_be_read_stops_none_of_its_name(tmp_path, result) -> None:
    own = table(count=1).drop(columns="device")
    for folder in ("good", "broken"):
        (tmp_path / folder).mkdir()
    own.to_csv(tmp_path / "good" / "log.csv", index=False)
    (tmp_path / "broken" / "log.csv").write_text("no readings\n", "utf-8")
    found = bc.fit_batch(MODEL, tmp_path)
    assert found.devices == ("log",) and "log.csv" in found.missing
    np.testing.assert_allclose(found["log"].mean, result["D00"].mean, rtol=1e-10)
