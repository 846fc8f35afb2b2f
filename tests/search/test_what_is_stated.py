"""What a search and a table of channels state is what they know."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro, still_sensor

QUICK = bc.LeastSquares(draws=200)


def search(most: int) -> bc.SearchPath:
    hidden = {"bias.thermal_lag": 0.05, "bias.temperature_quadratic": 5e-4}
    readings = mems_gyro.simulate(hidden, seed=3)
    model = mems_gyro.INSTRUMENT.baseline()
    return bc.calibrate(model, readings, method=QUICK, max_effects=most, widen_noise=False)


def channels() -> bc.Channels:
    """Two channels whose runs stand apart by fifty times their noise."""
    random = np.random.default_rng(2)
    runs, rows = 4, 60
    temperature = np.tile(np.linspace(20, 40, rows), runs)
    codes = np.repeat(np.arange(runs), rows)
    readings, models = {}, {}
    for name in ("acc_x", "acc_y"):
        apart = 50 * random.standard_normal(runs)
        output = apart[codes] + 2 * temperature + random.standard_normal(runs * rows)
        columns = {"time": 10.0 * np.arange(runs * rows), "run": [f"r{c}" for c in codes]}
        readings[name] = bc.Measurements.from_arrays(
            still_sensor.INSTRUMENT,
            units={"output": "ug"},
            temperature=temperature,
            output=output,
            **columns,
        )
        model = still_sensor.INSTRUMENT.for_readings(readings[name]).baseline()
        models[name] = model + "bias.run"
    return bc.calibrate_channels(models, readings, method=QUICK, max_effects=0, widen_noise=False)


def plateaus(temperatures: list[float]) -> bc.Measurements:
    random = np.random.default_rng(1)
    count = len(temperatures)
    temperature = np.repeat(temperatures, 20) + 0.01 * random.standard_normal(20 * count)
    return bc.Measurements.from_arrays(
        mems_gyro.INSTRUMENT,
        temperature=temperature,
        output=random.standard_normal(20 * count),
        run=np.repeat([f"r{i}" for i in range(count)], 20),
    )


@pytest.mark.parametrize(
    ("temperatures", "said"),
    [([20.0, 40.0, 60.0], True), ([20.0, 40.0, 20.0], False), ([20.0], False)],
)
def test_one_plateau_of_temperature_a_run_is_said_to_be_confounded(temperatures, said) -> None:
    ramps = len(temperatures) == 1
    readings = mems_gyro.simulate({}, seed=1) if ramps else plateaus(temperatures)
    flags = [f for f in readings.flags if "each run has one temperature of its own" in f]
    assert bool(flags) is said
