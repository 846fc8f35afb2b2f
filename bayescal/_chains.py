"""NUTS on a log density, by NumPyro: the fallback where importance weights fail, and the exact method.

Two densities are sampled: φ alone with x integrated out, and (φ, z) with x = x̂(φ) + L(φ)⁻ᵀz whitened, which
is exact for any likelihood and still well conditioned.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal import _composition as composition
from bayescal import _laplace as laplace
from bayescal import _linear as linear
from bayescal._frame import Frame
from bayescal._layout import Layout


class Chains(NamedTuple):
    """Draws of a vector: (chains, draws, d), with what NUTS reported."""

    draws: Float[Array, "c s d"]
    divergences: int
    steps: float


def run(
    log_density: Callable[[Array], Array],
    start: Float[Array, "d"],
    covariance: Float[Array, "d d"],
    key: Array,
    *,
    warmup: int,
    draws: int,
    chains: int = 4,
    dense: bool = True,
) -> Chains:
    """NumPyro's NUTS on a log density, its chains in parallel, started from a Laplace fit."""
    import numpyro.infer as infer  # only where chains are asked for

    k1, k2 = jax.random.split(key)
    # Scaled by the Laplace fit, so that the first mass matrix, the identity, is already right.
    chol = np.linalg.cholesky(np.asarray(covariance)) if start.size else np.zeros((0, 0))
    chol = jnp.asarray(chol)

    def potential(q: Array) -> Array:
        value = log_density(start + chol @ q)
        return jnp.where(jnp.isfinite(value), -value, 1e300)

    kernel = infer.NUTS(potential_fn=potential, dense_mass=dense, target_accept_prob=0.9)
    sampler = infer.MCMC(
        kernel,
        num_warmup=warmup,
        num_samples=draws,
        num_chains=chains,
        chain_method="vectorized",
        progress_bar=False,
    )
    begin = 0.5 * jax.random.normal(k1, (chains, start.size))
    sampler.run(k2, init_params=begin, extra_fields=("diverging", "num_steps"))
    extra = sampler.get_extra_fields(group_by_chain=True)
    q = sampler.get_samples(group_by_chain=True)
    return Chains(
        start + q @ chol.T,
        int(np.sum(np.asarray(extra["diverging"]))),
        float(np.mean(np.asarray(extra["num_steps"]))),
    )


def whitened(layout: Layout, frame: Frame, y: Array, mode: laplace.Mode):
    """The exact log density of (v, z, e), and the map from them to (x, rows, v)."""
    density = laplace.density_of_phi(layout, frame, y, mode.point, mode.flat)
    d, p = len(layout.hypers), layout.size
    noise, shape = layout.model.noise, mode.point.rows.shape

    def unpack(q: Float[Array, "dim"]):
        v, z, e = q[:d], q[d : d + p], q[d + p :].reshape(shape)
        hyper = composition.hyper_values(layout, v)
        found = density(v)[1]
        x = found.place(z)
        stretch = jnp.sum(jnp.log(found.sd)) - jnp.sum(jnp.log(jnp.diag(found.chol)))
        rows = mode.point.rows
        if layout.row_blocks:
            line = composition.linearise(layout, frame, mode.point.x, mode.point.rows, hyper)
            back = jnp.sum(line.rows * mode.point.rows, axis=1)
            rest = y - line.mean - line.jacobian @ (x - mode.point.x) + back
            variance = noise.variance(hyper, frame)
            rows, volume = linear.draw_rows(layout, line, rest, variance, e)
            stretch = stretch + volume
        return x, rows, v, hyper, stretch

    def log_density(q: Float[Array, "dim"]) -> Float[Array, ""]:
        x, rows, v, hyper, stretch = unpack(q)
        likelihood = jnp.sum(composition.log_likelihood(layout, frame, y, x, rows, hyper))
        prior = composition.log_prior_x(layout, x, rows, hyper)
        return likelihood + prior + composition.hyper_log_prior(layout, v) + stretch

    dim = d + p + int(np.prod(shape))
    start = jnp.concatenate([mode.v, jnp.zeros(dim - d)])
    covariance = jnp.eye(dim).at[:d, :d].set(mode.covariance)
    return log_density, unpack, start, covariance
