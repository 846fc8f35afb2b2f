"""Names of the columns of three-axis readings, and the ellipsoid fitted to outputs of constant magnitude."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float  # a tenth of the time of reading a file

AXES = ("x", "y", "z")
ACROSS = tuple(f"across_{a}" for a in AXES)  # unit vector on which a reading is a projection
DIRECTION = tuple(f"direction_{a}" for a in AXES)  # direction of the measurand in the body's axes
MAGNITUDE = "magnitude"  # of the vector measurand, output unit, if only its magnitude is known
# The magnitude computed from the outputs, by convention, if it is unknown.
MAGNITUDE_READ = "magnitude_read"
RATE = "rate"  # angular rate about the direction, output unit
AXIS = "axis"  # column of the index of the reading among the simultaneous ones
# Mean over a rotation of the measurand along axis j, weighted by component a of the direction, which turns with the
# body.
TURNED = tuple(f"turned_{a}{j}" for a in AXES for j in AXES)


def magnitude(columns: Any) -> Any:
    """Return the magnitude of the vector measurand from columns of readings: the known one, else the outputs'."""
    return columns[MAGNITUDE] if MAGNITUDE in columns else columns[MAGNITUDE_READ]


def fit_ellipsoid(
    outputs: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]] | None:
    """Fit an ellipsoid (y − c)ᵀQ(y − c) = 1 to outputs; return centre c and matrix Q, or None if undetermined.

    Least squares for the quadric's coefficients (Q. Li and J. G. Griffiths, Proc. GMP 2004).
    """
    scale, mean = np.max(np.std(outputs, axis=0)), outputs.mean(axis=0)
    if not scale > 0:
        return None
    points = (outputs - mean) / scale
    i, j = np.triu_indices(3)
    monomials = np.concatenate([points[:, i] * points[:, j], points], axis=1)
    coefficients, _, rank, _ = np.linalg.lstsq(monomials, np.ones(len(points)), rcond=1e-10)
    form_matrix = np.zeros((3, 3))
    form_matrix[i, j] = coefficients[:6]
    form_matrix = 0.5 * (form_matrix + form_matrix.T)
    if rank < len(coefficients) or not np.min(np.linalg.eigvalsh(form_matrix)) > 0:
        return None
    centre = -0.5 * np.linalg.solve(form_matrix, coefficients[6:])
    return mean + scale * centre, form_matrix / (1 + centre @ form_matrix @ centre) / scale**2
