"""Gyroscopes by moves between poses, in which accelerometers of the same unit say which way is up: no rate table.

Between two poses at rest the up direction u moves in the body's axes, u_B = Cᵀ·u_A with dC/dt = C·[ω×]. The outputs
y = M·ω + b + … are integrated with a matrix M₀ and a bias b₀; the closing error of u_B, on two axes q across it, is
linear in the errors of M₀ and b₀. With P(t) the rotation from the body at t to the body at the end, and T the duration:

    qᵀ(u_B − C₀ᵀ·u_A) = ∫ aᵀ(δM·ω + δb + Γ·f + K2·ω² + ω_E)·dt,     a(t) = −M₀⁻ᵀ·P(t)ᵀ·(q × u_B)

So a move gives two readings, each a mean of the outputs along a direction a/T that turns with the unit, and the three
outputs at rest before and after it three more. A rotation about the vertical changes no direction of up: the attitude
about it need not be known.

M₀ and b₀ are iterated, in damped steps, to the least-squares estimate, where the linear form is exact to the square of
the uncertainty. Each pose ends one move and begins another, and all of them share the errors of the accelerometers'
calibration. Two variances are estimated from the residuals by their marginal likelihood: of the bias from pose to pose,
and of the closing angle of a move (a unit that creeps in its pose, samples at other times than stated, aliases, a
nonlinear scale). Readings are the innovations of the moves in order, given those before, each with a known standard
uncertainty in excess of the smallest. A move or a pose that is an outlier is set aside, and named.

The Earth's rotation is three unknowns, along the axes that the body had in the first pose of a run.

Source: the method without its uncertainty is of D. Tedaldi, A. Pretto and E. Menegatti, ICRA 2014; rotation vectors of
rates between samples, coning among them: J. E. Bortz, IEEE Trans. AES 7 (1971) 61.
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
from bayescal._annexes.imu.scalar_readings import MOUNTING, tangents
from bayescal._annexes.imu.still_stretches import (
    LoggedRun,
    as_readings,
    averaged,
    in_common,
    logged_runs,
)
from bayescal._annexes.imu.vector_correction import VectorCorrection

# Beside `TURNED`, the specific force on j, the square of what acts on a, and the Earth's rotation.
PULLED = tuple(f"pulled_{a}{j}" for a in ws.AXES for j in ws.AXES)
SQUARED = tuple(f"squared_{a}" for a in ws.AXES)
AROUND = tuple(f"around_{k}" for k in "123")
MAX_ITERATIONS = 60  # integrations; four suffice for a matrix that is off by a tenth
MAX_HALVINGS = 10  # of a step that raises the residual sum of squares,
LARGER_RATIO = 1.01  # by more than this: slopes are exact to the first order
MAX_MATRIX_DEVIATION = 0.5  # of an entry from nominal: above it a wrong unit or axis
CONVERGENCE_SD = 0.01  # largest last step, in standard uncertainties
OUTLIER_PROBABILITY = 0.01  # that any of the moves and poses is set aside where all agree
MAX_SET_ASIDE_SHARE = 0.2  # of the moves
# Prior standard deviations of bias (rad/s), matrix, sensitivity to specific force (rad/s/g) and to the rate squared
# (s/rad) and the Earth's rotation (rad/s) in that estimate: they matter only where moves leave parameters unidentified.
PRIOR_SD = np.repeat(
    [1.0, 0.1, np.deg2rad(0.1), np.rad2deg(1e-5), np.deg2rad(15.04) / 3600], [3, 9, 9, 3, 3]
)
N_RATE = 12  # of these parameters those of the integration: bias and matrix
# Prior scale of the bias from pose to pose, rad/s, and of the closing angle of a move, rad: consumer parts, by hand.
PLAUSIBLE_SPREAD = np.deg2rad(0.1)
SPREAD_RATIOS = np.geomspace(0.1, 1000.0, 17)  # times the known deviation
SAMPLES_PER_BLOCK = 20_000  # whose forces are corrected at once
MOVES_ADVICE = (
    "Check the unit of the gyroscopes, that their axes are those of the accelerometers, that no rate is beyond their "
    "range, and that no samples are lost"
)


def moves(
    log: bc.Measurements,
    instrument: bc.Instrument,
    forces: bc.Measurements,
    correction: VectorCorrection,
    *,
    shortest: float | None = None,
) -> bc.Measurements:
    """Convert a log of gyroscopes to readings: three outputs at rest for each pose, two for each move between poses.

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
        InputError: no column `time`, no still stretches or fewer than two poses in common, outputs that do not lead
            from one pose to the next, an integration that does not settle, or too many moves that disagree.
        ModelError: an instrument whose outputs are no rates.
    """
    if instrument.vector is None or not ws.same_dimension(instrument.unit, "rad/s"):
        raise bc.ModelError(
            f"instrument {instrument.name!r}: moves are of three gyroscopes, and its output is in [{instrument.unit}]"
        )
    unit = float(np.asarray(ws.convert(np.ones(1), instrument.unit, "rad/s"))[0])
    f_runs = logged_runs(forces, correction.outputs, shortest)
    rates = logged_runs(log, instrument.vector.outputs, shortest, unit)
    if lacking := sorted(rates.keys() - f_runs.keys()):
        raise bc.InputError(
            f"{forces.file}: run {lacking[0]!r} of {log.file} is not in it: log gyroscopes and accelerometers together"
        )
    parts = list[dict[str, np.ndarray]]()
    poses, outliers = 0, list[str]()
    for run, gyro in rates.items():
        windows = in_common(gyro.ends(), f_runs[run].ends())
        if len(windows) < 2:
            raise bc.InputError(
                f"{log.file}, run {run!r}: {len(windows)} poses in which gyroscopes and accelerometers are at rest "
                "together, and a move needs two: hold the unit still for some seconds before and after each move"
            )
        poses += len(windows)
        try:
            line, fit, disagreeing = _fit_run(gyro, f_runs[run], windows, correction, len(rates))
        except bc.InputError as error:
            raise bc.InputError(f"{log.file}, run {run!r}: {error}") from None
        outliers += disagreeing
        columns = line.columns(fit, instrument.vector.beside, unit)
        others = [n for n in log.columns if n not in (*columns, *ws.DIRECTION, MOUNTING)]
        spans = line.session.spans[line.owner]
        parts.append(columns | averaged(gyro.samples, others, (gyro.inside(*s) for s in spans)))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    # The noise law has the variance of the surest reading, the column the excess of the others: a noise in addition to
    # known ones that suffice would have its mode at zero.
    squares = columns[ws.UNCERTAINTY] ** 2
    surest = float(np.sqrt(squares.min()))
    columns[ws.UNCERTAINTY] = np.sqrt(squares - squares.min())
    readings = as_readings(columns, instrument, log)
    summary = (
        f"{len(readings)} readings of {poses} poses and the moves between them, found in {log.file}; their "
        f"smallest standard uncertainty, by scatter, is {surest:.2g} {instrument.unit}: noise.white refers to it"
    )
    notes = [f"{log.file}: set aside, as it disagrees with all others: {o}" for o in outliers]
    return replace(readings, sources=log.sources, flags=(summary, *notes))  # of the log


class _Moves(NamedTuple):
    """Samples of m moves, padded with the last sample to one length; trapezoidal weights, 0 in the padding."""

    rate: Float[np.ndarray, "m n 3"]  # as measured, rad/s
    slope: Float[np.ndarray, "m n 3"]  # of it in time, rad/s²
    force: Float[np.ndarray, "m n 3"]  # corrected, g
    step: Float[np.ndarray, "m n-1"]  # s
    weight: Float[np.ndarray, "m n"]  # s

    @property
    def duration(self) -> Float[np.ndarray, "m"]:
        return self.step.sum(axis=1)


def _correct_forces(f_run: LoggedRun, correction: VectorCorrection) -> Float[np.ndarray, "n 3"]:
    """Correct the specific force of every sample, in blocks: the covariances of all would fill the memory."""
    count, logged = len(f_run.time), f_run.temperature
    warm = np.broadcast_to(correction.assumed if logged is None else logged, count)
    blocks = np.array_split(np.arange(count), 1 + count // SAMPLES_PER_BLOCK)
    parts = (correction(f_run.outputs[rows], warm[rows], noise=0.0) for rows in blocks)
    return np.concatenate([corrected.vector for corrected in parts])


def _paths(
    log: LoggedRun,
    windows: Float[np.ndarray, "k 2"],
    f_run: LoggedRun,
    force: Float[np.ndarray, "s 3"],
) -> _Moves:
    """Return the samples from the end of each pose to the begin of the next."""
    slices = [log.inside(a, b) for a, b in zip(windows[:-1, 1], windows[1:, 0], strict=True)]
    longest = max(s.stop - s.start for s in slices)
    at = np.array([np.minimum(np.arange(s.start, s.start + longest), s.stop - 1) for s in slices])
    step = np.diff(log.time[at], axis=1)
    weight = 0.5 * (np.pad(step, ((0, 0), (1, 0))) + np.pad(step, ((0, 0), (0, 1))))
    forces = np.stack([np.interp(log.time[at], f_run.time, force[:, j]) for j in range(3)], axis=2)
    slope = np.gradient(log.outputs, log.time, axis=0)
    return _Moves(log.outputs[at], slope[at], forces, step, weight)


def _attitude(path: _Moves, matrix: np.ndarray, bias: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rates (m, n, 3), and rotations from the body at each sample to the body at the begin (m, n, 3, 3)."""
    inverse = np.linalg.inv(matrix).T
    rate, h = (path.rate - bias) @ inverse, path.step[..., None]
    # To the fourth order in the step: the error of the trapezoidal rule, and coning.
    vectors = 0.5 * (rate[:, :-1] + rate[:, 1:]) - np.diff(path.slope @ inverse, axis=1) * h / 12
    vectors = vectors * h + np.cross(rate[:, :-1], rate[:, 1:]) * h**2 / 12
    steps = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
    rotation = np.empty((*rate.shape, 3))
    rotation[:, 0] = np.eye(3)
    for k in range(steps.shape[1]):
        rotation[:, k + 1] = rotation[:, k] @ steps[:, k]
    return rate, rotation


@ws.on_one_thread
def _fit_run(
    log: LoggedRun,
    f_run: LoggedRun,
    windows: Float[np.ndarray, "k 2"],
    correction: VectorCorrection,
    shared: int,
) -> tuple[_LinearModel, _Estimate, list[str]]:
    """Fit bias and matrix to the moves of one run; return model and estimate, and names of what was set aside.

    Args:
        log: of the gyroscopes.
        f_run: of the accelerometers.
        windows: of the poses, s.
        correction: of the accelerometers.
        shared: number of runs that share its errors, which do not average out.

    Raises:
        InputError: as of `moves`.
    """
    force, slopes, pose_cov = correction.in_poses(f_run, windows)
    forces = shared * slopes @ correction.covariance @ slopes.T + pose_cov
    at_rest, white = log.means(windows), log.at_rest.of_second**2
    nominal = np.concatenate([at_rest.mean(axis=0), np.eye(3).ravel(), np.zeros(15)])
    session = _Session(at_rest, windows, force, forces, white, nominal)
    path = _paths(log, windows, f_run, _correct_forces(f_run, correction))
    max_set_aside = max(1, int(MAX_SET_ASIDE_SHARE * len(path.rate)))
    origin, aside = session.nominal[:N_RATE], frozenset[int]()
    at = _integrate_moves(path, force, origin)
    for _ in range(MAX_ITERATIONS):
        line = _LinearModel.of(session, at, origin, aside)
        fit = line.estimate_variances()
        step = fit.mean[:N_RATE] - origin
        size = float(np.max(np.abs(step) / np.sqrt(np.diag(fit.covariance)[:N_RATE])))
        rss, accepted = line.weighted_rss(at, origin, fit), None
        for _ in range(MAX_HALVINGS if size >= CONVERGENCE_SD else 0):
            candidate = _integrate_moves(path, force, origin + step)
            if line.weighted_rss(candidate, origin + step, fit) < LARGER_RATIO * rss:
                accepted = candidate
                break
            step = 0.5 * step
        if accepted is not None:
            origin, at = origin + step, accepted
            continue
        # Converged; or the closing error of one move is too large for a linear form.
        extended = line.find_outlier(fit, aside)
        if extended == aside:
            break
        aside = extended
        if sum(k >= len(windows) for k in aside) > max_set_aside:
            raise bc.InputError(
                f"more than {max_set_aside} of {len(path.rate)} moves disagree with each other by more than they "
                f"scatter. {MOVES_ADVICE}"
            )
    deviation = np.max(np.abs(origin - session.nominal[:N_RATE])[3:])
    if size >= CONVERGENCE_SD or not deviation < MAX_MATRIX_DEVIATION:
        raise bc.InputError(
            "the outputs integrated over the moves do not lead from pose to pose, or not by one matrix: turn the unit "
            f"less between two poses, about all three axes, and hold it still for longer. {MOVES_ADVICE}"
        )
    ends = {k: " to ".join(ws.number(end, 5) for end in session.spans[k]) for k in sorted(aside)}
    kinds = {k: "pose" if k < len(windows) else "move" for k in ends}
    return line, fit, [f"the {kinds[k]} from {ends[k]} s" for k in ends]


class _Session(NamedTuple):
    """Data of a run's poses."""

    at_rest: Float[np.ndarray, "k 3"]  # outputs, rad/s
    windows: Float[np.ndarray, "k 2"]  # s
    force: Float[np.ndarray, "k 3"]  # g
    of_forces: Float[np.ndarray, "3k 3k"]  # covariance of these, g²
    white: float  # variance of a mean output over a second, (rad/s)²
    # Prior mean of the parameters: the bias as at rest, the matrix one.
    nominal: Float[np.ndarray, "27"]

    @property
    def spans(self) -> Float[np.ndarray, "km 2"]:
        """Return begin and end of each pose, then of each move between, s."""
        between = np.stack([self.windows[:-1, 1], self.windows[1:, 0]], axis=1)
        return np.concatenate([self.windows, between])


class _Estimate(NamedTuple):
    """An estimate of the parameters, given the variances of bias between poses (rad/s)² and of closing angles, rad²."""

    mean: Float[np.ndarray, "27"]
    covariance: Float[np.ndarray, "27 27"]
    wander: float
    closing: float
    log_density: float  # of the outputs


class _LinearModel(NamedTuple):
    """Outputs at rest and over moves of a run, rad/s, linear in the parameters; without those set aside."""

    session: _Session
    closure: _Closure
    output: Float[np.ndarray, "r"]
    design: Float[np.ndarray, "r 27"]
    # of each output the pose, which come first, or the move, by number after these
    owner: Int[np.ndarray, "r"]
    known_covariance: Float[
        np.ndarray, "r r"
    ]  # covariance without that of bias and of closing angles
    duration: Float[np.ndarray, "r"]  # of the moves, s; infinite at rest

    @classmethod
    def of(
        cls, session: _Session, closure: _Closure, origin: np.ndarray, aside: frozenset[int]
    ) -> Self:
        poses, count = len(session.windows), len(closure.duration)
        owner = np.concatenate([np.repeat(np.arange(poses), 3), poses + np.repeat(range(count), 2)])
        keep = ~np.isin(owner, [*aside])
        length = session.windows[:, 1] - session.windows[:, 0]
        moving = closure.of_forces @ session.of_forces @ closure.of_forces.T
        moving += session.white * block_diag(*closure.of_noise)
        at_rest_cov = np.diag(np.repeat(session.white / length, 3))
        known_cov = np.asarray(block_diag(at_rest_cov, moving))
        output = closure.residual + closure.design[:, :N_RATE] @ origin
        at_rest = _rest_design(origin[3:].reshape(3, 3), session.force, closure.world)
        duration = np.concatenate([np.full(3 * poses, np.inf), np.repeat(closure.duration, 2)])
        return cls(
            session,
            closure,
            output=np.concatenate([session.at_rest.ravel(), output])[keep],
            design=np.concatenate([at_rest, closure.design])[keep],
            owner=owner[keep],
            known_covariance=known_cov[np.ix_(keep, keep)],
            duration=duration[keep],
        )

    @property
    def is_move(self) -> Bool[np.ndarray, "r"]:
        return self.owner >= len(self.session.windows)

    def covariance(self, wander: float, closing: float) -> Float[np.ndarray, "r r"]:
        """Return the covariance of the outputs, (rad/s)²."""
        return self.known_covariance + np.diag(wander + closing / self.duration**2)

    def estimate(self, wander: float, closing: float) -> _Estimate:
        root = np.linalg.cholesky(self.covariance(wander, closing))
        table = np.column_stack([self.design, self.output - self.design @ self.session.nominal])
        # With a row for each prior, and no normal equations: outputs may be almost without noise.
        prior = np.column_stack([np.diag(1 / PRIOR_SD), np.zeros(len(PRIOR_SD))])
        white = np.concatenate([solve_triangular(root, table, lower=True), prior])
        upper = np.linalg.qr(white, mode="r")
        factor, rss = upper[:-1, :-1], upper[-1, -1]
        inverse = solve_triangular(factor, np.eye(len(factor)))
        log_density = -0.5 * rss**2 - np.sum(np.log(np.diag(root)))
        log_density -= np.sum(np.log(np.abs(np.diag(factor))))
        mean = self.session.nominal + inverse @ upper[:-1, -1]
        return _Estimate(mean, inverse @ inverse.T, wander, closing, float(log_density))

    def estimate_variances(self) -> _Estimate:
        """Estimate with both variances at their posterior means in turn; half-normal priors of the deviations."""
        rest_var, move_var = (
            np.diag(self.known_covariance)[rows] for rows in (~self.is_move, self.is_move)
        )
        angle_var = move_var * self.duration[self.is_move] ** 2
        known_var = float(np.median(rest_var)), float(np.median(angle_var))
        best = list(known_var)
        for i in (0, 1, 0, 1):
            candidates = known_var[i] * SPREAD_RATIOS**2
            fits = [self.estimate(*((v, best[1]) if i == 0 else (best[0], v))) for v in candidates]
            density = np.array([fit.log_density for fit in fits])
            density += 0.5 * np.log(candidates) - 0.5 * candidates / PLAUSIBLE_SPREAD**2
            best[i] = float(candidates @ np.exp(density - logsumexp(density)))
        return self.estimate(best[0], best[1])

    def weighted_rss(self, at: _Closure, phi: Float[np.ndarray, "12"], fit: _Estimate) -> float:
        """Return the weighted residual sum of squares of an integration with parameters phi, others as estimated."""
        values = np.concatenate([phi, fit.mean[N_RATE:]])
        residuals = self.output - self.design @ values
        moves = len(self.session.windows) + np.repeat(np.arange(len(at.duration)), 2)
        moving = at.residual - at.design[:, N_RATE:] @ fit.mean[N_RATE:]
        residuals[self.is_move] = moving[np.isin(moves, self.owner)]
        squares = residuals @ np.linalg.solve(self.covariance(fit.wander, fit.closing), residuals)
        return float(squares + np.sum(((values - self.session.nominal) / PRIOR_SD) ** 2))

    def find_outlier(self, fit: _Estimate, aside: frozenset[int]) -> frozenset[int]:
        """Add the pose or the move that is the most significant outlier, if there is one."""
        residuals, chances = self.output - self.design @ fit.mean, dict[int, float]()
        covariance = self.covariance(fit.wander, fit.closing)
        covariance -= self.design @ fit.covariance @ self.design.T
        moves = int(np.sum(self.is_move))
        for k in np.unique(self.owner).tolist():
            at = np.flatnonzero(self.owner == k)
            square = residuals[at] @ np.linalg.solve(covariance[np.ix_(at, at)], residuals[at])
            is_pose = k < len(self.session.windows)
            free = max(1, len(residuals) - moves - 3 if is_pose else moves - N_RATE)
            chances[k] = float(fdtrc(len(at), free, square / len(at)))
        worst = min(chances, key=chances.__getitem__)
        is_outlier = chances[worst] < OUTLIER_PROBABILITY / len(chances)
        return aside | {worst} if is_outlier else aside

    def columns(
        self, fit: _Estimate, forces: tuple[str, ...], unit: float
    ) -> dict[str, np.ndarray]:
        """Return the innovations of poses and moves in order, as columns of readings, rates in the output's unit."""
        factor = np.linalg.cholesky(self.covariance(fit.wander, fit.closing))
        innovation_sd, moves = np.diag(factor), int(np.sum(self.is_move))
        table = np.column_stack([self.output, self.design])
        # Lower with a diagonal of ones: each move given those before it.
        table = solve_triangular(factor / innovation_sd, table, lower=True, unit_diagonal=True)
        force = np.concatenate([self.session.force, self.closure.force])[self.owner]
        poses = (len(self.owner) - moves) // 3
        kinds = [*ws.AXES] * poses + ["move", "move too"] * (moves // 2)
        powers = np.repeat([0.0, 1.0, 0.0, 2.0, 0.0], [3, 9, 9, 3, 3])
        names = (*ws.ACROSS, *ws.TURNED, *PULLED, *SQUARED, *AROUND)
        columns = dict(zip(names, (table[:, 1:] / unit**powers).T, strict=True))
        columns |= {"output": table[:, 0] / unit, ws.UNCERTAINTY: innovation_sd / unit}
        columns |= {ws.OF: np.array(kinds)}
        return columns | {name: force[:, j] for j, name in enumerate(forces)}


class _Closure(NamedTuple):
    """Closing errors of moves, two readings each, as mean rates; their sensitivities."""

    residual: Float[np.ndarray, "2m"]  # rad/s
    design: Float[np.ndarray, "2m 27"]
    of_forces: Float[np.ndarray, "2m 3k"]  # slopes with respect to the specific forces in the poses
    of_noise: Float[np.ndarray, "m 2 2"]  # covariance by white noise of one rad/s over a second
    duration: Float[np.ndarray, "m"]  # s
    force: Float[np.ndarray, "m 3"]  # mean, g
    world: Float[np.ndarray, "k 3 3"]  # from the body in each pose to the body in the first


def _integrate_moves(
    path: _Moves, force: Float[np.ndarray, "k 3"], parameters: Float[np.ndarray, "12"]
) -> _Closure:
    """Integrate the gyro outputs of moves with a bias and a scale matrix; return closure errors and their Jacobian."""
    bias, matrix = parameters[:3], parameters[3:].reshape(3, 3)
    rate, turns = _attitude(path, matrix, bias)
    size, m, to_begin = np.linalg.norm(force, axis=1), len(rate), turns[:, -1]
    world = [np.eye(3)]
    for rotation in to_begin:
        world.append(world[-1] @ rotation)
    up = force / size[:, None]
    q = np.stack(tangents(up[1:]), axis=1)  # (m, 2, 3)
    before = np.einsum("mij,mkj->mki", to_begin, q)  # q in the axes of the pose before
    residual = np.einsum("mkj,mj->mk", q, up[1:]) - np.einsum("mkj,mj->mk", before, up[:-1])
    normal = np.cross(q, up[1:, None, :])
    at_begin = np.einsum("mij,mkj->mki", to_begin, normal)
    duration = path.duration[:, None, None]
    a = -np.einsum("mnji,mkj->mkni", turns, at_begin) @ np.linalg.inv(matrix) / duration[..., None]
    summed = a * path.weight[:, None, :, None]
    design = [
        summed.sum(axis=2),
        np.einsum("mkna,mnj->mkaj", summed, rate).reshape(m, 2, 9),
        np.einsum("mkna,mnj->mkaj", summed, path.force).reshape(m, 2, 9),
        np.einsum("mkna,mna->mka", summed, rate**2),
        -np.einsum("mij,mkj->mki", np.array(world[1:]), normal),
    ]
    slopes = np.zeros((m, 2, len(force), 3))
    move = np.arange(m)
    slopes[move, :, move + 1] = q / size[1:, None, None] / duration
    slopes[move, :, move] = -before / size[:-1, None, None] / duration
    return _Closure(
        (residual / duration[..., 0]).ravel(),
        np.concatenate(design, axis=2).reshape(2 * m, -1),
        slopes.reshape(2 * m, -1),
        np.einsum("mkna,mlna->mkl", summed, a),
        path.duration,
        np.einsum("mn,mnj->mj", path.weight, path.force) / path.duration[:, None],
        np.array(world),
    )


def _rest_design(
    matrix: Float[np.ndarray, "3 3"],
    force: Float[np.ndarray, "k 3"],
    world: Float[np.ndarray, "k 3 3"],
) -> Float[np.ndarray, "3k 27"]:
    """Return the design rows of the three outputs in each pose: only the Earth turns the body."""
    k, identity = len(force), np.eye(3)
    pulled = np.einsum("ab,kj->kabj", identity, force).reshape(k, 3, 9)
    around = matrix @ world.transpose(0, 2, 1)
    none = np.zeros((k, 3, 9))
    design = [np.broadcast_to(identity, (k, 3, 3)), none, pulled, none[..., :3], around]
    return np.concatenate(design, axis=2).reshape(3 * k, -1)
