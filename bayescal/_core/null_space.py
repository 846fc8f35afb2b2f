"""Unidentified directions of unknowns: null spaces, exact and weak, and collinear groups of columns.

Basis vectors of a null space of several dimensions are arbitrary mixtures. The reduced row echelon form with complete
pivoting gives each direction a pivot coefficient that no other has, and separates those without a common one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy import linalg

NULL_RATIO = 3e-14  # of a singular value to the largest, for columns of unit length, below which it counts as zero
ROUNDING_RATIO = 1e-9  # of an entry of a direction to the largest, below which it counts as zero
NEGLIGIBLE_RATIO = 1e-4  # the same, if it may stem from a nearly null direction
UNDECIDED_NATS = 0.5  # information below which the evidence cannot decide on a group, nats
UNDECIDED_RATIO = 0.01  # of residual to total sum of squares, of a group in the span of others


def find_null_rows(columns: np.ndarray) -> np.ndarray:
    """Return a sparse basis (k, p) of the null space of columns (n, p); the largest entry of each row is ±1."""
    norm = np.linalg.norm(columns, axis=0)
    norm = np.where(norm > 0, norm, 1.0)  # unit length: the result is independent of units
    reduced = _compute_r_factor(columns / norm)
    basis = reduce_to_echelon(linalg.null_space(reduced, rcond=NULL_RATIO).T)
    basis = np.array([_drop_negligible_entries(reduced, row) for row in basis]).reshape(basis.shape)
    basis = _sort_rows(basis / norm)
    return basis / np.abs(basis).max(axis=1, keepdims=True, initial=1e-300)


def _drop_negligible_entries(columns: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Return a null vector of the columns that is zero where `row` is negligible, if one exists; else `row`."""
    is_large = np.abs(row) > NEGLIGIBLE_RATIO * np.abs(row).max()
    if is_large.all():
        return row
    null_vectors = linalg.null_space(_compute_r_factor(columns[:, is_large]), rcond=NULL_RATIO)
    if not null_vectors.size:
        return row
    sparse_row = np.zeros_like(row)
    sparse_row[is_large] = null_vectors[:, -1]
    return sparse_row


def find_weak_rows(
    columns: np.ndarray, null_rows: np.ndarray, limit: float, share: float
) -> np.ndarray:
    """Return directions z (m, p) with information |columns·z|² below `limit`, other than the null directions.

    `columns` (n, p) are whitened, per prior standard deviation, with null directions `null_rows` (k, p). If the
    directions span more than `share` of a coefficient's squared unit vector, it is one of them; these come first.
    """
    count = columns.shape[1]
    # Squared singular values of whitened columns are the information along each direction, in units of the prior's.
    _, singular_values, rows = np.linalg.svd(_compute_r_factor(columns), full_matrices=True)
    singular_values = np.concatenate([singular_values, np.zeros(count - len(singular_values))])
    directions = _compute_complement(rows[singular_values**2 < limit], null_rows)
    unit_vectors = np.eye(count)[np.sum(directions**2, axis=0) > share]
    mixed_directions = reduce_to_echelon(_compute_complement(directions, unit_vectors))
    return np.concatenate([unit_vectors, mixed_directions])


def _compute_r_factor(columns: np.ndarray) -> np.ndarray:
    """Return at most p rows that have the same singular values and right singular vectors as the columns (n, p)."""
    # JᵀJ = RᵀR: the triangle of a QR has J's singular values, in p rows in place of n.
    is_tall = len(columns) > columns.shape[1]
    return np.asarray(np.linalg.qr(columns, mode="r")) if is_tall else columns


def _compute_complement(rows: np.ndarray, excluded_rows: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the complement of `excluded_rows` in the span of `rows` (both orthonormal)."""
    dimensions = len(rows) - len(excluded_rows)
    if dimensions <= 0 or not len(excluded_rows):
        return rows[: max(dimensions, 0)]
    # The leading right singular vectors of the residuals, after projection on `excluded_rows`, span the complement.
    basis, _ = np.linalg.qr(excluded_rows.T)
    _, _, rows = np.linalg.svd(rows - rows @ basis @ basis.T, full_matrices=False)
    return rows[:dimensions]


def reduce_to_echelon(rows: np.ndarray) -> np.ndarray:
    """Return the reduced row echelon form of rows (k, p) by complete pivoting, sorted, rounding errors set to zero."""
    reduced = np.array(rows, dtype=float)
    is_free = np.ones(len(reduced), dtype=bool)
    for _ in range(len(reduced)):
        # Complete pivoting: division by a small pivot would spread its rounding error over the row.
        candidates = np.where(is_free[:, None], np.abs(reduced), -1.0)
        pivot_row, pivot = np.unravel_index(np.argmax(candidates), candidates.shape)
        reduced[pivot_row] /= reduced[pivot_row, pivot]
        is_other_row = np.arange(len(reduced)) != pivot_row
        reduced[is_other_row] -= np.outer(reduced[is_other_row, pivot], reduced[pivot_row])
        is_free[pivot_row] = False
    largest = np.abs(reduced).max(axis=1, keepdims=True, initial=0.0)
    reduced[np.abs(reduced) < ROUNDING_RATIO * largest] = 0.0
    return _sort_rows(reduced)


def _sort_rows(rows: np.ndarray) -> np.ndarray:
    """Sort rows by the index of their first nonzero entry."""
    return rows[np.argsort([int(np.flatnonzero(row)[0]) for row in rows], kind="stable")]


def scale_to_integers(vector: np.ndarray) -> np.ndarray:
    """Scale a direction to integers below 100 if possible, else to a maximum of 1, with a positive first entry."""
    # Null directions of physical models are often ratios of small integers, such as 1 : −1 for two constants.
    entries = np.abs(vector[vector != 0])
    ratios = vector / entries.min()
    is_small = np.abs(ratios).max() < 100 and np.all(np.abs(ratios - np.rint(ratios)) < 1e-5)
    scaled_vector = np.rint(ratios) if is_small else vector / entries.max()
    return scaled_vector * np.sign(scaled_vector[np.flatnonzero(scaled_vector)[0]])


def compute_nats(columns: np.ndarray) -> float:
    """Return the information ½·log|I + CᵀC|, nats, of columns C (n, k), whitened and per prior standard deviation."""
    return 0.5 * float(np.sum(np.log1p(np.linalg.svd(columns, compute_uv=False) ** 2)))


def project_out(columns: np.ndarray, span: np.ndarray) -> np.ndarray:
    """Return the residuals (n, k) of columns after projection on the identified directions of `span` (n, m)."""
    axes, values, _ = np.linalg.svd(span, full_matrices=False)
    axes = axes[:, 0.5 * np.log1p(values**2) >= UNDECIDED_NATS]
    return columns - axes @ (axes.T @ columns)


def is_undecided(columns: np.ndarray, residuals: np.ndarray) -> bool:
    """Return whether the residuals of a regression of `columns` (n, k) are negligible in size and in information."""
    is_small = np.sum(residuals**2) < UNDECIDED_RATIO * np.sum(columns**2)
    return bool(is_small) and compute_nats(residuals) < UNDECIDED_NATS


@dataclass(frozen=True, eq=False)
class Spans:
    """Groups of columns by name, and tests of their collinearity: which groups are in the span of others."""

    # residuals (n, k) of each group's columns after projection on the model's; whitened, per prior standard deviation
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)
    # group in the span of the model's columns → the model's effects whose sum it equals
    model_sums: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:  # a search calls these methods repeatedly
        for name in ("find_implied", "find_minimal_sets"):
            object.__setattr__(self, name, cache(getattr(self, name)))

    def is_spanned(self, name: str, others: Iterable[str]) -> bool:
        """Return whether a group's columns are in the span of those of other groups."""
        span = [self.columns[n] for n in others if n in self.columns]
        if name not in self.columns or not span:
            return False
        columns = self.columns[name]
        return is_undecided(columns, project_out(columns, np.column_stack(span)))

    def find_implied(self, names: frozenset[str]) -> frozenset[str]:
        """Return the groups, other than `names`, whose columns are in the span of those of `names` and the model."""
        base = names.intersection(self.columns)
        others = [n for n in self.columns if n not in base] if base else []
        implied_names = {n for n in others if self.is_spanned(n, base)}
        return frozenset(implied_names.union(self.model_sums) - names)

    def find_spanning(self, names: frozenset[str]) -> set[str]:
        """Return the groups of `names` without which the others span fewer further groups."""
        closure = self.find_implied(names)
        return {n for n in names if closure - self.find_implied(names - {n}) - {n}}

    def find_minimal_sets(self, names: frozenset[str]) -> tuple[frozenset[str], ...]:
        """Return the minimal sets of groups whose columns have the same span as those of `names`, smallest first."""
        closure = names | self.find_implied(names)
        collinear = [n for n in self.columns if n in closure and self.is_spanned(n, closure - {n})]
        sets = list[frozenset[str]]()
        for count in range(len(collinear) + 1):
            for subset in itertools.combinations(collinear, count):
                base = (closure - {*collinear, *self.model_sums}).union(subset)
                if not any(s <= base for s in sets) and closure <= base | self.find_implied(base):
                    sets.append(base)
        return tuple(sets)
