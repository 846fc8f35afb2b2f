"""Where gravity points in a tilted, turning table: exact, no small-angle approximation.

In the tilted frame that does not turn (e0 along θ = 0, e90 along θ = 90°, n normal to the face) the unit vector
"up" and the input axis are

    u = ( sin γ2∥,  cos γ2∥·sin(γ + γ2⊥),  cos γ2∥·cos(γ + γ2⊥) )
    s = ( cos γ1·cos θ,  cos γ1·sin θ,  sin γ1 )

so that along the input axis acts a = g·u·s, and along the normal, the pendulous axis, ap = g·u·n.

Source: source 0, sections 2 and 3; formulas of the exact form ours.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

G = 1e6  # µg


class Accelerations(NamedTuple):
    """What acts on the accelerometer: along the input axis, µg, and along the table's normal, g."""

    along: Float[Array, "n"]
    normal: Float[Array, "n"]


def accelerations(
    tilt: Float[Array, "n"],
    angle: Float[Array, "n"],
    fixture_tilt: Float[Array, "n"],
    parallel: Float[Array, "n"],
    perp: Float[Array, "n"],
) -> Accelerations:
    """Gravity in the axes of the accelerometer. All angles in rad.

    Args:
        tilt: γ, of the table's face.
        angle: θ, to which the face is turned, the azimuth of the input axis included.
        fixture_tilt: γ1, of the input axis out of the face.
        parallel, perp: γ2∥ and γ2⊥, of the base along θ = 0 and along θ = 90°.
    """
    e0 = jnp.sin(parallel)
    e90 = jnp.cos(parallel) * jnp.sin(tilt + perp)
    n = jnp.cos(parallel) * jnp.cos(tilt + perp)
    in_face = e0 * jnp.cos(angle) + e90 * jnp.sin(angle)
    return Accelerations(G * (jnp.cos(fixture_tilt) * in_face + jnp.sin(fixture_tilt) * n), n)
