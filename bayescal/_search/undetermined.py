"""What readings cannot tell of a model, before anything is fitted, and which poses would.

The model, linearised at the means of its priors, says which combinations of coefficients move no planned reading by
more than its noise. Of three axes a reading in each of 26 directions (along the axes, at 45° between two, along the
diagonals), at the ends of the temperatures, adds information on these: greedily the most, the plainest where near.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._calibration.summary import null_vectors, unidentified_claims
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

# Information on a combination of coefficients, in units of its prior's, that poses to add must come to: its standard
# deviation is then below 0.7 of the prior's.
DETERMINED_INFORMATION = 1.0
# Share of the log volume that the best pose takes off, from which one that is easier to set does as well.
PLAINER_SHARE = 0.5

DIRECTIONS = np.array(
    sorted((d for d in product((1, 0, -1), repeat=3) if any(d)), key=lambda d: sum(map(abs, d))),
    dtype=float,
)
TURNING = 100.0  # output unit, where no reading turns
WARMER = 30.0  # °C, where all readings are at one temperature


@dataclass(frozen=True)
class AddedPose:
    """A reading to add: direction of what acts, temperature, °C, if one is recorded, and a known rate, output unit."""

    direction: tuple[float, float, float]
    temperature: float | None = None
    rate: float | None = None

    def __str__(self) -> str:
        pairs = zip(AXES, self.direction, strict=True)
        parts = [f"{'−' if d < 0 else ''}{axis}" for axis, d in pairs if d]
        words = ("along ", "at 45° between ", "along the diagonal of ")[len(parts) - 1]
        where = words + (" and " if len(parts) == 2 else ", ").join(parts)
        where = where if self.rate is None else f"{self.rate:g} about the axis {where}"
        return where if self.temperature is None else f"{where}, at {self.temperature:.4g} °C"


@dataclass(frozen=True, repr=False)
class Undetermined(Printed):
    """What planned readings do not tell."""

    readings: int  # how many there are; poses, of an instrument of three axes
    combinations: tuple[str, ...]  # of coefficients, each a sentence
    add: tuple[AddedPose, ...] = ()  # poses that would determine them, the most telling first
    left: int = 0  # combinations that none of these poses determines; zero where no pose was sought

    def _parts(self) -> list[str]:
        if not self.combinations:
            return [f"{self.readings} readings determine every coefficient."]
        lines = [f"{self.readings} readings do not determine:"]
        lines += [f"  {words}" for words in self.combinations]
        if self.add:
            lines += ["Add one each:", *(f"  {pose}" for pose in self.add)]
        if self.left:
            lines.append(f"{self.left} combination(s) are determined by no further pose.")
        return lines

    def _brief(self) -> str:
        return f"{len(self.combinations)} combinations not determined, {len(self.add)} poses to add"

    def _columns(self) -> dict[str, list[str]]:
        return {"combination": list(self.combinations)}


def undetermined(model: Model, readings: Measurements) -> Undetermined:
    """Find the coefficients that planned readings would not determine; nothing is fitted.

    Args:
        model: with its priors: what is not determined against these.
        readings: as planned. Of an instrument of three axes outputs are what acts in the poses; of poses that were
            taken they may be as measured.

    Raises:
        ModelError: an effect needs a column that the readings lack.
    """
    model.require(readings)
    layout, levels = bind(model, readings)
    reference = reference_of(readings)

    def linear(rows: Measurements) -> LinearModel:
        frame = build_frame(rows, reference, levels, readings)
        record = Record(model.instrument, frame, np.asarray(rows["output"]))
        return linearise_at_priors(Problem(layout, record))

    planned, vector = linear(readings), model.instrument.vector
    in_moves = readings.has(TURNED[0])  # what it takes is a log with further moves, about any axis
    count = len(readings) // (3 if readings.has(ACROSS[0]) and not in_moves else 1)
    directions = null_vectors(planned, with_exact=False)[1] if layout.size else []
    claims = unidentified_claims(planned, levels, with_exact=False)
    combinations = tuple(claims[: len(directions)])  # none of a rig's errors
    if vector is None or not directions or in_moves:
        return Undetermined(count, combinations)
    poses, rows = _candidates(model, vector, readings)
    basis = np.linalg.qr(np.array(directions).T)[0]
    columns = linear(rows).white_nuisance[:, : len(basis)] @ basis
    effort = [sum(d != 0 for d in p.direction) for p in poses]
    chosen, open_count = _greedy(columns.reshape(len(poses), -1, basis.shape[1]), effort)
    return Undetermined(count, combinations, tuple(poses[i] for i in chosen), open_count)


def _candidates(
    model: Model, vector: Vector, readings: Measurements
) -> tuple[list[AddedPose], Measurements]:
    """Return poses that may be added, and readings of them, in all else as the first."""
    warm: list[float | None] = [None]
    if any("temperature" in effect.columns for effect in model.effects):
        low, high = float(readings["temperature"].min()), float(readings["temperature"].max())
        warm = [low, high if high > low else low + WARMER]
    per_pose, first, rate = 1, 0, None
    if vector.acting is not None:
        per_pose, rate = 3, float(np.max(np.abs(readings[RATE]))) or TURNING
    elif readings.has(ACROSS[0]):  # a magnitude: what an unknown direction leaves
        first = int(np.argmin(np.any([readings[n] != 0 for n in ACROSS], axis=0)))
    poses = [AddedPose((d[0], d[1], d[2]), t, rate) for t in warm for d in DIRECTIONS.tolist()]
    units = np.array([p.direction for p in poses])
    units = units / np.linalg.norm(units, axis=1)[:, None]
    columns: dict[str, Any] = {}
    if warm[0] is not None:
        columns["temperature"] = np.array([p.temperature for p in poses])
    if rate is not None:
        columns |= {RATE: np.full(len(poses), rate)}
        columns |= {name: units[:, i] for i, name in enumerate(DIRECTION)}
    else:
        size = float(magnitude(readings)[0])
        columns |= {"output": np.full(len(poses), size)}
        columns |= {name: size * units[:, i] for i, name in enumerate(vector.outputs)}
    rows = readings.select(np.tile(first + np.arange(per_pose), len(poses)))
    for name, values in columns.items():
        rows = rows.with_column(name, np.repeat(values, per_pose))
    return poses, rows


def _greedy(columns: Float[np.ndarray, "c r k"], effort: list[int]) -> tuple[list[int], int]:
    """Choose candidates that determine k directions; return them and the count of directions left.

    Of whitened columns, one set a candidate; those of less effort are taken where they add nearly as much.
    """
    k = columns.shape[2]
    information, chosen = np.zeros((k, k)), list[int]()
    while True:
        weights, vectors = np.linalg.eigh(information)
        open_ = columns @ vectors[:, weights < DETERMINED_INFORMATION]  # not determined yet
        inner = open_ @ open_.transpose(0, 2, 1)
        gain = np.linalg.slogdet(np.eye(columns.shape[1]) + inner)[1]
        gain[chosen] = 0.0
        if not gain.max() > np.log1p(DETERMINED_INFORMATION):
            return chosen, open_.shape[2]
        near = [i for i in range(len(gain)) if gain[i] > PLAINER_SHARE * gain.max()]
        chosen.append(min(near, key=lambda i: (effort[i], i)))
        information = information + columns[chosen[-1]].T @ columns[chosen[-1]]
