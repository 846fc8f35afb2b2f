"""Files that are fitted some devices at a time have the numbers of all at once, whatever stands in them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import bayescal as bc
from tests.support.command_line import GYRO, needs_installation, run
from tests.support.inside import SMALL_TASKS
from tests.support.made_up.gyro_lot import MODEL, table


@pytest.fixture(autouse=True)
def small_tasks(monkeypatch) -> None:
    monkeypatch.setattr(*SMALL_TASKS)


def fitted(folder: Path, **more) -> bc.BatchResult:
    return bc.fit_batch(MODEL, folder, **more)


def same(found: bc.BatchResult, expected: bc.BatchResult, rtol: float = 1e-10) -> None:
    """The same devices, each once, with the same numbers."""
    ours, theirs = (
        one.table().sort_values(["device", "coefficient"]).reset_index(drop=True)
        for one in (found, expected)
    )
    pd.testing.assert_frame_equal(ours, theirs, rtol=rtol, atol=0)


@pytest.mark.slow
def test_parts_give_what_one_process_gives(lot_folder, result, tmp_path) -> None:
    found = fitted(lot_folder, out=tmp_path / "out.parquet")
    same(found, result)
    assert (len(found), found.fitted_count, found.file_errors) == (24, 24, {})
    mean = result.table().query("coefficient == 'bias.temperature'")["mean"]
    row = found.coefficients().set_index("coefficient").loc["bias.temperature"]
    assert row["median"] == pytest.approx(mean.median(), rel=1e-12)
    assert row["between devices"] == pytest.approx(mean.std(ddof=1), rel=1e-9)
    with pytest.raises(bc.InputError):
        found["D99"]
    back = bc.load_batch(tmp_path / "out.parquet")
    assert str(back) == str(found) and back.to_json_data() == found.to_json_data()


@pytest.mark.slow
def test_devices_need_not_stand_together(result, tmp_path) -> None:
    made = table().sample(frac=1, random_state=1)
    file = tmp_path / "lot.parquet"
    made.to_parquet(file, row_group_size=37)  # row groups end within devices
    same(fitted(file), result)
    made["output [deg/s]"] = made["output [deg/s]"].astype(object)
    at = int(np.flatnonzero(made.device == "D20")[2])
    made.iloc[at, made.columns.get_loc("output [deg/s]")] = "broken"
    made.astype({"output [deg/s]": str}).to_parquet(file, row_group_size=37)
    found = fitted(file)
    assert list(found.unreliable) == ["D20"] and f"row {at + 1} " in found["D20"].reason


def test_all_that_a_folder_holds_is_read_or_named(result, tmp_path, capsys) -> None:
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
    found = fitted(folder, out=tmp_path / "out.parquet")
    expected = {"d7.log2", "d8.csv.gz", "_d7.csv", ".d9.csv", "README", "below/_kept"}
    expected |= {"gone.csv", "link", "pipe.csv"}
    assert found.skip_reasons.keys() == expected
    said = capsys.readouterr().err
    assert all(name in said and name in str(found) for name in expected)
    same(found, result)
    assert bc.load_batch(tmp_path / "out.parquet").skip_reasons == found.skip_reasons
    for path in (folder / "below").glob("*.csv"):
        path.unlink()
    with pytest.raises(bc.InputError, match=r"_d7\.csv"):
        fitted(folder)


def test_a_corrupt_file_is_named(lot_folder, result, tmp_path) -> None:
    folder = tmp_path / "in"
    shutil.copytree(lot_folder, folder)
    whole = (folder / "lot-1.parquet").read_bytes()
    (folder / "lot-1.parquet").write_bytes(whole[: len(whole) // 2])
    found = fitted(folder)
    assert list(found.file_errors) == ["lot-1.parquet"]
    assert set(found.devices) == set(result.devices) - set(sorted(result.devices)[1::5])


def test_a_device_in_several_files_is_refused_once(lot_folder, tmp_path) -> None:
    folder = tmp_path / "in"
    shutil.copytree(lot_folder, folder)
    whole = pd.read_parquet(folder / "lot-3.parquet")
    stray = table().query("device == 'D00'")  # which stands in lot-0
    pd.concat([whole, stray]).to_parquet(folder / "lot-3.parquet")
    found = fitted(folder)
    assert (len(found), found.fitted_count) == (24, 23)
    own = found.table().query("device == 'D00'")
    assert len(own) == 1 and not own.ok.any()
    assert all(name in own.reason.iloc[0] for name in ("lot-0.parquet", "lot-3.parquet"))
    assert found.coefficients().devices.tolist() == [23, 23, 23]


def test_devices_that_cannot_be_used_are_refused_alone(lot_folder, tmp_path) -> None:
    folder = tmp_path / "in"
    shutil.copytree(lot_folder, folder)
    made = pd.read_parquet(folder / "lot-0.parquet")
    made["temperature [degC]"] = 25.0  # all devices of a part
    made.to_parquet(folder / "lot-0.parquet")
    found = fitted(folder)
    assert (len(found), found.fitted_count) == (24, 19) and "D00" in found.unreliable
    with pytest.raises(bc.InputError, match="D00"):
        bc.fit_batch(MODEL, folder / "lot-0.parquet")


@needs_installation
def test_a_folder_of_one_s_own_headers_is_asked_about_once(tmp_path) -> None:
    folder = tmp_path / "lot"
    folder.mkdir()
    (folder / "README.txt").write_text("Lot 7, oven B.\n")
    rng = np.random.default_rng(7)
    for i in range(8):
        heat = np.linspace(-20, 60, 30)
        rate = 0.1 * i + 0.01 * heat + 0.01 * rng.standard_normal(30)
        columns = {"Time (s)": 10.0 * np.arange(30), "Oven (C)": heat, "Gyro (dps)": rate}
        if i == 5:
            columns = dict(zip(("t/s", "T/°C", "w/(rad/s)"), columns.values(), strict=True))
            columns["w/(rad/s)"] = np.deg2rad(rate)
        pd.DataFrame(columns).to_csv(folder / f"N{i}.csv", index=False)
    command = ("batch", folder, *GYRO, "--out", tmp_path / "out.parquet")
    refused = run(*command)
    assert refused.status == 2 and refused.err.count("Oven (C) looks like it") == 1
    usual = ("--columns", "temperature=Oven (C)", "--columns", "output=Gyro (dps)")
    most = run(*command, *usual, "--json")
    assert most.data["fitted"] == 7 and "N5.csv" in most.data["missing"]
    every = run(*command, *usual, "--columns", "temperature=T/°C", "--columns", "output=w/(rad/s)")
    assert every.status == 1  # README.txt
    table = bc.load_batch(tmp_path / "out.parquet").table()
    slopes = table[table["coefficient"] == "bias.temperature"]["mean"]
    assert len(slopes) == 8 and np.allclose(slopes, 0.01, atol=1e-3)


@needs_installation
def test_the_command_takes_a_folder(lot_folder, result, tmp_path) -> None:
    out = tmp_path / "out.parquet"
    ran = run("batch", lot_folder, *GYRO, "-o", out)
    assert ran.status == 0, ran.err
    same(bc.load_batch(out), result)
    ran = run("batch", lot_folder / "none", *GYRO, "-o", out)
    assert ran.status == 2
