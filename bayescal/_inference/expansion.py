"""Columns of an effect as functions of its shapes: sums of few columns near a coordinate.

Along one shape, in a box of half width w about m, a column is a truncated Chebyshev series in u = (v − m)/w, fitted at
Chebyshev's points and tried between them. Boxes are made where a mode is sought. Columns that run too sharply for the
smallest box, as beside a step, and those of several shapes, are a Taylor series of second order about one place, by
central differences.
Source: L. Trefethen, Approximation Theory and Approximation Practice, SIAM 2013, ch. 3 (series from values at nodes).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from bayescal._inference.chebyshev import points, polynomials, to_coefficients

COUNT = 9  # Chebyshev points of a box
BOX_WIDTH = 1.2  # of the largest box, prior standard deviations of a shape
HALVINGS = 7  # of a box's width at most
FAILURES = 2  # places without a box, from which on none is tried for
KEPT_TERM, TOLERANCE = 1e-9, 1e-8  # of the largest number in a column: least term, error between
DIFFERENCE = 2e-3  # of a coordinate, for slopes about a place
TRIED_DRAWS = 12  # draws at which fitted polynomials are tried
KEPT_SHARE = 1e-7  # of the largest principal direction of polynomials' coefficients, down to which they are kept
BOX_SD = 5.0  # standard deviations of a Gaussian fit of φ, up to which polynomials are fitted
# Tried in turn, by the number of shapes.
DEGREES = {1: (6, 12, 20), 2: (4, 8, 12, 17), 3: (3, 5, 7, 9)}
LISTED = 8  # coordinates whose columns are listed together
MOST_PLACES = 8  # about which Taylor series are kept
_NUMBERS = itertools.count()
_ORDERS = np.arange(COUNT)
_TRIED = np.array([-0.93, -0.31, 0.47, 0.98])  # where a series is tried


class Shares(NamedTuple):
    """Factors of an expansion's columns at a coordinate, and their slopes by it."""

    value: Float[np.ndarray, "r"]
    first: Float[np.ndarray, "d r"]
    second: Float[np.ndarray, "d d r"]


@dataclass(eq=False)
class Expansion:
    """Columns J(v) = Σᵣ sᵣ(v)·columns[:, :, r] near a coordinate of the shapes.

    Attributes:
        columns: for each coefficient, those that its column is a sum of (n, k, r).
        middle: coordinates of the free shapes (d,).
        half: half of the box's width; zero for a Taylor series, which is of its place alone.
        orders: of the Chebyshev polynomials that the shares are (r,); none of a Taylor series.
        number: its own, by which a table knows its columns without holding them.
    """

    columns: Float[np.ndarray, "n k r"]
    middle: Float[np.ndarray, "d"]
    half: float = 0.0
    orders: np.ndarray = field(default_factory=_ORDERS[:0].copy)

    def __post_init__(self) -> None:
        self.rank: int = self.columns.shape[2]
        self.number: int = next(_NUMBERS)

    def distance(self, v: Float[np.ndarray, "d"]) -> float:
        """Return how far a coordinate is from the middle, in half widths."""
        distance = float(np.max(np.abs(v - self.middle), initial=0.0))
        return distance / self.half if self.half else np.inf if distance else 0.0

    def shares(self, v: Float[np.ndarray, "d"]) -> Shares:
        """Return the factors of the columns at a coordinate inside."""
        if not self.half:
            return _taylor_shares(len(v), self.rank)
        u, k = (v[0] - self.middle[0]) / self.half, self.orders
        angle = np.arccos(min(max(u, -1 + 1e-12), 1 - 1e-12))
        value, sin = np.cos(k * angle), np.sin(angle)
        first = k * np.sin(k * angle) / sin
        second = (u * first - k**2 * value) / sin**2
        return Shares(value, first[None] / self.half, second[None, None] / self.half**2)

    def values(self, v: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b r"]:
        """Return the factors at several coordinates inside."""
        if not self.half:
            return np.broadcast_to(_taylor_shares(v.shape[1], self.rank).value, (len(v), self.rank))
        return polynomials((v[:, 0] - self.middle[0]) / self.half, COUNT)[:, self.orders]


class ListedColumns(Expansion):
    """Columns at each of some coordinates (r, d), without slopes."""

    def values(self, v: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b r"]:
        return np.all(v[:, None] == self.middle, axis=2).astype(float)


class Polynomials:
    """Chebyshev's polynomials up to a total degree, by least squares in coordinates that a Gaussian fit is round in.

    Source: G. Migliorati et al., Found. Comput. Math. 14 (2014) 419 (polynomials by least squares at Chebyshev's
    density).
    """

    def __init__(self, draws: Float[np.ndarray, "s m"], degree: int) -> None:
        self.centre: np.ndarray = draws.mean(axis=0)
        covariance = np.atleast_2d(np.cov(draws.T))
        ridge = 1e-12 * np.diag(np.diag(covariance))
        self.root: np.ndarray = BOX_SD * np.linalg.cholesky(covariance + ridge)
        self.degree = degree
        self.dim: int = len(self.centre)
        powers = list(itertools.combinations_with_replacement(range(self.dim + 1), degree))
        self._powers = np.array([[c.count(j + 1) for j in range(self.dim)] for c in powers])
        # Twice as many points as terms, and a few: with points of the density 1/√(1 − t²), which the cosine below
        # gives, least squares is then stable (Migliorati et al. 2014).
        count = 2 * math.comb(self.dim + degree, self.dim) + 4
        # A Kronecker sequence: multiples of irrational steps, modulo one, leave no gaps whatever their number.
        ratio = brentq(lambda x: x ** (self.dim + 1) - x - 1, 1, 2, xtol=1e-15)
        steps = (np.arange(1, count + 1)[:, None] * ratio ** -np.arange(1, self.dim + 1) + 0.5) % 1
        self.points: np.ndarray = self.centre + np.cos(np.pi * steps) @ self.root.T

    def _round(self, coordinates: Float[np.ndarray, "*b m"]) -> Float[np.ndarray, "*b m"]:
        return np.linalg.solve(self.root, (coordinates - self.centre)[..., None])[..., 0]

    def reach(self, coordinates: Float[np.ndarray, "*b m"]) -> np.ndarray:
        """Return whether coordinates are where the polynomials were fitted."""
        return np.max(np.abs(self._round(coordinates)), axis=-1) <= 1

    def terms(self, coordinates: Float[np.ndarray, "b m"]) -> Float[np.ndarray, "b t"]:
        """Return the terms at coordinates; beyond the box, where they mean nothing, at its edge towards its centre."""
        t = self._round(coordinates)
        inside = t / np.maximum(1.0, np.max(np.abs(t), axis=1))[:, None]
        values = polynomials(inside, self.degree + 1)
        return np.prod([values[:, j, self._powers[:, j]] for j in range(self.dim)], axis=0)


class PolynomialColumns(Expansion):
    """Columns as polynomials of the shapes where a Gaussian fit of φ has its draws, without slopes."""

    def __init__(
        self,
        columns: Float[np.ndarray, "n k r"],
        polynomials: Polynomials,
        share: Float[np.ndarray, "t r"],
    ) -> None:
        super().__init__(columns, polynomials.centre)
        self.polynomials: Polynomials = polynomials
        self.share: np.ndarray = share

    def values(self, v: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b r"]:
        return self.polynomials.terms(v) @ self.share

    def reaches(self, v: Float[np.ndarray, "b d"]) -> np.ndarray:
        """Return whether coordinates are where the polynomials were fitted."""
        return self.polynomials.reach(v)


class Expansions:
    """Expansions of one effect's columns (s, n, k), functions of its shapes (s, d), made where asked for and kept."""

    def __init__(
        self, columns: Callable[[Float[np.ndarray, "s d"]], Float[np.ndarray, "s n k"]], dim: int
    ) -> None:
        self._columns = columns
        self.dim = dim
        self._boxes, self._places = list[Expansion](), list[Expansion]()
        self._halvings, self._failures = 0, 0 if dim == 1 else FAILURES

    @property
    def nbytes(self) -> int:
        return sum(e.columns.nbytes for e in (*self._boxes, *self._places))

    def at(self, v: Float[np.ndarray, "d"], with_grad: bool) -> Expansion:
        """Return an expansion that holds at a coordinate, the nearest box first; `with_grad`: differentiable there."""
        with_grad = with_grad and self.dim > 0
        nearest = min(self._boxes, key=lambda box: box.distance(v), default=None)
        if nearest is not None and nearest.distance(v) <= 1:
            return nearest
        if with_grad and (box := self._box(v)) is not None:
            self._boxes.append(box)
            return box
        for place in self._places:
            if place.distance(v) == 0 and (place.rank > 1 or not with_grad):
                return place
        place = self._about(v) if with_grad else Expansion(self._columns(v[None])[0][:, :, None], v)
        self._places = [*self._places[1 - MOST_PLACES :], place]
        return place

    def cover(self, v: Float[np.ndarray, "b d"]) -> tuple[list[Expansion], np.ndarray]:
        """Return expansions that hold at several coordinates, and which of them is for each, (b,)."""
        if not self.dim:
            return [self.at(v[0], False)], np.zeros(len(v), dtype=int)
        expansions, which = list[Expansion](), np.full(len(v), -1)
        for box in self._boxes:
            inside = (which < 0) & (np.abs(v[:, 0] - box.middle[0]) <= box.half)
            if inside.any():
                which[inside] = len(expansions)
                expansions.append(box)
        uncovered = np.flatnonzero(which < 0)
        # Each once: a coordinate that stood there twice would count twice.
        places, of = np.unique(v[uncovered], axis=0, return_inverse=True)
        for start in range(0, len(places), LISTED):
            some = places[start : start + LISTED]
            which[uncovered[(of >= start) & (of < start + LISTED)]] = len(expansions)
            expansions.append(ListedColumns(np.moveaxis(self._columns(some), 0, 2), some))
        return expansions, which

    def fitted(self, draws: Float[np.ndarray, "s d"]) -> PolynomialColumns | None:
        """Return columns as the best polynomials where some draws of the free shapes are; None where they are none."""
        best, fit = np.inf, None
        for degree in DEGREES.get(self.dim, ()):
            polynomials = Polynomials(draws, degree)
            count = len(polynomials.points)
            computed = self._columns(np.concatenate([polynomials.points, draws[:TRIED_DRAWS]]))
            values = computed[:count].reshape(count, -1)
            exact = computed[count:].reshape(TRIED_DRAWS, -1)
            if not np.all(np.isfinite(computed)):
                break
            coefficients = np.linalg.pinv(polynomials.terms(polynomials.points)) @ values
            error = polynomials.terms(draws[:TRIED_DRAWS]) @ coefficients - exact
            misfit = np.max(np.abs(error), initial=0.0) / np.max(np.abs(values), initial=1e-300)
            if misfit >= best:
                break
            # As few columns as span these: principal directions of the coefficients.
            size, vectors = np.linalg.eigh(coefficients @ coefficients.T)
            shares = vectors[:, size > KEPT_SHARE**2 * size[-1]]
            columns = (shares.T @ coefficients).reshape(-1, *computed.shape[1:])
            best, fit = misfit, PolynomialColumns(np.moveaxis(columns, 0, 2), polynomials, shares)
            if best <= TOLERANCE:
                break
        return fit

    def _box(self, v: Float[np.ndarray, "d"]) -> Expansion | None:
        """Return the largest box that a series describes; None where there is none."""
        for halvings in range(self._halvings, HALVINGS + 1) if self._failures < FAILURES else ():
            half = 0.5 * BOX_WIDTH * 2.0**-halvings
            computed = self._columns(v + half * np.append(points(COUNT), _TRIED)[:, None])
            nodes = computed[:COUNT].reshape(COUNT, -1)
            exact = computed[COUNT:].reshape(len(_TRIED), -1)
            coefficients = to_coefficients(COUNT) @ nodes
            largest = np.max(np.abs(nodes), initial=1e-300)
            error = np.max(np.abs(polynomials(_TRIED, COUNT) @ coefficients - exact), initial=0.0)
            if error <= TOLERANCE * largest:
                self._halvings = halvings
                size = np.max(np.abs(coefficients), axis=1, initial=0.0)
                orders = np.flatnonzero((size > KEPT_TERM * largest) | (_ORDERS == 0))
                parts = coefficients[orders].reshape(-1, *computed.shape[1:])
                return Expansion(np.moveaxis(parts, 0, 2), v, half, orders)
        self._failures += 1
        return None

    def _about(self, v: Float[np.ndarray, "d"]) -> Expansion:
        """Return the Taylor series of second order about a place: columns, slopes, second slopes (see `_pairs`)."""
        h, dim = DIFFERENCE, self.dim
        unit = h * np.eye(dim)
        mixed = [unit[i] + unit[j] for i, j in _pairs(dim) if i != j]
        shifts = np.array([np.zeros(dim), *unit, *-unit, *mixed, *np.negative(mixed)])
        computed = self._columns(v + shifts.reshape(-1, dim))
        middle, up, down = computed[0], computed[1 : 1 + dim], computed[1 + dim : 1 + 2 * dim]
        across = iter(computed[1 + 2 * dim :].reshape(2, -1, *middle.shape).sum(axis=0))
        parts = [middle, *((up - down) / (2 * h))]
        for i, j in _pairs(dim):
            bend = up[i] - 2 * middle + down[i]
            if i != j:
                bend = 0.5 * (next(across) - bend - up[j] - down[j])
            parts.append(bend / h**2)
        return Expansion(np.stack(parts, axis=2), v)


def _pairs(dim: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(dim) for j in range(i + 1)]


@cache
def _taylor_shares(dim: int, rank: int) -> Shares:
    """Return the factors of a Taylor series at its place: of the columns one, of each slope that of its coordinate."""
    first, second = np.zeros((dim, rank)), np.zeros((dim, dim, rank))
    if rank > 1:
        first = np.eye(rank)[1 : 1 + dim]
        for k, (i, j) in enumerate(_pairs(dim)):
            second[i, j, 1 + dim + k] = second[j, i, 1 + dim + k] = 1.0
    return Shares(np.eye(rank)[0], first, second)
