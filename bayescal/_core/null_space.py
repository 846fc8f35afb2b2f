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

EXACT_SHARE = 3e-14  # singular value over the largest, of normalised columns, that counts as zero
ROUNDING_SHARE = 1e-9  # entry over the largest of a direction, that counts as zero
NEGLIGIBLE_SHARE = 1e-4  # entry over the largest, possibly from a nearly null direction
# Information in nats, below which the evidence cannot decide on a group of columns.
UNDECIDED_NATS = 0.5
UNDECIDED_SHARE = 0.01  # residual over total sum of squares of a group in the span of others


def null_rows(columns: np.ndarray) -> np.ndarray:
    """Return a sparse basis (k, p) of the null space of columns (n, p), independent of the columns' units."""
    # Columns of unit length, so that the result is independent of units.
    norm = np.linalg.norm(columns, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    reduced = _compute_r_factor(columns / norm)
    basis = echelon(linalg.null_space(reduced, rcond=EXACT_SHARE).T)
    basis = np.array([_drop_negligible_entries(reduced, row) for row in basis]).reshape(basis.shape)
    basis = _sort_rows(basis / norm)
    return basis / np.abs(basis).max(axis=1, keepdims=True, initial=1e-300)


def _drop_negligible_entries(columns: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Return a null vector with the row's large entries as its only nonzero ones, if one exists; else the row."""
    is_large = np.abs(row) > NEGLIGIBLE_SHARE * np.abs(row).max()
    if is_large.all():
        return row
    null_vectors = linalg.null_space(_compute_r_factor(columns[:, is_large]), rcond=EXACT_SHARE)
    if not null_vectors.size:
        return row
    sparse_row = np.zeros_like(row)
    sparse_row[is_large] = null_vectors[:, -1]
    return sparse_row


def weak_rows(columns: np.ndarray, null_rows: np.ndarray, limit: float, share: float) -> np.ndarray:
    """Return directions z (m, p) with information |columns·z|² below `limit`, other than the null directions.

    `columns` (n, p) are whitened, per prior standard deviation, with null directions `null_rows` (k, p). If the
    directions span more than `share` of a coefficient's squared unit vector, it is one of them; these come first.
    """
    count = columns.shape[1]
    # Squared singular values of whitened columns are the information along each direction, in units of the prior's.
    _, values, rows = np.linalg.svd(_compute_r_factor(columns), full_matrices=True)
    values = np.concatenate([values, np.zeros(count - len(values))])
    directions = _compute_complement(rows[values**2 < limit], null_rows)
    units = np.eye(count)[np.sum(directions**2, axis=0) > share]
    mixed_directions = echelon(_compute_complement(directions, units))
    return np.concatenate([units, mixed_directions])


def _compute_r_factor(columns: np.ndarray) -> np.ndarray:
    """Return at most p rows that have the singular values and right singular vectors of columns (n, p)."""
    # JᵀJ = RᵀR: the triangle of a QR has J's singular values, in p rows in place of n.
    return (
        np.asarray(np.linalg.qr(columns, mode="r")) if len(columns) > columns.shape[1] else columns
    )


def _compute_complement(rows: np.ndarray, excluded_rows: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the complement of `excluded_rows` in the span of `rows` (both orthonormal)."""
    dimensions = len(rows) - len(excluded_rows)
    if dimensions <= 0 or not len(excluded_rows):
        return rows[: max(dimensions, 0)]
    # The leading right singular vectors of the residuals, after projection on `excluded_rows`, span the complement.
    basis, _ = np.linalg.qr(excluded_rows.T)
    _, _, rows = np.linalg.svd(rows - rows @ basis @ basis.T, full_matrices=False)
    return rows[:dimensions]


def echelon(rows: np.ndarray) -> np.ndarray:
    """Return the reduced row echelon form by complete pivoting, with rounding errors set to zero and rows sorted."""
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
    reduced[np.abs(reduced) < ROUNDING_SHARE * largest] = 0.0
    return _sort_rows(reduced)


def _sort_rows(rows: np.ndarray) -> np.ndarray:
    """Sort rows by the index of their first nonzero entry."""
    return rows[np.argsort([int(np.flatnonzero(row)[0]) for row in rows], kind="stable")]


def scale_to_integers(vector: np.ndarray) -> np.ndarray:
    """Scale a direction to small integers if possible, else to a maximum of one; the first entry is positive."""
    # Null directions of physical models are often ratios of small integers, such as 1 : −1 for two constants.
    entries = np.abs(vector[vector != 0])
    ratios = vector / entries.min()
    is_integer = np.abs(ratios - np.rint(ratios)) < 1e-5
    is_small = is_integer.all() and np.abs(ratios).max() < 100
    scaled_vector = np.rint(ratios) if is_small else vector / entries.max()
    return scaled_vector * np.sign(scaled_vector[np.flatnonzero(scaled_vector)[0]])


def information_nats(columns: np.ndarray) -> float:
    """Return the information ½·log|I + CᵀC|, nats, of columns C (n, k), whitened and per prior standard deviation."""
    return 0.5 * float(np.sum(np.log1p(np.linalg.svd(columns, compute_uv=False) ** 2)))


def beyond(columns: np.ndarray, span: np.ndarray) -> np.ndarray:
    """Project columns (n, k) onto the orthogonal complement of the identified directions of `span` (n, m)."""
    axes, values, _ = np.linalg.svd(span, full_matrices=False)
    axes = axes[:, 0.5 * np.log1p(values**2) >= UNDECIDED_NATS]
    return columns - axes @ (axes.T @ columns)


def is_undecided(columns: np.ndarray, residuals: np.ndarray) -> bool:
    """Return whether `residuals` of a regression of `columns` are negligible, relative to these and in information."""
    is_small = np.sum(residuals**2) < UNDECIDED_SHARE * np.sum(columns**2)
    return bool(is_small) and information_nats(residuals) < UNDECIDED_NATS


@dataclass(frozen=True, eq=False)
class Spans:
    """Groups of columns by name, and their collinearity: which groups are in the span of others."""

    # columns projected off a model's, whitened, per prior standard deviation (n, k)
    left: Mapping[str, np.ndarray] = field(default_factory=dict)
    # groups in the span of the model's columns → the model's effects that they equal
    latent: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # Called repeatedly by a search.
        for name in ("implied", "generators"):
            object.__setattr__(self, name, cache(getattr(self, name)))

    def is_spanned(self, name: str, others: Iterable[str]) -> bool:
        """Return whether a group is in the span of other groups."""
        span = [self.left[n] for n in others if n in self.left]
        if name not in self.left or not span:
            return False
        return is_undecided(self.left[name], beyond(self.left[name], np.column_stack(span)))

    def implied(self, names: frozenset[str]) -> frozenset[str]:
        """Return the other groups that are in the span of the groups `names` and the model."""
        base = names.intersection(self.left)
        others = [n for n in self.left if n not in base] if base else []
        return frozenset({n for n in others if self.is_spanned(n, base)} | {*self.latent}) - names

    def spanning(self, names: frozenset[str]) -> set[str]:
        """Return those of the groups `names` without which the others have fewer groups in their span."""
        closure = self.implied(names)
        return {n for n in names if closure - self.implied(names - {n}) - {n}}

    def generators(self, names: frozenset[str]) -> tuple[frozenset[str], ...]:
        """Return the minimal sets of groups with the same span as the groups `names`, smallest first."""
        closure = names | self.implied(names)
        collinear = [n for n in self.left if n in closure and self.is_spanned(n, closure - {n})]
        sets = list[frozenset[str]]()
        for count in range(len(collinear) + 1):
            for subset in itertools.combinations(collinear, count):
                base = (closure - {*collinear, *self.latent}).union(subset)
                if not any(s <= base for s in sets) and closure <= base | self.implied(base):
                    sets.append(base)
        return tuple(sets)
