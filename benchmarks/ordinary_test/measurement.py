"""The ordinary test of a laboratory: a few runs of a temperature profile, and a body that lags behind the thermometer.

    python -m benchmarks ordinary_test
    python -m benchmarks.ordinary_test.measurement --count 24 --readings 200 1600 --workers 2 --out FILE

Cells: how the body lags × whether the profile repeats × how many readings × five seeds, in an order drawn before any
was run; in each a random subset of run offsets, warm-up, a quadratic and the supply's voltage is hidden, at random
sizes, and one of two instruments reads the file. Bodies are integrated numerically (`bodies.py`), evidences of what is
hidden are exact (`oracle.py`). A line a campaign in results/ordinary_test.jsonl: stopped, it goes on where it was.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.hidden_effects.resume import go_on
from benchmarks.ordinary_test import page
from benchmarks.ordinary_test.judged import INSTRUMENTS, judged
from benchmarks.ordinary_test.worlds import STRUCTURES, Campaign, drawn
from benchmarks.record import RESULTS, core, read_lines

PATH = RESULTS / "ordinary_test.jsonl"
READINGS = (200, 1600, 16_000)
SEEDS = 5
FURTHER = ("run", "warm-up", "curve", "supply")
ORDER = 20261126  # seed of the order


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


def plan(readings: Sequence[int] = READINGS) -> list[Cell]:
    """All cells in their random order, those of some sizes alone."""
    cells = [
        Cell(s, r, n, seed)
        for s in STRUCTURES
        for r in (True, False)
        for n in READINGS
        for seed in range(SEEDS)
    ]
    random.Random(ORDER).shuffle(cells)
    return [c for c in cells if c.readings in readings]


def made(cell: Cell) -> tuple[Campaign, str]:
    """A cell's campaign, and the instrument that reads it."""
    rng = cell.rng
    hidden = tuple(f for f in FURTHER if rng.random() < 0.5)
    recorded = "supply" in hidden or bool(rng.random() < 0.5)
    instrument = sorted(INSTRUMENTS)[int(rng.integers(2))]
    return drawn(rng, *cell[:3], hidden, recorded=recorded), instrument


def campaign(cell: Cell, code: str = "") -> tuple[dict[str, Any], str]:
    """One row, and what is told of it."""
    row: dict[str, Any] = {**cell._asdict(), "core": code}
    try:
        row |= judged(*made(cell))
    except Exception as error:  # a row of its own: what ends in an error is no right answer
        row |= {"crash": f"{type(error).__name__}: {error}"}
        return row, f"{tuple(cell)} {row['crash']}"
    told = f"lost {row['lost']} invented {row['invented']} {row['descriptions']}"
    return row, f"{tuple(cell)} {row['status']} {told} {row['seconds']:.0f} s"


def main(arguments: Sequence[str] = ()) -> None:
    """Run what is missing, and render the page."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    asked.add_argument("--count", type=int, help="the first cells of the order")
    asked.add_argument("--readings", type=int, nargs="+", default=READINGS, choices=READINGS)
    asked.add_argument("--workers", type=int, default=1)
    asked.add_argument("--out", type=Path, default=PATH, help="of the rows")
    given = asked.parse_args(arguments)
    done = {tuple(row[f] for f in Cell._fields) for row in read_lines(given.out)}
    cells = [c for c in plan(given.readings)[: given.count] if tuple(c) not in done]
    go_on(given.out, cells, partial(campaign, code=core()), workers=given.workers)
    if given.out == PATH:
        page.write()


if __name__ == "__main__":
    main(sys.argv[1:])
