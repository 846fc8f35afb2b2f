"""A gate compares errors as the noise law weighs them, and blocks by what can be known of them; simulated, with truth.

A pressure transducer that scatters in proportion to its reading.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import mems_gyro, still_sensor

S = "ours"


def power(order: int, size: float, unit: str, name: str) -> bc.Effect:
    return bc.Effect(
        f"response.{name}",
        "response",
        basis=lambda r: r["pressure"] ** order,
        coefficients=(bc.Coefficient(unit, bc.Normal(0.0, size)),),
        columns=("pressure",),
        source=S,
    )


PRESSURE = bc.Instrument(
    name="meter",
    title="a meter beside a standard",
    columns=(bc.Column("pressure", "kPa"), bc.Column("output", "kPa")),
    slots=(bc.Slot("response", "kPa"),),
    response=lambda s, r: s["response"],
    effects=(effects.constant("response", 20.0, "kPa", source=S), power(1, 2.0, "1", "line")),
    candidates=(power(2, 1e-4, "kPa^-1", "quadratic"), power(3, 1e-6, "kPa^-2", "cubic")),
    noise=bc.White(bc.HalfCauchy(0.05)),
    use=bc.Use("pressure", "kPa"),
)


@pytest.mark.parametrize("seed", [1, *(pytest.param(s, marks=pytest.mark.slow) for s in (2, 3, 4))])
def test_proportional_noise_is_no_loss(seed) -> None:
    """0.2 % of the reading and 2 Pa, points in rising order: the last block decides an error without weights."""
    random = np.random.default_rng(seed)
    pressure = np.repeat([1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0], 6)
    scatter = np.hypot(0.002 * pressure, 0.002)
    output = 0.02 + 1.0025 * pressure + scatter * random.standard_normal(pressure.size)
    readings = bc.Measurements.from_arrays(PRESSURE, pressure=pressure, output=output)
    found = bc.calibrate(PRESSURE.baseline(), readings)
    assert found.gate.ok, found.gate.reason
    line = found.calibration.samples("response.line")
    assert line.mean() == pytest.approx(1.0025, abs=4 * line.std())


@pytest.mark.parametrize("method", [bc.LeastSquares(), bc.Marginal()])
def test_a_fit_says_that_readings_are_too_few(method) -> None:
    """As a search does: two readings determine two unknowns, and no noise."""
    readings = bc.Measurements.from_arrays(PRESSURE, pressure=[0.0, 200.0], output=[0.05, 199.65])
    found = bc.fit(PRESSURE.baseline(), readings, method, strict=False)
    assert [c.code for c in found.conflicts] == ["readings.too_few"]
    stated = bc.Measurements.from_arrays(
        PRESSURE, pressure=[0.0, 200.0], output=[0.05, 199.65], output_uncertainty=[0.1, 0.1]
    )
    known = bc.fit(PRESSURE.baseline().fix({"noise.white": 0.0}), stated, method, strict=False)
    assert known.conflicts == ()


# Correlated noise that is slow and large stands for something without a name, as a curve does.


QUICK: dict[str, Any] = {"method": bc.LeastSquares(draws=300)}
GYRO = mems_gyro.INSTRUMENT


def snapping(seed: int, kink: float) -> bc.Measurements:
    """Two hours up and down: a line and a quadratic at a body's temperature, and a kink at 52 °C, °/s."""
    random, time = np.random.default_rng(seed), np.linspace(0.0, 7200.0, 180)
    profile = np.array([0.0, 0.1, 0.45, 0.6, 0.9, 1.0]) * time[-1]
    temperature = 25 + np.interp(time, profile, [0, 0, 52, 52, -8, -8])
    kept, body = np.exp(-(time[1] - time[0]) / random.uniform(120, 500)), temperature.copy()
    for i in range(1, time.size):
        body[i] = temperature[i] + (body[i - 1] - temperature[i]) * kept
    output = 0.85 + 0.0155 * (body - 36) + 1.1e-4 * (body - 36) ** 2
    output = output + kink * np.tanh((body - 52) / 1.5) + 0.034 * random.standard_normal(time.size)
    temperature = temperature + 0.05 * random.standard_normal(time.size)
    columns: dict[str, Any] = {"time": time, "temperature": temperature, "output": output}
    return bc.Measurements.from_arrays(GYRO, run=np.full(time.size, "1"), **columns)


def wandering(readings: bc.Measurements) -> bc.Model:
    """The baseline with correlated noise."""
    time = readings["time"]
    law = bc.SummedNoise(float(time[1] - time[0]), float(np.ptp(time)), ("correlated",))
    return readings_model(readings).with_noise(law)


def readings_model(readings: bc.Measurements) -> bc.Model:
    instrument = GYRO if readings.unit("output") == "deg/s" else still_sensor.INSTRUMENT
    return instrument.for_readings(readings).baseline()


def codes(readings: bc.Measurements) -> set[str]:
    path = bc.calibrate(wandering(readings), readings, max_effects=0, **QUICK)
    return {claim.code for claim in path.gate.claims}


def test_kink_absorbed_by_noise_fails_acceptance() -> None:
    assert "noise.describes" in codes(snapping(2, 0.12))


def test_bias_instability_at_rest_is_noise() -> None:
    """Of a gyroscope at one reading in ten seconds: noise density 0.005 °/s/√Hz, a wander of 0.003 °/s."""
    random, time = np.random.default_rng(4), 10.0 * np.arange(400)
    wander, kept = np.zeros(time.size), np.exp(-10 / 600)
    for i in range(1, time.size):
        fresh = 0.003 * np.sqrt(1 - kept**2) * random.standard_normal()
        wander[i] = kept * wander[i - 1] + fresh
    output = wander + 0.005 / np.sqrt(10) * random.standard_normal(time.size)
    temperature = 25 + 0.3 * random.standard_normal(time.size)
    columns: dict[str, Any] = {"time": time, "temperature": temperature, "output": output}
    readings = bc.Measurements.from_arrays(GYRO, run=np.full(time.size, "1"), **columns)
    assert "noise.describes" not in codes(readings)


@pytest.mark.slow
def test_wander_of_a_still_sensor_is_noise() -> None:
    for seed in (1, 2):
        readings = still_sensor.simulate(seed=seed, noise_law="ornstein_uhlenbeck", interval=120)
        assert "noise.describes" not in codes(readings)


@pytest.mark.slow
def test_model_with_such_noise_is_not_complete() -> None:
    readings = snapping(2, 0.12)
    path = bc.calibrate(GYRO.baseline(), readings, **QUICK)
    found = path.final.discovery
    assert not path.ok and found is not None and found.unnamed
    assert found.nothing_missing is not None and found.nothing_missing < 0.5
