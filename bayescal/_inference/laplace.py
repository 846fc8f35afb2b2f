"""The mode of a structure: x̂ given φ̂ by Gauss–Newton, φ̂ by marginal likelihood, in turn; and its Laplace evidence.

The joint mode of coefficients and spreads would run to a spread of zero; the mode of φ with x integrated out does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from operator import attrgetter
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from bayescal._core.parallel import on_one_thread
from bayescal._inference.density import NOWHERE, Density
from bayescal._inference.gaussian import LOG_2PI, Conditional, column_scale, condition
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.terms import ColumnsOf

STILL_SD = 1e-4  # standard deviations that a round moves anything by, below which the mode is found
ROUNDS = 12  # alternations of x̂ and φ̂ at most
STARTS = 64  # prior draws of φ among which the start is chosen,
AHEAD = np.arange(-3.5, 3.5, 0.02)  # where along a shape of many maxima a higher one may be
HALVINGS = 8  # of a step that makes things worse
CURVED, LEAST_CURVATURE = 1e-3, 0.05  # step for the curvature; the least that counts as one
SPREAD_SHARE = (
    0.1  # of a direction's squared length beside spreads, up to which it is one of spreads
)
STEP_VARIANCE, FINEST = 0.1, 1e-5  # of a step's square over the variance there, at most; of a step
CLIMB, LONGEST_STEP_SD = 100, 1.5  # steps uphill at most; the longest, in prior standard deviations
NOTHING_KNOWN: Mapping[str, float] = MappingProxyType({})
NOTHING_LEFT = 1e-8  # log density that a step would gain, below which φ̂ is found,
ROUGHLY = 0.01  # and where nothing hangs on it


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
    covariance: np.ndarray | None = None,
    x: Float[np.ndarray, "p"] | None = None,
    still: float = STILL_SD,
    curved: bool = True,
    start: Mapping[str, float] = NOTHING_KNOWN,
    wanted_from: float = -math.inf,
) -> Mode:
    """The mode, from the best of some coordinates of φ. Deterministic.

    Args:
        problem: the structure on its record.
        starts: coordinates to begin at; prior draws if not given. The most probable is taken.
        covariance: what the Gaussian fit at the mode may look like; the climb is shorter for it.
        x: where x̂ may be; its prior mean, or what directions of an ellipsoid give, if not given.
        still: standard deviations that a round moves anything by, below which the mode is found. The log evidence is
            off by about half their square.
        curved: whether the Gaussian fit there is asked for too; without, its covariance is the climb's guess.
        start: φ by name where the mode may be, a start beside the prior draws; what it does not name is at its prior's
            middle.
        wanted_from: log density, below which a mode found to a hundredth of a nat will do.
    """
    x, dim = _start(problem) if x is None else x, len(problem.hypers)
    flat = flat_scales(problem, x, np.zeros(dim))
    wanted = prior_draws(problem) if starts is None else list(starts)
    if starts is None and problem.kinds == ["noise"]:  # one hill
        wanted = wanted[:5]
    if start:
        known = np.zeros(dim)
        for i, h in enumerate(problem.hypers):
            known[i] = h.prior.coordinate(start[h.name]) if h.name in start else 0.0
        wanted = [known, *wanted]

    def climbed(starts: Sequence[np.ndarray], x: np.ndarray) -> _Summit:
        return _climbed(problem, starts, covariance, x, flat, still, wanted_from)

    highest = partial(max, key=attrgetter("value"))
    top = climbed(wanted if dim else wanted[:1], x)
    if starts is None:
        # A product a·b is that of −a and −b: its density has two hills, and which one the prior draws met was chance.
        promoted = np.array([h.kind == "promoted" for h in problem.hypers], dtype=bool)
        if promoted.any():  # of a product both factors may have the other sign
            top = highest(top, climbed([np.where(promoted, -top.v, top.v)], x))
        for along in across(problem, top.v):  # and one of many maxima may be higher
            top = highest(top, climbed([*along], top.x))
    if not curved and top.value > NOWHERE:
        return Mode(top.x, top.v, top.wide, top.value, top.value, top.change, flat, False)
    density = top.density
    if density is None:
        density = Density(problem, top.x, flat, top.v)
    return at_mode(density, top.v, top.change, top.x)


def _start(problem: Problem) -> Float[np.ndarray, "p"]:
    """Where x̂ may be, nothing known: at its prior mean, or of three axes as `Vector.with_directions` has it."""
    record, start = problem.record, problem.start
    vector = record.instrument.vector
    known = None if vector is None else vector.with_directions(record.frame, record.y)
    if known is None:
        return start
    there = Problem(problem.layout, Record(record.instrument, *known), problem.size_factors)
    middle = np.zeros(len(problem.hypers))
    return mode_of_x(there, start, middle, flat_scales(there, start, middle))


def flat_scales(
    problem: Problem, x: Float[np.ndarray, "p"], v: Float[np.ndarray, "d"]
) -> Float[np.ndarray, "p"]:
    """Scales of the coefficients with flat priors; one for others."""
    if problem.weight_of_x.all():
        return np.ones(problem.size)
    return column_scale(problem.linearise(x, problem.hyper(v)).jacobian)


class _Summit(NamedTuple):
    """Where a climb ended."""

    value: float  # the log density there
    change: float  # in the last round
    v: np.ndarray
    x: np.ndarray
    wide: np.ndarray | None
    density: Density | None = None  # of φ there, where it is the one that was climbed


def _climbed(
    problem: Problem,
    starts: Sequence[np.ndarray],
    covariance: np.ndarray | None,
    x: np.ndarray,
    flat: np.ndarray,
    still: float,
    wanted_from: float,
) -> _Summit:
    """The mode of φ from the best of some starts.

    Each round climbs the density about x̂ given φ, and must raise it about the next x̂. Otherwise it goes part of the
    way: rounds that lost again what they had gained could go in circles.
    """
    # A step of `still` standard deviations gains about still²/2 nats.
    nothing = max(NOTHING_LEFT, 0.5 * still**2)
    density = Density(problem, x, flat, starts[0])
    # Where the output is affine the linearisation is exact wherever it is made: one climb, no alternation.
    if problem.affine:
        v, wide = climb(density, starts, covariance, nothing, wanted_from)
        value, found = density.at(v)
        return _Summit(value, 0.0, v, x if found is None else found.mean, wide, density)
    v = starts[int(np.argmax(density.values(np.array(starts))))] if len(starts) > 1 else starts[0]
    density, value = _about_x(problem, x, v, flat, still)
    change, wide = math.inf, covariance
    for _ in range(ROUNDS):
        goal, wide = climb(density, [v], wide, nothing, wanted_from)
        for _ in range(HALVINGS):
            there, higher = _about_x(problem, density.x, goal, flat, still)
            if higher > value - nothing:
                break
            goal = v + 0.3 * (goal - v)
        else:
            break
        change = float(np.max(np.abs(goal - v), initial=0.0))
        v, density, value = goal, there, higher
        if change < still:
            break
    return _Summit(value, change, v, density.x, wide)


def _about_x(
    problem: Problem, x: np.ndarray, v: np.ndarray, flat: np.ndarray, still: float
) -> tuple[Density, float]:
    """The density of φ about x̂ given φ, and its value there."""
    density = Density(problem, mode_of_x(problem, x, v, flat, still), flat, v)
    return density, density.at(v)[0]


def across(problem: Problem, v: np.ndarray) -> list[Float[np.ndarray, "k d"]]:
    """For each shape whose evidence has many maxima: coordinates along it, all else as it is."""
    names, made = problem.layout.index_in_phi, []
    shapes = ((e, s) for e in problem.layout.model.effects for s in e.column_shapes if s.ragged)
    for e, s in shapes:
        if (name := e.shape_name(s)) in names:
            made.append(np.tile(v, (len(AHEAD), 1)))
            made[-1][:, names[name]] = AHEAD
            if len(e.column_shapes) == 1:
                values = [float(s.prior.value(one)) for one in AHEAD]
                problem.record.keep_along(ColumnsOf.of(e), values)
    return made


def climb(
    density: Density,
    starts: Sequence[np.ndarray],
    covariance: np.ndarray | None,
    nothing: float = NOTHING_LEFT,
    wanted_from: float = -math.inf,
) -> tuple[np.ndarray, np.ndarray]:
    """φ̂ of a density, uphill by BFGS from the best of some coordinates, and the covariance of a Gaussian fit there.

    Args:
        density: of φ.
        starts: coordinates.
        covariance: first guess of the inverse curvature.
        nothing: what counts as nothing to gain, nats.
        wanted_from: log density, below which a hundredth of a nat does.
    """
    dim = len(starts[0])
    if not dim:
        return starts[0], np.zeros((0, 0))
    v = starts[int(np.argmax(density.values(np.array(starts))))] if len(starts) > 1 else starts[0]
    wide = 0.1 * np.eye(dim)
    if covariance is not None and np.all(np.isfinite(covariance)):
        wide = covariance
    value, slope = density.slope(v)
    for _ in range(CLIMB):
        step = wide @ slope
        # Beyond a step or two of the prior's width the slope here says nothing of the density there.
        step *= min(1.0, LONGEST_STEP_SD / max(float(np.max(np.abs(step))), 1e-300))
        gain = float(slope @ step)
        if not gain > (nothing if value > wanted_from else ROUGHLY):
            break
        for _ in range(HALVINGS):
            there, next_slope = density.slope(v + step)
            # Sufficient increase: some of what the slope promised (J. Nocedal and S. Wright, Numerical Optimization,
            # 2006, eq. 3.4).
            if there >= value + 1e-4 * gain:
                break
            step, gain = 0.3 * step, 0.3 * gain
        else:
            break
        turned = slope - next_slope
        # BFGS of the inverse curvature (same, eq. 6.17): H becomes (I − s·gᵀ/sᵀg)·H·(I − g·sᵀ/sᵀg) + s·sᵀ/sᵀg, s the
        # step and g what the slope lost on it. Positive definite only where the density bends down on the way, sᵀg >
        # 0.
        if (bend := float(step @ turned)) > 1e-12:
            left = np.eye(dim) - np.outer(step, turned) / bend
            wide = left @ wide @ left.T + np.outer(step, step) / bend
        v, value, slope = v + step, there, next_slope
    return v, wide


def prior_draws(problem: Problem) -> list[np.ndarray]:
    """Where the mode may be looked for: the middle of φ's prior, and draws half as wide again. Deterministic."""
    dim = len(problem.hypers)
    draws = 1.5 * np.random.default_rng(0).standard_normal((STARTS, dim))
    return [np.zeros(dim), *draws]


def mode_of_x(
    problem: Problem,
    x: Float[np.ndarray, "p"],
    v: np.ndarray,
    flat: np.ndarray,
    still: float = STILL_SD,
) -> Float[np.ndarray, "p"]:
    """x̂ given φ: Gauss–Newton on the residuals and the prior's, each step halved until the sum falls.

    What noise on inputs adds to the variance is held on each step: were it to fall with the residuals, the largest
    slopes would win (effective variance: J. Orear, Am. J. Phys. 50 (1982) 912).
    """
    hyper = problem.hyper(v)
    prior = problem.prior(hyper, flat)

    def look(at: np.ndarray, extra: Any = None) -> tuple[float, Conditional | None]:
        density = Density(problem, at, flat, held=extra)
        gram = density.gram(v, hyper)
        if not math.isfinite(gram.rtr + gram.logdet):
            return math.inf, None
        # Squares at the point itself, not at the linear model's minimum.
        z = prior.weight * (at - prior.mean) / np.where(prior.sd > 0, prior.sd, 1.0)
        found = condition(gram, problem.record.size, prior, at)
        return density.squares(hyper, gram) + float(z @ z), found

    squares, found = look(x)
    for _ in range(50):
        if found is None:
            return x
        goal, share = found.mean, 1.0
        # At rest where a whole Gauss–Newton step moves nothing by a tenth of `still` posterior standard deviations.
        width = np.sqrt(np.diag(found.covariance)) + 1e-300
        if np.max(np.abs((goal - x) / width), initial=0.0) < 0.1 * still:
            return x
        extra = problem.extra(problem.linearise(x, hyper)) if problem.noisy else None
        for _ in range(HALVINGS):
            trial = x + share * (goal - x)
            there, found = look(trial, extra)
            if there <= squares or not math.isfinite(squares):
                break
            share *= 0.5
        else:
            return x
        gain, squares, x = squares - there, there, trial
        if problem.noisy:
            squares, found = look(x)
        elif share == 1.0 and gain < still**2:
            return x
    return x


def at_mode(
    density: Density,
    v: np.ndarray,
    change: float,
    x: Float[np.ndarray, "p"] | None = None,
    quick: bool = False,
) -> Mode:
    """The Gaussian fit of φ at its mode, and the Laplace evidence.

    Args:
        density: of φ.
        v: its mode.
        change: of the last round, in standard deviations.
        x: x̂ there; the density's own if not given.
        quick: whether curvatures by differences on one side will do, which are a thousandth off.
    """
    value, found = density.at(v)
    x = density.x if x is None else x
    if found is None:
        nothing = np.full((len(v), len(v)), np.nan)
        return Mode(x, v, nothing, NOWHERE, -math.inf, math.inf, density.flat, True)
    mode = Mode(x, v, np.zeros((0, 0)), value, value, change, density.flat, False)
    if not len(v):
        return mode
    spreads = np.array([kind == "group_sd" for kind in density.problem.kinds])
    covariance, volume, indefinite = gaussian_fit(density, v, quick, spreads)
    return mode._replace(covariance=covariance, log_evidence=value + volume, indefinite=indefinite)


def with_fit(problem: Problem, mode: Mode) -> Mode:
    """A mode whose Gaussian fit was not made, with it; its curvatures are by differences on one side."""
    density = Density(problem, mode.x, mode.flat, mode.v)
    return at_mode(density, mode.v, mode.change, quick=True)


def gaussian_fit(
    density: Density,
    v: np.ndarray,
    quick: bool = False,
    spreads: Bool[np.ndarray, "d"] | bool = False,
) -> tuple[np.ndarray, float, bool]:
    """Covariance of the Gaussian fit at a mode, its log volume, and whether the curvature had to be mended.

    Where it is that of `spreads` alone, which lies flat on the way to zero, it does not count as mended.
    """
    # Laplace: log ∫p ≈ log p(φ̂) + ½·d·log 2π − ½·log|H|, H minus the curvature of log p at φ̂ (L. Tierney and J.
    # Kadane, JASA 81 (1986) 82).
    here = density.slope(v)[1] if quick else None
    bends = curvature(lambda at: density.slope(at)[1], v, CURVED, here)
    if not np.all(
        np.isfinite(bends)
    ):  # a step away the density is nowhere: no hill that a Gaussian describes
        return np.full_like(bends, np.nan), -math.inf, True
    weights, vectors = np.linalg.eigh(bends)
    # Coordinates are about standard normal a priori, so that H is of order one or more. Less than a twentieth is no
    # hill but the flank of one, such as a spread's way to zero: mended, its proposals stay finite.
    mended = np.maximum(weights, LEAST_CURVATURE)
    covariance = (vectors / mended) @ vectors.T
    covariance = 0.5 * (covariance + covariance.T)
    volume = 0.5 * len(v) * LOG_2PI - 0.5 * float(np.sum(np.log(mended)))
    # That of a spread alone says no more than that it may be zero.
    share = np.sum(vectors[~np.broadcast_to(spreads, len(v))] ** 2, axis=0)
    return covariance, volume, bool(np.any((weights < LEAST_CURVATURE) & (share > SPREAD_SHARE)))


def curvature(
    slope: Callable[[np.ndarray], np.ndarray],
    v: Float[np.ndarray, "d"],
    step: float,
    here: Float[np.ndarray, "d"] | None = None,
) -> Float[np.ndarray, "d d"]:
    """Negative curvature of a log density, from slopes on both sides of a point.

    Prior and readings may know a coordinate to a millionth of each other: a step is small against what the density
    lets it be moved by, or made smaller.

    Args:
        slope: of the log density.
        v: the point.
        step: of a coordinate, at most.
        here: the slope there, if it and one side will do.
    """
    rows = []
    for unit in np.eye(len(v)):
        size = step
        while True:
            before = slope(v - size * unit) if here is None else here
            row = (before - slope(v + size * unit)) / (size if here is not None else 2 * size)
            # row·unit is the curvature κ along the coordinate: κ·size² is the squared step in standard deviations of
            # the density.
            if abs(float(row @ unit)) * size**2 < STEP_VARIANCE or size < step * FINEST:
                break
            size *= 0.1
        rows.append(row)
    found = np.array(rows)
    return 0.5 * (found + found.T)
