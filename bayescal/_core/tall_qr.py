"""R of the QR factors of a tall table, a stretch of rows at a time: little memory, and each stretch stays in cache."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

STRETCH = 8192  # rows


def triangle(table: Float[Array, "n p"]) -> Float[Array, "q p"]:
    """R up to the signs of its rows; q is the smaller of n and p."""
    whole, columns = len(table) // STRETCH, table.shape[1]
    if whole < 2 or columns > STRETCH:
        return jnp.linalg.qr(table, mode="r")

    def further(i: Array, upper: Float[Array, "p p"]) -> Float[Array, "p p"]:
        rows = jax.lax.dynamic_slice_in_dim(table, i * STRETCH, STRETCH)
        return jnp.linalg.qr(jnp.concatenate([upper, rows]), mode="r")

    upper = jax.lax.fori_loop(1, whole, further, jnp.linalg.qr(table[:STRETCH], mode="r"))
    rest = table[whole * STRETCH :]
    return jnp.linalg.qr(jnp.concatenate([upper, rest]), mode="r") if len(rest) else upper
