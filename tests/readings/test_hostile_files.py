"""Forty files as laboratories have them: each is read right, or refused once with all that is wrong with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
import xarray as xr

from bayescal._core.errors import InputError
from bayescal._readings.read import read
from tests.support.gyro_files import GYRO

TIME = np.arange(12) * 10.0
TEMPERATURE = 20 + 0.125 * TIME
RATE = 0.5 + 0.015625 * (TEMPERATURE - 25)  # °/s, in binary fractions
BEGAN = datetime(2026, 11, 22, 23, 59, 0, 123000, tzinfo=UTC)
HEAD = ("time [s]", "temperature [degC]", "output [deg/s]")


def text(
    head: Sequence[str] = HEAD,
    columns: Sequence[Sequence[Any]] = (TIME, TEMPERATURE, RATE),
    separator: str = ",",
    decimal: str = ".",
) -> str:
    """A text file of these columns."""

    def cell(value: Any) -> str:
        return value if isinstance(value, str) else repr(float(value)).replace(".", decimal)

    rows = [separator.join(map(cell, row)) for row in zip(*columns, strict=True)]
    return "\n".join([separator.join(head), *rows, ""])


def when(form: Callable[[datetime], str], zone: str = "") -> list[str]:
    return [form(BEGAN + timedelta(seconds=t)) + zone for t in TIME]


def dated(form: Callable[[datetime], str], head: str = "Timestamp", zone: str = "") -> str:
    return text((head, *HEAD[1:]), (when(form, zone), TEMPERATURE, RATE))


def counted(per_second: int, head: str) -> str:
    began = int(round(BEGAN.timestamp() * 1e3)) * per_second // 1000
    counts = [str(began + int(t) * per_second) for t in TIME]
    return text((head, *HEAD[1:]), (counts, TEMPERATURE, RATE))


def with_cell(row: int, column: int, cell: str, source: str = "") -> str:
    lines = [line.split(",") for line in (source or text()).splitlines()]
    lines[row - 1][column] = cell
    return "\n".join([",".join(line) for line in lines] + [""])


def iso(moment: datetime) -> str:
    return moment.replace(tzinfo=None).isoformat(timespec="milliseconds")


def spaced(moment: datetime) -> str:
    return iso(moment).replace("T", " ")


class Good(NamedTuple):
    """A file that is read right: its content, options, and how near the numbers are."""

    content: str | bytes
    options: dict[str, Any] = {}
    left_out: tuple[int, ...] = ()


OUTPUT = {"columns": {"output": "gyro_z"}}
READ = {
    "as it should be": Good(text()),
    "units in round brackets": Good(text(("Time (s)", "Temp (°C)", "Output (°/s)"))),
    "C for °C": Good(text(("time [s]", "temperature [C]", "output [deg/s]"))),
    "units behind a slash": Good(text(("t/s", "T/°C", "output/(deg/s)"))),
    "units behind underscores": Good(
        text(("t_s", "Temp_C", "gyro_z_dps")), {"columns": {"output": "gyro_z_dps"}}
    ),
    "units given": Good(text(("time", "temp", "gyro_z")), {**OUTPUT, "units": dict(time="s", temp="degC", gyro_z="dps")}),
    "kelvin and radians": Good(
        text(("time [ms]", "temperature [K]", "output [rad/s]"), (TIME * 1e3, TEMPERATURE + 273.15, np.radians(RATE)))
    ),
    "degrees an hour": Good(text((*HEAD[:2], "output_dph"), (TIME, TEMPERATURE, RATE * 3600))),
    "other letters": Good(text(("TIME [S]", "TEMPERATURE [DEGC]", "Output [Deg/s]"))),
    "byte order mark": Good("\ufeff" + text()),
    "UTF-16": Good(text().encode("utf-16")),
    "Latin-1": Good(text(("t [s]", "Temp [°C]", "output [°/s]")).encode("latin-1")),
    "carriage returns": Good(text().replace("\n", "\r\n")),
    "semicolons": Good(text(separator=";")),
    "tabs": Good(text(separator="\t")),
    "decimal commas": Good(text(separator=";", decimal=",")),
    "decimal commas between tabs": Good(text(separator="\t", decimal=",")),
    "comments and blank lines": Good("# test 7\n\n" + text() + "\n\n"),
    "ISO": Good(dated(iso)),
    "ISO with Z": Good(dated(iso, "time", "Z")),
    "ISO with an offset": Good(dated(iso, "time", "+03:00")),
    "date and time": Good(dated(spaced)),
    "day first, with points": Good(dated(lambda m: f"{m:%d.%m.%Y %H:%M:%S}.{m.microsecond // 1000:03}", "Date")),
    "Unix seconds": Good(counted(1, "timestamp")),
    "Unix milliseconds": Good(counted(1_000, "timestamp")),
    "Unix microseconds": Good(counted(1_000_000, "timestamp")),
    "Unix microseconds, said": Good(counted(1_000_000, "time [us]")),
    "a missing reading, dropped": Good(with_cell(4, 2, ""), {"missing": "drop"}, (2,)),
    "marks of missing readings, dropped": Good(
        with_cell(4, 1, "N/A", with_cell(7, 2, "1.#QNAN")), {"missing": "drop"}, (2, 5)
    ),
    "-999, dropped": Good(with_cell(5, 2, "-999"), {"missing": "drop"}, (3,)),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_it_is_read_right(put, name):
    content, options, left_out = READ[name]
    is_right(read(put(content), GYRO, **options), left_out)


def is_right(readings, left_out=()):
    kept = np.setdiff1d(np.arange(len(TIME)), left_out)
    np.testing.assert_array_equal(readings["time"], TIME[kept])
    np.testing.assert_allclose(readings["temperature"], TEMPERATURE[kept], rtol=1e-14)
    np.testing.assert_allclose(readings["output"], RATE[kept], rtol=1e-14)


class Bad(NamedTuple):
    """A file that is refused: how many problems it has, and words that must be said."""

    content: str | bytes
    count: int
    said: tuple[str, ...]
    options: dict[str, Any] = {}


REFUSED = {
    "no units": Bad(
        text(("time", "temperature", "output")),
        3,
        ("--unit time=s", "--unit temperature=degC", "--unit output=deg/s"),
    ),
    "no output": Bad(text(("t_s", "Temp_C", "gyro_z_dps")), 1, ("--columns output=gyro_z_dps",)),
    "three gyroscopes": Bad(
        text((*HEAD[:2], "gx (dps)", "gy (dps)"), (TIME, TEMPERATURE, RATE, RATE)),
        1,
        ("gx (dps), gy (dps) look like it", "--columns 'output=gx (dps)'"),
    ),
    "two temperatures": Bad(
        text(("time [s]", "Temp (C)", "Temp [K]", "output [dps]"), (TIME, TEMPERATURE, TEMPERATURE, RATE)),
        1,
        ("lacks the column 'temperature'", "Temp"),
    ),
    "degrees for a temperature": Bad(text(("time [s]", "temperature [deg]", HEAD[2])), 1, ("[deg]", "degC")),
    "text and gaps": Bad(
        with_cell(3, 1, "", with_cell(4, 2, "OVLD", with_cell(9, 2, "x"))),
        2,
        ("'OVLD', 'x'", "4, 9", "--missing drop"),
    ),
    "everything": Bad(
        with_cell(3, 1, "", with_cell(4, 2, "1,5", with_cell(6, 0, "5", text(("time", "Temp (C)", "gyro_z")))).replace("1,5", "a,1.5")),
        6,
        ("no such column", "4 fields", "has no unit", "is empty or NaN", "--missing drop"),
    ),
    "commas that may part thousands": Bad(
        "temperature [degC];output [deg/s]\n20,125;1,125\n30,125;2,125\n", 2, ("--decimal ,",)
    ),
    "months and days that may be exchanged": Bad(
        dated(lambda m: f"{m:%m/%d/%Y %H:%M:%S}", "time"), 2, ("2026-11-22", "has no unit")
    ),
    "zones in some rows": Bad(
        with_cell(5, 0, iso(BEGAN) + "+01:00", dated(iso, "time")), 1, ("with a zone everywhere",)
    ),
    "dates and numbers": Bad(with_cell(5, 0, "40.0", dated(iso, "time")), 1, ("reads '40.0'", "a date such as")),
    "time that runs backwards": Bad(with_cell(5, 0, "5", ), 1, ("time runs backwards",)),
    "mixed encodings": Bad(
        text(("time [s]", "temperature [°C]", HEAD[2])).encode() + b"1,2,3 \xb0\n", 1, ("not UTF-8",)
    ),
    "no header": Bad("0,20,1\n1,20,2\n", 4, ("lacks",) and ("no such column",)),
    "nothing": Bad("", 1, ("is empty",)),
    "a missing reading in every row": Bad(
        text(HEAD, (TIME, TEMPERATURE, ["NaN"] * 12)), 1, ("no row without",), {"missing": "drop"}
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_once_with_all_that_is_wrong(put, name):
    content, count, said, options = REFUSED[name]
    path = put(content)
    with pytest.raises(InputError) as refused:
        read(path, GYRO, **options)
    for words in said:
        assert words in str(refused.value)
    assert (len(refused.value.problems) or 1) == count, str(refused.value)
    assert list(path.parent.iterdir()) == [path]


# --- formats -------------------------------------------------------------------------------------


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
    ],
)
def test_other_formats_read_as_text_does(tmp_path, name, write):
    write(tmp_path / name)
    is_right(read(tmp_path / name, GYRO))


def test_a_matrix_of_matlab_has_numbered_columns(tmp_path):
    path = tmp_path / "t.mat"
    scipy.io.savemat(path, {"data": np.column_stack([TIME, TEMPERATURE, RATE])})
    names = {"time": "data(:,1)", "temperature": "data(:,2)", "output": "data(:,3)"}
    units = {"data(:,1)": "s", "data(:,2)": "degC", "data(:,3)": "dps"}
    is_right(read(path, GYRO, columns=names, units=units))
    with pytest.raises(InputError, match=r"3 problems|2 problems"):
        read(path, GYRO, columns=names)
    scipy.io.savemat(path, {"a": np.zeros(3), "b": np.zeros(4)})
    with pytest.raises(InputError, match=r"vectors of 2 lengths, .* a \(3\), b \(4\)"):
        read(path, GYRO)


# --- time ----------------------------------------------------------------------------------------


def test_microseconds_of_unix_time_are_kept(put):
    counts = [1_767_225_600_000_001, 1_767_225_600_000_003, 1_767_225_600_123_457]
    path = put(text(("timestamp", *HEAD[1:]), (list(map(str, counts)), TEMPERATURE[:3], RATE[:3])))
    m = read(path, GYRO)
    assert m["time"].tolist() == [0.0, 2e-6, 0.123456]
    assert any("taken as µs since 1970" in flag for flag in m.flags)
    assert any("time is in s since 2026-01-01 00:00:00.000001" in flag for flag in m.flags)


def test_a_clock_that_may_count_from_its_start_needs_a_unit(put):
    counts = [str(1_200_000_000 + int(10e6 * i)) for i in range(12)]  # µs since switched on, 20 min
    with pytest.raises(InputError, match="'timestamp': the header has no unit"):
        read(put(text(("timestamp", *HEAD[1:]), (counts, TEMPERATURE, RATE))), GYRO)


def test_runs_by_date_share_one_clock(put):
    later = [spaced(BEGAN + timedelta(days=1, seconds=t)) for t in TIME]
    first = put(dated(spaced), "one.csv")
    second = put(text(("Timestamp", *HEAD[1:]), (later, TEMPERATURE, RATE)), "two.csv")
    m = read([second, first], GYRO)
    np.testing.assert_array_equal(m["time"], [*(TIME + 86400), *TIME])
    assert m.groups("run")[0] == ("two", "one")
    with pytest.raises(InputError, match=r"'one\.csv' has dates .* 't\.csv' has none"):
        read([first, put(text())], GYRO)


# --- what is said --------------------------------------------------------------------------------


def test_each_header_that_was_interpreted_is_said(put):
    said = read(put(text(("t_s", "Temp (C)", "output [deg/s]"))), GYRO).flags
    assert said == ("t.csv: read 't_s' as time in s", "t.csv: read 'Temp (C)' as temperature in °C")


def test_dropped_rows_are_gaps_that_are_said(put):
    m = read(put(with_cell(4, 2, "", with_cell(6, 1, ""))), GYRO, missing="drop")
    assert m["time"].tolist()[1:4] == [10.0, 30.0, 50.0] and m.sources[0].rows == 12
    assert m.flags[0] == (
        "t.csv: 2 of 12 rows dropped, where readings are missing: temperature in row 6; output in row 4"
    )


def test_an_option_that_is_none_is_refused(put):
    with pytest.raises(
        InputError, match=r"missing='skip' \(--missing\) is not one of refuse, drop"
    ):
        read(put(text()), GYRO, missing="skip")
    with pytest.raises(InputError, match="neither a point nor a comma"):
        read(put(text()), GYRO, decimal=";")
