"""The factors L·D·Lᵀ of a symmetric positive tridiagonal matrix T, by LAPACK, in time linear in its size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dpttrf, dtbtrs  # pyright: ignore[reportAttributeAccessIssue]


class Tridiagonal(NamedTuple):
    """D, and L by its diagonal of ones and what stands below it."""

    pivots: Float[np.ndarray, "n"]
    band: Float[np.ndarray, "2 n"]

    @classmethod
    def of(cls, diagonal: Float[np.ndarray, "n"], beside: Float[np.ndarray, "n-1"]) -> Tridiagonal:
        """The factors; pivots NaN where the matrix is not positive."""
        pivots, below, failed = dpttrf(diagonal, beside)
        band = np.zeros((2, len(diagonal)), order="F")
        band[0], band[1, :-1] = 1.0, below
        return cls(np.full(len(diagonal), np.nan) if failed else pivots, band)

    def forward(self, table: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """L⁻¹ times a table, which may be overwritten."""
        return dtbtrs(self.band, table, uplo="L", diag="U", overwrite_b=True)[0]

    def back(self, table: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """L⁻ᵀ times a table, which may be overwritten."""
        return dtbtrs(self.band, table, uplo="L", trans="T", diag="U", overwrite_b=True)[0]

    def inverse(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n-1"]]:
        """The diagonal of T⁻¹, and what stands beside it.

        From the last row on, Zᵢᵢ = 1/Dᵢ + lᵢ²·Zᵢ₊₁,ᵢ₊₁ and Zᵢ,ᵢ₊₁ = −lᵢ·Zᵢ₊₁,ᵢ₊₁.
        """
        below = self.band[1, :-1]
        recursion = self.band.copy(order="F")
        recursion[1, :-1] = -(below**2)
        diagonal = Tridiagonal(self.pivots, recursion).back(1 / self.pivots[:, None])[:, 0]
        return diagonal, -below * diagonal[1:]
