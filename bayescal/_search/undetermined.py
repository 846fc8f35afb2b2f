"""Combinations of coefficients that planned readings do not determine, and poses that would determine them.

The model, linearised at the means of its priors, gives the combinations of coefficients that change no planned reading
by more than its noise. For instruments of three axes a greedy algorithm then adds poses in 26 directions (along the
axes, at 45° between two, along the diagonals) at the ends of the temperature range: each time the pose that most
reduces the log volume of these combinations, or the simplest with more than half of this reduction.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._calibration.summary import find_null_vectors, find_unidentified
from bayescal._core.result_table import Printed
from bayescal._data.measurements import Measurements
from bayescal._data.pose_rows import ACROSS, AXES, DIRECTION, RATE, TURNED, magnitude
from bayescal._inference.linear_model import LinearModel, linearise_at_priors
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.model import Model
from bayescal._model.parameters import bind
from bayescal._model.vector import Vector

# Information on a combination of coefficients over its prior's, from which it is determined: 0.7 of the prior's sd.
DETERMINED_INFORMATION = 1.0
# Share of the best pose's reduction of log volume from which a pose that is simpler to set is preferred.
MIN_SHARE_OF_BEST_REDUCTION = 0.5

DIRECTIONS = np.array([d for d in product((1.0, 0.0, -1.0), repeat=3) if any(d)])
DIRECTIONS = DIRECTIONS[np.argsort(np.abs(DIRECTIONS).sum(axis=1), kind="stable")]
DEFAULT_RATE = 100.0  # output unit, where no reading turns
TEMPERATURE_STEP = 30.0  # °C, where all readings are at one temperature


@dataclass(frozen=True)
class AddedPose:
    """A reading to add: direction of the stimulus, temperature (°C) if recorded, and a known rate (output unit)."""

    direction: tuple[float, float, float]
    temperature: float | None = None
    rate: float | None = None

    def __str__(self) -> str:
        pairs = zip(AXES, self.direction, strict=True)
        axes = [f"{'−' if d < 0 else ''}{axis}" for axis, d in pairs if d]
        relation = ("along ", "at 45° between ", "along the diagonal of ")[len(axes) - 1]
        text = relation + (" and " if len(axes) == 2 else ", ").join(axes)
        text = text if self.rate is None else f"{self.rate:g} about the axis {text}"
        return text if self.temperature is None else f"{text}, at {self.temperature:.4g} °C"


@dataclass(frozen=True, repr=False)
class Undetermined(Printed):
    """Combinations of coefficients that planned readings do not determine, and poses to add; printed as text."""

    readings: int  # number of readings; of poses, for an instrument of three axes
    combinations: tuple[str, ...]  # combinations of coefficients, a sentence each
    add: tuple[AddedPose, ...] = ()  # poses that would determine them, the most informative first
    left: int = 0  # number of combinations left undetermined; 0 if no pose was sought

    def _list_parts(self) -> list[str]:
        if not self.combinations:
            return [f"{self.readings} readings determine every coefficient."]
        lines = [f"{self.readings} readings do not determine:"]
        lines += [f"  {words}" for words in self.combinations]
        if self.add:
            lines += ["Add one each:", *(f"  {pose}" for pose in self.add)]
        if self.left:
            lines.append(f"No further pose determines the other {self.left} combination(s).")
        return lines

    def _format_summary(self) -> str:
        return f"{len(self.combinations)} combinations not determined, {len(self.add)} poses to add"

    def _list_columns(self) -> dict[str, list[str]]:
        return {"combination": list(self.combinations)}


def undetermined(model: Model, readings: Measurements) -> Undetermined:
    """Find the coefficients that planned readings would not determine; nothing is fitted.

    Args:
        model: the model, with the priors against which a combination counts as not determined.
        readings: planned readings. The outputs of an instrument of three axes are the stimulus in each pose; for
            poses already taken they may be the measured outputs.

    Raises:
        ModelError: an effect needs a column that the readings lack.
    """
    model.require(readings)
    (layout, levels), reference = bind(model, readings), reference_of(readings)

    def linearise(rows: Measurements) -> LinearModel:
        frame = build_frame(rows, reference, levels, readings)
        record = Record(model.instrument, frame, np.asarray(rows["output"]))
        return linearise_at_priors(Problem(layout, record))

    planned_model, vector = linearise(readings), model.instrument.vector
    is_log = readings.has(TURNED[0])  # a log of moves: it needs further moves, about any axis
    count = len(readings) // (3 if readings.has(ACROSS[0]) and not is_log else 1)
    directions = find_null_vectors(planned_model, include_exact=False)[1] if layout.size else []
    claims = find_unidentified(planned_model, levels, include_exact=False)
    combinations = tuple(claims[: len(directions)])  # none of a rig's errors
    if vector is None or not directions or is_log:
        return Undetermined(count, combinations)
    poses, rows = _list_poses(model, vector, readings)
    basis = np.linalg.qr(np.array(directions).T)[0]
    columns = linearise(rows).white_nuisance[:, : len(basis)] @ basis
    effort = [sum(d != 0 for d in p.direction) for p in poses]
    indices, left_count = _choose_poses(columns.reshape(len(poses), -1, basis.shape[1]), effort)
    return Undetermined(count, combinations, tuple(poses[i] for i in indices), left_count)


def _list_poses(
    model: Model, vector: Vector, readings: Measurements
) -> tuple[list[AddedPose], Measurements]:
    """Return the poses that may be added, and simulated readings of them.

    Columns that the pose does not set are copied from the first reading; if the readings are of a magnitude, from the
    first one of unknown direction.
    """
    ends: list[float | None] = [None]
    if any("temperature" in effect.columns for effect in model.effects):
        low, high = float(readings["temperature"].min()), float(readings["temperature"].max())
        ends = [low, high if high > low else low + TEMPERATURE_STEP]
    rows_per_pose, template_row, rate = 1, 0, None
    if vector.acting is not None:
        rows_per_pose, rate = 3, float(np.max(np.abs(readings[RATE]))) or DEFAULT_RATE
    elif readings.has(ACROSS[0]):  # a magnitude: the direction is unknown
        template_row = int(np.argmin(np.any([readings[n] != 0 for n in ACROSS], axis=0)))
    poses = [AddedPose((d[0], d[1], d[2]), t, rate) for t in ends for d in DIRECTIONS.tolist()]
    unit_vectors = np.array([p.direction for p in poses])
    unit_vectors = unit_vectors / np.linalg.norm(unit_vectors, axis=1)[:, None]
    columns: dict[str, Any] = {}
    if ends[0] is not None:
        columns["temperature"] = np.array([p.temperature for p in poses])
    if rate is not None:
        columns |= {RATE: np.full(len(poses), rate)}
        columns |= {name: unit_vectors[:, i] for i, name in enumerate(DIRECTION)}
    else:
        size = float(magnitude(readings)[0])
        columns |= {"output": np.full(len(poses), size)}
        columns |= {name: size * unit_vectors[:, i] for i, name in enumerate(vector.outputs)}
    rows = readings.select(np.tile(template_row + np.arange(rows_per_pose), len(poses)))
    for name, values in columns.items():
        rows = rows.with_column(name, np.repeat(values, rows_per_pose))
    return poses, rows


def _choose_poses(columns: Float[np.ndarray, "c r k"], effort: list[int]) -> tuple[list[int], int]:
    """Choose poses that determine k combinations of coefficients; return their indices and how many are left.

    `columns` are the whitened columns of c poses along the combinations; a pose of less `effort` to set is preferred if
    it adds nearly as much information.
    """
    k = columns.shape[2]
    information, chosen_indices = np.zeros((k, k)), list[int]()
    while True:
        weights, vectors = np.linalg.eigh(information)
        open_columns = columns @ vectors[:, weights < DETERMINED_INFORMATION]  # not determined yet
        inner = open_columns @ open_columns.transpose(0, 2, 1)
        log_volumes = np.linalg.slogdet(np.eye(columns.shape[1]) + inner)[1]
        log_volumes[chosen_indices] = 0.0
        if not log_volumes.max() > np.log1p(DETERMINED_INFORMATION):
            return chosen_indices, open_columns.shape[2]
        candidates = np.flatnonzero(
            log_volumes > MIN_SHARE_OF_BEST_REDUCTION * log_volumes.max()
        ).tolist()
        chosen_indices.append(min(candidates, key=lambda i: (effort[i], i)))
        information = information + columns[chosen_indices[-1]].T @ columns[chosen_indices[-1]]
