"""A calibration in which no temperature was recorded says so, and is used at any; one that has it says at which."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal_models import accelerometer_triad
from tests.support.export_check import VECTOR_DRIVER, needs_compiler, run_c
from tests.support.inside import text_of

INSTRUMENT = accelerometer_triad.INSTRUMENT


@cache
def correction(*temperatures: float) -> bc.VectorCorrection:
    """Of 24 poses, without a column `temperature` or with these, one after the other."""
    made = accelerometer_triad.simulate(seed=3, campaign=accelerometer_triad.Campaign(poses=24))
    given: dict[str, Any] = {f"output_{a}": made[f"output_{a}"] for a in "xyz"}
    if temperatures:
        given["temperature"] = np.resize(temperatures, len(made))
    readings = bc.Measurements.from_arrays(INSTRUMENT, **given)
    return bc.vector_correction(bc.fit(INSTRUMENT.baseline(), readings, bc.LeastSquares(draws=400)))


def outside(correct: bc.VectorCorrection, folder: Path, *temperatures: float) -> list[float]:
    """What the C header returns at these temperatures."""
    bc.export_vector(correct, folder / "sensor.h", name="sensor")
    given = "row, row[3], row[4], f, c"
    rows = np.array([[0.1, 0.2, 0.9, t, 0.0, 0.0] for t in temperatures])
    return run_c(VECTOR_DRIVER.format(given=given), rows, folder).reshape(-1, 13)[:, 12].tolist()


@needs_compiler
def test_c_takes_any_where_none_was_recorded(tmp_path: Path) -> None:
    assert outside(correction(), tmp_path, -40.0, 0.0, 25.0, 85.0) == [0, 0, 0, 0]
    assert outside(correction(24.0, 26.5), tmp_path, -40.0, 24.0, 25.0, 27.0) == [1, 0, 0, 1]


def test_python_says_what_c_says(tmp_path: Path) -> None:
    y = np.tile([0.1, 0.2, 0.9], (4, 1))
    assert not correction()(y, [-40.0, 0.0, 25.0, 85.0]).outside.any()
    at = [-40.0, 24.0, 25.0, 27.0]
    assert correction(24.0, 26.5)(y, at).outside.tolist() == [True, False, False, True]
    assert not correction(25.2, 25.4)(y).outside.any()  # T0 is 25
    for correct in (correction(), correction(24.0, 26.5)):
        loaded = bc.load_vector_correction(bc.export_vector(correct, tmp_path / "c.json"))
        assert np.array_equal(loaded(y, at).outside, correct(y, at).outside)
        space: dict[str, Any] = {}
        exec(text_of(correct, "python", name="s"), space)
        found = [space["s_correct"](y[0], t)[2] for t in at]
        assert found == correct(y, at).outside.tolist()
