"""A fitted device is no checked one; one that is not like the others is named, on the screen and in fleet.json."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import bayescal as bc
from bayescal._annexes.fleet.batch_result import printed
from bayescal._annexes.fleet.find_devices import Share
from bayescal._annexes.fleet.odd_devices import Values, odd_effects, odd_values
from tests.support.command_line import GYRO, needs_installation, run
from tests.support.made_up.gyro_lot import MODEL, NOISE, table

ODD = ("D03", "D07", "D11")  # by its constant; its noise; where it was measured


@pytest.fixture(scope="module")
def lot() -> pd.DataFrame:
    made = table(count=40)
    rng = np.random.default_rng(5)
    temperature, output = "temperature [degC]", "output [deg/s]"
    made.loc[made.device == ODD[0], output] += 30.0
    noisy = made.device == ODD[1]
    made.loc[noisy, output] += rng.normal(0, 8 * NOISE, noisy.sum())
    made.loc[made.device == ODD[2], temperature] += 60.0
    return made


@pytest.fixture(scope="module")
def file(lot: pd.DataFrame, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("odd") / "lot.parquet"
    lot.to_parquet(path)
    return path


@pytest.fixture(scope="module")
def fleet(file: Path, tmp_path_factory) -> bc.FleetResult:
    return bc.fit_batch(MODEL, file, out=tmp_path_factory.mktemp("fleet") / "out")


def test_fitted_is_one_thing_and_checked_another(file: Path, fleet: bc.FleetResult) -> None:
    for found in (fleet, bc.fit_batch(MODEL, file)):
        said = str(found)
        assert "40 devices, 40 fitted (least-squares)\n" in said
        assert "fitted is not checked" in said and "reliable" not in said
    assert (fleet.fitted, fleet.checked) == (40, 0)


def test_odd_devices_are_named_with_what_is_odd(
    file: Path, fleet: bc.FleetResult, tmp_path
) -> None:
    batch = bc.fit_batch(MODEL, file)
    assert set(fleet.odd) == {*ODD}
    assert fleet.odd == batch.odd == bc.load_batch(batch.save(tmp_path / "b.parquet")).odd
    assert fleet.odd[ODD[0]][0].startswith("bias.constant 3")
    assert fleet.odd[ODD[1]][0].startswith("noise.white 1")
    assert "measured about 8" in fleet.odd[ODD[2]][0]
    for found in (fleet, batch, bc.load_fleet(fleet.folder)):
        said = str(found)
        assert "3 of 40 devices are not like the others:" in said
        assert all(f"  {name}: " in said for name in ODD)


@needs_installation
def test_the_command_names_them(file: Path) -> None:
    done = run("batch", file, *GYRO, "--out", file.parent / "results.parquet", "--json")
    assert done.status == 0, done.err
    assert set(done.data["odd"]) == {*ODD}
    assert done.data["checked"] == 0 and done.data["not_fitted"] == []


def test_fleet_json_holds_no_bare_nan(fleet: bc.FleetResult) -> None:
    def refuse(token: str) -> None:
        raise AssertionError(f"{token} is no JSON")

    text = (fleet.folder / "fleet.json").read_text("utf-8")
    told = json.loads(text, parse_constant=refuse)
    (noise,) = (row for row in told["coefficients"] if row["coefficient"] == "noise.white")
    assert noise["typical sd"] is None  # held at its estimate
    assert set(told["odd"]) == {*ODD} and told["checked"] == 0
    again = bc.load_fleet(fleet.folder)
    pd.testing.assert_frame_equal(again.table, fleet.table)
    assert str(again) == str(fleet)


def test_results_of_a_version_before_are_read(fleet: bc.FleetResult, tmp_path) -> None:
    told = json.loads((fleet.folder / "fleet.json").read_text("utf-8"))
    told["trusted"] = told.pop("fitted")
    del told["checked"], told["odd"]
    (tmp_path / "fleet.json").write_text(json.dumps(told), "utf-8")
    assert bc.load_fleet(tmp_path).fitted == 40


def test_a_fleet_of_like_devices_has_no_odd_one() -> None:
    """Of 400 fleets of 8 to 60 devices, few readings and many, about one in a hundred."""
    rng, named = np.random.default_rng(9), 0
    for _ in range(400):
        count = int(rng.integers(8, 61))
        devices = [f"D{i}" for i in range(count)]
        sd, readings = rng.uniform(0.1, 2.0, count), rng.integers(6, 200, count)
        facts = pd.DataFrame({"readings": readings, "T0": 25.0 + rng.integers(-1, 2)}, devices)
        noise = np.exp(rng.normal(0, 0.1, count)) * np.sqrt(
            rng.chisquare(readings - 2) / (readings - 2)
        )
        values = {
            "bias.constant": Values(devices, rng.normal(0, np.hypot(1.0, sd)), sd, "deg/s"),
            "noise.white": Values(devices, noise, np.full(count, np.nan), "deg/s"),
        }
        named += bool(odd_values([*values], values.__getitem__, facts))
    assert named <= 12


def test_devices_with_an_effect_that_few_have_are_named() -> None:
    names = [f"D{i}" for i in range(20)]
    has, lacks, some = np.zeros(20), np.ones(20), np.ones(20)
    has[4], lacks[7], some[:9] = 0.99, 0.01, 0.0
    shares = {
        "bias.lag": Share(1.0, 0.06, 0.0, 0.2, 1.0, has),
        "bias.curve": Share(1.0, 0.95, 0.8, 1.0, 19.0, lacks),
        "bias.drift": Share(1.0, 0.5, 0.3, 0.7, 11.0, some),
    }
    assert odd_effects(names, shares) == {
        "D4": ["has bias.lag, as about 1 of 20 devices"],
        "D7": ["lacks bias.curve, which about 19 of 20 devices have"],
    }


def test_a_curve_is_one_line_of_a_table() -> None:
    curve = [f"unknown(humidity)[{i}]" for i in range(1, 27)]
    own = ["unknown(humidity).length", "unknown(humidity).amplitude"]
    other = ["bias.constant", "bias.run(1)", "bias.lag[start](1)", "unknown(time, step)"]
    rows = pd.DataFrame({"coefficient": [*other, *curve, *own], "mean": 1.0})
    shown = printed(rows, 3).splitlines()
    assert len(shown) == 1 + len(other) + 1
    assert any("unknown(humidity), a curve (rms)" in line for line in shown)
