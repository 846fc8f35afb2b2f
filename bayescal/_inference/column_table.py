"""Cache of basis columns of all model structures on a record, and of their pairwise inner products."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._inference.noise_nodes import OneNode, Products

RESIDUAL = 0  # number of the block that holds the residual of a first fit
RCOND = 1e-6  # singular values below this fraction of the largest are ignored in that fit
CACHE_BYTES = 384 * 2**20  # of blocks and products, above which the cache is cleared


class ColumnTable:
    """Blocks of columns, and the inner products of each two blocks at the nodes of a noise law, computed on demand.

    A least-squares fit of the first structure's fixed columns is subtracted from the readings once, against
    cancellation in sums of squares; `removed` holds its coefficients by block. Structures without these columns add
    them back.
    """

    def __init__(self, residual: Float[np.ndarray, "n"]) -> None:
        self._blocks: dict[int, np.ndarray] = {RESIDUAL: residual[:, None]}
        self._numbers: dict[Any, int] = {}
        self._next = itertools.count(1)
        self._made: dict[OneNode, dict[int, _Block]] = {}
        self.removed: dict[int, Float[np.ndarray, "w"]] = {}
        self._started, self._bytes = False, 0

    def number(self, key: Any) -> int:
        """Return the number of a key; equal keys have the same number."""
        if key not in self._numbers:
            self._numbers[key] = next(self._next)
        return self._numbers[key]

    def block(self, key: Any, make: Callable[[], Float[np.ndarray, "n w"]]) -> int:
        """Return the number of a block; compute its columns with `make` if it is not cached."""
        number = self.number(key)
        if number not in self._blocks:
            self._blocks[number] = np.asfortranarray(make())
            self._bytes += self._blocks[number].nbytes
        return number

    def width(self, number: int) -> int:
        return self._blocks[number].shape[1]

    def discard(self, key: Any) -> None:
        """Remove a block and its products from the cache."""
        number = self._numbers.pop(key)
        self._blocks.pop(number, None)
        for products_by_block in self._made.values():
            if (block := products_by_block.pop(number, None)) is not None:
                for other in block.products:
                    if other in products_by_block:
                        products_by_block[other].products.pop(number, None)

    def remove_fit(self, numbers: Sequence[int]) -> None:
        """Subtract the least-squares fit of some blocks from the residual; only the first call has an effect."""
        if self._started:
            return
        self._started = True
        if not numbers:
            return
        columns, residual = np.hstack([self._blocks[i] for i in numbers]), self._blocks[RESIDUAL]
        # Columns of unit length make `RCOND` independent of units.
        norms = np.sqrt(np.sum(columns**2, axis=0))
        scale = np.where(norms > 0, 1 / np.where(norms > 0, norms, 1.0), 0.0)
        amounts = scale * np.linalg.lstsq(columns * scale, residual[:, 0], rcond=RCOND)[0]
        self._blocks[RESIDUAL] = residual - (columns @ amounts)[:, None]
        for i in numbers:
            self.removed[i], amounts = amounts[: self.width(i)], amounts[self.width(i) :]

    def products(self, nodes: OneNode, numbers: Sequence[int]) -> Products:
        """Return the inner products of the columns of some blocks, concatenated."""
        blocks = self._made.setdefault(nodes, {})
        for i in numbers:
            if i not in blocks:
                transformed = nodes.transform(self._blocks[i])
                blocks[i] = _Block(transformed, nodes.end_products(transformed), {})
                self._bytes += self._blocks[i].nbytes
        ends = np.cumsum([0, *map(self.width, numbers)])
        slices = [slice(a, b) for a, b in itertools.pairwise(ends)]
        gram = np.empty((nodes.count, ends[-1], ends[-1]))
        for a, i in enumerate(numbers):
            others, block = numbers[: a + 1], blocks[i]
            # One product with all missing blocks is several times faster than one product each.
            if missing := [j for j in others if j not in block.products]:
                runs = zip(*(blocks[j].columns for j in missing), strict=True)
                products = nodes.products(
                    block.columns, [np.concatenate(run, axis=1) for run in runs]
                )
                ends = np.cumsum([self.width(j) for j in missing])[:-1]
                for j, part in zip(missing, np.split(products, ends, axis=2), strict=True):
                    block.products[j] = np.ascontiguousarray(part)
                    blocks[j].products[i] = block.products[j].transpose(0, 2, 1)
                    self._bytes += part.nbytes
            for b, j in enumerate(others):
                gram[:, slices[a], slices[b]] = block.products[j]
                gram[:, slices[b], slices[a]] = blocks[j].products[i]
        ends = ((k, [blocks[i].ends[k] for i in numbers]) for k in block.ends)
        end_products = {k: np.concatenate(arrays, axis=2) for k, arrays in ends}
        if self._bytes > CACHE_BYTES:
            self.clear()
        return Products(gram, end_products)

    def clear(self) -> None:
        """Clear all blocks except those subtracted from the residual."""
        permanent = {RESIDUAL, *self.removed}
        self._blocks = {i: block for i, block in self._blocks.items() if i in permanent}
        self._made, self._bytes = {}, 0


class _Block(NamedTuple):
    """One block: transformed columns by run, their products with the ends of runs, products by other block."""

    columns: list[np.ndarray]
    ends: dict[tuple[int, int], np.ndarray]
    products: dict[int, np.ndarray]
