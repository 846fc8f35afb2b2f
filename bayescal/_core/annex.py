"""Annexes: extensions built on the core, such as three axes, or many devices at once.

An installed package offers one by an entry point of the group `bayescal.annexes`: a dictionary of some of

    commands            its commands, classes of `Command`
    exports             () → formats of its own for `bayescal export`: a function of an `ExportCommand`, to an `Answer`
    corrections         its kinds of corrections, `CorrectionKind` each
    corrected           calibration → the correction of one that is of such a kind
    certificate         path → the statements of a certificate's file, as `bayescal.report` takes it
    decided             calibration, limits, **rule → the decisions about them, for a report
    reference_dcc       path, instrument, column → the error of a reference as an effect, by its certificate
    result              calibration, average → entries of result.json behind the coefficients
    coefficient_tables  result.json → captions and tables behind a report's table of coefficients
    log                 path, name, channels → the table of a log
    scalar_readings     instrument, values, units, file → three outputs as readings of one, their units, flags

each itself, or by its place as text, "module:name", that loads when it is needed. The core works without any.
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
    """Load the dictionary of each installed annex, in the order of their names."""
    annexes = list[Mapping[str, Any]]()
    for entry in sorted(entry_points(group="bayescal.annexes"), key=lambda entry: entry.name):
        with suppress(ImportError):  # it is not there: its commands are not, either
            annexes.append(entry.load())
    return annexes


def offered(name: str) -> list[Any]:
    """Load the entries of all installed annexes under a name."""
    offers = [annex[name] for annex in installed_annexes() if name in annex]
    return [resolve_name(offer) if isinstance(offer, str) else offer for offer in offers]


def first_offered(name: str, request: str) -> Any:
    """Load the first annex entry under a name; raise InputError for `request`, in a user's words, if none has it."""
    for offer in offered(name):
        return offer
    raise InputError(f"{request} takes an annex that is not there: install bayescal once more")
