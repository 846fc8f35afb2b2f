"""Self-contained NumPyro model of three gyroscopes on a rate table, with errors of the mountings.

The model that `bc.fit(equal(), readings)` fits; `mems_gyro/as_numpyro.py` says how to run it.

The table turns at a rate Ω about an axis u of the body, nominally; ω = Ω·u. Of axis a of the unit:

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
    """Define the model of Ω °/s (n,), u and axis a (n, 3), u(θ) rad, mountings; output °/s, or None to simulate."""

    def sample_each(name: str, parts: tuple[str, ...], size: float) -> Any:
        return jnp.stack([numpyro.sample(f"{name}[{part}]", Normal(0.0, size)) for part in parts])

    bias = sample_each("bias.constant", ("x", "y", "z"), 3.0)  # °/s
    scale = 1e-6 * sample_each("scale.constant", ("x", "y", "z"), 20_000.0)  # from ppm
    pairs = ("xy", "xz", "yz", "yx", "zx", "zy")
    xy, xz, yz, yx, zx, zy = 1e-3 * sample_each("misalignment.constant", pairs, 20.0)  # from mrad
    G = jnp.diag(scale) + jnp.array([[0.0, xy, xz], [yx, 0.0, yz], [zx, zy, 0.0]])
    with numpyro.plate("mountings", mountings):
        off = sample_each("turn.mounting", ("x", "y", "z"), 1.0)  # in parts of u(θ)
    theta = uncertainty[:, None] * off.T[mounting]
    omega = rate[:, None] * direction
    y = omega + bias + omega @ G.T + rate[:, None] * jnp.cross(theta, direction)
    noise = numpyro.sample("noise.white", HalfCauchy(0.03))  # °/s
    numpyro.sample("output", Normal(jnp.sum(across * y, axis=1), noise), obs=output)


def data(readings: bc.Measurements) -> dict[str, Any]:
    """Return the readings as arguments of `model`."""
    direction, across = (
        np.stack([readings[f"{name}_{a}"] for a in "xyz"], axis=1)
        for name in ("direction", "across")
    )
    mountings, mounting = readings.groups("mounting")
    arms = {"rate": readings["rate"], "direction": direction, "across": across}
    groups = {"mounting": mounting, "mountings": len(mountings)}
    columns = {"uncertainty": readings["pose_uncertainty"], "output": readings["output"]}
    return arms | groups | columns


equal = INSTRUMENT.baseline  # the same model as a sum of named effects
