"""Magnetometers in the axes of accelerometers, by the dip of the field, which is the same in every pose at rest.

With û and n̂ the directions of the specific force and of the field in a pose, each in the axes of its own calibration,

    ûᵀ·R·n̂ = sin(dip)

for one rotation R and one dip (negative here where the field points down): four unknowns, by generalised least squares
over the poses of one log. Errors of both calibrations are shared by all poses and are in the covariance; the rotation's
own error is that of the correction that leaves, together with what it shares with the matrix. Where poses scatter by
more than their uncertainty (iron near by), the rotation is that much more uncertain (R. Birge, Phys. Rev. 40 (1932)
207). An axis that points backwards and a field that points to the other side of the level are the same to it: the dip
found is said.
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

MAX_ITERATIONS = 20  # of Gauss–Newton
CONVERGENCE_RADIANS = 1e-10  # largest last step
N_PARAMETERS = 4  # the rotation and the dip
AXIS_ROTATIONS = Rotation.create_group("O").as_matrix()  # the 24 that take axes to axes
MAX_DIP_SCATTER = 0.2  # standard deviation of sin(dip) between poses: above it axes are wrong


def in_frame_of(
    field: VectorCorrection,
    field_log: bc.Measurements,
    force: VectorCorrection,
    force_log: bc.Measurements,
    *,
    shortest: float | None = None,
) -> VectorCorrection:
    """Rotate a magnetometer correction to the axes of the accelerometers of the same unit.

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
    f_run, m_run = runs[0][label], runs[1].get(label)
    windows = np.zeros((0, 2)) if m_run is None else in_common(f_run.ends(), m_run.ends())
    if m_run is None or len(windows) <= N_PARAMETERS:
        raise bc.InputError(
            f"{field_log.file}: {len(windows)} poses in common with {force_log.file}, and five or more are needed: log "
            "both together, at rest for some seconds in each of many poses"
        )
    f, f_slopes, f_cov = force.in_poses(f_run, windows)
    m, m_slopes, m_cov = field.in_poses(m_run, windows)
    f_all = f_slopes @ force.covariance @ f_slopes.T + f_cov
    up, f_size = _directions_and_lengths(f)
    field_direction, m_size = _directions_and_lengths(m)
    starts = [np.std(np.sum(up * (field_direction @ r.T), axis=1)) for r in AXIS_ROTATIONS]
    turn = AXIS_ROTATIONS[int(np.argmin(starts))]
    dip = float(np.mean(np.sum(up * (field_direction @ turn.T), axis=1)))
    terms = field.covariance

    def linearise(turn: np.ndarray, dip: float) -> tuple[np.ndarray, ...]:
        """Return residuals, weight, gain, sensitivities to the terms of the field, covariance of the poses."""
        turned = field_direction @ turn.T
        cosine = np.sum(up * turned, axis=1)
        by_force = block_diag(*(turned - cosine[:, None] * up) / f_size)
        by_field = block_diag(*(up @ turn - cosine[:, None] * field_direction) / m_size)
        pose_cov = by_force @ f_all @ by_force.T + by_field @ m_cov @ by_field.T
        shared = by_field @ m_slopes
        weight = np.linalg.inv(pose_cov + shared @ terms @ shared.T)
        slopes = np.column_stack([np.cross(turned, up), -np.ones(len(up))])
        information = slopes.T @ weight @ slopes
        if np.linalg.cond(information) > 1 / np.finfo(float).eps:
            raise bc.InputError(
                f"{field_log.file}: these poses do not determine how magnetometers and accelerometers stand to each "
                "other: turn the unit about all three axes"
            )
        gain = np.linalg.solve(information, slopes.T @ weight)
        return cosine - dip, weight, gain, shared, pose_cov

    residuals, weight, gain, shared, pose_cov = linearise(turn, dip)
    for _ in range(MAX_ITERATIONS):
        step = -gain @ residuals
        turn = Rotation.from_rotvec(step[:3]).as_matrix() @ turn
        dip += float(step[3])
        residuals, weight, gain, shared, pose_cov = linearise(turn, dip)
        if np.max(np.abs(step)) < CONVERGENCE_RADIANS:
            break
    if not np.std(residuals) < MAX_DIP_SCATTER:
        raise bc.InputError(
            f"{field_log.file}: the angle between field and gravity differs by {np.std(residuals):.2g} rad from pose "
            "to pose, and one field has one dip. Is iron or a current near, or are two columns exchanged?"
        )
    ratio = max(1.0, float(residuals @ weight @ residuals) / (len(residuals) - N_PARAMETERS))
    gain = gain[:3]
    moved = _rotate(field, turn, gain @ shared, ratio * gain @ pose_cov @ gain.T)
    down = np.rad2deg(np.arcsin(np.clip(-dip, -1.0, 1.0)))
    note = (
        f"Axes are those of the accelerometers, by a field {abs(down):.1f}° {'below' if down >= 0 else 'above'} the "
        "level. If it points to the other side where you are, an axis of the magnetometers points backwards."
    )
    return replace(moved, notes=(note, *moved.notes))


def _rotate(
    field: VectorCorrection,
    turn: Float[np.ndarray, "3 3"],
    turn_by_terms: Float[np.ndarray, "3 q"],
    turn_cov: Float[np.ndarray, "3 3"],
) -> VectorCorrection:
    """Rotate a correction, given the rotation's sensitivities to its terms and its own covariance."""
    k, p = field.terms.shape
    rotate = np.eye(p)
    rotate[3:12, 3:12] = np.kron(np.eye(3), turn)
    terms = field.terms @ rotate.T
    matrix = terms[:, 3:12].reshape(k, 3, 3)
    by_turn = np.zeros((k, p, 3))
    # (1 + [ρ×])ᵀ on the right of a row is ρ × row.
    by_turn[:, 3:12] = np.stack([np.cross(e, matrix) for e in np.eye(3)], axis=3).reshape(k, 9, 3)
    by_turn = by_turn.reshape(k * p, 3)
    jacobian = np.kron(np.eye(k), rotate) + by_turn @ turn_by_terms
    covariance = jacobian @ field.covariance @ jacobian.T + by_turn @ turn_cov @ by_turn.T
    notes = [note for note in field.notes if note != UNKNOWN_DIRECTIONS]
    return replace(field, terms=terms, covariance=covariance, notes=tuple(notes))


def _directions_and_lengths(vectors: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (n, 3) and lengths (n, 1) of vectors."""
    size = np.linalg.norm(vectors, axis=1)[:, None]
    return vectors / size, size
