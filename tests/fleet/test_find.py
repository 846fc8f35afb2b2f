"""Effects hidden in some devices of a fleet are found in these, and the fleet's table counts them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.inside import DeviceResult
from tests.support.made_up.gyro_lot import MODEL

HIDDEN = {"bias.thermal_lag": 0.05}  # °/s per °C
DEVICES, WITH = 6, (1, 4)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory) -> Path:
    """Simulated campaigns, thinned; two of them with a lag."""
    folder = tmp_path_factory.mktemp("fleet")
    for i in range(DEVICES):
        made = mems_gyro.simulate(HIDDEN if i in WITH else {}, seed=i)
        made.select(np.arange(0, len(made), 3)).write(folder / f"unit-{i}.csv")
    return folder


@pytest.mark.slow
def test_each_device_gets_the_effects_it_lacks(fleet, tmp_path) -> None:
    found = bc.fit_batch(MODEL, fleet, find=True)
    table = found.effects.set_index("effect")
    assert table.devices["bias.thermal_lag"] == len(WITH)
    assert table.devices.sum() == len(WITH)  # nothing else in any
    row = table.loc["bias.thermal_lag"]
    assert row.low < len(WITH) / DEVICES < row.high
    assert row.expected == pytest.approx(len(WITH), abs=0.3) and row["in fleet"] > 0.99
    rows = found.table()
    # in whichever form of the lag each device got
    delay = rows[rows.coefficient.str.match(r"bias\.thermal_lag.*\.tau$")]
    assert sorted(delay.device) == [f"unit-{i}" for i in WITH]
    back = bc.load_batch(found.save(tmp_path / "out.parquet"))
    pd.testing.assert_frame_equal(back.effects, found.effects)


@pytest.mark.slow
def test_a_time_limit_names_the_files_that_were_not_reached(fleet) -> None:
    found = bc.fit_batch(MODEL, fleet, time_limit=1e-6)
    assert 0 < found.fitted_count < DEVICES and len(found) + len(found.file_errors) == DEVICES


def test_a_device_unlike_the_others_is_named(tmp_path) -> None:
    rng, rows = np.random.default_rng(3), []
    for d in range(40):
        temperature = rng.uniform(-40, 85, 30)
        offset = 2.0 + rng.normal(0, 0.5) + 5.0 * (d == 17)
        output = offset + 0.03 * (temperature - 20.0) + rng.normal(0, 0.2, 30)
        named = {"device": f"D{d:02d}", "temperature [degC]": temperature}
        rows.append(pd.DataFrame({**named, "output [deg/s]": output}))
    pd.concat(rows).to_parquet(tmp_path / "lot.parquet")
    found = bc.fit_batch(MODEL, tmp_path / "lot.parquet")
    assert list(found.outliers) == ["D17"] and "bias.constant" in found.outliers["D17"][0]


def test_the_spread_in_the_population_is_of_devices_with_the_same_effects() -> None:
    """A device's temperature coefficient differs beside another effect, which alone explains the difference."""

    def device(name: str, *values: float) -> DeviceResult:
        names = ("bias.temperature", "bias.voltage")[: len(values)]
        covariance = 1e-4 * np.eye(len(values))
        return DeviceResult(name, "", names, ("K",) * len(values), np.array(values), covariance)

    values = (1.0, 1.01, 0.99, 1.0, 1.005)
    fits = (*(device(f"D{i}", v) for i, v in enumerate(values)), device("D9", 0.3, 0.7))
    found = bc.BatchResult(fits, {"method": "least-squares"})
    row = found.coefficients().set_index("coefficient").loc["bias.temperature"]
    assert row["population sd"] == 0 and row["between devices"] < 0.01 and row["devices"] == 5
    assert "D9: not in the rows of coefficients that all devices have" in str(found)
