"""Mode of a model: φ̂ by marginal likelihood, x̂ given φ̂ by Gauss–Newton, and the Laplace approximation.

The joint density of coefficients and their standard deviation is unbounded at zero deviation; the marginal of φ is not.
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

from bayescal._core.parallel import on_one_thread
from bayescal._inference.density import Density
from bayescal._inference.gaussian import Conditional, column_scale, condition
from bayescal._inference.newton import CONVERGED_NATS, NOWHERE, Nearby, climb, gaussian_fit
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record

XTOL_SD = 1e-4  # convergence: largest change per round, posterior standard deviations
MAX_ROUNDS = 12  # alternations of x̂ and φ̂ at most
STARTS = 64  # prior draws of φ from which the start is selected
SCAN_GRID = np.arange(-3.5, 3.5, 0.02)  # coordinates scanned along a shape with many modes
MAX_HALVINGS = 8  # of a rejected step, at most
NOTHING_KNOWN: Mapping[str, float] = MappingProxyType({})
MIN_GAIN_NATS = 1e-8  # convergence: smallest increase of the log density per round


class Mode(NamedTuple):
    """Mode φ̂ of the marginal density, x̂ given φ̂, and the Laplace approximation in φ's coordinates."""

    x: Any  # (p,)
    v: Any  # (d,)
    covariance: Any  # (d, d)
    log_density: Any  # log p(y, φ̂), x integrated out
    log_evidence: Any  # Laplace
    change: Any  # in the last round, standard deviations
    flat: Any  # (p,)
    indefinite: Any  # whether the Hessian had to be modified to be positive definite


@on_one_thread
def find_mode(
    problem: Problem,
    starts: Iterable[np.ndarray] | None = None,
    x: Float[np.ndarray, "p"] | None = None,
    xtol: float = XTOL_SD,
    start: Mapping[str, float] = NOTHING_KNOWN,
    coarse_below: float = -math.inf,
    near: Nearby | None = None,
) -> Mode:
    """Find the mode of a model, from the most probable of several starting points. Deterministic.

    Args:
        starts: coordinates of φ to select the starting point from; prior draws if not given.
        x: starting point of x̂; its prior mean, or a fit by an ellipsoid for three axes, if not given.
        xtol: convergence tolerance, posterior standard deviations; the log evidence is accurate to about xtol²/2.
        start: a further starting point, φ by name; absent entries are at the median of their prior.
        coarse_below: log density below which a tolerance of 0.01 nat is sufficient.
        near: curvature of a similar density, as a first estimate of the Hessian.
    """
    x, dim = _find_start(problem) if x is None else x, len(problem.hypers)
    flat = flat_scales(problem, x, np.zeros(dim))
    candidates = prior_draws(problem) if starts is None else list(starts)
    if starts is None and problem.kinds == ["noise"]:  # one hill
        candidates = candidates[:5]
    if start:
        stated = np.zeros(dim)
        for i, h in enumerate(problem.hypers):
            stated[i] = h.prior.coordinate(start[h.name]) if h.name in start else 0.0
        candidates = [stated, *candidates]

    def climb_from(starts: Sequence[np.ndarray], x: np.ndarray) -> _Summit:
        return _climb(problem, starts, x, flat, xtol, coarse_below, near)

    select_highest = partial(max, key=attrgetter("value"))
    top = climb_from(candidates if dim else candidates[:1], x)
    if starts is None:
        # The density of factors of a product a·b is symmetric under (a, b) → (−a, −b): try the mirrored mode too.
        promoted = np.array([h.kind == "promoted" for h in problem.hypers], dtype=bool)
        if promoted.any():
            top = select_highest(top, climb_from([np.where(promoted, -top.v, top.v)], x))
        for grid in scan_ragged(problem, top.v):  # multimodal in these shapes
            top = select_highest(top, climb_from([*grid], top.x))
    return fit_at_mode(top.density, top.v, top.change, top.x, top.value > coarse_below)


def _find_start(problem: Problem) -> Float[np.ndarray, "p"]:
    """Return the starting point of x̂: its prior mean, or for three axes a fit by `Vector.with_directions`."""
    record, start = problem.record, problem.start
    vector = record.instrument.vector
    projected = None if vector is None else vector.with_directions(record.frame, record.y)
    if projected is None:
        return start
    record, centre = Record(record.instrument, *projected), np.zeros(len(problem.hypers))
    auxiliary = Problem(problem.layout, record, problem.size_factors)
    return mode_of_x(auxiliary, start, centre, flat_scales(auxiliary, start, centre))


def flat_scales(
    problem: Problem, x: Float[np.ndarray, "p"], v: Float[np.ndarray, "d"]
) -> Float[np.ndarray, "p"]:
    """Return the scale of each coefficient with a flat prior, 1 for all others (p,)."""
    if problem.weight_of_x.all():
        return np.ones(problem.size)
    return column_scale(problem.linearise(x, problem.hyper(v)).jacobian)


class _Summit(NamedTuple):
    """Result of one maximisation of the marginal density of φ."""

    value: float  # the log density there
    change: float  # in the last round
    v: np.ndarray
    x: np.ndarray
    density: Density  # of φ, about x


def _climb(
    problem: Problem,
    starts: Sequence[np.ndarray],
    x: np.ndarray,
    flat: np.ndarray,
    xtol: float,
    coarse_below: float,
    near: Nearby | None,
) -> _Summit:
    """Maximise the density of φ from the best of some starting points.

    Each round maximises the density linearised about x̂ given φ; its step is shortened until the density relinearised at
    the new x̂ increases.
    """
    # A step of `xtol` standard deviations changes the log density by about xtol²/2.
    min_gain = max(MIN_GAIN_NATS, 0.5 * xtol**2)
    # The Hessian at the mode is more sensitive to its location than the density.
    ftol = max(CONVERGED_NATS, 0.1 * min_gain)
    density = Density(problem, x, flat, starts[0], like=near)
    # The linearisation of an affine output is exact: one maximisation, no alternation.
    if problem.affine:
        v = climb(density, best_start(density, starts), coarse_below, ftol)
        value, conditional = density.condition_at(v)
        return _Summit(value, 0.0, v, x if conditional is None else conditional.mean, density)
    v, change = best_start(density, starts), math.inf
    density, value = _expand_about(problem, x, v, flat, xtol, near)
    for _ in range(MAX_ROUNDS):
        target = climb(density, v, coarse_below, ftol)
        for _ in range(MAX_HALVINGS):
            trial, height = _expand_about(problem, density.x, target, flat, xtol, density.nearby)
            if height > value - min_gain:
                break
            target = v + 0.3 * (target - v)
        else:
            break
        change = float(np.max(np.abs(target - v), initial=0.0))
        v, density, value = target, trial, height
        if change < xtol:
            break
    return _Summit(value, change, v, density.x, density)


def best_start(density: Density, starts: Sequence[np.ndarray]) -> np.ndarray:
    """Return the coordinate with the highest density."""
    index = int(np.argmax(density.values(np.array(starts)))) if len(starts) > 1 else 0
    return starts[index]


def _expand_about(
    problem: Problem,
    x: np.ndarray,
    v: np.ndarray,
    flat: np.ndarray,
    xtol: float,
    like: Nearby | None,
) -> tuple[Density, float]:
    """Return the density of φ linearised about x̂ given v, and its log value at v."""
    density = Density(problem, mode_of_x(problem, x, v, flat, xtol), flat, v, like=like)
    return density, density.condition_at(v)[0]


def scan_ragged(problem: Problem, v: np.ndarray) -> list[Float[np.ndarray, "k d"]]:
    """Return a grid of coordinates along each shape with a multimodal density (`Shape.ragged`)."""
    names, grids = problem.layout.index_in_phi, []
    shapes = ((e, s) for e in problem.layout.model.effects for s in e.column_shapes if s.ragged)
    for e, s in shapes:
        if (name := e.shape_name(s)) in names:
            grids.append(np.tile(v, (len(SCAN_GRID), 1)))
            grids[-1][:, names[name]] = SCAN_GRID
    return grids


def prior_draws(problem: Problem) -> list[np.ndarray]:
    """Return starting points: the prior median of φ, and 64 draws from a 1.5 times wider prior. Deterministic."""
    dim = len(problem.hypers)
    draws = 1.5 * np.random.default_rng(0).standard_normal((STARTS, dim))
    return [np.zeros(dim), *draws]


def mode_of_x(
    problem: Problem,
    x: Float[np.ndarray, "p"],
    v: np.ndarray,
    flat: np.ndarray,
    xtol: float = XTOL_SD,
) -> Float[np.ndarray, "p"]:
    """Find x̂ given φ by Gauss–Newton on residuals and prior, with step halving.

    The variance from noisy inputs is fixed within a step: minimising squares with a variance that depends on x favours
    steep slopes (effective variance: J. Orear, Am. J. Phys. 50 (1982) 912).
    """
    hyper = problem.hyper(v)
    prior = problem.prior(hyper, flat)

    def evaluate(at: np.ndarray, extra: Any = None) -> tuple[float, Conditional | None]:
        density = Density(problem, at, flat, input_variance=extra)
        gram = density.gram(v, hyper)
        if not math.isfinite(gram.rtr + gram.logdet):
            return math.inf, None
        # Sum of squares at the point itself, not at the minimum of the linear model.
        z = prior.weight * (at - prior.mean) / np.where(prior.sd > 0, prior.sd, 1.0)
        at_point = condition(gram, problem.record.size, prior, at)
        return density.rss(hyper, gram) + float(z @ z), at_point

    squares, conditional = evaluate(x)
    for _ in range(50):
        if conditional is None:
            return x
        target, fraction = conditional.mean, 1.0
        # Converged if a full Gauss–Newton step is below 0.1·xtol posterior standard deviations.
        sd = np.sqrt(np.diag(conditional.covariance)) + 1e-300
        if np.max(np.abs((target - x) / sd), initial=0.0) < 0.1 * xtol:
            return x
        extra = problem.extra(problem.linearise(x, hyper)) if problem.noisy else None
        for _ in range(MAX_HALVINGS):
            trial = x + fraction * (target - x)
            trial_squares, conditional = evaluate(trial, extra)
            if trial_squares <= squares or not math.isfinite(squares):
                break
            fraction *= 0.5
        else:
            return x
        decrease, squares, x = squares - trial_squares, trial_squares, trial
        if problem.noisy:
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

    `change`: of the last round, standard deviations. `exact`: compute the Hessian, instead of a BFGS estimate.
    """
    x = density.x if x is None else x
    spreads = np.array([kind == "group_sd" for kind in density.problem.kinds], dtype=bool)
    fit = gaussian_fit(density, v, spreads, exact)
    if fit.log_density <= NOWHERE:
        fit = fit._replace(log_evidence=-math.inf, indefinite=True)
        change = math.inf
    at_v = fit.covariance, fit.log_density, fit.log_evidence
    return Mode(x, v, *at_v, change, density.flat, fit.indefinite)
