"""Readings as others hold them: data frames of any library, arrays with units, and what comes back."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray

import bayescal as bc
from bayescal_models import mems_gyro

READINGS = mems_gyro.simulate(seed=1)
FRAME = READINGS.to_pandas()
COLUMNS = {name: READINGS[name] for name in READINGS.columns}


class Carried(SimpleNamespace):
    """A unit as pint or astropy has it."""

    def __str__(self) -> str:
        return self.text

    def __format__(self, how: str) -> str:
        return self.text


def pint(values: Any, unit: str, dimensionality: str = "") -> Any:
    units = Carried(text=unit, dimensionality=dimensionality)
    return SimpleNamespace(magnitude=values, units=units)


ASTROPY = Carried(text="rad / s", physical_type="angular speed")
RADIANS = np.radians(READINGS["output"])
HELD = {
    "pandas": FRAME,
    "pandas with an index": FRAME.set_index("time"),
    "xarray": READINGS.to_xarray().set_coords("time"),
    "pint": COLUMNS
    | {"output": pint(RADIANS, "rad/s"), "time": pint(READINGS["time"] / 60, "min")},
    "pint, warm": COLUMNS | {"temperature": pint(READINGS["temperature"], "°C")},
    "astropy": COLUMNS | {"output": SimpleNamespace(value=RADIANS, unit=ASTROPY)},
}


@pytest.mark.parametrize("held", HELD)
def test_readings_are_taken_as_they_are_held(held: str) -> None:
    taken = bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, HELD[held])
    assert {*taken.columns} == {*READINGS.columns}
    for name in ("time", "temperature", "output"):
        np.testing.assert_allclose(taken[name], READINGS[name], rtol=1e-12)
    assert list(taken["run"]) == list(READINGS["run"])


def test_a_gram_is_no_gravity() -> None:
    grams = pint(READINGS["output"], "gram", "[mass]")
    with pytest.raises(bc.InputError):
        bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, COLUMNS | {"output": grams})


def test_a_generator_seeds_and_a_covariance_is_of_the_draws(tmp_path: Path) -> None:
    model = mems_gyro.INSTRUMENT.baseline()
    drawn = bc.fit(model, READINGS, seed=np.random.default_rng(3))
    covariance, correlation = drawn.covariance, drawn.correlation
    np.testing.assert_array_equal(covariance, bc.fit(model, READINGS, seed=drawn.seed).covariance)
    sd = drawn.to_pandas()["sd"]
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), sd[covariance.index], rtol=1e-3)
    assert np.all(np.abs(correlation) <= 1 + 1e-12) and np.allclose(np.diag(correlation), 1)
    path = drawn.save(tmp_path / "gyro.nc")
    with xarray.open_datatree(path, engine="h5netcdf") as saved:
        assert saved.attrs["Conventions"].startswith("CF-")
        temperature = saved["constant_data/temperature"].attrs
        assert temperature["units"] == "degC" and temperature["long_name"]
