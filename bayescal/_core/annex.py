"""Annexes: what is built on the core and stands beside it, such as three axes, or many devices at once.

An installed package offers one by an entry point of the group `bayescal.annexes`: a dictionary of some of

    commands            its commands, `Commands`
    exports             () → what `bayescal export` writes by formats of its own, of an `ExportRequest` an `Answer`
    corrections         () → its kinds of corrections, `CorrectionKind` each
    corrected           calibration → the correction of one that is of such a kind
    certificate         path → what a certificate's file states, as `bayescal.report` takes it
    decided             calibration, limits, **rule → what is decided about them, for a report
    noise_file          channels, topic, quantile → their noise as a file for another program
    result              calibration, average → what result.json holds behind the coefficients
    coefficient_tables  result.json → captions and tables behind a report's table of coefficients

The core imports none. It asks all that are there, and without one all but what that offers stays as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from bayescal._core.errors import InputError

GROUP = "bayescal.annexes"


@cache
def installed_annexes() -> tuple[dict[str, Mapping[str, Any]], dict[str, str]]:
    """Annexes by their names, and of those that are named but not there, why."""
    found, absent = dict[str, Mapping[str, Any]](), dict[str, str]()
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name):
        try:
            found[entry.name] = entry.load()
        except ImportError as error:
            absent[entry.name] = f"The annex {entry.name!r} cannot be loaded ({error})"
    return found, absent


def absent_annexes() -> str:
    """Which annexes are named but not there, in a sentence each; empty for none."""
    found, absent = installed_annexes()
    if not found and not absent:  # a checkout that was installed before it had any
        return "No annex is found: install bayescal once more"
    return ". ".join(absent.values())


def offered(name: str) -> list[Any]:
    """What the installed annexes offer by a name, in the order of their names."""
    return [one[name] for one in installed_annexes()[0].values() if name in one]


def first_offered(name: str, asked: str) -> Any:
    """What the first annex offers by a name.

    Args:
        name: of what is offered.
        asked: for what, as the user says it.

    Raises:
        InputError: none offers it.
    """
    for one in offered(name):
        return one
    raise InputError(f"{asked} takes an annex that is not there. {absent_annexes()}".rstrip())
