"""What is read: columns, units, several files, and what is said of them without refusing."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro, ng_accelerometer, quartz_beam_accelerometer
from tests.support.gyro_files import GOOD, GYRO, HEAD, refused
from tests.support.inside import nominal_scale_of


def test_a_good_file_is_read_in_its_order_and_units(put):
    m = bc.read(put(GOOD), GYRO)
    assert m.columns == ("run", "time", "temperature", "rate_input", "output")
    assert len(m) == 3 and m.file == "t.csv" and m.output == "output" and m.flags == ()
    assert m["run"].tolist() == ["a", "a", "b"] and m.unit("run") is None
    assert m["output"].tolist() == [1.5, 1.6, 1.8] and m.unit("output") == "deg/s"
    assert m["rate_input"].tolist() == [0, 0, 0]  # its default
    assert m.sources[0].sha256 == hashlib.sha256(GOOD.encode()).hexdigest()
    assert m.sources[0].rows == 3


@pytest.mark.parametrize("order", ["in stretches", "alternating"])
def test_groups_are_numbered_as_they_appear(order):
    runs = ["b"] * 3 + ["a"] * 3 if order == "in stretches" else ["b", "a"] * 3
    m = bc.Measurements.from_arrays(GYRO, output=range(6), temperature=range(6), run=runs)
    assert m.groups("run")[0] == ("b", "a")
    assert m.groups("run")[1].tolist() == [int(run == "a") for run in runs]


def test_headers_carry_units_of_their_own(put):
    text = "time [h],temperature [°F],position_angle [deg],output [rad/s]\n1,68,180,1\n2,77,270,2\n"
    m = bc.read(put(text), GYRO)
    np.testing.assert_allclose(m["time"], [3600, 7200])
    np.testing.assert_allclose(m["temperature"], [20, 25])
    np.testing.assert_allclose(m["position_angle"], [np.pi, 1.5 * np.pi])
    np.testing.assert_allclose(m["output"], np.degrees([1, 2]))


def test_columns_and_units_can_be_named_from_outside(put):
    path = put("t_s,temp,gyro_x\n0,20,1\n1,30,2\n")
    columns = {"time": "t_s", "temperature": "temp", "output": "gyro_x"}
    m = bc.read(
        path, GYRO, columns=columns, units={"t_s": "s", "temperature": "degC", "gyro_x": "mV"}
    )
    np.testing.assert_allclose(m["output"], [-1199, -1198])
    overruled = put("temperature [degC],output [deg/s]\n20,1\n30,2\n")
    m = bc.read(overruled, GYRO, units={"output": "rad/s"})
    assert m["output"][0] == pytest.approx(np.degrees(1))
    assert any("read as [rad/s], as given by --unit" in flag for flag in m.flags)


def test_raw_outputs_pass_through_the_nominal_scale_and_that_is_said(put):
    text = "temperature [degC],output [V],output_uncertainty [mV]\n20,1.203,2\n30,1.204,3\n"
    m = bc.read(put(text), GYRO)
    np.testing.assert_allclose(m["output"], [3, 4], rtol=1e-12)
    np.testing.assert_allclose(m["output_uncertainty"], [2, 3])
    assert "by the nominal scale factor of test_gyro: (reading − 1.2)/0.001" in m.flags[0]
    other = bc.read(put(text), GYRO, nominal_scale=bc.NominalScale("mV", gain=2.0))
    np.testing.assert_allclose(other["output"], [601.5, 602])


def test_local_gravity_is_used_and_said(put):
    path = put("temperature [degC],output [deg/s],pull [m/s^2]\n20,1,9.81\n30,2,-9.81\n")
    m = bc.read(path, GYRO, local_gravity=9.81)
    np.testing.assert_allclose(m["pull"], [1e6, -1e6])
    assert m.unit("pull") == "ug" and "converted to units of g = 9.81 m/s²" in m.flags[0]


def test_further_columns_are_kept_if_sound_and_otherwise_flagged(put):
    text = (
        "temperature [degC],output [deg/s],humidity [%],note,p [hPa],q [foo],cell [1],\n"
        "20,1,40,x,1000,1,1,\n30,2,41,y,?,1,1,\n"
    )
    refused(put(text), r"'q \[foo\]'.*ends in \[foo\], which is not.*--ignore 'q \[foo\]'")
    m = bc.read(put(text), GYRO, ignore=["q [foo]"])
    np.testing.assert_allclose(m["humidity"], [0.4, 0.41])
    assert m.unit("humidity") == "1" and not {"p", "q", "note", "cell"} & set(m.columns)
    said = "\n".join(m.flags)
    for expected in (
        "'p [hPa]' ignored: row 3 reads '?'",
        "no unit: note, column 8, without a name",
        "the name 'cell' is reserved",
    ):
        assert expected in said


def test_comments_blank_lines_and_quotes_leave_row_numbers_right(put):
    text = f'# made by "hand\n\n# 2nd\n{HEAD}a,0,20,1\n\n  \n"b, ""c""",0,25,2\n\n'
    m = bc.read(put(text), GYRO)
    assert m["run"].tolist() == ["a", 'b, "c"']
    refused(put(text + "c,0,x,3\n"), r"row 10 of 't\.csv', column 'temperature \[degC\]'")


def test_an_empty_temperature_point_is_a_ramp(put):
    text = "temperature_point [degC],temperature [degC],output [deg/s]\n20,20,1\n,25,2\nnan,30,3\n"
    m = bc.read(put(text), GYRO)
    np.testing.assert_array_equal(m["temperature_point"], [20, np.nan, np.nan])
    assert m.groups("cell")[1].tolist() == [0, -1, -1]


def test_an_optional_column_without_content_is_left_out(put):
    m = bc.read(
        put("run,lab_temperature [degC],temperature [degC],output [V]\n,,20,1\n,,30,2\n"), GYRO
    )
    assert not m.has("run") and not m.has("lab_temperature")
    assert sum("is empty and ignored" in flag for flag in m.flags) == 2


BARE = "time [s],temperature [degC],output [deg/s]\n0,{},1\n1,{},2\n"


def test_several_files_are_runs_named_after_them(put):
    one, two = put(BARE.format(20, 21), "cold.csv"), put(BARE.format(30, 31), "warm.csv")
    m = bc.read([one, two], GYRO)
    assert m["run"].tolist() == ["cold", "cold", "warm", "warm"] and m.file == "cold.csv and 1 more"
    assert [s.rows for s in m.sources] == [2, 2] and m["temperature"].tolist() == [20, 21, 30, 31]
    assert not bc.read(one, GYRO).has("run")


def flags(**columns) -> str:
    return "\n".join(bc.Measurements.from_arrays(GYRO, **columns).flags)


def test_repeated_rows_are_dropped_where_the_time_tells_and_flagged(put):
    m, once = bc.read(put(GOOD + "b,0,30,1.8\n"), GYRO), bc.read(put(GOOD), GYRO)
    told = "1 row(s) repeat an earlier row in every column, first at row 5 of 't.csv'"
    assert f"{told}: dropped" in m.flags
    assert len(m) == len(once)
    no_time = bc.Measurements.from_arrays(
        GYRO, run=["a"] * 3, temperature=[20, 30, 30], rate_input=0, output=[1, 2, 2]
    )
    assert len(no_time) == 3
    assert any("1 row(s) repeat" in flag and "dropped" not in flag for flag in no_time.flags)


def test_a_saturated_output_is_flagged_and_a_rounded_one_is_not():
    rng = np.random.default_rng(1)
    x, t = rng.normal(size=500), np.linspace(20, 40, 500)
    said = flags(temperature=t, output=np.clip(x, None, 1.0))
    assert "'output' may be saturated" in said and "equal its maximum 1" in said
    assert "minimum -1" in flags(temperature=t, output=np.clip(x, -1.0, None))
    for rounded in (np.round(x, 1), np.round(x), np.sin(np.arange(500) * np.pi / 2), x):
        assert "saturated" not in flags(temperature=t, output=rounded)


def test_two_files_of_the_same_bytes_are_flagged(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("r.csv", "s.csv")]
    for path in paths:
        path.write_text("temperature [degC],output [deg/s]\n20,1.0\n30,1.5\n40,2.1\n", "utf-8")
    readings = bc.read(paths, GYRO)
    assert any("s.csv has the same content as r.csv" in flag for flag in readings.flags)


# A nominal scale and zero, as data sheets write them.


G = 1e6  # µg


def test_raw_outputs_are_read_by_a_scale_and_a_zero(tmp_path: Path) -> None:
    raw = tmp_path / "raw.csv"
    raw.write_text("temperature [degC],output [mV]\n20,1210\n30,1454\n")
    said = {"nominal_scale": "2.44 mV/(°/s)", "nominal_zero": "1.21 V"}
    found = bc.read(raw, mems_gyro.INSTRUMENT, **said)
    np.testing.assert_allclose(found["output"], [0.0, 100.0], atol=1e-12)


@pytest.mark.parametrize(
    ("instrument", "scale", "gain"),
    [
        (ng_accelerometer.INSTRUMENT, "250 V/g", 250 / G),
        (ng_accelerometer.INSTRUMENT, "25.4929 V/(m/s^2)", 25.4929 * 9.80665 / G),
        (ng_accelerometer.INSTRUMENT, "4 mg/V", 1 / 4e3),
        (mems_gyro.INSTRUMENT, "2.44 mV/°/s", 2.44),
        (mems_gyro.INSTRUMENT, "2.44mV/dps", 2.44),
        (mems_gyro.INSTRUMENT, "-131 LSB/(deg/s)", -131.0),
        (quartz_beam_accelerometer.INSTRUMENT, "37 Hz/g", 37 / G),
    ],
)  # fmt: skip
def test_it_is_read_as_data_sheets_write_it(instrument, scale, gain) -> None:
    made = nominal_scale_of(instrument, scale)
    assert made is not None and made.offset == 0
    np.testing.assert_allclose(made.gain, gain, rtol=1e-12)
