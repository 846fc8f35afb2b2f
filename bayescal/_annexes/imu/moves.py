"""Gyroscopes by moves between poses, in which accelerometers of the same unit say which way is up: no rate table.

Between two poses at rest the up direction u moves in the body's axes, u_B = Cᵀ·u_A with dC/dt = C·[ω×]. The outputs
y = M·ω + b + … are integrated with a matrix M₀ and a bias b₀, and what is left over of u_B, on two axes q across it, is
linear in what M and b are off by. With P(t) the rotation from the body at t to the body at the end, and T the duration:

    qᵀ(u_B − C₀ᵀ·u_A) = ∫ aᵀ(δM·ω + δb + Γ·f + K2·ω² + ω_E)·dt,     a(t) = −M₀⁻ᵀ·P(t)ᵀ·(q × u_B)

So a move gives two readings, each a mean of the outputs along a direction a/T that turns with the unit, and the three
outputs at rest before and after it three more. A rotation about the vertical changes no direction of up: the attitude
about it need not be known.

M₀ and b₀ are iterated, in damped steps, to the least-squares estimate, where the linear form is exact to the square of
the uncertainty. Each pose ends one move and begins another, and all of them share the errors of the accelerometers'
calibration. What is not known beforehand is estimated with the rest, from what is left over, by its marginal
likelihood: how far the bias wanders from pose to pose, and by which angle a move does not close (a unit that creeps in
its pose, samples at other times than stated, aliases, a scale that bends). Readings are the innovations of the moves
one after the other: what each says beside those before it, with a known standard uncertainty beside that of the
surest. A move or a pose that disagrees with all others is set aside, and named.

The Earth's rotation is three unknowns, along the axes that the body had in the first pose of a run.

Source: the method without its uncertainty is of D. Tedaldi, A. Pretto and E. Menegatti, ICRA 2014; rotation vectors of
rates between samples, coning among them: J. E. Bortz, IEEE Trans. AES 7 (1971) 61.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
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
    per_sample,
)
from bayescal._annexes.imu.vector_correction import VectorCorrection

# Beside `TURNED`, the specific force on j, the square of what acts on a, and the Earth's rotation.
PULLED = tuple(f"pulled_{a}{j}" for a in ws.AXES for j in ws.AXES)
SQUARED = tuple(f"squared_{a}" for a in ws.AXES)
AROUND = tuple(f"around_{k}" for k in "123")
SWEEPS = 60  # of integrating anew; four suffice for a matrix that is off by a tenth
HALVINGS = 10  # of a step that leaves more over than was,
LARGER_RATIO = 1.01  # times as much: slopes are exact to the first order in the angles left over
FARTHEST = 0.5  # of an entry of the matrix from nominal: a wrong unit or axis, no gyroscope
SETTLED = 0.01  # of a standard uncertainty, by which a further sweep may move an estimate
DISAGREES = 0.01  # probability that of moves and poses that agree any is set aside
MOST_LEFT_OUT = 0.2  # of the moves that may be
# Prior standard deviations of bias (rad/s), matrix, sensitivity to specific force (rad/s/g) and to the rate squared
# (s/rad) and the Earth's rotation (rad/s) while that estimate is sought: they decide nothing but what moves leave open.
PRIOR = np.repeat(
    [1.0, 0.1, np.deg2rad(0.1), np.rad2deg(1e-5), np.deg2rad(15.04) / 3600], [3, 9, 9, 3, 3]
)
OWN = 12  # of these what the outputs are integrated with: bias and matrix
# Of a bias from pose to pose, rad/s, and of the angle that a move leaves over, rad: consumer parts, by hand.
PLAUSIBLE = np.deg2rad(0.1)
SPREADS = np.geomspace(0.1, 1000.0, 17)  # times what is known, at which these are weighed
AT_ONCE = 20_000  # samples whose forces are corrected


class _Rows(NamedTuple):
    """Readings of one run, in rad/s and g: outputs, their levers and standard uncertainties."""

    output: Float[np.ndarray, "r"]
    levers: Float[np.ndarray, "r 27"]  # across, turned, pulled, squared, around
    uncertainty: Float[np.ndarray, "r"]
    windows: Float[np.ndarray, "r 2"]  # s
    force: Float[np.ndarray, "r 3"]  # g, its mean
    kinds: tuple[str, ...]


def moves(
    log: bc.Measurements,
    instrument: bc.Instrument,
    forces: bc.Measurements,
    correction: VectorCorrection,
    *,
    shortest: float | None = None,
) -> bc.Measurements:
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
        InputError: no column `time`, no still stretches or fewer than two poses in common, outputs that do not lead
            from one pose to the next, an integration that does not settle, or too many moves that disagree.
        ModelError: an instrument whose outputs are no rates.
    """
    if instrument.vector is None or not ws.same_dimension(instrument.unit, "rad/s"):
        raise bc.ModelError(
            f"instrument {instrument.name!r}: moves are of three gyroscopes, and its output is in [{instrument.unit}]"
        )
    unit = float(np.asarray(ws.convert(np.ones(1), instrument.unit, "rad/s"))[0])
    log, forces = per_sample(log), per_sample(forces)
    pulls = logged_runs(forces, correction.outputs, shortest)
    rates = logged_runs(log, instrument.vector.outputs, shortest)
    if lacking := sorted(rates.keys() - pulls.keys()):
        raise bc.InputError(
            f"{forces.file}: run {lacking[0]!r} of {log.file} is not in it: log gyroscopes and accelerometers together"
        )
    made: dict[str, list[np.ndarray]] = {}
    poses, odd = 0, list[str]()
    for run, own in rates.items():
        own = own._replace(
            outputs=unit * own.outputs,
            still=own.still._replace(of_second=unit * own.still.of_second),
        )
        windows = in_common(own.ends(), pulls[run].ends())
        if len(windows) < 2:
            raise bc.InputError(
                f"{log.file}, run {run!r}: {len(windows)} poses in which gyroscopes and accelerometers are at rest "
                "together, and a move needs two: hold the unit still for some seconds before and after each move"
            )
        poses += len(windows)
        try:
            rows, disagreeing = _readings(own, pulls[run], windows, correction, len(rates))
        except bc.InputError as error:
            raise bc.InputError(f"{log.file}, run {run!r}: {error}") from None
        odd += disagreeing
        labels, codes = log.groups("run")
        samples = log.select(codes == labels.index(run))
        for name, values in _columns(rows, samples, own, instrument.vector.beside, unit).items():
            made.setdefault(name, []).append(values)
    columns = {name: np.concatenate(parts) for name, parts in made.items()}
    # As of means of unequal numbers: the noise law's own is that of the surest reading, others have more beside it. A
    # noise beside known ones that suffice would have its mode at zero.
    squares = columns[ws.UNCERTAINTY] ** 2
    surest = float(np.sqrt(squares.min()))
    columns[ws.UNCERTAINTY] = np.sqrt(squares - squares.min())
    found = as_readings(columns, instrument, log)
    said = (
        f"{len(found)} readings of {poses} poses and the moves between them, found in {log.file}; by their scatter the "
        f"surest is uncertain by {surest:.2g} {instrument.unit}, which noise.white is of"
    )
    aside = [f"{log.file}: set aside, as it disagrees with all others: {one}" for one in odd]
    return replace(found, sources=log.sources, flags=(said, *aside))  # of the log


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


@ws.on_one_thread
def _readings(
    log: LoggedRun,
    pull: LoggedRun,
    windows: Float[np.ndarray, "k 2"],
    correction: VectorCorrection,
    shared: int,
) -> tuple[_Rows, list[str]]:
    """Of one run, and what was set aside of it, in words.

    Args:
        log: of the gyroscopes.
        pull: of the accelerometers.
        windows: of the poses, s.
        correction: of the accelerometers.
        shared: by how many runs, in which its errors are the same and do not average out.

    Raises:
        InputError: as of `moves`.
    """
    felt, slopes, own = correction.in_poses(pull, windows)
    forces = shared * slopes @ correction.covariance @ slopes.T + own
    at_rest, white = log.means(windows), log.still.of_second**2
    nominal = np.concatenate([at_rest.mean(axis=0), np.eye(3).ravel(), np.zeros(15)])
    session = _Session(at_rest, windows, felt, forces, white, nominal)
    moved = _between(log, windows, pull, _forces(pull, correction))
    most = max(1, int(MOST_LEFT_OUT * len(moved.rate)))
    here, aside = session.nominal[:OWN], _Aside((), ())
    at = _closure(moved, felt, here)
    for _ in range(SWEEPS):
        line = _Line.of(session, at, here, aside)
        found = line.spread()
        change = found.mean[:OWN] - here
        size = float(np.max(np.abs(change) / found.sd[:OWN]))
        before, there = line.left_over(at, here, found), None
        for _ in range(HALVINGS if size >= SETTLED else 0):
            tried = _closure(moved, felt, here + change)
            if line.left_over(tried, here + change, found) < LARGER_RATIO * before:
                there = tried
                break
            change = 0.5 * change
        if there is not None:
            here, at = here + change, there
            continue
        # Settled; or what one move leaves over is too large for a linear form.
        further = line.odd(found, aside)
        if further == aside:
            break
        aside = further
        if len(aside.moves) > most:
            raise bc.InputError(
                f"more than {most} of {len(moved.rate)} moves disagree with each other by more than they scatter. Were "
                "samples lost, is a rate beyond the gyroscopes' range, or did accelerometers and gyroscopes not turn "
                "together?"
            )
    if not np.max(np.abs(here - session.nominal[:OWN])[3:]) < FARTHEST:
        raise bc.InputError(
            "the outputs integrated over a move do not lead from one pose to the next. Check the unit of the "
            "gyroscopes, that their axes are those of the accelerometers, and that no rate is beyond their range"
        )
    if size >= SETTLED:
        raise bc.InputError(
            f"the integration over the moves did not settle: a further sweep would move an estimate by {size:.2g} "
            "standard uncertainties. Turn the unit less between two poses, about all three axes, and hold it still for "
            "longer; see that no rate is beyond the gyroscopes' range"
        )
    return line.rows(found), line.words(found, aside)


class _Session(NamedTuple):
    """What is known of a run's poses."""

    at_rest: Float[np.ndarray, "k 3"]  # outputs, rad/s
    windows: Float[np.ndarray, "k 2"]  # s
    felt: Float[np.ndarray, "k 3"]  # g
    of_forces: Float[np.ndarray, "3k 3k"]  # covariance of these, g²
    white: float  # variance of a mean output over a second, (rad/s)²
    # What has levers, where nothing is known: the bias as at rest, the matrix one.
    nominal: Float[np.ndarray, "27"]


class _Aside(NamedTuple):
    """Poses whose outputs at rest, and moves that disagree with the others, by number."""

    poses: tuple[int, ...]
    moves: tuple[int, ...]


class _Found(NamedTuple):
    """An estimate of what has levers, given how far the bias wanders (rad/s)² and how far moves do not close, rad²."""

    mean: Float[np.ndarray, "27"]
    covariance: Float[np.ndarray, "27 27"]
    wander: float
    closing: float
    log_density: float  # of the outputs

    @property
    def sd(self) -> Float[np.ndarray, "27"]:
        return np.sqrt(np.diag(self.covariance))


class _Line(NamedTuple):
    """Outputs at rest and over moves of a run, rad/s, linear in what has levers; without those set aside."""

    session: _Session
    closure: _Closure
    here: Float[np.ndarray, "12"]
    output: Float[np.ndarray, "r"]
    levers: Float[np.ndarray, "r 27"]
    pose: Int[np.ndarray, "p"]  # of each output at rest, which come first
    move: Int[np.ndarray, "q"]  # of each over a move
    at_rest: Float[np.ndarray, "p"]  # known variance
    moving: Float[np.ndarray, "q q"]  # known covariance
    duration: Float[np.ndarray, "q"]  # s

    @classmethod
    def of(cls, session: _Session, closure: _Closure, here: np.ndarray, aside: _Aside) -> _Line:
        poses, count = len(session.windows), len(closure.duration)
        pose, move = np.repeat(np.arange(poses), 3), np.repeat(np.arange(count), 2)
        rest, over = ~np.isin(pose, aside.poses), ~np.isin(move, aside.moves)
        covariance = closure.of_forces @ session.of_forces @ closure.of_forces.T
        covariance += session.white * block_diag(*closure.of_noise)
        output = closure.left + closure.levers[:, :OWN] @ here
        at_rest = _at_rest(here[3:].reshape(3, 3), session.felt, closure.world)
        length = session.windows[:, 1] - session.windows[:, 0]
        return cls(
            session,
            closure,
            here,
            output=np.concatenate([session.at_rest.ravel()[rest], output[over]]),
            levers=np.concatenate([at_rest[rest], closure.levers[over]]),
            pose=pose[rest],
            move=move[over],
            at_rest=(session.white / length)[pose[rest]],
            moving=covariance[np.ix_(over, over)],
            duration=closure.duration[move[over]],
        )

    def variances(self, wander: float, closing: float) -> tuple[np.ndarray, np.ndarray]:
        """Variances at rest (p,), covariance over moves (q, q)."""
        return self.at_rest + wander, self.moving + np.diag(wander + closing / self.duration**2)

    def estimate(self, wander: float, closing: float) -> _Found:
        rest, moving = self.variances(wander, closing)
        root, count = np.linalg.cholesky(moving), len(rest)
        table = np.column_stack([self.levers, self.output - self.levers @ self.session.nominal])
        still, over = table[:count] / np.sqrt(rest)[:, None], table[count:]
        # With a row for each prior, and no normal equations: outputs may be almost without noise.
        prior = np.column_stack([np.diag(1 / PRIOR), np.zeros(len(PRIOR))])
        white = np.concatenate([still, solve_triangular(root, over, lower=True), prior])
        upper = np.linalg.qr(white, mode="r")
        own, left = upper[:-1, :-1], upper[-1, -1]
        inverse = solve_triangular(own, np.eye(len(own)))
        log_density = -0.5 * left**2 - 0.5 * np.sum(np.log(rest)) - np.sum(np.log(np.diag(root)))
        log_density -= np.sum(np.log(np.abs(np.diag(own))))
        mean = self.session.nominal + inverse @ upper[:-1, -1]
        return _Found(mean, inverse @ inverse.T, wander, closing, float(log_density))

    def spread(self) -> _Found:
        """The estimate with both variances at their means: half-normal in the deviations, one after the other."""
        known = np.median(self.at_rest), np.median(np.diag(self.moving) * self.duration**2)
        found = list(map(float, known))
        for i in (0, 1, 0, 1):
            tried = known[i] * SPREADS**2
            each = [self.estimate(*((v, found[1]) if i == 0 else (found[0], v))) for v in tried]
            density = np.array([one.log_density for one in each])
            density += 0.5 * np.log(tried) - 0.5 * tried / PLAUSIBLE**2
            found[i] = float(tried @ np.exp(density - logsumexp(density)))
        return self.estimate(found[0], found[1])

    def left_over(self, at: _Closure, own: Float[np.ndarray, "12"], found: _Found) -> float:
        """Squares of what an integration with these leaves over, weighted, all else as found."""
        values = np.concatenate([own, found.mean[OWN:]])
        count = len(self.pose)
        still = self.output[:count] - self.levers[:count] @ values
        over = np.isin(np.repeat(np.arange(len(at.duration)), 2), self.move)
        moving = (at.left - at.levers[:, OWN:] @ found.mean[OWN:])[over]
        rest, covariance = self.variances(found.wander, found.closing)
        squares = np.sum(still**2 / rest) + moving @ np.linalg.solve(covariance, moving)
        return float(squares + np.sum(((values - self.session.nominal) / PRIOR) ** 2))

    def odd(self, found: _Found, aside: _Aside) -> _Aside:
        """With the pose or the move that disagrees most, if one does."""
        left, count = self.output - self.levers @ found.mean, len(self.pose)
        rest, moving = self.variances(found.wander, found.closing)
        least, worst = DISAGREES / (len({*self.pose}) + len({*self.move})), aside
        for field, of in (("poses", self.pose), ("moves", self.move)):
            own, begin = (np.diag(rest), 0) if field == "poses" else (moving, count)
            free = max(1, len(of) - (3 if field == "poses" else OWN))
            for k in dict.fromkeys(of.tolist()):
                at = np.flatnonzero(of == k)
                levers, gone = self.levers[begin + at], left[begin + at]
                covariance = own[np.ix_(at, at)] - levers @ found.covariance @ levers.T
                square = float(gone @ np.linalg.solve(covariance, gone))
                chance = float(fdtrc(len(at), free, square / len(at)))
                if chance < least:
                    least, worst = chance, aside._replace(**{field: (*getattr(aside, field), k)})
        return worst

    def words(self, found: _Found, aside: _Aside) -> list[str]:
        """What was set aside, each with what it leaves over."""
        at, windows = self.closure, self.session.windows
        left = (at.left - at.levers[:, OWN:] @ found.mean[OWN:]).reshape(-1, 2)
        angle = np.rad2deg(np.linalg.norm(left, axis=1) * at.duration)
        usual = float(np.median(np.delete(angle, aside.moves)))
        rates = self.session.at_rest - found.mean[:3]
        rate = np.rad2deg(np.linalg.norm(rates - rates.mean(axis=0), axis=1))
        still = float(np.median(np.delete(rate, aside.poses)))
        poses = (
            f"the pose from {ws.number(windows[k, 0], 5)} to {ws.number(windows[k, 1], 5)} s, in which the outputs "
            f"stand {ws.number(rate[k], 2)} deg/s off (others {ws.number(still, 2)})"
            for k in sorted(aside.poses)
        )
        moves = (
            f"the move from {ws.number(windows[k, 1], 5)} to {ws.number(windows[k + 1, 0], 5)} s, which leaves "
            f"{ws.number(angle[k], 2)} deg over (others {ws.number(usual, 2)})"
            for k in sorted(aside.moves)
        )
        return [*poses, *moves]

    def rows(self, found: _Found) -> _Rows:
        """Innovations, one after the other."""
        rest, moving = self.variances(found.wander, found.closing)
        windows, count = self.session.windows, len(rest)
        factor = np.linalg.cholesky(moving)
        own = np.diag(factor)
        # Lower with a diagonal of ones: what a move says beside those before it.
        table = np.column_stack([self.output, self.levers])[count:]
        table = solve_triangular(factor / own, table, lower=True, unit_diagonal=True)
        between = np.stack([windows[:-1, 1], windows[1:, 0]], axis=1)
        axis = np.arange(3 * len(windows)).reshape(-1, 3)[self.pose[::3]].ravel() % 3
        return _Rows(
            output=np.concatenate([self.output[:count], table[:, 0]]),
            levers=np.concatenate([self.levers[:count], table[:, 1:]]),
            uncertainty=np.concatenate([np.sqrt(rest), own]),
            windows=np.concatenate([windows[self.pose], between[self.move]]),
            force=np.concatenate([self.session.felt[self.pose], self.closure.force[self.move]]),
            kinds=(*(ws.AXES[i] for i in axis), *("move", "move too") * (len(self.move) // 2)),
        )


class _Closure(NamedTuple):
    """What moves leave over, two readings each, as mean rates; what acts on the way."""

    left: Float[np.ndarray, "2m"]  # rad/s
    levers: Float[np.ndarray, "2m 27"]
    of_forces: Float[np.ndarray, "2m 3k"]  # slopes by the specific forces in the poses
    of_noise: Float[np.ndarray, "m 2 2"]  # covariance by white noise of one rad/s over a second
    duration: Float[np.ndarray, "m"]  # s
    force: Float[np.ndarray, "m 3"]  # mean, g
    world: Float[np.ndarray, "k 3 3"]  # from the body in each pose to the body in the first


def _closure(
    moved: _Moves, felt: Float[np.ndarray, "k 3"], own: Float[np.ndarray, "12"]
) -> _Closure:
    """Of the outputs integrated with a bias and a matrix."""
    bias, matrix = own[:3], own[3:].reshape(3, 3)
    rate, turned = _turned(moved, matrix, bias)
    size, m, back = np.linalg.norm(felt, axis=1), len(rate), turned[:, -1]
    world = [np.eye(3)]
    for one in back:
        world.append(world[-1] @ one)
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
        -np.einsum("mij,mkj->mki", np.array(world[1:]), normal),
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
        moved.duration,
        np.einsum("mn,mnj->mj", moved.weight, moved.force) / moved.duration[:, None],
        np.array(world),
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


def _columns(
    rows: _Rows, samples: bc.Measurements, log: LoggedRun, beside: tuple[str, ...], unit: float
) -> dict[str, np.ndarray]:
    """Of readings, rates in the unit of the output; what else was recorded averaged over each."""
    powers = np.repeat([0.0, 1.0, 0.0, 2.0, 0.0], [3, 9, 9, 3, 3])
    names = (*ws.ACROSS, *ws.TURNED, *PULLED, *SQUARED, *AROUND)
    made = dict(zip(names, (rows.levers / unit**powers).T, strict=True))
    made |= {"output": rows.output / unit, ws.UNCERTAINTY: rows.uncertainty / unit}
    made |= {ws.OF: np.array(rows.kinds)}
    made |= {name: rows.force[:, j] for j, name in enumerate(beside)}
    rest = [n for n in samples.columns if n not in (*made, *ws.DIRECTION, MOUNTING)]
    return made | averaged(samples, rest, (log.inside(*w) for w in rows.windows))
