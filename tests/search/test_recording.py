"""How an output was recorded: rounded, clipped, stuck, constant, with too few digits."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from bayescal_models.mems_gyro import INSTRUMENT


def test_noise_below_the_resolution_of_doubles_is_no_crash() -> None:
    readings = mems_gyro.simulate({}, seed=1)
    exact = 20.0 + 0.05 * (readings["temperature"] - 55.0)
    found = bc.fit(
        INSTRUMENT.baseline(),
        readings.with_column("output", exact),
        bc.LeastSquares(),
        strict=False,
    )
    assert np.mean(found.samples("bias.temperature")) == pytest.approx(0.05, rel=1e-9)


def test_a_rounded_output_is_said_and_nothing_finer_is_looked_for() -> None:
    readings = mems_gyro.simulate({"bias.thermal_lag": 0.05}, seed=1)
    coarse = readings.with_column("output", np.round(readings["output"]))
    trail = bc.calibrate(INSTRUMENT.baseline(), coarse, method=bc.LeastSquares())
    assert len(trail.steps) == 1 and not trail.ok
    fine = readings.with_column("output", np.round(readings["output"], 2))
    assert bc.calibrate(INSTRUMENT.baseline(), fine, method=bc.LeastSquares()).ok


@pytest.mark.slow
def test_clipped_readings_are_set_aside_and_said() -> None:
    readings = mems_gyro.simulate({}, seed=1)
    low, high = np.quantile(readings["output"], [0.1, 0.9])
    clipped = readings.with_column("output", np.clip(readings["output"], low, high))
    trail = bc.calibrate(INSTRUMENT.baseline(), clipped, method=bc.LeastSquares())
    kept = (readings["output"] > low) & (readings["output"] < high)
    assert len(trail.final.calibration.readings) == kept.sum()
    whole = bc.fit(INSTRUMENT.baseline(), readings, bc.LeastSquares())
    for name in ("bias.constant", "bias.temperature"):
        difference = np.mean(trail.final.calibration.samples(name)) - np.mean(whole.samples(name))
        assert abs(difference) < 3 * np.std(trail.final.calibration.samples(name))
    assert len(trail.steps) == 1


def test_an_output_that_stood_still_is_set_aside_and_said() -> None:
    readings = mems_gyro.simulate({}, seed=1)
    output = readings["output"].copy()
    output[40:70] = output[39]
    kept = bc.set_aside(readings.with_column("output", output))
    assert len(kept) == len(readings) - 30
    np.testing.assert_array_equal(kept["time"], np.delete(readings["time"], np.s_[40:70]))
    rounded = readings.with_column("output", np.round(output, 1))
    assert len(bc.set_aside(rounded)) == len(readings)


def test_an_output_of_too_few_digits_is_refused() -> None:
    readings = mems_gyro.simulate({}, seed=1)
    far = readings.with_column("output", readings["output"] + 1e14)
    with pytest.raises(bc.ModelError):
        bc.fit(INSTRUMENT.baseline(), far)
