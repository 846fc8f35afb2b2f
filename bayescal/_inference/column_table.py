"""Cache of basis columns of all model structures on a record, and of their pairwise inner products."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._inference.noise_nodes import Products, SingleNode

RESIDUAL = 0  # number of the block of residuals
RCOND = 1e-6  # smallest singular value used in a fit, relative to the largest
MAX_CACHE_BYTES = 384 * 2**20  # of blocks and products


class ColumnTable:
    """Blocks of basis columns, and pairwise inner products of blocks at the nodes of a noise law, computed on demand.

    A least-squares fit of the first structure's φ-independent columns is subtracted from the readings once, against
    cancellation in sums of squares; `fitted_coefficients` holds its coefficients by block. Structures without these
    columns add them back.
    """

    def __init__(self, residual: Float[np.ndarray, "n"]) -> None:
        self._blocks: dict[int, np.ndarray] = {RESIDUAL: residual[:, None]}
        self._numbers: dict[Any, int] = {}
        self._counter = itertools.count(1)
        self._products: dict[SingleNode, dict[int, _Block]] = {}
        self.fitted_coefficients: dict[int, Float[np.ndarray, "w"]] = {}
        self._is_fitted, self._bytes = False, 0

    def number(self, key: Any) -> int:
        """Return the number of a block by its hashable key; equal keys have the same number."""
        if key not in self._numbers:
            self._numbers[key] = next(self._counter)
        return self._numbers[key]

    def block(self, key: Any, compute_columns: Callable[[], Float[np.ndarray, "n w"]]) -> int:
        """Return the number of a block; its columns are computed by `compute_columns` unless they are cached."""
        number = self.number(key)
        if number not in self._blocks:
            self._blocks[number] = np.asfortranarray(compute_columns())
            self._bytes += self._blocks[number].nbytes
        return number

    def width(self, number: int) -> int:
        return self._blocks[number].shape[1]

    def discard(self, key: Any) -> None:
        """Remove a block and its products from the cache."""
        number = self._numbers.pop(key)
        self._blocks.pop(number, None)
        for products_by_block in self._products.values():
            if (block := products_by_block.pop(number, None)) is not None:
                for other_number in block.products:
                    if other_number in products_by_block:
                        products_by_block[other_number].products.pop(number, None)

    def remove_fit(self, numbers: Sequence[int]) -> None:
        """Subtract a least-squares fit of the given blocks from the residual; only the first call has an effect."""
        if self._is_fitted:
            return
        self._is_fitted = True
        if not numbers:
            return
        columns, residual = np.hstack([self._blocks[i] for i in numbers]), self._blocks[RESIDUAL]
        # Columns of unit length make `RCOND` independent of units.
        norms = np.sqrt(np.sum(columns**2, axis=0))
        scale = np.where(norms > 0, 1 / np.where(norms > 0, norms, 1.0), 0.0)
        coefficients = scale * np.linalg.lstsq(columns * scale, residual[:, 0], rcond=RCOND)[0]
        self._blocks[RESIDUAL] = residual - (columns @ coefficients)[:, None]
        for i in numbers:
            width = self.width(i)
            self.fitted_coefficients[i], coefficients = coefficients[:width], coefficients[width:]

    def products(self, nodes: SingleNode, numbers: Sequence[int]) -> Products:
        """Return the inner products of all columns of the given blocks, concatenated in their order."""
        blocks = self._products.setdefault(nodes, {})
        for i in numbers:
            if i not in blocks:
                transformed = nodes.transform(self._blocks[i])
                blocks[i] = _Block(transformed, nodes.end_products(transformed), {})
                self._bytes += self._blocks[i].nbytes
        ends = np.cumsum([0, *map(self.width, numbers)])
        slices = [slice(a, b) for a, b in itertools.pairwise(ends)]
        gram = np.empty((nodes.count, ends[-1], ends[-1]))
        for a, i in enumerate(numbers):
            earlier_numbers, block = numbers[: a + 1], blocks[i]
            # One product with all missing blocks is several times faster than one product each.
            if missing_numbers := [j for j in earlier_numbers if j not in block.products]:
                runs = zip(*(blocks[j].columns for j in missing_numbers), strict=True)
                products = nodes.products(
                    block.columns, [np.concatenate(run, axis=1) for run in runs]
                )
                ends = np.cumsum([self.width(j) for j in missing_numbers])[:-1]
                for j, part in zip(missing_numbers, np.split(products, ends, axis=2), strict=True):
                    block.products[j] = np.ascontiguousarray(part)
                    blocks[j].products[i] = block.products[j].transpose(0, 2, 1)
                    self._bytes += part.nbytes
            for b, j in enumerate(earlier_numbers):
                gram[:, slices[a], slices[b]] = block.products[j]
                gram[:, slices[b], slices[a]] = blocks[j].products[i]
        ends = ((k, [blocks[i].ends[k] for i in numbers]) for k in block.ends)
        end_products = {k: np.concatenate(arrays, axis=2) for k, arrays in ends}
        if self._bytes > MAX_CACHE_BYTES:
            self.clear()
        return Products(gram, end_products)

    def clear(self) -> None:
        """Clear all cached blocks except those whose fit was subtracted from the residual."""
        numbers = {RESIDUAL, *self.fitted_coefficients}
        self._blocks = {i: block for i, block in self._blocks.items() if i in numbers}
        self._products, self._bytes = {}, 0


class _Block(NamedTuple):
    """One block: transformed columns of each run, their inner products with run-end vectors and with other blocks."""

    columns: list[np.ndarray]
    ends: dict[tuple[int, int], np.ndarray]
    products: dict[int, np.ndarray]
