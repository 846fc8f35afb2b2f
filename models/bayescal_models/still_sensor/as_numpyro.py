"""Self-contained NumPyro model of any sensor at rest, linear in temperature.

The model that `bc.fit(equal(), readings)` fits; `mems_gyro/as_numpyro.py` says how to run it.

Output y of reading i, µg; sizes are those of a plausible accelerometer on ramps:

    y_i = c0 + c1·(T_i − T0) + e_i,     e_i ~ N(0, σ²)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpyro
from numpyro.distributions import HalfCauchy, Normal

import bayescal as bc
from bayescal_models.still_sensor import reference_problem


def model(temperature, T0, output=None) -> None:
    """Define the model of temperatures °C (n,), T0 °C; output µg (n,), or None to simulate."""
    c0 = numpyro.sample("bias.constant", Normal(0.0, 5000.0))  # µg
    c1 = numpyro.sample("bias.temperature", Normal(0.0, 25.0))  # µg/°C
    noise = numpyro.sample("noise.white", HalfCauchy(100.0))  # µg
    numpyro.sample("output", Normal(c0 + c1 * (temperature - T0), noise), obs=output)


def data(readings: bc.Measurements) -> dict[str, Any]:
    """Return the readings as arguments of `model`."""
    temperature = readings["temperature"]
    T0 = np.round(temperature.mean())
    return {"temperature": temperature, "T0": T0, "output": readings["output"]}


equal = reference_problem.model  # the same model as a sum of named effects
