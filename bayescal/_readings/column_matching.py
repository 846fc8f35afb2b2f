"""Which column of a file is which column of an instrument, and in which unit.

A file may call its columns otherwise (`columns=`), and leave their units out or get them wrong
(`units=`). Columns that no instrument asked for are kept if they have a unit, because a user's own
effect may need them; they are never a reason to refuse a file.
"""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

from bayescal._core.errors import InputError
from bayescal._readings.column import TAKEN, Column, NominalScale
from bayescal._readings.raw_table import Header, Table
from bayescal._readings.unit_conversion import base_unit, fixed_unit
from bayescal._readings.unit_parsing import ANY, STANDARD_GRAVITY


class InstrumentLike(Protocol):
    """What reading a file asks of an instrument. (It may also name its `output`.)"""

    @property
    def name(self) -> str: ...
    @property
    def columns(self) -> tuple[Column, ...]: ...
    @property
    def nominal_scale(self) -> NominalScale | None: ...


@dataclass(frozen=True)
class ReadOptions:
    """What the user says beside the file.

    Attributes:
        columns: our name → the file's.
        units: the file's name, or ours → unit.
        local_gravity: m/s².
        nominal_scale: in place of the instrument's.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    local_gravity: float = STANDARD_GRAVITY
    nominal_scale: NominalScale | None = None


def output_name(instrument: InstrumentLike) -> str:
    """Name of the instrument's output column."""
    name = getattr(instrument, "output", "output")
    return name if isinstance(name, str) else "output"


def expected_columns(instrument: InstrumentLike) -> dict[str, Column]:
    """The instrument's columns, and those that every instrument may have."""
    expected = {column.name: column for column in instrument.columns}
    output = expected.get(output_name(instrument))
    for name in ("run", "device", "axis"):
        expected.setdefault(name, Column(name, None, required=False))
    if output is not None:
        meaning = "known standard uncertainty of each output"
        uncertainty = Column("output_uncertainty", output.unit, meaning, required=False, low=0.0)
        expected.setdefault("output_uncertainty", uncertainty)
    return expected


def match(table: Table, expected: Mapping[str, Column], options: ReadOptions) -> dict[str, int]:
    """Our name of every column → its position in the file.

    Raises:
        InputError: `columns=` names what the file lacks, two columns would be one, or a label
            carries a unit.
    """
    positions = _renamed_by_user(table, options.columns)
    for position, header in enumerate(table.headers):
        if position in positions.values() or not header.name:
            continue
        if header.name in positions:
            chosen = table.headers[positions[header.name]]
            raise InputError(
                f"{table.file!r} has two columns for {header.name!r}: {header.raw!r}, and "
                f"{chosen.raw!r} by columns=. Rename {header.raw!r} in the file, or leave "
                f"{header.name!r} out of columns="
            )
        positions[header.name] = position
    _rename_synonyms(table, expected, positions)
    for name, column in expected.items():
        if (
            column.unit is None
            and name in positions
            and table.headers[positions[name]].unit not in (None, "", "1", "-")
        ):
            raise InputError(
                f"{table.file!r}: column {table.headers[positions[name]].raw!r} carries a unit, but "
                f"{name!r} is a label (text). Remove the unit, or rename the column"
            )
    return positions


def _renamed_by_user(table: Table, columns: Mapping[str, str]) -> dict[str, int]:
    """Our name → position, of the columns that `columns=` names.

    Raises:
        InputError: the file lacks one, or one is named twice.
    """
    positions: dict[str, int] = {}
    for ours, theirs in columns.items():
        found = [i for i, h in enumerate(table.headers) if theirs.strip() in (h.name, h.raw)]
        if not found:
            raise InputError(
                f"columns={{{ours!r}: {theirs!r}}}: {table.file!r} has no column "
                f"{theirs!r}{_near(theirs, table)}. It has: {_names(table)}"
            )
        if found[0] in positions.values():
            other = next(name for name, position in positions.items() if position == found[0])
            raise InputError(
                f"columns= gives {table.file!r}'s column {theirs!r} to both {other!r} and "
                f"{ours!r}: name one for each"
            )
        positions[ours] = found[0]
    return positions


def _rename_synonyms(
    table: Table, expected: Mapping[str, Column], positions: dict[str, int]
) -> None:
    """Give columns that a file holds under another of their names our own.

    Raises:
        InputError: a file holds a column under two names.
    """
    for name, column in expected.items():
        for other in (n for n in column.also if n in positions and n not in expected):
            if name in positions:
                first, second = (table.headers[positions[n]].raw for n in (name, other))
                raise InputError(
                    f"{table.file!r} has two columns for {name!r}: {first!r} and {second!r}. Remove one"
                )
            positions[name] = positions.pop(other)


def refuse_missing(
    table: Table, expected: Mapping[str, Column], positions: Mapping[str, int], instrument: str
) -> None:
    """Refuse a file without a column that the instrument needs.

    Raises:
        InputError: it lacks one.
    """
    for name, column in expected.items():
        if column.required and name not in positions and column.default is None:
            asked = f"{name} [{column.example}]" if column.unit else name
            meaning = f" ({column.meaning})" if column.meaning else ""
            raise InputError(
                f"{table.file!r} lacks the column {name!r}{meaning} that {instrument!r} needs; it "
                f"has: {_names(table)}{_near(name, table)}. Add a column {asked!r}, or say which "
                f"one it is with columns={{{name!r}: …}} (--columns {name}=…)"
            )


def unit_of(header: Header, ours: str, options: ReadOptions) -> str | None:
    """The unit of a column: what the user says, else its header; None if neither."""
    for name in (header.raw, header.name, ours):
        if name in options.units:
            return options.units[name]
    return header.unit or None


def with_fixed_units(
    expected: Mapping[str, Column],
    table: Table,
    positions: Mapping[str, int],
    options: ReadOptions,
) -> dict[str, Column]:
    """The columns with a unit in place of "any": the fixed unit of what the file has.

    A known uncertainty follows its output. What has no unit, or one that is none, is refused where
    the column is converted.

    Raises:
        InputError: a nominal scale is given for an output that may be anything.
    """
    fixed = dict(expected)
    for name, column in expected.items():
        if column.unit != ANY or name not in positions:
            continue
        if options.nominal_scale is not None:
            raise InputError(
                f"{table.file!r}: a nominal scale was given for {name!r}, which is taken in the unit that "
                "it is in: leave the scale out, or choose an instrument whose output has a unit"
            )
        if name == "output_uncertainty":
            fixed[name] = replace(column, unit=fixed["output"].unit)
            continue
        unit = unit_of(table.headers[positions[name]], name, options)
        with contextlib.suppress(InputError):
            fixed[name] = column if unit is None else replace(column, unit=fixed_unit(unit))
    return fixed


def extra_columns(
    table: Table,
    expected: Mapping[str, Column],
    positions: Mapping[str, int],
    options: ReadOptions,
) -> tuple[dict[str, Column], list[str]]:
    """The columns beyond the instrument's that are kept, in base units, and why others are not."""
    kept: dict[str, Column] = {}
    flags: list[str] = []
    without_unit: list[str] = []
    for name in (n for n in positions if n not in expected):
        header = table.headers[positions[name]]
        unit = unit_of(header, name, options)
        if unit is None:
            without_unit.append(header.raw)
        elif name in TAKEN:
            flags.append(f"{table.file}: column {header.raw!r} ignored: the name {name!r} is taken")
        else:
            try:
                base = base_unit(unit)
            except InputError:
                flags.append(
                    f"{table.file}: column {header.raw!r} ignored: [{unit}] is no unit known here"
                )
            else:
                kept[name] = Column(name, base, required=False)
    without_unit += [
        f"column {i + 1}, without a name" for i, h in enumerate(table.headers) if not h.name
    ]
    if without_unit:
        flags.append(
            f"{table.file}: ignored, because they have no unit: {', '.join(without_unit)} (to keep "
            "one, write 'name [unit]' or give units=)"
        )
    return kept, flags


def refuse_unused_units(tables: Sequence[Table], options: ReadOptions) -> None:
    """Refuse a unit for a column that no file has: it was meant for one.

    Raises:
        InputError: there is such a unit.
    """
    known = {name for table in tables for h in table.headers for name in (h.raw, h.name)}
    known |= set(options.columns)
    for name, unit in options.units.items():
        if name not in known:
            raise InputError(
                f"units={{{name!r}: {unit!r}}}: {' and '.join(repr(t.file) for t in tables)} has "
                f"no column {name!r}{_near(name, tables[0])}. It has: {_names(tables[0])}"
            )


def _names(table: Table) -> str:
    return ", ".join(header.raw or "(no name)" for header in table.headers)


def _near(name: str, table: Table) -> str:
    names = {header.name.lower(): header.raw for header in table.headers if header.name}
    near = difflib.get_close_matches(name.lower(), names, 1)
    return f" (is {names[near[0]]!r} meant?)" if near else ""
