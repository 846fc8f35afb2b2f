"""The ordinary test of a laboratory: a few runs of a temperature profile, and a body that lags behind the thermometer.

Campaigns are combinations of the kind of lag, whether the profile repeats, the number of readings, and five seeds, in
an order drawn before the first was run. In each a random subset of run offsets, warm-up, a quadratic and the supply
voltage is hidden, at random sizes, and one of two instruments reads the file. Bodies are integrated numerically
(`bodies.py`); the evidences of hidden effects are exact (`oracle.py`).
"""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import numpy as np

from benchmarks.bank import Bank
from benchmarks.ordinary_test import page
from benchmarks.ordinary_test.judged import INSTRUMENTS, in_order, judged
from benchmarks.ordinary_test.worlds import STRUCTURES, Campaign, drawn

SAMPLE = 24  # campaigns that a release measures anew
COUNT = 60  # campaigns, the first of the order
READINGS = (200, 1600, 16_000)
LONGEST = 1600  # readings of a campaign that is measured: longer ones take minutes each
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
        """Return the campaign's random-number generator."""
        return np.random.default_rng(
            [53, STRUCTURES.index(self.structure), self.repeats, self.readings, self.seed]
        )


def plan() -> list[Cell]:
    """Return the measured campaigns, in order."""
    cells = in_order([Cell(*c) for c in product(STRUCTURES, (True, False), READINGS, range(SEEDS))])
    return [cell for cell in cells if cell.readings <= LONGEST][:COUNT]


def build(cell: Cell) -> tuple[Campaign, str]:
    """Build a campaign, and the name of the instrument that reads it."""
    rng = cell.rng
    hidden = tuple(f for f in FURTHER if rng.random() < 0.5)
    recorded = "supply" in hidden or bool(rng.random() < 0.5)
    instrument = sorted(INSTRUMENTS)[int(rng.integers(2))]
    return drawn(rng, *cell[:3], hidden, recorded=recorded), instrument


def measured(cell: Cell) -> dict[str, Any]:
    """Return the row of one campaign."""
    return judged(*build(cell))


BANKS = (Bank("ordinary_test", lambda: ((tuple(c), c) for c in plan()), measured, Cell._fields),)
render = page.render
