"""Least squares: maximum a posteriori estimate by Gauss–Newton, and its covariance by the Laplace approximation.

Shapes are estimated together with the coefficients, in their standard-normal coordinates. Between-group deviations and
noise parameters are fixed at the maximum of the marginal likelihood; a single noise standard deviation is estimated by
restricted likelihood (residual sum of squares over degrees of freedom), in alternation until both converge. All systems
are solved by QR of whitened tables, never by JᵀJ, which would square the condition number.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dgeqrf, dtrtri, dtrtrs  # pyright: ignore[reportAttributeAccessIssue]

from bayescal._core.lazy_jax import jnp
from bayescal._core.parallel import run_on_one_thread
from bayescal._core.progress import track
from bayescal._inference import trust
from bayescal._inference.gaussian import Prior
from bayescal._inference.laplace import NO_START, Mode, find_mode
from bayescal._inference.method import CHAINS, Draws, Method, Outcome, Verdict
from bayescal._inference.noise_on_record import SdWhitening, Whitening, variance, whitening
from bayescal._inference.problem import Problem, differentiate, overwrite
from bayescal._inference.programs import compile_on_call
from bayescal._model import forward
from bayescal._model.composition import Linearisation
from bayescal._model.noise_law import sort_by_time
from bayescal._model.parameters import Layout
from bayescal._model.prior import slope

XTOL_SD = 1e-6  # tolerance of the step, posterior standard deviations
# Tolerance of the relative offset, the fraction of the residuals in the tangent plane.
OFFSET_TOLERANCE = 1e-5
ROUND_TOLERANCE = 1e-9  # of the change of φ's coordinates in a round
MAX_ROUNDS = 30  # alternations of θ and noise
MAX_ROUND_STEPS = 200  # steps of θ in a round
SOLVER_TOL = 1e-12  # relative and absolute tolerance of optimistix's solver
SOLVER_STEPS = 5000  # of optimistix: steps along a curved valley are short
DIFF_STEP = 1e-4  # central-difference step of a coordinate


class LeastSquares(Method):
    """Maximum a posteriori estimate with Laplace covariance, by Levenberg–Marquardt (optimistix) and Gauss–Newton (QR).

    Attributes:
        curvature: "gauss-newton" neglects second derivatives of the expected output; "hessian" includes them.
        draws: number of draws from the Gaussian approximation.
    """

    curvature: Literal["gauss-newton", "hessian"] = "gauss-newton"
    draws: int = 4000
    name: ClassVar[str] = "least-squares"

    def run(self, problem: Problem, seed: int, start: Any = NO_START) -> Outcome:
        with track("least squares"):
            mode = find_mode(problem, start=start)
            # Near a known mode a few Gauss–Newton steps suffice, without optimistix.
            solution = refine(problem, mode, self.curvature == "hessian", use_optimistix=not start)
        return self.outcome(problem.layout, solution, seed)

    def outcome(self, layout: Layout, solution: Solution, seed: int) -> Outcome:
        """Return draws of the Gaussian approximation about a solution, and its verdict."""
        reasons = [] if solution.converged else [trust.NOT_CONVERGED]
        reasons += [] if np.all(np.isfinite(solution.covariance)) else [trust.SINGULAR_HESSIAN_TEXT]
        kind = "Gauss–Newton" if self.curvature == "gauss-newton" else "full-Hessian"
        notes = [
            f"{kind} covariance; noise and between-group standard deviations are fixed at their estimates: intervals "
            "do not include their uncertainty."
        ]
        return Outcome(
            layout=layout,
            draws=draw_gaussian(layout, solution, self.draws, seed),
            mode=solution.mode,
            verdict=Verdict(not reasons, tuple(reasons), tuple(notes), "least squares"),
            log_evidence=None if layout.is_improper else (float(solution.mode.log_evidence), None),
        )


@run_on_one_thread  # results must not depend on the number of cores
def draw_gaussian(layout: Layout, solution: Solution, count: int, seed: int) -> Draws:
    """Draw unknowns from the Gaussian approximation about a least-squares solution."""
    # Amplitude and length scale of a Gaussian process are fixed: their joint density with coefficients is unbounded.
    phi_index = layout.phi_indices("shape", "promoted")
    rng = np.random.default_rng(seed)
    covariance = np.where(np.isfinite(solution.covariance), solution.covariance, 0.0)
    sd = np.sqrt(np.diag(covariance))
    sd = np.where(sd > 0, sd, 1.0)  # scale factors, so that small variances keep their digits
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T) / np.outer(sd, sd))
    root = sd[:, None] * vectors * np.sqrt(np.maximum(values, 0))
    centre = np.concatenate([solution.mode.x, solution.mode.v[phi_index]])
    count = CHAINS * max(1, count // CHAINS)
    deviates = rng.standard_normal((count, len(centre)))
    # Exact sample moments: mean and covariance of the draws equal those of the fit.
    if count > 4 * len(centre) and len(centre):
        deviates = _standardise_moments(deviates)
    theta = centre + deviates @ root.T
    v = np.tile(solution.mode.v, (count, 1)).copy()  # of an empty v, tile gives a view
    v[:, phi_index] = theta[:, layout.size :]
    return Draws.of(theta[:, : layout.size], v)


def _standardise_moments(deviates: np.ndarray) -> np.ndarray:
    """Transform normal deviates (s, q) linearly, so that their sample mean is 0 and their sample covariance I."""
    # Polar decomposition: with Z − mean = U·s·Vᵀ, U·Vᵀ is the nearest matrix with orthonormal columns.
    svd = np.linalg.svd(deviates - deviates.mean(axis=0), full_matrices=False)
    return svd.U @ svd.Vh * np.sqrt(len(deviates) - 1)


class QR(NamedTuple):
    """QR decomposition of a whitened table [A r]: R (`upper`), Qᵀr, and the norm of r outside the range of A."""

    upper: Float[np.ndarray, "q q"]
    projection: Float[np.ndarray, "q"]
    residual_norm: float

    @property
    def is_full_rank(self) -> bool:
        scale = np.sqrt(np.sum(self.upper**2, axis=0))
        return bool(np.all(np.abs(np.diag(self.upper)) > 1e-14 * scale))

    @property
    def solution(self) -> Float[np.ndarray, "q"]:
        return dtrtrs(self.upper, self.projection)[0] if self.projection.size else self.projection

    def solve_damped(self, damping: float) -> Float[np.ndarray, "q"]:
        """Return the step s that minimises |R·s − Qᵀr|² + damping·|D·s|², D the norms of R's columns."""
        if not damping:
            return self.solution
        # Least squares of R over √λ·D: RᵀR would square the condition (J. Moré, Lect. Notes Math. 630 (1978) 105).
        weight = np.sqrt(np.sum(self.upper**2, axis=0))
        rows = np.column_stack([np.diag(math.sqrt(damping) * weight), 0 * weight])
        return qr(np.concatenate([np.column_stack([self.upper, self.projection]), rows])).solution


def qr(table: Float[np.ndarray, "m q1"]) -> QR:
    """Return the QR decomposition of a table [A r], residuals r in the last column."""
    upper, size = np.triu(dgeqrf(table)[0][: table.shape[1]]), table.shape[1] - 1
    residual_norm = float(upper[size, size]) if len(upper) > size else 0.0
    return QR(upper[:size, :size], upper[:size, size], residual_norm)


class Solution(NamedTuple):
    """Maximum a posteriori coefficients x and shapes, noise by restricted likelihood, and covariance of (x, shapes)."""

    mode: Mode
    covariance: Float[np.ndarray, "q q"]
    converged: bool


class _Conditional(NamedTuple):
    """Conditional posterior, given φ, of θ = (x, shapes) of a linearised model."""

    theta: Float[np.ndarray, "q"]
    root: Float[np.ndarray, "q q"]  # square root of the covariance root·rootᵀ
    squares: float  # whitened residual sum of squares at the mean
    dof_used: float  # effective number of parameters (degrees of freedom used)


@run_on_one_thread
def refine(
    problem: Problem, mode: Mode, use_full_hessian: bool, use_optimistix: bool = False
) -> Solution:
    """Refine a mode: alternate least squares of (x, shapes) with restricted likelihood of the noise until convergence.

    use_optimistix: start with optimistix's Levenberg–Marquardt solver if the model is nonlinear.
    """
    fit = _Refinement(problem, mode)
    # If JᵀJ was singular in the search for the mode, start from the prior mean: QR may still converge.
    is_finite = np.all(np.isfinite(mode.x)) and math.isfinite(mode.log_evidence)
    x = mode.x if is_finite else problem.start
    v = np.where(np.isfinite(mode.v), mode.v, 0.0)
    theta, converged = np.concatenate([x, v[fit.shapes]]), False
    if use_optimistix and (fit.shapes or not problem.is_affine):  # a linear model needs one QR step
        theta = fit.minimise_by_optimistix(theta, v)
    for _ in range(MAX_ROUNDS):
        theta, converged = fit.fit_theta(theta, v)
        new_v = fit.fit_noise(theta, overwrite(theta[problem.size :], fit.shapes, v))
        change = float(np.max(np.abs(new_v - v), initial=0.0))
        v = new_v
        if not change > ROUND_TOLERANCE:
            break
    conditional = fit.make_conditioner(theta, v)(v)
    # Converged if a further Gauss–Newton step would be negligible.
    covariance = conditional.root @ conditional.root.T
    sd = np.sqrt(np.diag(covariance))
    step = np.max(np.abs(conditional.theta - theta) / sd, initial=0.0)
    converged = converged or bool(step < XTOL_SD)
    if (use_full_hessian or not fit.is_gaussian) and np.all(np.isfinite(covariance)):
        covariance = fit.compute_covariance(theta, v, conditional.root)
    return Solution(mode._replace(x=theta[: problem.size], v=v), covariance, converged)


class _Refinement:
    """Least-squares fit of θ = (x, w), with w the shapes' coordinates, which replace those in v, coordinates of φ."""

    def __init__(self, problem: Problem, mode: Mode) -> None:
        self.problem, self.mode = problem, mode
        self.is_homoscedastic = problem.noise.even(problem.record.frame) and not problem.is_noisy
        layout, self.is_gaussian = problem.layout, problem.noise.is_gaussian
        # Only a common noise sd is re-estimated; without degrees of freedom its prior alone would determine it.
        count = sum(b.size for b in layout.x_blocks if b.coefficient.group_sd is None)
        has_one_sd = self.is_gaussian and self.is_homoscedastic and problem.record.size > count
        noise = layout.phi_indices("noise") if has_one_sd else []
        self.noise_index = noise[0] if len(noise) == 1 else None
        self.shapes = layout.nonlinear_phi

    def prior(self, v: Float[np.ndarray, "d"]) -> Prior:
        """Return the prior of θ = (x, w): that of x given φ, and standard normal for w."""
        mean, sd, weight = self.problem.prior(self.problem.hyper(v), self.mode.flat)
        ones = np.ones(len(self.shapes))
        return Prior(np.append(mean, 0 * ones), np.append(sd, ones), np.append(weight, ones))

    def table(self, theta: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray | float]:
        """Return the table [Jacobian with respect to θ, residuals], and the variance of readings from noisy inputs.

        With noisy inputs the Jacobian is that of whitened residuals, whose variance s² depends on θ:
        −s·∂(r/s) = ∂μ + ½·r·∂s²/s². For a straight line this is ∂μ at the adjusted inputs.
        Source: ISO/TS 28037:2010, 7; D. York, Can. J. Phys. 44 (1966) 1079.
        """
        problem, size = self.problem, self.problem.size

        def linearise_at(point: np.ndarray) -> Linearisation:
            hyper = problem.hyper(overwrite(point[size:], self.shapes, v))
            return problem.linearise(point[:size], hyper)

        line, x = linearise_at(theta), theta[:size]
        shape_jac = differentiate(
            lambda w: linearise_at(np.append(x, w)).mean, theta[size:], DIFF_STEP
        )
        residual, input_variance = problem.record.y - line.mean, problem.extra(line)
        table = np.column_stack([line.jacobian, *shape_jac, residual])
        if problem.is_noisy:
            total = variance(problem.noise, problem.hyper(v), problem.record) + input_variance
            steps = DIFF_STEP * self.prior(v).sd
            variance_grad = differentiate(lambda t: problem.extra(linearise_at(t)), theta, steps)
            table[:, :-1] += 0.5 * (residual / total)[:, None] * variance_grad.T
        return table, input_variance

    def whiten(self, v: np.ndarray, extra: Any, residual: np.ndarray) -> Whitening | SdWhitening:
        problem = self.problem
        return whitening(problem.noise, problem.hyper(v), problem.record, extra, residual)

    def fit_theta(self, theta: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, bool]:
        """Fit θ given v by damped Gauss–Newton on whitened residuals and prior; return θ and whether it converged."""
        if not theta.size:
            return theta, True
        prior = self.prior(v)
        weight = np.diag(prior.weight)

        def evaluate(point: np.ndarray) -> tuple[float, QR]:
            raw_table, input_variance = self.table(point, v)
            whitening = self.whiten(v, input_variance, raw_table[:, -1])
            table = whitening(raw_table)
            # The prior as pseudo-observations: for the step of z = (θ − m)/s, [A·S; W]·step = [r; −z].
            z = prior.weight * (point - prior.mean) / np.where(prior.sd > 0, prior.sd, 1.0)
            rows = np.column_stack([weight, -z])
            system = np.concatenate([table * np.append(prior.sd, 1.0), rows])
            if not np.all(np.isfinite(system)):
                return math.inf, qr(np.zeros_like(system))
            offset_squares = whitening.excess if isinstance(whitening, SdWhitening) else 0.0
            return float(system[:, -1] @ system[:, -1]) + offset_squares, qr(system)

        cost, factor = evaluate(theta)
        damping, best_offset = 0.0, float(np.linalg.norm(factor.projection))
        for _ in range(MAX_ROUND_STEPS):
            if not factor.is_full_rank:
                return theta, False
            trial = theta + prior.sd * factor.solve_damped(damping)
            trial_cost, trial_factor = evaluate(trial)
            offset = float(np.linalg.norm(trial_factor.projection))
            # Relative offset, independent of units and steps (D. Bates and D. Watts, Technometrics 23 (1981) 179).
            is_near = best_offset <= OFFSET_TOLERANCE * math.sqrt(cost)
            is_better = offset < 0.8 * best_offset and trial_cost < cost * (1 + 1e-6)
            if is_better or (not is_near and trial_cost < cost):
                theta, cost, factor, best_offset = trial, trial_cost, trial_factor, offset
                damping = 0.0 if damping < 1e-6 else 0.1 * damping
                continue
            if is_near or damping > 1e12:
                break
            damping = max(10 * damping, 1e-3)
        return theta, best_offset <= OFFSET_TOLERANCE * math.sqrt(cost)

    def minimise_by_optimistix(self, start: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Fit θ by Levenberg–Marquardt (optimistix), scaled by prior standard deviations; return `start` if it fails.

        Also returns `start` for non-Gaussian laws and for correlated noise, whose whitening lacks forward derivatives.
        """
        problem = self.problem
        layout, noise = problem.layout, problem.noise
        if not (noise.is_gaussian and noise.independent and start.size):
            return start
        prior, scale = self.prior(v), np.array(self.prior(v).sd)
        for b in (b for b in layout.x_blocks if b.coefficient.flat):
            scale[b.x_slice] = b.coefficient.size
        record = problem.record
        # Padded to one of a few lengths, so that few programs are compiled.
        is_reading = np.arange(record.padded_size) < record.size
        readings = jnp.asarray(record.pad(record.y)), jnp.asarray(is_reading, float)
        steps = _run_optimistix(
            layout, record.padded, readings, v, prior, start, scale, tuple(self.shapes)
        )
        theta = start + scale * np.asarray(steps)
        return theta if np.all(np.isfinite(theta)) else start

    def make_conditioner(self, theta: np.ndarray, v: np.ndarray) -> Callable[..., _Conditional]:
        """Return a function that maps v to the conditional posterior of θ for the model linearised at θ."""
        table, input_variance = self.table(theta, v)
        # Homoscedastic: the table is replaced by its R factor, and whitening divides by σ.
        is_homoscedastic, law = self.is_homoscedastic, self.problem.noise
        coordinate = law.variance_coordinate(self.problem.record.frame)
        reduced_table = np.triu(dgeqrf(table)[0][: table.shape[1]]) if is_homoscedastic else table
        nan_matrix = np.full((theta.size, theta.size), np.nan)
        undefined_result = _Conditional(np.full(theta.size, np.nan), nan_matrix, np.nan, np.nan)

        def condition_at(v: np.ndarray) -> _Conditional:
            prior = self.prior(v)
            if is_homoscedastic:
                variance = float(law.variance_at(self.problem.hyper(v), coordinate))
                if not variance > np.finfo(float).tiny:
                    return undefined_result
                whitened = reduced_table / math.sqrt(variance)
            else:
                whitened = self.whiten(v, input_variance, table[:, -1])(reduced_table)
            offset, prior_rhs = prior.offset_from(theta, np.sum(whitened[:, :-1] ** 2, axis=0))
            jacobian, residual = whitened[:, :-1], whitened[:, -1]
            scaled_table = np.column_stack([jacobian * prior.sd, residual - jacobian @ offset])
            rows = np.column_stack([np.diag(prior.weight), prior_rhs])
            qr_factor = qr(np.concatenate([scaled_table, rows]))
            if not qr_factor.is_full_rank:
                return undefined_result
            step = qr_factor.solution
            z = step - prior_rhs
            inverse = dtrtri(qr_factor.upper)[0] if z.size else qr_factor.upper
            squares = qr_factor.residual_norm**2 - float(prior.weight @ z**2)
            # Effective number of parameters: the trace of the hat matrix, q − tr(W·var z).
            dof_used = z.size - float(prior.weight @ np.sum(inverse**2, axis=1))
            mean = theta + offset + prior.sd * step
            return _Conditional(mean, prior.sd[:, None] * inverse, squares, dof_used)

        return condition_at

    def fit_noise(self, theta: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return v with the common noise sd re-estimated as √(residual sum of squares / degrees of freedom).

        Restricted likelihood (REML), θ integrated out: H. Patterson and R. Thompson, Biometrika 58 (1971) 545.
        """
        if self.noise_index is None:
            return v
        condition_at, index = self.make_conditioner(theta, v), self.noise_index
        y = self.problem.record.y
        min_variance = (np.finfo(float).eps * float(np.max(np.abs(y)))) ** 2  # rounding error
        # σ² = squares/(n − dof_used) is a fixed point: the effective number of parameters depends on σ.
        for _ in range(100):
            conditional = condition_at(v)
            if not (dof := len(y) - conditional.dof_used) > 0:
                return v
            ratio = max(conditional.squares / dof, min_variance)  # of variances
            prior = self.problem.hypers[index].prior
            step = 0.5 * math.log(ratio) * float(prior.value(v[index]) / slope(prior, v[index]))
            v = overwrite(v[index] + step, [index], v)
            if abs(step) < 1e-12:
                break
        return v

    def compute_covariance(
        self, theta: np.ndarray, v: np.ndarray, root: Float[np.ndarray, "q q"]
    ) -> Float[np.ndarray, "q q"]:
        """Return the covariance of θ from the full Hessian, with second derivatives of the expected output.

        root: square root of the Gauss–Newton covariance.
        """
        prior = self.prior(v)
        # The Hessian by central differences of the gradient of ½·(eᵀΣ⁻¹e + zᵀWz).
        precision = prior.weight / prior.sd**2

        def compute_gradient(steps: np.ndarray) -> np.ndarray:
            point = theta + root @ steps
            table, input_variance = self.table(point, v)
            table = self.whiten(v, input_variance, table[:, -1])(table)
            return root.T @ (precision * (point - prior.mean) - table[:, :-1].T @ table[:, -1])

        # Differences in whitened coordinates: steps along single, strongly correlated coefficients would be too large.
        hessian = differentiate(compute_gradient, np.zeros_like(theta), 1e-3)
        return root @ np.linalg.inv(0.5 * (hessian + hessian.T)) @ root.T


@compile_on_call
def _run_optimistix(layout, frame, readings, v, prior, start, scale, shape_indices):
    """Return the step (q,), in units of `scale`, from `start` to the minimum of squared residuals and prior."""
    import optimistix as optx  # a sixth of a second that only this needs

    (y, is_reading), noise, size = readings, layout.model.noise, layout.size
    shape_index = jnp.asarray(shape_indices, dtype=int)

    def residuals(z: Any, _: Any) -> Any:
        theta = start + scale * z
        hyper = layout.hyper(v.at[shape_index].set(theta[size:]))
        mean, extra = forward.predict_moments(layout, frame, theta[:size], hyper)
        by_time, residual = sort_by_time(noise, frame, y - mean)
        white, _ = noise.whiten(residual[:, None], 0.0 if extra is None else extra, hyper, by_time)
        return jnp.append(is_reading * white[:, 0], prior.weight * (theta - prior.mean) / prior.sd)

    zeros, solver = jnp.zeros(len(start)), optx.LevenbergMarquardt(rtol=SOLVER_TOL, atol=SOLVER_TOL)
    return optx.least_squares(residuals, solver, zeros, max_steps=SOLVER_STEPS, throw=False).value
