"""Interpolation along a coordinate of φ between Chebyshev's points, and its slopes."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

REACH = 4.0  # prior standard deviations of a shape, up to which columns are interpolated along it
COUNT = 64  # points: a lag of a minute to hours in a record of minutes takes 60
_ANGLES = (np.arange(COUNT) + 0.5) * np.pi / COUNT
NODES = REACH * np.cos(_ANGLES)
_ORDERS = np.arange(COUNT)
# From values at the nodes to coefficients of Chebyshev's polynomials: a discrete cosine transform.
_TO_COEFFICIENTS = (2 - (_ORDERS == 0))[:, None] / COUNT * np.cos(_ORDERS[:, None] * _ANGLES)
BETWEEN = REACH * np.cos(
    np.array([1, COUNT // 6, 2 * COUNT // 5, 3 * COUNT // 5, COUNT - 1]) * np.pi / COUNT
)  # half way between some nodes, where an interpolation is tried
_EDGE = 1 - 1e-12  # of the reach, where the slope of a polynomial by its angle is still a number


def weights(v: Any) -> Float[np.ndarray, "*b s"]:
    """Of the values at the nodes in the value at a coordinate; beyond the reach, as at its end."""
    # Σₖ cₖ·Tₖ(cos θ) with Tₖ = cos kθ, the coefficients c a discrete cosine transform of the values at the nodes.
    angle = np.arccos(np.clip(np.asarray(v) / REACH, -1.0, 1.0))
    return np.cos(angle[..., None] * _ORDERS) @ _TO_COEFFICIENTS


def weights_and_slopes(v: float) -> tuple[Float[np.ndarray, "s"], Float[np.ndarray, "s"]]:
    """The same at one coordinate, with their slopes by it: dTₖ(cos θ)/d cos θ = k·sin kθ/sin θ."""
    angle = float(np.arccos(np.clip(v / REACH, -_EDGE, _EDGE)))
    slopes = _ORDERS * np.sin(angle * _ORDERS) / (np.sin(angle) * REACH)
    return np.cos(angle * _ORDERS) @ _TO_COEFFICIENTS, slopes @ _TO_COEFFICIENTS
