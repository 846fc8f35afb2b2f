"""Readings once they are in: groups, selections, and files that hold exactly what was written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import xarray as xr
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import bayescal as bc
from tests.support.hostile_names import HOSTILE
from tests.support.inside import is_overload, to_one_line


@dataclass(frozen=True)
class Scale:
    name: str = "test_scale"
    nominal_scale: bc.NominalScale | None = None
    columns: tuple[bc.Column, ...] = (
        bc.Column("run", None, required=False),
        bc.Column("device", None, required=False),
        bc.Column("temperature_point", "degC", required=False),
        bc.Column("time", "s", required=False),
        bc.Column("angle", "rad", required=False),
        bc.Column("output", "ug"),
    )


SCALE = Scale()


def same(a: bc.Measurements, b: bc.Measurements) -> None:
    assert a.columns == b.columns
    for name in a.columns:
        assert a.unit(name) == b.unit(name)
        np.testing.assert_array_equal(a[name], b[name], strict=a.unit(name) is not None)


labels = st.text(st.characters(exclude_categories=["Cc", "Cs"]), min_size=1, max_size=8)
numbers = st.floats(allow_nan=False, allow_infinity=False).filter(  # no code of an overload
    lambda x: not is_overload(x)
)


@st.composite
def readings(draw) -> dict:
    n = draw(st.integers(1, 5))
    stripped = labels.map(str.strip).filter(bool)

    def column(values):
        return draw(st.lists(values, min_size=n, max_size=n))

    made = {"output": column(numbers), "angle": column(numbers), "run": column(stripped)}
    if draw(st.booleans()):
        made["device"] = column(stripped)
    if draw(st.booleans()):
        made["temperature_point"] = column(st.one_of(st.just(float("nan")), numbers))
        made["temperature_point"][0] = 20.0
    return made


@pytest.mark.slow
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(made=readings())
@example(made={"output": [1e308, -1e308, 1e308], "angle": [-1.7e308, 1.7e308, 0.0]})
def test_written_readings_are_read_back(tmp_path, made):
    m = bc.Measurements.from_arrays(SCALE, humidity=0.4, units={"humidity": "1"}, **made)
    path = m.write(tmp_path / "t.csv")
    same(bc.read(path, SCALE), m)
    assert [p.name for p in tmp_path.iterdir()] == ["t.csv"]  # nothing is left beside it


def test_parquet_of_others_is_read(tmp_path):
    path = tmp_path / "t.parquet"
    run = pa.array([1.0, 2.0, 2.0]).cast(pa.float32())
    table = pa.table({"run": run, "o.x": pa.array([1, 2, None]), "o": pa.array(["1.5", "2", "x"])})
    pq.write_table(table, path)
    with pytest.raises(bc.InputError):
        bc.read(path, SCALE, columns={"output": "o.x"}, units={"o.x": "mg"})
    with pytest.raises(bc.InputError):
        bc.read(path, SCALE, columns={"output": "o"}, units={"o": "mg"})
    pq.write_table(table.slice(0, 2), path)
    m = bc.read(path, SCALE, columns={"output": "o.x"}, units={"o.x": "mg"})
    assert m["output"].tolist() == [1000, 2000] and m["run"].tolist() == ["1", "2"]
    assert bc.read(path, SCALE, columns={"output": "o"}, units={"o": "ug"})["output"].tolist() == [
        1.5,
        2,
    ]
    when = pa.table({"output": pa.array([0, 1], pa.timestamp("s")), "flag": [True, False]})
    pq.write_table(when, path)
    with pytest.raises(bc.InputError):
        bc.read(path, SCALE, units={"output": "ug"})
    pq.write_table(when.drop_columns(["output"]), path)
    with pytest.raises(bc.InputError):
        bc.read(path, SCALE, columns={"output": "flag"}, units={"flag": "ug"})


def test_netcdf_of_others_is_read(tmp_path):
    path = tmp_path / "t.nc"
    data = xr.Dataset(
        {"output": ("time", [1.0, 2.0], {"units": "mg"}), "run": ("time", [1, 1]), "site": 5.0},
        coords={"time": ("time", [0, 1], {"units": "h"})},
    )
    data.to_netcdf(path, engine="h5netcdf")
    m = bc.read(path, SCALE)
    assert m["output"].tolist() == [1000, 2000] and m["time"].tolist() == [0, 3600]
    assert m["run"].tolist() == ["1", "1"]
    xr.Dataset({"output": ("a", [1.0]), "b": ("b", [1.0, 2.0])}).to_netcdf(path, engine="h5netcdf")
    with pytest.raises(bc.InputError):
        bc.read(path, SCALE)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(bc.InputError):
        bc.read(path, SCALE)


def test_any_name_of_a_column_is_written_and_read_back(tmp_path):
    m = bc.Measurements.from_arrays(SCALE, output=[1.0, 2.0])
    for name in HOSTILE:
        m = m.with_column(name, [3.0, 4.0], "V")
    back = bc.read(m.write(tmp_path / "t.csv"), SCALE)
    assert set(back.columns) >= set(map(to_one_line, HOSTILE))


def test_arrays_are_checked_as_files_are():
    m = bc.Measurements.from_arrays(
        SCALE, output=[1, 2], run="a", angle=[90, 180], units={"angle": "deg"}
    )
    np.testing.assert_allclose(m["angle"], [np.pi / 2, np.pi])
    assert m["run"].tolist() == ["a", "a"] and m.file == "the given arrays" and m.sources == ()
    assert m.columns == ("run", "angle", "output")  # in the instrument's order
    for columns in [
        {"output": [1.0, np.nan]},
        {"output": ["1", "x"]},
        {"output": [1.0], "angle": [1.0, 2.0]},
        {"output": []},
        {"angle": [1.0]},
        {"output": [1.0, 2.0], "time": [1.0, 0.0]},
        {"output": [1.0], "output_uncertainty": [-1.0]},
        {"output": [1.0], "run": ["\ud800"]},
    ]:
        with pytest.raises(bc.InputError):
            bc.Measurements.from_arrays(SCALE, **columns)


@pytest.fixture
def grouped() -> bc.Measurements:
    nan = float("nan")
    return bc.Measurements.from_arrays(
        SCALE,
        run=["b", "b", "b", "a", "a"],
        temperature_point=[30.0, 20.0, nan, 30.0, 30.0],
        output=[1.0, 2.0, 3.0, 4.0, 5.0],
    )


def test_groups_come_in_order_of_appearance(grouped):
    levels, codes = grouped.groups("run")
    assert levels == ("b", "a") and codes.tolist() == [0, 0, 0, 1, 1]
    levels, codes = grouped.groups("cell")
    assert levels == ("run b, 30 °C", "run b, 20 °C", "run a, 30 °C")
    assert codes.tolist() == [0, 1, -1, 2, 2]
    levels, codes = grouped.groups("reading")
    assert levels == ("1", "2", "3", "4", "5") and codes.tolist() == [0, 1, 2, 3, 4]
    assert grouped.groups("device") == (("1",), pytest.approx(np.zeros(5)))
    with pytest.raises(bc.InputError):
        grouped.groups("output")
    with pytest.raises(bc.InputError):
        grouped.groups("colour")


def test_some_of_the_readings_can_be_chosen(grouped):
    assert grouped.select(grouped["run"] == "a")["output"].tolist() == [4, 5]
    chosen = grouped.select([4, 0])
    assert chosen["output"].tolist() == [5, 1] and chosen.groups("run")[0] == ("a", "b")
    assert chosen.unit("output") == "ug" and not chosen["output"].flags.writeable
    with pytest.raises(bc.InputError):
        grouped.select([True, False])
    with pytest.raises(bc.InputError):
        grouped.select(np.zeros(5, dtype=bool))


def test_a_further_column_may_carry_its_unit_as_in_a_file():
    columns: dict[str, Any] = {"output": [1.0, 2.0], "humidity [%]": [45.0, 50.0]}
    m = bc.Measurements.from_arrays(SCALE, **columns)
    assert m.unit("humidity") == "1"
    np.testing.assert_allclose(m["humidity"], [0.45, 0.5])


def test_columns_come_as_a_mapping_behind_the_instrument():
    m = bc.Measurements.from_arrays(SCALE, {"output": [1.0, 2.0], "humidity [%]": [40.0, 41.0]})
    assert m.has("humidity") and len(m) == 2
