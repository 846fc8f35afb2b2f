"""Evaluate basis columns of effects by NumPy, vectorised over values of the shapes.

A user-defined basis that calls JAX functions is compiled for the readings and called once per value.
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
from bayescal._model.effect import Basis
from bayescal._model.frame import Frame

MAX_ELEMENTS = 4_000_000  # array elements per batch, which bounds memory


class HostColumns:
    """Evaluator of basis columns on the readings of one device, or of several along the leading axis of the frame."""

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self._programs = dict[Basis, Callable[..., Any]]()  # of bases that call JAX
        self._is_vectorised = dict[Basis, bool]()  # accepts arrays as shapes

    def evaluate(
        self, basis: Basis, shapes: Mapping[str, Any], shifts: Mapping[str, np.ndarray]
    ) -> Float[np.ndarray, "n k"]:
        """Evaluate a basis at one value of each shape, with shifts (n,) added to columns of the readings.

        Raises:
            ModelError: the basis returns an array of wrong shape, or uses a column that is absent.
        """
        if basis not in self._programs:
            try:
                columns = self._evaluate_matrix(basis, shapes, shifts)
                if not is_traced(columns):
                    return columns
            except ModelError:
                raise
            except Exception:  # the basis does not accept NumPy arrays
                pass
            self._is_vectorised[basis] = False
            self._programs[basis] = jax.jit(partial(self._evaluate_matrix, basis))
        return np.asarray(self._programs[basis](shapes, shifts))

    def evaluate_many(
        self,
        basis: Basis,
        shapes: Mapping[str, Float[np.ndarray, "s"]],
        shifts: Mapping[str, Float[np.ndarray, "*s n"]],
    ) -> Float[np.ndarray, "s n k"]:
        """Evaluate a basis at s values of the shapes; column shifts are (s, n), or (n,) for all values."""
        lengths = [len(v) for v in shapes.values()]
        lengths += [len(shift) for shift in shifts.values() if shift.ndim > 1]
        size = max(lengths, default=1)
        batches = []
        for rows in np.array_split(np.arange(size), -(-size * self.frame.size // MAX_ELEMENTS)):
            values = {n: np.broadcast_to(v, (size,))[rows] for n, v in shapes.items()}
            row_shifts = {n: m[rows] if m.ndim > 1 else m for n, m in shifts.items()}
            batches.append(self._evaluate_part(basis, values, row_shifts, len(rows)))
        return np.concatenate(batches)

    def _evaluate_part(
        self, basis: Basis, shapes: Mapping[str, Any], shifts: Mapping[str, Any], size: int
    ) -> Float[np.ndarray, "s n k"]:
        def column_at(i: int) -> Float[np.ndarray, "n k"]:
            part_shifts = {n: m[i] if m.ndim > 1 else m for n, m in shifts.items()}
            return self.evaluate(basis, {n: v[i] for n, v in shapes.items()}, part_shifts)

        if size > 1 and self._is_vectorised.get(basis, True):
            try:
                columns_of_shapes = {n: v[:, None] for n, v in shapes.items()}
                columns = self._evaluate_matrix(basis, columns_of_shapes, shifts, (size,))
            except Exception:  # not vectorised
                columns = None
            # The right array shape does not prove that the basis is vectorised: compare one value.
            if columns is not None and basis not in self._is_vectorised:
                pair, options = (columns[-1], column_at(size - 1)), {"atol": 0, "equal_nan": True}
                is_same = np.allclose(*pair, rtol=1e-12, **options)
                self._is_vectorised[basis] = is_same and basis not in self._programs
            if columns is not None and self._is_vectorised[basis]:
                return columns
            self._is_vectorised[basis] = False
        return np.array([column_at(i) for i in range(size)])

    def _evaluate_matrix(
        self,
        basis: Basis,
        shapes: Mapping[str, Any],
        shifts: Mapping[str, Any],
        batch_shape: tuple[int, ...] = (),
    ) -> Any:
        frame = self.frame.shift_columns(shifts)
        with np.errstate(all="ignore"):  # non-finite columns are refused by `Record.require_finite`
            return basis.evaluate(frame, shapes, (*batch_shape, *frame.order.shape[:-1]))
