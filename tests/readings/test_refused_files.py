"""What cannot be used is refused, with the file, the row, the column and a way out."""

from __future__ import annotations

import pickle

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

import bayescal as bc
from tests.support.gyro_files import GOOD, GYRO, HEAD, Gyro, refused

# --- columns and units --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "temperature [degC]\n20\n",
            r"'t\.csv' lacks the column 'output'.* 'test_gyro' needs; it has: t",
        ),
        (
            "temprature [degC],output [V]\n20,1\n",
            r"temprature \[degC\] looks like it\..*\(--columns 'temperature=temprature \[degC\]'\)",
        ),
        (
            "temperature,output [V]\n20,1\n",
            r"column 'temperature': the header has no unit.*\(--unit",
        ),
        (
            "temperature [furlong],output [V]\n20,1\n",
            r"'temperature \[furlong\]': .* 'furlong' is none",
        ),
        (
            "temperature [V],output [V]\n20,1\n",
            r"its unit is \[V\], one that converts to degC was expected",
        ),
        ("temperature [K],output [Hz]\n20,1\n", r"deg/s, or V, which the nominal scale converts"),
        ("temperature [K],output [V],output [V]\n20,1,1\n", "2 columns called 'output'"),
        ("temperature [K],output [V],output [mV]\n20,1,1\n", "2 columns called 'output'"),
        (
            "run [s],temperature [K],output [V]\n1,20,1\n",
            r"'run \[s\]': carries the unit s, a label \(text\) as 'run' was",
        ),
    ],
)
def test_headers_that_cannot_be_used_are_refused(put, text, message):
    refused(put(text), message)


def test_a_raw_output_without_a_nominal_scale_is_refused(put):
    path = put("temperature [degC],output [V]\n20,1\n30,2\n")
    with pytest.raises(
        bc.InputError, match=r"\[V\], one .* deg/s was .* --nominal-scale '250 V/\(deg/s\)'"
    ):
        bc.read(path, Gyro(nominal_scale=None))
    with pytest.raises(bc.InputError, match="the gain must be finite and not zero"):
        bc.NominalScale("V", gain=0.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"columns": {"output": "gyro"}},
            r"'t.csv', column 'gyro': no such column, but --columns output=gyro",
        ),
        (
            {"columns": {"output": "x"}},
            r"'output \[deg/s\]': a second 'output' beside 'x \[deg/s\]', which",
        ),
        (
            {"columns": {"output": "x", "rate_input": "x"}},
            "'x': both output and rate_input by --columns",
        ),
        ({"units": {"outptu": "V"}}, r"--unit outptu=V.*\(is 'output \[deg/s\]' meant"),
        ({"units": {"output": "volts!"}}, r"column 'output \[deg/s\]': \[volts!\] is not a unit"),
        ({"units": {"output": "degC"}}, r"its unit is \[degC\]"),
    ],
)
def test_options_that_do_not_fit_the_file_are_refused(put, options, message):
    path = put("temperature [degC],output [deg/s],x [deg/s]\n20,1,1\n30,2,2\n")
    refused(path, message, **options)


def test_what_no_option_mends_is_said_beside_the_options(put):
    path = put("temperature [degC],output [deg/s]\n20,1\n-,2\nthe door was open\n22,3\n")
    refused(
        path,
        r"(?s)holds no number \(empty, NaN, - .*\n\nwith row 4 mended and these options, .*drop$",
    )


# --- cells --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            "b,5,30,abc",
            r"row 5 of 't\.csv', column 'output \[deg/s\]': reads 'abc', a number in °/s was",
        ),
        ("b,5,30,", r"row 5 .* holds no number .*, a number in °/s was expected\. Fill it in"),
        ("b,5,nan,1", r"row 5 .*column 'temperature \[degC\]': holds no number"),
        ("b,5,30,inf", "row 5 .* reads inf"),
        ("b,5,30,1e999", "row 5 .* reads inf"),
        ("a,,30,1", r"row 5 .*column 'time \[s\]': holds no number"),
        (",0,30,1", "row 5 .*column 'run': is empty, a label was expected"),
        ("b,5,30,1_000", "row 5 .* reads '1_000'"),
        ("b,5,-300,1", r"row 5 .* reads -300 °C; plausible is -273\.15 … 250 °C\. Check the unit"),
        (
            "a,-5,30,1",
            r"row 5 .*column 'time': reads -5 s after 10 s in row 3 .* backwards within run a",
        ),
        (
            'b,5,30,"1,5"',
            r"row 5 .* reads '1,5', .* decimal comma, say so \(--decimal ,\), or export",
        ),
        ("a,0,30", "row 5 of 't.csv': 3 fields, 'a,0,30', its header has 4"),
        ("a,0,30,1,", "row 5 of 't.csv': 5 fields, .*header has 4.*one field for each column"),
        (
            "a,0,30,1,5",
            "row 5 of 't.csv': 5 fields.* decimal commas, export them with decimal p",
        ),
        ('"a,0,30,1', "row 5 of 't.csv' has a quotation mark without its pair"),
        ("a,0,30\r,1", "row 5 of 't.csv' holds a carriage return that ends no line"),
        ("a\x07,5,30,1", r"row 5 .* reads 'a\\x07', which holds a control character"),
    ],
)
def test_cells_that_cannot_be_used_are_refused_by_row_and_column(put, row, message):
    refused(put(GOOD + row + "\n"), message)


def test_time_may_begin_again_in_another_run_device_or_axis(put):
    text = "device,axis,time [s],temperature [degC],output [V]\n"
    good = text + "1,x,0,20,1\n1,x,9,21,1\n1,y,0,22,1\n2,x,5,23,1\n1,x,9,24,1\n"
    assert len(bc.read(put(good), GYRO)) == 5
    refused(put(good + "1,y,-1,20,1\n"), "row 7 .* after 0 s in row 4 .* within device 1, axis y")


def test_a_comma_that_may_part_thousands_is_refused(put):
    text = "temperature [degC];output [deg/s]\n20,500;1,500\n21,500;1,600\n"
    refused(put(text), "temperature .*4? reads '20,500', '21,500'|2 problems")
    for read_so in (
        bc.read(put(text), GYRO, decimal=","),
        bc.read(put(text.replace("1,500", "1,5")), GYRO),
    ):
        assert read_so["temperature"].tolist() == [20.5, 21.5]
    thousands = text.replace("1,500", "1,5").replace("20,500", "1.020,5")
    refused(put(thousands), r"row 2 .* reads '1\.020,5'")


@pytest.mark.parametrize(("unit", "factor"), [("deg", 1), ("arcsec", 3600)])
def test_an_angle_under_the_wrong_header_is_noticed(put, unit, factor):
    rows = "".join(f"{a * factor},{20 + a / 10},1\n" for a in (0, 30, 270))
    message = (
        rf"row 3 .*'position_angle \[rad\]': reads {30 * factor} rad; plausible is -6\.3 … 6\.3 rad"
    )
    refused(put("position_angle [rad],temperature [degC],output [V]\n" + rows), message)
    if unit == "deg":
        refused(
            put("position_angle [rad],temperature [degC],output [V]\n" + rows),
            r"in deg\? Then write",
        )


def test_an_unknown_label_is_refused(put):
    text = "group,temperature [degC],output [V]\nouter,20,1\nouter,21,1\nmiddle,30,1\n"
    refused(
        put(text),
        "row 4 .*column 'group': reads 'middle', an unknown label, one of outer, inner was",
    )


@pytest.mark.parametrize("second", ["20", "20.05"])
def test_one_temperature_only_is_refused_unless_asked_for(put, second):
    path = put(f"temperature [degC],output [deg/s]\n20,1\n{second},2\n")
    refused(path, r"'temperature': reads 20( … 20\.05)? °C, one temperature only\. At least two")
    assert len(bc.read(path, GYRO, allow_one_temperature=True)) == 2


# --- files --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", r"'t\.csv' is empty \(0 bytes\)"),
        ("\n \n", r"'t\.csv' is empty: a header"),
        ("# only a comment\n", r"'t\.csv' is empty: a header"),
        (HEAD, r"'t\.csv' holds no readings"),
        (GOOD.encode("utf-16-le"), r"row 1 of 't\.csv' holds a zero byte"),
        (GOOD.encode() + b"a,0,3\x000,1\n", r"row 5 of 't\.csv' holds a zero byte"),
        (
            GOOD.replace("degC", "°Cé").encode("latin-1") + b"\x81",
            r"row 1 .* not UTF-8: byte 27 .* is 0xb0",
        ),
        (
            GOOD.replace("degC", "°C").encode() + b"caf\xe9,0,30,1\n",
            r"row 5 .* is not UTF-8: byte 4 of the row is 0xe9, after 'caf'",
        ),
        (
            '"run,output [V]\n1,2\n',
            "row 1 of 't.csv' has a quotation mark without its pair, in the header",
        ),
    ],
)
def test_text_that_cannot_be_read_is_refused(put, content, message):
    refused(put(content), message)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "t.log",
            r"'t\.log': '\.log' cannot be read\. Give one of \.csv, \.tsv, \.dsv, \.txt, \.lvm, \.dat, \.parquet, \.nc",
        ),
        ("t.xls", r"Save it as \.xlsx"),
        ("t.xlsx", "cannot be read as Excel|needs openpyxl"),
        ("t.mat", "cannot be read as MATLAB"),
        ("t", "'a file without a suffix' cannot be read"),
        ("t.pkl", r"'\.pkl' cannot be read\. Pickled objects are never read"),
        ("t.npy", "Pickled objects are never read"),
        ("t.parquet", "cannot be read as Parquet"),
        ("t.nc", "cannot be read as NetCDF-4"),
    ],
)
def test_other_formats_are_refused(put, name, message):
    refused(put(pickle.dumps(GOOD), name), message)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    refused(tmp_path / "no.csv", r"no\.csv' cannot be read: No such file.* Check the name")
    refused(tmp_path, "is not a file")
    refused([], "no file was given")


def test_a_huge_file_is_refused_before_it_is_opened(tmp_path, put):
    huge = tmp_path / "huge.csv"
    with huge.open("wb") as handle:
        handle.truncate(10_000_000_000)  # sparse: takes no room
    refused(huge, r"'huge\.csv' holds 10 GB, the limit is 2 GB, and nothing was loaded")
    refused(
        [put(GOOD), put(GOOD, "b.csv")], r"'b\.csv' brings the files to .* bytes", max_bytes=150
    )


@pytest.mark.parametrize("suffix", [".parquet", ".nc"])
def test_a_small_file_that_unpacks_to_much_is_refused(tmp_path, suffix):
    path = tmp_path / f"t{suffix}"
    if suffix == ".nc":
        data = xr.Dataset({"output": ("reading", np.zeros(10**6))})
        data.to_netcdf(path, engine="h5netcdf", encoding={"output": {"zlib": True}})
    else:
        pq.write_table(pa.table({"output": np.zeros(10**6)}), path)
    assert path.stat().st_size < 10**6
    refused(path, "holds 1000000 rows of 1 columns, .* the limit is", max_bytes=10**6)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_whatever_a_file_holds_it_is_read_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("any") / data.draw(
        st.sampled_from(["t.csv", "t.parquet", "t.nc"])
    )
    m = bc.Measurements.from_arrays(
        GYRO, temperature=[20, 30, 40], output=[1, 2, 3], run=["a", "b", "c"]
    )
    whole = bytearray(m.write(path).read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(whole) - 1))
        whole[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    path.write_bytes(bytes(whole))
    try:
        m = bc.read(path, GYRO)
    except bc.InputError:
        return
    assert np.isfinite(m["output"]).all()


@pytest.mark.parametrize("sign", ["-", ""])
def test_a_number_that_stands_for_a_missing_reading_is_refused(put, sign):
    rows = "".join(f"a,{t},{20 + t},{1 + 0.1 * t:.1f}\n" for t in range(8))
    with pytest.raises(
        bc.InputError, match=rf"row 10 of .*reads {sign}999, far from all other numbers"
    ):
        bc.read(put(HEAD + rows + f"a,8,28,{sign}999\n"), GYRO)
