"""A thermometer's offset in each run and its delay are effects, which mend the temperature."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import still_sensor

QUICK = bc.LeastSquares(draws=200)
QUADRATIC = {"bias.temperature_quadratic": 0.4}


def fitted(readings: bc.Measurements, effect: bc.Effect) -> dict[str, tuple[float, float]]:
    model = still_sensor.INSTRUMENT.for_readings(readings).baseline()
    model = model + "bias.temperature_quadratic" + effect
    posterior = bc.fit(model, readings, QUICK).posterior
    return {
        str(n): (float(posterior[n].mean()), float(posterior[n].std()))
        for n in posterior
        if posterior[n].ndim == 2
    }


def test_an_offset_in_one_run_is_found_and_the_curve_is_right() -> None:
    readings = still_sensor.simulate(QUADRATIC, seed=2)
    warm = np.array(readings["temperature"])
    warm[readings["run"] == "3"] += 3.0
    spoilt = readings.with_column("temperature", warm)
    offset = effects.thermometer_offset(1.0, source="a re-seated thermometer")
    model = still_sensor.INSTRUMENT.for_readings(spoilt).baseline()
    found = bc.fit(model + "bias.temperature_quadratic" + offset, spoilt, QUICK)
    runs = found.posterior["temperature.run"].mean(("chain", "draw")).values
    assert runs[2] - 0.5 * (runs[0] + runs[1]) == pytest.approx(-3.0, abs=0.1)
    curve = found.samples("bias.temperature_quadratic")
    assert abs(curve.mean() - 0.4) < 4 * curve.std()


def test_a_late_thermometer_is_found_by_its_delay() -> None:
    readings = still_sensor.simulate(QUADRATIC, seed=2)
    late = np.array(readings["temperature"])
    for run in ("1", "2", "3"):
        rows, time = readings["run"] == run, readings["time"][readings["run"] == run]
        late[rows] = np.interp(time - 30.0, time, late[rows])
    spoilt = readings.with_column("temperature", late)
    found = fitted(spoilt, effects.thermometer_delay(60.0, source="a logger that asks in turn"))
    assert found["temperature.delay"][0] == pytest.approx(30.0, abs=3.0)
    assert found["bias.temperature"][0] == pytest.approx(40.0, abs=2.0)


def test_a_thermometer_that_is_right_has_neither() -> None:
    readings = still_sensor.simulate(QUADRATIC, seed=3)
    found = fitted(readings, effects.thermometer_delay(60.0, source="none"))
    mean, sd = found["temperature.delay"]
    assert abs(mean) < 4 * sd < 4.0
