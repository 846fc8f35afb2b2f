"""Random numbers that are identical on every machine: variates computed here from the raw stream of PCG64.

NumPy guarantees the stream of a bit generator, but not the variates that a `Generator` computes from it (NEP 19).
Source of PCG64: M. O'Neill, HMC-CS-2014-0905.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from scipy.special import ndtri

Array = np.ndarray
Option = TypeVar("Option")


class Draws:
    """A stream of random variates, seeded by integers."""

    def __init__(self, *seed: int) -> None:
        self._bits = np.random.PCG64(np.random.SeedSequence(seed))

    def uniform(self, count: int) -> Array:
        """Draw numbers uniform in the open interval (0, 1), with 53 bits each, at the centres of the cells."""
        raw = self._bits.random_raw(count) >> np.uint64(11)
        return (raw.astype(float) + 0.5) * 2.0**-53

    def normal(self, count: int) -> Array:
        return ndtri(self.uniform(count))

    def between(self, low: float, high: float) -> float:
        return low + (high - low) * float(self.uniform(1)[0])

    def ratio(self, low: float, high: float) -> float:
        """Draw a number log-uniformly between two positive limits."""
        return low * (high / low) ** float(self.uniform(1)[0])

    def sign(self) -> float:
        return 1.0 if self.uniform(1)[0] < 0.5 else -1.0

    def shuffled(self, options: Sequence[Option]) -> list[Option]:
        return [options[i] for i in np.argsort(self.uniform(len(options)), kind="stable")]

    def one_of(self, options: Sequence[Option]) -> Option:
        return self.shuffled(options)[0]

    def wave(self, count: int, knots: int) -> Array:
        """Draw a smooth random function of mean 0 and standard deviation 1: a sum of six cosines.

        Args:
            count: number of values.
            knots: number of half periods of the fastest cosine.
        """
        at = (np.arange(count) + 0.5) / count
        orders = 1 + np.floor(self.uniform(6) * knots)
        phases, sizes = self.uniform(6), self.normal(6)
        course = np.zeros(count) + sum(
            s * np.cos(np.pi * (k * at + 2 * p))
            for k, p, s in zip(orders, phases, sizes, strict=True)
        )
        return (course - np.mean(course)) / np.std(course)
