"""The best pairs of very many devices: pairs that a bound excludes are never looked at; the answer is the full table's.

The expected residual of a pair is E|a − r·b|/|s₁ + r·s₂| over the draws, with a, b the environments of the two devices
and r their ratio as calibrated. A norm is convex, so that it is at least

    |ā − r·b̄| / (s·(1 + r))  =  |(1 − q)·ā − q·b̄| / s,   q = r/(1 + r),

with posterior means ā and b̄ and s the largest scale of all draws: the distance from the origin to a piece of the
segment from ā to −b̄. r lies between the extremes of its draws. Devices fall into classes, balls about a centre; for
two classes the bound is that of their centres less the larger radius. Classes first, pairs of the classes that are
left then, and the pairs that are left in the order of their bounds, until no bound is below what was found.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

import bayescal as bc
from bayescal_models.differential_pair.pairing import criteria
from bayescal_models.differential_pair.pairing.devices import Devices

Array = NDArray[np.float64]
Places = NDArray[np.int64]

CLASSES = 64  # of either side at most
AT_ONCE = 2_000  # pairs whose expected residual is computed at once
KEPT = 500_000  # pairs within classes held with their bounds at once


@dataclass(frozen=True)
class Wafer:
    """Joint draws of many devices, outer ones first, environments in an orthonormal basis of the record.

    Attributes:
        names: of the devices, (K,).
        outer: number of outer devices.
        weights: of the draws, adding up to one, (d,).
        scale, sensitivity: (d, K); positive.
        environment: µg, (d, K, m), such that the rms over the record is the norm over m.
    """

    names: tuple[str, ...]
    outer: int
    weights: Array
    scale: Array
    sensitivity: Array
    environment: Array

    @classmethod
    def of(cls, devices: Devices) -> Wafer:
        """The devices of a calibration: their environments lie in the span of a few polynomials."""
        flat = devices.environment.reshape(-1, devices.environment.shape[-1])
        _, size, axes = np.linalg.svd(flat, full_matrices=False)
        image = flat @ axes[size > 1e-12 * size[0]].T / np.sqrt(flat.shape[1])
        kept = {n: getattr(devices, n) for n in ("weights", "scale", "sensitivity")}
        image = image.reshape(*devices.environment.shape[:2], -1)
        return cls(devices.names, devices.outer, **kept, environment=image)


@dataclass(frozen=True)
class ClassBound:
    """Why no pair of two classes is among the best, or that they were opened.

    Attributes:
        outer, inner: numbers of the classes.
        pairs: how many there are.
        bound: that no pair's expected residual is below, µg.
        excluded: whether that was enough; else their pairs were bounded one by one.
        computed: pairs whose expected residual was computed; none of an excluded one.
        least: the least bound of the other pairs, µg: what excluded them.
    """

    outer: int
    inner: int
    pairs: int
    bound: float
    excluded: bool
    computed: int
    least: float


@dataclass(frozen=True)
class WaferPairs:
    """The pairs of least expected residual, and what excluded the others.

    Attributes:
        pairs: (outer, inner, expected residual, µg, environment ratio), the best first.
        classes: bounds of all pairs of classes.
        members: class of each device, (K,).
        bounded: pairs excluded by a bound of their own.
        evaluated: pairs whose expected residual was computed.
        least_excluded: least bound of what was excluded, µg: not below the residual of the last pair.
    """

    pairs: tuple[tuple[str, str, float, float], ...]
    classes: tuple[ClassBound, ...]
    members: NDArray[np.int64]
    bounded: int
    evaluated: int
    least_excluded: float


def best_pairs(wafer: Wafer, count: int = 12) -> WaferPairs:
    """The pairs of least expected residual among all outer and inner devices.

    Raises:
        InputError: a sensitivity or scale that is not positive, or no pair.
    """
    if np.min(wafer.sensitivity) <= 0 or np.min(wafer.scale) <= 0:
        raise bc.InputError(
            "pairs are bounded for positive scales and sensitivities: leave others out"
        )
    if not 0 < wafer.outer < len(wafer.names):
        raise bc.InputError("a pair is one outer and one inner device: give both")
    search = _Search(wafer, count)
    members = search.run()
    order = np.argsort(search.found_residual, kind="stable")
    pairs = [
        (
            wafer.names[search.found_at[n][0]],
            wafer.names[wafer.outer + search.found_at[n][1]],
            float(search.found_residual[n]),
            float(search.found_ratio[n]),
        )
        for n in order
    ]
    return WaferPairs(
        tuple(pairs), tuple(search.classes), members, search.bounded, search.evaluated, search.least
    )


def expected_residual(wafer: Wafer, outer: Places, inner: Places) -> tuple[Array, Array]:
    """Expected residual, µg, and ratio of pairs given by the places of their devices, (pairs,) each."""
    inner = inner + wafer.outer
    ratio = criteria.median(
        wafer.sensitivity[:, outer] / wafer.sensitivity[:, inner], wafer.weights
    )
    left = wafer.environment[:, outer] - ratio[:, None] * wafer.environment[:, inner]
    divisor = wafer.scale[:, outer] + ratio * wafer.scale[:, inner]
    return wafer.weights @ (np.linalg.norm(left, axis=-1) / np.abs(divisor)), ratio


class _Search:
    """Best pairs so far, and the bounds that the others were excluded by."""

    def __init__(self, wafer: Wafer, count: int) -> None:
        self.wafer, self.count = wafer, count
        mean = np.einsum("d,dkm->km", wafer.weights, wafer.environment)
        self.above, self.below = mean[: wafer.outer], mean[wafer.outer :]
        self.largest = float(wafer.scale.max())
        self.low, self.high = wafer.sensitivity.min(axis=0), wafer.sensitivity.max(axis=0)
        self.found_at: list[tuple[int, int]] = []
        self.found_residual, self.found_ratio = np.zeros(0), np.zeros(0)
        self.classes: list[ClassBound] = []
        self.bounded = self.evaluated = 0
        self.least = np.inf

    @property
    def limit(self) -> float:
        """What a pair has to be below."""
        full = len(self.found_residual) == self.count
        return float(self.found_residual.max()) if full else np.inf

    def run(self) -> Places:
        outer, inner = self.wafer.outer, len(self.below)
        of_outer, of_inner = _classes(self.above), _classes(self.below)
        sides = [_balls(self.above, of_outer), _balls(self.below, of_inner)]
        extremes = [
            _extremes(self.low[:outer], self.high[:outer], of_outer),
            _extremes(self.low[outer:], self.high[outer:], of_inner),
        ]
        bounds = self._bounds(sides[0][0], sides[1][0], *extremes)
        bounds = bounds - np.maximum(sides[0][1][:, None], sides[1][1]) / self.largest
        heap = [(float(b), int(i), int(j)) for (i, j), b in np.ndenumerate(bounds)]
        heapq.heapify(heap)
        while heap:
            bound, i, j = heapq.heappop(heap)
            rows, columns = np.flatnonzero(of_outer == i), np.flatnonzero(of_inner == j)
            excluded = bound >= self.limit
            pairs = len(rows) * len(columns)
            before, least = self.evaluated, bound if excluded else np.inf
            if not excluded:
                for begin in range(0, len(rows), step := max(1, KEPT // max(len(columns), 1))):
                    least = min(least, self._open(rows[begin : begin + step], columns))
            self.least = min(self.least, least)
            computed = self.evaluated - before
            self.classes.append(ClassBound(i, j, pairs, max(bound, 0.0), excluded, computed, least))
        assert sum(c.pairs for c in self.classes) == outer * inner
        return np.concatenate([of_outer, of_inner])

    def _open(self, rows: Places, columns: Places) -> float:
        """Bound the pairs of two classes one by one, and compute those that are left, the least bound first.

        Returns:
            The least bound of those that were excluded, µg.
        """
        outer = self.wafer.outer
        below = columns + outer
        bounds = self._bounds(
            self.above[rows],
            self.below[columns],
            (self.low[rows], self.high[rows]),
            (self.low[below], self.high[below]),
        ).ravel()
        left = np.flatnonzero(bounds < self.limit)
        left = left[np.argsort(bounds[left], kind="stable")]
        for begin in range(0, len(left), AT_ONCE):
            some = left[begin : begin + AT_ONCE]
            some = some[bounds[some] < self.limit]
            if not len(some):
                break
            i, j = rows[some // len(columns)], columns[some % len(columns)]
            self._keep(i, j, *expected_residual(self.wafer, i, j))
            bounds[some] = np.nan  # computed, not excluded
        out = bounds[~np.isnan(bounds)]
        self.bounded += len(out)
        return float(out.min(initial=np.inf))

    def _keep(self, i, j, residual: Array, ratio: Array) -> None:
        self.evaluated += len(residual)
        at = [*self.found_at, *zip(i.tolist(), j.tolist(), strict=True)]
        residual = np.concatenate([self.found_residual, residual])
        ratio = np.concatenate([self.found_ratio, ratio])
        best = np.argsort(residual, kind="stable")[: self.count]
        self.found_at = [at[n] for n in best]
        self.found_residual, self.found_ratio = residual[best], ratio[best]

    def _bounds(self, above: Array, below: Array, of_above, of_below) -> Array:
        """Least distance from the origin to the segments from `above` to −`below`, where the ratio may lie, over s."""
        low = of_above[0][:, None] / of_below[1]
        high = of_above[1][:, None] / of_below[0]
        own, other = np.sum(above**2, axis=1)[:, None], np.sum(below**2, axis=1)
        cross = above @ below.T
        length = own + 2 * cross + other  # of the segment, squared
        q = np.where(length > 0, (own + cross) / np.where(length > 0, length, 1.0), 0.0)
        q = np.clip(q, low / (1 + low), high / (1 + high))
        square = (1 - q) ** 2 * own - 2 * q * (1 - q) * cross + q**2 * other
        # Rounding of the squares must not exclude: a millionth of the vectors is given away.
        spare = 1e-7 * np.sqrt(own + other)
        return np.maximum(np.sqrt(np.maximum(square, 0.0)) - spare, 0.0) / self.largest


def _classes(points: Array) -> Places:
    """Classes of devices whose environments are alike; the same for the same devices."""
    count = int(np.clip(len(points) // 16, 1, CLASSES))
    spread = points.std(axis=0).max() or 1.0
    return kmeans2(points / spread, count, minit="++", rng=0)[1].astype(np.int64)


def _balls(points: Array, of: Places) -> tuple[Array, Array]:
    """Centre and radius of each class; of an empty one, a point at the origin."""
    count = int(of.max()) + 1
    centres, radii = np.zeros((count, points.shape[1])), np.zeros(count)
    for k in range(count):
        if len(own := points[of == k]):
            centres[k] = own.mean(axis=0)
            radii[k] = np.linalg.norm(own - centres[k], axis=1).max()
    return centres, radii


def _extremes(low: Array, high: Array, of: Places) -> tuple[Array, Array]:
    count = int(of.max()) + 1
    return (
        np.array([low[of == k].min(initial=np.inf) for k in range(count)]),
        np.array([high[of == k].max(initial=0.0) for k in range(count)]),
    )
