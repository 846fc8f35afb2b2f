"""Least squares: the maximum a posteriori point by Gauss–Newton, its covariance by the Laplace approximation.

Shapes are estimated together with the coefficients, in their standard-normal coordinates. Group deviations and noise
parameters are fixed at the maximum of the marginal likelihood; a single noise standard deviation is estimated by
restricted likelihood (squares over degrees of freedom), alternating until both converge. All systems are solved by QR
of whitened tables, never by JᵀJ, which would square the condition number.
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
from bayescal._inference.laplace import NO_START, Mode, find_mode
from bayescal._inference.method import CHAINS, Draws, Method, Outcome, Verdict
from bayescal._inference.noise_on_record import Independent, Whitening, variance, whitening
from bayescal._inference.problem import Problem, differentiate, overwrite
from bayescal._model import forward
from bayescal._model.composition import Linearisation
from bayescal._model.noise_law import sort_by_time
from bayescal._model.parameters import Layout
from bayescal._model.prior import slope

XTOL_SD = 1e-6  # convergence: largest further step, posterior standard deviations
# Convergence: relative offset, the fraction of the residuals in the tangent plane.
OFFSET_TOLERANCE = 1e-5
ROUND_CHANGE = 1e-9  # convergence: largest change of φ's coordinates in a round
MAX_ROUNDS = 30  # alternations of θ and noise, at most
ROUND_STEPS = 200  # of θ in a round, at most
TOLERANCE = 1e-12  # of optimistix's solvers, relative and absolute
MAX_STEPS = 5000  # of these solvers: steps along a curved valley are short
DIFFERENCE = 1e-4  # step of a coordinate, for derivatives by central differences


class LeastSquares(Method):
    """Maximum a posteriori, with a Laplace covariance: by optimistix and, what is linear and the last digits, by QR.

    Attributes:
        curvature: "gauss-newton" leaves out second derivatives of the expected output; "hessian" keeps them.
        draws: from the Gaussian approximation, for the data tree.
    """

    curvature: Literal["gauss-newton", "hessian"] = "gauss-newton"
    draws: int = 4000
    name: ClassVar[str] = "least-squares"

    def run(self, problem: Problem, seed: int, start: Any = NO_START) -> Outcome:
        with stage("least squares"):
            mode = find_mode(problem, start=start)
            # Near a known mode a few Gauss–Newton steps suffice, without optimistix.
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
    # Amplitude and length scale of a Gaussian process are fixed at their marginal maximum: the joint density with the
    # coefficients is unbounded.
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
    # Exact sample moments: mean and covariance of the draws equal those of the fit.
    if count > 4 * len(centre) and len(centre):
        normal = _exact_moments(normal)
    theta = centre + normal @ root.T
    v = np.tile(solution.mode.v, (count, 1)).copy()  # of an empty v, tile gives a view
    v[:, places] = theta[:, layout.size :]
    return Draws.of(theta[:, : layout.size], v)


def _exact_moments(normal: np.ndarray) -> np.ndarray:
    """Transform normal draws linearly so that their sample mean is exactly 0 and their covariance exactly I."""
    # Polar decomposition: with Z − mean = U·s·Vᵀ, U·Vᵀ is the nearest matrix with orthonormal columns.
    svd = np.linalg.svd(normal - normal.mean(axis=0), full_matrices=False)
    return svd.U @ svd.Vh * np.sqrt(len(normal) - 1)


class QR(NamedTuple):
    """QR decomposition of a whitened table [A r]: R, Qᵀr, and the norm of r outside the range of A."""

    root: Float[np.ndarray, "q q"]
    projection: Float[np.ndarray, "q"]
    residual_norm: float

    @property
    def is_full_rank(self) -> bool:
        scale = np.sqrt(np.sum(self.root**2, axis=0))
        return bool(np.all(np.abs(np.diag(self.root)) > 1e-14 * scale))

    @property
    def solution(self) -> Float[np.ndarray, "q"]:
        return dtrtrs(self.root, self.projection)[0] if self.projection.size else self.projection

    def solve_damped(self, damping: float) -> Float[np.ndarray, "q"]:
        """Return the step that minimises |R·s − Qᵀr|² + damping·|weight·s|², weight the norms of R's columns."""
        if not damping:
            return self.solution
        # |R·s − Qᵀr|² + λ·|D·s|² is the least-squares problem of R over √λ·D: no product of R with itself, which
        # would square its condition (J. Moré, Lecture Notes in Mathematics 630 (1978) 105).
        weight = np.sqrt(np.sum(self.root**2, axis=0))
        rows = np.column_stack([np.diag(math.sqrt(damping) * weight), 0 * weight])
        return qr(np.concatenate([np.column_stack([self.root, self.projection]), rows])).solution


def qr(table: Float[np.ndarray, "m q1"]) -> QR:
    """Decompose a table whose last column is r."""
    upper, size = np.triu(dgeqrf(table)[0][: table.shape[1]]), table.shape[1] - 1
    last = float(upper[size, size]) if len(upper) > size else 0.0
    return QR(upper[:size, :size], upper[:size, size], last)


class Solution(NamedTuple):
    """Maximum a posteriori x and shapes, noise by restricted likelihood, and the covariance of (x, shapes)."""

    mode: Mode
    covariance: Float[np.ndarray, "q q"]
    converged: bool


class _Conditional(NamedTuple):
    """Conditional posterior of θ of a linearised model, given φ."""

    theta: Float[np.ndarray, "q"]
    root: Float[np.ndarray, "q q"]  # square root of the covariance, root·rootᵀ
    squares: float  # whitened residual sum of squares at the mean
    dof_used: float  # effective number of parameters (degrees of freedom used)


@on_one_thread
def refine(
    problem: Problem, mode: Mode, full_hessian: bool, by_optimistix: bool = False
) -> Solution:
    """Refine the mode: (x, shapes) by least squares, noise by restricted likelihood, until both converge.

    `by_optimistix`: start with its Levenberg–Marquardt solver if the model is nonlinear.
    """
    fit = _Refinement(problem, mode)
    # If JᵀJ was singular in the search for the mode, start from the prior mean: QR may still converge.
    is_finite = np.all(np.isfinite(mode.x)) and math.isfinite(mode.log_evidence)
    x = mode.x if is_finite else problem.start
    v = np.where(np.isfinite(mode.v), mode.v, 0.0)
    theta, converged = np.concatenate([x, v[fit.places]]), False
    if by_optimistix and (fit.places or not problem.affine):  # what is linear is one step of QR
        theta = fit.solve_by_optimistix(theta, v)
    for _ in range(MAX_ROUNDS):
        theta, converged = fit.fit_theta(theta, v)
        new_v = fit.fit_noise(theta, overwrite(theta[problem.size :], fit.places, v))
        change = float(np.max(np.abs(new_v - v), initial=0.0))
        v = new_v
        if not change > ROUND_CHANGE:
            break
    conditional = fit.conditioner(theta, v)(v)
    # Converged if a further Gauss–Newton step would be negligible.
    covariance = conditional.root @ conditional.root.T
    sd = np.sqrt(np.diag(covariance))
    step = np.max(np.abs(conditional.theta - theta) / sd, initial=0.0)
    converged = converged or bool(step < XTOL_SD)
    if (full_hessian or not fit.gaussian) and np.all(np.isfinite(covariance)):
        covariance = fit.hessian_covariance(theta, v, conditional.root)
    return Solution(mode._replace(x=theta[: problem.size], v=v), covariance, converged)


class _Refinement:
    """Fit of θ = (x, w), w the shapes' coordinates, and v, coordinates of all φ; w in θ overrides that in v."""

    def __init__(self, problem: Problem, mode: Mode) -> None:
        self.problem, self.mode = problem, mode
        # Homoscedastic: unweighted products suffice.
        self.is_homoscedastic = problem.noise.even(problem.record.frame) and not problem.noisy
        layout, self.gaussian = problem.layout, problem.noise.gaussian
        # Only a common noise standard deviation is re-estimated; with as many coefficients as readings it would be
        # determined by its prior alone.
        count = sum(b.size for b in layout.x_blocks if b.coefficient.group_sd is None)
        has_one_sd = self.gaussian and self.is_homoscedastic and problem.record.size > count
        noise = layout.phi_indices("noise") if has_one_sd else []
        self.noise_place = noise[0] if len(noise) == 1 else None
        self.places = layout.nonlinear_phi

    def prior(self, v: Float[np.ndarray, "d"]) -> Prior:
        """Return the prior of θ = (x, w): that of x given φ, and standard normal for w."""
        of_x = self.problem.prior(self.problem.hyper(v), self.mode.flat)
        ones = np.ones(len(self.places))
        return Prior(
            np.append(of_x.mean, 0 * ones), np.append(of_x.sd, ones), np.append(of_x.weight, ones)
        )

    def table(self, theta: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray | float]:
        """Return the table [Jacobian by θ, residuals], and the variance from noisy inputs.

        With noisy inputs it is the Jacobian of whitened residuals, whose variance s² depends on θ:
        −s·∂(r/s) = ∂μ + ½·r·∂s²/s². For a straight line this is ∂μ at the adjusted inputs.
        Source: ISO/TS 28037:2010, 7; D. York, Can. J. Phys. 44 (1966) 1079.
        """
        problem, size = self.problem, self.problem.size

        def linearise_at(at: np.ndarray) -> Linearisation:
            return problem.linearise(at[:size], problem.hyper(overwrite(at[size:], self.places, v)))

        line, x = linearise_at(theta), theta[:size]
        shape_jac = differentiate(
            lambda w: linearise_at(np.append(x, w)).mean, theta[size:], DIFFERENCE
        )
        residual, extra = problem.record.y - line.mean, problem.extra(line)
        table = np.column_stack([line.jacobian, *shape_jac, residual])
        if problem.noisy:
            total = variance(problem.noise, problem.hyper(v), problem.record) + extra
            steps = DIFFERENCE * self.prior(v).sd
            extra_grad = differentiate(lambda at: problem.extra(linearise_at(at)), theta, steps)
            table[:, :-1] += 0.5 * (residual / total)[:, None] * extra_grad.T
        return table, extra

    def whiten(self, v: np.ndarray, extra: Any, residual: np.ndarray) -> Whitening | Independent:
        problem = self.problem
        return whitening(problem.noise, problem.hyper(v), problem.record, extra, residual)

    def fit_theta(self, theta: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, bool]:
        """Fit θ by damped Gauss–Newton on whitened residuals and prior, given v; return θ and whether it converged."""
        if not theta.size:
            return theta, True
        prior = self.prior(v)
        weight = np.diag(prior.weight)

        def evaluate(at: np.ndarray) -> tuple[float, QR]:
            unwhitened, extra = self.table(at, v)
            white = self.whiten(v, extra, unwhitened[:, -1])
            table = white(unwhitened)
            # The prior as pseudo-observations: for the step of z = (θ − m)/s, [A·S; W]·step = [r; −z].
            z = prior.weight * (at - prior.mean) / np.where(prior.sd > 0, prior.sd, 1.0)
            rows = np.column_stack([weight, -z])
            stacked = np.concatenate([table * np.append(prior.sd, 1.0), rows])
            if not np.all(np.isfinite(stacked)):
                return math.inf, qr(np.zeros_like(stacked))
            offset_squares = white.excess if isinstance(white, Independent) else 0.0
            return float(stacked[:, -1] @ stacked[:, -1]) + offset_squares, qr(stacked)

        cost, factor = evaluate(theta)
        damping, best = 0.0, float(np.linalg.norm(factor.projection))
        for _ in range(ROUND_STEPS):
            if not factor.is_full_rank:
                return theta, False
            trial = theta + prior.sd * factor.solve_damped(damping)
            trial_cost, trial_factor = evaluate(trial)
            offset = float(np.linalg.norm(trial_factor.projection))
            # Relative offset: residuals in the tangent plane over all residuals, independent of units and step length
            # (D. Bates and D. Watts, Technometrics 23 (1981) 179).
            is_near = best <= OFFSET_TOLERANCE * math.sqrt(cost)
            improves = offset < 0.8 * best and trial_cost < cost * (1 + 1e-6)
            if improves or (not is_near and trial_cost < cost):
                theta, cost, factor, best = trial, trial_cost, trial_factor, offset
                damping = 0.0 if damping < 1e-6 else 0.1 * damping
                continue
            if is_near or damping > 1e12:
                break
            damping = max(10 * damping, 1e-3)
        return theta, best <= OFFSET_TOLERANCE * math.sqrt(cost)

    def solve_by_optimistix(self, begin: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Fit θ by Levenberg–Marquardt (optimistix), scaled by prior deviations; return `begin` if it fails.

        Not for non-Gaussian laws, nor for correlated noise, whose whitening has no forward-mode derivative.
        """
        problem = self.problem
        layout, noise = problem.layout, problem.noise
        if not (noise.gaussian and noise.independent and begin.size):
            return begin
        prior, scale = self.prior(v), np.array(self.prior(v).sd)
        for b in (b for b in layout.x_blocks if b.coefficient.flat):
            scale[b.x_slice] = b.coefficient.size
        record = problem.record
        # Padded to one of a few lengths, so that few programs are compiled.
        is_reading = np.arange(record.padded_size) < record.size
        readings = jnp.asarray(record.pad(record.y)), jnp.asarray(is_reading, float)
        steps = _by_optimistix(
            layout, record.padded, readings, v, prior, begin, scale, tuple(self.places)
        )
        theta = begin + scale * np.asarray(steps)
        return theta if np.all(np.isfinite(theta)) else begin

    def conditioner(self, theta: np.ndarray, v: np.ndarray) -> Callable[..., _Conditional]:
        """Return a function v → conditional posterior of θ, for the model linearised at θ, by QR."""
        table, extra = self.table(theta, v)
        # Homoscedastic: the table is replaced by its R factor, and whitening divides by σ.
        even = self.is_homoscedastic
        reduced = np.triu(dgeqrf(table)[0][: table.shape[1]]) if even else table
        undefined = np.full((theta.size, theta.size), np.nan)
        failed = _Conditional(np.full(theta.size, np.nan), undefined, np.nan, np.nan)

        def condition_at(v: np.ndarray) -> _Conditional:
            prior = self.prior(v)
            if even:
                variance = float(self.problem.noise.shared_variance(self.problem.hyper(v)))
                if not variance > np.finfo(float).tiny:
                    return failed
                white = reduced / math.sqrt(variance)
            else:
                white = self.whiten(v, extra, table[:, -1])(reduced)
            offset, prior_pull = prior.offset_from(theta, np.sum(white[:, :-1] ** 2, axis=0))
            a, r = white[:, :-1], white[:, -1]
            scaled = np.column_stack([a * prior.sd, r - a @ offset])
            rows = np.column_stack([np.diag(prior.weight), prior_pull])
            factor = qr(np.concatenate([scaled, rows]))
            if not factor.is_full_rank:
                return failed
            step = factor.solution
            z = step - prior_pull
            inverse = dtrtri(factor.root)[0] if z.size else factor.root
            squares = factor.residual_norm**2 - float(prior.weight @ z**2)
            # Effective number of parameters: the trace of the hat matrix, q − tr(W·var z).
            dof_used = z.size - float(prior.weight @ np.sum(inverse**2, axis=1))
            mean = theta + offset + prior.sd * step
            return _Conditional(mean, prior.sd[:, None] * inverse, squares, dof_used)

        return condition_at

    def fit_noise(self, theta: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Re-estimate the common noise standard deviation in v: squares over degrees of freedom.

        θ is integrated out (restricted likelihood: H. Patterson and R. Thompson, Biometrika 58 (1971) 545).
        """
        if self.noise_place is None:
            return v
        condition_at, place = self.conditioner(theta, v), self.noise_place
        y = self.problem.record.y
        floor = (np.finfo(float).eps * float(np.max(np.abs(y)))) ** 2  # rounding error
        # σ² = squares/(n − dof_used) is a fixed point: the effective number of parameters depends on σ.
        for _ in range(100):
            conditional = condition_at(v)
            if not (dof := len(y) - conditional.dof_used) > 0:
                return v
            ratio = max(conditional.squares / dof, floor)  # of variances
            prior = self.problem.hypers[place].prior
            step = 0.5 * math.log(ratio) * float(prior.value(v[place]) / slope(prior, v[place]))
            v = overwrite(v[place] + step, [place], v)
            if abs(step) < 1e-12:
                break
        return v

    def hessian_covariance(
        self, theta: np.ndarray, v: np.ndarray, root: Float[np.ndarray, "q q"]
    ) -> Float[np.ndarray, "q q"]:
        """Return the covariance of θ from the full Hessian, second derivatives of the expected output included.

        `root`: square root of the Gauss–Newton covariance.
        """
        prior = self.prior(v)
        # The Hessian by central differences of the gradient of ½·(eᵀΣ⁻¹e + zᵀWz).
        tightness = prior.weight / prior.sd**2

        def slope(steps: np.ndarray) -> np.ndarray:
            at = theta + root @ steps
            table, extra = self.table(at, v)
            table = self.whiten(v, extra, table[:, -1])(table)
            return root.T @ (tightness * (at - prior.mean) - table[:, :-1].T @ table[:, -1])

        # Differences in whitened coordinates: steps along single, strongly correlated coefficients would be too large.
        rows = differentiate(slope, np.zeros_like(theta), 1e-3)
        return root @ np.linalg.inv(0.5 * (rows + rows.T)) @ root.T


@compiled
def _by_optimistix(layout, frame, readings, v, prior, begin, scale, places):
    """Return the step (q,) in units of `scale` from `begin` to the minimum of residuals and prior, by optimistix."""
    import optimistix as optx  # a sixth of a second that only this needs

    (y, is_reading), noise, size = readings, layout.model.noise, layout.size
    at_shapes = jnp.asarray(places, dtype=int)

    def residuals(z: Any, _: Any) -> Any:
        theta = begin + scale * z
        hyper = forward.hyper_values(layout, v.at[at_shapes].set(theta[size:]))
        mean, extra = forward.predict_moments(layout, frame, theta[:size], hyper)
        ordered, residual = sort_by_time(noise, frame, y - mean)
        white, _ = noise.whiten(residual[:, None], 0.0 if extra is None else extra, hyper, ordered)
        return jnp.append(is_reading * white[:, 0], prior.weight * (theta - prior.mean) / prior.sd)

    zeros, solver = jnp.zeros(len(begin)), optx.LevenbergMarquardt(rtol=TOLERANCE, atol=TOLERANCE)
    return optx.least_squares(residuals, solver, zeros, max_steps=MAX_STEPS, throw=False).value
