"""Readings of three outputs as scalar ones.

What acts has a known magnitude (gravity, a field): a pose becomes its magnitude and, where its direction is known, two
projections. What acts is known, or nothing (a rate table): each output is a reading of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bayescal._core.errors import InputError
from bayescal._data.column import UNCERTAINTY

if TYPE_CHECKING:
    from jaxtyping import Float  # a tenth of the time of reading a file

AXES = ("x", "y", "z")
ACROSS = tuple(f"across_{a}" for a in AXES)  # the direction that a reading is the projection on
DIRECTION = tuple(f"direction_{a}" for a in AXES)  # of what acts, in the body's axes
POSE_UNCERTAINTY = "pose_uncertainty"  # of that direction, rad
MAGNITUDE = "magnitude"  # of what acts, output unit, where it is all that is known
# Where it is not known: what the outputs make of it, by convention.
MAGNITUDE_READ = "magnitude_read"
RATE = "rate"  # of what acts about the direction, output unit
MOUNTING = "mounting"  # readings that share an error of the direction
OF = "axis"  # which of the readings of one moment
# Of a mean over a move, along a direction that turns with the unit: the mean, weighted with that direction's
# component a, of what acts on j, of the specific force on j and of what acts on a squared; and of the Earth's rotation.
TURNED = tuple(f"turned_{a}{j}" for a in AXES for j in AXES)
PULLED = tuple(f"pulled_{a}{j}" for a in AXES for j in AXES)
SQUARED = tuple(f"squared_{a}" for a in AXES)
AROUND = tuple(f"around_{k}" for k in "123")


def scalar_readings(
    names: Sequence[str],
    values: Mapping[str, np.ndarray],
    units: Mapping[str, str | None],
    file: str,
    of_magnitude: bool = True,
) -> tuple[dict[str, np.ndarray], dict[str, str | None]]:
    """Return poses as scalar readings: of each its magnitude and, where its direction is known, two projections.

    Where neither the magnitude of what acts is given nor what the outputs make of it, the latter is added: the mean
    radius of their ellipsoid, which makes the scale factors ratios.

    Args:
        names: of the three outputs.
        values, units: columns of a file, one entry a pose, and their units.
        file: for messages.
        of_magnitude: whether what acts has one magnitude in all poses; else it is known: see `component_readings`.

    Raises:
        InputError: a direction without its uncertainty or of no length, or a pose that measures nothing.
    """
    if "output" in values:  # they are so already
        return dict(values), dict(units)
    if not of_magnitude:
        return component_readings(names, values, units, file)
    y = np.stack([values[name] for name in names], axis=1)
    if MAGNITUDE not in values and MAGNITUDE_READ not in values:
        values = {**values, MAGNITUDE_READ: np.full(len(y), _mean_radius(y))}
        units = {**units, MAGNITUDE_READ: units[names[0]]}
    size = _lengths(
        y, file, names, "all three read zero, so nothing acts on them: take the row out"
    )
    made_units = {**units, "output": units[names[0]]}
    given = [own for own in (*DIRECTION, POSE_UNCERTAINTY) if own in values]
    if not given:
        return {**values, "output": size}, made_units
    if len(given) < 4:
        lacking = sorted({*DIRECTION, POSE_UNCERTAINTY} - {*given})
        raise InputError(
            f"{file}: a known direction needs {', '.join((*DIRECTION, POSE_UNCERTAINTY))}, and "
            f"{', '.join(lacking)} is missing: add it, or take the others out, and directions are unknown"
        )
    direction = np.stack([values[name] for name in DIRECTION], axis=1)
    none = "a direction of length zero: give the direction of what acts, in the body's axes"
    direction = direction / _lengths(direction, file, DIRECTION, none)[:, None]
    across = np.stack([np.zeros_like(y), *tangents(direction)], axis=1)  # (n, 3 readings, 3)
    outputs = np.column_stack([size, np.einsum("nkj,nj->nk", across[:, 1:], y)])
    angle = values[POSE_UNCERTAINTY] * magnitude(values)
    beside = values.get(UNCERTAINTY, np.zeros(len(y)))
    uncertainty = np.stack([beside, *2 * [np.hypot(beside, angle)]], axis=1)
    values = {**values, **dict(zip(DIRECTION, direction.T, strict=True))}
    made = _three_each(values, across, outputs, ("magnitude", "across", "across too"))
    made |= {UNCERTAINTY: uncertainty.ravel()}
    made_units |= {**dict.fromkeys(ACROSS, "1"), UNCERTAINTY: made_units["output"], OF: None}
    return made, made_units


def _three_each(
    values: Mapping[str, np.ndarray],
    across: Float[np.ndarray, "n 3 3"],
    outputs: Float[np.ndarray, "n 3"],
    labels: Sequence[str],
) -> dict[str, np.ndarray]:
    """Return three readings of each moment: its outputs, what they are projections on, and what they are called."""
    made = {name: np.repeat(v, 3) for name, v in values.items()}
    made |= {name: across[:, :, i].ravel() for i, name in enumerate(ACROSS)}
    return made | {"output": outputs.ravel(), OF: np.tile(labels, len(outputs))}


def magnitude(columns: Any) -> Any:
    """Of what acts, as it is given or else as the outputs have it, of the columns of readings."""
    return columns[MAGNITUDE] if MAGNITUDE in columns else columns[MAGNITUDE_READ]


def ellipsoid(
    outputs: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]] | None:
    """Centre c and form Q of the ellipsoid (y − c)ᵀQ(y − c) = 1 through outputs; None where they determine none.

    By least squares on the quadric's coefficients (Q. Li and J. G. Griffiths, Proc. GMP 2004).
    """
    scale, middle = np.max(np.std(outputs, axis=0)), outputs.mean(axis=0)
    if not scale > 0:
        return None
    a = (outputs - middle) / scale
    i, j = np.triu_indices(3)
    table = np.concatenate([a[:, i] * a[:, j], a], axis=1)
    q, _, rank, _ = np.linalg.lstsq(table, np.ones(len(a)), rcond=1e-10)
    form = np.zeros((3, 3))
    form[i, j] = q[:6]
    form = 0.5 * (form + form.T)
    if rank < len(q) or not np.min(np.linalg.eigvalsh(form)) > 0:
        return None
    centre = -0.5 * np.linalg.solve(form, q[6:])
    return middle + scale * centre, form / (1 + centre @ form @ centre) / scale**2


def _mean_radius(outputs: Float[np.ndarray, "n 3"]) -> float:
    """Of the ellipsoid through outputs, the geometric mean; where there is none, of a sphere about their midrange."""
    found = ellipsoid(outputs)
    if found is None:
        middle = 0.5 * (outputs.min(axis=0) + outputs.max(axis=0))
        return float(np.median(np.linalg.norm(outputs - middle, axis=1)))
    return float(np.linalg.det(found[1]) ** (-1 / 6))


def _lengths(
    vectors: Float[np.ndarray, "n 3"], file: str, names: Sequence[str], none: str
) -> Float[np.ndarray, "n"]:
    """Of vectors in these columns."""
    length = np.linalg.norm(vectors, axis=1)
    if not np.all(length > 0):
        row = int(np.argmin(length > 0)) + 1
        raise InputError(f"{file}, row {row}, columns {', '.join(names)}: {none}")
    return length


def component_readings(
    names: Sequence[str],
    values: Mapping[str, np.ndarray],
    units: Mapping[str, str | None],
    file: str,
) -> tuple[dict[str, np.ndarray], dict[str, str | None]]:
    """Return each of three outputs as a reading of its own, of a known rate about a direction in the body's axes.

    Readings about one direction, forward or back, are of one mounting, unless a column says which are. Arguments as
    `scalar_readings`; raises InputError for a rate without its direction, or about one of no length.
    """
    count = len(values[names[0]])
    turning = values[RATE] != 0
    lacking = [name for name in DIRECTION if name not in values]
    if lacking and turning.any():
        row = int(np.argmax(turning)) + 1
        raise InputError(
            f"{file}, row {row}, column {RATE}: a rate needs the direction that it is about, and "
            f"{', '.join(lacking)} is missing: give the table's axis in the body's axes, of length one"
        )
    direction = np.zeros((count, 3))
    if not lacking:
        direction = np.stack([values[name] for name in DIRECTION], axis=1)
    length = np.linalg.norm(direction, axis=1)
    if np.any(turning & ~(length > 0)):
        row = int(np.argmax(turning & ~(length > 0))) + 1
        raise InputError(
            f"{file}, row {row}, columns {', '.join(DIRECTION)}: a rate about a direction of length zero: give the "
            "table's axis in the body's axes"
        )
    direction = direction / np.where(length > 0, length, 1.0)[:, None]
    values = {**values, **dict(zip(DIRECTION, direction.T, strict=True))}
    outputs = np.stack([values[n] for n in names], axis=1)
    made = _three_each(values, np.broadcast_to(np.eye(3), (count, 3, 3)), outputs, AXES)
    if MOUNTING not in values:
        first = np.argmax(np.abs(direction) > 0.5, axis=1)  # one sign for both ways round
        way = direction * np.sign(direction[np.arange(count), first])[:, None]
        labels = ["about " + " ".join(f"{c + 0.0:.3f}" for c in one) for one in np.round(way, 3)]
        made[MOUNTING] = np.repeat(np.where(length > 0, labels, "at rest"), 3)
    own = {**dict.fromkeys((*ACROSS, *DIRECTION), "1"), MOUNTING: None, OF: None}
    return made, {**units, **own, "output": units[names[0]]}


def tangents(direction: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors at right angles to each direction and to each other."""
    least = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    one = np.cross(direction, least)
    one = one / np.linalg.norm(one, axis=1)[:, None]
    return one, np.cross(direction, one)
