"""Correlated noise as states that go on from reading to reading, and the Kalman filter that whitens by them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Block(NamedTuple):
    """States of a term over the steps before n readings; all independent of each other, or a pair.

    Attributes:
        carry: what is kept of each state (n, k); or of a pair by a pair (n, 2, 2).
        root: what is new is `root` times independent standard normal numbers (n, k); or (n, 2, 2).
        start: stationary standard deviations (k,); or a root of the covariance (2, 2).
        passed: of a chain of two states, how much of the first the second has after the step; a chain stands last.
    """

    carry: Float[Array, "n *k"]
    root: Float[Array, "n *k"]
    start: Float[Array, "*k"]
    passed: float = 0.0


def exponential(time: Any, variance: Any, h: Float[Array, "n"]) -> Block:
    """Ornstein–Uhlenbeck processes of these times and variances."""
    time, size = jnp.atleast_1d(time), jnp.sqrt(jnp.atleast_1d(variance))
    steps = h[:, None] / time
    # At a run's first reading the step is zero and nothing is new. The inner `where` keeps the root's slope finite
    # there: automatic differentiation computes both branches, and 0·∞ is no number.
    fall = jnp.where(steps > 0, -jnp.expm1(-2 * steps), 0.0)
    root = jnp.where(fall > 0, jnp.sqrt(jnp.where(fall > 0, fall, 1.0)), 0.0)
    return Block(jnp.exp(-steps), size * root, size)


def pairs(a: Array, b: Array, c: Array, d: Array) -> Float[Array, "n 2 2"]:
    """Matrices [[a, b], [c, d]]."""
    return jnp.stack([a, b, c, d], -1).reshape(-1, 2, 2)


class States(NamedTuple):
    """All states of a sum, a row for each reading; those of a run's first reading begin anew.

    Attributes:
        carry: what is kept over the step before: of each state (n, p), or of all by all (n, p, p).
        fresh: covariance of what is new: (n, p) of each state, or (n, p, p).
        shown: how much of each state a reading shows (p,).
        last: how much of each state the last one takes up over the step before (n, p), where none else does of another.
    """

    carry: Float[Array, "n *p"]
    fresh: Float[Array, "n *p"]
    shown: Float[np.ndarray, "p"]
    last: Float[Array, "n p"] | None = None


def joined(blocks: Sequence[Block], step: Float[Array, "n"]) -> tuple[Any, Any, Any]:
    """What is kept of all states; what is new in them, per independent standard normal number; and `States.last`.

    At a run's first reading, of step −1, nothing is kept and the states have their stationary covariance: runs are
    independent.
    """
    carry, root = [], []
    for block in blocks:
        first = jnp.expand_dims(step < 0, range(1, block.carry.ndim))
        carry.append(jnp.where(first, 0.0, block.carry))
        root.append(jnp.where(first, block.start, block.root))
    apart = all(block.carry.ndim == 2 for block in blocks)
    together = (lambda a: jnp.concatenate(a, 1)) if apart else _diagonal
    kept, new = together(carry), together(root)
    if not (passed := blocks[-1].passed):
        return kept, new, None
    last = jnp.zeros(kept.shape[:2]).at[:, -2].set(jnp.where(step < 0, 0.0, passed))
    return (kept, new, last) if apart else (kept.at[:, -1].add(last), new, None)


def states_of(
    blocks: Sequence[Block], step: Float[Array, "n"], shown: Float[np.ndarray, "p"]
) -> States:
    """The states of blocks over steps, s; −1 where they begin."""
    carry, root, last = joined(blocks, step)
    fresh = root**2 if root.ndim == 2 else root @ jnp.swapaxes(root, 1, 2)
    return States(carry, fresh, shown, last)


def drawn(
    key: Array, blocks: Sequence[Block], step: Float[Array, "n"], shown: Float[np.ndarray, "p"]
) -> Float[Array, "n"]:
    """What readings show of the states of blocks, drawn."""
    carry, root, last = joined(blocks, step)
    normal = jax.random.normal(key, (step.shape[0], len(shown)))
    push = root * normal if root.ndim == 2 else jnp.einsum("nij,nj->ni", root, normal)

    def advance(state, row):
        kept, taken, own = row
        made = (kept * state if kept.ndim == 1 else kept @ state) + own
        if taken is not None:
            made = made.at[-1].add(taken @ state)
        return made, made @ jnp.asarray(shown)

    return jax.lax.scan(advance, jnp.zeros(len(shown)), (carry, last, push))[1]


def filtered(
    states: States, white: Float[Array, "n"], columns: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n"]]:
    """Whiten columns by the Kalman filter; return them, and the log standard deviation of each innovation.

    With P the covariance of the states given the readings before: g = P·1 over the states shown, s = 1ᵀg + w of the
    reading, gain g/s; P goes on as A·(P − g·gᵀ/s)·Aᵀ + what is new.

    Args:
        states: of a sum.
        white: variance w of each reading by itself.
        columns: in the order of time within runs.
    """
    passed = _forward(states, white, columns)
    return passed.new / jnp.sqrt(passed.total)[:, None], 0.5 * jnp.log(passed.total)


class _Passed(NamedTuple):
    """What a pass of the filter finds at each reading."""

    new: Float[Array, "n m"]  # innovation of each column
    total: Float[Array, "n"]  # its variance
    gain: Float[Array, "n p"]
    before: Float[
        Array, "n p p"
    ]  # covariance of the states given the readings before, at the one before
    mean: Float[Array, "n p m"]  # and their mean


def _forward(states: States, white: Float[Array, "n"], columns: Float[Array, "n m"]) -> _Passed:
    seen, count = jnp.asarray(states.shown), len(states.shown)

    # Variances and gains hang on no column: they are found first, once for all.
    def ahead(before, reading):
        kept, taken, fresh, own = reading
        made = _ahead(kept, taken, fresh, before)
        column = jnp.sum(made * seen, axis=1)
        total = jnp.sum(column * seen) + own
        gain = column / total
        return made - gain[:, None] * column, (total, gain, before)

    def further(before, reading):
        kept, taken, gain, row = reading
        made = _step(kept, taken, before)
        new = row - jnp.sum(made * seen[:, None], axis=0)
        return made + gain[:, None] * new, (new, before)

    nothing, rows = jnp.zeros((count, count)), (states.carry, states.last, states.fresh, white)
    total, gain, covariance = jax.lax.scan(ahead, nothing, rows, unroll=2)[1]
    nothing, rows = jnp.zeros((count, columns.shape[1])), (states.carry, states.last, gain, columns)
    new, mean = jax.lax.scan(further, nothing, rows, unroll=2)[1]
    return _Passed(new, total, gain, covariance, mean)


def _step(kept: Array, taken: Array | None, value: Float[Array, "p m"]) -> Float[Array, "p m"]:
    """Return A·value, A the step that `States` describe by what is kept and what the last state takes up."""
    if kept.ndim == 2:
        return _times(kept, value)
    made = kept[:, None] * value
    if taken is not None:
        made = made + jnp.eye(len(kept))[:, -1:] * jnp.sum(taken[:, None] * value, axis=0)
    return made


def _step_back(kept: Array, taken: Array | None, value: Float[Array, "p m"]) -> Float[Array, "p m"]:
    """Return Aᵀ·value."""
    if kept.ndim == 2:
        return _times(kept.T, value)
    made = kept[:, None] * value
    return made if taken is None else made + taken[:, None] * value[-1]


def _ahead(kept: Array, taken: Array | None, fresh: Array, covariance: Array) -> Array:
    """Return A·P·Aᵀ and what is new over the step."""
    made = _step(kept, taken, _step(kept, taken, covariance).T)
    return made + (jnp.diag(fresh) if fresh.ndim == 1 else fresh)


def smoothed(
    states: States, white: Float[Array, "n"], columns: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n"]]:
    """Mean and variance of what the states show at each row, given all readings of its run; a column by itself.

    Args:
        states: of a sum.
        white: variance of each reading by itself; infinite where there is none, and the states alone are asked for.
        columns: readings, in the order of time within runs.

    Source: J. Durbin and S. Koopman, Time Series Analysis by State Space Methods (2012), §4.4.
    """
    seen = jnp.asarray(states.shown)
    passed = _forward(states, white, columns)

    # r = h·v/F + (1 − k·hᵀ)ᵀ·Aᵀr and N = h·hᵀ/F + (1 − k·hᵀ)ᵀ·AᵀN·A·(1 − k·hᵀ) gather what this reading and later
    # ones say, v what is new in one, F its variance and k its gain; the state's mean moves by P·r, its covariance by
    # −P·N·P, P the covariance before the reading.
    def back(later, row):
        (r, big), (kept, taken, fresh, now) = later, row
        column = _ahead(kept, taken, fresh, now.before) @ seen
        passes = jnp.eye(len(seen)) - now.gain[:, None] * seen
        r = seen[:, None] * (now.new / now.total) + _times(passes.T, r)
        big = seen[:, None] * seen / now.total + _times(_times(passes.T, big), passes)
        mean = seen @ _step(kept, taken, now.mean) + column @ r
        variance = column @ seen - column @ _times(big, column[:, None])[:, 0]
        r = _step_back(kept, taken, r)
        return (r, _step_back(kept, taken, _step_back(kept, taken, big).T)), (mean, variance)

    size = len(seen)
    nothing = jnp.zeros((size, columns.shape[1])), jnp.zeros((size, size))
    rows = states.carry, states.last, states.fresh, passed
    _, (mean, variance) = jax.lax.scan(back, nothing, rows, reverse=True)
    return mean, jnp.maximum(variance, 0.0)


def _diagonal(blocks: list[Array]) -> Float[Array, "n p p"]:
    """Blocks along the diagonal; those of one row each are diagonals themselves."""
    count = sum(b.shape[1] for b in blocks)
    made, at = jnp.zeros((blocks[0].shape[0], count, count)), 0
    for block in blocks:
        size = block.shape[1]
        wide = block if block.ndim == 3 else block[:, :, None] * jnp.eye(size)
        made = made.at[:, at : at + size, at : at + size].set(wide)
        at += size
    return made


def _times(a: Float[Array, "p q"], b: Float[Array, "q m"]) -> Float[Array, "p m"]:
    """A product of small matrices, as one loop that the compiler fuses with its neighbours."""
    return jnp.sum(a[:, :, None] * b[None], axis=1)
