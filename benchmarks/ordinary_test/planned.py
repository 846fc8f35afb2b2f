"""A plan of campaigns in one random order: the first so many of it, what is missing of these, a row each."""

from __future__ import annotations

import argparse
import random
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.hidden_effects.resume import go_on

ORDER = 20261126  # seed of every order, drawn before anything was measured
TOLD = ("crash", "status", "final", "sets", "reason", "seconds")

Measure = Callable[[Any], dict[str, Any]]


def in_order(cells: Sequence[Any]) -> list[Any]:
    """Cells in the order in which they are measured."""
    found = list(cells)
    random.Random(ORDER).shuffle(found)
    return found


def go_through(
    cells: Sequence[Any], measure: Measure, path: Path, arguments: Sequence[str] = ()
) -> Path:
    """Measure what is missing of a plan's beginning.

    Args:
        cells: in their order, each a tuple of named fields.
        measure: from a cell to its row; a function of a module, that other processes can call.
        path: of the rows, unless `--out` says otherwise.
        arguments: `--count N`, `--readings N …`, `--workers N`, `--out FILE`.

    Returns:
        The file of the rows.
    """
    asked = argparse.ArgumentParser()
    asked.add_argument("--count", type=int, help="the first of the order")
    asked.add_argument("--readings", type=int, nargs="+", help="cells of so many readings alone")
    asked.add_argument("--workers", type=int, default=1)
    asked.add_argument("--out", type=Path, default=path)
    given = asked.parse_args(arguments)
    some = [c for c in cells if given.readings is None or c.readings in given.readings]
    cases = ((tuple(c), c) for c in some[: given.count])
    row = partial(_row, measure=measure)
    go_on(given.out, type(cells[0])._fields, cases, row, given.workers)
    return given.out


def _row(cell: NamedTuple, measure: Measure) -> tuple[dict[str, Any], str]:
    """A cell's row, and what is told of it; what ends in an error is a row of its own, and no right answer."""
    row: dict[str, Any] = cell._asdict()
    try:
        row |= measure(cell)
    except Exception as error:
        row["crash"] = f"{type(error).__name__}: {error}"
    return row, f"{tuple(cell)} " + " ".join(f"{k} {row[k]}" for k in TOLD if k in row)
