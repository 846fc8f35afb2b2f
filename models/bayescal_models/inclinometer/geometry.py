"""Geometry of a body with two tilt axes: specific force along each axis, and the placement angle ω.

A tilt x is defined by the component of gravity along its axis, A = g·sin x. With sensing axes X, Y and the body's
normal Z, "up" is therefore (sin x, sin y, √(1 − sin²x − sin²y)). The X accelerometer has its pendulum direction along
Z and its door direction along Y, so that in the plane normal to X "up" is cos x·(cos ω·Z + sin ω·Y): rotated by ω from
pendulum toward door.

Functions take NumPy or JAX arrays and the corresponding module, `numpy` or `jax.numpy`.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

ARCSEC = 3.14159265358979323846 / 648000  # rad
DEGREE = 3600.0  # arcsec


def compute_placement_angle(tilt: Any, cross: Any, xp: ModuleType) -> Any:
    """Return the placement angle of an accelerometer, rad, from its tilt x and the tilt y of the other axis.

    ω = atan2(sin y, √(1 − sin²x − sin²y)); source 4 takes ω = y. At x = y = 30° it is 35.3°.

    Args:
        tilt: tilt along the accelerometer's axis, rad.
        cross: tilt along the other axis, rad.
        xp: `numpy` or `jax.numpy`.
    """
    cosine_squared = 1 - xp.sin(tilt) ** 2 - xp.sin(cross) ** 2
    return xp.arctan2(xp.sin(cross), xp.sqrt(xp.maximum(cosine_squared, 1e-12)))


def are_compatible_tilts(tilt: Any, cross: Any) -> Any:
    """Return whether a body can have two tilts, rad, at once: sin²x + sin²y ≤ 1."""
    import numpy as np

    return np.sin(tilt) ** 2 + np.sin(cross) ** 2 <= 1.0


def compute_sine(sine: Any, zero: Any, cosine: Any, electrical: Any, scale: Any, cross: Any) -> Any:
    """Return the sine of the reading: (1 + κ)·[sin x + cos x·zero + S_e + m·sin y], all angles in rad.

    Args:
        sine, cosine: sine and cosine of the true tilt x.
        zero: mechanical zero S_p·cos ω + S_d·sin ω.
        electrical: electrical zero S_e.
        scale: scale factor deviation κ.
        cross: cross-axis term m·sin y.
    """
    return (1 + scale) * (sine + cosine * zero + electrical + cross)
