"""A lot of made-up gyros, each with a line of its own about a common one."""

from __future__ import annotations

import numpy as np
import pandas as pd

from bayescal_models import mems_gyro

MODEL = mems_gyro.INSTRUMENT.baseline()
SEED, COUNT, NOISE = 11, 24, 0.2


def table(seed: int = SEED, count: int = COUNT, least: int = 12, most: int = 30) -> pd.DataFrame:
    """Devices with lines of their own about a common one; other numbers of readings each."""
    rng = np.random.default_rng(seed)
    rows = []
    for d in range(count):
        n = int(rng.integers(least, most + 1))
        temperature = rng.uniform(-40, 85, n)
        constant, slope = rng.normal(2.0, 1.5), rng.normal(0.03, 0.01)
        output = constant + slope * (temperature - 20.0) + rng.normal(0, NOISE, n)
        frame = {"device": f"D{d:02d}", "temperature [degC]": temperature, "output [deg/s]": output}
        rows.append(pd.DataFrame(frame))
    return pd.concat(rows, ignore_index=True)
