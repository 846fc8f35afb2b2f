"""Annexes: extensions of the core, such as calibration of three-axis sensors, or of many devices at once.

An installed package provides an annex by an entry point of the group `bayescal.annexes`: a dictionary with some of the
entries below, given directly or as text "module:name", which is then loaded on demand. The core works without annexes.

    commands            list of subclasses of `Command`
    exports             () → formats of `bayescal export`: name → function that maps an `ExportCommand` to its `Answer`
    corrections         list of kinds of correction files, of type `CorrectionKind`
    corrected           calibration → its correction
    certificate         path → the data of a certificate, for `bayescal.report`
    decided             calibration, limits, **rule → conformity decisions, for a report
    reference_dcc       path, instrument, column → the error of a reference standard, as an effect
    result              calibration, average → further entries of result.json
    coefficient_tables  result.json → captions and tables that follow a report's table of coefficients
    log                 path, name, channels → the table of a log
    scalar_readings     instrument, values, units, file → three-axis outputs as readings of one output, units, flags
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
def list_installed_annexes() -> list[Mapping[str, Any]]:
    """Return the dictionaries of all annexes that can be imported, sorted by the names of their entry points."""
    annexes = list[Mapping[str, Any]]()
    for entry in sorted(entry_points(group="bayescal.annexes"), key=lambda entry: entry.name):
        with suppress(ImportError):  # not installed: its commands are absent
            annexes.append(entry.load())
    return annexes


def load_entries(name: str) -> list[Any]:
    """Return the entry `name` of each installed annex that has one; an entry "module:name" is imported first."""
    entries = [annex[name] for annex in list_installed_annexes() if name in annex]
    return [resolve_name(entry) if isinstance(entry, str) else entry for entry in entries]


def load_entry(name: str, request: str) -> Any:
    """Return the entry `name` of the first annex that has one; else raise InputError, whose subject is `request`."""
    for entry in load_entries(name):
        return entry
    raise InputError(f"{request} needs a component that is not installed: install all of bayescal")
