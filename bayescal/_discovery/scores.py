"""Every addition and every pair at once, in closed form, at a structure's φ̂: in which order moves are tried.

A score is the log Bayes factor of a linear model that was fitted before; what it says is only where to look. The
answer is always a refit's.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dtrtrs
from scipy.special import logsumexp, ndtri
from scipy.stats import qmc

from bayescal._discovery.structures import SIZES, Structures, Weighed
from bayescal._engine.blas import on_one_thread
from bayescal._engine.linear_model import linear_model
from bayescal._engine.record import ColumnsOf
from bayescal._model.coefficient import Coefficient, Shape
from bayescal._model.effect import Effect
from bayescal._readings.unit_conversion import coefficient_factor

SHAPE_POINTS = 7  # of one shape, at the middles of equal parts of its prior
SEVERAL_SHAPES = 32  # of several at once, a Sobol sequence
RAGGED_SHAPES = 128  # where the evidence has many maxima over one of them
LEVELS = 4  # of a learned spread, of an amplitude
HINTS = 2  # grid points at which a refit begins
IN_PAIRS = 2  # grid points of each candidate that are tried in pairs


class Size(NamedTuple):
    """One plausible size of an effect: standard deviations of its columns, what stands for them in φ, a probability."""

    sd: Float[np.ndarray, "k"]
    hint: dict[str, float]
    scales: dict[str, float]  # shapes that it is made of, in their units
    log_weight: float


class GridPoint(NamedTuple):
    """One candidate at one point of its shapes."""

    effect: str
    shapes: dict[str, float]
    hint: dict[str, float]
    basis: Float[np.ndarray, "n c"]
    at: slice  # its columns among all


@dataclass(eq=False)
class Library:
    """All candidates at all points of their shapes, with their sizes: the same for every structure.

    Attributes:
        points: of each candidate.
        sizes: of each candidate.
        width: columns in all.
    """

    structures: Structures
    points: dict[str, list[GridPoint]] = field(default_factory=dict)
    sizes: dict[str, list[Size]] = field(default_factory=dict)
    width: int = 0
    _columns: np.ndarray | None = None

    def __post_init__(self) -> None:
        record, counts = self.structures.record, dict(self.structures.layout.counts)
        for name, effect in self.structures.candidates.items():
            of, width = ColumnsOf.of(effect), [_members(c, counts) for c in effect.coefficients]
            self.sizes[name] = _sizes(effect, np.cumsum([0, *width]))
            self.points[name] = []
            for v in _grid(effect.column_shapes):
                values = [
                    float(s.prior.value(x)) for s, x in zip(effect.column_shapes, v, strict=True)
                ]
                named = [effect.shape_name(s) for s in effect.column_shapes]
                self.points[name].append(
                    GridPoint(
                        name,
                        dict(zip(of.shapes, values, strict=True)),
                        dict(zip(named, v.tolist(), strict=True)),
                        record.columns(of, tuple(values)),
                        slice(self.width, self.width + sum(width)),
                    )
                )
                self.width += sum(width)

    def grouped(self, name: str) -> bool:
        """Whether a candidate's size is that of many coefficients together: learned, or an amplitude."""
        effect = self.structures.candidates[name]
        return effect.is_placeholder or effect.coefficients[0].spread is not None

    def columns(self, slopes: Mapping[str, np.ndarray]) -> Float[np.ndarray, "n P"]:
        """∂μ/∂θ of all, output unit per reported unit, where the output has these slopes by the slots."""
        if self._columns is not None and self.structures.record.affine is not None:
            return self._columns
        record, instrument = self.structures.record, self.structures.base.instrument
        made = np.zeros((record.size, self.width), order="F")
        for name, points in self.points.items():
            effect, at = self.structures.candidates[name], 0
            for i, c in enumerate(effect.coefficients):
                slot = instrument.slot(c.slot or effect.slot)
                slope = slopes[slot.name] * coefficient_factor(c.unit, slot.unit)
                codes = None if c.per is None else record.codes[c.per]
                for p in points:
                    column = slope * p.basis[:, i]
                    if codes is None:
                        made[:, p.at.start + at] = column
                    else:
                        known = np.flatnonzero(codes >= 0)
                        made[known, p.at.start + at + codes[known]] = column[known]
                at += _members(c, dict(self.structures.layout.counts))
        self._columns = made
        return made


@dataclass(frozen=True, eq=False)
class Scored:
    """One candidate at one point of its shapes, at the likeliest size there.

    Attributes:
        point: which.
        gain: log Bayes factor by score, averaged over sizes.
        size: the likeliest.
        columns: whitened (n, k), in output units per reported unit.
        inside: what the nuisances take of them (q, k).
        u: score after the nuisances.
    """

    point: GridPoint
    gain: float
    size: Size
    columns: Float[np.ndarray, "n k"]
    inside: Float[np.ndarray, "q k"]
    u: Float[np.ndarray, "k"]

    @property
    def effect(self) -> str:
        return self.point.effect

    @property
    def hint(self) -> dict[str, float]:
        """Coordinates of φ by name, to begin a refit at."""
        return {**self.point.hint, **self.size.hint}

    @property
    def information(self) -> Float[np.ndarray, "k k"]:
        return self.columns.T @ self.columns - self.inside.T @ self.inside


class View:
    """A structure as a linear model about its mode, all candidates beside it: what may be added, dropped, exchanged.

    Everything is products that are computed once; the readings are not looked at again.
    """

    @on_one_thread
    def __init__(self, library: Library, at: Weighed):
        line = linear_model(at.assembly, at.mode)
        self.library, self.at, self.line = library, at, line
        self.columns = line.whiten(library.columns(line.slopes))
        nuisance, z = line.white_nuisance, line.z
        self.inner = nuisance.T @ nuisance
        self.cross = nuisance.T @ self.columns
        self.of_start = (
            self.inner @ z + line.weight * z
        )  # N'r₀, r₀ with nuisances at their prior's mean
        self.u_start = self.columns.T @ line.white_residual + self.cross.T @ z
        self.squares = line.rest + float(self.of_start @ z)
        self.volume = 0.0
        self.volume = self.without().volume

    def without(self, *names: str) -> Rest:
        """What is left where some of its effects are dropped, φ held."""
        kept = np.array([owner not in names for owner in self.line.owners], dtype=bool)
        inner = self.inner[np.ix_(kept, kept)] + np.diag(self.line.weight[kept])
        chol = np.linalg.cholesky(inner + 1e-12 * np.diag(np.diag(inner)))
        half = solve_triangular(chol, self.of_start[kept], lower=True)
        inside = solve_triangular(chol, self.cross[kept], lower=True)
        return Rest(
            view=self,
            inside=inside,
            u=self.u_start - inside.T @ half,
            rest=self.squares - float(half @ half),
            volume=float(np.sum(np.log(np.diag(chol)))),
        )


class Rest(NamedTuple):
    """What of the readings and of all candidates' columns some nuisances leave.

    inside (q, P): what they take of the columns; u (P,): score; rest: sum of squares; volume: Σ log of the factor.
    """

    view: View
    inside: Float[np.ndarray, "q P"]
    u: Float[np.ndarray, "P"]
    rest: float
    volume: float

    @on_one_thread
    def scores(self, names: Sequence[str]) -> dict[str, list[Scored]]:
        """Every grid point of these candidates, each candidate's most probable first."""
        library = self.view.library
        found = {name: [self._scored(p) for p in library.points[name]] for name in names}
        return {name: sorted(own, key=lambda s: -s.gain) for name, own in found.items()}

    def _scored(self, point: GridPoint) -> Scored:
        columns, inside, u = (
            self.view.columns[:, point.at],
            self.inside[:, point.at],
            self.u[point.at],
        )
        information = columns.T @ columns - inside.T @ inside
        sizes = self.view.library.sizes[point.effect]
        gains = [
            self.gain(s.sd * u, s.sd[:, None] * information * s.sd) + s.log_weight for s in sizes
        ]
        best = int(np.argmax(gains))
        return Scored(point, float(logsumexp(gains)), sizes[best], columns, inside, u)

    @property
    def dropped(self) -> float:
        """Log Bayes factor of what is left against the whole structure."""
        return self.gain(np.zeros(0), np.zeros((0, 0)))

    def gain(self, u: np.ndarray, information: np.ndarray) -> float:
        """Log Bayes factor, against the whole structure, of what is left with columns of standard normal coefficients.

        The noise is taken as large as it then is likely to be.
        """
        if not len(u):
            volume, taken = 0.0, 0.0
        elif len(u) == 1:
            volume, taken = 0.5 * math.log1p(information[0, 0]), u[0] ** 2 / (1 + information[0, 0])
        else:
            chol, failed = dpotrf(information + np.eye(len(u)), lower=1)
            if failed:
                return -math.inf
            half = dtrtrs(chol, u, lower=1)[0]
            volume, taken = float(np.sum(np.log(chol.diagonal()))), float(half @ half)
        # Of the squares that the noise was as large as, not of those that a dropped effect leaves.
        left = max((self.rest - taken) / self.view.line.rest, 1e-12)
        return self.lost - volume - 0.5 * self.view.line.size * math.log(left)

    @property
    def lost(self) -> float:
        """What dropping did to the volumes: part of every gain, beside the squares."""
        return self.view.volume - self.volume

    @on_one_thread
    def pairs(self, found: Mapping[str, list[Scored]]) -> list[tuple[float, Scored, Scored]]:
        """Log Bayes factors of two candidates at once, the best first."""
        points = [p for own in found.values() for p in own[:IN_PAIRS]]
        own = [p.size.sd[:, None] * p.information * p.size.sd for p in points]
        made = []
        for (i, a), (j, b) in itertools.combinations(enumerate(points), 2):
            if a.effect != b.effect:
                shared = a.columns.T @ b.columns - a.inside.T @ b.inside
                cross = a.size.sd[:, None] * shared * b.size.sd
                whole = np.block([[own[i], cross], [cross.T, own[j]]])
                u = np.concatenate([a.size.sd * a.u, b.size.sd * b.u])
                made.append((self.gain(u, whole), a, b))
        return sorted(made, key=lambda m: -m[0])


def gain_of(points: Sequence[Scored]) -> float:
    """A candidate's log Bayes factor by score, averaged over its grid."""
    return float(logsumexp([p.gain for p in points]) - math.log(len(points)))


def _members(coefficient: Coefficient, counts: Mapping[str, int]) -> int:
    return 1 if coefficient.per is None else counts[coefficient.per]


def _sizes(effect: Effect, at: np.ndarray) -> list[Size]:
    """Plausible sizes of an effect whose coefficients' columns begin at these places."""
    plain = np.zeros(at[-1])
    for i, c in enumerate(effect.coefficients):
        plain[at[i] : at[i + 1]] = c.size
    levels = (np.arange(LEVELS) + 0.5) / LEVELS
    if effect.weights is not None:
        scales = [s for s in effect.shapes if s.name in effect.weight_shapes]
        made = []
        for v in itertools.product(ndtri(levels), repeat=len(scales)):
            named = {s.name: float(s.prior.value(one)) for s, one in zip(scales, v, strict=True)}
            weights = np.broadcast_to(effect.weights(**named), (len(effect.coefficients),))
            hint = {effect.shape_name(s): float(one) for s, one in zip(scales, v, strict=True)}
            made.append(Size(plain * weights, hint, named, -len(scales) * math.log(LEVELS)))
        return made
    learned = [i for i, c in enumerate(effect.coefficients) if c.spread is not None]
    if learned:
        made = []
        for z in ndtri(0.5 + 0.5 * levels):  # a half-normal's quantiles
            sd = plain.copy()
            for i in learned:
                sd[at[i] : at[i + 1]] *= z
            hint = {f"{effect.coefficient_name(i)}.spread": math.log(z) for i in learned}
            made.append(Size(sd, hint, {}, -math.log(LEVELS)))
        return made
    return [Size(plain * factor, {}, {}, math.log(p)) for factor, p in SIZES.items()]


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
