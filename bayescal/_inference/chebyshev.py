"""Polynomial interpolation at Chebyshev nodes."""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float


@cache
def chebpts(count: int) -> Float[np.ndarray, "c"]:
    """Return the Chebyshev nodes of the first kind on [−1, 1], in descending order."""
    return np.cos((np.arange(count) + 0.5) * np.pi / count)


def chebvander(x: Float[np.ndarray, "*b"], count: int) -> Float[np.ndarray, "*b c"]:
    """Evaluate the Chebyshev polynomials of orders 0 … count − 1 at x in [−1, 1] (pseudo-Vandermonde matrix)."""
    return np.cos(np.arccos(np.clip(x, -1.0, 1.0))[..., None] * np.arange(count))


@cache
def values_to_coefficients(count: int) -> Float[np.ndarray, "k c"]:
    """Return the matrix that maps values at Chebyshev nodes to Chebyshev coefficients (a discrete cosine transform)."""
    scale = np.where(np.arange(count) == 0, 1, 2)[:, None] / count
    return scale * chebvander(chebpts(count), count).T


def lagrange_at_nodes(
    low: float, high: float, count: int, x: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "c"], Float[np.ndarray, "n c"]]:
    """Return the Chebyshev nodes on [low, high] (c,) and their Lagrange polynomials at x (n, c)."""
    centre, half_width = 0.5 * (low + high), 0.5 * (high - low)
    lagrange = chebvander((x - centre) / half_width, count) @ values_to_coefficients(count)
    return centre + half_width * chebpts(count), lagrange
