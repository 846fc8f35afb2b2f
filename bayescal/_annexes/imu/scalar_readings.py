"""Readings of three outputs as scalar readings.

Where the magnitude of the input is known (gravity, a field), a pose becomes its magnitude and, with a known direction,
two projections. Where the input itself is known or zero (a rate table), each output is a reading.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

import bayescal as bc
from bayescal import workshop as ws

POSE_UNCERTAINTY = "pose_uncertainty"  # of a known direction, rad
MOUNTING = "mounting"  # readings that share an error of the direction
Values = Mapping[str, np.ndarray]
Units = Mapping[str, str | None]
NO_DIRECTION = (
    f"columns {', '.join(ws.DIRECTION)}: a direction is needed, of a length above zero: that of what acts, or of the "
    "table's axis, in the body's axes"
)


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
    outputs = np.stack([values[name] for name in instrument.outputs], axis=1)
    units = {**units, "output": units[instrument.outputs[0]]}
    sized = [column.meaning for column in instrument.columns if column.name == ws.MAGNITUDE]
    if not sized:
        return *_component_readings(outputs, values, units, file), []
    flags = list[str]()
    if ws.MAGNITUDE not in values and ws.MAGNITUDE_READ not in values:
        radius = _mean_radius(outputs)
        values = {**values, ws.MAGNITUDE_READ: np.full(len(outputs), radius)}
        units = {**units, ws.MAGNITUDE_READ: units["output"]}
        flags.append(
            f"{file}: the magnitude {sized[0]} is not given (--local-field, or a column {ws.MAGNITUDE!r}): it is taken "
            f"as the outputs read it, {radius:.4g} {units['output']}, and ratios of scale factors are measured"
        )
    where = f"columns {', '.join(instrument.outputs)}: all three read zero"
    size = _require_lengths(outputs, f"{where}, so nothing acts on them: take the row out", file)
    columns = [*ws.DIRECTION, POSE_UNCERTAINTY]
    lacking = [column for column in columns if column not in values]
    if lacking == columns:
        return {**values, "output": size}, units, flags
    if lacking:
        raise bc.InputError(
            f"{file}: a known direction needs {', '.join(columns)}, and {', '.join(lacking)} is missing: add it, or "
            "take the others out, and directions are unknown"
        )
    return *_pose_readings(outputs, size, values, units, file), flags


def _pose_readings(
    outputs: Float[np.ndarray, "n 3"],
    size: Float[np.ndarray, "n"],
    values: Values,
    units: Units,
    file: str,
) -> tuple[Values, Units]:
    """Return the magnitude of each pose and two projections across its known direction."""
    direction = np.stack([values[name] for name in ws.DIRECTION], axis=1)
    direction = direction / _require_lengths(direction, NO_DIRECTION, file)[:, None]
    across = np.stack([np.zeros_like(outputs), *tangents(direction)], axis=1)  # (n, 3 readings, 3)
    scalar = np.column_stack([size, np.einsum("nkj,nj->nk", across[:, 1:], outputs)])
    angle = values[POSE_UNCERTAINTY] * ws.magnitude(values)
    output_sd = values.get(ws.UNCERTAINTY, np.zeros(len(outputs)))
    uncertainty = np.stack([output_sd, *2 * [np.hypot(output_sd, angle)]], axis=1)
    readings = _repeat(values, direction, across, scalar, ("magnitude", "across", "across too"))
    readings |= {ws.UNCERTAINTY: uncertainty.ravel()}
    new_units = {**dict.fromkeys(ws.ACROSS, "1"), ws.UNCERTAINTY: units["output"], ws.OF: None}
    return readings, {**units, **new_units}


def _component_readings(
    outputs: Float[np.ndarray, "n 3"], values: Values, units: Units, file: str
) -> tuple[Values, Units]:
    """Return each of three outputs as a reading of its own, of a known rate about a direction in the body's axes.

    Readings about one direction, forward or back, are of one mounting, unless a column says which are. Raises
    InputError for a rate without its direction, or about one of no length.
    """
    direction = np.zeros_like(outputs)
    if all(name in values for name in ws.DIRECTION):
        direction = np.stack([values[name] for name in ws.DIRECTION], axis=1)
    length = _require_lengths(direction, NO_DIRECTION, file, needed=values[ws.RATE] != 0)
    direction = direction / np.where(length > 0, length, 1.0)[:, None]
    across = np.broadcast_to(np.eye(3), (len(outputs), 3, 3))
    readings = _repeat(values, direction, across, outputs, ws.AXES)
    if MOUNTING not in values:
        first = np.argmax(np.abs(direction) > 0.5, axis=1)  # one sign for both ways round
        way = direction * np.sign(direction[np.arange(len(outputs)), first])[:, None]
        labels = ["about " + " ".join(f"{c + 0.0:.3f}" for c in axis) for axis in np.round(way, 3)]
        readings[MOUNTING] = np.repeat(np.where(length > 0, labels, "at rest"), 3)
    new_units = {**dict.fromkeys((*ws.ACROSS, *ws.DIRECTION), "1"), MOUNTING: None, ws.OF: None}
    return readings, {**units, **new_units}


def _repeat(
    values: Values,
    direction: Float[np.ndarray, "n 3"],
    across: Float[np.ndarray, "n 3 3"],
    outputs: Float[np.ndarray, "n 3"],
    labels: Sequence[str],
) -> dict[str, np.ndarray]:
    """Return three readings for each row: unit directions, outputs, directions of projection, labels."""
    values = {**values, **dict(zip(ws.DIRECTION, direction.T, strict=True))}
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
    vectors: Float[np.ndarray, "n 3"],
    problem: str,
    file: str,
    needed: Bool[np.ndarray, "n"] | bool = True,
) -> Float[np.ndarray, "n"]:
    """Return the lengths of vectors; raise InputError for a length of zero where one is needed."""
    length = np.linalg.norm(vectors, axis=1)
    if np.any(missing := needed & ~(length > 0)):
        raise bc.InputError(f"{file}, row {int(np.argmax(missing)) + 1}, {problem}")
    return length


def tangents(direction: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors orthogonal to each direction and to each other."""
    least = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    first = np.cross(direction, least)
    first = first / np.linalg.norm(first, axis=1)[:, None]
    return first, np.cross(direction, first)
