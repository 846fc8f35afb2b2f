"""Three gyroscopes on a rate table: what is measured, what a mounting leaves open, what is found, what leaves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import gyro_triad
from bayescal_models.gyro_triad import Campaign
from bayescal_models.gyro_triad.simulator import BASELINE
from bayescal_models.triad.simulator import FACTORS
from tests.support.triad_truth import TRUE, matrix_of

INSTRUMENT = gyro_triad.INSTRUMENT
MODEL = INSTRUMENT.baseline()
THERMAL = Campaign(temperatures=(-20.0, 0.0, 25.0, 50.0, 70.0))


def stated(calibration: bc.Calibration, names: Any) -> tuple[np.ndarray, np.ndarray]:
    draws = np.stack([calibration.samples(name) for name in names])
    return draws.mean(axis=1), draws.std(axis=1)


def test_misalignments_are_known_as_well_as_the_mountings_are() -> None:
    """Forty rates about each axis leave 1 mrad of a mounting on the axes across, and hardly a ppm on the scale."""
    rates = tuple(float(r) for r in np.linspace(-100, 100, 40))
    campaign = Campaign(mountings=("x", "y", "z"), rates=rates)
    readings = gyro_triad.simulate(seed=2, campaign=campaign)
    mean, sd = stated(bc.fit(MODEL, readings), TRUE)
    assert np.all(np.abs(mean - list(TRUE.values())) < 4 * sd)
    assert np.allclose(sd[6:], 1.0, rtol=0.1)  # mrad
    assert np.all(sd[3:6] < 30)  # ppm


def test_readings_of_one_direction_are_of_one_mounting_unless_it_is_said() -> None:
    columns = dict(INSTRUMENT.simulator(seed=2))  # pyright: ignore[reportOptionalCall]
    del columns["mounting"]
    readings = bc.Measurements.from_arrays(INSTRUMENT, **columns)
    members, _ = readings.groups("mounting")
    assert tuple(sorted(members)) == (
        "about 0.000 0.000 1.000",
        "about 0.000 1.000 0.000",
        "about 1.000 0.000 0.000",
    )
    assert sorted(readings.groups("axis")[0]) == ["x", "y", "z"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("bias.g_sensitivity", 0.02),
        ("bias.thermal_lag", (0.0, 0.005, 0.0)),  # of one axis
        ("misalignment.temperature", 0.02),
        ("square.constant", 1.0),
    ],
)
def test_a_hidden_effect_is_found(name: str, size: Any) -> None:
    readings = gyro_triad.simulate({name: size}, seed=3, campaign=THERMAL)
    assert [e.name for e in bc.discover(bc.fit(MODEL, readings)).best] == [name]


@pytest.mark.slow
def test_no_effect_is_invented() -> None:
    readings = gyro_triad.simulate(seed=4, campaign=THERMAL)
    assert not bc.discover(bc.fit(MODEL, readings)).best


def test_corrected_rate_depends_on_gravity() -> None:
    readings = gyro_triad.simulate({"bias.g_sensitivity": 0.05}, seed=5, campaign=THERMAL)
    correct = bc.vector_correction(bc.fit(MODEL + "bias.g_sensitivity", readings))
    assert correct.secondary_columns == ("gravity_x", "gravity_y", "gravity_z")
    y, gravity = np.array([10.0, -50.0, 3.0]), np.array([0.1, -0.4, 0.9])
    with pytest.raises(bc.InputError):
        correct(y, temperature=40.0)
    found = correct(y, temperature=40.0, secondary_input=gravity)
    bias = np.array(BASELINE["bias.constant"]) + 0.05 * FACTORS.reshape(3, 3) @ gravity
    apart = found.vector[0] - np.linalg.solve(matrix_of(BASELINE), y - bias)
    assert apart @ np.linalg.solve(found.covariance[0], apart) < 16


def test_at_rest_the_bias_alone_is_measured() -> None:
    random = np.random.default_rng(1)
    given: dict[str, Any] = {
        f"output_{a}": b + 5e-3 * random.standard_normal(20)
        for a, b in zip("xyz", (0.1, 0.2, 0.3), strict=True)
    }
    calibration = bc.fit(MODEL, bc.Measurements.from_arrays(INSTRUMENT, **given))
    mean, sd = stated(calibration, [f"bias.constant[{a}]" for a in "xyz"])
    assert np.all(np.abs(mean - [0.1, 0.2, 0.3]) < 4 * sd)
