"""Which column of a file is which column of an instrument, and in which unit.

A file may call its columns otherwise (`columns=`), and leave their units out or get them wrong (`units=`). Columns that
no instrument asked for are kept if they have a unit: an effect of the user may need them; no file is refused for them.
"""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

from bayescal._core.errors import InputError
from bayescal._readings.column import Column, NominalScale
from bayescal._readings.header_reading import readings_of
from bayescal._readings.unit_conversion import fixed_unit
from bayescal._readings.unit_parsing import ANY, STANDARD_GRAVITY
from bayescal._tables.dates import LATEST
from bayescal._tables.problems import Problem, Problems
from bayescal._tables.raw_table import Header, Table

MISSING_READINGS = ("refuse", "drop")


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
        missing: "refuse" rows with a missing reading, or "drop" them.
        decimal: between the whole and its parts in text files; empty where the file shows it.
        others: columns of the file that are outputs of other channels, and left out.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    local_gravity: float = STANDARD_GRAVITY
    nominal_scale: NominalScale | None = None
    missing: str = "refuse"
    decimal: str = ""
    others: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Refuse what is no option.

        Raises:
            InputError: `missing` or `decimal` is another word.
        """
        if self.missing not in MISSING_READINGS:
            raise InputError(f"missing={self.missing!r} (--missing) is not one of refuse, drop")
        if self.decimal not in ("", ".", ","):
            raise InputError(f"decimal={self.decimal!r} (--decimal) is neither a point nor a comma")


def output_name(instrument: InstrumentLike) -> str:
    """Name of the instrument's output column."""
    name = getattr(instrument, "output", "output")
    return name if isinstance(name, str) else "output"


def expected_columns(instrument: InstrumentLike) -> dict[str, Column]:
    """The instrument's columns, and those that every instrument may have."""
    expected = {column.name: column for column in instrument.columns}
    output = expected.get(output_name(instrument))
    time = expected.get("time")
    if time is not None and time.high is None:
        expected["time"] = replace(time, high=LATEST)
    for name in ("run", "device", "axis"):
        expected.setdefault(name, Column(name, None, required=False))
    if output is not None:
        meaning = "known standard uncertainty of each output"
        uncertainty = Column("output_uncertainty", output.unit, meaning, required=False, low=0.0)
        expected.setdefault("output_uncertainty", uncertainty)
    return expected


def match(
    table: Table,
    expected: Mapping[str, Column],
    options: ReadOptions,
    problems: Problems,
) -> dict[str, int]:
    """Our name of every column → its position in the file.

    Args:
        table: the file, its headers understood.
        expected: the columns that it should have.
        options: renamings.
        problems: to add to, where `columns=` names what the file lacks, two columns would be one, or a label carries
            a unit.
    """
    positions = _renamed_by_user(table, options.columns, problems)
    for position, header in enumerate(table.headers):
        if position in positions.values() or not header.name:
            continue
        if header.name in positions:
            chosen = table.headers[positions[header.name]]
            came = f"a second {header.name!r} beside {chosen.raw!r}, which columns= names"
            cure = f"Rename it, or leave {header.name!r} out of columns= (--columns)"
            problems.append(Problem(table.file, came, cure=cure, column=header.raw))
            continue
        positions[header.name] = position
    _rename_synonyms(table, expected, positions, problems)
    for name, column in expected.items():
        if column.unit is not None or name not in positions:
            continue
        header = table.headers[positions[name]]
        if header.unit not in (None, "", "1", "-"):
            came, meant = f"carries the unit {header.unit}", f"a label (text) as {name!r}"
            cure = "Remove the unit, or rename the column"
            problems.append(Problem(table.file, came, meant, cure, column=header.raw))
    return positions


def _renamed_by_user(
    table: Table, columns: Mapping[str, str], problems: Problems
) -> dict[str, int]:
    """Our name → position, of the columns that `columns=` names; problems if a file lacks one, or it is named twice."""
    positions: dict[str, int] = {}
    for ours, theirs in columns.items():
        found = [i for i, h in enumerate(table.headers) if theirs.strip() in (h.name, h.raw)]
        if not found:
            came = f"no such column, but columns={{{ours!r}: {theirs!r}}}"
            cure = f"It has: {names_in(table)}{near(theirs, table)}"
            problems.append(Problem(table.file, came, cure=cure, column=theirs))
        elif found[0] in positions.values():
            other = next(name for name, position in positions.items() if position == found[0])
            came = f"both {other} and {ours} by columns= (--columns)"
            problems.append(Problem(table.file, came, cure="Name one for each", column=theirs))
        else:
            positions[ours] = found[0]
    return positions


def _rename_synonyms(
    table: Table, expected: Mapping[str, Column], positions: dict[str, int], problems: Problems
) -> None:
    """Give columns that a file holds under another of their names our own; a problem if it holds one under two."""
    for name, column in expected.items():
        for other in (n for n in column.also if n in positions and n not in expected):
            if name in positions:
                first, second = (table.headers[positions[n]].raw for n in (name, other))
                came = f"a second {name!r} beside {first!r}"
                problems.append(Problem(table.file, came, cure="Remove one", column=second))
                continue
            positions[name] = positions.pop(other)


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
    problems: Problems,
) -> dict[str, Column]:
    """The columns with a unit in place of "any": the fixed unit of what the file has.

    A known uncertainty follows its output. What has no unit, or one that is none, is refused where
    the column is converted; a nominal scale for an output that may be anything is a problem here.
    """
    fixed = dict(expected)
    for name, column in expected.items():
        if column.unit != ANY or name not in positions:
            continue
        if options.nominal_scale is not None:
            came = "a nominal scale was given, but it is taken in the unit that it is in"
            cure = "Leave the scale out, or choose an instrument whose output has a unit"
            problems.append(Problem(table.file, came, cure=cure, column=name))
        if name == "output_uncertainty":
            fixed[name] = replace(column, unit=fixed["output"].unit)
            continue
        unit = unit_of(table.headers[positions[name]], name, options)
        with contextlib.suppress(InputError):
            fixed[name] = column if unit is None else replace(column, unit=fixed_unit(unit))
    return fixed


def unused_units(tables: Sequence[Table], options: ReadOptions, problems: Problems) -> None:
    """Note each unit for a column that no file has: it was meant for one."""
    known = {
        name
        for t in tables
        for h in t.headers
        for name in (h.raw, *(r.name for r in readings_of(h)))
    }
    known |= set(options.columns)
    for name, unit in options.units.items():
        if name not in known:
            came = f"no such column, but units={{{name!r}: {unit!r}}}"
            others = "".join(f", nor has {t.file!r}" for t in tables[1:])
            cure = f"It has: {names_in(tables[0])}{near(name, tables[0])}{others}"
            problems.append(Problem(tables[0].file, came, cure=cure, column=name))


def names_in(table: Table) -> str:
    return ", ".join(header.raw or "(no name)" for header in table.headers)


def near(name: str, table: Table) -> str:
    names = {header.name.lower(): header.raw for header in table.headers if header.name}
    near = difflib.get_close_matches(name.lower(), names, 1)
    return f" (is {names[near[0]]!r} meant?)" if near else ""
