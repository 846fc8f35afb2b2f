"""A gyro with an effect of the user's own, in air of changing humidity: what the tests of models share."""

from __future__ import annotations

import numpy as np

import bayescal as bc
from bayescal_models.mems_gyro import INSTRUMENT

BASELINE = INSTRUMENT.baseline()
HUMIDITY = bc.Effect(
    "bias.humidity",
    slot="bias",
    columns=("humidity",),
    basis=lambda r: r["humidity"] - 0.5,
    coefficients=(bc.Coefficient("deg/s/%", bc.Normal(0.0, 0.01)),),
    equation="c·(H − 50 %)",
)


def readings(rows: int = 12, **more) -> bc.Measurements:
    """Some readings of the gyro over temperature."""
    temperature = np.linspace(30.0, 80.0, rows)
    noise = 0.01 * np.cos(2.4 * np.arange(rows))
    columns = {"temperature": temperature, "output": 20 + 0.05 * temperature + noise, **more}
    return bc.Measurements.from_arrays(INSTRUMENT, **columns)
