"""Correlated noise as states that go on from reading to reading, and the Kalman filter that whitens by them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.lazy_jax import Array, jax, jnp


class Block(NamedTuple):
    """States of a term over the steps before n readings."""

    carry: Float[Array, "n k k"]  # what is kept of each state, by all (n, k, k)
    fresh: Float[Array, "n k k"]  # covariance of what is new (n, k, k)
    start: Float[Array, "k k"]  # the stationary covariance (k, k)
    shown: bool = False  # whether a reading shows all of them together, or the first alone


def exponential(time: Any, variance: Any, h: Float[Array, "n"]) -> Block:
    """Ornstein–Uhlenbeck processes of these times and variances."""
    time, variance = jnp.atleast_1d(time), jnp.atleast_1d(variance)
    steps, each = h[:, None] / time, jnp.eye(len(time))
    kept, fresh = jnp.exp(-steps), -jnp.expm1(-2 * steps) * variance
    return Block(kept[..., None] * each, fresh[..., None] * each, variance * each, shown=True)


def pairs(a: Array, b: Array, c: Array, d: Array) -> Float[Array, "n 2 2"]:
    """Matrices [[a, b], [c, d]]."""
    return jnp.stack([a, b, c, d], -1).reshape(-1, 2, 2)


class States(NamedTuple):
    """All states of a sum, a row for each reading; those of a run's first reading begin anew."""

    carry: Float[Array, "n p p"]  # what is kept over the step before (n, p, p)
    fresh: Float[Array, "n p p"]  # covariance of what is new (n, p, p)
    shown: Float[np.ndarray, "p"]  # how much of each state a reading shows (p,)


def states_of(blocks: Sequence[Block], step: Float[Array, "n"]) -> States:
    """The states of blocks over steps, s; −1 where they begin.

    There nothing is kept and the states have their stationary covariance: runs are independent.
    """
    first, at, count = (step < 0)[:, None, None], 0, sum(len(block.start) for block in blocks)
    carry = fresh = jnp.zeros((step.shape[0], count, count))
    shown = np.zeros(count)
    for block in blocks:
        own = slice(at, at + len(block.start))
        carry = carry.at[:, own, own].set(jnp.where(first, 0.0, block.carry))
        fresh = fresh.at[:, own, own].set(jnp.where(first, block.start, block.fresh))
        shown[own if block.shown else at] = 1.0
        at = own.stop
    return States(carry, fresh, shown)


def drawn(key: Array, states: States) -> Float[Array, "n"]:
    """What readings show of states, drawn."""
    values, vectors = jnp.linalg.eigh(states.fresh)  # of which some may be zero
    normal = jnp.sqrt(jnp.maximum(values, 0.0)) * jax.random.normal(key, values.shape)

    def advance(state, row):
        kept, own = row
        made = kept @ state + own
        return made, made @ jnp.asarray(states.shown)

    rows = states.carry, jnp.einsum("nij,nj->ni", vectors, normal)
    return jax.lax.scan(advance, jnp.zeros(len(states.shown)), rows)[1]


def filtered(
    states: States, white: Float[Array, "n"], columns: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n"]]:
    """Whiten columns by the Kalman filter; return them, and the log standard deviation of each innovation.

    With P the covariance of the states given the readings before, w the variance of a reading by itself: g = P·1 over
    the states shown, s = 1ᵀg + w of the reading, gain g/s; P goes on as A·(P − g·gᵀ/s)·Aᵀ + what is new.
    """
    passed = _forward(states, white, columns)
    return passed.new / jnp.sqrt(passed.total)[:, None], 0.5 * jnp.log(passed.total)


class _Passed(NamedTuple):
    """What a pass of the filter finds at each reading."""

    new: Float[Array, "n m"]  # innovation of each column
    total: Float[Array, "n"]  # its variance
    gain: Float[Array, "n p"]
    covariance: Float[Array, "n p p"]  # of the states given the readings before
    mean: Float[Array, "n p m"]  # and their mean


def _forward(states: States, white: Float[Array, "n"], columns: Float[Array, "n m"]) -> _Passed:
    seen, count = jnp.asarray(states.shown), len(states.shown)

    # Variances and gains hang on no column: they are found first, once for all.
    def ahead(before, reading):
        kept, fresh, own = reading
        made = _times(kept, _times(kept, before).T) + fresh
        column = jnp.sum(made * seen, axis=1)
        total = jnp.sum(column * seen) + own
        gain = column / total
        return made - gain[:, None] * column, (total, gain, made)

    def further(before, reading):
        kept, gain, row = reading
        made = _times(kept, before)
        new = row - jnp.sum(made * seen[:, None], axis=0)
        return made + gain[:, None] * new, (new, made)

    nothing, rows = jnp.zeros((count, count)), (states.carry, states.fresh, white)
    total, gain, covariance = jax.lax.scan(ahead, nothing, rows, unroll=2)[1]
    nothing, rows = jnp.zeros((count, columns.shape[1])), (states.carry, gain, columns)
    new, mean = jax.lax.scan(further, nothing, rows, unroll=2)[1]
    return _Passed(new, total, gain, covariance, mean)


def smoothed(
    states: States, white: Float[Array, "n"], columns: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n"]]:
    """Mean and variance of what the states show at each row, given all readings of its run; a column by itself.

    The variance of a reading by itself is infinite where there is none, and the states alone are asked for.
    Source: J. Durbin and S. Koopman, Time Series Analysis by State Space Methods (2012), §4.4.
    """
    seen = jnp.asarray(states.shown)

    # r = h·v/F + (1 − k·hᵀ)ᵀ·Aᵀr and N = h·hᵀ/F + (1 − k·hᵀ)ᵀ·AᵀN·A·(1 − k·hᵀ) gather what this reading and later
    # ones say, v what is new in one, F its variance and k its gain; the state's mean moves by P·r, its covariance by
    # −P·N·P, P the covariance before the reading.
    def back(later, row):
        (r, big), (kept, now) = later, row
        column, passes = now.covariance @ seen, jnp.eye(len(seen)) - now.gain[:, None] * seen
        r = seen[:, None] * (now.new / now.total) + _times(passes.T, r)
        big = seen[:, None] * seen / now.total + _times(_times(passes.T, big), passes)
        mean = seen @ now.mean + column @ r
        variance = column @ seen - column @ _times(big, column[:, None])[:, 0]
        return (_times(kept.T, r), _times(kept.T, _times(big, kept))), (mean, variance)

    size = len(seen)
    nothing = jnp.zeros((size, columns.shape[1])), jnp.zeros((size, size))
    rows = states.carry, _forward(states, white, columns)
    _, (mean, variance) = jax.lax.scan(back, nothing, rows, reverse=True)
    return mean, jnp.maximum(variance, 0.0)


def _times(a: Float[Array, "p q"], b: Float[Array, "q m"]) -> Float[Array, "p m"]:
    """A product of small matrices, as one loop that the compiler fuses with its neighbours."""
    return jnp.sum(a[:, :, None] * b[None], axis=1)
