"""Interpolation between Chebyshev's points."""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float


@cache
def points(count: int) -> Float[np.ndarray, "c"]:
    """Return Chebyshev's points of the first kind, between 1 and −1."""
    return np.cos((np.arange(count) + 0.5) * np.pi / count)


def polynomials(x: Float[np.ndarray, "*b"], count: int) -> Float[np.ndarray, "*b c"]:
    """Return Chebyshev's polynomials of orders 0 … count − 1 at places between −1 and 1."""
    return np.cos(np.arccos(np.clip(x, -1.0, 1.0))[..., None] * np.arange(count))


@cache
def to_coefficients(count: int) -> Float[np.ndarray, "k c"]:
    """Return the matrix from values at the points to coefficients of the polynomials: a discrete cosine transform."""
    half = np.where(np.arange(count) == 0, 1, 2)[:, None] / count
    return half * polynomials(points(count), count).T


def nodes_and_shares(
    low: float, high: float, count: int, x: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "c"], Float[np.ndarray, "n c"]]:
    """Return Chebyshev's points between two ends, and Lagrange's polynomials of them at places x."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    share = polynomials((x - middle) / half, count) @ to_coefficients(count)
    return middle + half * points(count), share
