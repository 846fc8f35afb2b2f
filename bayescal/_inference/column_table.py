"""Blocks of columns that the structures of a record share, and their products with each other at the nodes of a law."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._inference.noise_nodes import OneNode, Products

RESIDUAL = 0  # the number of the block of what a first fit left of the readings
SHARED = 1e-6  # of the largest singular value, below which a direction of columns takes nothing
KEPT_BYTES = 384 * 2**20  # of blocks and of products, above which all are forgotten


class ColumnTable:
    """Columns by block, and the products of each two blocks at the nodes of a law, made when first asked for.

    What a first structure's fixed columns explain is taken out of the residual, so that sums of squares are small
    differences; structures without these columns have them put back. For each block that a part of the readings was
    `taken` by, there are the amounts of its columns.
    """

    def __init__(self, residual: Float[np.ndarray, "n"]) -> None:
        self._blocks: dict[int, np.ndarray] = {RESIDUAL: residual[:, None]}
        self._numbers: dict[Any, int] = {}
        self._next = itertools.count(1)
        self._made: dict[OneNode, dict[int, _Block]] = {}
        self.taken: dict[int, Float[np.ndarray, "w"]] = {}
        self._started, self._bytes = False, 0

    def number(self, key: Any) -> int:
        """Return a number that stands for a key, the same for equal ones."""
        if key not in self._numbers:
            self._numbers[key] = next(self._next)
        return self._numbers[key]

    def block(self, key: Any, make: Callable[[], Float[np.ndarray, "n w"]]) -> int:
        """Return the number of a block, made where there is none."""
        number = self.number(key)
        if number not in self._blocks:
            self._blocks[number] = np.asfortranarray(make())
            self._bytes += self._blocks[number].nbytes
        return number

    def width(self, number: int) -> int:
        return self._blocks[number].shape[1]

    def drop(self, key: Any) -> None:
        """Forget a block, and its products."""
        number = self._numbers.pop(key)
        self._blocks.pop(number, None)
        for products_by_block in self._made.values():
            if (block := products_by_block.pop(number, None)) is not None:
                for other in block.products:
                    if other in products_by_block:
                        products_by_block[other].products.pop(number, None)

    def take(self, numbers: Sequence[int]) -> None:
        """Take what some blocks explain out of the residual, by least squares; once, nearly none of what they share."""
        if self._started:
            return
        self._started = True
        if not numbers:
            return
        columns, residual = np.hstack([self._blocks[i] for i in numbers]), self._blocks[RESIDUAL]
        # Columns of unit length: `SHARED` is then of directions, not of units.
        size = np.sqrt(np.sum(columns**2, axis=0))
        scale = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
        amounts = scale * np.linalg.lstsq(columns * scale, residual[:, 0], rcond=SHARED)[0]
        self._blocks[RESIDUAL] = residual - (columns @ amounts)[:, None]
        for i in numbers:
            self.taken[i], amounts = amounts[: self.width(i)], amounts[self.width(i) :]

    def products(self, nodes: OneNode, numbers: Sequence[int]) -> Products:
        """Return the products of some blocks' columns, side by side."""
        blocks = self._made.setdefault(nodes, {})
        for i in numbers:
            if i not in blocks:
                transformed = nodes.transform(self._blocks[i])
                blocks[i] = _Block(transformed, nodes.end_products(transformed), {})
                self._bytes += self._blocks[i].nbytes
        ends = np.cumsum([0, *map(self.width, numbers)])
        at = [slice(a, b) for a, b in itertools.pairwise(ends)]
        gram = np.empty((nodes.count, ends[-1], ends[-1]))
        for a, i in enumerate(numbers):
            partners, block = numbers[: a + 1], blocks[i]
            # Side by side: one after another would cost several times as much.
            if lacking := [j for j in partners if j not in block.products]:
                runs = zip(*(blocks[j].columns for j in lacking), strict=True)
                products = nodes.products(
                    block.columns, [np.concatenate(run, axis=1) for run in runs]
                )
                ends = np.cumsum([self.width(j) for j in lacking])[:-1]
                for j, part in zip(lacking, np.split(products, ends, axis=2), strict=True):
                    block.products[j] = np.ascontiguousarray(part)
                    blocks[j].products[i] = block.products[j].transpose(0, 2, 1)
                    self._bytes += part.nbytes
            for b, j in enumerate(partners):
                gram[:, at[a], at[b]] = block.products[j]
                gram[:, at[b], at[a]] = blocks[j].products[i]
        ends = ((k, [blocks[i].ends[k] for i in numbers]) for k in block.ends)
        looks = {k: np.concatenate(arrays, axis=2) for k, arrays in ends}
        if self._bytes > KEPT_BYTES:
            self.forget()
        return Products(gram, looks)

    def forget(self) -> None:
        """Forget all blocks but those taken out of the residual."""
        permanent = {RESIDUAL, *self.taken}
        self._blocks = {i: block for i, block in self._blocks.items() if i in permanent}
        self._made, self._bytes = {}, 0


class _Block(NamedTuple):
    """A block as the products are made of it: transformed columns, those at ends of runs, products by the other."""

    columns: list[np.ndarray]
    ends: dict[tuple[int, int], np.ndarray]
    products: dict[int, np.ndarray]
