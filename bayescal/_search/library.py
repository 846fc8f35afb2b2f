"""All candidates as columns: at points of their shapes, at plausible sizes, the same for every structure."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from bayescal._model.composition import by_member
from bayescal._model.effect import Coefficient, Effect, Shape
from bayescal._model.instrument import factor_of
from bayescal._model.terms import ColumnsOf
from bayescal._search.structures import SIZE_FACTORS, Structures

SHAPE_POINTS = 7  # of one shape, at the middles of equal parts of its prior
SEVERAL_SHAPES = 32  # of several at once, a Sobol sequence
RAGGED_SHAPES = 128  # where the evidence has many maxima over one of them
LEVELS = 4  # of a learned spread, of an amplitude


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

    Candidates that correct a column are not among them: they have no columns of their own to be scored by.

    Attributes:
        grids: for some candidates alone, the coordinates of their shapes (points, shapes); none for all at usual ones.
        points: of each candidate.
        sizes: of each candidate.
        width: columns in all.
    """

    structures: Structures
    grids: Mapping[str, Float[np.ndarray, "points shapes"]] = field(default_factory=dict)
    points: dict[str, list[GridPoint]] = field(default_factory=dict)
    sizes: dict[str, list[Size]] = field(default_factory=dict)
    width: int = 0
    _columns: np.ndarray | None = None

    def __post_init__(self) -> None:
        record, counts = self.structures.record, dict(self.structures.layout.counts)
        for name, effect in self.structures.candidates.items():
            if (self.grids and name not in self.grids) or self.structures.moves_a_column(name):
                continue
            of, width = ColumnsOf.of(effect), [_members(c, counts) for c in effect.coefficients]
            self.sizes[name] = _sizes(effect, np.cumsum([0, *width]))
            self.points[name] = []
            # Uneven where the channels of a unit ask along a shape that they share, else of equal prior mass.
            grid = self.grids[name] if self.grids else _grid(effect.column_shapes)
            own = effect.column_shapes
            each = [[float(s.prior.value(x)) for s, x in zip(own, v, strict=True)] for v in grid]
            bases = record.columns_of_draws(of, [*np.transpose(each)], {}) if own else None
            for i, v in enumerate(grid.tolist()):
                shapes = {s.name: value for s, value in zip(own, each[i], strict=True)}
                hint = {effect.shape_name(s): x for s, x in zip(own, v, strict=True)}
                basis = record.columns(of, ()) if bases is None else bases[i]
                at = slice(self.width, self.width + sum(width))
                self.points[name].append(GridPoint(name, shapes, hint, basis, at))
                self.width += sum(width)

    def grouped(self, name: str) -> bool:
        """Whether a candidate's size is that of many coefficients together: learned, or an amplitude."""
        effect = self.structures.candidates[name]
        return effect.is_placeholder or effect.coefficients[0].group_sd is not None

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
                # Chain rule: the output by the slot, and the slot by the coefficient (a factor of units, and the
                # basis).
                slope = slopes[slot.name] * factor_of(instrument, effect, c)
                codes = None if c.per is None else record.codes[c.per]
                size = _members(c, dict(self.structures.layout.counts))
                for p in points:
                    start = p.at.start + at
                    made[:, start : start + size] = by_member(
                        np, slope * p.basis[:, i], codes, size
                    )
                at += size
        self._columns = made
        return made


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
        # Of an amplitude and a length: a grid at the middles of equal parts of their priors, each point as probable.
        for v in itertools.product(ndtri(levels), repeat=len(scales)):
            named = {s.name: float(s.prior.value(one)) for s, one in zip(scales, v, strict=True)}
            weights = np.broadcast_to(effect.weights(**named), (len(effect.coefficients),))
            hint = {effect.shape_name(s): float(one) for s, one in zip(scales, v, strict=True)}
            made.append(Size(plain * weights, hint, named, -len(scales) * math.log(LEVELS)))
        return made
    learned = [i for i, c in enumerate(effect.coefficients) if c.group_sd is not None]
    if learned:
        made = []
        for z in ndtri(0.5 + 0.5 * levels):  # a half-normal's quantiles
            sd = plain.copy()
            for i in learned:
                sd[at[i] : at[i + 1]] *= z
            hint = {f"{effect.coefficient_name(i)}.group_sd": math.log(z) for i in learned}
            made.append(Size(sd, hint, {}, -math.log(LEVELS)))
        return made
    return [Size(plain * factor, {}, {}, math.log(p)) for factor, p in SIZE_FACTORS.items()]


def _grid(shapes: Sequence[Shape]) -> np.ndarray:
    """Coordinates of shapes (points, shapes), equally probable under their priors."""
    count = len(shapes)
    if count == 0:
        return np.zeros((1, 0))
    if count == 1 and not shapes[0].ragged:
        # Φ⁻¹ of the middles of equal parts: shapes are standard normal in their coordinates, so each point stands for
        # the same prior mass, and the mean over points is the integral over the prior.
        return ndtri((np.arange(SHAPE_POINTS) + 0.5) / SHAPE_POINTS)[:, None]
    if count == 1:
        return ndtri((np.arange(RAGGED_SHAPES) + 0.5) / RAGGED_SHAPES)[:, None]
    points = RAGGED_SHAPES if any(s.ragged for s in shapes) else SEVERAL_SHAPES
    from scipy.stats import qmc  # a second, for shapes of which no catalogue effect has several

    return ndtri(qmc.Sobol(count, scramble=True, rng=0).random(points))
