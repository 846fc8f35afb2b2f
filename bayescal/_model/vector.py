"""Three-axis instruments: the measurand is a vector of known magnitude, its direction unknown or nearly known.

    y = h(f; slots) + e,     |f| = F,     e ~ N(0, σ²) on each axis

Effects add to slots, and h maps slots and f to the three outputs. A *pose* (one averaged reading of three outputs)
is converted to scalar readings with independent noise, to which all methods for scalar outputs apply:

* its *magnitude*. With f̂ = h⁻¹(y), û = f̂/|f̂|, H = ∂h/∂f and s = |H⁻ᵀû|, the residual is

      F·g(|f̂|/F)/s  ~  N(0, σ²),     g(1 + x) = x/2 + x/(2 + 4x/3)

  (|f̂| − F)/s to first order: s·σ is the standard deviation of |f̂|, since Cov f̂ = σ²·H⁻¹H⁻ᵀ. The second derivative
  g″(1) = −2/3 makes the estimating equation unbiased: the mean of |f̂| exceeds F by σ²/F, and the residual's
  derivative is correlated with its noise; together −(3·g″ + 2)/2 times σ²·ûᵀ(∂H)û. With g″ = 0 hand-held poses (σ of
  30 mg) are biased by half a standard uncertainty. For |f̂| ≫ F g is linear: a singular matrix has large residuals.
* if its direction u is known to τ radians, two *projections* qᵀy on directions q ⊥ u, expected qᵀh(F·u), with standard
  uncertainty τ·F in addition to noise. They are independent of the magnitude, which is stationary in small angles.

With unknown direction one reading of three is left, and no reading depends on a rotation of the triad: only three of
six misalignments are identified (an upper triangle by convention).

If the measurand is known except for errors of the rig, these are unknowns of the model, and each output is a reading.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._core.inverse import iterate_newton
from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._core.renamed import renamed
from bayescal._data.pose_rows import ACROSS, DIRECTION, fit_ellipsoid, magnitude
from bayescal._model.frame import Frame
from bayescal._model.static import static

NEAR_RATIO = 1.5  # largest |output|/magnitude, or its inverse, to fit without an ellipsoid
NEWTON_STEPS = 1  # before the differentiated step: error 1e-7 for 10 % nonlinearity

OutputFunction = Callable[[Float[Array, "n 3"]], Float[Array, "n 3"]]


@renamed(beside="secondary_columns")
@static
class Vector:
    """Definition of an instrument of three axes.

    Attributes:
        outputs: the three output columns of files, in the output's unit; `output` is computed from them.
        equation: function of slots and frame that returns h, a function of the stimulus (n, 3), output unit, with the
            three expected outputs (n, 3): finite, and differentiable by JAX in reverse mode (no `while` loop).
        acting: function of a frame that returns the known measurand (n, 3), output unit; None if only |f| is known.
        common_scale: prior standard deviation of a common scale factor, from an error of the stimulus; 0: unspecified.
        rig: slots of the test rig's errors, which are not in the equation and do not act in use.
        secondary_columns: three columns of a second stimulus with linear response, such as gravity on gyroscopes.
    """

    outputs: tuple[str, str, str]
    equation: Callable[[Mapping[str, Any], Frame], OutputFunction]
    acting: Callable[[Frame], Float[Array, "n 3"]] | None = None
    common_scale: float = 0.0
    rig: tuple[str, ...] = ()
    secondary_columns: tuple[str, ...] = ()

    def response(self, slots: Mapping[str, Float[Array, "n"]], frame: Frame) -> Float[Array, "n"]:
        """Return the expected output of each reading (n,), its magnitude or a projection, output unit."""
        if self.acting is not None:
            projections = jnp.stack([frame[name] for name in ACROSS], axis=1)
            return jnp.sum(projections * self.equation(slots, frame)(self.acting(frame)), axis=1)
        y = jnp.stack([frame[name] for name in self.outputs], axis=1)
        magnitudes = magnitude(frame.columns)
        outputs = self.equation(slots, frame)
        stimulus, inverse = invert_equation(outputs, y)
        norm = _norms(stimulus)
        radial_slope = _norms(jnp.sum(inverse * (stimulus / norm[:, None])[:, :, None], axis=1))
        residual = magnitudes * compute_radial_residual(norm / magnitudes) / radial_slope
        expected = _norms(y) - residual
        if ACROSS[0] not in frame.columns:
            return expected
        projections = jnp.stack([frame[name] for name in ACROSS], axis=1)
        direction = jnp.stack([frame[name] for name in DIRECTION], axis=1)
        expected_outputs = outputs(magnitudes[:, None] * direction)
        is_projection = jnp.any(projections != 0, axis=1)
        return jnp.where(is_projection, jnp.sum(projections * expected_outputs, axis=1), expected)

    def with_directions(
        self, frame: Frame, y: Float[np.ndarray, "n"]
    ) -> tuple[Frame, Float[np.ndarray, "n"]] | None:
        """Replace magnitude readings by projections on directions from an ellipsoid fitted to the outputs.

        Projections are linear in the slots of a linear equation, so that a fit converges from any start. A fit to
        magnitudes may converge to a zero scale factor if the outputs' is far from the true one (hard iron, other unit).

        Returns:
            Frame and outputs; None if the measurand is known, magnitudes are near the true one, or no ellipsoid fits.
        """
        if self.acting is not None:
            return None
        outputs = np.stack([frame[name] for name in self.outputs], axis=1)
        ratio = np.linalg.norm(outputs, axis=1) / magnitude(frame.columns)
        is_near = np.all((ratio < NEAR_RATIO) & (ratio > 1 / NEAR_RATIO))
        if is_near or (fitted_ellipsoid := fit_ellipsoid(outputs)) is None:
            return None
        # The triad's matrix is upper triangular, by the convention of three misalignments.
        centred, quadratic_form = outputs - fitted_ellipsoid[0], fitted_ellipsoid[1]
        # Directions of the measurand, and normals of the ellipsoid.
        unnormalised = centred @ np.linalg.cholesky(quadratic_form), centred @ quadratic_form
        direction, normal = (v / np.linalg.norm(v, axis=1)[:, None] for v in unnormalised)
        names, zeros = (*DIRECTION, *ACROSS), np.zeros(len(y))
        columns = dict.fromkeys(names, zeros) | frame.columns
        is_projection = np.any([columns[name] != 0 for name in ACROSS], axis=0)
        for name, values in zip(names, np.concatenate([direction, normal], axis=1).T, strict=True):
            columns[name] = np.where(is_projection, columns[name], values)
        projections = np.sum(normal * outputs, axis=1)
        return replace(frame, columns=columns), np.where(is_projection, y, projections)


def compute_radial_residual(ratio: Any) -> Any:
    """Return g(ratio) = x/2 + x/(2 + 4x/3), x = ratio − 1; ratio: estimated over true magnitude. At x = 0 g″ = −2/3."""
    x = ratio - 1
    return x / 2 + x / (2 + 4 * x / 3)


def invert_equation(
    outputs: OutputFunction, y: Float[Array, "n 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """Solve h(f̂) = y by Newton's method; return f̂ and H⁻¹. Only the last step is differentiated (implicit function)."""

    def equation(stimulus: Array) -> tuple[Array, Callable[[Array], Array]]:
        value, inverse = _linearise_and_invert(outputs, stimulus)
        return value, lambda residual: jnp.sum(inverse * residual[:, None, :], axis=2)

    start = jax.lax.stop_gradient(iterate_newton(equation, y, y, NEWTON_STEPS))
    stimulus = iterate_newton(equation, y, start, 1)
    return stimulus, _linearise_and_invert(outputs, stimulus)[1]


def _linearise_and_invert(
    outputs: OutputFunction, stimulus: Float[Array, "n 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """Return h at the stimulus and the inverse of its Jacobian: cross products of rows over the determinant."""
    tangents = jnp.broadcast_to(jnp.eye(3)[:, None, :], (3, *stimulus.shape))
    value, jvp = jax.linearize(outputs, stimulus)
    a, b, c = jax.vmap(jvp)(tangents)
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    return value, rows / jnp.sum(a * rows[:, 0], axis=1)[:, None, None]


def _norms(vectors: Float[Array, "n 3"]) -> Float[Array, "n"]:
    return jnp.sqrt(jnp.sum(vectors**2, axis=1))
