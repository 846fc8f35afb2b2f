"""What the user says beside a file, and what an instrument expects in it.

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
    alike,
    convert,
    needs_gravity,
    parse,
    quantity,
    same_dimension,
)
from bayescal._tables.cells import EARLIEST, LATEST, ORDERS, unix_seconds
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

MISSING_READINGS = ("refuse", "drop")
_PERIOD = re.compile(r"(\d+\.?\d*)(?:\^(\d{1,2}))?\s*([^\d\s.^].*)?")


class InstrumentLike(Protocol):
    """What reading a file asks of an instrument. (It may also name its `output`.)"""

    @property
    def name(self) -> str: ...
    @property
    def columns(self) -> tuple[Column, ...]: ...
    @property
    def nominal_scale(self) -> NominalScale | None: ...


class ExpectedColumns(NamedTuple):
    """What a file must hold, as reading asks an instrument."""

    name: str
    columns: tuple[Column, ...]
    nominal_scale: NominalScale | None
    output: str = "output"


@dataclass(frozen=True)
class ReadOptions:
    """What the user says beside the file; those not named here are as `read` takes them.

    Attributes:
        columns: our name → the file's, or several, where files differ; of one file (`of_file`) the one that it has.
        local_field: in the unit of the instrument's column `magnitude`.
        only: whether all columns beside the instrument's are left out.
        others: columns of the file that are outputs of other channels, and left out.
        remembered: files of which it was said before how they are read: a header that stands there means the same.
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
        if self.missing not in MISSING_READINGS:
            raise InputError(f"missing={self.missing!r} (--missing) is not one of refuse, drop")
        if self.decimal not in ("", ".", ","):
            raise InputError(f"decimal={self.decimal!r} (--decimal) is neither a point nor a comma")
        if self.date_order not in ("", *ORDERS):
            raise InputError(
                f"date_order={self.date_order!r} (--date-order) is not one of {', '.join(ORDERS)}: the order of month, "
                "day and year, or of hours, minutes and seconds"
            )

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
        **given: Any,
    ) -> ReadOptions:
        """Parse what a user gives as text: nominal scale and zero, and the local field.

        Raises:
            InputError: one of them is not of its form, or not in a unit of this instrument.
        """
        options = cls(
            ignore=tuple(ignore),
            begin={"": begin} if begin and isinstance(begin, str) else dict(begin or {}),
            **given,
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
        """Local gravity as it is taken, m/s²: standard gravity where nobody stated it."""
        return STANDARD_GRAVITY if self.local_gravity is None else self.local_gravity

    @property
    def headers(self) -> tuple[str, ...]:
        """All headers that columns are said to have."""
        return tuple(name for names in self.columns.values() for name in _several(names))

    def of_file(self, table: Table, beside: Sequence[Table] = ()) -> ReadOptions:
        """Return the options of one file: of several headers of a column, the one that it has.

        A header that it lacks and a file beside it has was said for that one: here nothing is said of its column.
        """
        columns, units = dict[str, str](), dict(self.units)

        def there(names: Sequence[str], one: Table = table) -> list[str]:
            return [n for n in names if called(one.headers, in_one_line(n)) is not None]

        for ours, names in self.columns.items():
            found = there(_several(names))
            if found or not any(there(_several(names), one) for one in beside):
                columns[ours] = (found or _several(names))[0]
        raw, said = {header.raw for header in table.headers}, {*self.headers}
        for before in self.remembered:
            for ours, theirs in before.columns.items():
                new = ours not in {*self.columns, *columns}
                if new and theirs not in {*said, *columns.values()} and there([theirs]):
                    columns[ours] = theirs
            units = {h: unit for h, unit in before.units.items() if h in raw} | units
        return replace(self, columns=columns, units=units, remembered=())

    def leaves_out(self, header: Header) -> bool:
        """Whether a column is left out, as the user says, or as it is another channel's output."""
        return any(name in (header.raw, header.name) for name in (*self.ignore, *self.others))


def _several(names: str | Sequence[str]) -> Sequence[str]:
    return [names] if isinstance(names, str) else names


def _with_zero(instrument: InstrumentLike, scale: NominalScale | None, zero: str) -> NominalScale:
    """Return a nominal scale with the raw output at zero, such as "1.21 V"."""
    said = f"nominal_zero={zero!r} (--nominal-zero)"
    if scale is None:
        raise InputError(
            f"{said} and no scale: {instrument.name!r} has none of its own. Say how the raw output becomes the "
            "instrument's: --nominal-scale '250 V/g'"
        )
    value, unit = _number_and_unit(zero, said, f"1.21 {scale.unit}")
    if not same_dimension(unit, scale.unit):
        raise InputError(
            f"{said} is in {unit}, the nominal scale is of a raw output in {scale.unit}: give the raw output at zero "
            "in that unit"
        )
    return replace(scale, offset=float(convert(value, unit, scale.unit)))


def _parse_scale(instrument: InstrumentLike, text: str, local_gravity: float) -> NominalScale:
    """Parse a number in raw units per output unit, "250 V/g", or the other way round, "61 ug/count"."""
    unit = expected_columns(instrument)[output_name(instrument)].unit or "1"
    example = f"250 mV/({unit})" if "/" in unit else f"250 mV/{unit}"
    said = f"nominal_scale={text!r} (--nominal-scale)"
    gain, ratio = _number_and_unit(text, said, example)
    above, _, below = (part.strip() for part in ratio.partition("/"))
    for raw, inverse in ((above, False), (below, True)):
        wanted = f"({unit})/{raw}" if inverse else f"{raw}/({unit})"
        for whole in (ratio, f"{above}/({below})"):  # as it stands, and "mV/°/s" as it is meant
            if alike(whole, wanted) and not alike(raw, unit):
                per = float(convert(gain, whole, wanted, local_gravity=local_gravity))
                by_gravity = needs_gravity(whole, wanted)
                return NominalScale(raw, 1 / per if inverse and per else per, by_gravity=by_gravity)
    raise InputError(
        f"{said} is not a raw unit per {unit}: give what one unit of output is of the raw output, such as {example!r}"
    )


def _parse_field(instrument: InstrumentLike, text: str) -> float:
    """Parse the magnitude of the local field, such as "48.2 uT", into the unit of the instrument's column."""
    said = f"local_field={text!r} (--local-field)"
    value, unit = _number_and_unit(text, said, "48.2 uT")
    target = next((str(c.unit) for c in instrument.columns if c.name == MAGNITUDE), "1")
    if same_dimension(unit, "uT") and same_dimension("uT", target):
        return float(convert(value, unit, target))
    raise InputError(
        f"{said} is nothing that {instrument.name!r} can take: it is the magnitude of a magnetic field, such as "
        "'48.2 uT', and of magnetometers"
    )


def _number_and_unit(text: str, said: str, example: str) -> tuple[float, str]:
    try:
        return quantity(text)
    except InputError as error:
        raise InputError(f"{said}: {error}: write it such as {example!r}") from None


def output_name(instrument: InstrumentLike) -> str:
    """Name of the instrument's output column."""
    name = getattr(instrument, "output", "output")
    return name if isinstance(name, str) else "output"


def expected_columns(instrument: InstrumentLike) -> dict[str, Column]:
    """Return the instrument's columns, and those that every instrument may have."""
    expected = {column.name: column for column in instrument.columns}
    time = expected.get("time")
    if time is not None and time.high is None:
        expected["time"] = replace(time, high=LATEST)
    for name in RECORD:
        expected.setdefault(name, Column(name, None, required=False))
    if (output := expected.get(output_name(instrument))) is not None:
        meaning = "known standard uncertainty of each output"
        own = Column(UNCERTAINTY, output.unit, meaning, required=False, low=0.0)
        expected.setdefault(UNCERTAINTY, own)
    return expected


def unit_of(header: Header, ours: str, options: ReadOptions) -> str | None:
    """Return the unit of a column: what the user says, else its header's; None if neither."""
    names = (n for n in (header.raw, header.name, ours) if n in options.units)
    return next((options.units[n] for n in names), header.unit or None)


def period_of(text: str) -> tuple[float, str]:
    """Parse what a counter holds when it begins anew, a number and its unit: "2^32us", "604800 s", "65536"."""
    found = _PERIOD.fullmatch(text.strip())
    if not found or not float(found[1]) > 0:
        raise InputError(
            f"unwrap={text!r} (--unwrap): write what the counter held when it began anew, such as '2^32us', '604800s' "
            "or '65536count'"
        )
    unit = found[3] or "1"
    parse(unit)
    return float(found[1]) ** int(found[2] or 1), unit


def parse_begin(text: str) -> tuple[float, bool]:
    """Parse when a first reading was taken: seconds, and whether they count from 1970 or on a calibration's clock."""
    with contextlib.suppress(ValueError):
        (found,) = unix_seconds(text).values()
        if found >= EARLIEST:
            return found, True
    with contextlib.suppress(InputError):
        number, unit = quantity(text)
        return float(convert(number, unit, "s")), False
    raise InputError(
        f"begin={text!r} (--begin) is neither a date such as '2026-05-13 10:14:20' nor a time on the clock of the "
        "calibration such as '9 days'"
    )


def unused_options(tables: Sequence[Table], options: ReadOptions, problems: Objections) -> None:
    """Note each unit, each column to ignore and each counter that is said for a column that no file has."""
    first, *others = [t.file for t in tables]
    headers = [h for t in tables for h in t.headers]
    known = {n for h in headers for n in (h.raw, *(r.name for r in readings_of(h)))}
    known |= {*options.columns, *options.headers} | ({"time"} & options.unwrap.keys())
    if "" in options.begin and others:
        came = f"has one begin, {options.begin['']!r}, for {len(tables)} files"
        asked = option("--begin", f"{first}={options.begin['']}")
        problems.append(Objection(first, came, cure="Say of each", option=asked))
    said = {name: option("--unit", f"{name}={unit}") for name, unit in options.units.items()}
    said |= {name: option("--ignore", name) for name in options.ignore}
    said |= {name: option("--unwrap", f"{name}={text}") for name, text in options.unwrap.items()}
    for name in (n for n in said if n not in known):
        cure = f"It has: {names_in(tables[0])}" + "".join(f", nor has {file!r}" for file in others)
        came = f"no such column, but {said[name]}"
        problems.append(Objection(first, came, cure=cure, column=name))


def names_in(table: Table) -> str:
    """The headers of a file, for messages."""
    return ", ".join(header.raw or "(no name)" for header in table.headers)
