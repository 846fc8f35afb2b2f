"""Self-contained NumPyro model of any sensor at rest, linear in temperature.

It is the model that `bc.fit(equivalent_model(), readings)` fits; `mems_gyro/as_numpyro.py` shows how to run NUTS on it.

Output y, µg, of reading i; prior standard deviations are plausible for an accelerometer on ramps:

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
    """Define the NumPyro model: temperature °C (n,), T0 °C; output µg (n,), or None to simulate."""
    c0 = numpyro.sample("bias.constant", Normal(0.0, 5000.0))  # µg
    c1 = numpyro.sample("bias.temperature", Normal(0.0, 25.0))  # µg/°C
    noise = numpyro.sample("noise.white", HalfCauchy(100.0))  # µg
    numpyro.sample("output", Normal(c0 + c1 * (temperature - T0), noise), obs=output)


def model_arguments(readings: bc.Measurements) -> dict[str, Any]:
    """Return the arguments of `model` for these readings."""
    temperature = readings["temperature"]
    T0 = np.round(temperature.mean())
    return {"temperature": temperature, "T0": T0, "output": readings["output"]}


equivalent_model = reference_problem.model  # a sum of named effects with the same posterior
