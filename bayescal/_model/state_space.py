"""State-space form of correlated noise, its Kalman filter, which whitens residuals, and its smoother."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayescal._core.lazy_jax import Array, jax, jnp


class Block(NamedTuple):
    """State-space form of one noise term with k states, over the time steps before each of n readings."""

    transition: Float[Array, "n k k"]  # transition matrices A
    noise: Float[Array, "n k k"]  # covariance Q of the process noise
    start: Float[Array, "k k"]  # stationary covariance
    observes_all: bool = False  # whether a reading observes the sum of all states, or the first
    is_coupled: bool = True  # whether it has two states, each driven by both, or independent ones


def build_exponential(time: Any, variance: Any, h: Float[Array, "n"]) -> Block:
    """Build the block of independent Ornstein–Uhlenbeck processes: correlation times, variances (k,), steps h, s."""
    time, variance = jnp.atleast_1d(time), jnp.atleast_1d(variance)
    steps, eye = h[:, None] / time, jnp.eye(len(time))
    decay, noise = jnp.exp(-steps), -jnp.expm1(-2 * steps) * variance
    return Block(
        decay[..., None] * eye, noise[..., None] * eye, variance * eye, True, is_coupled=False
    )


def stack_2x2(a: Array, b: Array, c: Array, d: Array) -> Float[Array, "n 2 2"]:
    """Stack arrays (n,) into matrices [[a, b], [c, d]] (n, 2, 2)."""
    return jnp.stack([a, b, c, d], -1).reshape(-1, 2, 2)


class States(NamedTuple):
    """State-space form of a sum of terms with p states; each run starts in the stationary distribution."""

    transition: Float[Array, "n p p"]  # transition matrices A over the step before each reading
    noise: Float[Array, "n p p"]  # covariance Q of the process noise
    observation: Float[np.ndarray, "p"]  # observation vector h: a reading is hᵀ·state + white noise
    partner: Int[np.ndarray, "p"]  # index of the state coupled with each; its own if there is none


def assemble_states(blocks: Sequence[Block], step: Float[Array, "n"]) -> States:
    """Assemble blocks into one state space over time steps, s; a step of −1 begins a run.

    At the first reading of a run A = 0 and Q is the stationary covariance: runs are independent.
    """
    is_first, offset, size = (step < 0)[:, None, None], 0, sum(len(block.start) for block in blocks)
    transition = noise = jnp.zeros((step.shape[0], size, size))
    observation, partner = np.zeros(size), np.arange(size)
    for block in blocks:
        rows = slice(offset, offset + len(block.start))
        transition = transition.at[:, rows, rows].set(jnp.where(is_first, 0.0, block.transition))
        noise = noise.at[:, rows, rows].set(jnp.where(is_first, block.start, block.noise))
        observation[rows if block.observes_all else offset] = 1.0
        partner[rows] = partner[rows][:: -1 if block.is_coupled else 1]
        offset = rows.stop
    return States(transition, noise, observation, partner)


def draw_states(key: Array, states: States) -> Float[Array, "n"]:
    """Draw a path of the states; return what is observed of them, hᵀ·state (n,)."""
    eigenvalues, eigenvectors = jnp.linalg.eigh(states.noise)  # some eigenvalues may be zero
    deviates = jnp.sqrt(jnp.maximum(eigenvalues, 0.0)) * jax.random.normal(key, eigenvalues.shape)

    def advance(state, row):
        state = row[0] @ state + row[1]
        return state, state @ jnp.asarray(states.observation)

    rows = states.transition, jnp.einsum("nij,nj->ni", eigenvectors, deviates)
    return jax.lax.scan(advance, jnp.zeros(len(states.observation)), rows)[1]


def kalman_whiten(
    states: States, white_variance: Float[Array, "n"], columns: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n"]]:
    """Whiten columns by the Kalman filter; return them, and the log standard deviation of each innovation (n,).

    With P the covariance of the states given earlier readings, h the observation vector and w the white variance of a
    reading (`white_variance`): g = P·h, innovation variance s = hᵀg + w, gain g/s, and P ← A·(P − g·gᵀ/s)·Aᵀ + Q.
    """
    h, partner = jnp.asarray(states.observation), states.partner
    is_coupled = partner != (rows := np.arange(len(partner)))
    coefficients = states.transition[:, rows, rows], states.transition[:, rows, partner]

    def propagate(coefficients, x):
        """Return A·x as at most two elementwise products, which XLA fuses with adjacent operations."""
        diag, off_diag = (c[:, None] for c in coefficients)
        return diag * x + (is_coupled[:, None] * off_diag * x[partner] if is_coupled.any() else 0.0)

    # Variances and gains do not depend on the data: they are computed once for all columns.
    def advance_covariance(covariance, reading):
        transition, noise, reading_variance = reading
        prediction = propagate(transition, propagate(transition, covariance).T) + noise
        state_covariance = jnp.sum(prediction * h, axis=1)
        variance = jnp.sum(state_covariance * h) + reading_variance
        gain = state_covariance / variance
        return prediction - gain[:, None] * state_covariance, (variance, gain)

    def advance_mean(state_mean, reading):
        transition, gain, row = reading
        prediction = propagate(transition, state_mean)
        innovation = row - jnp.sum(prediction * h[:, None], axis=0)
        return prediction + gain[:, None] * innovation, innovation

    initial, rows = jnp.zeros((len(h), len(h))), (coefficients, states.noise, white_variance)
    variance, gain = jax.lax.scan(advance_covariance, initial, rows)[1]
    initial, rows = jnp.zeros((len(h), columns.shape[1])), (coefficients, gain, columns)
    innovation = jax.lax.scan(advance_mean, initial, rows)[1]
    return innovation / jnp.sqrt(variance)[:, None], 0.5 * jnp.log(variance)


def smooth(
    states: States, precision: Float[Array, "n"], weighted_residuals: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n"]]:
    """Return the smoothed mean (n, m) and variance (n,) of the correlated noise, given all readings of the run.

    precision: inverse white variance of each row, 0 in a row without a reading. weighted_residuals: times precision.

    With f the correlated noise, a reading of precision p and weighted residual b has the likelihood exp(b·f − ½·p·f²)
    up to a factor. The moments are derivatives of Z = E[Π exp(b·f − ½·p·f²)], which the Kalman filter gives: the mean
    is ∂log Z/∂b, the variance −2·∂log Z/∂p at b = 0.
    """
    h, count = jnp.asarray(states.observation), len(states.observation)

    def advance(state, row):
        (mean, covariance), (transition, noise, b, p) = state, row
        mean, covariance = transition @ mean, transition @ covariance @ transition.T + noise
        f_mean, state_covariance = h @ mean, covariance @ h
        f_variance = h @ state_covariance
        gain = state_covariance / (1 + p * f_variance)
        exponent = f_variance * b**2 + 2 * b * f_mean - p * f_mean**2
        mean = mean + gain[:, None] * (b - p * f_mean)
        covariance = covariance - p * gain[:, None] * state_covariance
        log_z = 0.5 * exponent / (1 + p * f_variance) - 0.5 * jnp.log1p(p * f_variance)
        return (mean, covariance), log_z

    def sum_log_z(weighted_residuals, precision):
        initial = jnp.zeros((count, weighted_residuals.shape[1])), jnp.zeros((count, count))
        rows = states.transition, states.noise, weighted_residuals, precision
        return jnp.sum(jax.lax.scan(advance, initial, rows)[1])

    mean = jax.grad(sum_log_z)(weighted_residuals, precision)
    return mean, -2 * jax.grad(sum_log_z, argnums=1)(jnp.zeros((len(precision), 1)), precision)
