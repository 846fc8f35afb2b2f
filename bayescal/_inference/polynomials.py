"""Chebyshev's polynomials of several variables where a Gaussian fit has its draws, by least squares.

Source: G. Migliorati et al., Found. Comput. Math. 14 (2014) 419 (polynomials by least squares at Chebyshev's density).
"""

from __future__ import annotations

import math
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from jaxtyping import Float

BOX = 5.0  # standard deviations of a Gaussian fit of φ, up to which polynomials are fitted
DEGREES = {
    1: (6, 12, 20),
    2: (4, 8, 12, 17),
    3: (3, 5, 7, 9),
}  # tried in turn, by the number of variables


class Polynomials:
    """Chebyshev's polynomials up to a total degree, in coordinates that a Gaussian fit is round in."""

    def __init__(self, draws: Float[np.ndarray, "s m"], degree: int) -> None:
        self.centre = draws.mean(axis=0)
        covariance = np.atleast_2d(np.cov(draws.T))
        self.root = BOX * np.linalg.cholesky(covariance + 1e-12 * np.diag(np.diag(covariance)))
        self.degree, self.dim = degree, len(self.centre)
        powers = list(combinations_with_replacement(range(self.dim + 1), degree))
        self.count = len(powers)
        self._powers = np.array([[c.count(j + 1) for j in range(self.dim)] for c in powers])
        # Twice as many points as terms, and a few: with points of the density 1/√(1 − t²), which the cosine below
        # gives, least squares is then stable (Migliorati et al. 2014).
        count = 2 * math.comb(self.dim + degree, self.dim) + 4
        # Where the products are computed: a sequence, dense at the ends where there are few axes.
        # A Kronecker sequence: multiples of irrational steps, modulo one, leave no gaps whatever their number.
        ratio = _golden(self.dim)
        steps = (np.arange(1, count + 1)[:, None] * ratio ** -np.arange(1, self.dim + 1) + 0.5) % 1
        t = np.cos(np.pi * steps)
        if self.dim > 3:  # corners of a cube are far out
            t = t / np.maximum(1.0, np.linalg.norm(t, axis=1))[:, None]
        self.points = self.centre + t @ self.root.T

    def fit(self, rows: Float[np.ndarray, "c s"]) -> Float[np.ndarray, "t s"]:
        """Coefficients of each term, for numbers at the points."""
        return np.linalg.pinv(self.terms(self.points)) @ rows

    def _round(self, coordinates: Float[np.ndarray, "*b m"]) -> Float[np.ndarray, "*b m"]:
        return np.linalg.solve(self.root, (coordinates - self.centre)[..., None])[..., 0]

    def reach(self, coordinates: Float[np.ndarray, "*b m"]) -> Any:
        """Whether they are where the polynomials were fitted."""
        return np.max(np.abs(self._round(coordinates)), axis=-1) <= 1

    def terms(self, coordinates: Float[np.ndarray, "b m"]) -> Float[np.ndarray, "b t"]:
        t = self._round(coordinates)
        # Beyond the box a polynomial means nothing: the value at the box's edge, on the way to its centre, stands for
        # it.
        t = t / np.maximum(1.0, np.max(np.abs(t), axis=1))[:, None]
        # Tₖ(cos θ) = cos kθ.
        angle = np.arccos(np.clip(t, -1.0, 1.0))
        one = np.cos(angle[:, :, None] * np.arange(self.degree + 1))
        found = np.ones((len(t), len(self._powers)))
        for j in range(self.dim):
            found *= one[:, j, self._powers[:, j]]
        return found


def _golden(dim: int) -> float:
    """The root of x^(d+1) = x + 1, whose powers make an even sequence in d dimensions."""
    x = 2.0
    for _ in range(40):
        x = (1 + x) ** (1 / (dim + 1))
    return x
