"""Poses of three outputs as scalar readings: the magnitude and, where the direction is known, two projections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import InputError
from bayescal._data.column import UNCERTAINTY

AXES = ("x", "y", "z")
ACROSS = tuple(f"across_{a}" for a in AXES)  # the direction that a reading is the projection on
DIRECTION = tuple(f"direction_{a}" for a in AXES)  # of what acts, in the body's axes
POSE_UNCERTAINTY = "pose_uncertainty"  # of that direction, rad
MAGNITUDE = "magnitude"  # of what acts, output unit


def scalar_readings(
    names: Sequence[str],
    values: Mapping[str, np.ndarray],
    units: Mapping[str, str | None],
    file: str,
) -> tuple[dict[str, np.ndarray], dict[str, str | None]]:
    """Poses as scalar readings: of each its magnitude and, where its direction is known, two projections.

    Args:
        names: of the three outputs.
        values: columns of a file, one entry a pose.
        units: of these.
        file: for messages.

    Raises:
        InputError: a direction without its uncertainty or of no length, or a pose that measures nothing.
    """
    if "output" in values:  # they are so already
        return dict(values), dict(units)
    y = np.stack([values[name] for name in names], axis=1)
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
    across = np.stack([np.zeros_like(y), *_tangents(direction)], axis=1)  # (n, 3 readings, 3)
    outputs = np.column_stack([size, np.einsum("nkj,nj->nk", across[:, 1:], y)])
    angle = values[POSE_UNCERTAINTY] * values[MAGNITUDE]
    beside = values.get(UNCERTAINTY, np.zeros(len(y)))
    uncertainty = np.stack([beside, *2 * [np.hypot(beside, angle)]], axis=1)
    made = {name: np.repeat(v, 3) for name, v in values.items()}
    made |= {name: np.repeat(direction[:, i], 3) for i, name in enumerate(DIRECTION)}
    made |= {name: across[:, :, i].ravel() for i, name in enumerate(ACROSS)}
    made |= {"output": outputs.ravel(), UNCERTAINTY: uncertainty.ravel()}
    made_units |= {**dict.fromkeys(ACROSS, "1"), UNCERTAINTY: made_units["output"]}
    return made, made_units


def _lengths(
    vectors: Float[np.ndarray, "n 3"], file: str, names: Sequence[str], none: str
) -> Float[np.ndarray, "n"]:
    """Of vectors in these columns.

    Raises:
        InputError: one is zero, which is said as `none`.
    """
    length = np.linalg.norm(vectors, axis=1)
    if not np.all(length > 0):
        row = int(np.argmin(length > 0)) + 1
        raise InputError(f"{file}, row {row}, columns {', '.join(names)}: {none}")
    return length


def _tangents(direction: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors at right angles to each direction and to each other."""
    least = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    one = np.cross(direction, least)
    one = one / np.linalg.norm(one, axis=1)[:, None]
    return one, np.cross(direction, one)
