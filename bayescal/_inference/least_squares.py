"""Least squares: the maximum a posteriori point by Gauss–Newton, its covariance by Laplace.

Shapes are estimated together with the coefficients, in their standard-normal coordinates. Learned spreads and noise
stand where the marginal likelihood has its maximum; one standard deviation of all readings by restricted likelihood,
squares divided by the degrees of freedom that the coefficients leave, in turn until both rest. All solves are by QR of
whitened tables, never by JᵀJ, so that no condition number is squared.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dgeqrf, dtrtri, dtrtrs  # pyright: ignore[reportAttributeAccessIssue]

from bayescal._core.jit import compiled
from bayescal._core.lazy_jax import jnp
from bayescal._core.parallel import on_one_thread
from bayescal._core.progress import stage
from bayescal._inference import trust
from bayescal._inference.gaussian import Prior
from bayescal._inference.laplace import NOTHING_KNOWN, Mode, find_mode
from bayescal._inference.method import CHAINS, Draws, Method, Outcome, Verdict
from bayescal._inference.noise_on_record import Independent, Whitening, variance, whitening
from bayescal._inference.problem import Problem, differences, put
from bayescal._model import forward
from bayescal._model.composition import Linearisation
from bayescal._model.noise_law import sort_by_time
from bayescal._model.parameters import Layout
from bayescal._model.prior import slope

XTOL_SD = 1e-6  # standard deviations: a further step smaller than this is none
# Share of the residuals in the tangent plane, at which a point counts as the optimum.
GOOD_SHARE = 1e-5
ROUND_CHANGE = 1e-9  # change of φ's coordinates in a round, below which it rests
MAX_ROUNDS = 30  # at most
ROUND_STEPS = 200  # of θ in a round
TOLERANCE = 1e-12  # of optimistix's solvers, relative and absolute
MOST_STEPS = 5000  # of these: along a curved valley they are short
SHIFT = 1e-4  # of a coordinate, for slopes by differences


class LeastSquares(Method):
    """Maximum a posteriori, with a Laplace covariance: by optimistix and, what is linear and the last digits, by QR.

    Attributes:
        curvature: "gauss-newton" leaves out second derivatives of the expected output; "hessian" keeps them.
        draws: from the Gaussian approximation, for the data tree.
    """

    curvature: Literal["gauss-newton", "hessian"] = "gauss-newton"
    draws: int = 4000
    name: ClassVar[str] = "least-squares"

    def run(self, problem: Problem, seed: int, start: Any = NOTHING_KNOWN) -> Outcome:
        with stage("least squares"):
            mode = find_mode(problem, start=start)
            # From where the mode is known to be, the last digits are a few steps of Gauss–Newton away.
            solution = refine(problem, mode, self.curvature == "hessian", by_optimistix=not start)
        return self.outcome(problem.layout, solution, seed)

    def outcome(self, layout: Layout, solution: Solution, seed: int) -> Outcome:
        """Return draws of the Gaussian approximation about a solution, and its verdict."""
        reasons = [] if solution.converged else [trust.NOT_CONVERGED]
        reasons += [] if np.all(np.isfinite(solution.covariance)) else [trust.SINGULAR]
        kind = "Gauss–Newton" if self.curvature == "gauss-newton" else "full-Hessian"
        notes = [
            f"{kind} covariance; noise and between-group standard deviations held at their estimates, so that "
            "intervals do not carry their uncertainty."
        ]
        return Outcome(
            layout=layout,
            draws=gaussian_draws(layout, solution, self.draws, seed),
            mode=solution.mode,
            verdict=Verdict(not reasons, tuple(reasons), tuple(notes), "least squares"),
            log_evidence=None if layout.is_improper else (float(solution.mode.log_evidence), None),
        )


@on_one_thread  # else the last digits would hang on how many cores there are
def gaussian_draws(layout: Layout, solution: Solution, count: int, seed: int) -> Draws:
    """Draw from the Gaussian approximation about a solution."""
    # An unknown function's amplitude and length are not among these: fitted together with the function, the amplitude
    # would run away and its coefficients to zero. They stay where the marginal likelihood has its maximum.
    places = layout.phi_indices("shape", "promoted")
    random = np.random.default_rng(seed)
    covariance = np.where(np.isfinite(solution.covariance), solution.covariance, 0.0)
    sd = np.sqrt(np.diag(covariance))
    sd = np.where(sd > 0, sd, 1.0)  # scaled by it, so that a small variance beside a large counts
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T) / np.outer(sd, sd))
    root = sd[:, None] * vectors * np.sqrt(np.maximum(values, 0))
    centre = np.concatenate([solution.mode.x, solution.mode.v[places]])
    count = CHAINS * max(1, count // CHAINS)
    normal = random.standard_normal((count, len(centre)))
    # So that means and covariances read from the draws are those of the fit, not of the draws' luck:
    if count > 4 * len(centre) and len(centre):
        normal = _exact_moments(normal)
    theta = centre + normal @ root.T
    v = np.tile(solution.mode.v, (count, 1)).copy()  # of an empty v, tile gives a view
    v[:, places] = theta[:, layout.size :]
    return Draws.of(theta[:, : layout.size], v)


def _exact_moments(normal: np.ndarray) -> np.ndarray:
    """Move normal draws linearly so that their mean is exactly 0 and their covariance exactly 1."""
    # With Z − mean = U·s·Vᵀ the matrix U·Vᵀ is the nearest to it with orthonormal columns (polar decomposition).
    svd = np.linalg.svd(normal - normal.mean(axis=0), full_matrices=False)
    return svd.U @ svd.Vh * np.sqrt(len(normal) - 1)


class QR(NamedTuple):
    """QR of a whitened table [A r]: R, Qᵀr, and what of r lies outside."""

    root: Float[np.ndarray, "q q"]
    inside: Float[np.ndarray, "q"]
    outside: float

    @property
    def determined(self) -> bool:
        scale = np.sqrt(np.sum(self.root**2, axis=0))
        return bool(np.all(np.abs(np.diag(self.root)) > 1e-14 * scale))

    @property
    def solution(self) -> Float[np.ndarray, "q"]:
        return dtrtrs(self.root, self.inside)[0] if self.inside.size else self.inside

    def damped(self, damping: float) -> Float[np.ndarray, "q"]:
        """Return the step that minimises |R·s − Qᵀr|² + damping·|weight·s|², weight the norms of R's columns."""
        if not damping:
            return self.solution
        # |R·s − Qᵀr|² + λ·|D·s|² is the least-squares problem of R over √λ·D: no product of R with itself, which
        # would square its condition (J. Moré, Lecture Notes in Mathematics 630 (1978) 105).
        weight = np.sqrt(np.sum(self.root**2, axis=0))
        rows = np.column_stack([np.diag(math.sqrt(damping) * weight), 0 * weight])
        return qr(np.concatenate([np.column_stack([self.root, self.inside]), rows])).solution


def qr(table: Float[np.ndarray, "m q1"]) -> QR:
    """Decompose a table whose last column is r."""
    upper, size = np.triu(dgeqrf(table)[0][: table.shape[1]]), table.shape[1] - 1
    last = float(upper[size, size]) if len(upper) > size else 0.0
    return QR(upper[:size, :size], upper[:size, size], last)


class Solution(NamedTuple):
    """x̂ and shapes at the maximum, scales by restricted likelihood, and the covariance of (x, shapes)."""

    mode: Mode
    covariance: Float[np.ndarray, "q q"]
    converged: bool


class _Conditional(NamedTuple):
    """θ integrated out of the model linearised somewhere, given φ."""

    theta: Float[np.ndarray, "q"]
    root: Float[np.ndarray, "q q"]  # times its transpose, the covariance
    squares: float  # of the whitened residuals at the mean, without the prior's
    spent: float  # degrees of freedom


@on_one_thread
def refine(
    problem: Problem, mode: Mode, full_hessian: bool, by_optimistix: bool = False
) -> Solution:
    """Refine the mode: (x, shapes) by least squares, scales by restricted likelihood, until both rest.

    `by_optimistix`: begin with its solver where anything is not linear.
    """
    fit = _Refinement(problem, mode)
    # Where JᵀJ has no Cholesky factor the mode is nowhere; from the prior's centre, QR may find it.
    is_finite = np.all(np.isfinite(mode.x)) and math.isfinite(mode.log_evidence)
    x = mode.x if is_finite else problem.start
    v = np.where(np.isfinite(mode.v), mode.v, 0.0)
    theta, converged = np.concatenate([x, v[fit.places]]), False
    if by_optimistix and (fit.places or not problem.affine):  # what is linear is one step of QR
        theta = fit.solved(theta, v)
    for _ in range(MAX_ROUNDS):
        theta, converged = fit.fit_theta(theta, v)
        moved = fit.fit_noise(theta, put(theta[problem.size :], fit.places, v))
        change = float(np.max(np.abs(moved - v), initial=0.0))
        v = moved
        if not change > ROUND_CHANGE:
            break
    conditional = fit.conditional(theta, v)(v)
    # What counts is whether a Gauss–Newton step would still move anything.
    covariance = conditional.root @ conditional.root.T
    sd = np.sqrt(np.diag(covariance))
    step = np.max(np.abs(conditional.theta - theta) / sd, initial=0.0)
    converged = converged or bool(step < XTOL_SD)
    if (full_hessian or not fit.gaussian) and np.all(np.isfinite(covariance)):
        covariance = fit.curved(theta, v, conditional.root)
    return Solution(mode._replace(x=theta[: problem.size], v=v), covariance, converged)


class _Refinement:
    """One fit of θ = (x, w), w the shapes' coordinates, and v, those of all φ; where both have w, that in θ counts."""

    def __init__(self, problem: Problem, mode: Mode) -> None:
        self.problem, self.mode = problem, mode
        # One variance for all readings: products over them do not depend on it.
        self.even = problem.noise.even(problem.record.frame) and not problem.noisy
        layout, self.gaussian = problem.layout, problem.noise.gaussian
        # All scales stay where the marginal likelihood of the mode has them, but for one standard deviation of all
        # readings; where coefficients of stated sizes explain any readings its prior alone says how large it is.
        stated = sum(b.size for b in layout.x_blocks if b.coefficient.group_sd is None)
        has_one_sd = self.gaussian and self.even and problem.record.size > stated
        noise = layout.phi_indices("noise") if has_one_sd else []
        self.noise_place = noise[0] if len(noise) == 1 else None
        self.places = layout.nonlinear_phi

    def prior(self, v: Float[np.ndarray, "d"]) -> Prior:
        """Return the prior of θ: of x given φ, and standard normal of w."""
        of_x = self.problem.prior(self.problem.hyper(v), self.mode.flat)
        further = np.ones(len(self.places))
        return Prior(
            np.append(of_x.mean, 0 * further),
            np.append(of_x.sd, further),
            np.append(of_x.weight, further),
        )

    def table(self, theta: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray | float]:
        """Return slopes by θ beside what the expected output leaves, and the variance that noise on inputs adds.

        With noise on inputs the slopes are those of the whitened residuals, whose variance s² moves with θ:
        −s·∂(r/s) = ∂μ + ½·r·∂s²/s². Of a straight line that is ∂μ at the adjusted inputs.
        Source: ISO/TS 28037:2010, 7; D. York, Can. J. Phys. 44 (1966) 1079.
        """
        problem, size = self.problem, self.problem.size

        def linearised(at: np.ndarray) -> Linearisation:
            return problem.linearise(at[:size], problem.hyper(put(at[size:], self.places, v)))

        line, x = linearised(theta), theta[:size]
        moved = differences(lambda w: linearised(np.append(x, w)).mean, theta[size:], SHIFT)
        residual, extra = problem.record.y - line.mean, problem.extra(line)
        table = np.column_stack([line.jacobian, *moved, residual])
        if problem.noisy:
            total = variance(problem.noise, problem.hyper(v), problem.record) + extra
            steps = SHIFT * self.prior(v).sd
            by_theta = differences(lambda at: problem.extra(linearised(at)), theta, steps)
            table[:, :-1] += 0.5 * (residual / total)[:, None] * by_theta.T
        return table, extra

    def whiten(self, v: np.ndarray, extra: Any, residual: np.ndarray) -> Whitening | Independent:
        problem = self.problem
        return whitening(problem.noise, problem.hyper(v), problem.record, extra, residual)

    def fit_theta(self, theta: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, bool]:
        """Fit θ by least squares of the whitened residuals and the prior's, given the scales in v."""
        if not theta.size:
            return theta, True
        prior = self.prior(v)
        weight = np.diag(prior.weight)

        def look(at: np.ndarray) -> tuple[float, QR]:
            plain, extra = self.table(at, v)
            white = self.whiten(v, extra, plain[:, -1])
            table = white(plain)
            # The prior is rows beside the readings: in steps of z = (θ − m)/s, [A·S; W]·step = [r; −z].
            z = prior.weight * (at - prior.mean) / np.where(prior.sd > 0, prior.sd, 1.0)
            rows = np.column_stack([weight, -z])
            whole = np.concatenate([table * np.append(prior.sd, 1.0), rows])
            if not np.all(np.isfinite(whole)):
                return math.inf, qr(np.zeros_like(whole))
            beyond = white.beyond if isinstance(white, Independent) else 0.0
            return float(whole[:, -1] @ whole[:, -1]) + beyond, qr(whole)

        cost, factor = look(theta)
        damping, best = 0.0, float(np.linalg.norm(factor.inside))
        for _ in range(ROUND_STEPS):
            if not factor.determined:
                return theta, False
            trial = theta + prior.sd * factor.damped(damping)
            trial_cost, further = look(trial)
            offset = float(np.linalg.norm(further.inside))
            # Relative offset: what of the residuals lies in the tangent plane, against all of them, has no units and
            # knows of no step length (D. Bates and D. Watts, Technometrics 23 (1981) 179).
            near = best <= GOOD_SHARE * math.sqrt(cost)
            settles = offset < 0.8 * best and trial_cost < cost * (1 + 1e-6)
            if settles or (not near and trial_cost < cost):
                theta, cost, factor, best = trial, trial_cost, further, offset
                damping = 0.0 if damping < 1e-6 else 0.1 * damping
                continue
            if near or damping > 1e12:
                break
            damping = max(10 * damping, 1e-3)
        return theta, best <= GOOD_SHARE * math.sqrt(cost)

    def solved(self, begin: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Fit θ by optimistix on the composed residuals, in plausible steps; `begin` where it fails.

        Non-Gaussian laws have no such residuals; of correlated noise no forward derivative is known.
        """
        problem = self.problem
        layout, noise = problem.layout, problem.noise
        if not (noise.gaussian and noise.independent and begin.size):
            return begin
        prior, scale = self.prior(v), np.array(self.prior(v).sd)
        for b in (b for b in layout.x_blocks if b.coefficient.flat):
            scale[b.x_slice] = b.coefficient.size
        record = problem.record
        # Padded to one of a few lengths, for each of which it is compiled once.
        is_reading = np.arange(record.padded_size) < record.size
        readings = jnp.asarray(record.longer(record.y)), jnp.asarray(is_reading, float)
        steps = _by_optimistix(
            layout, record.padded, readings, v, prior, begin, scale, tuple(self.places)
        )
        theta = begin + scale * np.asarray(steps)
        return theta if np.all(np.isfinite(theta)) else begin

    def conditional(self, theta: np.ndarray, v: np.ndarray) -> Callable[..., _Conditional]:
        """Return a function of φ's coordinates: θ integrated out of the model linearised here, by QR."""
        table, extra = self.table(theta, v)
        # With one variance for all readings R of the plain table stands for it: whitening only divides by σ.
        even = self.even
        upper = np.triu(dgeqrf(table)[0][: table.shape[1]]) if even else table
        lost = np.full((theta.size, theta.size), np.nan)
        nowhere = _Conditional(np.full(theta.size, np.nan), lost, np.nan, np.nan)

        def condition_at(v: np.ndarray) -> _Conditional:
            prior = self.prior(v)
            if even:
                variance = float(self.problem.noise.shared_variance(self.problem.hyper(v)))
                if not variance > np.finfo(float).tiny:
                    return nowhere
                white = upper / math.sqrt(variance)
            else:
                white = self.whiten(v, extra, table[:, -1])(upper)
            offset, far = prior.from_point(theta, np.sum(white[:, :-1] ** 2, axis=0))
            a, r = white[:, :-1], white[:, -1]
            scaled = np.column_stack([a * prior.sd, r - a @ offset])
            rows = np.column_stack([np.diag(prior.weight), far])
            factor = qr(np.concatenate([scaled, rows]))
            if not factor.determined:
                return nowhere
            step = factor.solution
            z = step - far
            inverse = dtrtri(factor.root)[0] if z.size else factor.root
            squares = factor.outside**2 - float(prior.weight @ z**2)
            # Degrees of freedom: the trace of the hat matrix, q − tr W·var z; all q where priors say nothing.
            spent = z.size - float(prior.weight @ np.sum(inverse**2, axis=1))
            mean = theta + offset + prior.sd * step
            return _Conditional(mean, prior.sd[:, None] * inverse, squares, spent)

        return condition_at

    def fit_noise(self, theta: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return v with the independent noise's standard deviation from squares over degrees of freedom.

        θ is integrated out (restricted likelihood: H. Patterson and R. Thompson, Biometrika 58 (1971) 545).
        """
        if self.noise_place is None:
            return v
        condition_at, place, y = self.conditional(theta, v), self.noise_place, self.problem.record.y
        least = (np.finfo(float).eps * float(np.max(np.abs(y)))) ** 2  # what the digits can tell
        # Its maximum is σ² = squares/(n − spent); priors make `spent` follow σ, hence the rounds.
        for _ in range(100):
            conditional = condition_at(v)
            if not (freedom := len(y) - conditional.spent) > 0:
                return v
            ratio = max(conditional.squares / freedom, least)  # of variances
            prior = self.problem.hypers[place].prior
            step = 0.5 * math.log(ratio) * float(prior.value(v[place]) / slope(prior, v[place]))
            v = put(v[place] + step, [place], v)
            if abs(step) < 1e-12:
                break
        return v

    def curved(
        self, theta: np.ndarray, v: np.ndarray, root: Float[np.ndarray, "q q"]
    ) -> Float[np.ndarray, "q q"]:
        """Return the covariance of θ at the maximum with second derivatives of the expected output.

        `root` is that of the covariance by Gauss–Newton.
        """
        prior = self.prior(v)
        # Slopes of ½·(eᵀΣ⁻¹e + zᵀWz) by θ: their differences hold the second derivatives.
        tightness = prior.weight / prior.sd**2

        def slope(steps: np.ndarray) -> np.ndarray:
            at = theta + root @ steps
            table, extra = self.table(at, v)
            table = self.whiten(v, extra, table[:, -1])(table)
            return root.T @ (tightness * (at - prior.mean) - table[:, :-1].T @ table[:, -1])

        # Steps along what is independent a posteriori. Two coefficients of which the readings know the sum alone are
        # each uncertain by far more than the noise, and steps of parts of that would differ in how they bend.
        rows = differences(slope, np.zeros_like(theta), 1e-3)
        return root @ np.linalg.inv(0.5 * (rows + rows.T)) @ root.T


@compiled
def _by_optimistix(layout, frame, readings, v, prior, begin, scale, places):
    """Return steps (q,), in parts of `scale`, to the least squares of residuals and prior."""
    import optimistix as optx  # a sixth of a second that only this needs

    (y, real), noise, size = readings, layout.model.noise, layout.size
    at_shapes = jnp.asarray(places, dtype=int)

    def residuals(z: Any, _: Any) -> Any:
        at = begin + scale * z
        hyper = forward.hyper_values(layout, v.at[at_shapes].set(at[size:]))
        mean, extra = forward.predict_moments(layout, frame, at[:size], hyper)
        ordered, residual = sort_by_time(noise, frame, y - mean)
        white, _ = noise.whiten(residual[:, None], 0.0 if extra is None else extra, hyper, ordered)
        return jnp.append(real * white[:, 0], prior.weight * (at - prior.mean) / prior.sd)

    none, solver = jnp.zeros(len(begin)), optx.LevenbergMarquardt(rtol=TOLERANCE, atol=TOLERANCE)
    return optx.least_squares(residuals, solver, none, max_steps=MOST_STEPS, throw=False).value
