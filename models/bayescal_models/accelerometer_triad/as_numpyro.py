"""Self-contained NumPyro model of three accelerometers in poses at rest of unknown direction.

It is the model that `bc.fit(equal(), readings)` fits, given as an example; the package does not import it.

    nuts = NUTS(bc.non_centred(model), dense_mass=True, target_accept_prob=0.95)
    MCMC(nuts, num_warmup=1000, num_samples=8000).run(key, **data(readings))

In each pose gravity has a latent direction, a unit vector f with a uniform prior:

    y = b + (1 + κ)·f + [γ_xy·f_y + γ_xz·f_z,  γ_yz·f_z,  0] + e,     e ~ N(0, σ²) in each axis,  all in g

The z axis of the body is that of the sensor z, its y axis in the plane of the sensors y and z.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro.distributions import HalfCauchy, Normal

import bayescal as bc
from bayescal_models.accelerometer_triad.model import INSTRUMENT


def model(poses, output=None) -> None:
    """Define the model of a number of poses; output g (poses, 3), or None to simulate."""

    def sample_each(name: str, parts: tuple[str, ...], size: float) -> Any:
        return jnp.stack([numpyro.sample(f"{name}[{part}]", Normal(0.0, size)) for part in parts])

    bias = 1e-3 * sample_each("bias.constant", ("x", "y", "z"), 50.0)  # from mg
    kappa = 1e-6 * sample_each("scale.constant", ("x", "y", "z"), 30_000.0)  # from ppm
    xy, xz, yz = 1e-3 * sample_each("misalignment.constant", ("xy", "xz", "yz"), 20.0)  # from mrad
    with numpyro.plate("poses", poses):
        # its direction is uniform
        arrow = numpyro.sample("arrow", Normal(jnp.zeros(3), 1.0).to_event(1))
    f = arrow / jnp.linalg.norm(arrow, axis=1, keepdims=True)
    y, z = f[:, 1], f[:, 2]
    turned = jnp.stack([xy * y + xz * z, yz * z, 0.0 * z], axis=1)
    noise = numpyro.sample("noise.white", HalfCauchy(1e-3))  # g
    numpyro.sample("output", Normal(bias + (1 + kappa) * f + turned, noise).to_event(1), obs=output)


def data(readings: bc.Measurements) -> dict[str, Any]:
    """Return the readings as arguments of `model`."""
    output = np.stack([readings[name] for name in INSTRUMENT.vector.outputs], axis=1)
    return {"poses": len(output), "output": output}


equal = INSTRUMENT.baseline  # the same model as a sum of named effects
