"""All candidates as columns: at points of their shapes, at plausible sizes, the same for every structure."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from bayescal._core import deadline
from bayescal._inference.linear_model import LinearModel
from bayescal._inference.means import Means
from bayescal._model.composition import expand_members
from bayescal._model.effect import Coefficient, Effect, Shape
from bayescal._model.instrument import factor_of
from bayescal._model.terms import ColumnSpec, Correction
from bayescal._search.structures import SIZE_FACTORS, Structures

SHAPE_POINTS = 7  # of one shape, at the middles of equal parts of its prior
SEVERAL_SHAPES = 32  # of several at once, a Sobol sequence
SOBOL = Path(__file__).with_name("sobol.npz")
RAGGED_SHAPES = 128  # where the evidence has many maxima over one of them
# Of candidates' columns, held at once; those of more are made each time.
HELD_NUMBERS = 2**23
BLOCK_NUMBERS = 2**20  # that are whitened together
ACTING_STEP = 0.05  # of a shape that acts on them, prior standard deviations, which no score feels
LEVELS = 4  # of a learned spread, of an amplitude
MEANS = 8192  # by which candidates are looked over on longer records
LOST = 0.01  # of the variance of a candidate's column, which may be within means
KEPT_EFFECTS = 1024  # whose grids and sizes are kept: devices of a fleet have the same


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
    at: slice  # its columns among all
    index: int  # among the candidate's points


@dataclass(eq=False)
class Library:
    """All candidates at all points of their shapes, with their sizes: the same for every structure.

    Candidates that correct a column are not among them: they have no columns of their own to be scored by.
    """

    structures: Structures
    # for some candidates alone, the coordinates of their shapes (points, shapes); none for all at usual ones
    grids: Mapping[str, Float[np.ndarray, "points shapes"]] = field(default_factory=dict)
    points: dict[str, list[GridPoint]] = field(default_factory=dict)  # of each candidate
    sizes: dict[str, list[Size]] = field(default_factory=dict)  # of each candidate
    width: int = 0  # columns in all
    # candidates that change within means: they are scored by all readings
    blurred: frozenset[str] = frozenset()
    _means: Means | None = None
    _columns: dict[str, dict[bool, tuple[Any, ...]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        counts = dict(self.structures.layout.counts)
        for name, effect in self.structures.candidates.items():
            if (self.grids and name not in self.grids) or self.structures.moves_a_column(name):
                continue
            widths = tuple(_members(c, counts) for c in effect.coefficients)
            self.sizes[name] = _sizes(effect, widths)
            # Uneven where the channels of a unit ask along a shape that they share, else of equal prior mass.
            grid = _at(effect, self.grids[name]) if self.grids else _usual_grid(effect)
            self.points[name] = []
            for i, (shapes, hint) in enumerate(grid):
                at = slice(self.width, self.width + sum(widths))
                self.points[name].append(GridPoint(name, shapes, hint, at, i))
                self.width += sum(widths)

    def grouped(self, name: str) -> bool:
        """Return whether a candidate's size is shared by many coefficients: a learned spread, or an amplitude."""
        effect = self.structures.candidates[name]
        return effect.is_placeholder or effect.coefficients[0].group_sd is not None

    def on_means(self, line: LinearModel) -> LinearModel:
        """Return a linear model of a long record as one of means, by which candidates are looked over."""
        count = line.size // MEANS
        if count < 2:
            return line
        if self._means is None:
            self._means = Means.from_record(self.structures.record, count)
            for name, points in self.points.items():
                columns = self.columns(line, _at_ends(points), {})
                if np.max(self._means.within_fraction(columns)) > LOST:
                    self.blurred |= {name}
        return self._means.linear_model(line)

    def blocks(self, size: int) -> Iterator[list[GridPoint]]:
        """Yield all points, those apart that need all readings: as many as have columns of a length held together."""
        for needed, names in itertools.groupby(self.points, lambda name: name in self.blurred):
            block, rows = list[GridPoint](), self.structures.record.size if needed else size
            for point in itertools.chain.from_iterable(self.points[name] for name in names):
                if block and (point.at.stop - block[0].at.start) * rows > BLOCK_NUMBERS:
                    yield block
                    block = []
                block.append(point)
            yield block

    def columns(
        self,
        line: LinearModel,
        points: Iterable[GridPoint],
        acting: Mapping[Correction, tuple[float, ...]],
    ) -> Float[np.ndarray, "n k"]:
        """Return ∂μ/∂θ at some points, output unit per reported unit, by the slopes of a linear model.

        What depends on a column that is corrected is of the corrected one, such as the temperature of a body.
        """
        parts, size = [], line.problem.record.size
        for name, candidate_points in itertools.groupby(points, lambda p: p.effect):
            deadline.current().ask()
            parts.append(self._along(line, name, list(candidate_points), acting).reshape(-1, size))
        return parts[0].T if len(parts) == 1 else np.concatenate([*parts, np.empty((0, size))]).T

    def _along(
        self,
        line: LinearModel,
        name: str,
        points: list[GridPoint],
        acting: Mapping[Correction, tuple[float, ...]],
    ) -> Float[np.ndarray, "points k n"]:
        """Return a candidate's columns at some of its points; of a short record all are cached.

        As measured, and beside the latest correction.
        """
        record, instrument = line.problem.record, self.structures.base.instrument
        effect, counts = self.structures.candidates[name], dict(self.structures.layout.counts)
        # Chain rule: the output by the slot, and the slot by the coefficient (a factor of units, and the basis).
        by_slot = np.array([line.slopes[c.slot or effect.slot] for c in effect.coefficients])
        needed, cached = self._needed(name, acting), self._columns.get(name, {})
        if entry := cached.get(bool(needed)):
            same = entry[0] is record and entry[1] == needed
            if same and np.array_equal(entry[2], by_slot):
                return entry[3][[p.index for p in points]]
        is_small = self.width * record.size <= HELD_NUMBERS
        needed_points = self.points[name] if is_small else points
        at = np.transpose([[*p.shapes.values()] for p in needed_points])
        spec = ColumnSpec.from_effect(effect).with_corrections([*needed])
        bases = record.columns_of_draws(spec, [*at, *itertools.chain(*needed.values())], {})
        bases = bases[None] if bases.ndim == 2 else bases
        ends = np.cumsum([0, *(_members(c, counts) for c in effect.coefficients)])
        columns = np.empty((len(bases), ends[-1], record.size))
        for i, c in enumerate(effect.coefficients):
            slope = by_slot[i] * factor_of(instrument, effect, c)
            codes, members = None if c.per is None else record.codes[c.per], slice(*ends[i : i + 2])
            spread = expand_members(slope * bases[..., i], codes, members.stop - members.start)
            columns[:, members] = np.moveaxis(spread, -1, 1)
        if not is_small:
            return columns
        self._columns.setdefault(name, {})[bool(needed)] = record, needed, by_slot, columns
        return columns[[p.index for p in points]]

    def _needed(
        self, name: str, acting: Mapping[Correction, tuple[float, ...]]
    ) -> dict[Correction, tuple[float, ...]]:
        """Return the corrections of columns that a candidate depends on, with their shapes on a grid.

        Structures that find nearly the same share what is scored beside them.
        """
        columns = self.structures.candidates[name].columns
        return {c: _nearby(c, at) for c, at in acting.items() if c.column in columns}


def _at_ends(points: Sequence[GridPoint]) -> list[GridPoint]:
    """Return those of a candidate's points at which a shape is smallest or largest."""
    along = np.array([[*p.shapes.values()] for p in points])
    ends = {*along.argmin(axis=0), *along.argmax(axis=0)} if along.size else {0}
    return [points[i] for i in sorted(ends)]


def _nearby(correction: Correction, at: tuple[float, ...]) -> tuple[float, ...]:
    """Return a correction's shapes, rounded to even steps of their coordinates."""
    pairs = zip(correction.spec.priors, at, strict=True)
    return tuple(
        float(p.value(round(p.coordinate(x) / ACTING_STEP) * ACTING_STEP)) for p, x in pairs
    )


def _members(coefficient: Coefficient, counts: Mapping[str, int]) -> int:
    return 1 if coefficient.per is None else counts[coefficient.per]


@lru_cache(KEPT_EFFECTS)
def _sizes(effect: Effect, widths: tuple[int, ...]) -> list[Size]:
    """Return plausible sizes of an effect whose coefficients have so many columns each."""
    at = np.cumsum([0, *widths])
    plain = np.zeros(at[-1])
    for i, c in enumerate(effect.coefficients):
        plain[at[i] : at[i + 1]] = c.size
    levels = (np.arange(LEVELS) + 0.5) / LEVELS
    if effect.weights is not None:
        scales = [s for s in effect.shapes if s.name in effect.weight_shapes]
        sizes = []
        # Of an amplitude and a length: a grid at the middles of equal parts of their priors, each point as probable.
        for v in itertools.product(ndtri(levels), repeat=len(scales)):
            pairs = [*zip(scales, map(float, v), strict=True)]
            named = {s.name: float(s.prior.value(c)) for s, c in pairs}
            weights = np.broadcast_to(effect.weights(**named), (len(effect.coefficients),))
            hint = {effect.shape_name(s): c for s, c in pairs}
            sizes.append(Size(plain * weights, hint, named, -len(scales) * math.log(LEVELS)))
        return sizes
    learned = [i for i, c in enumerate(effect.coefficients) if c.group_sd is not None]
    of_spread = np.repeat([c.group_sd is not None for c in effect.coefficients], np.diff(at))
    spreads = ndtri(0.5 + 0.5 * levels) if learned else np.ones(1)  # a half-normal's quantiles
    factors = {1.0: 1.0} if of_spread.all() else SIZE_FACTORS
    return [
        Size(
            plain * np.where(of_spread, z, factor),
            {effect.group_sd_name(i): math.log(z) for i in learned},
            {},
            math.log(p / len(spreads)),
        )
        for z in spreads
        for factor, p in factors.items()
    ]


# Shapes by their own names; coordinates by the full ones.
Place = tuple[dict[str, float], dict[str, float]]


def _at(effect: Effect, grid: np.ndarray) -> list[Place]:
    """Return an effect's shapes, and coordinates of φ, at coordinates of the shapes (points, shapes)."""
    shapes, count = effect.column_shapes, len(grid)
    names, full = [s.name for s in shapes], [effect.shape_name(s) for s in shapes]
    pairs = zip(shapes, grid.T, strict=True)
    values = np.transpose([s.prior.value(v) for s, v in pairs]).reshape(count, -1)
    return [
        (dict(zip(names, row, strict=True)), dict(zip(full, v, strict=True)))
        for row, v in zip(values.tolist(), grid.tolist(), strict=True)
    ]


@lru_cache(KEPT_EFFECTS)
def _usual_grid(effect: Effect) -> list[Place]:
    return _at(effect, _grid(effect.column_shapes))


def _grid(shapes: Sequence[Shape]) -> np.ndarray:
    """Return coordinates of shapes (points, shapes), equally probable under their priors."""
    if not shapes:
        return np.zeros((1, 0))
    count = SHAPE_POINTS if len(shapes) == 1 else SEVERAL_SHAPES
    count = RAGGED_SHAPES if any(s.ragged for s in shapes) else count
    if len(shapes) == 1:
        # Φ⁻¹ of the middles of equal parts: shapes are standard normal in their coordinates, so each point stands for
        # the same prior mass, and the mean over points is the integral over the prior.
        return ndtri((np.arange(count) + 0.5) / count)[:, None]
    return ndtri(sobol_points(len(shapes))[:count])


def sobol_points(count: int) -> Float[np.ndarray, "k count"]:
    """Return scrambled Sobol points of a dimension, always the same; those of two and three from a file."""
    with np.load(SOBOL) as tables:  # SciPy's take half a second to load
        if str(count) in tables:
            return tables[str(count)]
    from scipy.stats import qmc

    return qmc.Sobol(count, scramble=True, rng=0).random(RAGGED_SHAPES)
