"""Every addition and every pair at once, in closed form, at a structure's φ̂: in which order moves are tried.

A score is the log Bayes factor of a linear model that was fitted before; what it says is only where to look. The
answer is always a refit's.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp, ndtri
from scipy.stats import qmc

from bayescal._discovery.structures import SIZES, Structures, Weighed
from bayescal._engine.closed_form import Density
from bayescal._engine.linear_model import LinearModel, linear_model
from bayescal._engine.record import ColumnsOf, Record
from bayescal._model.coefficient import Shape
from bayescal._model.effect import Effect
from bayescal._model.parameters import Layout
from bayescal._readings.unit_conversion import coefficient_factor

SHAPE_POINTS = 7  # of one shape, at the middles of equal parts of its prior
SEVERAL_SHAPES = 32  # of several at once, a Sobol sequence
RAGGED_SHAPES = 128  # where the evidence has many maxima over one of them
LEVELS = 5  # of a learned spread, of an amplitude
HINTS = 2  # grid points at which a refit begins
IN_PAIRS = 2  # grid points of each candidate that are tried in pairs


@dataclass(frozen=True, eq=False)
class Scored:
    """One candidate at one point of its shapes, at the likeliest size there.

    Attributes:
        effect: canonical name.
        gain: log Bayes factor by score, averaged over sizes.
        hint: coordinates of φ by name, to begin a refit at.
        shapes: by name, in their units.
        sd: prior standard deviations of its columns at the likeliest size.
        columns: whitened (n, k), in output units per reported unit.
        u, information: score and information after the nuisances, in the same units.
        weight: of the grid point.
    """

    effect: str
    gain: float
    hint: dict[str, float]
    shapes: dict[str, float]
    sd: Float[np.ndarray, "k"]
    columns: Float[np.ndarray, "n k"]
    u: Float[np.ndarray, "k"]
    information: Float[np.ndarray, "k k"]
    before: Float[np.ndarray, "k"]
    weight: float = 1.0
    levels: tuple[np.ndarray, ...] = field(default_factory=tuple)


def scores(structures: Structures, at: Weighed, names: Sequence[str]) -> dict[str, list[Scored]]:
    """Every grid point of these candidates, each candidate's most probable first."""
    line = linear_model(at.assembly, at.mode)
    found = {}
    for name in names:
        effect = structures.candidates[name]
        points = [_scored(structures, line, effect, v) for v in _grid(effect.column_shapes)]
        found[name] = sorted(points, key=lambda p: -p.gain)
    return found


def gain_of(points: Sequence[Scored]) -> float:
    """A candidate's log Bayes factor by score, averaged over its grid."""
    return float(logsumexp([p.gain for p in points]) - math.log(len(points)))


def pairs(found: dict[str, list[Scored]], line: LinearModel) -> list[tuple[float, Scored, Scored]]:
    """Log Bayes factors of two candidates at once, the best first."""
    points = [p for own in found.values() for p in own[:IN_PAIRS]]
    if not points:
        return []
    inside = [line.projected(p.columns * p.sd) for p in points]
    made = []
    for (i, a), (j, b) in itertools.combinations(enumerate(points), 2):
        if a.effect != b.effect:
            cross = (a.columns * a.sd).T @ (b.columns * b.sd) - inside[i].T @ inside[j]
            own = [p.sd[:, None] * p.information * p.sd for p in (a, b)]
            whole = np.block([[own[0], cross], [cross.T, own[1]]])
            u = np.concatenate([a.sd * a.u, b.sd * b.u])
            made.append((log_bayes_factor(u, whole, line), a, b))
    return sorted(made, key=lambda m: -m[0])


def log_bayes_factor(u: np.ndarray, information: np.ndarray, line: LinearModel) -> float:
    """Of columns with standard normal coefficients, the size of the noise as likely as it then is."""
    inner = information + np.eye(len(u))
    try:
        chol = np.linalg.cholesky(inner)
    except np.linalg.LinAlgError:
        return -math.inf
    half = np.linalg.solve(chol, u)
    taken = min(float(half @ half) / line.rest, 1 - 1e-12)
    return -float(np.sum(np.log(np.diag(chol)))) - 0.5 * line.size * math.log1p(-taken)


def _scored(structures: Structures, line: LinearModel, effect: Effect, v: np.ndarray) -> Scored:
    named = {s.name: float(s.prior.value(one)) for s, one in zip(effect.column_shapes, v, strict=True)}
    columns, at = line.columns_of(structures.layout, effect, named)
    u = columns.T @ line.white_residual
    inside = line.projected(columns)
    own = columns.T @ columns
    information = own - inside.T @ inside
    sizes = _sizes(effect, at)
    gains = [
        log_bayes_factor(sd * u, sd[:, None] * information * sd, line) + log_weight
        for sd, _, log_weight in sizes
    ]
    best = int(np.argmax(gains))
    hint = {effect.shape_name(s): float(one) for s, one in zip(effect.column_shapes, v, strict=True)}
    return Scored(
        effect=effect.name,
        gain=float(logsumexp(gains)),
        hint={**hint, **sizes[best][1]},
        shapes=named,
        sd=sizes[best][0],
        columns=columns,
        u=u,
        information=information,
        before=np.diag(own),
        levels=tuple(sd for sd, *_ in sizes),
    )


def _sizes(
    effect: Effect, at: Sequence[tuple[int, int]]
) -> list[tuple[np.ndarray, dict[str, float], float]]:
    """Prior standard deviations of an effect's columns, coordinates that stand for them, and log probabilities.

    Args:
        effect: whose.
        at: for each coefficient, where its columns begin and end.
    """
    width = at[-1][1]
    plain = np.zeros(width)
    for (low, high), c in zip(at, effect.coefficients, strict=True):
        plain[low:high] = c.size
    levels = (np.arange(LEVELS) + 0.5) / LEVELS
    if effect.weights is not None:
        made = []
        scales = [s for s in effect.shapes if s.name in effect.weight_shapes]
        for v in itertools.product(ndtri(levels), repeat=len(scales)):
            named = {s.name: float(s.prior.value(one)) for s, one in zip(scales, v, strict=True)}
            weights = np.broadcast_to(effect.weights(**named), (len(effect.coefficients),))
            hint = {effect.shape_name(s): float(one) for s, one in zip(scales, v, strict=True)}
            made.append((plain * weights, hint, -len(scales) * math.log(LEVELS)))
        return made
    learned = [(i, c) for i, c in enumerate(effect.coefficients) if c.spread is not None]
    if learned:
        made = []
        for z in ndtri(0.5 + 0.5 * levels):  # a half-normal's quantiles
            sd = plain.copy()
            for i, _ in learned:
                sd[slice(*at[i])] *= z
            hint = {f"{effect.coefficient_name(i)}.spread": math.log(z) for i, _ in learned}
            made.append((sd, hint, -math.log(LEVELS)))
        return made
    return [(plain * factor, {}, math.log(p)) for factor, p in SIZES.items()]


def _grid(shapes: Sequence[Shape]) -> np.ndarray:
    """Coordinates of shapes (points, shapes), equally probable under their priors."""
    count = len(shapes)
    if count == 0:
        return np.zeros((1, 0))
    if count == 1 and not shapes[0].ragged:
        return ndtri((np.arange(SHAPE_POINTS) + 0.5) / SHAPE_POINTS)[:, None]
    if count == 1:
        return ndtri((np.arange(RAGGED_SHAPES) + 0.5) / RAGGED_SHAPES)[:, None]
    points = RAGGED_SHAPES if any(s.ragged for s in shapes) else SEVERAL_SHAPES
    return ndtri(qmc.Sobol(count, scramble=True, rng=0).random(points))
