"""Columns of all candidates on grids of their shapes and prior scales, the same for every structure."""

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
from bayescal._model.instrument import compute_factor
from bayescal._model.terms import ColumnSpec, Correction
from bayescal._search.structures import SIZE_FACTORS, Structures

SHAPE_POINT_COUNT = 7  # grid points of one shape, at the middles of equal parts of its prior
SOBOL_POINT_COUNT = 32  # grid points of several shapes, a Sobol sequence
SOBOL = Path(__file__).with_name("sobol.npz")
RAGGED_POINT_COUNT = 128  # grid points where the evidence has many maxima over a shape
# Numbers in all candidates' columns up to which they are cached; larger columns are computed each time.
MAX_CACHED_NUMBERS = 2**23
MAX_BLOCK_NUMBERS = 2**20  # numbers in the columns whitened at a time
CORRECTION_STEP_SD = 0.05  # to which a correction's shapes are rounded, prior standard deviations
SPREAD_LEVELS = 4  # grid points of a between-group standard deviation or an amplitude
MEANS_COUNT = 8192  # means of readings by which candidates are scored on longer records
MAX_VARIANCE_SHARE = 0.01  # largest share of a column's variance within the means
CACHED_EFFECTS = 1024  # effects with cached grids and scales: devices of a fleet share them

Corrections = Mapping[Correction, tuple[float, ...]]  # corrections of columns, with their shapes
# Shapes in their units by their own names; their coordinates by full names.
ShapeValues = tuple[dict[str, float], dict[str, float]]


class PriorScale(NamedTuple):
    """A scale of an effect's prior, with the log of its prior probability (`log_weight`)."""

    sd: Float[np.ndarray, "k"]  # prior standard deviations of the coefficients
    start: dict[str, float]  # coordinates of φ at this scale, by name
    shapes: dict[str, float]  # shapes that determine the scale, in their units
    log_weight: float


class GridPoint(NamedTuple):
    """A candidate at one point of the grid of its shapes."""

    name: str  # of the candidate
    shapes: dict[str, float]  # values of the shapes, in their units
    start: dict[str, float]  # coordinates of the shapes, by full name
    block: slice  # indices of its columns among those of all points
    index: int  # among the candidate's points


@dataclass(eq=False)
class Library:
    """All candidates on the grids of their shapes, with their prior scales.

    Candidates that correct a column have no columns of their own, hence no grid and no score.
    """

    structures: Structures
    # shape coordinates (points, shapes) of the candidates to include; empty: all candidates, on default grids
    grids: Mapping[str, Float[np.ndarray, "points shapes"]] = field(default_factory=dict)
    points: dict[str, list[GridPoint]] = field(default_factory=dict)  # grid of each candidate
    prior_scales: dict[str, list[PriorScale]] = field(default_factory=dict)  # of each candidate
    column_count: int = 0  # of all candidates at all points
    # candidates that vary within means, scored by all readings
    unaveraged: frozenset[str] = frozenset()
    _means: Means | None = None
    cached_columns: dict[str, dict[bool, tuple[Any, ...]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        counts = dict(self.structures.layout.counts)
        for name, effect in self.structures.candidates.items():
            if (self.grids and name not in self.grids) or self.structures.corrects_column(name):
                continue
            widths = tuple(_count_members(c, counts) for c in effect.coefficients)
            self.prior_scales[name] = _list_prior_scales(effect, widths)
            # Given for a shape that the channels of a device share; otherwise points of equal prior mass.
            grid = _map_shapes(effect, self.grids[name]) if self.grids else _make_grid(effect)
            self.points[name] = []
            for i, (shapes, start) in enumerate(grid):
                block = slice(self.column_count, self.column_count + sum(widths))
                self.points[name].append(GridPoint(name, shapes, start, block, i))
                self.column_count += sum(widths)

    def is_grouped(self, name: str) -> bool:
        """Return whether a candidate has many coefficients with a common scale: standard deviation or amplitude."""
        effect = self.structures.candidates[name]
        return effect.is_placeholder or effect.coefficients[0].group_sd is not None

    def average(self, linear: LinearModel) -> LinearModel:
        """Return the linear model on means of readings, for scores on a long record; unchanged for a short one."""
        count = linear.size // MEANS_COUNT
        if count < 2:
            return linear
        if self._means is None:
            self._means = Means.from_record(self.structures.record, count)
            for name, points in self.points.items():
                columns = self.columns(linear, _find_extreme_points(points), {})
                if np.max(self._means.within_fraction(columns)) > MAX_VARIANCE_SHARE:
                    self.unaveraged |= {name}
        return self._means.linear_model(linear)

    def iterate_blocks(self, row_count: int) -> Iterator[list[GridPoint]]:
        """Yield all grid points in blocks whose columns, of `row_count` rows, fit in memory; unaveraged ones apart."""
        for needed, names in itertools.groupby(self.points, lambda name: name in self.unaveraged):
            block, rows = list[GridPoint](), self.structures.record.size if needed else row_count
            for point in itertools.chain.from_iterable(self.points[name] for name in names):
                if block and (point.block.stop - block[0].block.start) * rows > MAX_BLOCK_NUMBERS:
                    yield block
                    block = []
                block.append(point)
            yield block

    def columns(
        self, linear: LinearModel, points: Iterable[GridPoint], corrections: Corrections
    ) -> Float[np.ndarray, "n k"]:
        """Return the columns ∂μ/∂θ at given grid points, output unit per reported unit, by a linear model's gradients.

        A basis that depends on a corrected column, such as a body's temperature, is computed from the corrected values.
        """
        parts, size = [], linear.problem.record.size
        for name, candidate_points in itertools.groupby(points, lambda p: p.name):
            deadline.current().raise_if_over()
            columns = self._columns_at(linear, name, list(candidate_points), corrections)
            parts.append(columns.reshape(-1, size))
        return parts[0].T if len(parts) == 1 else np.concatenate([*parts, np.empty((0, size))]).T

    def _columns_at(
        self, linear: LinearModel, name: str, points: list[GridPoint], corrections: Corrections
    ) -> Float[np.ndarray, "points k n"]:
        """Return a candidate's columns at some of its grid points; those of a short record are cached at all points.

        The cache holds two sets: without corrections, and with the latest corrections.
        """
        record, instrument = linear.problem.record, self.structures.base.instrument
        effect, counts = self.structures.candidates[name], dict(self.structures.layout.counts)
        # Chain rule: derivative of the output with respect to the slot, times ∂slot/∂coefficient.
        slopes = np.array([linear.slopes[c.slot or effect.slot] for c in effect.coefficients])
        needed = self._list_relevant_corrections(name, corrections)
        if entry := self.cached_columns.get(name, {}).get(bool(needed)):
            is_same = entry[0] is record and entry[1] == needed
            if is_same and np.array_equal(entry[2], slopes):
                return entry[3][[p.index for p in points]]
        is_small = self.column_count * record.size <= MAX_CACHED_NUMBERS
        needed_points = self.points[name] if is_small else points
        shape_values = np.transpose([[*p.shapes.values()] for p in needed_points])
        spec = ColumnSpec.from_effect(effect).with_corrections([*needed])
        values = [*shape_values, *itertools.chain(*needed.values())]
        bases = record.columns_of_draws(spec, values, {})
        bases = bases[None] if bases.ndim == 2 else bases
        ends = np.cumsum([0, *(_count_members(c, counts) for c in effect.coefficients)])
        columns = np.empty((len(bases), ends[-1], record.size))
        for i, c in enumerate(effect.coefficients):
            slope = slopes[i] * compute_factor(instrument, effect, c)
            codes, members = None if c.per is None else record.codes[c.per], slice(*ends[i : i + 2])
            per_member = expand_members(slope * bases[..., i], codes, members.stop - members.start)
            columns[:, members] = np.moveaxis(per_member, -1, 1)
        if not is_small:
            return columns
        self.cached_columns.setdefault(name, {})[bool(needed)] = record, needed, slopes, columns
        return columns[[p.index for p in points]]

    def _list_relevant_corrections(self, name: str, corrections: Corrections) -> Corrections:
        """Return the corrections of the columns that a candidate depends on, with rounded shapes.

        Structures with nearly equal shapes then share cached columns.
        """
        columns = self.structures.candidates[name].columns
        return {c: _round_shapes(c, at) for c, at in corrections.items() if c.column in columns}


def _find_extreme_points(points: Sequence[GridPoint]) -> list[GridPoint]:
    """Return the grid points of a candidate at which one of its shapes has its minimum or maximum."""
    shapes = np.array([[*p.shapes.values()] for p in points])
    extreme_indices = {*shapes.argmin(axis=0), *shapes.argmax(axis=0)} if shapes.size else {0}
    return [points[i] for i in sorted(extreme_indices)]


def _round_shapes(correction: Correction, shapes: tuple[float, ...]) -> tuple[float, ...]:
    """Return a correction's shapes, rounded to multiples of a step in their coordinates."""
    pairs, step = zip(correction.spec.priors, shapes, strict=True), CORRECTION_STEP_SD
    return tuple(float(p.value(round(p.coordinate(x) / step) * step)) for p, x in pairs)


def _count_members(coefficient: Coefficient, counts: Mapping[str, int]) -> int:
    return 1 if coefficient.per is None else counts[coefficient.per]


@lru_cache(CACHED_EFFECTS)
def _list_prior_scales(effect: Effect, widths: tuple[int, ...]) -> list[PriorScale]:
    """Return the prior scales of an effect whose coefficients have `widths` columns each."""
    ends = np.cumsum([0, *widths])
    sd = np.zeros(ends[-1])
    for i, c in enumerate(effect.coefficients):
        sd[ends[i] : ends[i + 1]] = c.size
    prior_scales, levels = list[PriorScale](), (np.arange(SPREAD_LEVELS) + 0.5) / SPREAD_LEVELS
    if effect.weights is not None:
        shapes = [s for s in effect.shapes if s.name in effect.weight_shapes]
        log_weight = -len(shapes) * math.log(SPREAD_LEVELS)
        # Grid of an amplitude and a length at the middles of equal parts of their priors, all points equally probable.
        for v in itertools.product(ndtri(levels), repeat=len(shapes)):
            pairs = [*zip(shapes, map(float, v), strict=True)]
            shape_values = {s.name: float(s.prior.value(c)) for s, c in pairs}
            weights = np.broadcast_to(effect.weights(**shape_values), (len(effect.coefficients),))
            start = {effect.shape_name(s): c for s, c in pairs}
            prior_scales.append(PriorScale(sd * weights, start, shape_values, log_weight))
        return prior_scales
    indices = [i for i, c in enumerate(effect.coefficients) if c.group_sd is not None]
    is_spread = np.repeat([c.group_sd is not None for c in effect.coefficients], np.diff(ends))
    spreads = ndtri(0.5 + 0.5 * levels) if indices else np.ones(1)  # a half-normal's quantiles
    factors = {1.0: 1.0} if is_spread.all() else SIZE_FACTORS
    for z, (factor, p) in itertools.product(spreads, factors.items()):
        start = {effect.group_sd_name(i): math.log(z) for i in indices}
        scale_sd, log_weight = sd * np.where(is_spread, z, factor), math.log(p / len(spreads))
        prior_scales.append(PriorScale(scale_sd, start, {}, log_weight))
    return prior_scales


def _map_shapes(effect: Effect, grid: np.ndarray) -> list[ShapeValues]:
    """Return for each grid point (points, shapes) an effect's shapes in their units, and coordinates by full name."""
    shapes, count = effect.column_shapes, len(grid)
    names, full = [s.name for s in shapes], [effect.shape_name(s) for s in shapes]
    pairs = zip(shapes, grid.T, strict=True)
    values = np.transpose([s.prior.value(v) for s, v in pairs]).reshape(count, -1)
    rows = zip(values.tolist(), grid.tolist(), strict=True)
    return [(dict(zip(names, a, strict=True)), dict(zip(full, v, strict=True))) for a, v in rows]


@lru_cache(CACHED_EFFECTS)
def _make_grid(effect: Effect) -> list[ShapeValues]:
    return _map_shapes(effect, _build_shape_grid(effect.column_shapes))


def _build_shape_grid(shapes: Sequence[Shape]) -> np.ndarray:
    """Return a grid of shape coordinates (points, shapes), all points equally probable under the priors."""
    if not shapes:
        return np.zeros((1, 0))
    count = SHAPE_POINT_COUNT if len(shapes) == 1 else SOBOL_POINT_COUNT
    count = RAGGED_POINT_COUNT if any(s.ragged for s in shapes) else count
    if len(shapes) == 1:
        # Φ⁻¹ of the middles of equal parts: each point has the same prior mass, so that means are prior integrals.
        return ndtri((np.arange(count) + 0.5) / count)[:, None]
    return ndtri(load_sobol_points(len(shapes))[:count])


def load_sobol_points(dimension: int) -> Float[np.ndarray, "k d"]:
    """Return scrambled Sobol points (k, dimension), with a fixed seed; of two and three dimensions from a file."""
    with np.load(SOBOL) as tables:  # SciPy's take half a second to load
        if str(dimension) in tables:
            return tables[str(dimension)]
    from scipy.stats import qmc

    return qmc.Sobol(dimension, scramble=True, rng=0).random(RAGGED_POINT_COUNT)
