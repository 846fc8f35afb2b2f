"""The regularised horseshoe by NumPyro's NUTS; the set of a draw is the candidates that it shrinks by less than half.

Model: output left by the base and columns of candidates, all of mean square 1; coefficients of candidate i are
normal with standard deviation τ·λ̃ᵢ, λ̃ᵢ² = c²·λᵢ²/(c² + τ²·λᵢ²), λᵢ ~ C⁺(0, 1), one λᵢ for all columns of a candidate;
τ ~ C⁺(0, τ₀) with τ₀ = p₀/(D − p₀)·σ/√n, D candidates and the guess p₀ = 1; c² ~ Inv-Gamma(ν/2, ν·s²/2) with ν = 4 and
s = 2; σ ~ C⁺(0, 1). Coefficients, and those of the base, are integrated out in closed form: NUTS moves D + 3 numbers.
Probabilities: a draw's shrinkage factors are κᵢ = 1/(1 + n·τ²·λ̃ᵢ²/σ²); its set is {i: κᵢ < 1/2}; a set's probability is
its share of draws. κ is no inclusion indicator: such shares are a customary reading, no posterior over models.
Sources: J. Piironen & A. Vehtari, Electron. J. Stat. 11 (2017) 5018; ν and s, defaults of the R package brms; half as
threshold, C. Carvalho, N. Polson & J. Scott, Biometrika 97 (2010) 465. A λ for a group of columns is ours.
"""

from __future__ import annotations

from collections import Counter
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist

from missing_effect.regression import Regression
from missing_effect.task import Task

GUESS = 1.0  # p₀, candidates that matter
FREEDOM, SLAB = 4.0, 2.0  # ν and s of the slab
CHAINS, WARM_UP, DRAWS = 4, 500, 500
PREDICTED = 200  # draws that predict


def solve(task: Task) -> dict[str, Any]:
    jax.config.update("jax_enable_x64", True)
    problem = Regression(task)
    widths = [c.shape[1] for c in problem.projected]
    owner = np.repeat(np.arange(len(widths)), widths)
    x = np.hstack(problem.projected)
    scale = np.maximum(np.sqrt(np.mean(x**2, axis=0)), 1e-300)
    unit = float(np.sqrt(np.mean(problem.left**2)))
    x, y = x / scale, problem.left / unit
    # Columns of one candidate share their λ, so that turning them among themselves changes nothing.
    widest = owner == _widest(owner)
    turn = np.linalg.eigh(x[:, widest].T @ x[:, widest]).eigenvectors
    later = problem.beyond / scale
    x[:, widest], later[:, widest] = x[:, widest] @ turn, later[:, widest] @ turn
    gram, right = x.T @ x, x.T @ y
    free = y.size - problem.parameters
    drawn = _drawn(gram, right, float(y @ y), free, owner)
    included = drawn["size"] ** 2 * free / drawn["sigma"][:, None] ** 2 > 1.0  # κ < 1/2
    counts = Counter(tuple(np.flatnonzero(row).tolist()) for row in included)
    sets = {problem.names(s): count / len(included) for s, count in counts.items()}
    means, variances = [], []
    for at in range(0, len(included), max(1, len(included) // PREDICTED)):
        size, sigma = drawn["size"][at][owner], drawn["sigma"][at]
        inner = sigma**2 * np.eye(size.size) + size[:, None] * gram * size
        carried = later * size
        means.append(carried @ np.linalg.solve(inner, size * right))
        spread = np.linalg.solve(inner, carried.T).T
        variances.append(sigma**2 * (problem.of_base + np.sum(carried * spread, axis=1)))
    mean = problem.predict(())[0] + unit * np.mean(means, axis=0)
    variance = unit**2 * (np.mean(variances, axis=0) + np.var(means, axis=0))
    return {"sets": sets, "mean": mean, "sd": np.sqrt(variance + problem.extra)}


def _widest(owner: np.ndarray) -> int:
    """Return the candidate with the most columns."""
    return int(np.argmax(np.bincount(owner)))


def _drawn(
    gram: np.ndarray, right: np.ndarray, square: float, free: int, owner: np.ndarray
) -> dict[str, np.ndarray]:
    """Return draws of `sigma`, (draws,), and of `size`, the coefficients' sd of each candidate, (draws, D).

    Args:
        gram, right, square: X'X, X'y and y'y, the sufficient statistics of the likelihood.
        free: number of readings minus that of the base's parameters.
        owner: candidate of each column.
    """
    sampler = _sampler(tuple(owner.tolist()))
    sampler.run(jax.random.key(0), *map(jnp.asarray, (gram, right, square, float(free))))
    return {name: np.asarray(values) for name, values in sampler.get_samples().items()}


@cache
def _sampler(owners: tuple[int, ...]) -> numpyro.infer.MCMC:
    """Build the sampler for all tasks with this assignment of columns to candidates; compiled once per process."""
    owner = np.array(owners)
    count, width = int(owner[-1]) + 1, _widest(owner)

    def model(gram: jax.Array, right: jax.Array, square: jax.Array, free: jax.Array) -> None:
        sigma = numpyro.sample("sigma", dist.HalfCauchy(1.0))
        tau0 = GUESS / (count - GUESS) / jnp.sqrt(free)
        tau = sigma * tau0 * numpyro.sample("tau", dist.HalfCauchy(1.0))
        slab = numpyro.sample("slab", dist.InverseGamma(FREEDOM / 2, FREEDOM / 2 * SLAB**2))
        local = numpyro.sample("local", dist.HalfCauchy(1.0).expand([count]).to_event(1))
        size = jnp.sqrt(slab * (tau * local) ** 2 / (slab + (tau * local) ** 2))
        numpyro.deterministic("size", size)
        gain = gained(gram, right / sigma, size[owner] / sigma, owner == width)
        numpyro.factor("left", gain - square / (2 * sigma**2) - free * jnp.log(sigma))

    return numpyro.infer.MCMC(
        numpyro.infer.NUTS(model, target_accept_prob=0.9),
        num_warmup=WARM_UP, num_samples=DRAWS, num_chains=CHAINS,
        chain_method="vectorized", progress_bar=False, jit_model_args=True,
    )  # fmt: skip


def gained(gram: jax.Array, right: jax.Array, sd: jax.Array, mask: np.ndarray) -> jax.Array:
    """Return the log evidence of coefficients with a normal prior over none, by the block of the widest candidate.

    Args:
        gram: X'X, (p, p), diagonal in that block.
        right: X'y over the noise's standard deviation, (p,).
        sd: prior standard deviations of the coefficients over the noise's, (p,).
        mask: columns of that block, (p,).
    """
    inside = 1.0 + sd[mask] ** 2 * jnp.diag(gram)[mask]
    across = sd[mask][:, None] * gram[mask][:, ~mask] * sd[~mask]
    outer = jnp.eye(int((~mask).sum())) + sd[~mask][:, None] * gram[~mask][:, ~mask] * sd[~mask]
    root = jnp.linalg.cholesky(outer - across.T @ (across / inside[:, None]))
    first, second = sd[mask] * right[mask], sd[~mask] * right[~mask]
    z = jax.scipy.linalg.solve_triangular(root, second - across.T @ (first / inside), lower=True)
    explained = jnp.sum(first**2 / inside) + jnp.sum(z**2)
    return explained / 2 - jnp.sum(jnp.log(jnp.diag(root))) - jnp.sum(jnp.log(inside)) / 2
