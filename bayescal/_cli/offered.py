"""What a package offers for an instrument beside the instrument itself, by entry points of the instrument's name."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any

DEMONSTRATIONS = "bayescal.demos"
"""`run(folder, seed)` writes a demonstration to an existing folder."""

PAIR_SELECTIONS = "bayescal.pair_selections"
"""`select(calibration, criterion=…)` gives a table of pairs that prints itself and has `data()`, plain JSON."""


def offered(group: str, instrument: str) -> Callable[..., Any] | None:
    """What an installed package offers in a group for the instrument of this name; None where none does."""
    for found in entry_points(group=group, name=instrument):
        return found.load()
    return None
