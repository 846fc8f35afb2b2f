"""Self-contained NumPyro model of an accelerometer on a dividing head, linear in temperature.

It is the model that `bc.fit(equivalent_model(), readings)` fits; `mems_gyro/as_numpyro.py` shows how to run NUTS on it.

Output y, µg, with bias K0, scale factor deviation κ, their tempcos k0 and λ, set angle θ and zero ψ of the head:

    y = K0 + k0·(T − T0) + (1 + κ + λ·(T − T0))·g·sin(θ + ψ) + e,     e ~ N(0, σ²)
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro.distributions import HalfCauchy, Normal

import bayescal as bc
from bayescal_models.accelerometer_dividing_head import reference_problem

G = 1e6  # µg


def model(temperature, angle, T0, output=None) -> None:
    """Define the NumPyro model: temperature °C and angle rad (n,), T0 °C; output µg (n,), or None to simulate."""
    departure = temperature - T0
    k0 = numpyro.sample("bias.constant", Normal(0.0, 4000.0))  # µg
    k0 += numpyro.sample("bias.temperature", Normal(0.0, 30.0)) * departure
    kappa = numpyro.sample("scale.constant", Normal(0.0, 20000.0))  # ppm
    kappa += numpyro.sample("scale.temperature", Normal(0.0, 180.0)) * departure
    zero = numpyro.sample("zero.constant", Normal(0.0, 2000.0))  # µrad
    a = jnp.sin(angle + 1e-6 * zero)  # g
    noise = numpyro.sample("noise.white", HalfCauchy(10.0))  # µg
    numpyro.sample("output", Normal(k0 + (1 + 1e-6 * kappa) * G * a, noise), obs=output)


def model_arguments(readings: bc.Measurements) -> dict[str, Any]:
    """Return the arguments of `model` for these readings."""
    columns = {n: readings[n] for n in ("temperature", "output")}
    T0 = np.round(columns["temperature"].mean())
    return columns | {"angle": readings["position_angle"], "T0": T0}


equivalent_model = reference_problem.model  # a sum of named effects with the same posterior
