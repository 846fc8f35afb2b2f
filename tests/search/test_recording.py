"""How an output was recorded: rounded, clipped, stuck, constant, with too few digits."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro, still_sensor
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
    assert bc.calibrate(INSTRUMENT.baseline(), fine, method=bc.LeastSquares(), max_effects=1).ok


def test_an_output_that_stood_still_is_set_aside_and_said() -> None:
    readings = mems_gyro.simulate({}, seed=1)
    output = readings["output"].copy()
    output[40:70] = output[39]
    kept = bc.exclude_faults(readings.with_column("output", output))
    assert len(kept) == len(readings) - 30
    np.testing.assert_array_equal(kept["time"], np.delete(readings["time"], np.s_[40:70]))
    rounded = readings.with_column("output", np.round(output, 1))
    assert len(bc.exclude_faults(rounded)) == len(readings)


def test_an_output_of_too_few_digits_is_refused() -> None:
    readings = mems_gyro.simulate({}, seed=1)
    far = readings.with_column("output", readings["output"] + 1e14)
    with pytest.raises(bc.ModelError):
        bc.fit(INSTRUMENT.baseline(), far)


# Whether a column was rounded or cut off no file tells: half a step, shared by all readings, is in coefficients.


QUICK = bc.LeastSquares(draws=400)
CONSTANT, SLOPE, NOISE = 2000.0, 40.0, 20.0  # of the simulator, µg and µg/°C


def fitted(readings: bc.Measurements) -> bc.Calibration:
    return bc.fit(still_sensor.INSTRUMENT.for_readings(readings).baseline(), readings, QUICK)


def off(calibration: bc.Calibration, name: str, true: float) -> float:
    values = calibration.samples(name)
    return float(abs(values.mean() - true) / values.std())


@pytest.mark.parametrize("cut", [np.floor, np.rint, np.ceil])
def test_thermometer_of_coarse_steps_widens_the_constant(cut) -> None:
    readings = still_sensor.simulate(seed=306, interval=30)
    coarse = readings.with_column("temperature", 0.5 * cut(readings["temperature"] / 0.5))
    found = fitted(coarse)
    constant = CONSTANT + SLOPE * (found.hold_at["T0"] - 27.0)
    assert off(found, "bias.constant", constant) < 3 and off(found, "bias.temperature", SLOPE) < 3
    least = SLOPE * 0.5 / np.sqrt(12.0)
    assert found.samples("bias.constant").std() == pytest.approx(least, rel=0.1)
    assert found.samples("bias.temperature").std() < 0.1


@pytest.mark.parametrize("cut", [np.floor, np.rint])
def test_output_of_coarse_steps_widens_the_constant(cut) -> None:
    readings, step = still_sensor.simulate(seed=3), 3.0 * NOISE
    found = fitted(readings.with_column("output", step * cut(readings["output"] / step)))
    constant = CONSTANT + SLOPE * (found.hold_at["T0"] - 27.0)
    assert off(found, "bias.constant", constant) < 3
    assert found.samples("bias.constant").std() == pytest.approx(step / np.sqrt(12.0), rel=0.1)


def test_what_fine_digits_and_set_points_say_stays_as_it_is() -> None:
    readings = still_sensor.simulate(seed=3)
    fine = readings.with_column("temperature", np.round(readings["temperature"], 3))
    plain, digits = fitted(readings), fitted(fine)
    assert digits.samples("bias.constant").std() == pytest.approx(
        plain.samples("bias.constant").std(), rel=0.05
    )
    points = readings.with_column("temperature", 10.0 * np.rint(readings["temperature"] / 10.0))
    assert fitted(points).samples("bias.constant").std() < 0.1 * SLOPE * 10.0 / np.sqrt(12.0)


def test_prediction_with_the_same_thermometer_is_as_good_as_before() -> None:
    readings = still_sensor.simulate(seed=306, interval=30)
    coarse = readings.with_column("temperature", 0.5 * np.floor(readings["temperature"] / 0.5))
    assert bc.predict(fitted(coarse)).model_sd.max() < 0.3 * NOISE
