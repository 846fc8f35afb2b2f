"""Local expansions of an effect's basis columns in its shapes v: J(v) = Σᵣ factorᵣ(v)·columnsᵣ.

In one shape, on an interval ("box") of half width w about m, the expansion is a truncated Chebyshev series in
u = (v − m)/w, fitted at Chebyshev nodes and tested between them. Columns too steep for the smallest box (near a step),
and those of several shapes, are Taylor series of second order about a point, by central differences. For draws of a
Laplace approximation, columns are multivariate polynomials fitted by least squares.
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
from numpy.polynomial.chebyshev import chebpts1, chebvander

NODES = 9  # Chebyshev nodes of a box
MAX_BOX_WIDTH_SD = 1.2  # of the largest box, prior standard deviations of a shape
MAX_HALVINGS = 7  # of the box width, at most
MAX_FAILS = 2  # failed fits of a box, after which no further one is attempted
TERM_TOLERANCE = 1e-9  # smallest term, relative to the largest element
TOLERANCE = 1e-8  # largest error, relative to the largest element
DIFF_STEP = 2e-3  # step of a coordinate, for Taylor series by central differences
TEST_DRAWS = 12  # draws at which fitted polynomials are tested
RANK_TOLERANCE = 1e-7  # smallest principal component of polynomials, relative to the largest
REGION_SD = 5.0  # half width of the polynomials' region, standard deviations of φ
# Polynomial degrees tried in turn, by the number of shapes.
DEGREES = {1: (6, 12, 20), 2: (4, 8, 12, 17), 3: (3, 5, 7, 9)}
LIST_SIZE = 8  # coordinates per `ListedColumns`
MAX_CACHED_POINTS = 8  # cached Taylor series
_NUMBERS = itertools.count()
_ORDERS = np.arange(NODES)
_TEST_POINTS = np.array([-0.93, -0.31, 0.47, 0.98])  # where a series is tested, in half widths


@cache
def values_to_coefficients(count: int) -> Float[np.ndarray, "k c"]:
    """Return the matrix that maps values at Chebyshev nodes to Chebyshev coefficients (a discrete cosine transform)."""
    scale = np.where(np.arange(count) == 0, 1, 2)[:, None] / count
    return scale * chebvander(chebpts1(count), count - 1).T


def lagrange_at_nodes(
    low: float, high: float, count: int, x: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "c"], Float[np.ndarray, "n c"]]:
    """Return the Chebyshev nodes on [low, high] (c,) and their Lagrange polynomials at x (n, c)."""
    centre, half_width = 0.5 * (low + high), 0.5 * (high - low)
    lagrange = chebvander((x - centre) / half_width, count - 1) @ values_to_coefficients(count)
    return centre + half_width * chebpts1(count), lagrange


class Factors(NamedTuple):
    """Factors (r,) of an expansion's columns at one point of the shapes' coordinates, with gradient and Hessian."""

    value: Float[np.ndarray, "r"]
    gradient: Float[np.ndarray, "d r"]
    hessian: Float[np.ndarray, "d d r"]


@dataclass(eq=False)
class Expansion:
    """Expansion J(v) = Σᵣ factorᵣ(v)·columns[:, :, r] of basis columns about a point of the shapes' coordinates v.

    Attributes:
        columns: terms of the expansion of each coefficient's column (n, k, r).
        middle: coordinates of the expansion point (d,).
        half: half width of the box; zero for a Taylor series, valid at its point only.
        orders: Chebyshev orders of the terms (r,); empty for a Taylor series.
        number: unique identifier, a key of caches.
    """

    columns: Float[np.ndarray, "n k r"]
    middle: Float[np.ndarray, "d"]
    half: float = 0.0
    orders: np.ndarray = field(default_factory=_ORDERS[:0].copy)

    def __post_init__(self) -> None:
        self.rank: int = self.columns.shape[2]
        self.number: int = next(_NUMBERS)

    def distance(self, v: Float[np.ndarray, "d"]) -> float:
        """Return the largest distance of coordinates (d,) from the expansion point, half widths of the box."""
        distance = float(np.max(np.abs(v - self.middle), initial=0.0))
        return distance / self.half if self.half else np.inf if distance else 0.0

    def factors(self, v: Float[np.ndarray, "d"]) -> Factors:
        """Return the factors with gradient and Hessian at coordinates (d,) inside the box."""
        if not self.half:
            return _get_factors(len(v), self.rank)
        u, k = (v[0] - self.middle[0]) / self.half, self.orders
        angle = np.arccos(min(max(u, -1 + 1e-12), 1 - 1e-12))
        value, sin = np.cos(k * angle), np.sin(angle)
        gradient = k * np.sin(k * angle) / sin
        hessian = (u * gradient - k**2 * value) / sin**2
        return Factors(value, gradient[None] / self.half, hessian[None, None] / self.half**2)

    def values(self, v: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b r"]:
        """Evaluate the r factors of the columns at b points in the expansion's box (b, r)."""
        if not self.half:
            return np.broadcast_to(_get_factors(v.shape[1], self.rank).value, (len(v), self.rank))
        return chebvander((v[:, 0] - self.middle[0]) / self.half, NODES - 1)[:, self.orders]


class ListedColumns(Expansion):
    """Columns at a list of r points (r, d), valid at these points only, without derivatives."""

    def values(self, v: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b r"]:
        return np.all(v[:, None] == self.middle, axis=2).astype(float)


class Polynomials:
    """Multivariate Chebyshev polynomials of limited total degree, fitted by least squares in whitened coordinates.

    Source: G. Migliorati et al., Found. Comput. Math. 14 (2014) 419 (polynomials by least squares at Chebyshev's
    density).
    """

    def __init__(self, draws: Float[np.ndarray, "s m"], degree: int) -> None:
        self.centre: np.ndarray = draws.mean(axis=0)
        covariance = np.atleast_2d(np.cov(draws.T))
        ridge = 1e-12 * np.diag(np.diag(covariance))
        self.root: np.ndarray = REGION_SD * np.linalg.cholesky(covariance + ridge)
        self.degree = degree
        self.dim: int = len(self.centre)
        powers = list(itertools.combinations_with_replacement(range(self.dim + 1), degree))
        self._powers = np.array([[c.count(j + 1) for j in range(self.dim)] for c in powers])
        # Twice as many points as terms, distributed as 1/√(1 − t²) by the cosine below: least squares is then stable.
        count = 2 * math.comb(self.dim + degree, self.dim) + 4
        # Kronecker low-discrepancy sequence; the base of its steps is the positive root of x^(dim + 1) = x + 1.
        ratio = np.max(np.roots([1, *np.zeros(self.dim - 1), -1, -1]).real)
        steps = (np.arange(1, count + 1)[:, None] * ratio ** -np.arange(1, self.dim + 1) + 0.5) % 1
        self.points: np.ndarray = self.centre + np.cos(np.pi * steps) @ self.root.T

    def _standardise(self, coordinates: Float[np.ndarray, "*b m"]) -> Float[np.ndarray, "*b m"]:
        return np.linalg.solve(self.root, (coordinates - self.centre)[..., None])[..., 0]

    def contains(self, coordinates: Float[np.ndarray, "*b m"]) -> np.ndarray:
        """Return whether points (*b, m) are inside the region of the fit (*b,)."""
        return np.max(np.abs(self._standardise(coordinates)), axis=-1) <= 1

    def terms(self, coordinates: Float[np.ndarray, "b m"]) -> Float[np.ndarray, "b t"]:
        """Evaluate all t terms at b points (b, t), clipped to the region of the fit along the ray to its centre."""
        z = self._standardise(coordinates)
        clipped_z = z / np.maximum(1.0, np.max(np.abs(z), axis=1))[:, None]
        values = chebvander(clipped_z, self.degree)
        return np.prod([values[:, j, self._powers[:, j]] for j in range(self.dim)], axis=0)


class PolynomialColumns(Expansion):
    """Columns as polynomials of the shapes, fitted in the region of the Laplace approximation; without derivatives."""

    def __init__(
        self,
        columns: Float[np.ndarray, "n k r"],
        basis: Polynomials,
        combination: Float[np.ndarray, "t r"],
    ) -> None:
        super().__init__(columns, basis.centre)
        self.polynomials: Polynomials = basis
        self.combination: np.ndarray = combination

    def values(self, v: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b r"]:
        return self.polynomials.terms(v) @ self.combination

    def contains(self, v: Float[np.ndarray, "b d"]) -> np.ndarray:
        """Return whether points are inside the region of the fit (*b,)."""
        return self.polynomials.contains(v)


class Expansions:
    """Cache of the expansions of one effect's columns (s, n, k) as functions of its shapes (s, d)."""

    def __init__(
        self, columns: Callable[[Float[np.ndarray, "s d"]], Float[np.ndarray, "s n k"]], dim: int
    ) -> None:
        self._columns = columns
        self.dim = dim
        self._boxes, self._places = list[Expansion](), list[Expansion]()
        self._level, self._failures = 0, 0 if dim == 1 else MAX_FAILS

    @property
    def nbytes(self) -> int:
        return sum(e.columns.nbytes for e in (*self._boxes, *self._places))

    def get(self, v: Float[np.ndarray, "d"], with_grad: bool) -> Expansion:
        """Return an expansion valid at v, from the nearest box if possible; differentiable if `with_grad`."""
        with_grad = with_grad and self.dim > 0
        nearest_box = min(self._boxes, key=lambda box: box.distance(v), default=None)
        if nearest_box is not None and nearest_box.distance(v) <= 1:
            return nearest_box
        if with_grad and (box := self._fit_box(v)) is not None:
            self._boxes.append(box)
            return box
        for place in self._places:
            if place.distance(v) == 0 and (place.rank > 1 or not with_grad):
                return place
        place = self._expand(v) if with_grad else Expansion(self._columns(v[None])[0, ..., None], v)
        self._places = [*self._places[1 - MAX_CACHED_POINTS :], place]
        return place

    def cover(self, v: Float[np.ndarray, "b d"]) -> tuple[list[Expansion], np.ndarray]:
        """Return expansions that cover several points (b, d), and the index of the expansion for each point (b,)."""
        if not self.dim:
            return [self.get(v[0], False)], np.zeros(len(v), dtype=int)
        expansions, index = list[Expansion](), np.full(len(v), -1)
        for box in self._boxes:
            is_inside = (index < 0) & (np.abs(v[:, 0] - box.middle[0]) <= box.half)
            if is_inside.any():
                index[is_inside] = len(expansions)
                expansions.append(box)
        missing = np.flatnonzero(index < 0)
        # Duplicates removed: the factors of `ListedColumns` would count a coordinate twice.
        points, inverse = np.unique(v[missing], axis=0, return_inverse=True)
        for start in range(0, len(points), LIST_SIZE):
            batch = points[start : start + LIST_SIZE]
            index[missing[(inverse >= start) & (inverse < start + LIST_SIZE)]] = len(expansions)
            expansions.append(ListedColumns(np.moveaxis(self._columns(batch), 0, 2), batch))
        return expansions, index

    def fit_polynomials(self, draws: Float[np.ndarray, "s d"]) -> PolynomialColumns | None:
        """Fit polynomials of increasing degree to the columns in the region of draws; return the best, or None."""
        best, fit = np.inf, None
        for degree in DEGREES.get(self.dim, ()):
            basis = Polynomials(draws, degree)
            count = len(basis.points)
            samples = self._columns(np.concatenate([basis.points, draws[:TEST_DRAWS]]))
            values = samples[:count].reshape(count, -1)
            exact_values = samples[count:].reshape(TEST_DRAWS, -1)
            if not np.all(np.isfinite(samples)):
                break
            coefficients = np.linalg.pinv(basis.terms(basis.points)) @ values
            error = basis.terms(draws[:TEST_DRAWS]) @ coefficients - exact_values
            misfit = np.max(np.abs(error), initial=0.0) / np.max(np.abs(values), initial=1e-300)
            if misfit >= best:
                break
            # Reduce the number of columns to the principal components of the coefficients.
            eigenvalues, vectors = np.linalg.eigh(coefficients @ coefficients.T)
            directions = vectors[:, eigenvalues > RANK_TOLERANCE**2 * eigenvalues[-1]]
            columns = (directions.T @ coefficients).reshape(-1, *samples.shape[1:])
            best, fit = misfit, PolynomialColumns(np.moveaxis(columns, 0, 2), basis, directions)
            if best <= TOLERANCE:
                break
        return fit

    def _fit_box(self, v: Float[np.ndarray, "d"]) -> Expansion | None:
        """Fit a Chebyshev series on the largest possible box about v; None if the smallest box fails."""
        for halvings in range(self._level, MAX_HALVINGS + 1) if self._failures < MAX_FAILS else ():
            half = 0.5 * MAX_BOX_WIDTH_SD * 2.0**-halvings
            columns = self._columns(v + half * np.append(chebpts1(NODES), _TEST_POINTS)[:, None])
            nodes = columns[:NODES].reshape(NODES, -1)
            exact_values = columns[NODES:].reshape(len(_TEST_POINTS), -1)
            coefficients = values_to_coefficients(NODES) @ nodes
            max_value = np.max(np.abs(nodes), initial=1e-300)
            error = np.max(
                np.abs(chebvander(_TEST_POINTS, NODES - 1) @ coefficients - exact_values),
                initial=0.0,
            )
            if error <= TOLERANCE * max_value:
                self._level = halvings
                magnitudes = np.max(np.abs(coefficients), axis=1, initial=0.0)
                orders = np.flatnonzero((magnitudes > TERM_TOLERANCE * max_value) | (_ORDERS == 0))
                terms = coefficients[orders].reshape(-1, *columns.shape[1:])
                return Expansion(np.moveaxis(terms, 0, 2), v, half, orders)
        self._failures += 1
        return None

    def _expand(self, v: Float[np.ndarray, "d"]) -> Expansion:
        """Return the second-order Taylor series about v: columns, gradient, Hessian (`_list_lower_indices`)."""
        h, dim = DIFF_STEP, self.dim
        steps = h * np.eye(dim)
        pairs = [steps[i] + steps[j] for i, j in _list_lower_indices(dim) if i != j]
        shifts = np.array([np.zeros(dim), *steps, *-steps, *pairs, *np.negative(pairs)])
        columns = self._columns(v + shifts.reshape(-1, dim))
        centre, upper, lower = columns[0], columns[1 : 1 + dim], columns[1 + dim : 1 + 2 * dim]
        mixed_sums = iter(columns[1 + 2 * dim :].reshape(2, -1, *centre.shape).sum(axis=0))
        terms = [centre, *((upper - lower) / (2 * h))]
        for i, j in _list_lower_indices(dim):
            difference = upper[i] - 2 * centre + lower[i]
            if i != j:
                difference = 0.5 * (next(mixed_sums) - difference - upper[j] - lower[j])
            terms.append(difference / h**2)
        return Expansion(np.stack(terms, axis=2), v)


def _list_lower_indices(dim: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(dim) for j in range(i + 1)]


@cache
def _get_factors(dim: int, rank: int) -> Factors:
    """Return the Taylor monomials at the expansion point, (1, 0, …), and their gradient and Hessian there."""
    gradient, hessian = np.zeros((dim, rank)), np.zeros((dim, dim, rank))
    if rank > 1:
        gradient = np.eye(rank)[1 : 1 + dim]
        for k, (i, j) in enumerate(_list_lower_indices(dim)):
            hessian[i, j, 1 + dim + k] = hessian[j, i, 1 + dim + k] = 1.0
    return Factors(np.eye(rank)[0], gradient, hessian)
