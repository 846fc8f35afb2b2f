"""Self-contained NumPyro model of three magnetometers turned in a constant field of unknown direction.

The model that `bc.fit(equal(), readings)` fits; `mems_gyro/as_numpyro.py` says how to run it.

In each reading the field of magnitude F points along a latent unit vector u with a uniform prior; m = F·u:

    y = b + (1 + κ)·m + [γ_xy·m_y + γ_xz·m_z,  γ_yz·m_z,  0] + e,     e ~ N(0, σ²) in each axis,  all in µT

The z axis of the body is that of the sensor z, its y axis in the plane of the sensors y and z.
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
    """Define the model of F of each reading µT (n,); output µT (n, 3), or None to simulate."""

    def sample_each(name: str, parts: tuple[str, ...], size: float) -> Any:
        return jnp.stack([numpyro.sample(f"{name}[{part}]", Normal(0.0, size)) for part in parts])

    bias = sample_each("bias.constant", ("x", "y", "z"), 50.0)  # µT
    kappa = 1e-6 * sample_each("scale.constant", ("x", "y", "z"), 300_000.0)  # from ppm
    xy, xz, yz = 1e-3 * sample_each("misalignment.constant", ("xy", "xz", "yz"), 100.0)  # from mrad
    with numpyro.plate("readings", len(magnitude)):
        arrow = numpyro.sample("arrow", Normal(jnp.zeros(3), 1.0).to_event(1))
    m = magnitude[:, None] * arrow / jnp.linalg.norm(arrow, axis=1, keepdims=True)
    y, z = m[:, 1], m[:, 2]
    turned = jnp.stack([xy * y + xz * z, yz * z, 0.0 * z], axis=1)
    noise = numpyro.sample("noise.white", HalfCauchy(0.3))  # µT
    numpyro.sample("output", Normal(bias + (1 + kappa) * m + turned, noise).to_event(1), obs=output)


def data(readings: bc.Measurements) -> dict[str, Any]:
    """Return the readings as arguments of `model`."""
    output = np.stack([readings[name] for name in INSTRUMENT.vector.outputs], axis=1)
    return {"magnitude": readings["magnitude"], "output": output}


equal = INSTRUMENT.baseline  # the same model as a sum of named effects
