"""Interpolation between Chebyshev's points: of any number; and along a coordinate of φ, with its slopes."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float

REACH = 4.0  # prior standard deviations of a shape, up to which columns are interpolated along it
COUNT = 64  # points: a lag of a minute to hours in a record of minutes takes 60
_ORDERS = np.arange(COUNT)


def _angles(count: int) -> Float[np.ndarray, "c"]:
    return (np.arange(count) + 0.5) * np.pi / count


def points(count: int) -> Float[np.ndarray, "c"]:
    """Return Chebyshev's points of the first kind, between 1 and −1."""
    return np.cos(_angles(count))


@cache
def _to_coefficients(count: int) -> Float[np.ndarray, "k c"]:
    """From values at the points to coefficients of Chebyshev's polynomials: a discrete cosine transform."""
    orders = np.arange(count)
    return (2 - (orders == 0))[:, None] / count * np.cos(orders[:, None] * _angles(count))


def lagrange(x: Any, count: int) -> Float[np.ndarray, "*b c"]:
    """Return Lagrange's polynomials of so many points at places between −1 and 1."""
    # Σₖ cₖ·Tₖ(cos θ) with Tₖ = cos kθ.
    angle = np.arccos(np.clip(np.asarray(x), -1.0, 1.0))
    return np.cos(angle[..., None] * np.arange(count)) @ _to_coefficients(count)


NODES = REACH * points(COUNT)
BETWEEN = REACH * np.cos(
    np.array([1, COUNT // 6, 2 * COUNT // 5, 3 * COUNT // 5, COUNT - 1]) * np.pi / COUNT
)  # half way between some nodes, where an interpolation is tried
_EDGE = 1 - 1e-12  # of the reach, where the slope of a polynomial by its angle is still a number


def weights(v: Any) -> Float[np.ndarray, "*b s"]:
    """Of the values at the nodes in the value at a coordinate; beyond the reach, as at its end."""
    return lagrange(np.asarray(v) / REACH, COUNT)


def weights_and_slopes(v: float) -> tuple[Float[np.ndarray, "s"], Float[np.ndarray, "s"]]:
    """The same at one coordinate, with their slopes by it: dTₖ(cos θ)/d cos θ = k·sin kθ/sin θ."""
    angle = float(np.arccos(np.clip(v / REACH, -_EDGE, _EDGE)))
    slopes = _ORDERS * np.sin(angle * _ORDERS) / (np.sin(angle) * REACH)
    made = _to_coefficients(COUNT)
    return np.cos(angle * _ORDERS) @ made, slopes @ made
