"""Blocks of columns that the structures of a record share, and their products with each other at the nodes of a law."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._inference.noise_nodes import OneNode, Products

RESIDUAL = "residual"  # the block of what a first fit left of the readings
SHARED = 1e-6  # of the largest singular value, below which a direction of columns takes nothing
KEPT_BYTES = 384 * 2**20  # of blocks and of products, above which all are forgotten


class ColumnTable:
    """Columns by block, and the products of each two blocks at the nodes of a law, made when first asked for.

    What a first structure's fixed columns explain is taken out of the residual, so that sums of squares are small
    differences; structures without these columns have them put back (`taken`).

    Attributes:
        taken: for each block that a part of the readings was taken by, the amounts of its columns.
    """

    def __init__(self, residual: Float[np.ndarray, "n"]) -> None:
        self._blocks: dict[Any, np.ndarray] = {RESIDUAL: residual[:, None]}
        self._nodes: dict[OneNode, tuple[dict[Any, Any], dict[tuple[Any, Any], np.ndarray]]] = {}
        self.taken: dict[Any, Float[np.ndarray, "w"]] = {}
        self._started, self._bytes = False, 0

    def block(self, key: Any, make: Callable[[], Float[np.ndarray, "n w"]]) -> np.ndarray:
        """Return a block, made where there is none."""
        if key not in self._blocks:
            self._blocks[key] = np.asfortranarray(make())
            self._bytes += self._blocks[key].nbytes
        return self._blocks[key]

    def drop(self, key: Any) -> None:
        """Forget a block, and what was made of it."""
        self._bytes -= self._blocks.pop(key).nbytes
        for transformed, pairs in self._nodes.values():
            transformed.pop(key, None)
            for pair in [pair for pair in pairs if key in pair]:
                del pairs[pair]

    def take(self, keys: Sequence[Any]) -> None:
        """Take what some blocks explain out of the residual, by least squares; once, nearly none of what they share."""
        if self._started:
            return
        self._started = True
        if not keys:
            return
        columns, residual = (
            np.concatenate([self._blocks[k] for k in keys], axis=1),
            self._blocks[RESIDUAL],
        )
        # Columns of unit length: `SHARED` is then of directions, not of units.
        size = np.sqrt(np.sum(columns**2, axis=0))
        scale = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
        amounts = scale * np.linalg.lstsq(columns * scale, residual[:, 0], rcond=SHARED)[0]
        self._blocks[RESIDUAL] = residual - (columns @ amounts)[:, None]
        for key in keys:
            width = self._blocks[key].shape[1]
            self.taken[key], amounts = amounts[:width], amounts[width:]

    def products(self, nodes: OneNode, keys: Sequence[Any]) -> Products:
        """Return the products of some blocks' columns, side by side."""
        transformed, pairs = self._nodes.setdefault(nodes, ({}, {}))
        for key in keys:
            if key not in transformed:
                own = nodes.transform(self._blocks[key])
                transformed[key] = own, nodes.end_products(own)
                self._bytes += self._blocks[key].nbytes
        ends = np.cumsum([0, *(self._blocks[k].shape[1] for k in keys)])
        at = [slice(a, b) for a, b in zip(ends, ends[1:], strict=False)]
        found = np.empty((nodes.count, ends[-1], ends[-1]))
        for i, key in enumerate(keys):
            lacking = [j for j in range(i + 1) if (key, keys[j]) not in pairs]
            if lacking:  # side by side: one after another would cost several times as much
                left = transformed[key][0]
                right = [transformed[keys[j]][0] for j in lacking]
                beside = [np.concatenate(run, axis=1) for run in zip(*right, strict=True)]
                made, end = nodes.products(left, beside), 0
                for j in lacking:
                    begin, end = end, end + at[j].stop - at[j].start
                    own = np.ascontiguousarray(made[:, :, begin:end])
                    pairs[key, keys[j]], pairs[keys[j], key] = own, own.transpose(0, 2, 1)
                    self._bytes += own.nbytes
            for j in range(i + 1):
                found[:, at[i], at[j]] = pairs[key, keys[j]]
                found[:, at[j], at[i]] = pairs[keys[j], key]
        looks = {
            k: np.concatenate([transformed[key][1][k] for key in keys], axis=2)
            for k in transformed[RESIDUAL][1]
        }
        if self._bytes > KEPT_BYTES:
            self._forget()
        return Products(found, looks)

    def _forget(self) -> None:
        """Forget all but what the residual was taken by."""
        kept = {RESIDUAL, *self.taken}
        self._blocks = {k: block for k, block in self._blocks.items() if k in kept}
        self._nodes, self._bytes = {}, 0
