"""Three axes as one instrument: the measurand is a vector of known magnitude, its direction unknown or nearly known.

    y = h(f; slots) + e,     |f| = F,     e ~ N(0, σ²) on each axis

Effects add to slots, and h turns slots and f into the three outputs. A *pose* (one averaged reading of three outputs)
becomes scalar readings of independent noise, so that everything that takes a scalar output takes vectors:

* its *magnitude*. With f̂ = h⁻¹(y), û = f̂/|f̂|, H = ∂h/∂f and s = |H⁻ᵀû|, the residual is

      F·g(|f̂|/F)/s  ~  N(0, σ²),     g(1 + x) = x/2 + x/(2 + 4x/3)

  which is (|f̂| − F)/s with its curvature. That s·σ is the standard deviation of |f̂| follows from Cov f̂ = σ²·H⁻¹H⁻ᵀ.
  The curvature g″(1) = −2/3 is what makes the estimating equation unbiased: by the curvature of the sphere |f̂| is
  too long by σ²/F on average, and noise in û and |f̂| moves the residual's own slope with it; these add up to
  −(3·g″ + 2)/2 times σ²·ûᵀ(∂H)û. With g″ = 0 poses held by hand (σ of 30 mg) are biased by half a standard
  uncertainty. Far away g rises in proportion: with a power of |f̂| below one a matrix near zero, f̂ without bound,
  would leave nothing over.
* where its direction u is known to τ radians, two projections qᵀy on directions q ⊥ u, expected qᵀh(F·u), with the
  known standard uncertainty τ·F beside their noise. They share nothing with the magnitude, which no small angle moves.

A direction that is unknown leaves one reading of three; a rotation of the triad then moves no reading, so that only
three of six misalignments are determined (an upper triangle by convention).

Where what acts is known but for errors of the rig (a rate about a table's axis), these are unknowns of the model, and
each output is a reading of its own: the projection on its axis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._core.inverse import stepped
from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._data.pose_rows import ACROSS, DIRECTION, ellipsoid, magnitude
from bayescal._model.frame import Frame
from bayescal._model.static import static

NEAR_RATIO = 1.5  # factor by which outputs may be off in length, where a fit needs no ellipsoid
INVERSIONS = 1  # Newton steps before the one that is differentiated: 1e-7 in the end for a nonlinearity of a tenth

Outputs = Callable[[Float[Array, "n 3"]], Float[Array, "n 3"]]


@static
class Vector:
    """Definition of an instrument of three axes.

    Attributes:
        outputs: the three columns that files hold, in the output's unit; `output` is made of them.
        equation: h of slots and frame: a function of what acts (n, 3), output unit, to the three outputs expected,
            that JAX can differentiate backward too (no loop of unknown length), finite wherever it is evaluated.
        acting: what acts (n, 3), output unit, of a frame, where it is known; None where its magnitude is.
        common_scale: plausible standard deviation of a factor that the three scale factors share, as a wrong magnitude
            of what acts would make it; 0 where nothing is said of it.
        rig: slots of the rig's own errors, which do not act in use and which the equation does not hold.
        beside: three columns of what else acts, linearly, in use too: gravity on gyroscopes.
    """

    outputs: tuple[str, str, str]
    equation: Callable[[Mapping[str, Any], Frame], Outputs]
    acting: Callable[[Frame], Float[Array, "n 3"]] | None = None
    common_scale: float = 0.0
    rig: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()

    def response(self, slots: Mapping[str, Float[Array, "n"]], frame: Frame) -> Float[Array, "n"]:
        """Return the expected output of each reading, magnitude or projection, output unit."""
        if self.acting is not None:
            across = jnp.stack([frame[name] for name in ACROSS], axis=1)
            return jnp.sum(across * self.equation(slots, frame)(self.acting(frame)), axis=1)
        y = jnp.stack([frame[name] for name in self.outputs], axis=1)
        size = magnitude(frame.columns)
        outputs = self.equation(slots, frame)
        force, inverse = inverted(outputs, y)
        length = _norm(force)
        slope = _norm(jnp.sum(inverse * (force / length[:, None])[:, :, None], axis=1))
        radial = size * excess(length / size) / slope
        expected = _norm(y) - radial
        if ACROSS[0] not in frame.columns:
            return expected
        across = jnp.stack([frame[name] for name in ACROSS], axis=1)
        direction = jnp.stack([frame[name] for name in DIRECTION], axis=1)
        expected_outputs = outputs(size[:, None] * direction)
        projected = jnp.any(across != 0, axis=1)
        return jnp.where(projected, jnp.sum(across * expected_outputs, axis=1), expected)

    def with_directions(
        self, frame: Frame, y: Float[np.ndarray, "n"]
    ) -> tuple[Frame, Float[np.ndarray, "n"]] | None:
        """Return the readings as projections in known directions, those of an ellipsoid through the outputs.

        Their expected outputs are linear in the slots of a linear equation, from wherever a fit begins. The magnitude
        is not where outputs are far from it in length (a hard iron, another unit): a fit that begins with the
        directions of the outputs themselves ends where a scale factor is zero.

        Returns:
            Frame and outputs; None where outputs are near the magnitude, what acts is known, or no ellipsoid is found.
        """
        if self.acting is not None:
            return None
        outputs = np.stack([frame[name] for name in self.outputs], axis=1)
        ratio = np.linalg.norm(outputs, axis=1) / magnitude(frame.columns)
        near = np.all((ratio < NEAR_RATIO) & (ratio > 1 / NEAR_RATIO))
        if near or (fitted := ellipsoid(outputs)) is None:
            return None
        # The triad's matrix is upper triangular, as the convention of three misalignments has it.
        off, form = outputs - fitted[0], fitted[1]
        # The measurand, and the ellipsoid's normal.
        vectors = off @ np.linalg.cholesky(form), off @ form
        direction, normal = (v / np.linalg.norm(v, axis=1)[:, None] for v in vectors)
        names, columns = (*DIRECTION, *ACROSS), dict(frame.columns)
        present = [name in columns for name in names]
        projected = np.zeros(len(y), bool)
        if all(present):
            projected = np.any(np.stack([columns[name] for name in ACROSS]) != 0, axis=0)
        for name, values in zip(names, np.concatenate([direction, normal], axis=1).T, strict=True):
            columns[name] = np.where(projected, columns[name], values) if all(present) else values
        along = np.sum(normal * outputs, axis=1)
        return replace(frame, columns=columns), np.where(projected, y, along)


def excess(ratio: Any) -> Any:
    """Return g of a length over its true magnitude: 0, slope 1 and curvature −2/3 at one."""
    x = ratio - 1
    return x / 2 + x / (2 + 4 * x / 3)


def inverted(
    outputs: Outputs, y: Float[Array, "n 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """Return f̂ = h⁻¹(y) and H⁻¹ there; only the last Newton step is differentiated: that is the derivative of h⁻¹."""

    def equation(force: Array) -> tuple[Array, Callable[[Array], Array]]:
        value, inverse = _with_inverse(outputs, force)
        return value, lambda miss: jnp.sum(inverse * miss[:, None, :], axis=2)

    near = jax.lax.stop_gradient(stepped(equation, y, y, INVERSIONS))
    force = stepped(equation, y, near, 1)
    return force, _with_inverse(outputs, force)[1]


def _with_inverse(
    outputs: Outputs, force: Float[Array, "n 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """Return h and the inverse of its derivative: cross products over the determinant."""
    along = jnp.broadcast_to(jnp.eye(3)[:, None, :], (3, *force.shape))
    value, push = jax.linearize(outputs, force)
    a, b, c = jax.vmap(push)(along)
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    return value, rows / jnp.sum(a * rows[:, 0], axis=1)[:, None, None]


def _norm(vectors: Float[Array, "n 3"]) -> Float[Array, "n"]:
    return jnp.sqrt(jnp.sum(vectors**2, axis=1))
