"""Columns of effects on the host: bases called with NumPy's arrays, all values of a shape at once.

A basis that calls JAX by itself, as one of a user's own may, is compiled for the readings and called value by value.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import ModelError
from bayescal._core.lazy_jax import jax
from bayescal._core.xp import is_traced
from bayescal._model.effect import Basis, evaluate_basis
from bayescal._model.frame import Frame

NUMBERS_AT_ONCE = 4_000_000  # of columns that are computed together, which bounds memory


class HostColumns:
    """Columns of bases on one set of readings, or on those of several devices: a frame with a leading axis."""

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self._programs = dict[Basis, Callable[..., Any]]()  # of bases that call JAX
        self._together = dict[Basis, bool]()  # whether it takes several values of a shape at a time

    def at(
        self, basis: Basis, shapes: Mapping[str, Any], shifts: Mapping[str, np.ndarray]
    ) -> Float[np.ndarray, "n k"]:
        """Return columns at a value of each shape, columns of the readings moved by (n,) each.

        Raises:
            ModelError: the basis returns another shape, or asks for a column that is not there.
        """
        if basis not in self._programs:
            try:
                columns = self._matrix(basis, shapes, shifts)
                if not is_traced(columns):
                    return columns
            except ModelError:
                raise
            except Exception:  # of arrays of NumPy's that it cannot take
                pass
            self._together[basis] = False
            self._programs[basis] = jax.jit(partial(self._matrix, basis))
        return np.asarray(self._programs[basis](shapes, shifts))

    def along(
        self,
        basis: Basis,
        shapes: Mapping[str, Float[np.ndarray, "s"]],
        shifts: Mapping[str, Float[np.ndarray, "*s n"]],
    ) -> Float[np.ndarray, "s n k"]:
        """Return columns at several values of the shapes, as `at`; columns of readings moved for each, or for all."""
        lengths = [len(v) for v in shapes.values()]
        lengths += [len(shift) for shift in shifts.values() if shift.ndim > 1]
        size = max(lengths, default=1)
        parts = []
        for part in np.array_split(np.arange(size), -(-size * self.frame.size // NUMBERS_AT_ONCE)):
            values = {n: np.broadcast_to(v, (size,))[part] for n, v in shapes.items()}
            moved = {n: m[part] if m.ndim > 1 else m for n, m in shifts.items()}
            parts.append(self._part(basis, values, moved, len(part)))
        return np.concatenate(parts)

    def _part(
        self, basis: Basis, shapes: Mapping[str, Any], shifts: Mapping[str, Any], size: int
    ) -> Float[np.ndarray, "s n k"]:
        def column_at(i: int) -> Float[np.ndarray, "n k"]:
            moved = {n: m[i] if m.ndim > 1 else m for n, m in shifts.items()}
            return self.at(basis, {n: v[i] for n, v in shapes.items()}, moved)

        if size > 1 and self._together.get(basis, True):
            try:
                leading = {n: v[:, None] for n, v in shapes.items()}
                columns = self._matrix(basis, leading, shifts, (size,))
            except Exception:  # written for one value
                columns = None
            # Such a basis may return the right shape by chance.
            if columns is not None and basis not in self._together:
                pair, how = (columns[-1], column_at(size - 1)), {"atol": 0, "equal_nan": True}
                is_same = np.allclose(*pair, rtol=1e-12, **how)
                self._together[basis] = is_same and basis not in self._programs
            if columns is not None and self._together[basis]:
                return columns
            self._together[basis] = False
        return np.array([column_at(i) for i in range(size)])

    def _matrix(
        self,
        basis: Basis,
        shapes: Mapping[str, Any],
        shifts: Mapping[str, Any],
        lead: tuple[int, ...] = (),
    ) -> Any:
        frame = self.frame.moved(shifts)
        with np.errstate(all="ignore"):  # what is not finite is refused where that is asked
            return evaluate_basis(*basis, frame, shapes, (*lead, *frame.order.shape[:-1]))
