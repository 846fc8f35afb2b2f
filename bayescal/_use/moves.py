"""Gyroscopes by moves between poses, in which accelerometers of the same unit say which way is up: no rate table.

Between two poses at rest the up direction u moves in the body's axes, u_B = Cᵀ·u_A with dC/dt = C·[ω×]. The outputs
y = M·ω + b + … are integrated with a matrix M₀ and a bias b₀, and what is left over of u_B, on two axes q across it, is
linear in what M and b are off by. With P(t) the rotation from the body at t to the body at the end, and T the duration:

    qᵀ(u_B − C₀ᵀ·u_A) = ∫ aᵀ(δM·ω + δb + Γ·f + K2·ω² + ω_E)·dt,     a(t) = −M₀⁻ᵀ·P(t)ᵀ·(q × u_B)

So a move gives two readings, each a mean of the outputs along a direction a/T that turns with the unit, and the three
outputs at rest before and after it three more. A rotation about the vertical changes no direction of up: the attitude
about it need not be known.

M₀ and b₀ are iterated to the least-squares estimate, where the linear form is exact to the square of the uncertainty.
Each pose ends one move and begins another, and all of them share the errors of the accelerometers' calibration. Their
covariance is known, and readings are the innovations of the moves one after the other: what each says beside those
before it, with a known standard uncertainty beside that of the surest.

The Earth's rotation is three unknowns, along the axes that the body had in the first pose of a run.

Source: the method without its uncertainty is of D. Tedaldi, A. Pretto and E. Menegatti, ICRA 2014; rotation vectors of
rates between samples, coning among them: J. E. Bortz, IEEE Trans. AES 7 (1971) 61.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag, solve_triangular
from scipy.spatial.transform import Rotation

from bayescal._core.errors import InputError, ModelError
from bayescal._data.column import UNCERTAINTY
from bayescal._data.measurements import Measurements
from bayescal._data.pose_rows import (
    ACROSS,
    AROUND,
    AXES,
    DIRECTION,
    MOUNTING,
    OF,
    PULLED,
    SQUARED,
    TURNED,
    tangents,
)
from bayescal._data.still_stretches import (
    LoggedRun,
    as_readings,
    in_common,
    logged_runs,
    per_sample,
)
from bayescal._data.unit_conversion import convert, same_dimension
from bayescal._model.instrument import Instrument
from bayescal._use.vector_correction import VectorCorrection

SWEEPS = 12  # of integrating anew; four suffice for a matrix that is off by a tenth
FARTHEST = 0.5  # of an entry of the matrix from nominal: a wrong unit or axis, no gyroscope
SETTLED = 1e-3  # of a standard uncertainty, by which the last sweep may move an estimate
# Prior standard deviations of bias (rad/s), matrix and the Earth's rotation (rad/s) while that estimate is sought: they
# decide nothing but what moves leave open.
PRIOR = np.repeat([1.0, 0.1, np.deg2rad(15.04) / 3600], [3, 9, 3])
AT_ONCE = 20_000  # samples whose forces are corrected
SOUGHT = np.r_[:12, 24:27]  # the levers of these


class _Rows(NamedTuple):
    """Readings of one run, in rad/s and g: outputs, their levers and standard uncertainties."""

    output: Float[np.ndarray, "r"]
    levers: Float[np.ndarray, "r 27"]  # across, turned, pulled, squared, around
    uncertainty: Float[np.ndarray, "r"]
    windows: Float[np.ndarray, "r 2"]  # s
    force: Float[np.ndarray, "r 3"]  # g, its mean
    kinds: tuple[str, ...]


def moves(
    log: Measurements,
    instrument: Instrument,
    forces: Measurements,
    correction: VectorCorrection,
    *,
    shortest: float | None = None,
) -> Measurements:
    """Readings of gyroscopes: of each pose three outputs at rest, of each move between two poses two.

    The unit is at rest where both logs are; a slow turn about the vertical is seen by neither and counts as a bias.

    Args:
        log: samples of the gyroscopes, read with their instrument, with a column `time`.
        instrument: of the gyroscopes.
        forces: samples of the accelerometers of the same unit on the same clock, in the same runs.
        correction: of these accelerometers, in g; the body's axes are those of its calibration.
        shortest: of a pose, s.

    Returns:
        Readings that hold, beside the output, what it is a mean of: columns `across_x`, `turned_xx`, `pulled_xx`,
        `squared_x` and `around_1`, ….

    Raises:
        InputError: no column `time`, no still stretches or fewer than two poses in common, or an integration that does
            not settle.
        ModelError: an instrument whose outputs are no rates.
    """
    if instrument.vector is None or not same_dimension(instrument.unit, "rad/s"):
        raise ModelError(
            f"instrument {instrument.name!r}: moves are of three gyroscopes, and its output is in [{instrument.unit}]"
        )
    unit = float(np.asarray(convert(np.ones(1), instrument.unit, "rad/s"))[0])
    log, forces = per_sample(log), per_sample(forces)
    pulls = logged_runs(forces, correction.outputs, shortest)
    rates = logged_runs(log, instrument.vector.outputs, shortest)
    if lacking := sorted(rates.keys() - pulls.keys()):
        raise InputError(
            f"{forces.file}: run {lacking[0]!r} of {log.file} is not in it: log gyroscopes and accelerometers together"
        )
    made: dict[str, list[np.ndarray]] = {}
    poses = 0
    for run, own in rates.items():
        own = own._replace(
            outputs=unit * own.outputs,
            still=own.still._replace(of_second=unit * own.still.of_second),
        )
        windows = in_common(own.ends(), pulls[run].ends())
        if len(windows) < 2:
            raise InputError(
                f"{log.file}, run {run!r}: {len(windows)} poses in which gyroscopes and accelerometers are at rest "
                "together, and a move needs two: hold the unit still for some seconds before and after each move"
            )
        poses += len(windows)
        rows = _readings(own, pulls[run], windows, correction, log.file)
        labels, codes = log.groups("run")
        samples = log.select(codes == labels.index(run))
        for name, values in _columns(rows, samples, own, instrument.vector.beside, unit).items():
            made.setdefault(name, []).append(values)
    columns = {name: np.concatenate(parts) for name, parts in made.items()}
    # As of means of unequal numbers: the noise law's own is that of the surest reading, others have more beside it. A
    # noise beside known ones that suffice would have its mode at zero.
    surest = float(np.min(columns[UNCERTAINTY]))
    columns[UNCERTAINTY] = np.sqrt(columns[UNCERTAINTY] ** 2 - surest**2)
    found = as_readings(columns, instrument, log)
    said = (
        f"{len(found)} readings of {poses} poses and the moves between them, found in {log.file}; by the noise at rest "
        f"the surest is uncertain by {surest:.2g} {instrument.unit}, which noise.white is of"
    )
    return replace(found, sources=log.sources, flags=(said,))  # of the log, not of what is made


class _Moves(NamedTuple):
    """Samples of m moves, padded with the last one to one length; weights of a trapezoidal integral, 0 there."""

    rate: Float[np.ndarray, "m n 3"]  # as measured, rad/s
    slope: Float[np.ndarray, "m n 3"]  # of it in time, rad/s²
    force: Float[np.ndarray, "m n 3"]  # corrected, g
    step: Float[np.ndarray, "m n-1"]  # s
    weight: Float[np.ndarray, "m n"]  # s

    @property
    def duration(self) -> Float[np.ndarray, "m"]:
        return self.step.sum(axis=1)


def _forces(pull: LoggedRun, correction: VectorCorrection) -> Float[np.ndarray, "n 3"]:
    """Of every sample, some at once: covariances of all, which nobody asks for, would fill the memory."""
    parts = []
    for start in range(0, len(pull.time), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        warm = None if pull.temperature is None else pull.temperature[some]
        parts.append(correction(pull.outputs[some], warm, noise=0.0).vector)
    return np.concatenate(parts)


def _between(
    log: LoggedRun,
    windows: Float[np.ndarray, "k 2"],
    pull: LoggedRun,
    force: Float[np.ndarray, "s 3"],
) -> _Moves:
    """The samples from the end of each pose to the begin of the next."""
    own = [log.inside(a, b) for a, b in zip(windows[:-1, 1], windows[1:, 0], strict=True)]
    longest = max(s.stop - s.start for s in own)
    at = np.array([np.minimum(np.arange(s.start, s.start + longest), s.stop - 1) for s in own])
    step = np.diff(log.time[at], axis=1)
    weight = 0.5 * (np.pad(step, ((0, 0), (1, 0))) + np.pad(step, ((0, 0), (0, 1))))
    felt = np.stack([np.interp(log.time[at], pull.time, force[:, j]) for j in range(3)], axis=2)
    slope = np.gradient(log.outputs, log.time, axis=0)
    return _Moves(log.outputs[at], slope[at], felt, step, weight)


def _turned(moved: _Moves, matrix: np.ndarray, bias: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rates (m, n, 3), and rotations from the body at each sample to the body at the begin (m, n, 3, 3)."""
    back = np.linalg.inv(matrix).T
    rate, h = (moved.rate - bias) @ back, moved.step[..., None]
    # To the fourth order in the step: what a trapezoid leaves over, and coning.
    vectors = 0.5 * (rate[:, :-1] + rate[:, 1:]) - np.diff(moved.slope @ back, axis=1) * h / 12
    vectors = vectors * h + np.cross(rate[:, :-1], rate[:, 1:]) * h**2 / 12
    steps = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
    turned = np.empty((*rate.shape, 3))
    turned[:, 0] = np.eye(3)
    for k in range(steps.shape[1]):
        turned[:, k + 1] = turned[:, k] @ steps[:, k]
    return rate, turned


def _readings(
    log: LoggedRun,
    pull: LoggedRun,
    windows: Float[np.ndarray, "k 2"],
    correction: VectorCorrection,
    file: str,
) -> _Rows:
    """Of one run.

    Raises:
        InputError: the integration does not settle.
    """
    length = windows[:, 1] - windows[:, 0]
    felt, slopes, own = correction.in_poses(pull, windows)
    shared = slopes @ correction.covariance @ slopes.T + own
    force = _forces(pull, correction)
    moved, at_rest = _between(log, windows, pull, force), log.means(windows)
    between = np.stack([windows[:-1, 1], windows[1:, 0]], axis=1)
    midway = np.einsum("mn,mnj->mj", moved.weight, moved.force) / moved.duration[:, None]
    matrix, bias = np.eye(3), at_rest.mean(axis=0)
    for _ in range(SWEEPS):
        rate, turned = _turned(moved, matrix, bias)
        world = [np.eye(3)]  # from the body in each pose to the body in the first
        for own in turned[:, -1]:
            world.append(world[-1] @ own)
        closure = _closure(moved, rate, turned, matrix, felt, np.array(world))
        here = np.concatenate([bias, matrix.ravel(), np.zeros(15)])
        covariance = closure.of_forces @ shared @ closure.of_forces.T
        covariance += log.still.of_second**2 * block_diag(*closure.of_noise)
        factor = np.linalg.cholesky(covariance)
        own = np.diag(factor)
        # Lower with a diagonal of ones: what a move says beside those before it.
        table = np.column_stack([closure.left + closure.levers @ here, closure.levers])
        table = solve_triangular(factor / own, table, lower=True, unit_diagonal=True)
        rows = _Rows(
            output=np.concatenate([at_rest.ravel(), table[:, 0]]),
            levers=np.concatenate([_at_rest(matrix, felt, np.array(world)), table[:, 1:]]),
            uncertainty=np.concatenate([np.repeat(log.still.of_second / np.sqrt(length), 3), own]),
            windows=np.concatenate([np.repeat(windows, 3, axis=0), np.repeat(between, 2, axis=0)]),
            force=np.concatenate([np.repeat(felt, 3, axis=0), np.repeat(midway, 2, axis=0)]),
            kinds=(*AXES * len(windows), *("move", "move too") * len(between)),
        )
        found, sd = _estimate(rows, at_rest.mean(axis=0))
        settled = np.max(np.abs(found - here[:12]) / sd) < SETTLED
        bias, matrix = found[:3], found[3:].reshape(3, 3)
        if not np.max(np.abs(matrix - np.eye(3))) < FARTHEST:
            break
        if settled:
            return rows
    raise InputError(
        f"{file}: the outputs integrated over a move do not lead from one pose to the next. Check the unit of the "
        "gyroscopes, that their axes are those of the accelerometers, and that no rate is beyond their range"
    )


class _Closure(NamedTuple):
    """What moves leave over, two readings each, as mean rates."""

    left: Float[np.ndarray, "2m"]  # rad/s
    levers: Float[np.ndarray, "2m 27"]
    of_forces: Float[np.ndarray, "2m 3k"]  # slopes by the specific forces in the poses
    of_noise: Float[np.ndarray, "m 2 2"]  # covariance by white noise of one rad/s over a second


def _closure(
    moved: _Moves,
    rate: Float[np.ndarray, "m n 3"],
    turned: Float[np.ndarray, "m n 3 3"],
    matrix: Float[np.ndarray, "3 3"],
    felt: Float[np.ndarray, "k 3"],
    world: Float[np.ndarray, "k 3 3"],
) -> _Closure:
    size, m, back = np.linalg.norm(felt, axis=1), len(rate), turned[:, -1]
    up = felt / size[:, None]
    q = np.stack(tangents(up[1:]), axis=1)  # (m, 2, 3)
    before = np.einsum("mij,mkj->mki", back, q)  # q in the axes of the pose before
    left = np.einsum("mkj,mj->mk", q, up[1:]) - np.einsum("mkj,mj->mk", before, up[:-1])
    normal = np.cross(q, up[1:, None, :])
    at_begin = np.einsum("mij,mkj->mki", back, normal)
    duration = moved.duration[:, None, None]
    a = -np.einsum("mnji,mkj->mkni", turned, at_begin) @ np.linalg.inv(matrix) / duration[..., None]
    summed = a * moved.weight[:, None, :, None]
    levers = [
        summed.sum(axis=2),
        np.einsum("mkna,mnj->mkaj", summed, rate).reshape(m, 2, 9),
        np.einsum("mkna,mnj->mkaj", summed, moved.force).reshape(m, 2, 9),
        np.einsum("mkna,mna->mka", summed, rate**2),
        -np.einsum("mij,mkj->mki", world[1:], normal),
    ]
    slopes = np.zeros((m, 2, len(felt), 3))
    each = np.arange(m)
    slopes[each, :, each + 1] = q / size[1:, None, None] / duration
    slopes[each, :, each] = -before / size[:-1, None, None] / duration
    return _Closure(
        (left / duration[..., 0]).ravel(),
        np.concatenate(levers, axis=2).reshape(2 * m, -1),
        slopes.reshape(2 * m, -1),
        np.einsum("mkna,mlna->mkl", summed, a),
    )


def _at_rest(
    matrix: Float[np.ndarray, "3 3"],
    felt: Float[np.ndarray, "k 3"],
    world: Float[np.ndarray, "k 3 3"],
) -> Float[np.ndarray, "3k 27"]:
    """Levers of the three outputs in each pose: the Earth alone turns the body."""
    k, each = len(felt), np.eye(3)
    pulled = np.einsum("ab,kj->kabj", each, felt).reshape(k, 3, 9)
    around = matrix @ world.transpose(0, 2, 1)
    none = np.zeros((k, 3, 9))
    levers = [np.broadcast_to(each, (k, 3, 3)), none, pulled, none[..., :3], around]
    return np.concatenate(levers, axis=2).reshape(3 * k, -1)


def _estimate(
    rows: _Rows, bias: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "12"], Float[np.ndarray, "12"]]:
    """Bias and matrix by weighted least squares, and their standard uncertainties."""
    nominal = np.concatenate([bias, np.eye(3).ravel(), np.zeros(3)])
    levers = rows.levers[:, SOUGHT]
    white = levers / rows.uncertainty[:, None]
    covariance = np.linalg.inv(white.T @ white + np.diag(PRIOR**-2))
    off = white.T @ ((rows.output - levers @ nominal) / rows.uncertainty)
    return (nominal + covariance @ off)[:12], np.sqrt(np.diag(covariance))[:12]


def _columns(
    rows: _Rows, samples: Measurements, log: LoggedRun, beside: tuple[str, ...], unit: float
) -> dict[str, np.ndarray]:
    """Of readings, rates in the unit of the output; what else was recorded averaged over each."""
    powers = np.repeat([0.0, 1.0, 0.0, 2.0, 0.0], [3, 9, 9, 3, 3])
    names = (*ACROSS, *TURNED, *PULLED, *SQUARED, *AROUND)
    made = dict(zip(names, (rows.levers / unit**powers).T, strict=True))
    made |= {"output": rows.output / unit, UNCERTAINTY: rows.uncertainty / unit}
    made |= {OF: np.array(rows.kinds)}
    made |= {name: rows.force[:, j] for j, name in enumerate(beside)}
    inside = [log.inside(*w) for w in rows.windows]
    for name in samples.columns:
        if name in made or name in (*DIRECTION, MOUNTING):
            continue
        values = samples[name]
        # Labels do not average: the one at the begin holds.
        each = [values[s.start] if values.dtype.kind != "f" else values[s].mean() for s in inside]
        made[name] = np.array(each)
    return made
