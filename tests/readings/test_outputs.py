"""Several outputs of one file: the channels of a unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import still_sensor

INSTRUMENT = still_sensor.INSTRUMENT
TIME = np.arange(40) * 10.0
TEMPERATURE = 20 + 0.125 * TIME


def unit(folder: Path, head: str = "time [s],temperature [degC],gyro_x [deg/s],acc_x [ug]") -> Path:
    path = folder / "unit.csv"
    table = np.column_stack([TIME, TEMPERATURE, 0.5 + 0.25 * TIME, 3.0 - TIME])
    np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.9g")
    return path


def test_each_output_is_read_in_its_own_unit_and_the_others_are_no_covariates(tmp_path) -> None:
    found = bc.read(unit(tmp_path), INSTRUMENT, outputs=["gyro_x", "acc_x"])
    assert list(found) == ["gyro_x", "acc_x"]
    np.testing.assert_array_equal(found["gyro_x"]["output"], 0.5 + 0.25 * TIME)
    np.testing.assert_array_equal(found["acc_x"]["output"], 3.0 - TIME)
    assert [one.unit("output") for one in found.values()] == ["deg/s", "ug"]
    assert all(set(one.columns) == {"time", "temperature", "output"} for one in found.values())


def test_units_may_be_given_for_all_of_them(tmp_path) -> None:
    path = unit(tmp_path, "time [s],temperature [degC],gyro_x,acc_x")
    units = {"gyro_x": "rad/s", "acc_x": "mg"}
    found = bc.read(path, INSTRUMENT, outputs=["gyro_x", "acc_x"], units=units)
    np.testing.assert_allclose(found["gyro_x"]["output"], np.rad2deg(0.5 + 0.25 * TIME), rtol=1e-12)
    np.testing.assert_allclose(found["acc_x"]["output"], 1e3 * (3.0 - TIME), rtol=1e-12)


def test_what_is_wrong_with_all_outputs_is_said_at_once_and_no_sentence_twice(tmp_path) -> None:
    path = unit(tmp_path, "time [s],temperature [degF2],gyro_x [m],acc_x")
    with pytest.raises(bc.InputError) as refused:
        bc.read(path, INSTRUMENT, outputs=["gyro_x", "acc_x", "gyro_z"])
    said = [str(problem) for problem in refused.value.problems]
    assert len(said) == len(set(said))
    for word in ("temperature", "acc_x", "gyro_z"):
        assert any(word in one for one in said), (word, said)
