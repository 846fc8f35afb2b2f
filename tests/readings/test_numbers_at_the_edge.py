"""Hold-out data that are readings of the fit are said to be so."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro, still_sensor
from tests.support.inside import said_of_holdout


@pytest.fixture(scope="module")
def readings() -> bc.Measurements:
    return still_sensor.simulate(seed=1)


def test_hold_out_data_that_are_the_readings(readings: bc.Measurements) -> None:
    later = readings.with_column("time", readings["time"] + 86400.0)
    renamed = readings.with_column("run", np.char.add("later ", readings["run"]))
    for holdout in (readings, later, renamed):
        assert f" {len(readings)} of the {len(readings)} " in said_of_holdout(readings, holdout)
    half = readings.select(np.arange(0, len(readings), 2))
    assert f" {len(half)} of the {len(half)} " in said_of_holdout(readings, half)


def test_hold_out_data_that_are_new(readings: bc.Measurements) -> None:
    assert said_of_holdout(readings, still_sensor.simulate(seed=2)) == ""
    rows = np.arange(len(readings)) % 2 == 0
    assert said_of_holdout(readings.select(rows), readings.select(~rows)) == ""
    rounded = readings.with_column("output", 1000 * np.rint(readings["output"] / 1000))
    rounded = rounded.with_column("temperature", 20 * np.rint(readings["temperature"] / 20))
    assert said_of_holdout(rounded, rounded) == ""  # equal numbers say nothing there


@pytest.mark.parametrize("step", [0.15, 0.05])
def test_other_readings_share_rounded_numbers_by_chance(step: float) -> None:
    def rounded(seed: int) -> bc.Measurements:
        found = mems_gyro.simulate(seed=seed)
        for name, to in (("output", step), ("temperature", 0.5), ("board_temperature", 0.5)):
            found = found.with_column(name, to * np.floor(found[name] / to))
        return found

    fitted = rounded(1)
    assert said_of_holdout(fitted, rounded(101)) == ""
    assert said_of_holdout(fitted, fitted.select(np.arange(200))) != ""
