"""Calibration of gyroscopes without a rate table, by moves between poses whose up direction accelerometers measure.

Between poses A and B the up direction u moves in the body's axes, u_B = Cᵀ·u_A with dC/dt = C·[ω×]. The outputs y =
M·ω + b + Γ·f + K2·ω² + ω_E (f specific force, ω_E Earth rate) are integrated with a matrix M₀ and a bias b₀; the
closure error of u_B along two axes q orthogonal to it is linear in their errors δM and δb. With P(t) the rotation from
the body at time t to the body at the end, and T the duration of the move:

    qᵀ(u_B − C₀ᵀ·u_A) = ∫ aᵀ(δM·ω + δb + Γ·f + K2·ω² + ω_E)·dt,     a(t) = −M₀⁻ᵀ·P(t)ᵀ·(q × u_B)

A move thus gives two readings, each a time mean of the outputs along the direction a/T, which is fixed in space;
each pose gives three more, its outputs at rest. The heading need not be known: a rotation about the vertical leaves the
up direction unchanged.

M₀ and b₀ are iterated by Gauss–Newton steps with step halving to the least-squares estimate, where the linearisation
error is of second order in the uncertainty. Consecutive moves share a pose, and all share the errors of the
accelerometers' calibration. Two variances are estimated from the residuals by marginal likelihood: that of the bias
between poses, and that of the closure angle of a move (creep in a pose, timing errors, aliasing, a nonlinear scale).
Readings are the innovations of the moves in time order, each with the known excess of its standard uncertainty over the
smallest. Outlying moves and poses are set aside and listed. The Earth rate is three unknowns, along the body axes in
the first pose of a run.

Sources: D. Tedaldi, A. Pretto and E. Menegatti, ICRA 2014 (the method, without its uncertainty); J. E. Bortz, IEEE
Trans. AES 7 (1971) 61 (rotation vectors between samples, with the coning correction).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import block_diag, solve_triangular
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc, logsumexp

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.imu.scalar_readings import MOUNTING, build_tangents
from bayescal._annexes.imu.still_stretches import (
    LoggedRun,
    average_segments,
    build_readings,
    intersect_windows,
    split_runs,
)
from bayescal._annexes.imu.vector_correction import VectorCorrection

# Design columns, in addition to `TURNED`: specific force j on axis a, squared rate on axis a, Earth rate.
FORCE_COLUMNS = tuple(f"pulled_{a}{j}" for a in ws.AXES for j in ws.AXES)
SQUARED_RATE_COLUMNS = tuple(f"squared_{a}" for a in ws.AXES)
EARTH_RATE_COLUMNS = tuple(f"around_{k}" for k in "123")
MAX_ITERATIONS = 60  # integrations; four suffice for a matrix with errors of a tenth
MAX_STEP_HALVINGS = 10  # of a step that increases the residual sum of squares (rss)
MAX_RSS_RATIO = 1.01  # of an accepted step's rss to the one before; the Jacobian is of first order
MAX_MATRIX_DEVIATION = 0.5  # of an entry from nominal: above it a wrong unit or axis
XTOL_SD = 0.01  # largest last step, in standard uncertainties
OUTLIER_PROBABILITY = 0.01  # family-wise, that a move or pose without error is set aside
MAX_OUTLIER_FRACTION = 0.2  # of the moves
# Prior standard deviations of bias (rad/s), matrix, sensitivity to specific force (rad/s/g) and to squared rate (s/rad)
# and Earth rate (rad/s) in that estimate: they matter only for parameters that the moves do not identify.
PRIOR_SD = np.repeat(
    [1.0, 0.1, np.deg2rad(0.1), np.rad2deg(1e-5), np.deg2rad(15.04) / 3600], [3, 9, 9, 3, 3]
)
N_INTEGRATED = 12  # number of parameters used in the integration: bias and matrix
# Prior scale of the bias between poses, rad/s, and of the closure angle of a move, rad: consumer parts, moved by hand.
PRIOR_SCALE = np.deg2rad(0.1)
SD_RATIOS = np.geomspace(0.1, 1000.0, 17)  # standard deviations tried, over the known one
SAMPLES_PER_BLOCK = 20_000  # whose specific forces are corrected together
MOVES_ADVICE = (
    "Check the unit of the gyroscopes, that their axes are those of the accelerometers, that no rate exceeds their "
    "range, and that no samples are lost"
)


@ws.renamed(shortest="min_duration")
def moves(
    log: bc.Measurements,
    instrument: bc.Instrument,
    forces: bc.Measurements,
    correction: VectorCorrection,
    *,
    min_duration: float | None = None,
) -> bc.Measurements:
    """Convert a log of gyroscopes to readings: three outputs at rest of each pose, two mean outputs of each move.

    The unit is at rest if both logs are static; slow rotation about the vertical is not detected, but adds to the bias.

    Args:
        log: samples of the gyroscopes, read with their instrument, with a column `time`.
        instrument: the gyroscopes' instrument.
        forces: samples of the accelerometers of the same unit, on the same clock, in the same runs.
        correction: correction of these accelerometers, in g, which defines the body's axes.
        min_duration: minimum duration of a pose, s; default 2, or 1 if many segments of a log are shorter than 2 s.

    Returns:
        Readings with the output and the columns of its linear model: `across_x` (bias), `turned_xx` (matrix),
        `pulled_xx` (specific force), `squared_x` (squared rate), `around_1` (Earth rate), and so on for other axes.

    Raises:
        InputError: no column `time`, no static segments or fewer than two common poses, moves that are inconsistent
            with the poses or whose fit does not converge, or too many outlying moves.
        ModelError: the instrument does not have three outputs in a unit of rate.
    """
    if instrument.vector is None or not ws.same_dimension(instrument.unit, "rad/s"):
        raise bc.ModelError(
            f"instrument {instrument.name!r} is not a triad of gyroscopes; moves calibrate no other instrument"
        )
    unit = float(np.asarray(ws.convert(np.ones(1), instrument.unit, "rad/s"))[0])
    f_runs = split_runs(forces, correction.outputs, min_duration)
    gyro_runs = split_runs(log, instrument.vector.outputs, min_duration, unit)
    if missing_runs := sorted(gyro_runs.keys() - f_runs.keys()):
        raise bc.InputError(
            f"{forces.file} lacks the run {missing_runs[0]!r} of {log.file}: log gyroscopes and accelerometers together"
        )
    tables = list[dict[str, np.ndarray]]()
    pose_count, outliers = 0, list[str]()
    for run, gyro in gyro_runs.items():
        windows = intersect_windows(gyro.pose_windows, f_runs[run].pose_windows)
        if len(windows) < 2:
            raise bc.InputError(
                f"{log.file}, run {run!r}: {len(windows)} poses in which gyroscopes and accelerometers are at rest, "
                "but a move needs two: hold the unit still for some seconds before and after each move"
            )
        pose_count += len(windows)
        try:
            model, fit, labels = _fit_run(gyro, f_runs[run], windows, correction, len(gyro_runs))
        except bc.InputError as error:
            raise bc.InputError(f"{log.file}, run {run!r}: {error}") from None
        outliers += labels
        columns = model.build_columns(fit, instrument.vector.secondary_columns, unit)
        names = [n for n in log.columns if n not in (*columns, *ws.DIRECTION, MOUNTING)]
        spans = map(gyro.find_rows, *model.poses.spans[model.segment].T)
        tables.append(columns | average_segments(gyro.samples, names, spans))
    columns = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    # The noise law has the smallest variance of a reading, the column the excess of the others: the mode of a noise in
    # addition to the known variances would be zero.
    variances = columns[ws.UNCERTAINTY] ** 2
    min_sd = float(np.sqrt(variances.min()))
    columns[ws.UNCERTAINTY] = np.sqrt(variances - variances.min())
    readings = build_readings(columns, instrument, log)
    summary = (
        f"{len(readings)} readings of {pose_count} poses and the moves between them, found in {log.file}; noise.white "
        f"is their smallest standard uncertainty, estimated from scatter as {min_sd:.2g} {instrument.unit}"
    )
    notes = [f"{log.file}: set aside as an outlier: {outlier}" for outlier in outliers]
    return replace(readings, sources=log.sources, flags=(summary, *notes))


class _Moves(NamedTuple):
    """Samples of m moves, padded to one length n by repetition of the last sample."""

    rate: Float[np.ndarray, "m n 3"]  # as measured, rad/s
    slope: Float[np.ndarray, "m n 3"]  # time derivative of the rate, rad/s²
    force: Float[np.ndarray, "m n 3"]  # corrected, g
    step: Float[np.ndarray, "m n-1"]  # s
    weight: Float[np.ndarray, "m n"]  # of the trapezoidal rule, s; 0 in the padding

    @property
    def duration(self) -> Float[np.ndarray, "m"]:
        return self.step.sum(axis=1)


def _correct_forces(f_run: LoggedRun, correction: VectorCorrection) -> Float[np.ndarray, "n 3"]:
    """Return the corrected specific force of each sample, g, computed in blocks to limit memory."""
    count, log_values = len(f_run.time), f_run.temperature
    temperature = correction.default_temperature if log_values is None else log_values
    temperature = np.broadcast_to(temperature, count)
    blocks = np.array_split(np.arange(count), 1 + count // SAMPLES_PER_BLOCK)
    parts = (correction(f_run.outputs[rows], temperature[rows], noise=0.0) for rows in blocks)
    return np.concatenate([corrected.vector for corrected in parts])


def _cut_moves(
    log: LoggedRun,
    windows: Float[np.ndarray, "k 2"],
    f_run: LoggedRun,
    force: Float[np.ndarray, "s 3"],
) -> _Moves:
    """Return the samples of each move, from the end of a pose to the beginning of the next."""
    slices = [log.find_rows(*w) for w in zip(windows[:-1, 1], windows[1:, 0], strict=True)]
    offsets = np.arange(max(s.stop - s.start for s in slices))
    rows = np.array([np.minimum(s.start + offsets, s.stop - 1) for s in slices])
    times, slope = log.time[rows], np.gradient(log.outputs, log.time, axis=0)
    step = np.diff(times, axis=1)
    weight = 0.5 * (np.pad(step, ((0, 0), (1, 0))) + np.pad(step, ((0, 0), (0, 1))))
    forces = np.stack([np.interp(times, f_run.time, force[:, j]) for j in range(3)], axis=2)
    return _Moves(log.outputs[rows], slope[rows], forces, step, weight)


def _integrate_attitude(
    samples: _Moves, matrix: np.ndarray, bias: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rates (m, n, 3), and rotation matrices (m, n, 3, 3) from a sample's body axes to its move's first."""
    inverse = np.linalg.inv(matrix).T
    rate, h = (samples.rate - bias) @ inverse, samples.step[..., None]
    # Fourth order in the step: corrections of the trapezoidal rule, and for coning.
    vectors = 0.5 * (rate[:, :-1] + rate[:, 1:]) - np.diff(samples.slope @ inverse, axis=1) * h / 12
    vectors = vectors * h + np.cross(rate[:, :-1], rate[:, 1:]) * h**2 / 12
    steps = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
    rotation = np.empty((*rate.shape, 3))
    rotation[:, 0] = np.eye(3)
    for k in range(steps.shape[1]):
        rotation[:, k + 1] = rotation[:, k] @ steps[:, k]
    return rate, rotation


@ws.run_on_one_thread
def _fit_run(
    log: LoggedRun,
    f_run: LoggedRun,
    windows: Float[np.ndarray, "k 2"],
    correction: VectorCorrection,
    n_runs: int,
) -> tuple[_LinearModel, _Estimate, list[str]]:
    """Fit bias and matrix to the moves of one run; return linear model, estimate, and labels of the outliers.

    Args:
        log: samples of the gyroscopes.
        f_run: samples of the accelerometers.
        windows: start and end time of each pose, s.
        correction: correction of the accelerometers.
        n_runs: number of runs that share the errors of the correction, which do not average out.

    Raises:
        InputError: as in `moves`.
    """
    force, slopes, pose_cov = correction.correct_poses(f_run, windows)
    force_cov = n_runs * slopes @ correction.covariance @ slopes.T + pose_cov
    outputs, white_variance = log.average_outputs(windows), log.segments.one_second_sd**2
    prior_mean = np.concatenate([outputs.mean(axis=0), np.eye(3).ravel(), np.zeros(15)])
    poses = _Poses(outputs, windows, force, force_cov, white_variance, prior_mean)
    samples = _cut_moves(log, windows, f_run, _correct_forces(f_run, correction))
    max_outliers = max(1, int(MAX_OUTLIER_FRACTION * len(samples.rate)))
    prior_parameters, outliers = poses.prior_mean[:N_INTEGRATED], frozenset[int]()
    closure = _integrate_moves(samples, force, prior_parameters)
    for _ in range(MAX_ITERATIONS):
        linear_model = _LinearModel.build(poses, closure, outliers)
        fit = linear_model.estimate_variances()
        step = fit.mean[:N_INTEGRATED] - closure.parameters
        step_size = float(np.max(np.abs(step) / np.sqrt(np.diag(fit.covariance)[:N_INTEGRATED])))
        cov = linear_model.covariance(fit.bias_variance, fit.angle_variance)
        max_rss = MAX_RSS_RATIO * linear_model.weighted_rss(fit, cov)
        for _ in range(MAX_STEP_HALVINGS if step_size >= XTOL_SD else 0):
            trial_closure = _integrate_moves(samples, force, closure.parameters + step)
            if _LinearModel.build(poses, trial_closure, outliers).weighted_rss(fit, cov) < max_rss:
                closure = trial_closure
                break
            step = 0.5 * step
        else:  # converged; or the closure error of one move is too large to be linearised
            new_outliers = linear_model.find_outlier(fit, outliers)
            if new_outliers == outliers:
                break
            outliers = new_outliers
            if sum(k >= len(windows) for k in outliers) > max_outliers:
                raise bc.InputError(
                    f"more than {max_outliers} of {len(samples.rate)} moves are outliers, inconsistent with the other "
                    f"moves. {MOVES_ADVICE}"
                )
    deviation = np.max(np.abs(closure.parameters - prior_parameters)[3:])
    if step_size >= XTOL_SD or not deviation < MAX_MATRIX_DEVIATION:
        raise bc.InputError(
            "the outputs integrated over the moves are inconsistent with the poses for any matrix: make smaller turns "
            f"between poses, with turns about all three axes, and hold each pose longer. {MOVES_ADVICE}"
        )
    ends = {k: " to ".join(ws.number(end, 5) for end in poses.spans[k]) for k in sorted(outliers)}
    kinds = {k: "pose" if k < len(windows) else "move" for k in ends}
    return linear_model, fit, [f"the {kinds[k]} from {ends[k]} s" for k in ends]


class _Poses(NamedTuple):
    """Mean outputs and specific forces in the poses of one run, and the prior mean of the parameters."""

    outputs: Float[np.ndarray, "k 3"]  # means, rad/s
    windows: Float[np.ndarray, "k 2"]  # start and end times, s
    force: Float[np.ndarray, "k 3"]  # specific force, g
    force_covariance: Float[np.ndarray, "3k 3k"]  # of all specific forces, g²
    white_variance: float  # variance of a mean output over a second, (rad/s)²
    # Prior mean of the parameters: bias as measured at rest, identity matrix, zeros.
    prior_mean: Float[np.ndarray, "27"]

    @property
    def spans(self) -> Float[np.ndarray, "km 2"]:
        """Return the start and end times, s, of each pose, then of each move."""
        moves = np.stack([self.windows[:-1, 1], self.windows[1:, 0]], axis=1)
        return np.concatenate([self.windows, moves])


class _Estimate(NamedTuple):
    """Posterior of the parameters, given the variances of the bias between poses and of the closure angles."""

    mean: Float[np.ndarray, "27"]
    covariance: Float[np.ndarray, "27 27"]
    bias_variance: float  # (rad/s)²
    angle_variance: float  # rad²
    log_density: float  # log marginal likelihood of the outputs


class _LinearModel(NamedTuple):
    """Linear model of a run's outputs, at rest and over moves, without outliers: output = design · parameters."""

    poses: _Poses
    closure: _Closure
    output: Float[np.ndarray, "r"]  # rad/s
    design: Float[np.ndarray, "r 27"]
    segment: Int[np.ndarray, "r"]  # index of an output's pose or move; moves follow poses
    known_covariance: Float[np.ndarray, "r r"]  # without variances of bias and closure angle
    duration: Float[np.ndarray, "r"]  # of the moves, s; infinite at rest

    @classmethod
    def build(cls, poses: _Poses, closure: _Closure, outliers: frozenset[int]) -> Self:
        pose_count, move_count = len(poses.windows), len(closure.duration)
        segment = np.repeat(np.arange(pose_count + move_count), [3] * pose_count + [2] * move_count)
        is_kept = ~np.isin(segment, [*outliers])
        length = poses.windows[:, 1] - poses.windows[:, 0]
        move_cov = closure.force_jacobian @ poses.force_covariance @ closure.force_jacobian.T
        move_cov += poses.white_variance * block_diag(*closure.noise_covariance)
        rest_cov = np.diag(np.repeat(poses.white_variance / length, 3))
        known_cov = np.asarray(block_diag(rest_cov, move_cov))
        output = closure.residual + closure.design[:, :N_INTEGRATED] @ closure.parameters
        matrix = closure.parameters[3:].reshape(3, 3)
        rest_design = _build_rest_design(matrix, poses.force, closure.pose_rotations)
        duration = np.concatenate([np.full(3 * pose_count, np.inf), np.repeat(closure.duration, 2)])
        return cls(
            poses,
            closure,
            output=np.concatenate([poses.outputs.ravel(), output])[is_kept],
            design=np.concatenate([rest_design, closure.design])[is_kept],
            segment=segment[is_kept],
            known_covariance=known_cov[np.ix_(is_kept, is_kept)],
            duration=duration[is_kept],
        )

    @property
    def is_move(self) -> Bool[np.ndarray, "r"]:
        return self.segment >= len(self.poses.windows)

    def covariance(self, bias_variance: float, angle_variance: float) -> Float[np.ndarray, "r r"]:
        """Return the covariance of the outputs, (rad/s)²."""
        return self.known_covariance + np.diag(bias_variance + angle_variance / self.duration**2)

    def estimate(self, bias_variance: float, angle_variance: float) -> _Estimate:
        cholesky = np.linalg.cholesky(self.covariance(bias_variance, angle_variance))
        table = np.column_stack([self.design, self.output - self.design @ self.poses.prior_mean])
        # QR with a row for each prior, not normal equations: outputs may be almost noise-free.
        prior = np.column_stack([np.diag(1 / PRIOR_SD), np.zeros(len(PRIOR_SD))])
        whitened = np.concatenate([solve_triangular(cholesky, table, lower=True), prior])
        upper = np.linalg.qr(whitened, mode="r")
        factor, rss = upper[:-1, :-1], upper[-1, -1]
        inverse = solve_triangular(factor, np.eye(len(factor)))
        log_dets = np.sum(np.log(np.diag(cholesky))), np.sum(np.log(np.abs(np.diag(factor))))
        log_density = -0.5 * rss**2 - log_dets[0] - log_dets[1]
        mean = self.poses.prior_mean + inverse @ upper[:-1, -1]
        cov, log_density = inverse @ inverse.T, float(log_density)
        return _Estimate(mean, cov, bias_variance, angle_variance, log_density)

    def estimate_variances(self) -> _Estimate:
        """Estimate both variances, in turn, by posterior means; the standard deviations have half-normal priors."""
        rest_var, move_var = (
            np.diag(self.known_covariance)[rows] for rows in (~self.is_move, self.is_move)
        )
        angle_var = move_var * self.duration[self.is_move] ** 2
        known_var = float(np.median(rest_var)), float(np.median(angle_var))
        variances = list(known_var)
        for i in (0, 1, 0, 1):
            candidates = known_var[i] * SD_RATIOS**2
            trials = ((v, variances[1]) if i == 0 else (variances[0], v) for v in candidates)
            density = np.array([self.estimate(*trial).log_density for trial in trials])
            density += 0.5 * np.log(candidates) - 0.5 * candidates / PRIOR_SCALE**2
            variances[i] = float(candidates @ np.exp(density - logsumexp(density)))
        return self.estimate(*variances)

    def weighted_rss(self, fit: _Estimate, covariance: Float[np.ndarray, "n n"]) -> float:
        """Return the weighted rss, priors included, at this model's bias and matrix and `fit`'s other parameters."""
        values = np.concatenate([self.closure.parameters, fit.mean[N_INTEGRATED:]])
        residuals = self.output - self.design @ values
        squares = residuals @ np.linalg.solve(covariance, residuals)
        return float(squares + np.sum(((values - self.poses.prior_mean) / PRIOR_SD) ** 2))

    def find_outlier(self, fit: _Estimate, outliers: frozenset[int]) -> frozenset[int]:
        """Return `outliers` and the most significant other outlying pose or move, if there is one."""
        residuals, p_values = self.output - self.design @ fit.mean, dict[int, float]()
        covariance = self.covariance(fit.bias_variance, fit.angle_variance)
        covariance -= self.design @ fit.covariance @ self.design.T
        move_rows = int(np.sum(self.is_move))
        for k in np.unique(self.segment).tolist():
            rows = np.flatnonzero(self.segment == k)
            r, cov = residuals[rows], covariance[np.ix_(rows, rows)]
            is_pose = k < len(self.poses.windows)
            dof = max(1, len(residuals) - move_rows - 3 if is_pose else move_rows - N_INTEGRATED)
            p_values[k] = float(fdtrc(len(r), dof, r @ np.linalg.solve(cov, r) / len(r)))
        candidate = min(p_values, key=p_values.__getitem__)
        is_outlier = p_values[candidate] < OUTLIER_PROBABILITY / len(p_values)
        return outliers | {candidate} if is_outlier else outliers

    def build_columns(
        self, fit: _Estimate, force_names: tuple[str, ...], unit: float
    ) -> dict[str, np.ndarray]:
        """Return columns of readings: innovations of poses and moves in time order; `unit`: the output's, in rad/s."""
        factor = np.linalg.cholesky(self.covariance(fit.bias_variance, fit.angle_variance))
        innovation_sd, move_rows = np.diag(factor), int(np.sum(self.is_move))
        table = np.column_stack([self.output, self.design])
        # A unit lower triangular factor: each move is conditional on those before it.
        table = solve_triangular(factor / innovation_sd, table, lower=True, unit_diagonal=True)
        force = np.concatenate([self.poses.force, self.closure.force])[self.segment]
        pose_count = (len(self.segment) - move_rows) // 3
        kinds = [*ws.AXES] * pose_count + ["move", "move too"] * (move_rows // 2)
        powers = np.repeat([0.0, 1.0, 0.0, 2.0, 0.0], [3, 9, 9, 3, 3])
        names = (*ws.ACROSS, *ws.TURNED, *FORCE_COLUMNS, *SQUARED_RATE_COLUMNS, *EARTH_RATE_COLUMNS)
        columns = dict(zip(names, (table[:, 1:] / unit**powers).T, strict=True))
        columns |= {"output": table[:, 0] / unit, ws.UNCERTAINTY: innovation_sd / unit}
        columns |= {ws.AXIS: np.array(kinds)}
        return columns | {name: force[:, j] for j, name in enumerate(force_names)}


class _Closure(NamedTuple):
    """Closure errors of m moves, two readings each, as mean rates, and their Jacobians."""

    parameters: Float[np.ndarray, "12"]  # bias and matrix of the integration
    residual: Float[np.ndarray, "2m"]  # rad/s
    design: Float[np.ndarray, "2m 27"]  # Jacobian with respect to the parameters
    force_jacobian: Float[np.ndarray, "2m 3k"]  # with respect to the specific forces in the poses
    noise_covariance: Float[np.ndarray, "m 2 2"]  # due to white noise of 1 rad/s over a second
    duration: Float[np.ndarray, "m"]  # s
    force: Float[np.ndarray, "m 3"]  # mean specific force, g
    pose_rotations: Float[np.ndarray, "k 3 3"]  # from the body in each pose to that in the first


def _integrate_moves(
    samples: _Moves, force: Float[np.ndarray, "k 3"], parameters: Float[np.ndarray, "12"]
) -> _Closure:
    """Integrate the gyro outputs of moves with bias and matrix (`parameters`); return closure errors and Jacobians."""
    bias, matrix = parameters[:3], parameters[3:].reshape(3, 3)
    rate, rotations = _integrate_attitude(samples, matrix, bias)
    magnitude, m, rotations_to_start = np.linalg.norm(force, axis=1), len(rate), rotations[:, -1]
    pose_rotations = [np.eye(3)]
    for rotation in rotations_to_start:
        pose_rotations.append(pose_rotations[-1] @ rotation)
    up = force / magnitude[:, None]
    q = np.stack(build_tangents(up[1:]), axis=1)  # (m, 2, 3)
    start_q = np.einsum("mij,mkj->mki", rotations_to_start, q)  # q in the axes of the pose before
    residual = np.einsum("mkj,mj->mk", q, up[1:]) - np.einsum("mkj,mj->mk", start_q, up[:-1])
    normal, duration = np.cross(q, up[1:, None, :]), samples.duration[:, None, None]
    start_normal = np.einsum("mij,mkj->mki", rotations_to_start, normal)
    a = -np.einsum("mnji,mkj->mkni", rotations, start_normal) @ np.linalg.inv(matrix)
    a = a / duration[..., None]
    weighted_a = a * samples.weight[:, None, :, None]
    design = [
        weighted_a.sum(axis=2),
        np.einsum("mkna,mnj->mkaj", weighted_a, rate).reshape(m, 2, 9),
        np.einsum("mkna,mnj->mkaj", weighted_a, samples.force).reshape(m, 2, 9),
        np.einsum("mkna,mna->mka", weighted_a, rate**2),
        -np.einsum("mij,mkj->mki", np.array(pose_rotations[1:]), normal),
    ]
    slopes = np.zeros((m, 2, len(force), 3))
    move = np.arange(m)
    slopes[move, :, move + 1] = q / magnitude[1:, None, None] / duration
    slopes[move, :, move] = -start_q / magnitude[:-1, None, None] / duration
    return _Closure(
        parameters,
        (residual / duration[..., 0]).ravel(),
        np.concatenate(design, axis=2).reshape(2 * m, -1),
        slopes.reshape(2 * m, -1),
        np.einsum("mkna,mlna->mkl", weighted_a, a),
        samples.duration,
        np.einsum("mn,mnj->mj", samples.weight, samples.force) / samples.duration[:, None],
        np.array(pose_rotations),
    )


def _build_rest_design(
    matrix: Float[np.ndarray, "3 3"],
    force: Float[np.ndarray, "k 3"],
    pose_rotations: Float[np.ndarray, "k 3 3"],
) -> Float[np.ndarray, "3k 27"]:
    """Return the design matrix of the three outputs in each pose, where the only rate is the Earth's."""
    k, identity = len(force), np.eye(3)
    force_design = np.einsum("ab,kj->kabj", identity, force).reshape(k, 3, 9)
    earth_rate, zero = matrix @ pose_rotations.transpose(0, 2, 1), np.zeros((k, 3, 9))
    design = [np.broadcast_to(identity, (k, 3, 3)), zero, force_design, zero[..., :3], earth_rate]
    return np.concatenate(design, axis=2).reshape(3 * k, -1)
