"""Which column of a file is which column of an instrument, and in which unit.

A file may call its columns otherwise (`columns=`), and leave their units out or get them wrong (`units=`). Columns that
no instrument asked for are kept if they have a unit: an effect of the user may need them; no file is refused for them.
"""

from __future__ import annotations

import contextlib
import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from bayescal._core.errors import InputError
from bayescal._data.column import Column, NominalScale
from bayescal._data.header_reading import readings_of
from bayescal._data.unit_conversion import convert, fixed_unit, same_dimension
from bayescal._data.unit_parsing import ANY, STANDARD_GRAVITY, parse
from bayescal._tables.dates import LATEST, ORDERS
from bayescal._tables.problems import Problem, Problems
from bayescal._tables.raw_table import Header, Table, in_one_line

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
        date_order: of month, day and year in dates such as 05/06/2026: "mdy", "dmy" or "ymd"; empty where the dates
            show it.
        ignore: columns of the file that are left out.
        only: whether all columns beside the instrument's are.
        others: columns of the file that are outputs of other channels, and left out.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    local_gravity: float = STANDARD_GRAVITY
    nominal_scale: NominalScale | None = None
    missing: str = "refuse"
    decimal: str = ""
    date_order: str = ""
    ignore: tuple[str, ...] = ()
    only: bool = False
    others: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Refuse what is no option.

        Raises:
            InputError: `missing`, `decimal` or `date_order` is another word.
        """
        if self.missing not in MISSING_READINGS:
            raise InputError(f"missing={self.missing!r} (--missing) is not one of refuse, drop")
        if self.decimal not in ("", ".", ","):
            raise InputError(f"decimal={self.decimal!r} (--decimal) is neither a point nor a comma")
        if self.date_order not in ("", *ORDERS):
            raise InputError(
                f"date_order={self.date_order!r} (--date-order) is not one of {', '.join(ORDERS)}: the order of month, "
                "day and year"
            )

    @classmethod
    def of(
        cls,
        instrument: InstrumentLike,
        *,
        nominal_scale: NominalScale | str | None = None,
        nominal_zero: str | None = None,
        ignore: Sequence[str] = (),
        **given: Any,
    ) -> ReadOptions:
        """As a user gives them: the nominal scale and zero as text, what is not said left out.

        Raises:
            InputError: `nominal_scale` or `nominal_zero` is not of its form, or not in a unit of this instrument.
        """
        made = cls(**given, ignore=tuple(ignore))
        scale = _scale_in_words(instrument, nominal_scale, nominal_zero, made.local_gravity)
        return replace(made, nominal_scale=scale)

    def leaves_out(self, header: Header) -> bool:
        """Whether a column is left out, as the user says."""
        return any(name in (header.raw, header.name) for name in self.ignore)


_NUMBER_AND_UNIT = re.compile(r"([+\-−]?\d*\.?\d+(?:[eE][+-]?\d+)?)\s*([^\d\s.].*)")


def _scale_in_words(
    instrument: InstrumentLike,
    scale: NominalScale | str | None,
    zero: str | None,
    local_gravity: float,
) -> NominalScale | None:
    """The nominal scale that is said: its gain as "250 V/g" (or "61 ug/count"), its zero as "1.21 V".

    Raises:
        InputError: one of them is not of this form, or in other units than those of a scale; or a zero without a scale.
    """
    if isinstance(scale, str):
        scale = _scale_from(instrument, scale, local_gravity)
    if zero is None:
        return scale
    scale = scale or instrument.nominal_scale
    if scale is None:
        raise InputError(
            f"nominal_zero={zero!r} (--nominal-zero) and no scale: {instrument.name!r} has none of its own. Say how "
            "the raw output becomes the instrument's: --nominal-scale '250 V/g'"
        )
    value, unit = _number_and_unit(zero, "nominal_zero", "--nominal-zero", f"1.21 {scale.unit}")
    if not same_dimension(unit, scale.unit):
        raise InputError(
            f"nominal_zero={zero!r} (--nominal-zero) is in {unit}, the nominal scale is of a raw output in "
            f"{scale.unit}: give the raw output at zero in that unit"
        )
    return replace(scale, offset=float(convert(value, unit, scale.unit)))


def _scale_from(instrument: InstrumentLike, text: str, local_gravity: float) -> NominalScale:
    """A nominal scale from a number in raw units per output unit, or the other way round."""
    unit = expected_columns(instrument)[output_name(instrument)].unit or "1"
    example = f"250 mV/({unit})" if "/" in unit else f"250 mV/{unit}"
    gain, said = _number_and_unit(text, "nominal_scale", "--nominal-scale", example)
    above, _, below = (part.strip() for part in said.partition("/"))
    for raw, inverse in ((above, False), (below, True)):
        wanted = f"({unit})/{raw}" if inverse else f"{raw}/({unit})"
        for whole in (said, f"{above}/({below})"):  # as it stands, and "mV/°/s" as it is meant
            if _alike_units(whole, wanted) and not _alike_units(raw, unit):
                per = float(convert(gain, whole, wanted, local_gravity=local_gravity))
                return NominalScale(raw, 1 / per if inverse and per else per)
    raise InputError(
        f"nominal_scale={text!r} (--nominal-scale) is not a raw unit per {unit}: give what one unit of output is of "
        f"the raw output, such as {example!r}"
    )


def _alike_units(a: str, b: str) -> bool:
    """Whether both are units, of one dimension."""
    with contextlib.suppress(InputError):
        return same_dimension(a, b)
    return False


def _number_and_unit(text: str, name: str, option: str, example: str) -> tuple[float, str]:
    found = _NUMBER_AND_UNIT.fullmatch(text.strip())
    if not found:
        raise InputError(
            f"{name}={text!r} ({option}) is no number with a unit: write it such as {example!r}"
        )
    try:
        parse(found[2])
    except InputError as error:
        raise InputError(f"{name}={text!r} ({option}): {error}") from None
    return float(found[1].replace("−", "-")), found[2]


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
    renamed = set(positions.values())
    for position, header in enumerate(table.headers):
        if position in renamed or not header.name:
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
        asked = in_one_line(theirs)
        found = [i for i, h in enumerate(table.headers) if asked in (h.name, h.raw)]
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


_AXIS = re.compile(
    r"(?:^|[\W_\d])[xyzXYZ](?=$|[\W_])|(?<=[a-z])[XYZ](?=$|[\W_])|^[xyz](?=acc|gyr|mag)"
)
# What a channel of the output's own axis is in; one in another unit, such as a drive voltage, is of the same sensor.
_MOTION = ("m/s^2", "rad/s", "rad", "uT", "count")


def channels_beside(output: str, columns: Mapping[str, str | None], unit: str | None) -> list[str]:
    """Columns that are channels of the unit whose output this is: of another axis, of its own and another motion, or
    of another number and alike.

    Channels of one unit see the same temperature and time, so that each follows the others, and causes none of them.

    Args:
        output: the file's name of the output, such as "acc_z" or "dut 3".
        columns: name → unit, of those that no instrument declares.
        unit: of the output.
    """
    numbered, axis = re.sub(r"\d+", "#", output), _axis(output)
    found = []
    for name, own in columns.items():
        alike = own and unit and same_dimension(own, unit) and re.sub(r"\d+", "#", name) == numbered
        another = axis and (its := _axis(name)) and (its != axis or _moves(own))
        if another or (alike and "#" in numbered):
            found.append(name)
    return found


def _axis(name: str) -> str:
    """The letter of the axis that a name ends in or begins with; "" if there is none."""
    found = _AXIS.findall(name)
    return found[-1][-1].lower() if found else ""


def _moves(unit: str | None) -> bool:
    """Whether a unit is of a motion or a field, or of none."""
    return unit is None or any(same_dimension(unit, motion) for motion in _MOTION)


def unused_options(tables: Sequence[Table], options: ReadOptions, problems: Problems) -> None:
    """Note each unit for a column that no file has, and each column to ignore: it was meant for one."""
    known = {
        name
        for t in tables
        for h in t.headers
        for name in (h.raw, *(r.name for r in readings_of(h)))
    }
    known |= set(options.columns)
    said = {name: f"units={{{name!r}: {unit!r}}}" for name, unit in options.units.items()}
    said |= {name: f"ignore=[{name!r}]" for name in options.ignore}
    for name, asked in said.items():
        if name not in known:
            came = f"no such column, but {asked}"
            others = "".join(f", nor has {t.file!r}" for t in tables[1:])
            cure = f"It has: {names_in(tables[0])}{near(name, tables[0])}{others}"
            problems.append(Problem(tables[0].file, came, cure=cure, column=name))


def names_in(table: Table) -> str:
    return ", ".join(header.raw or "(no name)" for header in table.headers)


def near(name: str, table: Table) -> str:
    names = {header.name.lower(): header.raw for header in table.headers if header.name}
    near = difflib.get_close_matches(name.lower(), names, 1)
    return f" (is {names[near[0]]!r} meant?)" if near else ""
