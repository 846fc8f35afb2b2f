"""Options of reading a file, and the columns that an instrument expects in it."""

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
    parse_quantity,
    same_dimension,
)
from bayescal._tables.cells import EARLIEST_S, LATEST_S, ORDERS, parse_date
from bayescal._tables.raw_table import (
    Header,
    Objection,
    Objections,
    Table,
    find_header,
    list_splits,
    option,
    to_one_line,
)

_PERIOD = re.compile(r"(\d+\.?\d*)(?:\^(\d{1,2}))?\s*([^\d\s.^].*)?")


class InstrumentLike(Protocol):
    """Protocol of an instrument whose files are read; it may also have an attribute `output`, a column name."""

    @property
    def name(self) -> str: ...
    @property
    def columns(self) -> tuple[Column, ...]: ...
    @property
    def nominal_scale(self) -> NominalScale | None: ...


class ExpectedColumns(NamedTuple):
    """Expected columns of a file, for use in place of an instrument."""

    name: str
    columns: tuple[Column, ...]
    nominal_scale: NominalScale | None
    output: str = "output"


@dataclass(frozen=True)
class ReadOptions:
    """The user's options for reading a file; those not listed here are the arguments of `read`.

    Attributes:
        columns: bayescal's name → the file's, or several if files differ; reduced to one by `restrict_to`.
        local_field: magnitude of the field, in the unit of the instrument's column `magnitude`.
        only_declared: whether to ignore all columns that the instrument does not declare.
        others: columns to ignore because they are outputs of other channels.
        remembered: files read before, whose assignments of headers apply again.
        begin: name of a file, or "" for files without dates → time of its first reading.
        epoch: time zero of the calibration, seconds since 1970; None if it has no dates.
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
    only_declared: bool = False
    others: frozenset[str] = frozenset()
    unwrap: Mapping[str, str] = field(default_factory=dict)
    remembered: tuple[Source, ...] = ()
    begin: Mapping[str, str] = field(default_factory=dict)
    epoch: float | None = None

    def __post_init__(self) -> None:
        """Raise InputError for an invalid value of `missing`, `decimal` or `date_order`."""
        allowed = {"missing": ("refuse", "drop")}
        allowed |= {"decimal": ("", ".", ","), "date_order": ("", *ORDERS)}
        for name, words in allowed.items():
            if (value := getattr(self, name)) not in words:
                argument = f"{name}={value!r} (--{name.replace('_', '-')})"
                raise InputError(f"{argument} is not one of {', '.join(filter(None, words))}")

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
        """Create options from texts: nominal scale and zero, local field; raise InputError for a malformed text."""
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
            scale = _set_zero(instrument, scale or instrument.nominal_scale, nominal_zero)
        return replace(options, nominal_scale=scale)

    @property
    def gravity(self) -> float:
        """Return the local gravity, m/s²; standard gravity if it was not given."""
        return STANDARD_GRAVITY if self.local_gravity is None else self.local_gravity

    @property
    def headers(self) -> tuple[str, ...]:
        """Return all headers that the user assigns to columns."""
        return tuple(name for names in self.columns.values() for name in _as_sequence(names))

    def restrict_to(self, table: Table, other_tables: Sequence[Table] = ()) -> ReadOptions:
        """Return the options for one file: of several headers that the user gives for a column, the one that it has.

        Headers that only other files have are omitted.
        """
        columns, units = dict[str, str](), dict(self.units)

        def find_names(names: Sequence[str], source: Table = table) -> list[str]:
            return [n for n in names if find_header(source.headers, to_one_line(n)) is not None]

        for name, names in self.columns.items():
            matches = find_names(_as_sequence(names))
            if matches or not any(find_names(_as_sequence(names), other) for other in other_tables):
                columns[name] = (matches or _as_sequence(names))[0]
        raw_headers, assigned_headers = {header.raw for header in table.headers}, {*self.headers}
        for source in self.remembered:
            for name, header in source.columns.items():
                is_new = name not in {*self.columns, *columns}
                is_free = header not in {*assigned_headers, *columns.values()}
                if is_new and is_free and find_names([header]):
                    columns[name] = header
            units = {h: unit for h, unit in source.units.items() if h in raw_headers} | units
        return replace(self, columns=columns, units=units, remembered=())

    def is_ignored(self, header: Header) -> bool:
        """Return whether a column is excluded, by the user or as another channel's output."""
        return any(name in (header.raw, header.name) for name in (*self.ignore, *self.others))


def _as_sequence(names: str | Sequence[str]) -> Sequence[str]:
    return [names] if isinstance(names, str) else names


def _set_zero(instrument: InstrumentLike, scale: NominalScale | None, text: str) -> NominalScale:
    """Return `scale` with the raw output at zero input given by `text`, such as "1.21 V"."""
    argument = f"nominal_zero={text!r} (--nominal-zero)"
    if scale is None:
        raise InputError(
            f"{argument} without a nominal scale factor, which {instrument.name!r} does not define. Give the raw "
            "output per unit of output: --nominal-scale '250 V/g'"
        )
    value, unit = _parse_quantity(text, argument, f"1.21 {scale.unit}")
    if not same_dimension(unit, scale.unit):
        raise InputError(
            f"{argument} is in {unit}, but the nominal scale factor applies to raw outputs in {scale.unit}: give "
            f"the raw output at zero in {scale.unit}"
        )
    return replace(scale, offset=float(convert(value, unit, scale.unit)))


def _parse_scale(instrument: InstrumentLike, text: str, local_gravity: float) -> NominalScale:
    """Parse a nominal scale in raw units per output unit, "250 V/g", or inverted, "61 ug/count"."""
    unit = expected_columns(instrument)[output_name(instrument)].unit or "1"
    example = f"250 mV/({unit})" if "/" in unit else f"250 mV/{unit}"
    argument = f"nominal_scale={text!r} (--nominal-scale)"
    gain, ratio = _parse_quantity(text, argument, example)
    numerator, _, divisor = (part.strip() for part in ratio.partition("/"))
    for raw, is_inverse in ((numerator, False), (divisor, True)):
        target = f"({unit})/{raw}" if is_inverse else f"{raw}/({unit})"
        for gain_unit in (ratio, f"{numerator}/({divisor})"):  # "mV/°/s" also as mV/(°/s)
            if is_convertible(gain_unit, target) and not is_convertible(raw, unit):
                gain = float(convert(gain, gain_unit, target, local_gravity=local_gravity))
                by_gravity = needs_gravity(gain_unit, target)
                return NominalScale(raw, 1 / gain if is_inverse and gain else gain, 0.0, by_gravity)
    raise InputError(
        f"{argument} is not a scale factor from {unit} to raw units: give one such as {example!r}"
    )


def _parse_field(instrument: InstrumentLike, text: str) -> float:
    """Parse the magnitude of the local field, such as "48.2 uT"; return it in the unit of the instrument's column."""
    argument = f"local_field={text!r} (--local-field)"
    value, unit = _parse_quantity(text, argument, "48.2 uT")
    target = next((str(c.unit) for c in instrument.columns if c.name == MAGNITUDE), "1")
    if same_dimension(unit, "uT") and same_dimension("uT", target):
        return float(convert(value, unit, target))
    raise InputError(
        f"{argument} does not suit {instrument.name!r}: it is the magnitude of a magnetic field, such as '48.2 uT', "
        "for magnetometers only"
    )


def _parse_quantity(text: str, argument: str, example: str) -> tuple[float, str]:
    try:
        return parse_quantity(text)
    except InputError as error:
        raise InputError(f"{argument}: {error}: write, for example, {example!r}") from None


def output_name(instrument: InstrumentLike) -> str:
    """Return the name of the instrument's output column."""
    name = getattr(instrument, "output", "output")
    return name if isinstance(name, str) else "output"


def expected_columns(instrument: InstrumentLike) -> dict[str, Column]:
    """Return the columns expected in a file, by name: the instrument's, and those common to all instruments."""
    expected = {column.name: column for column in instrument.columns}
    if (time := expected.get("time")) is not None and time.high is None:
        expected["time"] = replace(time, high=LATEST_S)
    for name in RECORD:
        expected.setdefault(name, Column(name, None, required=False))
    if (output := expected.get(output_name(instrument))) is not None:
        meaning = "known standard uncertainty of each output"
        uncertainty = Column(UNCERTAINTY, output.unit, meaning, required=False, low=0.0)
        expected.setdefault(UNCERTAINTY, uncertainty)
    return expected


def unit_of(header: Header, name: str, options: ReadOptions) -> str | None:
    """Return the unit of a column: the user's, else its header's, else None."""
    names = (n for n in (header.raw, header.name, name) if n in options.units)
    return next((options.units[n] for n in names), header.unit or None)


def parse_period(text: str) -> tuple[float, str]:
    """Parse the wrap-around period of a counter, a number and its unit: "2^32us", "604800 s", "65536"."""
    match = _PERIOD.fullmatch(text.strip())
    if not match or not float(match[1]) > 0:
        raise InputError(
            f"unwrap={text!r} (--unwrap): write the period after which the counter wraps around, such as '2^32us', "
            "'604800s' or '65536count'"
        )
    unit = match[3] or "1"
    parse(unit)
    return float(match[1]) ** int(match[2] or 1), unit


def parse_begin(text: str) -> tuple[float, bool]:
    """Parse the time of a first reading; return it in s, and whether it is a date.

    A date counts from 1970, any other time from the origin of the calibration's clock.
    """
    with contextlib.suppress(ValueError):
        (seconds,) = parse_date(text).values()
        if seconds >= EARLIEST_S:
            return seconds, True
    with contextlib.suppress(InputError):
        number, unit = parse_quantity(text)
        return float(convert(number, unit, "s")), False
    raise InputError(
        f"begin={text!r} (--begin) is neither a date such as '2026-05-13 10:14:20' nor a time on the clock of the "
        "calibration such as '9 days'"
    )


def check_options(tables: Sequence[Table], options: ReadOptions, problems: Objections) -> None:
    """Add a problem for each option (unit, --ignore, --unwrap) given for a column that no file has."""
    first, *others = [t.file for t in tables]
    headers = [h for t in tables for h in t.headers]
    known_names = {n for h in headers for n in (h.raw, *(r.name for r in list_splits(h)))}
    known_names |= {*options.columns, *options.headers} | ({"time"} & options.unwrap.keys())
    if "" in options.begin and others:
        fault = f"needs its own start time: --begin {options.begin['']!r} is given for {len(tables)} files"
        suggestion = option("--begin", f"{first}={options.begin['']}")
        problems.append(Objection(first, fault, cure="Give one for each file", option=suggestion))
    arguments = {name: option("--unit", f"{name}={unit}") for name, unit in options.units.items()}
    arguments |= {name: option("--ignore", name) for name in options.ignore}
    arguments |= {n: option("--unwrap", f"{n}={text}") for n, text in options.unwrap.items()}
    for name in (n for n in arguments if n not in known_names):
        cure = f"It has: {format_headers(tables[0])}" + "".join(f", nor has {f!r}" for f in others)
        fault = f"has no column {name!r} ({arguments[name]})"
        problems.append(Objection(first, fault, cure=cure))


def format_headers(table: Table) -> str:
    """Format the headers of a file as a list for messages."""
    return ", ".join(header.raw or "(no name)" for header in table.headers)
