"""Annexes: what is built on the core and stands beside it, such as three axes, or many devices at once.

An installed package offers one by an entry point of the group `bayescal.annexes`: a dictionary of some of

    commands            its commands, classes of `Command`
    exports             () → what `bayescal export` writes by formats of its own, of an `ExportCommand` an `Answer`
    corrections         its kinds of corrections, `CorrectionKind` each
    corrected           calibration → the correction of one that is of such a kind
    certificate         path → what a certificate's file states, as `bayescal.report` takes it
    decided             calibration, limits, **rule → what is decided about them, for a report
    noise_file          channels, topic, quantile → their noise as a file for another program
    result              calibration, average → what result.json holds behind the coefficients
    coefficient_tables  result.json → captions and tables behind a report's table of coefficients
    pictures            calibration → captions and pictures for the first page of a report
    log                 path, name, channels → the table of a log
    scalar_readings     instrument, values, units, file → three outputs as readings of one, their units, flags

each itself, or by its place as text, "module:name", that loads when it is asked for. The core imports none. It asks all
that are there, and without one all but what that offers stays as it is.
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
    """Return what each installed annex offers, in the order of their names."""
    found = list[Mapping[str, Any]]()
    for entry in sorted(entry_points(group="bayescal.annexes"), key=lambda entry: entry.name):
        with suppress(ImportError):  # it is not there: its commands are not, either
            found.append(entry.load())
    return found


def offered(name: str) -> list[Any]:
    """Return what the installed annexes offer by a name."""
    offers = [one[name] for one in installed_annexes() if name in one]
    return [resolve_name(one) if isinstance(one, str) else one for one in offers]


def first_offered(name: str, asked: str) -> Any:
    """Return what the first annex offers by a name; refuse what is `asked` for, in a user's words, else."""
    for one in offered(name):
        return one
    raise InputError(f"{asked} takes an annex that is not there: install bayescal once more")
