"""The reference problem of a record on ramps, as described in `bayescal_models`."""

from __future__ import annotations

import bayescal as bc
from bayescal_models.still_sensor.model import instrument, simulate

# Sizes as of a plausible accelerometer on ramps, declared here so that no record has a say in them; made once,
# because an instrument made anew has programs of its own. µg, µg, °C, °C/min.
SENSOR = instrument("ug", size=1000.0, constant=5000.0, span=40.0, pace=3.0)


def model() -> bc.Model:
    """Return the baseline, a line over temperature, of a sensor whose output is in µg."""
    return SENSOR.baseline()


def readings(seed: int = 0) -> bc.Measurements:
    """Simulate 82 readings, µg: two runs of ramps, one reading a minute, with a line only."""
    return simulate(seed=seed, runs=2, interval=60)
