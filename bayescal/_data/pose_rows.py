"""Columns of readings of three outputs, and the ellipsoid fitted to outputs at a known magnitude."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float  # a tenth of the time of reading a file

AXES = ("x", "y", "z")
ACROSS = tuple(f"across_{a}" for a in AXES)  # the direction that a reading is the projection on
DIRECTION = tuple(f"direction_{a}" for a in AXES)  # of what acts, in the body's axes
MAGNITUDE = "magnitude"  # of what acts, output unit, where it is all that is known
# Where it is not known: what the outputs make of it, by convention.
MAGNITUDE_READ = "magnitude_read"
RATE = "rate"  # of what acts about the direction, output unit
OF = "axis"  # which of the readings of one moment
# Of a mean over a move, along a direction that turns with the unit: that of what acts on j, weighted with the
# direction's component a.
TURNED = tuple(f"turned_{a}{j}" for a in AXES for j in AXES)


def magnitude(columns: Any) -> Any:
    """Return the magnitude of the vector measurand from columns of readings: as given, else as read from outputs."""
    return columns[MAGNITUDE] if MAGNITUDE in columns else columns[MAGNITUDE_READ]


def ellipsoid(
    outputs: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]] | None:
    """Return centre c and form Q of the ellipsoid (y − c)ᵀQ(y − c) = 1 through outputs; None where not determined.

    By least squares on the quadric's coefficients (Q. Li and J. G. Griffiths, Proc. GMP 2004).
    """
    scale, mean = np.max(np.std(outputs, axis=0)), outputs.mean(axis=0)
    if not scale > 0:
        return None
    a = (outputs - mean) / scale
    i, j = np.triu_indices(3)
    table = np.concatenate([a[:, i] * a[:, j], a], axis=1)
    q, _, rank, _ = np.linalg.lstsq(table, np.ones(len(a)), rcond=1e-10)
    form = np.zeros((3, 3))
    form[i, j] = q[:6]
    form = 0.5 * (form + form.T)
    if rank < len(q) or not np.min(np.linalg.eigvalsh(form)) > 0:
        return None
    centre = -0.5 * np.linalg.solve(form, q[6:])
    return mean + scale * centre, form / (1 + centre @ form @ centre) / scale**2
