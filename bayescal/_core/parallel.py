"""How work is shared out: a function mapped in batches; linear algebra on one thread.

Matrices here have ten to a hundred rows: several threads of BLAS would spend their time waiting for each other.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")


@cache
def _threads() -> ThreadpoolController:
    return ThreadpoolController()


def on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """The function, BLAS held to one thread and overflow passed over while it runs."""

    @wraps(function)
    def held(*args: P.args, **kwargs: P.kwargs) -> R:
        with _threads().limit(limits=1, user_api="blas"), np.errstate(all="ignore"):
            return function(*args, **kwargs)

    return held


def over(function: Callable[[Any], Any], inputs: Any, batch: int) -> Any:
    """`vmap(function)(inputs)`, `batch` at a time. Arrays of zero size are allowed."""
    count = jax.tree.leaves(inputs)[0].shape[0]
    batch = min(batch, count)
    loops = -(-count // batch)
    spare = loops * batch - count

    def fold(a):
        # `lax.map` takes whole batches: the last input stands in for missing ones, and its results are cut off.
        padded = jnp.concatenate([a, jnp.repeat(a[-1:], spare, axis=0)]) if spare else a
        return padded.reshape(loops, batch, *a.shape[1:])

    def unfold(a):
        return a.reshape(loops * batch, *a.shape[2:])[:count]

    return jax.tree.map(unfold, jax.lax.map(jax.vmap(function), jax.tree.map(fold, inputs)))
