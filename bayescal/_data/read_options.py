"""Options of reading a file, and the columns that an instrument expects in it.

A file may call its columns otherwise (`columns=`), and leave their units out or get them wrong (`units=`).
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

from bayescal._core.errors import InputError
from bayescal._data.column import UNCERTAINTY, Column, NominalScale, Source
from bayescal._data.pose_rows import MAGNITUDE
from bayescal._data.records import RECORD
from bayescal._data.unit_conversion import (
    STANDARD_GRAVITY,
    convert,
    is_convertible,
    needs_gravity,
    parse,
    quantity,
    same_dimension,
)
from bayescal._tables.cells import EARLIEST, LATEST, ORDERS, parse_date
from bayescal._tables.raw_table import (
    Header,
    Objection,
    Objections,
    Table,
    called,
    in_one_line,
    option,
    readings_of,
)

_PERIOD = re.compile(r"(\d+\.?\d*)(?:\^(\d{1,2}))?\s*([^\d\s.^].*)?")


class InstrumentLike(Protocol):
    """Instrument as reading a file needs it. (It may also name its `output`.)"""

    @property
    def name(self) -> str: ...
    @property
    def columns(self) -> tuple[Column, ...]: ...
    @property
    def nominal_scale(self) -> NominalScale | None: ...


class ExpectedColumns(NamedTuple):
    """Columns that a file must hold, in place of an instrument."""

    name: str
    columns: tuple[Column, ...]
    nominal_scale: NominalScale | None
    output: str = "output"


@dataclass(frozen=True)
class ReadOptions:
    """Options of the user for reading a file; those not listed here are as `read` takes them.

    Attributes:
        columns: our name → the file's, or several, where files differ; for one file (`of_file`) the one that it has.
        local_field: in the unit of the instrument's column `magnitude`.
        only: whether all columns beside the instrument's are left out.
        others: columns of the file that are outputs of other channels, and left out.
        remembered: files read before with options: a header of theirs means the same.
        begin: a file's name, or "" for files without dates → when its first reading was taken.
        epoch: of the calibration, seconds since 1970; None where it has none.
    """

    columns: Mapping[str, Any] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    local_gravity: float | None = None
    local_field: float | None = None
    nominal_scale: NominalScale | None = None
    missing: str = "refuse"
    decimal: str = ""
    date_order: str = ""
    ignore: tuple[str, ...] = ()
    only: bool = False
    others: frozenset[str] = frozenset()
    unwrap: Mapping[str, str] = field(default_factory=dict)
    remembered: tuple[Source, ...] = ()
    begin: Mapping[str, str] = field(default_factory=dict)
    epoch: float | None = None

    def __post_init__(self) -> None:
        """Raise InputError where `missing`, `decimal` or `date_order` is another word."""
        allowed = {"missing": ("refuse", "drop")}
        allowed |= {"decimal": ("", ".", ","), "date_order": ("", *ORDERS)}
        for name, words in allowed.items():
            if (value := getattr(self, name)) not in words:
                argument = f"{name}={value!r} (--{name.replace('_', '-')})"
                raise InputError(f"{argument} is none of {', '.join(filter(None, words))}")

    @classmethod
    def of(
        cls,
        instrument: InstrumentLike,
        *,
        nominal_scale: NominalScale | str | None = None,
        nominal_zero: str | None = None,
        local_field: str | None = None,
        ignore: Sequence[str] = (),
        begin: str | Mapping[str, str] = "",
        **other_options: Any,
    ) -> ReadOptions:
        """Parse options that a user gives as text: nominal scale and zero, and the local field.

        Raises:
            InputError: one of them is not of its form, or not in a unit of this instrument.
        """
        options = cls(
            ignore=tuple(ignore),
            begin={"": begin} if begin and isinstance(begin, str) else dict(begin or {}),
            **other_options,
        )
        if local_field is not None:
            options = replace(options, local_field=_parse_field(instrument, local_field))
        scale = nominal_scale
        if isinstance(scale, str):
            scale = _parse_scale(instrument, scale, options.gravity)
        if nominal_zero is not None:
            scale = _with_zero(instrument, scale or instrument.nominal_scale, nominal_zero)
        return replace(options, nominal_scale=scale)

    @property
    def gravity(self) -> float:
        """Return the local gravity used, m/s²: standard gravity where nobody stated it."""
        return STANDARD_GRAVITY if self.local_gravity is None else self.local_gravity

    @property
    def headers(self) -> tuple[str, ...]:
        """Return all headers that the user names for columns."""
        return tuple(name for names in self.columns.values() for name in _as_sequence(names))

    def of_file(self, table: Table, other_tables: Sequence[Table] = ()) -> ReadOptions:
        """Return the options for one file: of several headers of a column, the one that it has.

        A header that it lacks and another file has is meant for that one: here it is not an option.
        """
        columns, units = dict[str, str](), dict(self.units)

        def present_in(names: Sequence[str], source: Table = table) -> list[str]:
            return [n for n in names if called(source.headers, in_one_line(n)) is not None]

        for ours, names in self.columns.items():
            present = present_in(_as_sequence(names))
            if present or not any(present_in(_as_sequence(names), other) for other in other_tables):
                columns[ours] = (present or _as_sequence(names))[0]
        raw, named = {header.raw for header in table.headers}, {*self.headers}
        for before in self.remembered:
            for ours, theirs in before.columns.items():
                new = ours not in {*self.columns, *columns}
                if new and theirs not in {*named, *columns.values()} and present_in([theirs]):
                    columns[ours] = theirs
            units = {h: unit for h, unit in before.units.items() if h in raw} | units
        return replace(self, columns=columns, units=units, remembered=())

    def is_ignored(self, header: Header) -> bool:
        """Return whether a column is excluded, by the user or as another channel's output."""
        return any(name in (header.raw, header.name) for name in (*self.ignore, *self.others))


def _as_sequence(names: str | Sequence[str]) -> Sequence[str]:
    return [names] if isinstance(names, str) else names


def _with_zero(instrument: InstrumentLike, scale: NominalScale | None, zero: str) -> NominalScale:
    """Return a nominal scale with the raw output at zero, such as "1.21 V"."""
    argument = f"nominal_zero={zero!r} (--nominal-zero)"
    if scale is None:
        raise InputError(
            f"{argument} and no scale: {instrument.name!r} has none of its own. Say how the raw output becomes the "
            "instrument's: --nominal-scale '250 V/g'"
        )
    value, unit = _number_and_unit(zero, argument, f"1.21 {scale.unit}")
    if not same_dimension(unit, scale.unit):
        raise InputError(
            f"{argument} is in {unit}, but the nominal scale is of a raw output in {scale.unit}: give the raw output "
            f"at zero in {scale.unit}"
        )
    return replace(scale, offset=float(convert(value, unit, scale.unit)))


def _parse_scale(instrument: InstrumentLike, text: str, local_gravity: float) -> NominalScale:
    """Parse a number in raw units per output unit, "250 V/g", or the other way round, "61 ug/count"."""
    unit = expected_columns(instrument)[output_name(instrument)].unit or "1"
    example = f"250 mV/({unit})" if "/" in unit else f"250 mV/{unit}"
    flag = f"nominal_scale={text!r} (--nominal-scale)"
    gain, ratio = _number_and_unit(text, flag, example)
    above, _, below = (part.strip() for part in ratio.partition("/"))
    for raw, inverse in ((above, False), (below, True)):
        target = f"({unit})/{raw}" if inverse else f"{raw}/({unit})"
        for whole in (ratio, f"{above}/({below})"):  # as it stands, and "mV/°/s" as it is meant
            if is_convertible(whole, target) and not is_convertible(raw, unit):
                per = float(convert(gain, whole, target, local_gravity=local_gravity))
                by_gravity = needs_gravity(whole, target)
                return NominalScale(raw, 1 / per if inverse and per else per, by_gravity=by_gravity)
    raise InputError(
        f"{flag} is not a raw unit per {unit}: give what one unit of output is of the raw output, such as {example!r}"
    )


def _parse_field(instrument: InstrumentLike, text: str) -> float:
    """Parse the magnitude of the local field, such as "48.2 uT", into the unit of the instrument's column."""
    argument = f"local_field={text!r} (--local-field)"
    value, unit = _number_and_unit(text, argument, "48.2 uT")
    target = next((str(c.unit) for c in instrument.columns if c.name == MAGNITUDE), "1")
    if same_dimension(unit, "uT") and same_dimension("uT", target):
        return float(convert(value, unit, target))
    raise InputError(
        f"{argument} is nothing that {instrument.name!r} can take: it is the magnitude of a magnetic field, such as "
        "'48.2 uT', and of magnetometers"
    )


def _number_and_unit(text: str, argument: str, example: str) -> tuple[float, str]:
    try:
        return quantity(text)
    except InputError as error:
        raise InputError(f"{argument}: {error}: write it such as {example!r}") from None


def output_name(instrument: InstrumentLike) -> str:
    """Return the name of the instrument's output column."""
    name = getattr(instrument, "output", "output")
    return name if isinstance(name, str) else "output"


def expected_columns(instrument: InstrumentLike) -> dict[str, Column]:
    """Return the instrument's columns, and those that every instrument may have."""
    expected = {column.name: column for column in instrument.columns}
    if (time := expected.get("time")) is not None and time.high is None:
        expected["time"] = replace(time, high=LATEST)
    for name in RECORD:
        expected.setdefault(name, Column(name, None, required=False))
    if (output := expected.get(output_name(instrument))) is not None:
        meaning = "known standard uncertainty of each output"
        uncertainty = Column(UNCERTAINTY, output.unit, meaning, required=False, low=0.0)
        expected.setdefault(UNCERTAINTY, uncertainty)
    return expected


def unit_of(header: Header, ours: str, options: ReadOptions) -> str | None:
    """Return the unit of a column: the user's, else its header's; None if neither."""
    names = (n for n in (header.raw, header.name, ours) if n in options.units)
    return next((options.units[n] for n in names), header.unit or None)


def parse_period(text: str) -> tuple[float, str]:
    """Parse the period of a counter, a number and its unit: "2^32us", "604800 s", "65536"."""
    match = _PERIOD.fullmatch(text.strip())
    if not match or not float(match[1]) > 0:
        raise InputError(
            f"unwrap={text!r} (--unwrap): write what the counter held when it began anew, such as '2^32us', '604800s' "
            "or '65536count'"
        )
    unit = match[3] or "1"
    parse(unit)
    return float(match[1]) ** int(match[2] or 1), unit


def parse_begin(text: str) -> tuple[float, bool]:
    """Parse the time of a first reading: seconds, and whether they count from 1970 or on a calibration's clock."""
    with contextlib.suppress(ValueError):
        (seconds,) = parse_date(text).values()
        if seconds >= EARLIEST:
            return seconds, True
    with contextlib.suppress(InputError):
        number, unit = quantity(text)
        return float(convert(number, unit, "s")), False
    raise InputError(
        f"begin={text!r} (--begin) is neither a date such as '2026-05-13 10:14:20' nor a time on the clock of the "
        "calibration such as '9 days'"
    )


def unused_options(tables: Sequence[Table], options: ReadOptions, problems: Objections) -> None:
    """Add a problem for each unit, ignored column and counter period given for a column that no file has."""
    first, *others = [t.file for t in tables]
    headers = [h for t in tables for h in t.headers]
    known_names = {n for h in headers for n in (h.raw, *(r.name for r in readings_of(h)))}
    known_names |= {*options.columns, *options.headers} | ({"time"} & options.unwrap.keys())
    if "" in options.begin and others:
        came = f"has one begin, {options.begin['']!r}, for {len(tables)} files"
        suggestion = option("--begin", f"{first}={options.begin['']}")
        problems.append(Objection(first, came, cure="Say of each", option=suggestion))
    arguments = {name: option("--unit", f"{name}={unit}") for name, unit in options.units.items()}
    arguments |= {name: option("--ignore", name) for name in options.ignore}
    arguments |= {n: option("--unwrap", f"{n}={text}") for n, text in options.unwrap.items()}
    for name in (n for n in arguments if n not in known_names):
        cure = f"It has: {names_in(tables[0])}" + "".join(f", nor has {file!r}" for file in others)
        came = f"has no column {name!r} ({arguments[name]})"
        problems.append(Objection(first, came, cure=cure))


def names_in(table: Table) -> str:
    """List the headers of a file, for messages."""
    return ", ".join(header.raw or "(no name)" for header in table.headers)
