"""Annexes: what is built on the core and stands beside it, such as three axes, or many devices at once.

An installed package offers one by an entry point of the group `bayescal.annexes`: an `Annex`. The core imports none. It
asks all that are there, and without one all but what that offers stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar

from bayescal._core.errors import InputError

GROUP = "bayescal.annexes"
Offered = TypeVar("Offered")


class Annex:
    """What an annex may offer; here, what the core has without. Light until it is asked for something heavy."""

    def commands(self) -> Any:
        """Its commands, a `typer.Typer`."""

    def corrections(self) -> Sequence[Any]:
        """Its kinds of corrections, `CorrectionKind` each."""
        return ()

    def corrected(self, calibration: Any) -> Any:
        """The correction of a calibration, if it is of one of its kinds."""

    def exports(self) -> Mapping[str, Callable[[Any], Any]]:
        """What `bayescal export` writes by formats of its own: of an `ExportRequest` an `Answer`."""
        return {}

    def certificate(self, path: str | Path) -> Any:
        """What a certificate's file states, as `bayescal.report` takes it."""

    def decided(self, calibration: Any, limits: Sequence[str], **rule: Any) -> Any:
        """What is decided about limits, as `bayescal.report` takes it, with a `doubt` where one is not met."""

    def noise_file(self, channels: Mapping[str, Any], topic: str, quantile: float) -> str | None:
        """The noise of channels as a file for another program: `bayescal noise --yaml`."""

    def result(self, calibration: Any, average: Any) -> Mapping[str, Any]:
        """What result.json holds behind the coefficients: of the last model, and of the average, if there is one."""
        return {}

    def coefficient_tables(self, data: Mapping[str, Any]) -> Sequence[tuple[str, Any]]:
        """Captions and tables behind a report's table of coefficients, made of result.json."""
        return ()


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
    found, absent = installed_annexes()
    if not found and not absent:  # a checkout that was installed before it had any
        return "No annex is found: install bayescal once more"
    return ". ".join(absent.values())


def first_offered(offered: Iterable[Offered | None], asked: str) -> Offered:
    """What the first annex offers that offers something.

    Args:
        offered: by each annex.
        asked: for what, as the user says it.

    Raises:
        InputError: none does.
    """
    for one in offered:
        if one is not None:
            return one
    raise InputError(f"{asked} takes an annex that is not there. {absent_annexes()}".rstrip())
