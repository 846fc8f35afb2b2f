"""State-space form of correlated noise, and its Kalman filter, which whitens residuals, and smoother."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.lazy_jax import Array, jax, jnp


class Block(NamedTuple):
    """State-space form of one noise term with k states, over the time steps before each of n readings."""

    transition: Float[Array, "n k k"]  # transition matrices A
    noise: Float[Array, "n k k"]  # covariance Q of the process noise
    start: Float[Array, "k k"]  # stationary covariance
    observes_all: bool = False  # whether a reading observes the sum of all states, or the first


def exponential_block(time: Any, variance: Any, h: Float[Array, "n"]) -> Block:
    """Return the block of independent Ornstein–Uhlenbeck processes with correlation times (k,) and variances (k,)."""
    time, variance = jnp.atleast_1d(time), jnp.atleast_1d(variance)
    steps, eye = h[:, None] / time, jnp.eye(len(time))
    decay, noise = jnp.exp(-steps), -jnp.expm1(-2 * steps) * variance
    return Block(decay[..., None] * eye, noise[..., None] * eye, variance * eye, observes_all=True)


def matrix_2x2(a: Array, b: Array, c: Array, d: Array) -> Float[Array, "n 2 2"]:
    """Stack arrays (n,) into matrices [[a, b], [c, d]] (n, 2, 2)."""
    return jnp.stack([a, b, c, d], -1).reshape(-1, 2, 2)


class States(NamedTuple):
    """State-space form of a sum of terms with p states; each run starts in the stationary distribution."""

    transition: Float[Array, "n p p"]  # transition matrices A over the step before each reading
    noise: Float[Array, "n p p"]  # covariance Q of the process noise
    observation: Float[np.ndarray, "p"]  # observation vector h: a reading is hᵀ·state + white noise


def assemble_states(blocks: Sequence[Block], step: Float[Array, "n"]) -> States:
    """Assemble blocks into one state space over time steps, s; a step of −1 begins a run.

    At the first reading of a run A = 0 and Q is the stationary covariance: runs are independent.
    """
    is_first, offset, size = (step < 0)[:, None, None], 0, sum(len(block.start) for block in blocks)
    transition = noise = jnp.zeros((step.shape[0], size, size))
    observation = np.zeros(size)
    for block in blocks:
        rows = slice(offset, offset + len(block.start))
        transition = transition.at[:, rows, rows].set(jnp.where(is_first, 0.0, block.transition))
        noise = noise.at[:, rows, rows].set(jnp.where(is_first, block.start, block.noise))
        observation[rows if block.observes_all else offset] = 1.0
        offset = rows.stop
    return States(transition, noise, observation)


def draw_states(key: Array, states: States) -> Float[Array, "n"]:
    """Draw a path of the states and return the observed sum hᵀ·state (n,)."""
    eigenvalues, eigenvectors = jnp.linalg.eigh(states.noise)  # some eigenvalues may be zero
    normal = jnp.sqrt(jnp.maximum(eigenvalues, 0.0)) * jax.random.normal(key, eigenvalues.shape)

    def advance(state, row):
        transition, noise = row
        next_state = transition @ state + noise
        return next_state, next_state @ jnp.asarray(states.observation)

    rows = states.transition, jnp.einsum("nij,nj->ni", eigenvectors, normal)
    return jax.lax.scan(advance, jnp.zeros(len(states.observation)), rows)[1]


def kalman_whiten(
    states: States, white_variance: Float[Array, "n"], columns: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n"]]:
    """Whiten columns by the Kalman filter; return them, and the log standard deviation of each innovation (n,).

    With P the covariance of the states given earlier readings, h the observation vector and w the white variance of a
    reading (`white_variance`): g = P·h, innovation variance s = hᵀg + w, gain g/s, and P ← A·(P − g·gᵀ/s)·Aᵀ + Q.
    """
    result = _filter(states, white_variance, columns)
    return result.innovation / jnp.sqrt(result.variance)[:, None], 0.5 * jnp.log(result.variance)


class _FilterPass(NamedTuple):
    """Results of the Kalman filter for each reading: innovations, gains, and predicted states."""

    innovation: Float[Array, "n m"]  # innovations of each column
    variance: Float[Array, "n"]  # variance of the innovation
    gain: Float[Array, "n p"]
    covariance: Float[Array, "n p p"]  # covariance of the states given earlier readings
    mean: Float[Array, "n p m"]  # mean of the states given earlier readings


def _filter(states: States, white_variance: Array, columns: Float[Array, "n m"]) -> _FilterPass:
    h, count = jnp.asarray(states.observation), len(states.observation)

    # Variances and gains do not depend on the data: they are computed once for all columns.
    def advance_covariance(previous, reading):
        transition, noise, reading_variance = reading
        predicted = _multiply(transition, _multiply(transition, previous).T) + noise
        state_covariance = jnp.sum(predicted * h, axis=1)
        variance = jnp.sum(state_covariance * h) + reading_variance
        gain = state_covariance / variance
        return predicted - gain[:, None] * state_covariance, (variance, gain, predicted)

    def advance_mean(previous, reading):
        transition, gain, row = reading
        predicted = _multiply(transition, previous)
        innovation = row - jnp.sum(predicted * h[:, None], axis=0)
        return predicted + gain[:, None] * innovation, (innovation, predicted)

    initial, rows = jnp.zeros((count, count)), (states.transition, states.noise, white_variance)
    variance, gain, covariance = jax.lax.scan(advance_covariance, initial, rows, unroll=2)[1]
    initial, rows = jnp.zeros((count, columns.shape[1])), (states.transition, gain, columns)
    innovation, mean = jax.lax.scan(advance_mean, initial, rows, unroll=2)[1]
    return _FilterPass(innovation, variance, gain, covariance, mean)


def smooth(
    states: States, white_variance: Float[Array, "n"], columns: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n"]]:
    """Return the smoothed mean (n, m) and variance (n,) of the correlated noise, given all readings of the run.

    white_variance: white-noise variance of each row; infinite in a row without a reading. columns: residuals.
    Source: J. Durbin and S. Koopman, Time Series Analysis by State Space Methods (2012), §4.4.
    """
    h = jnp.asarray(states.observation)

    # r = h·v/F + (1 − k·hᵀ)ᵀ·Aᵀr and N = h·hᵀ/F + (1 − k·hᵀ)ᵀ·AᵀN·A·(1 − k·hᵀ) sum over this and all later readings
    # (v innovation, F its variance, k gain, P predicted covariance): the smoothed mean is the predicted mean plus P·r,
    # the smoothed covariance P − P·N·P.
    def step_backward(sums, reading):
        (r, info), (a, filter_pass) = sums, reading
        column, update = filter_pass.covariance @ h, jnp.eye(len(h)) - filter_pass.gain[:, None] * h
        r = h[:, None] * (filter_pass.innovation / filter_pass.variance) + _multiply(update.T, r)
        info = h[:, None] * h / filter_pass.variance + _multiply(_multiply(update.T, info), update)
        mean = h @ filter_pass.mean + column @ r
        variance = column @ h - column @ _multiply(info, column[:, None])[:, 0]
        return (_multiply(a.T, r), _multiply(a.T, _multiply(info, a))), (mean, variance)

    size = len(h)
    initial = jnp.zeros((size, columns.shape[1])), jnp.zeros((size, size))
    rows = states.transition, _filter(states, white_variance, columns)
    _, (mean, variance) = jax.lax.scan(step_backward, initial, rows, reverse=True)
    return mean, jnp.maximum(variance, 0.0)


def _multiply(a: Float[Array, "p q"], b: Float[Array, "q m"]) -> Float[Array, "p m"]:
    """Multiply small matrices by broadcasting, which XLA fuses with adjacent operations."""
    return jnp.sum(a[:, :, None] * b[None], axis=1)
