"""A fitted device is no checked one; one that is not like the others is named, on the screen and in fleet.json.

A device is judged on its coefficients, on its noise, on what it lacks and on what it alone has; one fleet in a hundred
has an odd device by chance.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
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
def fleet(file: Path, tmp_path_factory) -> bc.BatchResult:
    return bc.fit_batch(MODEL, file)


def test_odd_devices_are_named_with_what_is_odd(fleet: bc.BatchResult, tmp_path) -> None:
    assert set(fleet.outliers) == {*ODD}
    assert bc.load_batch(fleet.save(tmp_path / "b.parquet")).outliers == fleet.outliers


KINDS = ("constant", "slope", "noise", "lacks", "has")
BENT = MODEL + "bias.temperature_quadratic" + "bias.temperature_cubic"


def bent_lot(seed: int, devices: int = 20, odd: bool = True) -> tuple[pd.DataFrame, dict[str, str]]:
    """Devices with a line and a bend of their own about common ones; the first five odd, a kind each."""
    rng, rows, kinds = np.random.default_rng(seed), [], dict[str, str]()
    for d in range(devices):
        kind = KINDS[d] if odd and d < len(KINDS) else ""
        kinds[f"D{d:02d}"] = kind
        warm = 30.0 * np.sin(np.linspace(0, 2 * np.pi, 60) + rng.uniform(-0.1, 0.1))
        warm += rng.normal(0, 0.2, 60)
        constant = 1.0 + 0.1 * rng.normal() + (kind == "constant")
        slope = 0.03 + 0.001 * rng.normal() + 0.01 * (kind == "slope")
        bend = (4e-4 + 4e-5 * rng.normal()) * (kind != "lacks")
        output = constant + slope * warm + bend * warm**2 + 1e-5 * (kind == "has") * warm**3
        output += rng.normal(0, 0.04 if kind == "noise" else 0.02, 60)
        frame = {"device": f"D{d:02d}", "time [s]": 60.0 * np.arange(60)}
        frame |= {"temperature [degC]": 25.0 + warm, "output [deg/s]": output}
        rows.append(pd.DataFrame(frame))
    return pd.concat(rows), kinds


def devices_of(lot: pd.DataFrame) -> dict[str, bc.Measurements]:
    return {
        str(name): bc.Measurements.from_arrays(
            mems_gyro.INSTRUMENT,
            temperature=own["temperature [degC]"].to_numpy(),
            output=own["output [deg/s]"].to_numpy(),
        )
        for name, own in lot.groupby("device")
    }


def test_five_kinds_of_oddness_are_found_among_twenty() -> None:
    """Seeds 0 to 7: 39 of 40 odd devices or more, and no other."""
    found, others = 0, 0
    for seed in range(8):
        lot, kinds = bent_lot(seed)
        odd = set(bc.fit_batch(BENT, devices_of(lot)).outliers)
        found += len(odd & {name for name, kind in kinds.items() if kind})
        others += len(odd & {name for name, kind in kinds.items() if not kind})
    assert found >= 39 and others <= 1


@pytest.mark.parametrize(
    ("fleets", "most"), [(20, 1), pytest.param(200, 6, marks=pytest.mark.slow)]
)
def test_one_plain_fleet_in_a_hundred_has_an_odd_device(fleets: int, most: int) -> None:
    """Of 200 fleets of 12 devices two are expected; more than six come by chance once in two hundred."""
    lots = (bent_lot(seed, devices=12, odd=False)[0] for seed in range(fleets))
    assert sum(bool(bc.fit_batch(BENT, devices_of(lot)).outliers) for lot in lots) <= most


@pytest.mark.slow
def test_of_searched_devices_what_one_lacks_and_what_one_has_is_odd(tmp_path: Path) -> None:
    """The model given has neither; the fleet has one of them, which one device lacks."""
    lot, kinds = bent_lot(3, devices=14)
    lot.to_parquet(tmp_path / "lot.parquet")
    found = bc.fit_batch(MODEL, tmp_path / "lot.parquet", find=True)
    assert set(found.outliers) == {name for name, kind in kinds.items() if kind}


def test_the_sd_in_the_population_is_without_what_readings_leave_open() -> None:
    """200 constants of sd 0.05 °/s, known to 0.2 °/s/√4 each."""
    rng, lot = np.random.default_rng(2), {}
    for d in range(200):
        output = 2.0 + rng.normal(0, 0.05) + rng.normal(0, NOISE, 4)
        temperature = np.array([10.0, 18.0, 22.0, 30.0])
        columns = {"temperature": temperature, "output": output}
        lot[f"D{d}"] = bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, **columns)
    model = MODEL.fix({"noise.white": NOISE})
    row = bc.fit_batch(model, lot).coefficients().set_index("coefficient").loc["bias.constant"]
    assert row["population sd"] == pytest.approx(0.05, abs=0.03)
    assert row["between devices"] == pytest.approx(np.hypot(0.05, 0.1), rel=0.15)


# A device that cannot be fitted is refused by itself and spoils no other.


def test_bad_devices_are_refused_by_themselves(tmp_path, result) -> None:
    made = table()
    first = made.groupby("device").head(1).index
    made = made.astype({"output [deg/s]": object})
    made.loc[first[2], "output [deg/s]"] = float("nan")
    made.loc[first[5], "output [deg/s]"] = "broken"
    made.loc[made.device == "D07", "temperature [degC]"] = 25.0
    made.loc[first[9], "temperature [degC]"] = 4000.0
    made = made.drop(made.index[made.device == "D11"][2:])  # two readings are left
    file = tmp_path / "lot.csv"
    made.to_csv(file, index=False)
    found = bc.fit_batch(MODEL, file)
    said = ("D02", "D05", "D07", "D09", "D11")
    for name in said:
        assert not found[name].ok
    good = sorted(n for n in result.devices if n not in said)
    assert [n for n in found.devices if found[n].ok] == good
    for name in good:
        np.testing.assert_allclose(found[name].mean, result[name].mean, rtol=1e-10)


def test_measurements_that_differ_do_not_stop_each_other(readings, result) -> None:
    lacking, broken = readings["D01"], readings["D02"]
    kept = {n: values for n, values in lacking.values.items() if n != "temperature"}
    lacking = dataclasses.replace(lacking, values=kept)
    broken = broken.with_column("output", np.where(np.arange(len(broken)) == 3, np.nan, 1.0))
    whole, last = readings["D00"], readings["D03"]
    given = {"whole": whole, "lacking": lacking, "broken": broken, "last": last}
    found = bc.fit_batch(MODEL, given)
    np.testing.assert_allclose(found["whole"].mean, result["D00"].mean, rtol=1e-12)
    np.testing.assert_allclose(found["last"].mean, result["D03"].mean, rtol=1e-12)


def test_a_file_that_cannot_be_read_stops_none_of_its_name(tmp_path, result) -> None:
    own = table(count=1).drop(columns="device")
    for folder in ("good", "broken"):
        (tmp_path / folder).mkdir()
    own.to_csv(tmp_path / "good" / "log.csv", index=False)
    (tmp_path / "broken" / "log.csv").write_text("no readings\n", "utf-8")
    found = bc.fit_batch(MODEL, tmp_path)
    assert found.devices == ("log",) and "log.csv" in found.file_errors
    np.testing.assert_allclose(found["log"].mean, result["D00"].mean, rtol=1e-10)
