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
            sentence = (
                f"{table.file!r} has two columns for {header.name!r}: {header.raw!r}, and "
                f"{chosen.raw!r} by columns=. Rename {header.raw!r} in the file, or leave "
                f"{header.name!r} out of columns="
            )
            cure = f"rename it, or leave {header.name} out of --columns"
            came = f"a second column {header.name}"
            problems.append(
                Problem(table.file, came, cure=cure, column=header.raw, sentence=sentence)
            )
            continue
        positions[header.name] = position
    _rename_synonyms(table, expected, positions, problems)
    for name, column in expected.items():
        if column.unit is not None or name not in positions:
            continue
        header = table.headers[positions[name]]
        if header.unit not in (None, "", "1", "-"):
            sentence = (
                f"{table.file!r}: column {header.raw!r} carries a unit, but "
                f"{name!r} is a label (text). Remove the unit, or rename the column"
            )
            came, cure = f"the unit {header.unit}", "Remove the unit, or rename the column"
            problems.append(
                Problem(table.file, came, "a label", cure, column=header.raw, sentence=sentence)
            )
    return positions


def _renamed_by_user(
    table: Table, columns: Mapping[str, str], problems: Problems
) -> dict[str, int]:
    """Our name → position, of the columns that `columns=` names; problems if a file lacks one, or it is named twice."""
    positions: dict[str, int] = {}
    for ours, theirs in columns.items():
        found = [i for i, h in enumerate(table.headers) if theirs.strip() in (h.name, h.raw)]
        if not found:
            sentence = (
                f"columns={{{ours!r}: {theirs!r}}}: {table.file!r} has no column "
                f"{theirs!r}{near(theirs, table)}. It has: {names_in(table)}"
            )
            cure = f"It has: {names_in(table)}{near(theirs, table)}"
            problems.append(
                Problem(table.file, "no such column", ours, cure, column=theirs, sentence=sentence)
            )
        elif found[0] in positions.values():
            other = next(name for name, position in positions.items() if position == found[0])
            sentence = (
                f"columns= gives {table.file!r}'s column {theirs!r} to both {other!r} and "
                f"{ours!r}: name one for each"
            )
            came = f"{other} and {ours} by --columns"
            problems.append(Problem(table.file, came, column=theirs, sentence=sentence))
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
                sentence = f"{table.file!r} has two columns for {name!r}: {first!r} and {second!r}. Remove one"
                came = f"another column {name}"
                problems.append(
                    Problem(table.file, came, cure="Remove one", column=second, sentence=sentence)
                )
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
            sentence = (
                f"{table.file!r}: a nominal scale was given for {name!r}, which is taken in the unit that "
                "it is in: leave the scale out, or choose an instrument whose output has a unit"
            )
            problems.append(Problem(table.file, "a nominal scale", column=name, sentence=sentence))
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
            names = " and ".join(repr(t.file) for t in tables)
            sentence = (
                f"units={{{name!r}: {unit!r}}}: {names} has "
                f"no column {name!r}{near(name, tables[0])}. It has: {names_in(tables[0])}"
            )
            cure = f"It has: {names_in(tables[0])}"
            problems.append(
                Problem(
                    tables[0].file,
                    "no such column",
                    f"one in {unit}",
                    cure,
                    column=name,
                    sentence=sentence,
                )
            )


def names_in(table: Table) -> str:
    return ", ".join(header.raw or "(no name)" for header in table.headers)


def near(name: str, table: Table) -> str:
    names = {header.name.lower(): header.raw for header in table.headers if header.name}
    near = difflib.get_close_matches(name.lower(), names, 1)
    return f" (is {names[near[0]]!r} meant?)" if near else ""
