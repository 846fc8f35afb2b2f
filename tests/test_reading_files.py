"""What comes in at the door: read right, or refused with the file, the row, the column and a way out."""

from __future__ import annotations

import hashlib
import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from bayescal._errors import InputError
from bayescal._measurements import Column, Measurements, NominalScale
from bayescal._read import read


@dataclass(frozen=True)
class Gyro:
    name: str = "test_gyro"
    nominal_scale: NominalScale | None = NominalScale("V", gain=0.001, offset=1.2)
    columns: tuple[Column, ...] = (
        Column("run", None, "label of the run", required=False),
        Column("group", None, required=False, allowed=("outer", "inner")),
        Column("temperature_point", "degC", required=False),
        Column("time", "s", required=False),
        Column("temperature", "degC", "thermometer", low=-273.15, high=400.0),
        Column("lab_temperature", "degC", required=False),
        Column("position_angle", "rad", required=False, low=-6.3, high=6.3),
        Column("rate_input", "deg/s", required=False, default=0.0),
        Column("output", "deg/s"),
    )


GYRO = Gyro()
HEAD = "run,time [s],temperature [degC],output [deg/s]\n"
GOOD = HEAD + "a,0,20,1.5\na,10,25,1.6\nb,0,30,1.8\n"


@pytest.fixture
def put(tmp_path):
    """Write content under a name; the file's path."""

    def write(content: str | bytes, name: str = "t.csv") -> Path:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def refused(path, message: str, **options) -> None:
    with pytest.raises(InputError, match=message):
        read(path, GYRO, **options)


# --- what is read --------------------------------------------------------------------------------


def test_a_good_file_is_read_in_its_order_and_units(put):
    m = read(put(GOOD), GYRO)
    assert m.columns == ("run", "time", "temperature", "rate_input", "output")
    assert len(m) == 3 and m.file == "t.csv" and m.output == "output" and m.flags == ()
    assert m["run"].tolist() == ["a", "a", "b"] and m.unit("run") is None
    assert m["output"].tolist() == [1.5, 1.6, 1.8] and m.unit("output") == "deg/s"
    assert m["rate_input"].tolist() == [0, 0, 0]  # its default
    assert m.sources[0].sha256 == hashlib.sha256(GOOD.encode()).hexdigest()
    assert m.sources[0].rows == 3


def test_headers_carry_units_of_their_own(put):
    text = "time [h],temperature [°F],position_angle [deg],output [rad/s]\n1,68,180,1\n2,77,270,2\n"
    m = read(put(text), GYRO)
    np.testing.assert_allclose(m["time"], [3600, 7200])
    np.testing.assert_allclose(m["temperature"], [20, 25])
    np.testing.assert_allclose(m["position_angle"], [np.pi, 1.5 * np.pi])
    np.testing.assert_allclose(m["output"], np.degrees([1, 2]))


def test_columns_and_units_can_be_named_from_outside(put):
    path = put("t_s,temp,gyro_x\n0,20,1\n1,30,2\n")
    columns = {"time": "t_s", "temperature": "temp", "output": "gyro_x"}
    m = read(path, GYRO, columns=columns, units={"t_s": "s", "temperature": "degC", "gyro_x": "mV"})
    np.testing.assert_allclose(m["output"], [-1199, -1198])
    overruled = put("temperature [degC],output [deg/s]\n20,1\n30,2\n")
    m = read(overruled, GYRO, units={"output": "rad/s"})
    assert m["output"][0] == pytest.approx(np.degrees(1))
    assert any("taken as [rad/s], as units= says" in flag for flag in m.flags)


def test_raw_outputs_pass_through_the_nominal_scale_and_that_is_said(put):
    text = "temperature [degC],output [V],output_uncertainty [mV]\n20,1.203,2\n30,1.204,3\n"
    m = read(put(text), GYRO)
    np.testing.assert_allclose(m["output"], [3, 4], rtol=1e-12)
    np.testing.assert_allclose(m["output_uncertainty"], [2, 3])
    assert "turned into °/s by the nominal scale: (reading − 1.2)/0.001" in m.flags[0]
    other = read(put(text), GYRO, nominal_scale=NominalScale("mV", gain=2.0))
    np.testing.assert_allclose(other["output"], [601.5, 602])


def test_local_gravity_is_used_and_said(put):
    path = put("temperature [degC],output [deg/s],pull [m/s^2]\n20,1,9.81\n30,2,-9.81\n")
    m = read(path, GYRO, local_gravity=9.81)
    np.testing.assert_allclose(m["pull"], [1e6, -1e6])
    assert m.unit("pull") == "ug" and "turned into local g by 9.81 m/s²" in m.flags[0]


def test_further_columns_are_kept_if_sound_and_otherwise_flagged(put):
    text = (
        "temperature [degC],output [deg/s],humidity [%],note,p [hPa],q [foo],cell [1],\n"
        "20,1,40,x,1000,1,1,\n30,2,41,y,?,1,1,\n"
    )
    m = read(put(text), GYRO)
    np.testing.assert_allclose(m["humidity"], [0.4, 0.41])
    assert m.unit("humidity") == "1" and not {"p", "q", "note", "cell"} & set(m.columns)
    said = "\n".join(m.flags)
    for expected in (
        "'p [hPa]' ignored: row 3 reads '?'",
        "[foo] is no unit known here",
        "no unit: note, column 8, without a name",
        "the name 'cell' is taken",
    ):
        assert expected in said


def test_comments_blank_lines_and_quotes_leave_row_numbers_right(put):
    text = f'# made by "hand\n\n# 2nd\n{HEAD}a,0,20,1\n\n  \n"b, ""c""",0,25,2\n\n'
    m = read(put(text), GYRO)
    assert m["run"].tolist() == ["a", 'b, "c"']
    refused(put(text + "c,0,x,3\n"), r"row 10 of 't\.csv', column 'temperature \[degC\]'")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_byte_order_mark_and_line_ends_do_not_matter(put, end):
    text = "\ufeff" + "temperature [°C],output [°/s]\n20,1\n30,2\n".replace("\n", end)
    assert read(put(text), GYRO)["temperature"].tolist() == [20, 30]


@pytest.mark.parametrize("separator", [";", "\t"])
def test_semicolons_and_tabs_separate_as_well(put, separator):
    assert read(put(GOOD.replace(",", separator)), GYRO)["output"].tolist() == [1.5, 1.6, 1.8]


def test_an_empty_temperature_point_is_a_ramp(put):
    text = "temperature_point [degC],temperature [degC],output [deg/s]\n20,20,1\n,25,2\nnan,30,3\n"
    m = read(put(text), GYRO)
    np.testing.assert_array_equal(m["temperature_point"], [20, np.nan, np.nan])
    assert m.groups("cell")[1].tolist() == [0, -1, -1]


def test_an_optional_column_without_content_is_left_out(put):
    m = read(
        put("run,lab_temperature [degC],temperature [degC],output [V]\n,,20,1\n,,30,2\n"), GYRO
    )
    assert not m.has("run") and not m.has("lab_temperature")
    assert sum("is empty and was left out" in flag for flag in m.flags) == 2


def test_many_rows_are_checked_in_stretches(put, monkeypatch):
    monkeypatch.setattr("bayescal._read_csv._BLOCK", 64)
    monkeypatch.setattr("bayescal._read_csv._ROWS", 7)
    rows = [f"a,{i},{20 + i % 5},{i / 8}" for i in range(100)]
    m = read(put(HEAD + "\n".join(rows)), GYRO)
    np.testing.assert_array_equal(m["output"], np.arange(100) / 8)
    rows[61] = "a,61,20,1.2.3"
    refused(put(HEAD + "\n".join(rows)), r"row 63 of .* reads '1\.2\.3'")
    rows[61] = "a,61,20"
    refused(put(HEAD + "\n".join(rows)), "row 63 of 't.csv' has 3 fields, its header 4")
    refused(put(HEAD + "a" * 200), "row 2 of 't.csv' is longer than 64 bytes")


# --- what is refused: columns and units ----------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "temperature [degC]\n20\n",
            r"'t\.csv' lacks the column 'output'.* 'test_gyro' needs; it has: t",
        ),
        (
            "temprature [degC],output [V]\n20,1\n",
            r"\(is 'temprature \[degC\]' meant\?\).*--columns temp",
        ),
        (
            "temperature,output [V]\n20,1\n",
            r"column 'temperature': the header has no unit.*\(--unit",
        ),
        ("temperature [degc],output [V]\n20,1\n", r"'temperature \[degc\]': .*\(is degC meant\?\)"),
        (
            "temperature [V],output [V]\n20,1\n",
            r"its unit is \[V\], expected is one that converts to d",
        ),
        ("temperature [K],output [Hz]\n20,1\n", r"deg/s, or V, which the nominal scale converts"),
        ("temperature [K],output [V],output [V]\n20,1,1\n", "2 columns called 'output'"),
        ("temperature [K],output [V],output [mV]\n20,1,1\n", "2 columns called 'output'"),
        (
            "run [s],temperature [K],output [V]\n1,20,1\n",
            r"'run \[s\]' carries a unit, but 'run' is a l",
        ),
    ],
)
def test_headers_that_cannot_be_used_are_refused(put, text, message):
    refused(put(text), message)


def test_a_raw_output_without_a_nominal_scale_is_refused(put):
    path = put("temperature [degC],output [V]\n20,1\n30,2\n")
    with pytest.raises(InputError, match=r"\[V\], expected .* deg/s\..* Or give a nominal_scale"):
        read(path, Gyro(nominal_scale=None))
    with pytest.raises(InputError, match="the gain must be finite and not zero"):
        NominalScale("V", gain=0.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"columns": {"output": "gyro"}},
            r"columns=\{'output': 'gyro'\}: 't.csv' has no column 'gyro'",
        ),
        (
            {"columns": {"output": "x"}},
            r"two columns for 'output': 'output \[deg/s\]', and 'x \[deg/s\]'",
        ),
        ({"columns": {"output": "x", "rate_input": "x"}}, "to both 'output' and 'rate_input'"),
        ({"units": {"outptu": "V"}}, r"units=\{'outptu': 'V'\}.*\(is 'output \[deg/s\]' meant"),
        ({"units": {"output": "volts!"}}, r"column 'output \[deg/s\]': \[volts!\] is not a unit"),
        ({"units": {"output": "degC"}}, r"its unit is \[degC\]"),
    ],
)
def test_options_that_do_not_fit_the_file_are_refused(put, options, message):
    path = put("temperature [degC],output [deg/s],x [deg/s]\n20,1,1\n30,2,2\n")
    refused(path, message, **options)


# --- what is refused: cells ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            "a,0,30,abc",
            r"row 5 of 't\.csv', column 'output \[deg/s\]': reads 'abc', a number in °/s was",
        ),
        ("a,0,30,", r"row 5 .* is empty or NaN, a number in °/s was expected\. Fill it in"),
        ("a,0,nan,1", r"row 5 .*column 'temperature \[degC\]': is empty or NaN"),
        ("a,0,30,inf", "row 5 .* reads inf"),
        ("a,0,30,1e999", "row 5 .* reads inf"),
        ("a,,30,1", r"row 5 .*column 'time \[s\]': is empty or NaN"),
        (",0,30,1", "row 5 .*column 'run': is empty, a label was expected"),
        ("a,0,30,1_000", "row 5 .* reads '1_000'"),
        ("a,0,-300,1", r"row 5 .* reads -300 °C; plausible is -273\.15 … 400 °C\. Check the unit"),
        (
            "a,-5,30,1",
            r"row 5 .*column 'time': reads -5 s after 10 s in row 3 .* backwards within run a",
        ),
        (
            'a,0,30,"1,5"',
            "row 5 .* reads '1,5', .* decimal comma, export the file with decimal points",
        ),
        ("a,0,30", "row 5 of 't.csv' has 3 fields, its header 4: 'a,0,30'"),
        ("a,0,30,1,", "row 5 of 't.csv' has 5 fields, its header 4.*one field for each column"),
        (
            "a,0,30,1,5",
            "row 5 of 't.csv' has 5 fields.* decimal commas, export them with decimal p",
        ),
        ('"a,0,30,1', "row 5 of 't.csv' has a quotation mark without its pair"),
        ("a,0,30\r,1", "row 5 of 't.csv' holds a carriage return that ends no line"),
        ("a\x07,0,30,1", r"row 5 .* reads 'a\\x07', which holds a control character"),
    ],
)
def test_cells_that_cannot_be_used_are_refused_by_row_and_column(put, row, message):
    refused(put(GOOD + row + "\n"), message)


def test_time_may_begin_again_in_another_run_device_or_axis(put):
    text = "device,axis,time [s],temperature [degC],output [V]\n"
    good = text + "1,x,0,20,1\n1,x,9,21,1\n1,y,0,22,1\n2,x,5,23,1\n1,x,9,24,1\n"
    assert len(read(put(good), GYRO)) == 5
    refused(put(good + "1,y,-1,20,1\n"), "row 7 .* after 0 s in row 4 .* within device 1, axis y")


def test_semicolons_with_decimal_commas_are_refused(put):
    text = "temperature [degC];output [deg/s]\n20,5;1,5\n21,5;1,6\n"
    refused(put(text), "row 2 .*'temperature .* reads '20,5'.* export the file with decimal points")


@pytest.mark.parametrize(("unit", "factor"), [("deg", 1), ("arcsec", 3600)])
def test_an_angle_under_the_wrong_header_is_noticed(put, unit, factor):
    rows = "".join(f"{a * factor},{20 + a},1\n" for a in (0, 30, 270))
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
        put(text), "row 4 .*column 'group': reads 'middle', an unknown label; .* of outer, inner"
    )


@pytest.mark.parametrize("second", ["20", "20.05"])
def test_one_temperature_only_is_refused_unless_asked_for(put, second):
    path = put(f"temperature [degC],output [deg/s]\n20,1\n{second},2\n")
    refused(path, r"'temperature': reads 20( … 20\.05)? °C, one temperature only; at least two")
    assert len(read(path, GYRO, allow_one_temperature=True)) == 2


# --- what is refused: files ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", r"'t\.csv' is empty \(0 bytes\)"),
        ("\n \n", r"'t\.csv' is empty: a header"),
        ("# only a comment\n", r"'t\.csv' is empty: a header"),
        (HEAD, r"'t\.csv' holds no readings"),
        (GOOD.encode("utf-16"), r"'t\.csv' is UTF-16 text, UTF-8 was expected\. Save it as"),
        (GOOD.encode("utf-16-le"), r"row 1 of 't\.csv' holds a zero byte"),
        (GOOD.encode() + b"a,0,3\x000,1\n", r"row 5 of 't\.csv' holds a zero byte"),
        (GOOD.replace("degC", "°C").encode("latin-1"), r"row 1 .* not UTF-8: byte 27 .* is 0xb0"),
        (
            GOOD.encode() + b"caf\xe9,0,30,1\n",
            r"row 5 .* is not UTF-8: byte 4 of the row is 0xe9, after 'caf'",
        ),
        ('"run,output [V]\n1,2\n', "row 1 of 't.csv', the header, has a quotation mark without"),
    ],
)
def test_text_that_cannot_be_read_is_refused(put, content, message):
    refused(put(content), message)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("t.txt", r"'t\.txt': '\.txt' cannot be read\. Give one of \.csv, \.parquet, \.nc"),
        ("t", "'a file without a suffix' cannot be read"),
        ("t.pkl", r"'\.pkl' cannot be read\. Pickled objects are never read"),
        ("t.npy", "Pickled objects are never read"),
        ("t.parquet", "cannot be read as Parquet"),
        ("t.nc", "cannot be read as NetCDF-4"),
    ],
)
def test_formats_other_than_the_three_are_refused(put, name, message):
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
    m = Measurements.from_arrays(
        GYRO, temperature=[20, 30, 40], output=[1, 2, 3], run=["a", "b", "c"]
    )
    whole = bytearray(m.write(path).read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(whole) - 1))
        whole[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    path.write_bytes(bytes(whole))
    try:
        assert np.isfinite(read(path, GYRO)["output"]).all()
    except InputError as error:
        assert "t." in str(error)


# --- several files -------------------------------------------------------------------------------


BARE = "time [s],temperature [degC],output [deg/s]\n0,{},1\n1,{},2\n"


def test_several_files_are_runs_named_after_them(put):
    one, two = put(BARE.format(20, 21), "cold.csv"), put(BARE.format(30, 31), "warm.csv")
    m = read([one, two], GYRO)
    assert m["run"].tolist() == ["cold", "cold", "warm", "warm"] and m.file == "cold.csv and 1 more"
    assert [s.rows for s in m.sources] == [2, 2] and m["temperature"].tolist() == [20, 21, 30, 31]
    assert not read(one, GYRO).has("run")


def test_equal_stems_are_made_distinct(put):
    paths = [put(BARE.format(20 + i, 25), f"{d}/t.csv") for i, d in enumerate(("a", "b"))]
    paths.append(put(BARE.format(28, 29), "b/t.CSV"))
    m = read(paths, GYRO)
    assert m.groups("run")[0] == ("a/t", "b/t", "b/t (2)")
    named = put(
        "run," + BARE.format("x,20", "x,21").replace("\n0", "\nt,0").replace("\n1", "\nt,1")
    )
    named.write_text("run,temperature [degC],output [V]\nc,20,1\n")
    assert read([named, put(BARE.format(1, 2), "c.csv")], GYRO).groups("run")[0] == ("c", "file c")


def test_files_that_do_not_go_together(put):
    a = put("temperature [degC],output [V],lab_temperature [degC]\n20,1,23\n", "a.csv")
    b = put("temperature [degC],output [V]\n30,1\n", "b.csv")
    m = read([a, b], GYRO)
    assert not m.has("lab_temperature")
    assert any("'lab_temperature' left out: a.csv has it, b.csv has not" in f for f in m.flags)
    c = put("device,temperature [degC],output [V]\n1,30,1\n", "c.csv")
    refused(
        [a, c], r"'a\.csv' lacks the column 'device' that 'c\.csv' has: label every file, or none"
    )
    x = put("temperature [degC],output [V],p [V]\n20,1,23\n", "x.csv")
    y = put("temperature [degC],output [V],p [Pa]\n20,1,23\n", "y.csv")
    refused(
        [x, y], r"column 'p' is in Pa in 'y\.csv' and in V|column 'p' is in V in 'x\.csv' and in Pa"
    )
    refused([a, a], r"'a\.csv' was given 2 times")


def test_files_that_go_together_in_a_doubtful_way_are_flagged(put):
    text = "run,temperature [degC],output [V]\nr,{},1\n"
    a, b = put(text.format(20), "a.csv"), put(text.format(30), "b.csv")
    assert any(
        "run 'r' of b.csv is taken as the one of a.csv" in f for f in read([a, b], GYRO).flags
    )
    copy = put(text.format(20), "copy.csv")
    assert any(
        "copy.csv has the same content as a.csv" in f for f in read([a, b, copy], GYRO).flags
    )
    point = put("temperature_point [degC],temperature [degC],output [V]\n40,40,1\n", "point.csv")
    m = read([point, put("temperature [degC],output [V]\n30,1\n", "ramp.csv")], GYRO)
    assert m.groups("cell")[1].tolist() == [0, -1]
    assert any("ramp.csv: no 'temperature_point'" in f for f in m.flags)


def test_a_refusal_names_the_file_among_several(put):
    a, b = put(GOOD, "a.csv"), put(GOOD + "b,-1,20,1\n", "b.csv")
    with pytest.raises(
        InputError, match=r"row 2 of 'b\.csv', column 'time': reads 0 s after 10 s in row 3 of 'a"
    ):
        read([a, b], GYRO)


# --- what is flagged -----------------------------------------------------------------------------


def flags(**columns) -> str:
    return "\n".join(Measurements.from_arrays(GYRO, **columns).flags)


def test_repeated_rows_are_flagged(put):
    m = read(put(GOOD + "b,0,30,1.8\n"), GYRO)
    assert "1 row repeats an earlier one in every column, first at row 5 of 't.csv'" in m.flags


def test_a_saturated_output_is_flagged_and_a_rounded_one_is_not():
    rng = np.random.default_rng(1)
    x, t = rng.normal(size=500), np.linspace(20, 40, 500)
    said = flags(temperature=t, output=np.clip(x, None, 1.0))
    assert "'output' may be saturated" in said and "exactly at its maximum 1" in said
    assert "minimum -1" in flags(temperature=t, output=np.clip(x, -1.0, None))
    for rounded in (np.round(x, 1), np.round(x), np.sin(np.arange(500) * np.pi / 2), x):
        assert "saturated" not in flags(temperature=t, output=rounded)


def test_a_constant_column_is_flagged_unless_it_is_a_default():
    said = flags(temperature=[20.0, 30.0], output=[1.0, 2.0], lab_temperature=23.0)
    assert "column 'lab_temperature' is constant (23)" in said and "rate_input" not in said
