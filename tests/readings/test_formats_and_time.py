"""Excel, MATLAB and the others read as text does; dates become seconds; what was interpreted is said."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
import xarray as xr

import bayescal as bc
from tests.support.gyro_files import GYRO
from tests.support.lab_files import (
    BEGAN,
    HEAD,
    RATE,
    TEMPERATURE,
    TIME,
    dated,
    is_right,
    spaced,
    text,
    with_cell,
)


def columns() -> dict[str, np.ndarray]:
    return {"time_s": TIME, "temp_C": TEMPERATURE, "output_dps": RATE}


def write_excel(path: Path) -> None:
    pytest.importorskip("openpyxl")
    frame = pd.DataFrame(
        {"Time": [m.replace(tzinfo=None) for m in moments()], "Temp (°C)": TEMPERATURE}
    )
    with pd.ExcelWriter(path) as book:
        frame.assign(**{"Output (deg/s)": RATE}).to_excel(
            book, sheet_name="Run 1", index=False, startrow=2
        )
        pd.DataFrame({"note": ["all well"]}).to_excel(book, sheet_name="Notes", index=False)


def moments() -> list[datetime]:
    return [BEGAN + timedelta(seconds=t) for t in TIME]


def write_old_matlab(path: Path) -> None:
    scipy.io.savemat(path, {**columns(), "operator": "kk"})


def write_structure(path: Path) -> None:
    scipy.io.savemat(path, {"log": columns()})


def write_new_matlab(path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in columns().items():
            file[name] = values[None, :]
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as handle:
        handle.write(b"MATLAB 7.3 MAT-file".ljust(128))


def write_netcdf(path: Path) -> None:
    data = {
        "temperature": ("time", TEMPERATURE, {"units": "degC"}),
        "output": ("time", RATE, {"units": "deg/s"}),
    }
    xr.Dataset(data, {"time": ("time", TIME, {"units": "s"})}).to_netcdf(path, engine="h5netcdf")


def write_parquet(path: Path) -> None:
    pd.DataFrame({"time": moments(), "Temp (C)": TEMPERATURE, "output [deg/s]": RATE}).to_parquet(
        path
    )


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("t.xlsx", write_excel),
        ("t.mat", write_old_matlab),
        ("t.mat", write_structure),
        ("t.mat", write_new_matlab),
        ("t.nc", write_netcdf),
        ("t.parquet", write_parquet),
        ("t.tsv", lambda path: path.write_text(text(separator="\t"))),
        ("t.dsv", lambda path: path.write_text(text(separator=";"))),
        ("t.dsv", lambda path: path.write_text(text(separator="|"))),
    ],
)
def test_other_formats_read_as_text_does(tmp_path, name, write):
    write(tmp_path / name)
    is_right(bc.read(tmp_path / name, GYRO))


def test_a_matrix_of_matlab_has_numbered_columns(tmp_path):
    path = tmp_path / "t.mat"
    scipy.io.savemat(path, {"data": np.column_stack([TIME, TEMPERATURE, RATE])})
    names = {"time": "data(:,1)", "temperature": "data(:,2)", "output": "data(:,3)"}
    units = {"data(:,1)": "s", "data(:,2)": "degC", "data(:,3)": "dps"}
    is_right(bc.read(path, GYRO, columns=names, units=units))
    with pytest.raises(bc.InputError):
        bc.read(path, GYRO, columns=names)
    scipy.io.savemat(path, {"a": np.zeros(3), "b": np.zeros(4)})
    with pytest.raises(bc.InputError):
        bc.read(path, GYRO)


def test_microseconds_of_unix_time_are_kept(put):
    counts = [1_767_225_600_000_001, 1_767_225_600_000_003, 1_767_225_600_123_457]
    path = put(text(("timestamp", *HEAD[1:]), (list(map(str, counts)), TEMPERATURE[:3], RATE[:3])))
    m = bc.read(path, GYRO)
    assert m["time"].tolist() == [0.0, 2e-6, 0.123456]


def test_runs_by_date_share_one_clock(put):
    later = [spaced(BEGAN + timedelta(days=1, seconds=t)) for t in TIME]
    first = put(dated(spaced), "one.csv")
    second = put(text(("Timestamp", *HEAD[1:]), (later, TEMPERATURE, RATE)), "two.csv")
    m = bc.read([second, first], GYRO)
    np.testing.assert_array_equal(m["time"], [*(TIME + 86400), *TIME])
    assert m.groups("run")[0] == ("two", "one")
    timeless = put(text(HEAD[1:], (TEMPERATURE, RATE)), "timeless.csv")
    for files in ([first, put(text())], [timeless, first, put(text())]):
        with pytest.raises(bc.InputError):
            bc.read(files, GYRO)


def test_dropped_rows_are_gaps_that_are_said(put):
    m = bc.read(put(with_cell(4, 2, "", with_cell(6, 1, ""))), GYRO, missing="drop")
    assert m["time"].tolist()[1:4] == [10.0, 30.0, 50.0] and m.sources[0].rows == 12
