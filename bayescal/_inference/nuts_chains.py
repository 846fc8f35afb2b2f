"""NUTS (No-U-Turn sampler) on a log density, by NumPyro: the exact method, and the fallback of importance sampling.

(φ, z) are sampled with x = x̂(φ) + L(φ)⁻ᵀz whitened, which is exact for any likelihood and still well conditioned.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core import deadline
from bayescal._core.jit import compiler_options
from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._inference.density import Density
from bayescal._inference.laplace import Mode
from bayescal._inference.problem import Problem
from bayescal._model import forward

# Iterations per compiled block; the deadline and Ctrl-C are checked between blocks.
BLOCK = 4
MIN_STEPS = 7  # leapfrog steps per iteration (tree depth 3) in the lower bound of the run time
MAX_TIME_S = 300.0  # s, time limit of NUTS as a fallback without another limit


class Chains(NamedTuple):
    """NUTS draws in the sampler's coordinates (chains, draws, …), number of divergences, mean leapfrog steps."""

    draws: Any
    divergences: int
    steps: float


class Plan(NamedTuple):
    """Settings of NUTS: warm-up and draws per chain, number of chains, dense mass matrix or diagonal."""

    warmup: int
    draws: int
    chains: int = 4
    dense: bool = True

    def kernel(self, *model: Any, **options: Any) -> Any:
        """Build NumPyro's NUTS kernel for a program or a potential (negative log density)."""
        import numpyro.infer as infer  # half a second that only chains need

        return infer.NUTS(*model, dense_mass=self.dense, target_accept_prob=0.95, **options)


def run(
    log_density: Callable[[Array], Array],
    start: Float[Array, "d"],
    covariance: Float[Array, "d d"],
    key: Array,
    plan: Plan,
) -> Chains:
    """Run NUTS on a log density, chains in parallel, preconditioned and started by a Laplace approximation."""
    start_key, chain_key = jax.random.split(key)
    # Preconditioned by the Laplace covariance, so that the initial identity mass matrix is adequate.
    chol = np.linalg.cholesky(np.asarray(covariance)) if start.size else np.zeros((0, 0))
    chol = jnp.asarray(chol)

    def potential(q: Array) -> Array:
        # An undefined density: a finite, high potential ends the trajectory; infinity would give NaN gradients.
        value = log_density(start + chol @ q)
        return jnp.where(jnp.isfinite(value), -value, 1e300)

    starts = 0.5 * jax.random.normal(start_key, (plan.chains, start.size))
    chains = run_kernel(plan.kernel(potential_fn=potential), chain_key, (), starts, plan)
    return chains._replace(draws=start + chains.draws @ chol.T)


def run_kernel(kernel: Any, key: Array, arguments: tuple, starts: Any, plan: Plan) -> Chains:
    """Run a NumPyro kernel, all chains vectorised, in blocks of a few iterations.

    The run time is estimated from the first block; chains that would exceed the deadline are stopped. starts: starting
    points; None: chosen by the kernel.

    Raises:
        TimeIsUp: the deadline is reached, or would be before the last iteration.
    """

    def sample(state: Any, _: None) -> tuple[Any, tuple]:
        state = kernel.sample(state, arguments, {})
        return state, (state.z, state.diverging, state.num_steps)

    time_limit, count = deadline.current(), plan.warmup + plan.draws
    time_limit.raise_if_over()
    keys = jax.random.split(key, plan.chains)
    state = kernel.init(keys, plan.warmup, starts, model_args=arguments, model_kwargs={})
    run_block = jax.jit(
        lambda state: jax.lax.scan(sample, state, length=BLOCK),
        compiler_options=compiler_options(True),
    )
    run_block = run_block.lower(state).compile()  # excluded from the timing
    blocks = []
    for iteration in range(0, count, BLOCK):
        time_limit.raise_if_over()
        start = time.monotonic()
        state, samples = jax.block_until_ready(run_block(state))
        blocks.append(jax.tree.map(np.asarray, samples))
        if iteration == 0:
            # A lower bound, by shallow trees, so that no chain is stopped that would have finished.
            mean_steps = max(1.0, float(np.mean(np.max(np.atleast_2d(blocks[0][2]), axis=-1))))
            elapsed_s = time.monotonic() - start
            seconds = elapsed_s / BLOCK * min(1.0, MIN_STEPS / mean_steps) * (count - BLOCK)
            if time.monotonic() + seconds > time_limit.ends_at:
                duration = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} minutes"
                raise deadline.TimeIsUp(f"{time_limit.reason}; NUTS would take {duration} or more")
    z, diverging, mean_steps = jax.tree.map(
        lambda *blocks: np.concatenate(blocks)[plan.warmup : count], *blocks
    )
    chain_draws = jax.tree.map(lambda a: jnp.swapaxes(jnp.asarray(a), 0, 1), z)
    return Chains(chain_draws, int(np.sum(diverging)), float(np.mean(mean_steps)))


def whiten_posterior(problem: Problem, mode: Mode):
    """Return the exact log density of q = (v, z), the map q → (x, v, log Jacobian), starting point and covariance.

    z is x whitened by its conditional posterior of the linearised model, with the Gram matrix at the mode.
    """
    layout, record = problem.layout, problem.record
    frame = jax.tree.map(jnp.asarray, record.frame)
    y, d, p = jnp.asarray(record.y), len(layout.hypers), layout.size
    density, hyper_at_mode = Density(problem, mode.x, mode.flat, mode.v), problem.hyper(mode.v)
    gram, prior = density.gram(mode.v, hyper_at_mode), problem.prior(hyper_at_mode, mode.flat)
    rhs = gram.jtr - gram.jtj @ (prior.weight * (prior.mean - mode.x))
    centre = jnp.asarray(np.where(prior.weight > 0, prior.mean, mode.x))
    amplitude = next(iter(problem.noise.amplitudes), None)

    def unwhiten(v, z):
        # x = x̂(φ) + S·L⁻ᵀ·z with the precision of the linearised model (`gaussian.condition`) and JᵀΣ⁻¹J of the mode,
        # scaled by the noise's first amplitude. The approximation affects the map only: the log Jacobian, log|S·L⁻ᵀ|,
        # makes the density of (v, z) exact.
        hyper = layout.hyper(v)
        sd = forward.prior_sd(layout, hyper, jnp.asarray(mode.flat))
        ratio = 1.0 if amplitude is None else (hyper[amplitude] / hyper_at_mode[amplitude]) ** 2
        precision = sd[:, None] * gram.jtj * sd / ratio + jnp.diag(prior.weight)
        chol = jnp.linalg.cholesky(precision)
        solve = jax.scipy.linalg.solve_triangular
        white_rhs = solve(chol, sd * rhs / ratio, lower=True)
        log_volume = jnp.sum(jnp.log(sd)) - jnp.sum(jnp.log(jnp.diagonal(chol)))
        return centre + sd * solve(chol, white_rhs + z, lower=True, trans=1), log_volume

    def unpack(q: Float[Array, "dim"]):
        x, log_jacobian = unwhiten(q[:d], q[d:])
        return x, q[:d], log_jacobian

    def log_density(q: Float[Array, "dim"]) -> Float[Array, ""]:
        x, v, log_jacobian = unpack(q)
        hyper = layout.hyper(v)
        likelihood = jnp.sum(forward.log_likelihood(layout, frame, y, x, hyper))
        prior = forward.log_prior_x(layout, x, hyper)
        return likelihood + prior + layout.log_prior(v) + log_jacobian

    dim = d + p
    start = jnp.zeros(dim).at[:d].set(mode.v)
    covariance = jnp.eye(dim).at[:d, :d].set(mode.covariance)
    return log_density, unpack, start, covariance
