"""NUTS on a log density, by NumPyro: the fallback where importance weights fail, and the exact method.

(φ, z) are sampled with x = x̂(φ) + L(φ)⁻ᵀz whitened, which is exact for any likelihood and still well conditioned.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core import deadline
from bayescal._core.jit import ALWAYS, known
from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._inference.density import Density
from bayescal._inference.laplace import Mode
from bayescal._inference.problem import Problem
from bayescal._model import forward

# Iterations between which a run can be stopped, so that a deadline is met and Ctrl-C heard.
BLOCK = 4
FEWEST_STEPS = 7  # of an iteration, by which its cost is judged too low rather than too high: a tree of depth three
PATIENCE = 300.0  # s that chains get that nobody asked for, where there is no time limit


class Chains(NamedTuple):
    """Draws in a sampler's coordinates, (chains, draws, …) each, with what NUTS reported."""

    draws: Any
    divergences: int
    steps: float


class Plan(NamedTuple):
    """How chains are run: iterations of each, how many side by side, and whether a dense mass matrix is adapted."""

    warmup: int
    draws: int
    chains: int = 4
    dense: bool = True

    def kernel(self, *model: Any, **how: Any) -> Any:
        """Return NumPyro's NUTS of a program or of a `potential_fn`."""
        import numpyro.infer as infer  # half a second that only chains need

        return infer.NUTS(*model, dense_mass=self.dense, target_accept_prob=0.95, **how)


def run(
    log_density: Callable[[Array], Array],
    start: Float[Array, "d"],
    covariance: Float[Array, "d d"],
    key: Array,
    plan: Plan,
) -> Chains:
    """Run NumPyro's NUTS on a log density, its chains in parallel, started from a Laplace fit."""
    k1, k2 = jax.random.split(key)
    # Scaled by the Laplace fit, so that the first mass matrix, the identity, is already right.
    chol = np.linalg.cholesky(np.asarray(covariance)) if start.size else np.zeros((0, 0))
    chol = jnp.asarray(chol)

    def potential(q: Array) -> Array:
        # No density there: a potential so high that no trajectory goes on; infinity would give slopes of NaN.
        value = log_density(start + chol @ q)
        return jnp.where(jnp.isfinite(value), -value, 1e300)

    begin = 0.5 * jax.random.normal(k1, (plan.chains, start.size))
    ran = iterate(plan.kernel(potential_fn=potential), k2, (), begin, plan)
    return ran._replace(draws=start + ran.draws @ chol.T)


def iterate(kernel: Any, key: Array, arguments: tuple, begin: Any, plan: Plan) -> Chains:
    """Run a NumPyro kernel, all chains side by side, a few iterations at once.

    Chains that have no time to end are not begun, as far as the first iterations can tell. They begin where the kernel
    finds a place, if `begin` is None.

    Raises:
        TimeIsUp: the deadline came first, or surely would.
    """

    def sample(state: Any, _: None) -> tuple[Any, tuple]:
        state = kernel.sample(state, arguments, {})
        return state, (state.z, state.diverging, state.num_steps)

    end, count = deadline.current(), plan.warmup + plan.draws
    end.ask()
    keys = jax.random.split(key, plan.chains)
    state = kernel.init(keys, plan.warmup, begin, model_args=arguments, model_kwargs={})
    block = jax.jit(
        lambda state: jax.lax.scan(sample, state, length=BLOCK), compiler_options=known(ALWAYS)
    )
    block = block.lower(state).compile()  # which is no part of what an iteration costs
    by_block = []
    for done in range(0, count, BLOCK):
        end.ask()
        since = time.monotonic()
        state, drawn = jax.block_until_ready(block(state))
        by_block.append(jax.tree.map(np.asarray, drawn))
        if done == 0:
            # Judged by the smallest tree, so that chains are never given up that would have ended in time.
            steps = max(1.0, float(np.mean(np.max(np.atleast_2d(by_block[0][2]), axis=-1))))
            took = time.monotonic() - since
            least = took / BLOCK * min(1.0, FEWEST_STEPS / steps) * (count - BLOCK)
            if time.monotonic() + least > end.ends_at:
                words = f"{least:.0f} s" if least < 100 else f"{least / 60:.0f} minutes"
                raise deadline.TimeIsUp(f"{end.why}, where chains take {words} or more")
    z, diverging, steps = jax.tree.map(
        lambda *blocks: np.concatenate(blocks)[plan.warmup : count], *by_block
    )
    by_chain = jax.tree.map(lambda a: jnp.swapaxes(jnp.asarray(a), 0, 1), z)
    return Chains(by_chain, int(np.sum(diverging)), float(np.mean(steps)))


def whitened(problem: Problem, mode: Mode):
    """Return the exact log density of (v, z), and the map from them to (x, v).

    z is x in units of its linearised posterior, by the products at the mode and φ's own prior and noise.
    """
    layout, record = problem.layout, problem.record
    frame = jax.tree.map(jnp.asarray, record.frame)
    y, d, p = jnp.asarray(record.y), len(layout.hypers), layout.size
    density, hyper_at_mode = Density(problem, mode.x, mode.flat, mode.v), problem.hyper(mode.v)
    gram, prior = density.gram(mode.v, hyper_at_mode), problem.prior(hyper_at_mode, mode.flat)
    pull = gram.jtr - gram.jtj @ (prior.weight * (prior.mean - mode.x))
    middle = jnp.asarray(np.where(prior.weight > 0, prior.mean, mode.x))
    amplitude = next(iter(problem.noise.amplitudes), None)

    def place(v, z):
        # z is x − x̂(φ) whitened by the precision of the linearised model at v (`gaussian.condition`), with the
        # products of the mode: JᵀΣ⁻¹J is taken to go with the noise's first amplitude. That only shapes the map; its
        # log Jacobian, log|S·L⁻ᵀ|, makes the density of (v, z) exact.
        hyper = forward.hyper_values(layout, v)
        sd = forward.prior_sd(layout, hyper, jnp.asarray(mode.flat))
        larger = 1.0 if amplitude is None else (hyper[amplitude] / hyper_at_mode[amplitude]) ** 2
        precision = sd[:, None] * gram.jtj * sd / larger + jnp.diag(prior.weight)
        chol = jnp.linalg.cholesky(precision)
        solve = jax.scipy.linalg.solve_triangular
        u = solve(chol, sd * pull / larger, lower=True)
        volume = jnp.sum(jnp.log(sd)) - jnp.sum(jnp.log(jnp.diagonal(chol)))
        return middle + sd * solve(chol, u + z, lower=True, trans=1), volume

    def unpack(q: Float[Array, "dim"]):
        x, log_jacobian = place(q[:d], q[d:])
        return x, q[:d], log_jacobian

    def log_density(q: Float[Array, "dim"]) -> Float[Array, ""]:
        x, v, log_jacobian = unpack(q)
        hyper = forward.hyper_values(layout, v)
        likelihood = jnp.sum(forward.log_likelihood(layout, frame, y, x, hyper))
        prior = forward.log_prior_x(layout, x, hyper)
        return likelihood + prior + forward.hyper_log_prior(layout, v) + log_jacobian

    dim = d + p
    start = jnp.zeros(dim).at[:d].set(mode.v)
    covariance = jnp.eye(dim).at[:d, :d].set(mode.covariance)
    return log_density, unpack, start, covariance
