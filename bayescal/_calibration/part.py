"""Part of a record: some of its readings, whose columns are rows of those computed for all."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from bayescal._inference.column_products import ColumnProducts
from bayescal._inference.record import Basis, Record
from bayescal._model.frame import Frame
from bayescal._model.terms import ColumnsOf


class Part(Record):
    """The readings of a record that are kept; what happened between them stays in their columns."""

    def __init__(self, whole: Record, rows: np.ndarray) -> None:
        """Args:
        whole: the record.
        rows: the kept readings, in their order there.
        """
        frame = _frame(whole, rows)
        super().__init__(whole.instrument, frame, whole.y[rows], plain=whole.plain)
        self.whole, self.rows = whole, rows

    def columns(self, effect: ColumnsOf, values: tuple[float, ...]) -> Float[np.ndarray, "n k"]:
        return self.whole.columns(effect, values)[self.rows]

    def basis_along(self, effect: ColumnsOf) -> Basis | None:
        found = self.whole.basis_along(effect)
        return found and found._replace(columns=found.columns[self.rows])

    def moved_columns(
        self, effect: ColumnsOf, values: tuple[float, ...], moves: Mapping[str, np.ndarray]
    ) -> tuple[Float[np.ndarray, "n k"], dict[str, Float[np.ndarray, "n k"]]]:
        columns, slopes = self.whole.moved_columns(effect, values, self._spread(moves))
        return columns[self.rows], {name: slope[self.rows] for name, slope in slopes.items()}

    @cached_property
    def affine(self) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
        found = self.whole.affine
        if found is None:
            return None
        return found[0][self.rows], {name: slope[self.rows] for name, slope in found[1].items()}

    @cached_property
    def products(self) -> ColumnProducts:
        return self.whole.products.of_rows(self.rows)

    def several(
        self, slots: Mapping[str, np.ndarray], moves: Mapping[str, np.ndarray]
    ) -> Float[np.ndarray, "b n"]:
        return self.whole.several(self._spread(slots), self._spread(moves))[:, self.rows]

    def _response(self, slots, moves):
        mean, slopes = self.whole._response(self._spread(slots), self._spread(moves))
        return mean[self.rows], {name: slope[self.rows] for name, slope in slopes.items()}

    def _spread(self, values: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """The same on the whole record, zero where a reading is not kept."""
        found = {}
        for name, value in values.items():
            kept = np.broadcast_to(value, (*np.shape(value)[:-1], self.size))
            found[name] = np.zeros((*kept.shape[:-1], self.whole.size))
            found[name][..., self.rows] = kept
        return found


def _frame(whole: Record, rows: np.ndarray) -> Frame:
    """The kept readings in order of time, the steps between them those of all readings in between, summed."""
    order, step = whole.in_time
    place = np.full(whole.size, -1)
    place[rows] = np.arange(len(rows))
    kept = np.flatnonzero(place[order] >= 0)
    run = np.cumsum(step < 0)[kept]
    time = np.cumsum(np.maximum(step, 0.0))[kept]
    steps = np.diff(time, prepend=0.0)
    steps[np.diff(run, prepend=-1) != 0] = -1.0

    return jax.tree.map(np.asarray, whole.frame).reordered(rows, place[order[kept]], steps)
