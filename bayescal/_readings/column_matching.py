"""Which column of a file is which column of an instrument, and in which unit.

A file may call its columns otherwise (`columns=`), and leave their units out or get them wrong
(`units=`).
"""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

from bayescal._core.errors import InputError
from bayescal._readings import units as _units
from bayescal._readings.column import Column, NominalScale
from bayescal._readings.raw_table import Header, Table


class Expects(Protocol):
    """What the door asks of an instrument. (It may also name its `output`.)"""

    @property
    def name(self) -> str: ...
    @property
    def columns(self) -> tuple[Column, ...]: ...
    @property
    def nominal_scale(self) -> NominalScale | None: ...


@dataclass(frozen=True)
class Wishes:
    """What the user says beside the file.

    Attributes:
        columns: our name → the file's.
        units: the file's name, or ours → unit.
        local_gravity: m/s².
        nominal_scale: in place of the instrument's.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    local_gravity: float = _units.STANDARD_GRAVITY
    nominal_scale: NominalScale | None = None


def output_name(instrument: Expects) -> str:
    """Name of the instrument's output column."""
    name = getattr(instrument, "output", "output")
    return name if isinstance(name, str) else "output"


def expected_columns(instrument: Expects) -> dict[str, Column]:
    """The instrument's columns, and those that every instrument may have."""
    found = {column.name: column for column in instrument.columns}
    output = found.get(output_name(instrument))
    for name in ("run", "device", "axis"):
        found.setdefault(name, Column(name, None, required=False))
    if output is not None:
        meaning = "known standard uncertainty of each output"
        uncertainty = Column("output_uncertainty", output.unit, meaning, required=False, low=0.0)
        found.setdefault("output_uncertainty", uncertainty)
    return found


def settled(
    expected: Mapping[str, Column], table: Table, places: Mapping[str, int], wishes: Wishes
) -> dict[str, Column]:
    """The columns with a unit in place of "any": the fixed unit of what the file has.

    A known uncertainty follows its output. What has no unit, or one that is none, is left for the door
    to refuse.

    Raises:
        InputError: a nominal scale is given for an output that may be anything.
    """
    found = dict(expected)
    for name, column in expected.items():
        if column.unit != _units.ANY or name not in places:
            continue
        if wishes.nominal_scale is not None:
            raise InputError(
                f"{table.file!r}: a nominal scale was given for {name!r}, which is taken in the unit that "
                "it is in: leave the scale out, or choose an instrument whose output has a unit"
            )
        if name == "output_uncertainty":
            found[name] = replace(column, unit=found["output"].unit)
            continue
        unit = unit_of(table.headers[places[name]], name, wishes)
        with contextlib.suppress(InputError):
            found[name] = column if unit is None else replace(column, unit=_units.fixed_unit(unit))
    return found


def match(table: Table, expected: Mapping[str, Column], wishes: Wishes) -> dict[str, int]:
    """Our name of every column → its position in the file.

    Raises:
        InputError: `columns=` names what the file lacks, two columns would be one, or a label
            carries a unit.
    """
    places: dict[str, int] = {}
    for ours, theirs in wishes.columns.items():
        found = [i for i, h in enumerate(table.headers) if theirs.strip() in (h.name, h.raw)]
        if not found:
            raise InputError(
                f"columns={{{ours!r}: {theirs!r}}}: {table.file!r} has no column "
                f"{theirs!r}{_near(theirs, table)}. It has: {_names(table)}"
            )
        if found[0] in places.values():
            other = next(name for name, place in places.items() if place == found[0])
            raise InputError(
                f"columns= gives {table.file!r}'s column {theirs!r} to both {other!r} and "
                f"{ours!r}: name one for each"
            )
        places[ours] = found[0]
    for position, header in enumerate(table.headers):
        if position in places.values() or not header.name:
            continue
        if header.name in places:
            chosen = table.headers[places[header.name]]
            raise InputError(
                f"{table.file!r} has two columns for {header.name!r}: {header.raw!r}, and "
                f"{chosen.raw!r} by columns=. Rename {header.raw!r} in the file, or leave "
                f"{header.name!r} out of columns="
            )
        places[header.name] = position
    _rename(table, expected, places)
    for name, column in expected.items():
        if (
            column.unit is None
            and name in places
            and table.headers[places[name]].unit not in (None, "", "1", "-")
        ):
            raise InputError(
                f"{table.file!r}: column {table.headers[places[name]].raw!r} carries a unit, but "
                f"{name!r} is a label (text). Remove the unit, or rename the column"
            )
    return places


def _rename(table: Table, expected: Mapping[str, Column], places: dict[str, int]) -> None:
    """Give columns that a file holds under another of their names our own.

    Raises:
        InputError: a file holds a column under two names.
    """
    for name, column in expected.items():
        for other in (n for n in column.also if n in places and n not in expected):
            if name in places:
                first, second = (table.headers[places[n]].raw for n in (name, other))
                raise InputError(
                    f"{table.file!r} has two columns for {name!r}: {first!r} and {second!r}. Remove one"
                )
            places[name] = places.pop(other)


def refuse_missing(
    table: Table, expected: Mapping[str, Column], places: Mapping[str, int], instrument: str
) -> None:
    """Refuse a file without a column that the instrument needs.

    Raises:
        InputError: it lacks one.
    """
    for name, column in expected.items():
        if column.required and name not in places and column.default is None:
            asked = f"{name} [{column.example}]" if column.unit else name
            meaning = f" ({column.meaning})" if column.meaning else ""
            raise InputError(
                f"{table.file!r} lacks the column {name!r}{meaning} that {instrument!r} needs; it "
                f"has: {_names(table)}{_near(name, table)}. Add a column {asked!r}, or say which "
                f"one it is with columns={{{name!r}: …}} (--columns {name}=…)"
            )


def _names(table: Table) -> str:
    return ", ".join(header.raw or "(no name)" for header in table.headers)


def _near(name: str, table: Table) -> str:
    names = {header.name.lower(): header.raw for header in table.headers if header.name}
    near = difflib.get_close_matches(name.lower(), names, 1)
    return f" (is {names[near[0]]!r} meant?)" if near else ""


def unit_of(header: Header, ours: str, wishes: Wishes) -> str | None:
    """The unit of a column: what the user says, else its header; None if neither."""
    for name in (header.raw, header.name, ours):
        if name in wishes.units:
            return wishes.units[name]
    return header.unit or None


def refuse_unused_units(tables: Sequence[Table], wishes: Wishes) -> None:
    """Refuse a unit for a column that no file has: it was meant for one.

    Raises:
        InputError: there is such a unit.
    """
    known = {name for table in tables for h in table.headers for name in (h.raw, h.name)}
    known |= set(wishes.columns)
    for name, unit in wishes.units.items():
        if name not in known:
            raise InputError(
                f"units={{{name!r}: {unit!r}}}: {' and '.join(repr(t.file) for t in tables)} has "
                f"no column {name!r}{_near(name, tables[0])}. It has: {_names(tables[0])}"
            )
