"""Columns of effects on the host: bases called with NumPy's arrays, all values of a shape at once.

A basis that calls JAX by itself, as one of a user's own may, gives an array of JAX's or fails on NumPy's: a program
then computes its columns.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import ModelError
from bayescal._core.xp import is_traced
from bayescal._model.effect import Basis, matrix
from bayescal._model.frame import Frame

NUMBERS_AT_ONCE = 4_000_000  # of columns that are computed together, which bounds memory


class HostColumns:
    """Columns of bases on one set of readings.

    Attributes:
        frame: the readings; of several devices with a leading axis.
    """

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self._traced = set[Any]()  # bases that are JAX's
        self._together = dict[
            Any, bool
        ]()  # whether others take several values of a shape at a time

    def at(
        self, basis: Basis, shapes: Mapping[str, Any], moves: Mapping[str, np.ndarray]
    ) -> Float[np.ndarray, "n k"] | None:
        """Return columns at values of the shapes; None where the basis is JAX's.

        Args:
            basis: which.
            shapes: a value of each.
            moves: what columns of the readings are corrected by, (n,) each.

        Raises:
            ModelError: the basis returns another shape, or asks for a column that is not there.
        """
        return self._made(basis, shapes, moves, ())

    def along(
        self,
        basis: Basis,
        shapes: Mapping[str, Float[np.ndarray, "s"]],
        moves: Mapping[str, Float[np.ndarray, "*s n"]],
    ) -> Float[np.ndarray, "s n k"] | None:
        """Return columns at several values of the shapes, as `at`; columns of readings moved for each, or for all."""
        lengths = [len(v) for v in shapes.values()] + [len(m) for m in moves.values() if m.ndim > 1]
        size = max(lengths, default=1)
        step = max(1, NUMBERS_AT_ONCE // self.frame.size)
        parts = []
        for start in range(0, size, step):
            here = slice(start, min(size, start + step))
            own = {n: np.broadcast_to(v, (size,))[here] for n, v in shapes.items()}
            moved = {n: m[here] if m.ndim > 1 else m for n, m in moves.items()}
            parts.append(self._part(basis, own, moved, here.stop - start))
        return None if any(p is None for p in parts) else np.concatenate(parts)

    def _part(
        self, basis: Basis, shapes: Mapping[str, Any], moves: Mapping[str, Any], size: int
    ) -> Float[np.ndarray, "s n k"] | None:
        def one(i: int) -> Float[np.ndarray, "n k"] | None:
            moved = {n: m[i] if m.ndim > 1 else m for n, m in moves.items()}
            return self.at(basis, {n: v[i] for n, v in shapes.items()}, moved)

        if size > 1 and self._together.get(basis, True):
            try:
                leading = {n: v[:, None] for n, v in shapes.items()}
                made = self._made(basis, leading, moves, (size,))
            except ModelError:
                made = None
            if basis in self._traced:
                return None
            # A basis that was written for one value may return the right shape by chance.
            if made is not None and basis not in self._together:
                alone = one(size - 1)
                alike = np.allclose(made[-1], alone, rtol=1e-12, atol=0, equal_nan=True)  # pyright: ignore[reportArgumentType]
                self._together[basis] = alike
            if made is not None and self._together[basis]:
                return made
            self._together[basis] = False
        rows = [one(i) for i in range(size)]
        return None if any(row is None for row in rows) else np.array(rows)

    def _made(
        self,
        basis: Basis,
        shapes: Mapping[str, Any],
        moves: Mapping[str, np.ndarray],
        lead: tuple[int, ...],
    ) -> np.ndarray | None:
        if basis in self._traced:
            return None
        frame = self.frame
        for name, shift in moves.items():
            frame = frame.with_column(name, frame[name] + shift)
        try:
            with np.errstate(all="ignore"):  # what is not finite is refused where that is asked
                made = matrix(*basis, frame, shapes, (*lead, *frame.order.shape[:-1]))
        except ModelError:
            raise
        except (
            Exception
        ):  # of arrays that the basis cannot take: a program says what is wrong, if something is
            made = None
        if made is None or is_traced(made):
            if not lead:
                self._traced.add(basis)
            return None
        return made
