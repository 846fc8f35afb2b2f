"""An output that follows the temperature of a die behind the thermometer: a line, a quadratic and one time constant."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import mems_gyro

GYRO = mems_gyro.INSTRUMENT
DIE = effects.die_temperature(
    "bias",
    0.05,
    "deg/s/degC",
    quadratic=5e-4,
    quadratic_unit="deg/s/degC^2",
    low=60.0,
    high=1200.0,
    start=0.1,
    start_unit="deg/s",
    source="none",
)
RUNS, HOURS, STEP, FINE = 3, 4, 60.0, 5.0  # s
LINE, QUADRATIC, DRIFT, NOISE = 0.05, 5e-4, 0.1, 0.05  # °/s/°C, °/s/°C², °/s over the record, °/s


def campaign(seed: int) -> tuple[bc.Measurements, float, float]:
    """Random profiles of temperature, the time constant of the die, s, and the quadratic's coefficient."""
    random = np.random.default_rng(seed)
    tau, quadratic = random.uniform(200.0, 700.0), QUADRATIC * random.choice([-1.0, 1.0])
    time = np.arange(0.0, HOURS * 3600, STEP)
    fine = np.arange(0.0, time[-1] + FINE, FINE)
    air, die = [], []
    for _ in range(RUNS):
        air.append(np.interp(fine, np.linspace(0, fine[-1], 9), random.uniform(-20.0, 70.0, 9)))
        behind = [air[-1][0]]
        for t in air[-1][1:]:
            behind.append(behind[-1] + (t - behind[-1]) * (1 - np.exp(-FINE / tau)))
        die.append(np.interp(time, fine, behind))
    clock = np.concatenate([time + i * (HOURS + 1) * 3600 for i in range(RUNS)])
    above = np.concatenate(die) - 25.0
    output = (
        1 + LINE * above + quadratic * above**2 + DRIFT * (clock - clock.mean()) / np.ptp(clock)
    )
    readings = bc.Measurements.from_arrays(
        GYRO,
        temperature=np.concatenate([np.interp(time, fine, a) for a in air]),
        output=output + random.normal(0, NOISE, clock.size),
        time=clock,
        run=np.repeat([f"run {i + 1}" for i in range(RUNS)], time.size),
    )
    return readings, tau, quadratic


def found(seed: int, **options: Any) -> tuple[bool, bool, bool]:
    """Whether it is found, and whether τ and the curvature lie inside their 95 % intervals; options of `calibrate`."""
    readings, tau, quadratic = campaign(seed)
    trail = bc.calibrate(GYRO.baseline(), readings, effects=[DIE], **options)
    last = trail.final.calibration
    if "bias.die_temperature" not in last.model.names:
        return False, False, False
    low, high = np.quantile(last.samples("bias.die_temperature.tau"), [0.025, 0.975])
    below, above = np.quantile(last.samples("bias.temperature_quadratic"), [0.025, 0.975])
    return True, low <= tau <= high, below <= quadratic <= above


def test_it_is_found_with_its_time_constant_and_curvature() -> None:
    """The noise is white, as it is; the slow test weighs the other laws too."""
    short = {"method": bc.LeastSquares(draws=400), "max_effects": 2, "widen_noise": False}
    assert found(2, **short) == (True, True, True)


@pytest.mark.slow
def test_it_is_found_in_twenty_campaigns() -> None:
    seen, tau, curvature = np.array([found(seed) for seed in range(100, 120)]).sum(axis=0)
    assert seen >= 18 and tau >= 0.93 * 20 - 1.5 and curvature >= 0.93 * 20 - 1.5
