"""What cannot be used is refused, with the file, the row, the column and a way out: refused_files.txt."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

import bayescal as bc
from tests.support.golden import assert_golden
from tests.support.gyro_files import GOOD, GYRO, HEAD, Gyro

HEADERS = [
    "temperature [degC]\n20\n", "temprature [degC],output [V]\n20,1\n",
    "temperature,output [V]\n20,1\n", "temperature [furlong],output [V]\n20,1\n",
    "temperature [V],output [V]\n20,1\n", "temperature [K],output [Hz]\n20,1\n",
    "temperature [K],output [V],output [V]\n20,1,1\n",
    "temperature [K],output [V],output [mV]\n20,1,1\n",
    "run [s],temperature [K],output [V]\n1,20,1\n",
]  # fmt: skip
OPTIONS = [
    {"columns": {"output": "gyro"}},
    {"columns": {"output": "x"}},
    {"columns": {"output": "x", "rate_input": "x"}},
    {"units": {"outptu": "V"}},
    {"units": {"output": "volts!"}},
    {"units": {"output": "degC"}},
]
CELLS = [
    "b,5,30,abc", "b,5,30,", "b,5,nan,1", "b,5,30,inf", "b,5,30,1e999", "a,,30,1", ",0,30,1",
    "b,5,30,1_000", "b,5,-300,1", "a,-5,30,1", 'b,5,30,"1,5"', "a,0,30", "a,0,30,1,", "a,0,30,1,5",
    '"a,0,30,1', "a,0,30\r,1", "a\x07,5,30,1",
]  # fmt: skip
CONTENTS = [
    "", "\n \n", "# only a comment\n", HEAD, GOOD.encode("utf-16-le"),
    GOOD.encode() + b"a,0,3\x000,1\n", GOOD.replace("degC", "°Cé").encode("latin-1") + b"\x81",
    GOOD.replace("degC", "°C").encode() + b"caf\xe9,0,30,1\n", '"run,output [V]\n1,2\n',
]  # fmt: skip
NAMES = ["t.log", "t.xls", "t.xlsx", "t.mat", "t", "t.pkl", "t.npy", "t.parquet", "t.nc"]
ANGLES = "position_angle [rad],temperature [degC],output [V]\n"
DEVICES = "device,axis,time [s],temperature [degC],output [V]\n"
AXES = DEVICES + "1,x,0,20,1\n1,x,9,21,1\n1,y,0,22,1\n2,x,5,23,1\n1,x,9,24,1\n"
THOUSANDS = "temperature [degC];output [deg/s]\n20,500;1,500\n21,500;1,600\n"
MISSING = HEAD + "".join(f"a,{t},{20 + t},{1 + 0.1 * t:.1f}\n" for t in range(8))
OTHERS = [
    "temperature [degC],output [deg/s]\n20,1\n-,2\nthe door was open\n22,3\n",
    AXES + "1,y,-1,20,1\n",
    THOUSANDS,
    THOUSANDS.replace("1,500", "1,5").replace("20,500", "1.020,5"),
    *(ANGLES + "".join(f"{a * k},{20 + a / 10},1\n" for a in (0, 30, 270)) for k in (1, 3600)),
    "group,temperature [degC],output [V]\nouter,20,1\nouter,21,1\nmiddle,30,1\n",
    "temperature [degC],output [deg/s]\n20,1\n20.05,2\n",
    *(MISSING + f"a,8,28,{sign}999\n" for sign in ("-", "")),
]


def refusal(path, **options) -> str:
    with pytest.raises(bc.InputError) as refused:
        bc.read(path, GYRO, **options)
    return str(refused.value)


def test_unusable_file_is_refused(put, tmp_path) -> None:
    told: dict[str, str] = {}
    for text in [*HEADERS, *(GOOD + row + "\n" for row in CELLS), *CONTENTS, *OTHERS]:
        told[repr(text)] = refusal(put(text))
    for options in OPTIONS:
        path = put("temperature [degC],output [deg/s],x [deg/s]\n20,1,1\n30,2,2\n")
        told[repr(options)] = refusal(path, **options)
    for name in NAMES:
        told[name] = refusal(put(pickle.dumps(GOOD), name))
    told["no file"] = refusal([])
    told["no such file"] = refusal(tmp_path / "no.csv")
    told["a folder"] = refusal(tmp_path)
    huge = tmp_path / "huge.csv"
    with huge.open("wb") as handle:
        handle.truncate(10_000_000_000)  # sparse: takes no room
    told["10 GB"] = refusal(huge)
    told["more than max_bytes"] = refusal([put(GOOD), put(GOOD, "b.csv")], max_bytes=150)
    told = {title: said.replace(str(tmp_path), "FOLDER") for title, said in told.items()}
    assert_golden(Path(__file__).with_name("refused_files.txt"), told)


def test_time_may_begin_again_in_another_run_device_or_axis(put) -> None:
    assert len(bc.read(put(AXES), GYRO)) == 5


def test_a_decimal_comma_is_read_where_it_is_stated_or_plain(put) -> None:
    for read_so in (
        bc.read(put(THOUSANDS), GYRO, decimal=","),
        bc.read(put(THOUSANDS.replace("1,500", "1,5")), GYRO),
    ):
        assert read_so["temperature"].tolist() == [20.5, 21.5]


def test_one_temperature_only_is_read_where_asked_for(put) -> None:
    path = put("temperature [degC],output [deg/s]\n20,1\n20.05,2\n")
    assert len(bc.read(path, GYRO, allow_one_temperature=True)) == 2


def test_a_raw_output_without_a_nominal_scale_is_refused(put):
    path = put("temperature [degC],output [V]\n20,1\n30,2\n")
    with pytest.raises(bc.InputError):
        bc.read(path, Gyro(nominal_scale=None))
    with pytest.raises(bc.InputError):
        bc.NominalScale("V", gain=0.0)


@pytest.mark.parametrize("suffix", [".parquet", ".nc"])
def test_a_small_file_that_unpacks_to_much_is_refused(tmp_path, suffix):
    path = tmp_path / f"t{suffix}"
    if suffix == ".nc":
        data = xr.Dataset({"output": ("reading", np.zeros(10**6))})
        data.to_netcdf(path, engine="h5netcdf", encoding={"output": {"zlib": True}})
    else:
        pq.write_table(pa.table({"output": np.zeros(10**6)}), path)
    assert path.stat().st_size < 10**6
    with pytest.raises(bc.InputError):
        bc.read(path, GYRO, max_bytes=10**6)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_whatever_a_file_holds_it_is_read_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("any") / data.draw(
        st.sampled_from(["t.csv", "t.parquet", "t.nc"])
    )
    m = bc.Measurements.from_arrays(
        GYRO, temperature=[20, 30, 40], output=[1, 2, 3], run=["a", "b", "c"]
    )
    units = {"temperature": "temperature [degC]", "output": "output [deg/s]"}
    if path.suffix == ".csv":
        m.write(path)
    elif path.suffix == ".parquet":
        m.to_pandas().rename(columns=units).to_parquet(path)
    else:
        m.to_xarray().to_netcdf(path, engine="h5netcdf")
    whole = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(whole) - 1))
        whole[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    path.write_bytes(bytes(whole))
    try:
        m = bc.read(path, GYRO)
    except bc.InputError:
        return
    assert np.isfinite(m["output"]).all()
