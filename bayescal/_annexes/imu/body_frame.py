"""Magnetometers in the axes of accelerometers, by the dip of the field, which is the same in every pose at rest.

With û and n̂ the directions of the specific force and of the field in a pose, each in the axes of its own calibration,

    ûᵀ·R·n̂ = sin(dip)

for one rotation R and one dip (negative here where the field points down): four unknowns, by generalised least squares
over the poses of one log. Errors of both calibrations are shared by all poses and are in the covariance; the rotation's
own error is that of the correction that leaves, together with what it shares with the matrix and with the force's
correction, which a heading by both counts. Where poses scatter by more than their uncertainty (iron near by), the
rotation is that much more uncertain (R. Birge, Phys. Rev. 40 (1932) 207). An axis that points backwards and a field
that points to the other side of the level are the same to it: the dip found is said.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

import bayescal as bc
from bayescal._annexes.imu.still_stretches import in_common, logged_runs, per_sample
from bayescal._annexes.imu.vector_correction import UNKNOWN_DIRECTIONS, VectorCorrection

SWEEPS = 20  # of Gauss–Newton
SETTLED_RADIANS = 1e-10  # rad, by which the last may move
UNKNOWNS = 4  # the rotation and the dip
TURNS = Rotation.create_group("O").as_matrix()  # the 24 that take axes to axes
SCATTER = 0.2  # of sin(dip) between poses, from which on the axes do not fit or the field is none


def in_frame_of(
    field: VectorCorrection,
    field_log: bc.Measurements,
    force: VectorCorrection,
    force_log: bc.Measurements,
    *,
    shortest: float | None = None,
) -> VectorCorrection:
    """The correction of magnetometers in the axes of the accelerometers of the same unit.

    Args:
        field: correction of the magnetometers, of first order in the field.
        field_log: samples of theirs, with a column `time`, in one run.
        force: correction of the accelerometers.
        force_log: samples of theirs on the same clock.
        shortest: of a pose, s.

    Raises:
        InputError: fewer than five poses in common, poses that do not determine the rotation, axes of unlike
            handedness or a field that differs from pose to pose, or a correction of higher order.
    """
    if field.order > 1:
        raise bc.InputError(
            "the correction of the magnetometers has terms of higher order, which are not turned into other axes: fit "
            "the model without them"
        )
    runs = [
        logged_runs(per_sample(log), correction.outputs, shortest)
        for log, correction in ((force_log, force), (field_log, field))
    ]
    label = next(iter(runs[0]))
    pull, drawn = runs[0][label], runs[1].get(label)
    windows = np.zeros((0, 2)) if drawn is None else in_common(pull.ends(), drawn.ends())
    if drawn is None or len(windows) <= UNKNOWNS:
        raise bc.InputError(
            f"{field_log.file}: {len(windows)} poses in common with {force_log.file}, and five or more are needed: log "
            "both together, at rest for some seconds in each of many poses"
        )
    f, f_slopes, f_own = force.in_poses(pull, windows)
    m, m_slopes, m_own = field.in_poses(drawn, windows)
    f_all = f_slopes @ force.covariance @ f_slopes.T + f_own
    up, f_size = _split(f)
    along, m_size = _split(m)
    starts = [np.std(np.sum(up * (along @ r.T), axis=1)) for r in TURNS]
    turn = TURNS[int(np.argmin(starts))]
    dip = float(np.mean(np.sum(up * (along @ turn.T), axis=1)))
    terms = field.covariance

    def linear(turn: np.ndarray, dip: float) -> tuple[np.ndarray, ...]:
        """What is left, its weight, the estimate's gain; what terms of both move it by; covariance beside."""
        turned = along @ turn.T
        cosine = np.sum(up * turned, axis=1)
        by_force = block_diag(*(turned - cosine[:, None] * up) / f_size)
        by_field = block_diag(*(up @ turn - cosine[:, None] * along) / m_size)
        beside = by_force @ f_all @ by_force.T + by_field @ m_own @ by_field.T
        shared = by_field @ m_slopes
        weight = np.linalg.inv(beside + shared @ terms @ shared.T)
        slopes = np.column_stack([np.cross(turned, up), -np.ones(len(up))])
        information = slopes.T @ weight @ slopes
        if np.linalg.cond(information) > 1 / np.finfo(float).eps:
            raise bc.InputError(
                f"{field_log.file}: these poses do not determine how magnetometers and accelerometers stand to each "
                "other: turn the unit about all three axes"
            )
        gain = np.linalg.solve(information, slopes.T @ weight)
        return cosine - dip, weight, gain, shared, by_force @ f_slopes, beside

    left, weight, gain, shared, of_force, beside = linear(turn, dip)
    for _ in range(SWEEPS):
        step = -gain @ left
        turn = Rotation.from_rotvec(step[:3]).as_matrix() @ turn
        dip += float(step[3])
        left, weight, gain, shared, of_force, beside = linear(turn, dip)
        if np.max(np.abs(step)) < SETTLED_RADIANS:
            break
    if not np.std(left) < SCATTER:
        raise bc.InputError(
            f"{field_log.file}: the angle between field and gravity differs by {np.std(left):.2g} rad from pose to "
            "pose, and one field has one dip. Is iron or a current near, or are two columns exchanged?"
        )
    ratio = max(1.0, float(left @ weight @ left) / (len(left) - UNKNOWNS))
    gain = gain[:3]
    made, by_turn = _rotated(field, turn, gain @ shared, ratio * gain @ beside @ gain.T)
    with_force = by_turn @ gain @ of_force @ force.covariance
    down = np.rad2deg(np.arcsin(np.clip(-dip, -1.0, 1.0)))
    said = (
        f"Axes are those of the accelerometers, by a field {abs(down):.1f}° {'below' if down >= 0 else 'above'} the "
        "level. If it points to the other side where you are, an axis of the magnetometers points backwards."
    )
    return replace(made, notes=(said, *made.notes), axes_of=force.source, shared=with_force)


def _rotated(
    field: VectorCorrection,
    turn: Float[np.ndarray, "3 3"],
    by_terms: Float[np.ndarray, "3 q"],
    beside: Float[np.ndarray, "3 3"],
) -> tuple[VectorCorrection, Float[np.ndarray, "q 3"]]:
    """In other axes, and what a turn of these moves its terms by."""
    k, p = field.terms.shape
    rotate = np.eye(p)
    rotate[3:12, 3:12] = np.kron(np.eye(3), turn)
    terms = field.terms @ rotate.T
    matrix = terms[:, 3:12].reshape(k, 3, 3)
    by_turn = np.zeros((k, p, 3))
    # (1 + [ρ×])ᵀ on the right of a row is ρ × row.
    by_turn[:, 3:12] = np.stack([np.cross(e, matrix) for e in np.eye(3)], axis=3).reshape(k, 9, 3)
    by_turn = by_turn.reshape(k * p, 3)
    moved = np.kron(np.eye(k), rotate) + by_turn @ by_terms
    covariance = moved @ field.covariance @ moved.T + by_turn @ beside @ by_turn.T
    notes = [note for note in field.notes if note != UNKNOWN_DIRECTIONS]
    made = replace(field, terms=terms, covariance=covariance, notes=tuple(notes))
    return made, by_turn


def _split(vectors: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, 3) and lengths (n, 1)."""
    size = np.linalg.norm(vectors, axis=1)[:, None]
    return vectors / size, size
