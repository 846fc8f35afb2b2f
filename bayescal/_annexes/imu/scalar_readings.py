"""Readings of three outputs as scalar ones.

What acts has a known magnitude (gravity, a field): a pose becomes its magnitude and, where its direction is known, two
projections. What acts is known, or nothing (a rate table): each output is a reading of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

import bayescal as bc
from bayescal import workshop as ws

POSE_UNCERTAINTY = "pose_uncertainty"  # of a known direction, rad
MOUNTING = "mounting"  # readings that share an error of the direction
Values = Mapping[str, np.ndarray]
Units = Mapping[str, str | None]


def scalar_readings(
    instrument: bc.Instrument, values: Values, units: Units, file: str
) -> tuple[Values, Units, list[str]]:
    """Return readings of three outputs as readings of one, with their units and flags.

    Args:
        instrument: with a column `magnitude` where what acts has one magnitude in all poses; else it is known.
        values, units: columns of a file, one entry a pose, and their units.
        file: for messages.

    Raises:
        InputError: a direction without its uncertainty or of no length, or a pose that measures nothing.
    """
    if "output" in values:  # they are so already
        return values, units, []
    sized = [column.meaning for column in instrument.columns if column.name == ws.MAGNITUDE]
    read = pose_readings if sized else component_readings
    made, made_units = read(instrument.outputs, values, units, file)
    if ws.MAGNITUDE_READ not in made.keys() - values.keys():
        return made, made_units, []
    size = f"{made[ws.MAGNITUDE_READ][0]:.4g} {made_units[ws.MAGNITUDE_READ]}"
    flag = (
        f"{file}: the magnitude {sized[0]} is not given (--local-field, or a column {ws.MAGNITUDE!r}): it is taken as "
        f"the outputs read it, {size}, and ratios of scale factors are measured"
    )
    return made, made_units, [flag]


def pose_readings(
    names: Sequence[str], values: Values, units: Units, file: str
) -> tuple[Values, Units]:
    """Return of each pose its magnitude and, where its direction is known, two projections.

    Where neither the magnitude of what acts is given nor what the outputs make of it, the latter is added: the mean
    radius of their ellipsoid, which makes the scale factors ratios. Arguments as of `scalar_readings`.
    """
    y = np.stack([values[name] for name in names], axis=1)
    if ws.MAGNITUDE not in values and ws.MAGNITUDE_READ not in values:
        values = {**values, ws.MAGNITUDE_READ: np.full(len(y), _mean_radius(y))}
        units = {**units, ws.MAGNITUDE_READ: units[names[0]]}
    size = _lengths(
        y, file, names, "all three read zero, so nothing acts on them: take the row out"
    )
    made_units = {**units, "output": units[names[0]]}
    given = [own for own in (*ws.DIRECTION, POSE_UNCERTAINTY) if own in values]
    if not given:
        return {**values, "output": size}, made_units
    if len(given) < 4:
        lacking = sorted({*ws.DIRECTION, POSE_UNCERTAINTY} - {*given})
        raise bc.InputError(
            f"{file}: a known direction needs {', '.join((*ws.DIRECTION, POSE_UNCERTAINTY))}, and "
            f"{', '.join(lacking)} is missing: add it, or take the others out, and directions are unknown"
        )
    direction = np.stack([values[name] for name in ws.DIRECTION], axis=1)
    none = "a direction of length zero: give the direction of what acts, in the body's axes"
    direction = direction / _lengths(direction, file, ws.DIRECTION, none)[:, None]
    across = np.stack([np.zeros_like(y), *tangents(direction)], axis=1)  # (n, 3 readings, 3)
    outputs = np.column_stack([size, np.einsum("nkj,nj->nk", across[:, 1:], y)])
    angle = values[POSE_UNCERTAINTY] * ws.magnitude(values)
    beside = values.get(ws.UNCERTAINTY, np.zeros(len(y)))
    uncertainty = np.stack([beside, *2 * [np.hypot(beside, angle)]], axis=1)
    values = {**values, **dict(zip(ws.DIRECTION, direction.T, strict=True))}
    made = _three_each(values, across, outputs, ("magnitude", "across", "across too"))
    made |= {ws.UNCERTAINTY: uncertainty.ravel()}
    made_units |= {
        **dict.fromkeys(ws.ACROSS, "1"),
        ws.UNCERTAINTY: made_units["output"],
        ws.OF: None,
    }
    return made, made_units


def _three_each(
    values: Values,
    across: Float[np.ndarray, "n 3 3"],
    outputs: Float[np.ndarray, "n 3"],
    labels: Sequence[str],
) -> dict[str, np.ndarray]:
    """Return three readings of each moment: its outputs, what they are projections on, and what they are called."""
    made = {name: np.repeat(v, 3) for name, v in values.items()}
    made |= {name: across[:, :, i].ravel() for i, name in enumerate(ws.ACROSS)}
    return made | {"output": outputs.ravel(), ws.OF: np.tile(labels, len(outputs))}


def _mean_radius(outputs: Float[np.ndarray, "n 3"]) -> float:
    """Of the ellipsoid through outputs, the geometric mean; where there is none, of a sphere about their midrange."""
    found = ws.ellipsoid(outputs)
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
        raise bc.InputError(f"{file}, row {row}, columns {', '.join(names)}: {none}")
    return length


def component_readings(
    names: Sequence[str], values: Values, units: Units, file: str
) -> tuple[Values, Units]:
    """Return each of three outputs as a reading of its own, of a known rate about a direction in the body's axes.

    Readings about one direction, forward or back, are of one mounting, unless a column says which are. Arguments as
    `scalar_readings`; raises InputError for a rate without its direction, or about one of no length.
    """
    count = len(values[names[0]])
    turning = values[ws.RATE] != 0
    lacking = [name for name in ws.DIRECTION if name not in values]
    if lacking and turning.any():
        row = int(np.argmax(turning)) + 1
        raise bc.InputError(
            f"{file}, row {row}, column {ws.RATE}: a rate needs the direction that it is about, and "
            f"{', '.join(lacking)} is missing: give the table's axis in the body's axes, of length one"
        )
    direction = np.zeros((count, 3))
    if not lacking:
        direction = np.stack([values[name] for name in ws.DIRECTION], axis=1)
    length = np.linalg.norm(direction, axis=1)
    if np.any(turning & ~(length > 0)):
        row = int(np.argmax(turning & ~(length > 0))) + 1
        raise bc.InputError(
            f"{file}, row {row}, columns {', '.join(ws.DIRECTION)}: a rate about a direction of length zero: give the "
            "table's axis in the body's axes"
        )
    direction = direction / np.where(length > 0, length, 1.0)[:, None]
    values = {**values, **dict(zip(ws.DIRECTION, direction.T, strict=True))}
    outputs = np.stack([values[n] for n in names], axis=1)
    made = _three_each(values, np.broadcast_to(np.eye(3), (count, 3, 3)), outputs, ws.AXES)
    if MOUNTING not in values:
        first = np.argmax(np.abs(direction) > 0.5, axis=1)  # one sign for both ways round
        way = direction * np.sign(direction[np.arange(count), first])[:, None]
        labels = ["about " + " ".join(f"{c + 0.0:.3f}" for c in one) for one in np.round(way, 3)]
        made[MOUNTING] = np.repeat(np.where(length > 0, labels, "at rest"), 3)
    own = {**dict.fromkeys((*ws.ACROSS, *ws.DIRECTION), "1"), MOUNTING: None, ws.OF: None}
    return made, {**units, **own, "output": units[names[0]]}


def tangents(direction: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors at right angles to each direction and to each other."""
    least = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    one = np.cross(direction, least)
    one = one / np.linalg.norm(one, axis=1)[:, None]
    return one, np.cross(direction, one)
