"""Annexes: what is built on the core and stands beside it, such as three axes, or many devices at once.

An installed package offers one by an entry point of the group `bayescal.annexes`: an `Annex`. The core imports none. It
asks all that are there, and without one all but what that offers stays as it is.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from typing import Any

GROUP = "bayescal.annexes"


class Annex:
    """What an annex may offer; here, what the core has without. Light until it is asked for something heavy."""

    def commands(self) -> Any:
        """Its commands, a `typer.Typer`."""


@cache
def installed_annexes() -> tuple[dict[str, Annex], dict[str, str]]:
    """Annexes by their names, and of those that are named but not there, why."""
    found, absent = dict[str, Annex](), dict[str, str]()
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name):
        try:
            found[entry.name] = entry.load()
        except ImportError as error:
            absent[entry.name] = f"The annex {entry.name!r} cannot be loaded ({error})"
    return found, absent


def annexes() -> list[Annex]:
    """Those that are installed, in the order of their names."""
    return [*installed_annexes()[0].values()]


def absent_annexes() -> str:
    """Which annexes are named but not there, in a sentence each; empty for none."""
    return ". ".join(installed_annexes()[1].values())
