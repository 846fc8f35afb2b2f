"""The mode of a structure: x̂ given φ̂ by Gauss–Newton, φ̂ by marginal likelihood, and the Laplace approximation there.

The joint mode of coefficients and spreads would run to a spread of zero; the mode of φ with x integrated out does not.
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

XTOL_SD = 1e-4  # standard deviations that a round moves anything by, below which the mode is found
MAX_ROUNDS = 12  # alternations of x̂ and φ̂ at most
STARTS = 64  # prior draws of φ among which the start is chosen,
AHEAD = np.arange(-3.5, 3.5, 0.02)  # where along a shape of many maxima a higher one may be
HALVINGS = 8  # of a step that makes things worse
NOTHING_KNOWN: Mapping[str, float] = MappingProxyType({})
MIN_GAIN_NATS = 1e-8  # log density that a round gains, below which φ̂ is found


class Mode(NamedTuple):
    """φ̂ with x̂ at it, and the Gaussian fit of φ's coordinates there."""

    x: Any  # (p,)
    v: Any  # (d,)
    covariance: Any  # (d, d)
    log_density: Any  # log p(y, φ̂), x integrated out
    log_evidence: Any  # Laplace
    change: Any  # of the last round, in standard deviations
    flat: Any  # (p,)
    indefinite: Any  # whether the curvature had to be mended


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
    """Find the mode, from the best of some coordinates of φ. Deterministic.

    Args:
        starts: coordinates, of which the most probable is begun at; prior draws if not given.
        x: where x̂ may be; its prior mean, or what directions of an ellipsoid give, if not given.
        xtol: standard deviations that a round moves anything by, below which the mode is found: the log evidence is
            off by about half their square.
        start: φ by name where the mode may be, beside the prior draws; others are at their priors' middle.
        coarse_below: log density, below which a mode found to a hundredth of a nat will do.
        near: the curvature of a density that is much alike.
    """
    x, dim = _start(problem) if x is None else x, len(problem.hypers)
    flat = flat_scales(problem, x, np.zeros(dim))
    candidates = prior_draws(problem) if starts is None else list(starts)
    if starts is None and problem.kinds == ["noise"]:  # one hill
        candidates = candidates[:5]
    if start:
        stated = np.zeros(dim)
        for i, h in enumerate(problem.hypers):
            stated[i] = h.prior.coordinate(start[h.name]) if h.name in start else 0.0
        candidates = [stated, *candidates]

    def climbed(starts: Sequence[np.ndarray], x: np.ndarray) -> _Summit:
        return _climbed(problem, starts, x, flat, xtol, coarse_below, near)

    highest = partial(max, key=attrgetter("value"))
    top = climbed(candidates if dim else candidates[:1], x)
    if starts is None:
        # A product a·b is that of −a and −b: its density has two hills, and which one the prior draws met was chance.
        promoted = np.array([h.kind == "promoted" for h in problem.hypers], dtype=bool)
        if promoted.any():  # of a product both factors may have the other sign
            top = highest(top, climbed([np.where(promoted, -top.v, top.v)], x))
        for along in across(problem, top.v):  # and one of many maxima may be higher
            top = highest(top, climbed([*along], top.x))
    return at_mode(top.density, top.v, top.change, top.x, top.value > coarse_below)


def _start(problem: Problem) -> Float[np.ndarray, "p"]:
    """Return where x̂ may be: its prior mean, or for three axes that of `Vector.with_directions`."""
    record, start = problem.record, problem.start
    vector = record.instrument.vector
    directed = None if vector is None else vector.with_directions(record.frame, record.y)
    if directed is None:
        return start
    record, middle = Record(record.instrument, *directed), np.zeros(len(problem.hypers))
    problem_there = Problem(problem.layout, record, problem.size_factors)
    return mode_of_x(problem_there, start, middle, flat_scales(problem_there, start, middle))


def flat_scales(
    problem: Problem, x: Float[np.ndarray, "p"], v: Float[np.ndarray, "d"]
) -> Float[np.ndarray, "p"]:
    """Return scales of the coefficients with flat priors; one for others."""
    if problem.weight_of_x.all():
        return np.ones(problem.size)
    return column_scale(problem.linearise(x, problem.hyper(v)).jacobian)


class _Summit(NamedTuple):
    """Where a climb ended."""

    value: float  # the log density there
    change: float  # in the last round
    v: np.ndarray
    x: np.ndarray
    density: Density  # of φ there


def _climbed(
    problem: Problem,
    starts: Sequence[np.ndarray],
    x: np.ndarray,
    flat: np.ndarray,
    xtol: float,
    coarse_below: float,
    near: Nearby | None,
) -> _Summit:
    """Find the mode of φ from the best of some starts.

    Each round climbs the density about x̂ given φ, and must raise it about the next x̂. Otherwise it goes part of the
    way: rounds that lost again what they had gained could go in circles.
    """
    # A step of `xtol` standard deviations gains about xtol²/2 nats.
    least_gain = max(MIN_GAIN_NATS, 0.5 * xtol**2)
    # The curvature at a point hangs more on where that is than the density does.
    ftol = max(CONVERGED_NATS, 0.01 * least_gain)
    density = Density(problem, x, flat, starts[0], like=near)
    # Where the output is affine the linearisation is exact wherever it is made: one climb, no alternation.
    if problem.affine:
        v = climb(density, best(density, starts), coarse_below, ftol)
        value, conditional = density.at(v)
        return _Summit(value, 0.0, v, x if conditional is None else conditional.mean, density)
    v, change = best(density, starts), math.inf
    density, value = _about_x(problem, x, v, flat, xtol, near)
    for _ in range(MAX_ROUNDS):
        goal = climb(density, v, coarse_below, ftol)
        for _ in range(HALVINGS):
            trial, higher = _about_x(problem, density.x, goal, flat, xtol, density.nearby)
            if higher > value - least_gain:
                break
            goal = v + 0.3 * (goal - v)
        else:
            break
        change = float(np.max(np.abs(goal - v), initial=0.0))
        v, density, value = goal, trial, higher
        if change < xtol:
            break
    return _Summit(value, change, v, density.x, density)


def best(density: Density, starts: Sequence[np.ndarray]) -> np.ndarray:
    """Return the most probable of some coordinates."""
    index = int(np.argmax(density.values(np.array(starts)))) if len(starts) > 1 else 0
    return starts[index]


def _about_x(
    problem: Problem,
    x: np.ndarray,
    v: np.ndarray,
    flat: np.ndarray,
    xtol: float,
    like: Nearby | None,
) -> tuple[Density, float]:
    """Return the density of φ about x̂ given φ, and its value there."""
    density = Density(problem, mode_of_x(problem, x, v, flat, xtol), flat, v, like=like)
    return density, density.at(v)[0]


def across(problem: Problem, v: np.ndarray) -> list[Float[np.ndarray, "k d"]]:
    """Return a grid of coordinates along each shape whose evidence has many maxima."""
    names, grids = problem.layout.index_in_phi, []
    shapes = ((e, s) for e in problem.layout.model.effects for s in e.column_shapes if s.ragged)
    for e, s in shapes:
        if (name := e.shape_name(s)) in names:
            grids.append(np.tile(v, (len(AHEAD), 1)))
            grids[-1][:, names[name]] = AHEAD
    return grids


def prior_draws(problem: Problem) -> list[np.ndarray]:
    """Return starting points: the middle of φ's prior, and draws half as wide again. Deterministic."""
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

    What noise on inputs adds to the variance is held on each step: were it to fall with the residuals, the largest
    slopes would win (effective variance: J. Orear, Am. J. Phys. 50 (1982) 912).
    """
    hyper = problem.hyper(v)
    prior = problem.prior(hyper, flat)

    def look(at: np.ndarray, extra: Any = None) -> tuple[float, Conditional | None]:
        density = Density(problem, at, flat, input_variance=extra)
        gram = density.gram(v, hyper)
        if not math.isfinite(gram.rtr + gram.logdet):
            return math.inf, None
        # Squares at the point itself, not at the linear model's minimum.
        z = prior.weight * (at - prior.mean) / np.where(prior.sd > 0, prior.sd, 1.0)
        at_point = condition(gram, problem.record.size, prior, at)
        return density.squares(hyper, gram) + float(z @ z), at_point

    squares, conditional = look(x)
    for _ in range(50):
        if conditional is None:
            return x
        goal, share = conditional.mean, 1.0
        # At rest where a whole Gauss–Newton step moves nothing by a tenth of `xtol` posterior standard deviations.
        width = np.sqrt(np.diag(conditional.covariance)) + 1e-300
        if np.max(np.abs((goal - x) / width), initial=0.0) < 0.1 * xtol:
            return x
        extra = problem.extra(problem.linearise(x, hyper)) if problem.noisy else None
        for _ in range(HALVINGS):
            trial = x + share * (goal - x)
            trial_squares, conditional = look(trial, extra)
            if trial_squares <= squares or not math.isfinite(squares):
                break
            share *= 0.5
        else:
            return x
        gain, squares, x = squares - trial_squares, trial_squares, trial
        if problem.noisy:
            squares, conditional = look(x)
        elif share == 1.0 and gain < xtol**2:
            return x
    return x


def at_mode(
    density: Density,
    v: np.ndarray,
    change: float,
    x: Float[np.ndarray, "p"] | None = None,
    exact: bool = True,
) -> Mode:
    """Return the Gaussian fit of φ at its mode, and the Laplace evidence.

    The last round moved it by `change` standard deviations. `exact`: a curvature that is about right will not do.
    """
    x = density.x if x is None else x
    spreads = np.array([kind == "group_sd" for kind in density.problem.kinds], dtype=bool)
    fit = gaussian_fit(density, v, spreads, exact)
    if fit.log_density <= NOWHERE:
        fit = fit._replace(log_evidence=-math.inf, indefinite=True)
        change = math.inf
    at_v = fit.covariance, fit.log_density, fit.log_evidence
    return Mode(x, v, *at_v, change, density.flat, fit.indefinite)
