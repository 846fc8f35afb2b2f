"""Columns of an affine output that the structures of a record share, and their products with each other."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

SHARED = 1e-6  # of the largest singular value, below which a direction of columns takes nothing

KEEPS_DIGITS = 1e-4  # of a sum of squares that is left, where the rest is taken off: four digits of sixteen are lost


class ColumnProducts:
    """Columns of an affine output that were asked for so far, and their products with each other.

    Column 0 is what a first fit leaves of the readings, so that sums of squares are small differences; coefficients of
    the columns that this took are kept (`taken`).
    """

    def __init__(self, residual: Float[np.ndarray, "n"]) -> None:
        self._table = np.asfortranarray(residual[:, None])
        self._filled = 1
        self.products = np.array([[residual @ residual]])
        self.places: dict[Any, Int[np.ndarray, "w"]] = {}
        self.taken: dict[int, float] = {}

    def add(self, columns: Float[np.ndarray, "n w"]) -> Int[np.ndarray, "w"]:
        """Where further columns stand from now on."""
        (size, width), start = columns.shape, self._filled
        end = start + width
        if end > self._table.shape[1]:
            larger = np.empty((size, max(end, 2 * start, 64)), order="F")
            larger[:, :start] = self._table[:, :start]
            self._table = larger
        self._table[:, start:end] = columns
        cross = self._table[:, :end].T @ columns
        products = np.empty((end, end))
        products[:start, :start] = self.products
        products[:, start:], products[start:, :start] = cross, cross[:start].T
        self.products, self._filled = products, end
        return np.arange(start, end)

    def take(self, places: Int[np.ndarray, "m"]) -> None:
        """Take what these columns explain out of the residual, by least squares; nearly none of what they share."""
        if not len(places):
            return
        table, residual = self._table[:, places], self._table[:, 0]
        # Columns of unit length: `SHARED` is then of directions, not of units.
        size = np.sqrt(np.sum(table**2, axis=0))
        scale = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
        found = scale * np.linalg.lstsq(table * scale, residual, rcond=SHARED)[0]
        self._table[:, 0] = residual - table @ found
        cross = self._table[:, : self._filled].T @ self._table[:, 0]
        self.products[0], self.products[:, 0] = cross, cross
        self.taken = dict(zip(places.tolist(), found.tolist(), strict=True))

    def of_rows(self, kept: Int[np.ndarray, "k"]) -> ColumnProducts:
        """The same of some of the readings, without what the others add; columns that are zero there are exactly so."""
        # Products over the rows that are kept are those of all less those of the others: cheaper where few are left
        # out, as long as the difference keeps its digits.
        found = ColumnProducts(self._table[kept, 0])
        table = self._table[kept, : self._filled]
        others = np.delete(self._table[:, : self._filled], kept, axis=0)
        left = self.products.diagonal() - np.einsum("ij,ij->j", others, others)
        if len(others) < len(table) and left[0] > KEEPS_DIGITS * self.products[0, 0]:
            found.products = self.products - others.T @ others
            nothing = ~np.any(table, axis=0)
            found.products[nothing], found.products[:, nothing] = 0.0, 0.0
        else:
            found.products = table.T @ table
        found._table, found._filled = np.asfortranarray(table), self._filled
        found.places, found.taken = dict(self.places), dict(self.taken)
        return found

    def beside_residual(self, places: Int[np.ndarray, "m"]) -> Float[np.ndarray, "m1 m1"]:
        """Products of some columns and of what is left of the readings, last, where only these columns took a part."""
        places = np.append(places, 0)
        made = self.products[places[:, None], places]
        own = set(places.tolist())
        if missing := [i for i in self.taken if i not in own]:  # what others took is put back
            # Residual r₀, and r₀ + Φₘ·a before columns m took their shares a: products of the latter follow from
            # those of r₀ and Φₘ.
            amount = np.array([self.taken[i] for i in missing])
            across = amount @ self.products[np.array(missing)[:, None], places]
            inside = amount @ self.products[np.array(missing)[:, None], missing] @ amount
            made[-1, -1] += 2 * across[-1] + inside
            made[:-1, -1] += across[:-1]
            made[-1, :-1] = made[:-1, -1]
        return made
