"""Self-contained NumPyro model of three accelerometers in poses at rest of unknown direction.

It is the model that `bc.fit(equivalent_model(), readings)` fits. NUTS is run on it by

    nuts = NUTS(bc.non_centred(model), dense_mass=True, target_accept_prob=0.95)
    MCMC(nuts, num_warmup=1000, num_samples=8000).run(key, **model_arguments(readings))

In each pose the specific force f, in g, has a latent direction with a uniform prior:

    y = b + (1 + κ)·f + [γ_xy·f_y + γ_xz·f_z,  γ_yz·f_z,  0] + e,     e ~ N(0, σ²) in each axis,  all in g

By convention the body's z axis is that of sensor z, and its y axis lies in the plane of the sensors y and z.
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
    """Define the NumPyro model: number of poses; outputs g (poses, 3), or None to simulate."""

    def sample_parts(name: str, labels: tuple[str, ...], sd: float) -> Any:
        return jnp.stack([numpyro.sample(f"{name}[{part}]", Normal(0.0, sd)) for part in labels])

    bias = 1e-3 * sample_parts("bias.constant", ("x", "y", "z"), 50.0)  # from mg
    kappa = 1e-6 * sample_parts("scale.constant", ("x", "y", "z"), 30_000.0)  # from ppm
    xy, xz, yz = 1e-3 * sample_parts("misalignment.constant", ("xy", "xz", "yz"), 20.0)  # from mrad
    with numpyro.plate("poses", poses):
        # the direction of a normal vector is uniform
        normal_vector = numpyro.sample("arrow", Normal(jnp.zeros(3), 1.0).to_event(1))
    f = normal_vector / jnp.linalg.norm(normal_vector, axis=1, keepdims=True)
    y, z = f[:, 1], f[:, 2]
    cross = jnp.stack([xy * y + xz * z, yz * z, 0.0 * z], axis=1)
    noise = numpyro.sample("noise.white", HalfCauchy(1e-3))  # g
    numpyro.sample("output", Normal(bias + (1 + kappa) * f + cross, noise).to_event(1), obs=output)


def model_arguments(readings: bc.Measurements) -> dict[str, Any]:
    """Return the arguments of `model` for these readings."""
    output = np.stack([readings[name] for name in INSTRUMENT.vector.outputs], axis=1)
    return {"poses": len(output), "output": output}


equivalent_model = INSTRUMENT.baseline  # a sum of named effects with the same posterior
