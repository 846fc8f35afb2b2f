"""State-space form of correlated noise, and the Kalman filter that whitens by it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.lazy_jax import Array, jax, jnp


class Block(NamedTuple):
    """States of a term over the steps before n readings."""

    carry: Float[Array, "n k k"]  # transition matrices (n, k, k)
    fresh: Float[Array, "n k k"]  # covariance of the process noise (n, k, k)
    start: Float[Array, "k k"]  # the stationary covariance (k, k)
    observed: bool = False  # whether a reading shows all of them together, or the first alone


def exponential(time: Any, variance: Any, h: Float[Array, "n"]) -> Block:
    """Return the states of Ornstein–Uhlenbeck processes of these times and variances."""
    time, variance = jnp.atleast_1d(time), jnp.atleast_1d(variance)
    steps, eye = h[:, None] / time, jnp.eye(len(time))
    decay, fresh = jnp.exp(-steps), -jnp.expm1(-2 * steps) * variance
    return Block(decay[..., None] * eye, fresh[..., None] * eye, variance * eye, observed=True)


def pairs(a: Array, b: Array, c: Array, d: Array) -> Float[Array, "n 2 2"]:
    """Stack matrices [[a, b], [c, d]]."""
    return jnp.stack([a, b, c, d], -1).reshape(-1, 2, 2)


class States(NamedTuple):
    """All states of a sum, a row for each reading; at a run's first reading they start stationary."""

    carry: Float[Array, "n p p"]  # transition over the step before (n, p, p)
    fresh: Float[Array, "n p p"]  # covariance of the process noise (n, p, p)
    observed: Float[np.ndarray, "p"]  # how much of each state a reading shows (p,)


def states_of(blocks: Sequence[Block], step: Float[Array, "n"]) -> States:
    """Assemble the states of blocks over steps, s; −1 where they begin.

    There the transition is zero and the states have their stationary covariance: runs are independent.
    """
    first, at, count = (step < 0)[:, None, None], 0, sum(len(block.start) for block in blocks)
    carry = fresh = jnp.zeros((step.shape[0], count, count))
    observed = np.zeros(count)
    for block in blocks:
        rows = slice(at, at + len(block.start))
        carry = carry.at[:, rows, rows].set(jnp.where(first, 0.0, block.carry))
        fresh = fresh.at[:, rows, rows].set(jnp.where(first, block.start, block.fresh))
        observed[rows if block.observed else at] = 1.0
        at = rows.stop
    return States(carry, fresh, observed)


def drawn(key: Array, states: States) -> Float[Array, "n"]:
    """Draw the states and return their sum as readings show it."""
    values, vectors = jnp.linalg.eigh(states.fresh)  # of which some may be zero
    normal = jnp.sqrt(jnp.maximum(values, 0.0)) * jax.random.normal(key, values.shape)

    def advance(state, row):
        carry, noise = row
        advanced = carry @ state + noise
        return advanced, advanced @ jnp.asarray(states.observed)

    rows = states.carry, jnp.einsum("nij,nj->ni", vectors, normal)
    return jax.lax.scan(advance, jnp.zeros(len(states.observed)), rows)[1]


def filtered(
    states: States, white: Float[Array, "n"], columns: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n"]]:
    """Whiten columns by the Kalman filter; return them, and the log standard deviation of each innovation.

    With P the covariance of the states given the readings before, w the variance of a reading by itself: g = P·1 over
    the states shown, s = 1ᵀg + w of the reading, gain g/s; P becomes A·(P − g·gᵀ/s)·Aᵀ + Q.
    """
    passed = _forward(states, white, columns)
    return passed.new / jnp.sqrt(passed.total)[:, None], 0.5 * jnp.log(passed.total)


class _Passed(NamedTuple):
    """Results of the forward pass of the filter, by reading."""

    new: Float[Array, "n m"]  # innovation of each column
    total: Float[Array, "n"]  # its variance
    gain: Float[Array, "n p"]
    covariance: Float[Array, "n p p"]  # of the states given the readings before
    mean: Float[Array, "n p m"]  # and their mean


def _forward(states: States, white: Float[Array, "n"], columns: Float[Array, "n m"]) -> _Passed:
    h, count = jnp.asarray(states.observed), len(states.observed)

    # Variances and gains depend on no column: they are computed first, once for all.
    def ahead(before, reading):
        carry, fresh, white_variance = reading
        predicted = _times(carry, _times(carry, before).T) + fresh
        column = jnp.sum(predicted * h, axis=1)
        total = jnp.sum(column * h) + white_variance
        gain = column / total
        return predicted - gain[:, None] * column, (total, gain, predicted)

    def further(before, reading):
        carry, gain, row = reading
        predicted = _times(carry, before)
        new = row - jnp.sum(predicted * h[:, None], axis=0)
        return predicted + gain[:, None] * new, (new, predicted)

    initial, rows = jnp.zeros((count, count)), (states.carry, states.fresh, white)
    total, gain, covariance = jax.lax.scan(ahead, initial, rows, unroll=2)[1]
    initial, rows = jnp.zeros((count, columns.shape[1])), (states.carry, gain, columns)
    new, mean = jax.lax.scan(further, initial, rows, unroll=2)[1]
    return _Passed(new, total, gain, covariance, mean)


def smoothed(
    states: States, white: Float[Array, "n"], columns: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n"]]:
    """Return mean and variance of the states' sum at each row, given all readings of its run; column by column.

    The white variance of a row is infinite where there is no reading.
    Source: J. Durbin and S. Koopman, Time Series Analysis by State Space Methods (2012), §4.4.
    """
    h = jnp.asarray(states.observed)

    # r = h·v/F + (1 − k·hᵀ)ᵀ·Aᵀr and N = h·hᵀ/F + (1 − k·hᵀ)ᵀ·AᵀN·A·(1 − k·hᵀ) gather what this reading and later
    # ones say, v what is new in one, F its variance and k its gain; the state's mean moves by P·r, its covariance by
    # −P·N·P, P the covariance before the reading.
    def back(later, row):
        (r, big), (carry, now) = later, row
        column, passes = now.covariance @ h, jnp.eye(len(h)) - now.gain[:, None] * h
        r = h[:, None] * (now.new / now.total) + _times(passes.T, r)
        big = h[:, None] * h / now.total + _times(_times(passes.T, big), passes)
        mean = h @ now.mean + column @ r
        variance = column @ h - column @ _times(big, column[:, None])[:, 0]
        return (_times(carry.T, r), _times(carry.T, _times(big, carry))), (mean, variance)

    size = len(h)
    initial = jnp.zeros((size, columns.shape[1])), jnp.zeros((size, size))
    rows = states.carry, _forward(states, white, columns)
    _, (mean, variance) = jax.lax.scan(back, initial, rows, reverse=True)
    return mean, jnp.maximum(variance, 0.0)


def _times(a: Float[Array, "p q"], b: Float[Array, "q m"]) -> Float[Array, "p m"]:
    """Multiply small matrices, as one loop that the compiler fuses with its neighbours."""
    return jnp.sum(a[:, :, None] * b[None], axis=1)
