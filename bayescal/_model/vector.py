"""Three axes as one instrument: what acts is a vector of known magnitude, its direction unknown or nearly known.

    y = h(f; slots) + e,     |f| = F,     e ~ N(0, σ²) on each axis

Effects add to slots, and h turns slots and f into the three outputs. A *pose* (one averaged reading of three outputs)
becomes scalar readings of independent noise, so that everything that takes a scalar output takes vectors:

* its *magnitude*. With f̂ = h⁻¹(y), û = f̂/|f̂|, H = ∂h/∂f and s = |H⁻ᵀû|, the residual is

      3·F·((|f̂|/F)^⅓ − 1)/s  ~  N(0, σ²)

  which is (|f̂| − F)/s with its curvature. That s·σ is the standard deviation of |f̂| follows from Cov f̂ = σ²·H⁻¹H⁻ᵀ.
  The power one third is what makes the estimating equation unbiased: by the curvature of the sphere |f̂| is
  too long by σ²/F on average, and noise in û and |f̂| moves the residual's own slope with it; for the power p these add
  up to (1 − 3·p)/2 times σ²·ûᵀ(∂H)û. With p = 1 poses held by hand (σ of 30 mg) are biased by half a standard
  uncertainty.
* where its direction u is known to τ radians, two projections qᵀy on directions q ⊥ u, expected qᵀh(F·u), with the
  known standard uncertainty τ·F beside their noise. They share nothing with the magnitude, which no small angle moves.

A direction that is unknown leaves one reading of three; a rotation of the triad then moves no reading, so that only
three of six misalignments are determined (an upper triangle by convention).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal._core.errors import InputError
from bayescal._data.column import UNCERTAINTY
from bayescal._model.frame import Frame
from bayescal._model.static import static

AXES = ("x", "y", "z")
ACROSS = tuple(f"across_{a}" for a in AXES)  # the direction that a reading is the projection on
DIRECTION = tuple(f"direction_{a}" for a in AXES)  # of what acts, in the body's axes
POSE_UNCERTAINTY = "pose_uncertainty"  # of that direction, rad
MAGNITUDE = "magnitude"  # of what acts, output unit
INVERSIONS = 1  # Newton steps before the one that is differentiated: with terms of second order of a tenth, 1e-7 at the end

Outputs = Callable[[Float[Array, "n 3"]], Float[Array, "n 3"]]


@static
class Vector:
    """What makes an instrument one of three axes.

    Attributes:
        outputs: the three columns that files hold, in the output's unit; `output` is made of them.
        equation: h of slots and frame: a function of what acts (n, 3), output unit, to the three outputs expected.
    """

    outputs: tuple[str, str, str]
    equation: Callable[[Mapping[str, Any], Frame], Outputs]

    def response(
        self, slots: Mapping[str, Float[Array, "n"]], frame: Frame
    ) -> Float[Array, "n"]:
        """The expected output of each reading, magnitude or projection, output unit."""
        y = jnp.stack([frame[name] for name in self.outputs], axis=1)
        size = frame[MAGNITUDE]
        outputs = self.equation(slots, frame)
        force, inverse = inverted(outputs, y)
        length = _norm(force)
        slope = _norm(jnp.sum(inverse * (force / length[:, None])[:, :, None], axis=1))
        radial = 3 * size * (jnp.cbrt(length / size) - 1) / slope
        expected = _norm(y) - radial
        if ACROSS[0] not in frame.columns:
            return expected
        across = jnp.stack([frame[name] for name in ACROSS], axis=1)
        direction = jnp.stack([frame[name] for name in DIRECTION], axis=1)
        known = outputs(size[:, None] * direction)
        projected = jnp.any(across != 0, axis=1)
        return jnp.where(projected, jnp.sum(across * known, axis=1), expected)

    def readings(
        self, values: Mapping[str, np.ndarray], units: Mapping[str, str | None], file: str
    ) -> tuple[dict[str, np.ndarray], dict[str, str | None]]:
        """Poses as scalar readings: of each its magnitude and, where its direction is known, two projections.

        Raises:
            InputError: a direction without its uncertainty or of no length, or a pose that measures nothing.
        """
        if "output" in values:  # they are so already
            return dict(values), dict(units)
        y = np.stack([values[name] for name in self.outputs], axis=1)
        size = np.linalg.norm(y, axis=1)
        if not np.all(size > 0):
            row = int(np.argmin(size > 0)) + 1
            raise InputError(
                f"{file}, row {row}, columns {', '.join(self.outputs)}: all three read zero, so nothing acts on them: "
                "take the row out"
            )
        own = {**units, "output": units[self.outputs[0]]}
        given = [name for name in (*DIRECTION, POSE_UNCERTAINTY) if name in values]
        if not given:
            return {**values, "output": size}, own
        if len(given) < 4:
            lacking = sorted({*DIRECTION, POSE_UNCERTAINTY} - {*given})
            raise InputError(
                f"{file}: a known direction needs {', '.join((*DIRECTION, POSE_UNCERTAINTY))}, and "
                f"{', '.join(lacking)} is missing: add it, or take the others out, and directions are unknown"
            )
        direction = np.stack([values[name] for name in DIRECTION], axis=1)
        length = np.linalg.norm(direction, axis=1)
        if not np.all(length > 0):
            row = int(np.argmin(length > 0)) + 1
            raise InputError(
                f"{file}, row {row}, columns {', '.join(DIRECTION)}: a direction of length zero: give the direction "
                "of what acts, in the body's axes"
            )
        direction = direction / length[:, None]
        across = np.stack([np.zeros_like(y), *_tangents(direction)], axis=1)  # (n, 3 readings, 3)
        outputs = np.column_stack([size, np.einsum("nkj,nj->nk", across[:, 1:], y)])
        angle = values[POSE_UNCERTAINTY] * values[MAGNITUDE]
        beside = values.get(UNCERTAINTY, np.zeros(len(y)))
        uncertainty = np.stack([beside, *2 * [np.hypot(beside, angle)]], axis=1)
        made = {name: np.repeat(v, 3) for name, v in values.items()}
        made |= {name: np.repeat(direction[:, i], 3) for i, name in enumerate(DIRECTION)}
        made |= {name: across[:, :, i].ravel() for i, name in enumerate(ACROSS)}
        made |= {"output": outputs.ravel(), UNCERTAINTY: uncertainty.ravel()}
        own |= {**dict.fromkeys(ACROSS, "1"), UNCERTAINTY: own["output"]}
        return made, own


def inverted(
    outputs: Outputs, y: Float[Array, "n 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """f̂ = h⁻¹(y) and H⁻¹ there. The last step of Newton alone is differentiated: that is the derivative of h⁻¹."""
    force, inverse = y, y[:, :, None]
    for step in range(INVERSIONS + 1):
        force = jax.lax.stop_gradient(force) if step == INVERSIONS else force
        along = jnp.broadcast_to(jnp.eye(3)[:, None, :], (3, *force.shape))
        there, push = jax.linearize(outputs, force)
        inverse = _inverse(*jax.vmap(push)(along))
        force = force - jnp.sum(inverse * (there - y)[:, None, :], axis=2)
    return force, inverse


def _tangents(direction: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors at right angles to each direction and to each other."""
    least = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    one = np.cross(direction, least)
    one = one / np.linalg.norm(one, axis=1)[:, None]
    return one, np.cross(direction, one)


def _norm(vectors: Float[Array, "n 3"]) -> Float[Array, "n"]:
    return jnp.sqrt(jnp.sum(vectors**2, axis=1))


def _inverse(
    a: Float[Array, "n 3"], b: Float[Array, "n 3"], c: Float[Array, "n 3"]
) -> Float[Array, "n 3 3"]:
    """Of matrices given by their columns: cross products over the determinant."""
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    return rows / jnp.sum(a * rows[:, 0], axis=1)[:, None, None]
