"""The samplers of others, each on a target of `targets.py`, in the way that its makers propose."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

CHAINS = 2
DRAWS = 1000
ACCEPT = 0.9
LEAPS = 10  # of the Laplace Hamiltonian steps, which take a fixed number


class Target(NamedTuple):
    """A log density over R^d for a sampler of others, and what its coordinates stand for.

    Attributes:
        log_density: of a point, traceable.
        start: (chains, d).
        unknowns: from a point to every unknown of the model, (q,), NaN where the target integrates it out.
        latent: (d,), true for coordinates that are Gaussian given the rest, or nearly.
    """

    log_density: Callable[[jax.Array], jax.Array]
    start: jax.Array
    unknowns: Callable[[jax.Array], jax.Array]
    latent: np.ndarray


class Ran(NamedTuple):
    """Draws of a target's coordinates (chains, draws, d), and seconds without and of compilation."""

    draws: np.ndarray
    seconds: float
    compiling: float
    divergences: int


def numpyro_nuts(target: Target, dense: bool, warmup: int) -> Ran:
    """NumPyro's NUTS, chains one after another."""
    import numpyro.infer as infer

    kernel = infer.NUTS(
        potential_fn=lambda q: -target.log_density(q), dense_mass=dense, target_accept_prob=ACCEPT
    )

    def mcmc(warmup: int, draws: int) -> infer.MCMC:
        return infer.MCMC(
            kernel,
            num_warmup=warmup,
            num_samples=draws,
            num_chains=CHAINS,
            chain_method="sequential",
            progress_bar=False,
        )

    begun = time.perf_counter()
    made = mcmc(warmup, DRAWS)
    made.run(jax.random.key(1), init_params=target.start, extra_fields=("diverging",))
    whole = time.perf_counter() - begun
    draws = np.asarray(made.get_samples(group_by_chain=True))
    diverging = int(np.sum(made.get_extra_fields()["diverging"]))
    begun = time.perf_counter()
    short = mcmc(2, 2)
    short.run(jax.random.key(2), init_params=target.start)
    compiling = time.perf_counter() - begun  # two draws take no time beside it
    return Ran(draws, whole - compiling, compiling, diverging)


def blackjax_nuts(target: Target, warmup: int) -> Ran:
    """BlackJAX's NUTS after its window adaptation, chains one after another."""
    import blackjax  # pyright: ignore[reportMissingImports]

    adapt: Any = blackjax.window_adaptation(
        blackjax.nuts,
        target.log_density,
        is_mass_matrix_diagonal=False,
        target_acceptance_rate=ACCEPT,
    )

    def chain(key, start):
        k1, k2 = jax.random.split(key)
        (state, parameters), _ = adapt.run(k1, start, num_steps=warmup)
        step: Any = blackjax.nuts(target.log_density, **parameters).step

        def one(state, key):
            state, told = step(key, state)
            return state, (state.position, told.is_divergent)

        return jax.lax.scan(one, state, jax.random.split(k2, DRAWS))[1]

    return _chains(chain, target.start)


def blackjax_laplace(target: Target, warmup: int) -> Ran:
    """BlackJAX's Hamiltonian steps on the Laplace marginal: step and mass by its window adaptation, then whole
    trajectories (`laplace_mhmc`). Draws of the latent coordinates are NaN, for it makes none."""
    import blackjax  # pyright: ignore[reportMissingImports]
    from blackjax.mcmc.laplace_marginal import laplace_marginal_factory  # pyright: ignore[reportMissingImports]

    inner, outer = np.flatnonzero(target.latent), np.flatnonzero(~target.latent)

    def joint(theta, phi):
        q = jnp.zeros(len(target.latent)).at[inner].set(theta).at[outer].set(phi)
        return target.log_density(q)

    zero = jnp.zeros(len(inner))
    laplace = laplace_marginal_factory(joint, zero)
    adapt: Any = blackjax.window_adaptation(
        blackjax.hmc,
        lambda phi: laplace(phi)[0],
        is_mass_matrix_diagonal=False,
        target_acceptance_rate=ACCEPT,
        num_integration_steps=LEAPS,
    )

    def chain(key, start):
        k1, k2 = jax.random.split(key)
        (state, found), _ = adapt.run(k1, start[outer], num_steps=warmup)
        own: Any = blackjax.laplace_mhmc(joint, theta_init=zero, **found)

        def one(state, key):
            state, told = own.step(key, state)
            return state, (state.position, told.is_divergent)

        first = own.init(state.position)
        phi, diverging = jax.lax.scan(one, first, jax.random.split(k2, DRAWS))[1]
        return jnp.full((DRAWS, len(target.latent)), jnp.nan).at[:, outer].set(phi), diverging

    return _chains(chain, target.start)


def _chains(chain: Callable[..., Any], start: jax.Array) -> Ran:
    """A function of key and start, compiled, for each start."""
    begun = time.perf_counter()
    compiled = jax.jit(chain).lower(jax.random.key(0), start[0]).compile()
    compiling = time.perf_counter() - begun
    begun = time.perf_counter()
    found = [compiled(jax.random.key(i), start[i]) for i in range(CHAINS)]
    draws = np.stack([np.asarray(f[0]) for f in found])
    seconds = time.perf_counter() - begun
    return Ran(draws, seconds, compiling, int(sum(np.sum(f[1]) for f in found)))


def _both(target: Target) -> tuple[Callable[..., Any], float]:
    """Value and gradient, compiled, and the seconds that this took."""
    both = jax.jit(jax.value_and_grad(target.log_density))
    begun = time.perf_counter()
    jax.block_until_ready(both(target.start[0]))
    return both, time.perf_counter() - begun


def _traced(trace: Any, seconds: float, compiling: float) -> Ran:
    """What a sampler hands back as an ArviZ tree."""
    draws, diverging = trace.posterior["q"], trace.sample_stats["diverging"]
    return Ran(np.asarray(draws), seconds, compiling, int(np.sum(np.asarray(diverging))))


def nutpie_nuts(target: Target, low_rank: bool, warmup: int) -> Ran:
    """nutpie on the compiled value and gradient."""
    import nutpie  # pyright: ignore[reportMissingImports]
    from nutpie.compiled_pyfunc import from_pyfunc  # pyright: ignore[reportMissingImports]

    both, compiling = _both(target)
    dim = target.start.shape[1]

    def logp() -> Callable[..., tuple[float, np.ndarray]]:
        def function(q, **_):
            value, slope = both(q)
            return float(value), np.asarray(slope)

        return function

    def expand(*_):
        return lambda q, **_: {"q": np.asarray(q)}

    def begin(seed):
        return np.asarray(target.start)[seed % CHAINS]

    model = from_pyfunc(
        dim,
        logp,
        expand,
        [np.dtype("float64")],
        [(dim,)],
        ["q"],
        make_initial_point_fn=begin,
    )
    begun = time.perf_counter()
    trace = nutpie.sample(
        model,
        tune=warmup,
        draws=DRAWS,
        chains=CHAINS,
        cores=2,
        seed=1,
        low_rank_modified_mass_matrix=low_rank,
        progress_bar=False,
    )
    seconds = time.perf_counter() - begun
    return _traced(trace, seconds, compiling)


def pymc_nuts(target: Target, warmup: int) -> Ran:
    """PyMC's own NUTS on the compiled value and gradient, chains one after another."""
    import pymc as pm  # pyright: ignore[reportMissingImports]
    import pytensor.tensor as pt  # pyright: ignore[reportMissingImports]
    from pytensor.graph.op import Op  # pyright: ignore[reportMissingImports]

    both, compiling = _both(target)

    class Slope(Op):
        itypes, otypes = (pt.dvector,), (pt.dvector,)  # pyright: ignore[reportPrivateImportUsage]

        def perform(self, node, inputs, output_storage):
            output_storage[0][0] = np.array(both(inputs[0])[1])

    class Density(Op):
        itypes, otypes = (pt.dvector,), (pt.dscalar,)  # pyright: ignore[reportPrivateImportUsage]

        def perform(self, node, inputs, output_storage):
            output_storage[0][0] = np.array(both(inputs[0])[0])

        def L_op(self, inputs, outputs, output_grads):  # the name that PyTensor asks for
            return [output_grads[0] * Slope()(inputs[0])]  # pyright: ignore[reportOperatorIssue]

    with pm.Model():
        q = pm.Flat("q", shape=target.start.shape[1])
        pm.Potential("density", Density()(q))  # pyright: ignore[reportArgumentType]
        begun = time.perf_counter()
        trace = pm.sample(
            draws=DRAWS,
            tune=warmup,
            chains=CHAINS,
            cores=1,
            target_accept=ACCEPT,
            initvals=[{"q": np.asarray(one)} for one in target.start],
            random_seed=1,
            progressbar=False,
            compute_convergence_checks=False,
        )
        seconds = time.perf_counter() - begun
    return _traced(trace, seconds, compiling)
