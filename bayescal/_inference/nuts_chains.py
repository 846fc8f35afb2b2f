"""NUTS on a log density, by NumPyro: the fallback where importance weights fail, and the exact method.

Two densities are sampled: φ alone with x integrated out, and (φ, z) with x = x̂(φ) + L(φ)⁻ᵀz whitened, which
is exact for any likelihood and still well conditioned.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal._core.jit import ALWAYS, known
from bayescal._inference import checkpoint, gaussian, laplace
from bayescal._model import forward
from bayescal._model.frame import Frame
from bayescal._model.parameters import Layout

BLOCK = 100  # iterations between which a run can be stopped and taken up again


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
    name: str = "chains",
) -> Chains:
    """NumPyro's NUTS on a log density, its chains in parallel, started from a Laplace fit.

    `name` is that of these chains in a checkpoint.
    """
    import numpyro.infer as infer  # only where chains are asked for

    k1, k2 = jax.random.split(key)
    # Scaled by the Laplace fit, so that the first mass matrix, the identity, is already right.
    chol = np.linalg.cholesky(np.asarray(covariance)) if start.size else np.zeros((0, 0))
    chol = jnp.asarray(chol)

    def potential(q: Array) -> Array:
        value = log_density(start + chol @ q)
        return jnp.where(jnp.isfinite(value), -value, 1e300)

    kernel = infer.NUTS(potential_fn=potential, dense_mass=dense, target_accept_prob=0.9)
    begin = 0.5 * jax.random.normal(k1, (chains, start.size))
    ran = iterate(kernel, k2, (), begin, warmup=warmup, draws=draws, chains=chains, name=name)
    return Chains(start + ran.draws @ chol.T, ran.divergences, ran.steps)


class Iterated(NamedTuple):
    """Draws in the sampler's own unconstrained coordinates, (chains, draws, …) each."""

    draws: Any
    divergences: int
    steps: float


def iterate(
    kernel: Any,
    key: Array,
    arguments: tuple,
    begin: Any,
    *,
    warmup: int,
    draws: int,
    chains: int,
    name: str,
) -> Iterated:
    """Run a NumPyro kernel, all chains side by side, in blocks of `BLOCK` iterations.

    Where the fit keeps a checkpoint, the sampler's state is kept with the draws after each block. The blocks are
    the same with a checkpoint and without one, hence the draws too.

    Args:
        kernel: of NumPyro.
        key: split over the chains.
        arguments: of the kernel's model.
        begin: first point of each chain; None where the kernel finds it.
        warmup, draws, chains: how many.
        name: of these chains, in the checkpoint.
    """
    state = kernel.init(
        jax.random.split(key, chains), warmup, begin, model_args=arguments, model_kwargs={}
    )
    block = _block_of(kernel, arguments)
    found = jax.tree.map(lambda a: np.zeros((draws, *a.shape), a.dtype), _kept(state))
    store, done = checkpoint.current(), 0
    if store is not None and name in store.arrays:
        done = int(store.notes[name])
        state, found = checkpoint.filled((state, found), store.arrays[name])
        found = jax.tree.map(np.array, found)  # arrays that can be written to
    while done < warmup + draws:
        # A block ends where warm-up does.
        count = min(BLOCK, (warmup if done < warmup else warmup + draws) - done)
        state, kept = block(state, count)
        if done >= warmup:
            place = slice(done - warmup, done - warmup + count)
            for all_of_it, new in zip(jax.tree.leaves(found), jax.tree.leaves(kept), strict=True):
                all_of_it[place] = np.asarray(new)[:count]
        done += count
        if store is not None:
            store.notes[name] = done
            store.arrays[name] = checkpoint.leaves_of((state, found))
            store.write_now_and_then()
    z, diverging, steps = found
    by_chain = jax.tree.map(lambda a: jnp.swapaxes(jnp.asarray(a), 0, 1), z)
    return Iterated(by_chain, int(np.sum(diverging)), float(np.mean(steps)))


def _kept(state: Any) -> tuple:
    """What is kept of the sampler's state at an iteration."""
    return state.z, state.diverging, state.num_steps


def _block_of(kernel: Any, arguments: tuple) -> Callable:
    """At most `BLOCK` iterations as one compiled program: from a state and their number to the state, and to what
    is kept of each."""

    @partial(jax.jit, compiler_options=known(ALWAYS))
    def block(state, count):
        def one(i, carried):
            state, kept = carried
            state = kernel.sample(state, arguments, {})
            return state, jax.tree.map(lambda a, b: a.at[i].set(b), kept, _kept(state))

        kept = jax.tree.map(lambda a: jnp.zeros((BLOCK, *a.shape), a.dtype), _kept(state))
        return jax.lax.fori_loop(0, count, one, (state, kept))

    return block


def whitened(layout: Layout, frame: Frame, y: Array, mode: laplace.Mode):
    """The exact log density of (v, z, e), and the map from them to (x, rows, v)."""
    density = laplace.density_of_phi(layout, frame, y, mode.point, mode.flat)
    d, p = len(layout.hypers), layout.size
    noise, shape = layout.model.noise, mode.point.rows.shape

    def unpack(q: Float[Array, "dim"]):
        v, z, e = q[:d], q[d : d + p], q[d + p :].reshape(shape)
        hyper = forward.hyper_values(layout, v)
        found = density(v)[1]
        x = found.place(z)
        log_jacobian = found.log_jacobian
        rows = mode.point.rows
        if layout.row_blocks:
            line = forward.linearise(layout, frame, mode.point.x, mode.point.rows, hyper)
            back = jnp.sum(line.rows * mode.point.rows, axis=1)
            rest = y - line.mean - line.jacobian @ (x - mode.point.x) + back
            variance = noise.variance(hyper, frame)
            rows, volume = gaussian.draw_rows(layout, line, rest, variance, e)
            log_jacobian = log_jacobian + volume
        return x, rows, v, hyper, log_jacobian

    def log_density(q: Float[Array, "dim"]) -> Float[Array, ""]:
        x, rows, v, hyper, log_jacobian = unpack(q)
        likelihood = jnp.sum(forward.log_likelihood(layout, frame, y, x, rows, hyper))
        prior = forward.log_prior_x(layout, x, rows, hyper)
        return likelihood + prior + forward.hyper_log_prior(layout, v) + log_jacobian

    dim = d + p + int(np.prod(shape))
    start = jnp.concatenate([mode.v, jnp.zeros(dim - d)])
    covariance = jnp.eye(dim).at[:d, :d].set(mode.covariance)
    return log_density, unpack, start, covariance
