"""The ordinary test of a laboratory: a few runs of a temperature profile, and a body that lags behind the thermometer.

    python -m benchmarks ordinary_test
    python -m benchmarks.ordinary_test.measurement --count 24 --readings 200 1600 --workers 2 --out FILE

Cells: how the body lags × whether the profile repeats × how many readings × five seeds, in an order drawn before any
was run; in each a random subset of run offsets, warm-up, a quadratic and the supply's voltage is hidden, at random
sizes, and one of two instruments reads the file. Bodies are integrated numerically (`bodies.py`), evidences of what is
hidden are exact (`oracle.py`). A line a campaign in results/ordinary_test.jsonl: stopped, it goes on where it was.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from benchmarks.ordinary_test import page
from benchmarks.ordinary_test.judged import INSTRUMENTS, judged
from benchmarks.ordinary_test.planned import go_through, in_order
from benchmarks.ordinary_test.worlds import STRUCTURES, Campaign, drawn
from benchmarks.record import RESULTS

PATH = RESULTS / "ordinary_test.jsonl"
READINGS = (200, 1600, 16_000)
SEEDS = 5
FURTHER = ("run", "warm-up", "curve", "supply")


class Cell(NamedTuple):
    """One campaign of the plan."""

    structure: str
    repeats: bool
    readings: int
    seed: int

    @property
    def rng(self) -> np.random.Generator:
        """Of everything in it."""
        return np.random.default_rng(
            [53, STRUCTURES.index(self.structure), self.repeats, self.readings, self.seed]
        )


def plan() -> list[Cell]:
    """All cells, in their order."""
    return in_order([Cell(*c) for c in product(STRUCTURES, (True, False), READINGS, range(SEEDS))])


def made(cell: Cell) -> tuple[Campaign, str]:
    """A cell's campaign, and the instrument that reads it."""
    rng = cell.rng
    hidden = tuple(f for f in FURTHER if rng.random() < 0.5)
    recorded = "supply" in hidden or bool(rng.random() < 0.5)
    instrument = sorted(INSTRUMENTS)[int(rng.integers(2))]
    return drawn(rng, *cell[:3], hidden, recorded=recorded), instrument


def measured(cell: Cell) -> dict[str, Any]:
    """One campaign's row."""
    return judged(*made(cell))


def main(arguments: Sequence[str] = ()) -> None:
    """Run what is missing, and render the page."""
    if go_through(plan(), measured, PATH, arguments) == PATH:
        page.write()


if __name__ == "__main__":
    main(sys.argv[1:])
