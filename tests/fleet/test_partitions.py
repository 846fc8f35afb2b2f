"""Partition by partition a fleet has the numbers of one process, each device once, whatever stands in its files."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import bayescal as bc
from bayescal._annexes.fleet import fit_batch as fitting
from bayescal._annexes.fleet.fit_batch import partitions_of
from tests.support.command_line import GYRO, needs_installation, run
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


@pytest.mark.slow
def test_a_large_file_is_cut_between_devices(result, tmp_path) -> None:
    made = table().sort_values("device", kind="stable")
    file = tmp_path / "lot.parquet"
    made.to_parquet(file, row_group_size=37)  # row groups end within devices
    assert len(partitions_of([file], SMALL)) > 4
    same(fitted(file, tmp_path / "out"), result)
    one = made[made.device == "D03"]
    long = pd.concat([one] * 12)  # a device longer than several partitions
    pd.concat([made[made.device < "D03"], long, made[made.device > "D03"]]).to_parquet(
        file, row_group_size=37
    )
    found = fitted(file, tmp_path / "long")
    assert found.readings == len(made) + 11 * len(one)
    assert (len(found), found.fitted) == (24, 24)


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


def test_what_is_done_is_not_done_again(lot_folder, tmp_path, monkeypatch) -> None:
    folder, out = tmp_path / "in", tmp_path / "out"
    shutil.copytree(lot_folder, folder)
    first = fitted(folder, out)
    before = first.rows()
    calls: list[int] = []
    real = fitting._fitted

    def counted(request, partition, *rest):
        calls.append(partition.number)
        return real(request, partition, *rest)

    monkeypatch.setattr(fitting, "_fitted", counted)
    assert fitted(folder, out).about["found_done"] == 5
    assert calls == []
    (out / "devices" / "part-000001.parquet").unlink()  # never written
    damaged = out / "devices" / "part-000003.parquet"
    damaged.write_bytes(damaged.read_bytes()[:-100])  # or not whole
    pd.testing.assert_frame_equal(fitted(folder, out).rows(), before, check_exact=True)
    assert calls == [1, 3]
    made = pd.read_parquet(folder / "lot-2.parquet")
    made.iloc[0, made.columns.get_loc("output [deg/s]")] += 1.0
    made.to_parquet(folder / "lot-2.parquet")  # other readings
    assert fitted(folder, out).about["found_done"] == 4
    assert fitted(folder, out, reference={"T0": 0.0}).about["found_done"] == 0  # another request
    with pytest.raises(bc.InputError):
        bc.fit_batch(MODEL, folder / "lot-0.parquet", out=out)


def test_a_basis_of_another_form_is_another_request(lot_folder, tmp_path) -> None:
    def model(power: int) -> bc.Model:
        return MODEL + bc.Effect(
            "bias.power",
            "bias",
            basis=lambda r: r.centred() ** power,
            coefficients=(bc.Coefficient("deg/s", bc.Normal(0.0, 1.0)),),
        )

    file, done = lot_folder / "lot-0.parquet", []
    for power in (2, 2, 3):
        found = bc.fit_batch(model(power), file, out=tmp_path / "out")
        assert isinstance(found, bc.FleetResult)
        done.append(found.about["found_done"])
    assert done == [0, 1, 0]


def test_a_corrupt_file_is_named_and_done_once_it_is_mended(lot_folder, result, tmp_path) -> None:
    folder, out = tmp_path / "in", tmp_path / "out"
    shutil.copytree(lot_folder, folder)
    whole = (folder / "lot-1.parquet").read_bytes()
    (folder / "lot-1.parquet").write_bytes(whole[: len(whole) // 2])
    found = fitted(folder, out)
    assert list(found.missing) == ["lot-1.parquet"]
    assert "Parquet" in found.missing["lot-1.parquet"]
    assert set(found.rows().device) == set(result.devices) - set(sorted(result.devices)[1::5])
    (folder / "lot-1.parquet").write_bytes(whole)
    found = fitted(folder, out)
    assert found.missing == {} and found.about["found_done"] == 4
    same(found, result)


def test_a_device_in_several_partitions_is_refused_once(lot_folder, result, tmp_path) -> None:
    folder, out = tmp_path / "in", tmp_path / "out"
    shutil.copytree(lot_folder, folder)
    whole = pd.read_parquet(folder / "lot-3.parquet")
    stray = table().query("device == 'D00'")  # which stands in lot-0
    pd.concat([whole, stray]).to_parquet(folder / "lot-3.parquet")
    found = fitted(folder, out)
    assert (len(found), found.fitted) == (24, 23)
    rows = found.rows()
    own = rows[rows.device == "D00"]
    assert len(own) == 1 and not own.ok.any()
    assert found.table.devices.tolist() == [23, 23, 23]
    again = fitted(folder, out)
    assert again.about["found_done"] == 5  # nothing is done a third time
    whole.to_parquet(folder / "lot-3.parquet")
    same(fitted(folder, out), result)


def test_devices_that_cannot_be_used_are_refused_alone(lot_folder, result, tmp_path) -> None:
    folder = tmp_path / "in"
    shutil.copytree(lot_folder, folder)
    made = pd.read_parquet(folder / "lot-0.parquet")
    made["temperature [degC]"] = 25.0  # all devices of a partition
    made.to_parquet(folder / "lot-0.parquet")
    found = fitted(folder, tmp_path / "out")
    assert (len(found), found.fitted) == (24, 19)
    with pytest.raises(bc.InputError):
        bc.fit_batch(MODEL, folder / "lot-0.parquet", out=tmp_path / "none")


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
    command = ("batch", folder, *GYRO, "--out", tmp_path / "out")
    refused = run(*command)
    assert refused.status == 2 and refused.err.count("Oven (C) looks like it") == 1
    usual = ("--columns", "temperature=Oven (C)", "--columns", "output=Gyro (dps)")
    run(*command, *usual)
    run(*command, *usual, "--columns", "temperature=T/°C", "--columns", "output=w/(rad/s)")
    table = bc.load_fleet(tmp_path / "out").rows()
    slopes = table[table["coefficient"] == "bias.temperature"]["mean"]
    assert np.allclose(slopes, 0.01, atol=1e-3)


def test_a_full_disk_is_said_and_gone_on_from(lot_folder, result, tmp_path, monkeypatch) -> None:
    out = tmp_path / "out"
    write, written = pq.write_table, []

    def full(table: pa.Table, where, **options):
        if len(written) == 2:
            raise OSError(28, "No space left on device")
        written.append(where)
        write(table, where, **options)

    with monkeypatch.context() as patch:
        patch.setattr(pq, "write_table", full)
        found = fitted(lot_folder, out)
    assert sorted(found.missing) == ["lot-2.parquet", "lot-3.parquet", "lot-4.parquet"]
    assert not list((out / "devices").glob(".*"))
    found = fitted(lot_folder, out)
    assert found.about["found_done"] == 2
    same(found, result)


@needs_installation
def test_the_command_goes_by_partition(lot_folder, result, tmp_path) -> None:
    out = tmp_path / "out"
    ran = run("batch", lot_folder, *GYRO, "-o", out)
    assert ran.status == 0, ran.err
    same(bc.load_fleet(out), result)
    assert json.loads((out / "fleet.json").read_text())["schema"] == "bayescal.fleet/1"
    ran = run("batch", lot_folder, *GYRO, "-o", tmp_path / "out.parquet")
    assert ran.status == 2
    ran = run("batch", lot_folder / "none", *GYRO, "-o", out)
    assert ran.status == 2
    broken = tmp_path / "in"
    shutil.copytree(lot_folder, broken)
    (broken / "lot-4.parquet").write_bytes(b"PAR1")
    ran = run("batch", broken, *GYRO, "-o", tmp_path / "other")
    assert ran.status == 1
