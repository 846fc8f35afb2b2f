"""Conversion of readings of three outputs to scalar readings.

If the magnitude of the input is known (gravity, a field), a pose is converted to the magnitude of the outputs and, with
a known direction, two projections. If the input itself is known or zero (a rate table), each output is a reading.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

import bayescal as bc
from bayescal import workshop as ws

POSE_UNCERTAINTY = "pose_uncertainty"  # column: standard uncertainty of a known direction, rad
MOUNTING = "mounting"  # column: label of readings that share a direction error
Values = Mapping[str, np.ndarray]
Units = Mapping[str, str | None]
NO_DIRECTION = (
    f"columns {', '.join(ws.DIRECTION)}: the direction of the input, or of the table's axis, in the body's axes is "
    "needed, and must not be zero"
)


def convert_to_scalar_readings(
    instrument: bc.Instrument, values: Values, units: Units, file: str
) -> tuple[Values, Units, list[str]]:
    """Convert readings of three outputs to readings of one output; return their columns, units and flags.

    Args:
        instrument: three-axis instrument; if it has a column `magnitude`, only the input's magnitude is known.
        values, units: columns of a file, one entry per pose, and their units.
        file: name of the file in error messages.

    Raises:
        InputError: a direction without uncertainty or of zero length, or a pose with three zero outputs.
    """
    if "output" in values:  # scalar already
        return values, units, []
    outputs = np.stack([values[name] for name in instrument.outputs], axis=1)
    units = {**units, "output": units[instrument.outputs[0]]}
    meanings = {column.name: column.meaning for column in instrument.columns}
    if ws.MAGNITUDE not in meanings:
        return *_convert_components(outputs, values, units, file), []
    flags = list[str]()
    if ws.MAGNITUDE not in values and ws.MAGNITUDE_READ not in values:
        radius = _estimate_mean_radius(outputs)
        values = {**values, ws.MAGNITUDE_READ: np.full(len(outputs), radius)}
        units = {**units, ws.MAGNITUDE_READ: units["output"]}
        flags.append(
            f"{file}: the magnitude {meanings[ws.MAGNITUDE]} is missing (--local-field, or column {ws.MAGNITUDE!r}): "
            f"their mean radius, {radius:.4g} {units['output']}, is used; only ratios of scale factors are identified"
        )
    problem = f"columns {', '.join(instrument.outputs)}: all three are zero: remove the row"
    lengths = _require_lengths(outputs, problem, file)
    columns = [*ws.DIRECTION, POSE_UNCERTAINTY]
    missing_columns = [column for column in columns if column not in values]
    if missing_columns == columns:
        return {**values, "output": lengths}, units, flags
    if missing_columns:
        raise bc.InputError(
            f"{file}: a known direction needs {', '.join(columns)}; not in the file: {', '.join(missing_columns)}. "
            "Add what is missing, or remove the others to calibrate with unknown directions"
        )
    return *_convert_poses(outputs, lengths, values, units, file), flags


def _convert_poses(
    outputs: Float[np.ndarray, "n 3"],
    magnitude: Float[np.ndarray, "n"],
    values: Values,
    units: Units,
    file: str,
) -> tuple[Values, Units]:
    """Return each pose's magnitude and its projections on two axes orthogonal to its known direction, with units."""
    direction = np.stack([values[name] for name in ws.DIRECTION], axis=1)
    direction = direction / _require_lengths(direction, NO_DIRECTION, file)[:, None]
    axes = np.stack([np.zeros_like(outputs), *build_tangents(direction)], axis=1)  # (n, 3, 3)
    scalars = np.column_stack([magnitude, np.einsum("nkj,nj->nk", axes[:, 1:], outputs)])
    direction_sd = values[POSE_UNCERTAINTY] * ws.magnitude(values)
    output_sd = values.get(ws.UNCERTAINTY, np.zeros(len(outputs)))
    uncertainty = np.stack([output_sd, *2 * [np.hypot(output_sd, direction_sd)]], axis=1)
    labels = ("magnitude", "across", "across too")
    readings = _repeat_rows(values, direction, axes, scalars, labels)
    readings |= {ws.UNCERTAINTY: uncertainty.ravel()}
    new_units = {**dict.fromkeys(ws.ACROSS, "1"), ws.UNCERTAINTY: units["output"], ws.AXIS: None}
    return readings, {**units, **new_units}


def _convert_components(
    outputs: Float[np.ndarray, "n 3"], values: Values, units: Units, file: str
) -> tuple[Values, Units]:
    """Return each output as a separate reading of a known rate about a direction in the body's axes.

    Without a column `mounting`, readings about one axis, in either sense, share a mounting. Raises InputError for a
    rate whose direction is missing or zero.
    """
    direction = np.zeros_like(outputs)
    if all(name in values for name in ws.DIRECTION):
        direction = np.stack([values[name] for name in ws.DIRECTION], axis=1)
    lengths = _require_lengths(direction, NO_DIRECTION, file, is_required=values[ws.RATE] != 0)
    direction = direction / np.where(lengths > 0, lengths, 1.0)[:, None]
    components = np.broadcast_to(np.eye(3), (len(outputs), 3, 3))
    readings = _repeat_rows(values, direction, components, outputs, ws.AXES)
    if MOUNTING not in values:
        indices = np.argmax(np.abs(direction) > 0.5, axis=1)  # of components that fix axes' signs
        axes = direction * np.sign(direction[np.arange(len(outputs)), indices])[:, None]
        labels = ["about " + " ".join(f"{c + 0.0:.3f}" for c in axis) for axis in np.round(axes, 3)]
        readings[MOUNTING] = np.repeat(np.where(lengths > 0, labels, "at rest"), 3)
    new_units = {**dict.fromkeys((*ws.ACROSS, *ws.DIRECTION), "1"), MOUNTING: None, ws.AXIS: None}
    return readings, {**units, **new_units}


def _repeat_rows(
    values: Values,
    direction: Float[np.ndarray, "n 3"],
    axes: Float[np.ndarray, "n 3 3"],
    outputs: Float[np.ndarray, "n 3"],
    labels: Sequence[str],
) -> dict[str, np.ndarray]:
    """Return columns with three rows for each pose, with its values, unit direction, axes, outputs and labels."""
    values = {**values, **dict(zip(ws.DIRECTION, direction.T, strict=True))}
    columns = {name: np.repeat(v, 3) for name, v in values.items()}
    columns |= {name: axes[:, :, i].ravel() for i, name in enumerate(ws.ACROSS)}
    return columns | {"output": outputs.ravel(), ws.AXIS: np.tile(labels, len(outputs))}


def _estimate_mean_radius(outputs: Float[np.ndarray, "n 3"]) -> float:
    """Return the geometric mean radius of the outputs' ellipsoid, or their median distance from the midrange."""
    ellipsoid = ws.fit_ellipsoid(outputs)
    if ellipsoid is None:
        midrange = 0.5 * (outputs.min(axis=0) + outputs.max(axis=0))
        return float(np.median(np.linalg.norm(outputs - midrange, axis=1)))
    return float(np.linalg.det(ellipsoid[1]) ** (-1 / 6))


def _require_lengths(
    vectors: Float[np.ndarray, "n 3"],
    problem: str,
    file: str,
    is_required: Bool[np.ndarray, "n"] | bool = True,
) -> Float[np.ndarray, "n"]:
    """Return the lengths of vectors; raise InputError, with `problem` as reason, if a required length is zero."""
    lengths = np.linalg.norm(vectors, axis=1)
    if np.any(is_zero := is_required & ~(lengths > 0)):
        raise bc.InputError(f"{file}, row {int(np.argmax(is_zero)) + 1}, {problem}")
    return lengths


def build_tangents(direction: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors orthogonal to each direction and to each other."""
    axis = np.eye(3)[np.argmin(np.abs(direction), axis=1)]  # the one farthest from the direction
    tangent = np.cross(direction, axis)
    tangent = tangent / np.linalg.norm(tangent, axis=1)[:, None]
    return tangent, np.cross(direction, tangent)
