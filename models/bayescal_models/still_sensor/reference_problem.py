"""Reference problem (see `bayescal_models`) of the sensor at rest: a record on temperature ramps."""

from __future__ import annotations

import bayescal as bc
from bayescal_models.still_sensor.model import instrument, simulate

# Plausible sizes for an accelerometer on ramps, independent of the readings: µg, µg, °C, °C/min. Built once, because a
# new instrument object would be compiled again.
SENSOR = instrument("ug", size=1000.0, constant=5000.0, span=40.0, pace=3.0)


def model() -> bc.Model:
    """Return the baseline model, linear in temperature, of a sensor with output in µg."""
    return SENSOR.baseline()


def readings(seed: int = 0) -> bc.Measurements:
    """Simulate 82 readings, µg: two runs of ramps, one reading per minute, baseline effects only."""
    return simulate(seed=seed, runs=2, interval=60)
