"""Outputs in m/s² divided by a local gravity that nobody stated: scale factors are as uncertain as gravity on Earth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import accelerometer_dividing_head, accelerometer_triad, ng_accelerometer
from bayescal_models.accelerometer_triad.simulator import BASELINE
from tests.support.tiers import slow_but

INSTRUMENT = accelerometer_triad.INSTRUMENT
MODEL = INSTRUMENT.baseline()
AXES = ("x", "y", "z")
RELATIVE = 0.052 / 12**0.5 / 9.80665  # rectangular over 9.780 to 9.832 m/s²
EARTH = (9.780, 9.80665, 9.832)  # m/s², at the equator, by convention, at a pole


def poses(gravity: float, seed: int = 3, **how: Any) -> bc.Measurements:
    """Poses of the simulated triad, in m/s²."""
    made = accelerometer_triad.simulate(seed=seed)
    columns: dict[str, Any] = {f"output_{a}": gravity * made[f"output_{a}"] for a in AXES}
    units = dict.fromkeys(columns, "m/s^2")
    return bc.Measurements.from_arrays(INSTRUMENT, units=units, **how, **columns)


def scales(calibration: bc.Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard uncertainties of the three scale factors, ppm."""
    draws = np.stack([calibration.samples(f"scale.constant[{a}]") for a in AXES])
    return draws.mean(axis=1), draws.std(axis=1)


@pytest.mark.parametrize("gravity", EARTH)
def test_scale_factors_hold_the_truth_anywhere_on_earth(gravity: float) -> None:
    fitted = bc.fit(MODEL, poses(gravity), bc.LeastSquares())
    mean, sd = scales(fitted)
    assert np.all(np.abs(mean - BASELINE["scale.constant"]) < 2.2 * sd)
    assert np.all(sd > 0.99e6 * RELATIVE)
    correct = bc.vector_correction(fitted)
    assert np.all(correct.uncertainty[0, [3, 7, 11]] > 0.99 * RELATIVE)
    # It is one factor: what is told of the axes beside each other stays as sharp.
    draws = np.stack([fitted.samples(f"scale.constant[{a}]") for a in AXES])
    assert np.std(draws[0] - draws[1]) < 400


def test_a_stated_gravity_leaves_nothing_uncertain() -> None:
    mean, sd = scales(bc.fit(MODEL, poses(9.832, local_gravity=9.832), bc.LeastSquares()))
    assert np.all(sd < 400)
    assert np.all(np.abs(mean - BASELINE["scale.constant"]) < 4 * sd)


def test_outputs_in_g_and_a_magnitude_in_the_outputs_own_unit_leave_nothing_uncertain() -> None:
    made = accelerometer_triad.simulate(seed=3)
    columns: dict[str, Any] = {f"output_{a}": 9.79 * made[f"output_{a}"] for a in AXES}
    columns["magnitude"] = 9.79
    stated = bc.Measurements.from_arrays(
        INSTRUMENT, units=dict.fromkeys(columns, "m/s^2"), **columns
    )
    for readings in (made, stated):
        assert np.all(scales(bc.fit(MODEL, readings, bc.LeastSquares()))[1] < 400)


@pytest.mark.parametrize(
    "module",
    slow_but([accelerometer_dividing_head], [accelerometer_dividing_head, ng_accelerometer]),
)
def test_one_axis_against_gravity_is_as_uncertain(module) -> None:
    made, instrument = module.simulate(seed=1), module.INSTRUMENT
    columns: dict[str, Any] = {name: made[name] for name in made.columns}
    columns["output"] = 1e-6 * 9.79 * made["output"]
    units = {name: unit for name in columns if (unit := made.unit(name))} | {"output": "m/s^2"}

    def sd(**how: Any) -> float:
        readings = bc.Measurements.from_arrays(instrument, units=units, **how, **columns)
        fitted = bc.fit(instrument.baseline(), readings, bc.LeastSquares())
        return float(fitted.samples("scale.constant").std())

    assert sd() == pytest.approx(np.hypot(sd(local_gravity=9.79), 1e6 * RELATIVE), rel=0.05)


def test_it_stays_in_files_of_readings_and_in_saved_calibrations(tmp_path: Path) -> None:
    readings = poses(9.80665)
    again = bc.read(readings.write(tmp_path / "poses.csv"), INSTRUMENT)
    assert any("--local-gravity" in flag for flag in readings.flags)
    fitted = bc.fit(MODEL, again, bc.LeastSquares())
    assert np.all(scales(fitted)[1] > 0.99e6 * RELATIVE)
    loaded = bc.load(fitted.save(tmp_path / "calibration.nc"))
    np.testing.assert_allclose(scales(loaded), scales(fitted))


def test_a_file_in_g_beside_one_in_metres_per_second_squared(tmp_path: Path) -> None:
    made = accelerometer_triad.simulate(seed=3)
    outputs = np.stack([made[f"output_{a}"] for a in AXES], axis=1)
    for name, unit, factor, rows in (
        ("a", "g", 1.0, outputs[:12]),
        ("b", "m/s^2", 9.8, outputs[12:]),
    ):
        header = ",".join(f"acc_{a} [{unit}]" for a in AXES)
        path = tmp_path / f"{name}.csv"
        np.savetxt(path, factor * rows, delimiter=",", header=header, comments="")
    readings = bc.read(sorted(tmp_path.glob("*.csv")), INSTRUMENT)
    sd = scales(bc.fit(MODEL, readings, bc.LeastSquares()))[1]
    assert np.all(sd < 1000)  # twelve poses in g tell local gravity
