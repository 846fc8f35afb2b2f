"""Mode and log evidence of a model, by the Laplace approximation: φ̂ by marginal likelihood, x̂ by Gauss–Newton.

The joint density of coefficients and their standard deviation is unbounded if that is zero; the marginal of φ is not.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from operator import attrgetter
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.parallel import run_on_one_thread
from bayescal._inference.density import Density
from bayescal._inference.gaussian import Conditional, compute_column_scales, condition
from bayescal._inference.newton import FTOL_NATS, LOG_ZERO, HessianGuess, fit_gaussian, maximise
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record

XTOL_SD = 1e-4  # tolerance: change per round, standard deviations
MAX_ROUNDS = 12  # alternations of x̂ and φ̂ at most
START_COUNT = 64  # prior draws of φ among which the starting point is selected
SCAN_COORDINATES = np.arange(-3.5, 3.5, 0.02)  # coordinates scanned along a shape with many modes
MAX_STEP_HALVINGS = 8  # of a rejected step
NO_START: Mapping[str, float] = MappingProxyType({})
MIN_INCREASE_NATS = 1e-8  # tolerance: increase of the log density per round


class Mode(NamedTuple):
    """Mode φ̂ of the marginal density of φ, mode x̂ given φ̂, and the Laplace approximation in φ's coordinates."""

    x: Any  # coefficients x̂ (p,)
    v: Any  # coordinates of φ̂ (d,)
    covariance: Any  # of the coordinates of φ (d, d)
    log_density: Any  # log p(y, φ̂), x integrated out
    log_evidence: Any  # by the Laplace approximation
    change: Any  # of φ in the last round, standard deviations
    flat: Any  # scales of coefficients with flat priors (p,)
    indefinite: Any  # whether the Hessian had to be modified to be positive definite


class FoundMode(dict[str, float]):
    """φ by name at a mode: the only starting point of a fit of the same model under the same priors."""

    def __init__(self, problem: Problem, mode: Mode) -> None:
        super().__init__((name, float(value)) for name, value in problem.hyper(mode.v).items())
        self.mode, self.priors = mode, problem.priors


@run_on_one_thread
def find_mode(
    problem: Problem,
    starts: Iterable[np.ndarray] | None = None,
    x: Float[np.ndarray, "p"] | None = None,
    xtol: float = XTOL_SD,
    start: Mapping[str, float] = NO_START,
    coarse_below: float = -math.inf,
    guess: HessianGuess | None = None,
) -> Mode:
    """Find the mode of a model, from the most probable of several starting points. Deterministic.

    Args:
        starts: candidate starting points, coordinates of φ; default: prior draws.
        x: starting point of the coefficients; default: prior mean, or an ellipsoid fit for three axes.
        xtol: tolerance of a step, in prior sd of φ and posterior sd of x; the log evidence is accurate to xtol²/2.
        start: additional starting point, φ by name; names that it lacks are at their prior medians. A `FoundMode` under
            the same priors is the only starting point.
        coarse_below: log density below which a tolerance of 0.01 nat is sufficient.
        guess: curvature of a similar density, as a first estimate of the Hessian.
    """
    x, dim = _find_start(problem) if x is None else x, len(problem.hypers)
    flat_scales = compute_flat_scales(problem, x, np.zeros(dim))
    candidates = draw_starts(problem) if starts is None else list(starts)
    if starts is None and problem.kinds == ["noise"]:  # unimodal
        candidates = candidates[:5]
    if isinstance(start, FoundMode) and start.priors == problem.priors:
        v, precision = start.mode.v, np.linalg.pinv(np.nan_to_num(start.mode.covariance))
        candidates, guess = [v], HessianGuess(v, precision, not start.mode.indefinite)
    elif start:
        start_coordinates = np.zeros(dim)
        for i, (name, prior) in enumerate(problem.priors.items()):
            start_coordinates[i] = prior.coordinate(start[name]) if name in start else 0.0
        candidates = [start_coordinates, *candidates]

    def maximise_from(starts: Sequence[np.ndarray], x: np.ndarray) -> _Peak:
        return _maximise_marginal(problem, starts, x, flat_scales, xtol, coarse_below, guess)

    select_highest = partial(max, key=attrgetter("value"))
    peak = maximise_from(candidates if dim else candidates[:1], x)
    if starts is None:
        # The density of factors of a product a·b is symmetric under (a, b) → (−a, −b): try the mirrored mode too.
        is_promoted = np.array([h.kind == "promoted" for h in problem.hypers], dtype=bool)
        if is_promoted.any():
            peak = select_highest(peak, maximise_from([np.where(is_promoted, -peak.v, peak.v)], x))
        for grid in make_scan_grids(problem, peak.v):  # multimodal in these shapes
            peak = select_highest(peak, maximise_from([*grid], peak.x))
    return fit_at_mode(peak.density, peak.v, peak.change, peak.x, peak.value > coarse_below)


def _find_start(problem: Problem) -> Float[np.ndarray, "p"]:
    """Return the starting point of x: the prior mean, or for three axes a fit to estimated directions of the input."""
    record, start = problem.record, problem.start
    vector = record.instrument.vector
    projections = None if vector is None else vector.with_directions(record.frame, record.y)
    if projections is None:
        return start
    record, centre = Record(record.instrument, *projections), np.zeros(len(problem.hypers))
    auxiliary = Problem(problem.layout, record, problem.size_factors)
    return find_mode_of_x(auxiliary, start, centre, compute_flat_scales(auxiliary, start, centre))


def compute_flat_scales(
    problem: Problem, x: Float[np.ndarray, "p"], v: Float[np.ndarray, "d"]
) -> Float[np.ndarray, "p"]:
    """Return the scale of each coefficient with a flat prior, by its column's rms; 1 for all others (p,)."""
    if problem.weight_of_x.all():
        return np.ones(problem.size)
    return compute_column_scales(problem.linearise(x, problem.hyper(v)).jacobian)


class _Peak(NamedTuple):
    """Result of one maximisation of the marginal density of φ."""

    value: float  # log density
    change: float  # in the last round
    v: np.ndarray
    x: np.ndarray
    density: Density  # linearised about x


def _maximise_marginal(
    problem: Problem,
    starts: Sequence[np.ndarray],
    x: np.ndarray,
    flat_scales: np.ndarray,
    xtol: float,
    coarse_below: float,
    guess: HessianGuess | None,
) -> _Peak:
    """Maximise the marginal density of φ from the most probable of given starting points.

    Each round maximises the density linearised about x̂(φ); the step is shortened until the density relinearised at the
    new x̂ increases.
    """
    # A step of `xtol` standard deviations changes the log density by about xtol²/2.
    min_increase = max(MIN_INCREASE_NATS, 0.5 * xtol**2)
    # The Hessian at the mode is more sensitive to its location than the density.
    ftol = max(FTOL_NATS, 0.1 * min_increase)
    density = Density(problem, x, flat_scales, starts[0], guess=guess)
    # The linearisation of an affine output is exact: one maximisation, no alternation.
    if problem.is_affine:
        v = maximise(density, select_start(density, starts), coarse_below, ftol)
        value, conditional = density.condition_at(v)
        return _Peak(value, 0.0, v, x if conditional is None else conditional.mean, density)
    v, change = select_start(density, starts), math.inf
    density, value = _relinearise(density, v, xtol)
    for _ in range(MAX_ROUNDS):
        target = maximise(density, v, coarse_below, ftol)
        for _ in range(MAX_STEP_HALVINGS):
            trial_density, trial_value = _relinearise(density, target, xtol)
            if trial_value > value - min_increase:
                break
            target = v + 0.3 * (target - v)
        else:
            break
        change = float(np.max(np.abs(target - v), initial=0.0))
        v, density, value = target, trial_density, trial_value
        if change < xtol:
            break
    return _Peak(value, change, v, density.x, density)


def select_start(density: Density, starts: Sequence[np.ndarray]) -> np.ndarray:
    """Return the starting point of highest density, coordinates of φ (d,)."""
    index = int(np.argmax(density.values(np.array(starts)))) if len(starts) > 1 else 0
    return starts[index]


def _relinearise(density: Density, v: np.ndarray, xtol: float) -> tuple[Density, float]:
    """Return the density of φ linearised about the conditional mode of x at v, and its log value at v."""
    problem, flat_scales = density.problem, density.flat_scales
    x = find_mode_of_x(problem, density.x, v, flat_scales, xtol)
    density = Density(problem, x, flat_scales, v, guess=density.next_guess)
    return density, density.condition_at(v)[0]


def make_scan_grids(problem: Problem, v: np.ndarray) -> list[Float[np.ndarray, "k d"]]:
    """Return a grid of coordinates (k, d) along each shape with a multimodal density (`Shape.ragged`)."""
    names, grids = problem.layout.index_in_phi, []
    shapes = ((e, s) for e in problem.layout.model.effects for s in e.column_shapes if s.ragged)
    for e, s in shapes:
        if (name := e.shape_name(s)) in names:
            grids.append(np.tile(v, (len(SCAN_COORDINATES), 1)))
            grids[-1][:, names[name]] = SCAN_COORDINATES
    return grids


def draw_starts(problem: Problem) -> list[np.ndarray]:
    """Return starting points: the prior median of φ, and 64 draws from a 1.5 times wider prior. Deterministic."""
    dim = len(problem.hypers)
    draws = 1.5 * np.random.default_rng(0).standard_normal((START_COUNT, dim))
    return [np.zeros(dim), *draws]


def find_mode_of_x(
    problem: Problem,
    x: Float[np.ndarray, "p"],
    v: np.ndarray,
    flat_scales: np.ndarray,
    xtol: float = XTOL_SD,
) -> Float[np.ndarray, "p"]:
    """Return the conditional mode of x given φ, found by Gauss–Newton with step halving.

    The variance from noisy inputs is fixed within a step: weighted least squares whose variance depends on x would
    favour steep slopes (effective variance: J. Orear, Am. J. Phys. 50 (1982) 912).
    """
    hyper = problem.hyper(v)
    prior = problem.prior(hyper, flat_scales)

    def evaluate(point: np.ndarray, variance: Any = None) -> tuple[float, Conditional | None]:
        density = Density(problem, point, flat_scales, input_variance=variance)
        gram = density.gram(v, hyper)
        if not math.isfinite(gram.rtr + gram.logdet):
            return math.inf, None
        # Sum of squares at the point itself, not at the minimum of the linear model.
        z = prior.weight * (point - prior.mean) / np.where(prior.sd > 0, prior.sd, 1.0)
        point_conditional = condition(gram, problem.record.size, prior, point)
        return density.rss(hyper, gram) + float(z @ z), point_conditional

    squares, conditional = evaluate(x)
    for _ in range(50):
        if conditional is None:
            return x
        target_x, fraction = conditional.mean, 1.0
        # Converged if a full Gauss–Newton step is below 0.1·xtol posterior standard deviations.
        sd = np.sqrt(np.diag(conditional.covariance)) + 1e-300
        if np.max(np.abs((target_x - x) / sd), initial=0.0) < 0.1 * xtol:
            return x
        variance = problem.extra(problem.linearise(x, hyper)) if problem.is_noisy else None
        for _ in range(MAX_STEP_HALVINGS):
            trial_x = x + fraction * (target_x - x)
            trial_squares, conditional = evaluate(trial_x, variance)
            if trial_squares <= squares or not math.isfinite(squares):
                break
            fraction *= 0.5
        else:
            return x
        decrease, squares, x = squares - trial_squares, trial_squares, trial_x
        if problem.is_noisy:
            squares, conditional = evaluate(x)
        elif fraction == 1.0 and decrease < xtol**2:
            return x
    return x


def fit_at_mode(
    density: Density,
    v: np.ndarray,
    change: float,
    x: Float[np.ndarray, "p"] | None = None,
    exact: bool = True,
) -> Mode:
    """Return the Laplace approximation of φ at its mode, and the Laplace evidence.

    change: last step of φ, standard deviations. x: default, that of `density`. exact: compute the Hessian.
    """
    x = density.x if x is None else x
    is_group_sd = np.array([kind == "group_sd" for kind in density.problem.kinds], dtype=bool)
    fit = fit_gaussian(density, v, is_group_sd, exact)
    if fit.log_density <= LOG_ZERO:
        fit = fit._replace(log_evidence=-math.inf, indefinite=True)
        change = math.inf
    fit_results = fit.covariance, fit.log_density, fit.log_evidence
    return Mode(x, v, *fit_results, change, density.flat_scales, fit.indefinite)
