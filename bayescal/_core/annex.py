"""Annexes: extensions built on the core, such as three axes, or many devices at once.

An installed package provides one by an entry point of the group `bayescal.annexes`: a dictionary with some of

    commands            commands, classes of `Command`
    exports             () → formats of `bayescal export`: name → function of an `ExportCommand`, to its `Answer`
    corrections         kinds of corrections, `CorrectionKind` each
    corrected           calibration → its correction
    certificate         path → the data of a certificate, for `bayescal.report`
    decided             calibration, limits, **rule → conformity decisions, for a report
    reference_dcc       path, instrument, column → the error of a reference standard, as an effect
    result              calibration, average → further entries of result.json
    coefficient_tables  result.json → captions and tables that follow a report's table of coefficients
    log                 path, name, channels → the table of a log
    scalar_readings     instrument, values, units, file → three-axis outputs as readings of one output, units, flags

given directly, or as text "module:name" to be loaded on demand. The core works without annexes.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import entry_points
from pkgutil import resolve_name
from typing import Any

from bayescal._core.errors import InputError


@cache
def installed_annexes() -> list[Mapping[str, Any]]:
    """Load the dictionaries of all installed annexes, sorted by name."""
    annexes = list[Mapping[str, Any]]()
    for entry in sorted(entry_points(group="bayescal.annexes"), key=lambda entry: entry.name):
        with suppress(ImportError):  # not installed: its commands are absent
            annexes.append(entry.load())
    return annexes


def offered(name: str) -> list[Any]:
    """Load the entries of one name from all installed annexes."""
    offers = [annex[name] for annex in installed_annexes() if name in annex]
    return [resolve_name(offer) if isinstance(offer, str) else offer for offer in offers]


def first_offered(name: str, request: str) -> Any:
    """Load the first annex entry of a name; raise InputError, with `request` as its subject, if there is none."""
    for offer in offered(name):
        return offer
    raise InputError(f"{request} needs a component that is not installed: install all of bayescal")
