"""Two tilts of one body: specific force along each axis, and placement angle from pendulum toward door attitude.

A tilt is defined by the component of gravity along its axis, A = g·sin x. With X, Y the sensing axes and Z the body's
normal, "up" is therefore (sin x, sin y, √(1 − sin²x − sin²y)). The X accelerometer has its pendulum direction along
Z and its door direction along Y, so in the plane normal to its axis "up" is cos x·(cos ω·Z + sin ω·Y): rotated from
pendulum toward door by ω.

Functions take arrays of NumPy or JAX and the module `numpy` that belongs to them.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

ARCSEC = 3.14159265358979323846 / 648000  # rad
DEGREE = 3600.0  # arcsec


def exact_placement(tilt: Any, cross: Any, xp: ModuleType) -> Any:
    """Return the placement angle of an accelerometer from its tilt and that of the other axis, rad.

    ω = atan2(sin y, √(1 − sin²x − sin²y)); source 4 takes ω = y. At x = y = 30° it is 35.3°.

    Args:
        tilt: tilt along the accelerometer's axis, rad.
        cross: tilt along the other axis, rad.
        xp: `numpy` or `jax.numpy`.
    """
    upright = 1 - xp.sin(tilt) ** 2 - xp.sin(cross) ** 2
    return xp.arctan2(xp.sin(cross), xp.sqrt(xp.maximum(upright, 1e-12)))


def possible(tilt: Any, cross: Any) -> Any:
    """Return whether two tilts are compatible: sin²x + sin²y is at most 1."""
    import numpy as np

    return np.sin(tilt) ** 2 + np.sin(cross) ** 2 <= 1.0


def sensed(sine: Any, zero: Any, cosine: Any, electrical: Any, scale: Any, leak: Any) -> Any:
    """Return the sine of the reading: (1 + κ)·[sin x + cos x·zero + S_e + m·sin y], all angles in rad.

    Args:
        sine, cosine: sine and cosine of the true tilt.
        zero: mechanical zero S_p·cos ω + S_d·sin ω.
        electrical: S_e.
        scale: κ.
        leak: m·sin y.
    """
    return (1 + scale) * (sine + cosine * zero + electrical + leak)
