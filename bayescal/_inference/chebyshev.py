"""Polynomial interpolation at Chebyshev nodes of the first kind."""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float
from numpy.polynomial.chebyshev import chebpts1, chebvander


@cache
def values_to_coefficients(count: int) -> Float[np.ndarray, "k c"]:
    """Return the matrix that maps values at Chebyshev nodes to Chebyshev coefficients (a discrete cosine transform)."""
    scale = np.where(np.arange(count) == 0, 1, 2)[:, None] / count
    return scale * chebvander(chebpts1(count), count - 1).T


def lagrange_at_nodes(
    low: float, high: float, count: int, x: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "c"], Float[np.ndarray, "n c"]]:
    """Return the Chebyshev nodes on [low, high] (c,) and their Lagrange polynomials at x (n, c)."""
    centre, half_width = 0.5 * (low + high), 0.5 * (high - low)
    lagrange = chebvander((x - centre) / half_width, count - 1) @ values_to_coefficients(count)
    return centre + half_width * chebpts1(count), lagrange
