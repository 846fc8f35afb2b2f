"""Readings of three outputs as scalar readings.

Where the magnitude of the input is known (gravity, a field), a pose becomes its magnitude and, with a known direction,
two projections. Where the input itself is known or zero (a rate table), each output is a reading.
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
    readings, reading_units = read(instrument.outputs, values, units, file)
    if ws.MAGNITUDE_READ not in readings.keys() - values.keys():
        return readings, reading_units, []
    size = f"{readings[ws.MAGNITUDE_READ][0]:.4g} {reading_units[ws.MAGNITUDE_READ]}"
    flag = (
        f"{file}: the magnitude {sized[0]} is not given (--local-field, or a column {ws.MAGNITUDE!r}): it is taken as "
        f"the outputs read it, {size}, and ratios of scale factors are measured"
    )
    return readings, reading_units, [flag]


def pose_readings(
    names: Sequence[str], values: Values, units: Units, file: str
) -> tuple[Values, Units]:
    """Return the magnitude of each pose and, where its direction is known, two projections.

    Where neither the magnitude of what acts is given nor what the outputs make of it, the latter is added: the mean
    radius of their ellipsoid, which makes the scale factors ratios. Arguments as of `scalar_readings`.
    """
    y = np.stack([values[name] for name in names], axis=1)
    if ws.MAGNITUDE not in values and ws.MAGNITUDE_READ not in values:
        values = {**values, ws.MAGNITUDE_READ: np.full(len(y), _mean_radius(y))}
        units = {**units, ws.MAGNITUDE_READ: units[names[0]]}
    size = _require_lengths(
        y, file, names, "all three read zero, so nothing acts on them: take the row out"
    )
    reading_units = {**units, "output": units[names[0]]}
    direction_columns = [column for column in (*ws.DIRECTION, POSE_UNCERTAINTY) if column in values]
    if not direction_columns:
        return {**values, "output": size}, reading_units
    if len(direction_columns) < 4:
        lacking = sorted({*ws.DIRECTION, POSE_UNCERTAINTY} - {*direction_columns})
        raise bc.InputError(
            f"{file}: a known direction needs {', '.join((*ws.DIRECTION, POSE_UNCERTAINTY))}, and "
            f"{', '.join(lacking)} is missing: add it, or take the others out, and directions are unknown"
        )
    direction = np.stack([values[name] for name in ws.DIRECTION], axis=1)
    none = "a direction of length zero: give the direction of what acts, in the body's axes"
    direction = direction / _require_lengths(direction, file, ws.DIRECTION, none)[:, None]
    across = np.stack([np.zeros_like(y), *tangents(direction)], axis=1)  # (n, 3 readings, 3)
    outputs = np.column_stack([size, np.einsum("nkj,nj->nk", across[:, 1:], y)])
    angle = values[POSE_UNCERTAINTY] * ws.magnitude(values)
    output_sd = values.get(ws.UNCERTAINTY, np.zeros(len(y)))
    uncertainty = np.stack([output_sd, *2 * [np.hypot(output_sd, angle)]], axis=1)
    values = {**values, **dict(zip(ws.DIRECTION, direction.T, strict=True))}
    readings = _repeat(values, across, outputs, ("magnitude", "across", "across too"))
    readings |= {ws.UNCERTAINTY: uncertainty.ravel()}
    reading_units |= {
        **dict.fromkeys(ws.ACROSS, "1"),
        ws.UNCERTAINTY: reading_units["output"],
        ws.OF: None,
    }
    return readings, reading_units


def _repeat(
    values: Values,
    across: Float[np.ndarray, "n 3 3"],
    outputs: Float[np.ndarray, "n 3"],
    labels: Sequence[str],
) -> dict[str, np.ndarray]:
    """Return three readings for each row: outputs, directions of projection, labels."""
    columns = {name: np.repeat(v, 3) for name, v in values.items()}
    columns |= {name: across[:, :, i].ravel() for i, name in enumerate(ws.ACROSS)}
    return columns | {"output": outputs.ravel(), ws.OF: np.tile(labels, len(outputs))}


def _mean_radius(outputs: Float[np.ndarray, "n 3"]) -> float:
    """Return the geometric mean radius of the ellipsoid through outputs, else the median one about their midrange."""
    fitted = ws.ellipsoid(outputs)
    if fitted is None:
        middle = 0.5 * (outputs.min(axis=0) + outputs.max(axis=0))
        return float(np.median(np.linalg.norm(outputs - middle, axis=1)))
    return float(np.linalg.det(fitted[1]) ** (-1 / 6))


def _require_lengths(
    vectors: Float[np.ndarray, "n 3"], file: str, names: Sequence[str], none: str
) -> Float[np.ndarray, "n"]:
    """Return the lengths of vectors in columns `names`; raise InputError for a length of zero."""
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
    readings = _repeat(values, np.broadcast_to(np.eye(3), (count, 3, 3)), outputs, ws.AXES)
    if MOUNTING not in values:
        first = np.argmax(np.abs(direction) > 0.5, axis=1)  # one sign for both ways round
        way = direction * np.sign(direction[np.arange(count), first])[:, None]
        labels = ["about " + " ".join(f"{c + 0.0:.3f}" for c in axis) for axis in np.round(way, 3)]
        readings[MOUNTING] = np.repeat(np.where(length > 0, labels, "at rest"), 3)
    new_units = {**dict.fromkeys((*ws.ACROSS, *ws.DIRECTION), "1"), MOUNTING: None, ws.OF: None}
    return readings, {**units, **new_units, "output": units[names[0]]}


def tangents(direction: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors orthogonal to each direction and to each other."""
    least = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    first = np.cross(direction, least)
    first = first / np.linalg.norm(first, axis=1)[:, None]
    return first, np.cross(direction, first)
