"""Candidate effects as columns: shapes and spreads laid out on a grid of their priors, priors scaled to one."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.special import ndtri
from scipy.stats import qmc

from bayescal._calibration.calibration import Calibration
from bayescal._core.jit import compiled
from bayescal._discovery.susie import Item
from bayescal._model import forward
from bayescal._model.coefficient import Coefficient
from bayescal._model.effect import Effect

SHAPE_POINTS = 7  # of one shape, at the middles of equal parts of its prior
SEVERAL_SHAPES = 32  # of several at once, a Sobol sequence
RAGGED_SHAPES = 128  # where the evidence has many maxima over one of them
WIDEST = 256  # columns of one candidate over all its grid points
SPREAD_POINTS = 7  # of a learned spread
UNKNOWN_SHARE = 0.1  # of the prior, for what no named effect describes


@dataclass(frozen=True)
class GridPoint:
    """One candidate at one point of its shapes and spreads: where its columns stand.

    `amplitude` is the learned spread of a group (`spread`: true), or the amplitude of an unknown dependence; None for
    single coefficients.
    """

    shapes: dict[str, float]
    amplitude: float | None
    spread: bool
    columns: tuple[int, ...]


@dataclass(frozen=True)
class Columns:
    """All candidates' columns side by side, in output units per prior standard deviation.

    Attributes:
        matrix: (n, P).
        items: for the sum of single effects.
        points: for each item, what it stands for.
        effects: the candidates, in order.
        prior: each candidate's share of the prior probability that something is missing.
    """

    matrix: np.ndarray
    items: tuple[Item, ...]
    points: tuple[GridPoint, ...]
    effects: tuple[Effect, ...]
    prior: np.ndarray

    def of(self, candidate: int) -> list[int]:
        """Positions of a candidate's items."""
        return [i for i, item in enumerate(self.items) if item.candidate == candidate]


def lay_out(calibration: Calibration, effects: Sequence[Effect]) -> Columns:
    """The columns ∂μ/∂θ of effects that are not in the model, at the fitted model."""
    grids = [_shape_grid(effect) for effect in effects]
    stacks = _all_columns(
        calibration.layout,
        calibration.frame,
        calibration.mode,
        tuple(effects),
        tuple(jnp.asarray(g) for g in grids),
    )
    matrix, items, points = [], [], []
    width = 0
    for candidate, (effect, grid, stack) in enumerate(zip(effects, grids, stacks, strict=True)):
        spreads = _spread_grid(effect)
        stack = [(np.asarray(columns), size) for columns, size in stack]
        weight = 1 / (len(grid) * len(spreads))
        for (i, shape), own in product(enumerate(grid), spreads):
            parts = [
                columns[i] * (size if spread is None else spread)
                for (columns, size), spread in zip(stack, own, strict=True)
            ]
            block = np.concatenate(parts, axis=1)
            at = tuple(range(width, width + block.shape[1]))
            width += block.shape[1]
            matrix.append(block)
            items.append(Item(candidate, weight, at))
            named = {s.name: float(v) for s, v in zip(effect.shapes, shape, strict=True)}
            spread = next((spread for spread in own if spread is not None), None)
            amplitude = named[effect.measure] if effect.measure else spread
            points.append(GridPoint(named, amplitude, spread is not None, at))
    rows = len(calibration.readings)
    whole = np.concatenate(matrix, axis=1) if matrix else np.zeros((rows, 0))
    return Columns(
        matrix=whole,
        items=tuple(items),
        points=tuple(points),
        effects=tuple(effects),
        prior=prior_shares(effects),
    )


def columns_at(
    calibration: Calibration, effect: Effect, shapes: Sequence[float]
) -> list[tuple[np.ndarray, float]]:
    """Columns ∂μ/∂θ (n, members) of each coefficient at one value of the effect's shapes, and its prior's size."""
    grid = jnp.asarray(shapes, float).reshape(1, -1)
    stacks = _all_columns(
        calibration.layout, calibration.frame, calibration.mode, (effect,), (grid,)
    )
    return [(np.asarray(columns[0]), float(size)) for columns, size in stacks[0]]


def prior_shares(effects: Sequence[Effect]) -> np.ndarray:
    """Equal shares for named effects, and a small one for all unknown dependences together."""
    unknown = np.array([e.is_placeholder for e in effects])
    if unknown.all() or not unknown.any():
        return np.full(len(effects), 1 / len(effects))
    return np.where(unknown, UNKNOWN_SHARE / unknown.sum(), (1 - UNKNOWN_SHARE) / (~unknown).sum())


@compiled
def _all_columns(layout, frame, mode, effects: tuple[Effect, ...], grids: tuple[Array, ...]):
    hyper = forward.hyper_values(layout, mode.v)
    values = forward.coefficients(layout, mode.point.x, mode.point.rows, hyper)
    found = []
    for effect, grid in zip(effects, grids, strict=True):

        def at(shape, effect=effect):
            named = {s.name: shape[i] for i, s in enumerate(effect.shapes)}
            return forward.effect_columns(layout, frame, values, hyper, effect, named)

        found.append(
            jax.vmap(at)(grid) if grid.shape[1] else [(c[None], s) for c, s in at(grid[0])]
        )
    return [
        [(c, s if not hasattr(s, "shape") or s.ndim == 0 else s[0]) for c, s in f] for f in found
    ]


def _shape_grid(effect: Effect) -> np.ndarray:
    """Values of the shapes (points, shapes), equally probable under their priors."""
    count = len(effect.shapes)
    if count == 0:
        return np.zeros((1, 0))
    if count == 1:
        levels = ((np.arange(SHAPE_POINTS) + 0.5) / SHAPE_POINTS)[:, None]
    else:
        most = RAGGED_SHAPES if any(s.ragged for s in effect.shapes) else SEVERAL_SHAPES
        points = max(8, min(most, WIDEST // len(effect.coefficients)))
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", UserWarning
            )  # not a power of two: balance is not needed
            levels = qmc.Sobol(count, scramble=True, rng=0).random(points)
    v = ndtri(levels)
    return np.stack(
        [np.asarray(s.prior.value(jnp.asarray(v[:, i]))) for i, s in enumerate(effect.shapes)],
        axis=1,
    )


def _spread_grid(effect: Effect) -> list[tuple[float | None, ...]]:
    """Learned spreads of an effect's coefficients, each in its own unit, equally probable under their priors.

    One entry for each coefficient, None where it has no learned spread. Those of one effect move together.
    """
    if all(c.spread is None for c in effect.coefficients):
        return [(None,) * len(effect.coefficients)]
    levels = (np.arange(SPREAD_POINTS) + 0.5) / SPREAD_POINTS
    # A half-normal's quantile; the other spread priors are treated as if of the same scale.
    return [
        tuple(None if c.spread is None else float(c.spread.scale * z) for c in effect.coefficients)
        for z in ndtri(0.5 + 0.5 * levels)
    ]


def reported(effect: Effect) -> tuple[Coefficient, str]:
    """The coefficient that speaks for an effect, and its unit."""
    first = effect.coefficients[0]
    return first, first.unit
