"""Self-contained NumPyro model of three gyroscopes on a rate table, with errors of the mountings.

It is the model that `bc.fit(equivalent_model(), readings)` fits; `mems_gyro/as_numpyro.py` shows how to run NUTS on it.

The table turns at a rate Ω about a nominal axis u of the body, ω = Ω·u. The output of axis a is

    y_a = ω_a + b_a + Σ_j G_aj·ω_j + Ω·(θ × u)_a + e_a,     e_a ~ N(0, σ²),     all in °/s

G has scale factors and misalignments; θ is the rotation error of a mounting on the table, each angle N(0, u²) with the
standard uncertainty u given with the readings.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro.distributions import HalfCauchy, Normal

import bayescal as bc
from bayescal_models.gyro_triad.model import INSTRUMENT


def model(rate, direction, across, uncertainty, mounting, mountings, output=None) -> None:
    """Define the NumPyro model.

    Args:
        rate, direction: rate of the table, °/s, (n,), and its axis u in the body, unit vectors (n, 3).
        across, uncertainty: axis of each output, unit vectors (n, 3); standard uncertainty u of θ, rad, (n,).
        mounting, mountings: index of each reading's mounting, (n,), and number of mountings.
        output: outputs, °/s, (n,); None to simulate.
    """

    def sample_parts(name: str, labels: tuple[str, ...], sd: float) -> Any:
        return jnp.stack([numpyro.sample(f"{name}[{part}]", Normal(0.0, sd)) for part in labels])

    bias = sample_parts("bias.constant", ("x", "y", "z"), 3.0)  # °/s
    scale = 1e-6 * sample_parts("scale.constant", ("x", "y", "z"), 20_000.0)  # from ppm
    pairs = ("xy", "xz", "yz", "yx", "zx", "zy")
    xy, xz, yz, yx, zx, zy = 1e-3 * sample_parts("misalignment.constant", pairs, 20.0)  # from mrad
    G = jnp.diag(scale) + jnp.array([[0.0, xy, xz], [yx, 0.0, yz], [zx, zy, 0.0]])
    with numpyro.plate("mountings", mountings):
        mounting_deviates = sample_parts("turn.mounting", ("x", "y", "z"), 1.0)  # θ/u
    theta = uncertainty[:, None] * mounting_deviates.T[mounting]
    omega = rate[:, None] * direction
    y = omega + bias + omega @ G.T + rate[:, None] * jnp.cross(theta, direction)
    noise = numpyro.sample("noise.white", HalfCauchy(0.03))  # °/s
    numpyro.sample("output", Normal(jnp.sum(across * y, axis=1), noise), obs=output)


def model_arguments(readings: bc.Measurements) -> dict[str, Any]:
    """Return the arguments of `model` for these readings."""
    direction, across = (
        np.stack([readings[f"{name}_{a}"] for a in "xyz"], axis=1)
        for name in ("direction", "across")
    )
    mountings, mounting = readings.groups("mounting")
    rates = {"rate": readings["rate"], "direction": direction, "across": across}
    groups = {"mounting": mounting, "mountings": len(mountings)}
    columns = {"uncertainty": readings["pose_uncertainty"], "output": readings["output"]}
    return rates | groups | columns


equivalent_model = INSTRUMENT.baseline  # a sum of named effects with the same posterior
