"""Unidentified directions of unknowns: null spaces, exact and weak, and collinear groups of columns.

Eigenvectors of a null space of several dimensions are arbitrary mixtures. A reduced echelon form, its pivots the
largest remaining entries, gives each direction a coefficient of its own and separates directions without a common
coefficient.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy import linalg

EXACT_SHARE = 3e-14  # singular value over the largest, of normalised columns: rounding
DUST_SHARE = 1e-9  # entry over a direction's largest: rounding
NEGLIGIBLE_SHARE = 1e-4  # entry over the largest: possibly a remnant of a nearly null direction
# Information in nats, below which no evidence can decide on a group of columns.
UNDECIDED_NATS = 0.5
UNDECIDED_SHARE = 0.01  # residual over total sum of squares of a group in the span of others


def exact(columns: np.ndarray) -> np.ndarray:
    """Return a basis (k, p) of the null space of columns (n, p) in any units, few entries a row, the others zero."""
    # Columns of unit length, so that the result is independent of units.
    norm = np.linalg.norm(columns, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    reduced = _r_factor(columns / norm)
    basis = echelon(linalg.null_space(reduced, rcond=EXACT_SHARE).T)
    basis = np.array([_drop_negligible_entries(reduced, row) for row in basis]).reshape(basis.shape)
    basis = _sort_rows(basis / norm)
    return basis / np.abs(basis).max(axis=1, keepdims=True, initial=1e-300)


def _drop_negligible_entries(columns: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Return a null vector supported on the row's large entries alone, if one exists; otherwise the row."""
    large = np.abs(row) > NEGLIGIBLE_SHARE * np.abs(row).max()
    if large.all():
        return row
    null = linalg.null_space(_r_factor(columns[:, large]), rcond=EXACT_SHARE)
    if not null.size:
        return row
    swept = np.zeros_like(row)
    swept[large] = null[:, -1]
    return swept


def weak(columns: np.ndarray, exact: np.ndarray, limit: float, alone: float) -> np.ndarray:
    """Return directions (m, p) of information |columns·z|² below `limit`, without the `exact` ones.

    Columns (n, p) are whitened, per prior standard deviation. A coefficient whose unit vector has more than `alone` of
    its square within these directions is one of them by itself; these come first.
    """
    count = columns.shape[1]
    # Squared singular values of whitened columns are the information along each direction, in units of the prior's.
    _, values, rows = np.linalg.svd(_r_factor(columns), full_matrices=True)
    values = np.concatenate([values, np.zeros(count - len(values))])
    space = _complement(rows[values**2 < limit], exact)
    units = np.eye(count)[np.sum(space**2, axis=0) > alone]
    others = echelon(_complement(space, units))
    return np.concatenate([units, others])


def _r_factor(columns: np.ndarray) -> np.ndarray:
    """Reduce to a square matrix with the same singular values and right vectors."""
    # JᵀJ = RᵀR: the triangle of a QR has J's singular values, in p rows in place of n.
    return (
        np.asarray(np.linalg.qr(columns, mode="r")) if len(columns) > columns.shape[1] else columns
    )


def _complement(space: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return orthonormal rows that span the orthogonal complement of `others` in `space` (orthonormal rows)."""
    dimensions = len(space) - len(others)
    if dimensions <= 0 or not len(others):
        return space[: max(dimensions, 0)]
    # Of the residuals of the projection on `others`, the right singular vectors with the largest singular values
    # span the space: as many as it has dimensions more.
    basis, _ = np.linalg.qr(others.T)
    _, _, rows = np.linalg.svd(space - space @ basis @ basis.T, full_matrices=False)
    return rows[:dimensions]


def echelon(rows: np.ndarray) -> np.ndarray:
    """Return the reduced row echelon form by complete pivoting, rounding set to zero, ordered by first entry."""
    reduced = np.array(rows, dtype=float)
    free = np.ones(len(reduced), dtype=bool)
    for _ in range(len(reduced)):
        # The largest remaining entry becomes the pivot: dividing by a small one would spread its rounding over the
        # row.
        candidates = np.where(free[:, None], np.abs(reduced), -1.0)
        at, pivot = np.unravel_index(np.argmax(candidates), candidates.shape)
        reduced[at] /= reduced[at, pivot]
        others = np.arange(len(reduced)) != at
        reduced[others] -= np.outer(reduced[others, pivot], reduced[at])
        free[at] = False
    largest = np.abs(reduced).max(axis=1, keepdims=True, initial=0.0)
    reduced[np.abs(reduced) < DUST_SHARE * largest] = 0.0
    return _sort_rows(reduced)


def _sort_rows(rows: np.ndarray) -> np.ndarray:
    """Sort rows by the index of their first nonzero entry."""
    return rows[np.argsort([int(np.flatnonzero(row)[0]) for row in rows], kind="stable")]


def scale_to_integers(vector: np.ndarray) -> np.ndarray:
    """Scale a direction to small integers if possible, else to a maximum of one; the first entry is positive."""
    # Null directions of physical models are often ratios of small whole numbers, such as 1 : −1 of two constants,
    # which can be stated exactly.
    entries = np.abs(vector[vector != 0])
    ratios = vector / entries.min()
    is_integer = np.abs(ratios - np.rint(ratios)) < 1e-5
    is_small = is_integer.all() and np.abs(ratios).max() < 100
    scaled = np.rint(ratios) if is_small else vector / entries.max()
    return scaled * np.sign(scaled[np.flatnonzero(scaled)[0]])


def information_nats(columns: np.ndarray) -> float:
    """Return the information of columns (n, k), ½·log|I + CᵀC| in nats, per prior standard deviation."""
    return 0.5 * float(np.sum(np.log1p(np.linalg.svd(columns, compute_uv=False) ** 2)))


def beyond(columns: np.ndarray, span: np.ndarray) -> np.ndarray:
    """Project the identified directions of `span` (n, m) out of columns (n, k)."""
    axes, values, _ = np.linalg.svd(span, full_matrices=False)
    axes = axes[:, 0.5 * np.log1p(values**2) >= UNDECIDED_NATS]
    return columns - axes @ (axes.T @ columns)


def is_undecided(columns: np.ndarray, residuals: np.ndarray) -> bool:
    """Return whether the residuals of columns on others are negligible, relatively and in information."""
    is_small = np.sum(residuals**2) < UNDECIDED_SHARE * np.sum(columns**2)
    return bool(is_small) and information_nats(residuals) < UNDECIDED_NATS


@dataclass(frozen=True, eq=False)
class Spans:
    """Groups of columns by name, and their collinearity."""

    # columns projected off a model's, whitened, per prior standard deviation (n, k)
    left: Mapping[str, np.ndarray] = field(default_factory=dict)
    # names of further groups, in the span of the model's columns, and the effects of it that they equal
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
        """Return the groups outside `names` that are in the span of `names` and the model."""
        base = names.intersection(self.left)
        others = [n for n in self.left if n not in base] if base else []
        return frozenset({n for n in others if self.is_spanned(n, base)} | {*self.latent}) - names

    def spanning(self, names: frozenset[str]) -> set[str]:
        """Return those of `names` that are needed for other groups to be in their span."""
        closure = self.implied(names)
        return {n for n in names if closure - self.implied(names - {n}) - {n}}

    def generators(self, names: frozenset[str]) -> tuple[frozenset[str], ...]:
        """Return the minimal sets of groups with the same span as `names`, smallest first."""
        closure = names | self.implied(names)
        dependent = [n for n in self.left if n in closure and self.is_spanned(n, closure - {n})]
        sets = list[frozenset[str]]()
        for count in range(len(dependent) + 1):
            for subset in itertools.combinations(dependent, count):
                base = (closure - {*dependent, *self.latent}).union(subset)
                if not any(s <= base for s in sets) and closure <= base | self.implied(base):
                    sets.append(base)
        return tuple(sets)
