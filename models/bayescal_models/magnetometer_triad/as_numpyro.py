"""Self-contained NumPyro model of three magnetometers turned in a constant field of unknown direction.

It is the model that `bc.fit(equivalent_model(), readings)` fits; `mems_gyro/as_numpyro.py` shows how to run NUTS on it.

In each reading the field m = F·u has the magnitude F and a latent direction u with a uniform prior:

    y = b + (1 + κ)·m + [γ_xy·m_y + γ_xz·m_z,  γ_yz·m_z,  0] + e,     e ~ N(0, σ²) in each axis,  all in µT

By convention the body's z axis is that of sensor z, and its y axis lies in the plane of the sensors y and z.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro.distributions import HalfCauchy, Normal

import bayescal as bc
from bayescal_models.magnetometer_triad.model import INSTRUMENT


def model(magnitude, output=None) -> None:
    """Define the NumPyro model: field magnitude µT (n,); outputs µT (n, 3), or None to simulate."""

    def sample_parts(name: str, labels: tuple[str, ...], sd: float) -> Any:
        return jnp.stack([numpyro.sample(f"{name}[{part}]", Normal(0.0, sd)) for part in labels])

    bias = sample_parts("bias.constant", ("x", "y", "z"), 50.0)  # µT
    kappa = 1e-6 * sample_parts("scale.constant", ("x", "y", "z"), 300_000.0)  # from ppm
    xy, xz, yz = 1e-3 * sample_parts("misalignment.constant", ("xy", "xz", "yz"), 100.0)  # mrad
    with numpyro.plate("readings", len(magnitude)):
        normal_vector = numpyro.sample("arrow", Normal(jnp.zeros(3), 1.0).to_event(1))
    m = magnitude[:, None] * normal_vector / jnp.linalg.norm(normal_vector, axis=1, keepdims=True)
    y, z = m[:, 1], m[:, 2]
    cross = jnp.stack([xy * y + xz * z, yz * z, 0.0 * z], axis=1)
    noise = numpyro.sample("noise.white", HalfCauchy(0.3))  # µT
    numpyro.sample("output", Normal(bias + (1 + kappa) * m + cross, noise).to_event(1), obs=output)


def model_arguments(readings: bc.Measurements) -> dict[str, Any]:
    """Return the arguments of `model` for these readings."""
    output = np.stack([readings[name] for name in INSTRUMENT.vector.outputs], axis=1)
    return {"magnitude": readings["magnitude"], "output": output}


equivalent_model = INSTRUMENT.baseline  # a sum of named effects with the same posterior
