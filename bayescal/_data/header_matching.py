"""A file's headers understood for an instrument, by the rules of `header_rules`, and what the user says beside it.

What a user says are the `ReadOptions`: a file may call its columns otherwise (`columns=`), and leave their units out or
get them wrong (`units=`). Columns that no instrument asked for are kept if they have a unit: an effect of the user may
need them; no file is refused for them.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from typing import Any, NamedTuple, Protocol

import numpy as np

from bayescal._core.errors import InputError
from bayescal._core.flag import Flag
from bayescal._data.column import TAKEN, UNCERTAINTY, Column, NominalScale, Source
from bayescal._data.header_rules import (
    DAYS,
    NO_UNIT,
    RAW,
    ColumnRule,
    by_name,
    called,
    fits,
    is_channel,
    labels_in,
    like_a_unit,
    like_labels,
    longest_unit,
    plain,
    raw_unit,
    readings_of,
    told_apart,
    unit_behind,
)
from bayescal._data.pose_rows import MAGNITUDE
from bayescal._data.records import RECORD
from bayescal._data.unit_conversion import (
    ANY,
    STANDARD_GRAVITY,
    alike,
    base_unit,
    convert,
    fixed_unit,
    needs_gravity,
    parse,
    pretty,
    quantity,
    same_dimension,
    spelled,
    unit_in,
)
from bayescal._tables.cells import EARLIEST, LATEST, ORDERS, unix_seconds
from bayescal._tables.raw_table import (
    Header,
    Objection,
    Objections,
    Table,
    in_one_line,
    load_whole,
    option,
)

MISSING_READINGS = ("refuse", "drop")
SHOWN_HEADERS = 4  # of those that may be meant
_LACKS = "no such column"


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
        columns: our name → the file's; of several, which name the same in different files, the first.
        others_called: our name → those several.
        local_field: in the unit of the instrument's column `magnitude`.
        only: whether all columns beside the instrument's are left out.
        others: columns of the file that are outputs of other channels, and left out.
        remembered: files of which it was said before how they are read: a header that stands there means the same.
        begin: a file's name, or "" for files without dates → when its first reading was taken.
        epoch: of the calibration, seconds since 1970; None where it has none.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    others_called: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
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
        field = None if local_field is None else _field_in_words(instrument, local_field)
        said = {n: [v] if isinstance(v, str) else [*v] for n, v in given.pop("columns", {}).items()}
        given |= {"columns": {name: names[0] for name, names in said.items()}}
        several = {name: tuple(names) for name, names in said.items() if len(names) > 1}
        begins = ({"": begin} if begin else {}) if isinstance(begin, str) else dict(begin)
        more = {"local_field": field, "ignore": tuple(ignore), "begin": begins}
        made = cls(**given, **more, others_called=several)
        scale = _scale_in_words(instrument, nominal_scale, nominal_zero, made.gravity)
        return replace(made, nominal_scale=scale)

    @property
    def gravity(self) -> float:
        """Local gravity as it is taken, m/s²: standard gravity where nobody stated it."""
        return STANDARD_GRAVITY if self.local_gravity is None else self.local_gravity

    @property
    def headers(self) -> tuple[str, ...]:
        """All headers that columns are said to have."""
        return (*self.columns.values(), *(n for v in self.others_called.values() for n in v))

    def of_file(self, table: Table, beside: Sequence[Table] = ()) -> ReadOptions:
        """Return the options of one file: of several headers of a column, the one that it has.

        A header that it lacks and a file beside it has was said for that one: here nothing is said of its column.
        """
        columns, units = dict(self.columns), dict(self.units)

        def there(names: Sequence[str], one: Table = table) -> list[str]:
            return [n for n in names if called(one.headers, in_one_line(n)) is not None]

        for before in self.remembered:
            for ours, theirs in before.columns.items():
                if ours not in columns and theirs not in columns.values() and there([theirs]):
                    columns[ours] = theirs
            raw = {header.raw for header in table.headers}
            units = {h: unit for h, unit in before.units.items() if h in raw} | units
        for ours, first in self.columns.items():
            names = self.others_called.get(ours, (first,))
            if found := there(names):
                columns[ours] = found[0]
            elif any(there(names, one) for one in beside):
                del columns[ours]
        return replace(self, columns=columns, units=units, others_called={}, remembered=())

    def leaves_out(self, header: Header) -> bool:
        """Whether a column is left out, as the user says, or as it is another channel's output."""
        return any(name in (header.raw, header.name) for name in (*self.ignore, *self.others))


def _scale_in_words(
    instrument: InstrumentLike,
    scale: NominalScale | str | None,
    zero: str | None,
    local_gravity: float,
) -> NominalScale | None:
    """Parse the nominal scale: its gain as "250 V/g" (or "61 ug/count"), its zero as "1.21 V"."""
    if isinstance(scale, str):
        scale = _scale_from(instrument, scale, local_gravity)
    if zero is None:
        return scale
    scale, said = scale or instrument.nominal_scale, f"nominal_zero={zero!r} (--nominal-zero)"
    if scale is None:
        raise InputError(
            f"{said} and no scale: {instrument.name!r} has none of its own. Say how the raw output becomes the "
            "instrument's: --nominal-scale '250 V/g'"
        )
    value, unit = _number_and_unit(zero, "nominal_zero", "--nominal-zero", f"1.21 {scale.unit}")
    if not same_dimension(unit, scale.unit):
        raise InputError(
            f"{said} is in {unit}, the nominal scale is of a raw output in {scale.unit}: give the raw output at zero "
            "in that unit"
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
            if alike(whole, wanted) and not alike(raw, unit):
                per = float(convert(gain, whole, wanted, local_gravity=local_gravity))
                by_gravity = needs_gravity(whole, wanted)
                return NominalScale(raw, 1 / per if inverse and per else per, by_gravity=by_gravity)
    raise InputError(
        f"nominal_scale={text!r} (--nominal-scale) is not a raw unit per {unit}: give what one unit of output is of "
        f"the raw output, such as {example!r}"
    )


def _field_in_words(instrument: InstrumentLike, text: str) -> float:
    """Parse the magnitude of the local field, such as "48.2 uT", into the unit of the instrument's column."""
    value, unit = _number_and_unit(text, "local_field", "--local-field", "48.2 uT")
    target = next((str(c.unit) for c in instrument.columns if c.name == MAGNITUDE), "1")
    if same_dimension(unit, "uT") and same_dimension("uT", target):
        return float(convert(value, unit, target))
    raise InputError(
        f"local_field={text!r} (--local-field) is nothing that {instrument.name!r} can take: it is the magnitude of a "
        "magnetic field, such as '48.2 uT', and of magnetometers"
    )


def _number_and_unit(text: str, name: str, option: str, example: str) -> tuple[float, str]:
    try:
        return quantity(text)
    except InputError as error:
        said = f"{name}={text!r} ({option}): {error}: write it such as {example!r}"
        raise InputError(said) from None


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


@dataclass
class MatchedFile:
    """A file whose headers are understood, for an instrument.

    A header means a column of the instrument if it has one reading as such, which a note says. A column that the file
    holds under its own name, or that `columns=` names, is not looked for.

    Attributes:
        table: the file, with the name and unit that each header means.
        instrument: whose columns are expected.
        options: what the user says.
        problems: to add to.
        expected: the columns that are expected, by our names.
        positions: our name of every column → its position in the file.
    """

    table: Table
    instrument: InstrumentLike
    options: ReadOptions
    problems: Objections
    expected: dict[str, Column] = field(init=False)
    positions: dict[str, int] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        """Match the headers."""
        self.expected = expected_columns(self.instrument)
        self.options = self.options.of_file(self.table)
        headers, notes, positions = list(self.table.headers), list(self.table.notes), self.positions
        free = set(range(len(headers)))

        def rename(position: int, reading: Header, say: str) -> None:
            old, headers[position] = headers[position], reading
            if reading != old:
                unit = f" in {pretty(reading.unit)}" if reading.unit else ""
                notes.append(f"{self.table.file}: read {old.raw!r} as {say}{unit}")

        def take(position: int, reading: Header, name: str, why: str = "") -> None:
            free.discard(position)
            positions[name] = position
            rename(position, reading, name + why)

        for ours, theirs in self.options.columns.items():
            asked = in_one_line(theirs)
            position = called(headers, asked)
            if position is None:
                came = f"no such column, but {option('--columns', f'{ours}={theirs}')}"
                like = self.rule(ours).resembled([h for h in headers if h.name])
                asked = option("--columns", f"{ours}={like[0].raw}") if len(like) == 1 else ""
                self.problem(theirs, came, cure=_there(self.table, theirs), option=asked)
            elif position not in free:
                other = next(name for name, taken in positions.items() if taken == position)
                came = f"both {other} and {ours} by --columns"
                self.problem(theirs, came, cure="Name one for each")
            else:
                header = headers[position]
                found = self.rule(ours).fitting(header, self.options.units)
                name = header.name if asked in (header.name, header.raw) else asked
                take(position, replace(found or header, name=name), ours)
        said = set(positions)
        exact, named = {headers[i].name: i for i in free}, by_name(headers)
        for name, column in self.expected.items():
            also = [n for n in column.also if n in exact]
            found = dict[int, Header]()
            if name in self.options.columns:
                pass
            elif name in exact:
                own = headers[exact[name]]
                unit = own.unit and unit_in(own.unit, self.rule(name).kinds)
                found = {exact[name]: replace(own, unit=unit or own.unit)}
            elif not also:
                found = self.rule(name).among(headers, named, free, self.options.units)
            if len(found) == 1:
                position, reading = found.popitem()
                take(position, replace(reading, name=name), name)
            for other in (n for n in also if n not in self.expected):
                if name in positions:
                    first = self.table.headers[positions[name]].raw
                    second = headers[exact[other]].raw
                    self.problem(second, f"a second {name!r} beside {first!r}", cure="Remove one")
                else:
                    positions[name] = exact[other]
                    free.discard(exact[other])
        for name, position in self._three_axes(headers, free, said).items():
            take(position, replace(headers[position], name=name), name)
        for i in sorted(free):
            ours = labels_in(headers[i])
            taken = {*positions, *self.options.columns}
            if ours and ours not in taken and self._holds_labels(i, ours == "device"):
                reading = replace(headers[i], name=ours, unit=None)
                take(i, reading, ours, ", as its values are labels")
        dated = [i for i in sorted(free) if not headers[i].unit and self._goes_on(i, dates=True)]
        if len(dated) == 1:
            reading = replace(headers[dated[0]], name="time")
            take(dated[0], reading, "time", ", as its values are dates")
        for i in sorted(free):
            reading = unit_behind(headers[i])
            if reading and reading.name not in self.expected:
                rename(i, reading, reading.name)
            name = headers[i].name
            if name in positions:
                other = f"{name!r} beside {headers[positions[name]].raw!r}"
                other += ", which --columns names" if name in said else ""
                cure = f"Rename it, or leave {name!r} out of --columns"
                self.problem(headers[i].raw, f"a second {other}", cure=cure)
            elif name:
                positions[name] = i
        self.table = replace(self.table, headers=tuple(headers), notes=tuple(notes))
        for name, column in self.expected.items():
            unit = self.header(name).unit if name in positions else None
            meant = name in self.options.columns and not _known(unit)
            if column.unit is None and not meant and (unit or "").lower() not in NO_UNIT:
                came, meant = f"carries the unit {unit}", f"a label (text) as {name!r}"
                cure = "Remove the unit, or rename the column"
                self.problem(self.header(name).raw, came, meant, cure)

    def _three_axes(
        self, headers: Sequence[Header], free: Collection[int], said: Collection[str]
    ) -> dict[str, int]:
        """Return where the outputs of three axes stand: the one triple of headers in their dimension, alike but for x,
        y, z at the beginning or the end; empty where there is none, or several."""
        outputs = getattr(self.instrument, "outputs", ())
        if not outputs or {*self.positions, *said}.intersection(outputs):
            return {}
        triples = dict[str, dict[str, int]]()
        for i in free:
            name, unit = headers[i].name.lower(), unit_of(headers[i], "", self.options)
            if name and unit and fits(unit, str(self.expected[outputs[0]].unit)):
                for key, axis in ((f"{name[:-1]}?", name[-1]), (f"?{name[1:]}", name[0])):
                    triples.setdefault(key, {})[axis] = i
        whole = [found for found in triples.values() if found.keys() >= {*"xyz"}]
        return {f"output_{axis}": whole[0][axis] for axis in "xyz"} if len(whole) == 1 else {}

    def _holds_labels(self, position: int, in_turn: bool = False) -> bool:
        """Whether the cells of a column are labels."""
        left_out = self.options.leaves_out(self.table.headers[position])
        if left_out or not self.table.readable:
            return False
        return like_labels(load_whole(self.table, {position: False})[position].values, in_turn)

    def _goes_on(self, position: int, dates: bool = False) -> bool:
        """Whether a column may be the time that the file lacks: numbers (or dates) that go on from one to the next."""
        if "time" in (*self.positions, *self.options.columns) or "time" not in self.expected:
            return False
        if self.options.leaves_out(self.table.headers[position]) or not self.table.readable:
            return False
        cells = load_whole(self.table, {position: True})[position]
        steps = np.diff(cells.values)
        return steps.size > 1 and cells.dates >= dates and bool(np.median(steps) > 0)

    def rule(self, name: str) -> ColumnRule:
        """How the header of a column of ours is known."""
        column, output = self.expected.get(name), output_name(self.instrument)
        if column is None:
            return ColumnRule(Column(name, ANY), (ANY,))
        scale = self.options.nominal_scale or self.instrument.nominal_scale
        if column.unit is None:
            kinds = ()
        elif scale and name in (output, UNCERTAINTY) and column.unit != ANY:
            kinds = (column.unit, scale.unit)
        else:
            kinds = (column.unit,)
        return ColumnRule(column, kinds, name == output)

    def header(self, name: str) -> Header:
        """The header of a column by our name."""
        return self.table.headers[self.positions[name]]

    def problem(
        self,
        column: str,
        came: str,
        expected: str = "",
        cure: str = "",
        option: str = "",
        *,
        sentence: str = "",
        rows: Sequence[int] | np.ndarray = (),
    ) -> None:
        """Note a problem of a column, given by its header; of some of its readings, if `rows` are given."""
        made = Objection(self.table.file, came, expected, cure, option, column, sentence=sentence)
        self.problems.append(made.at([int(row) for row in rows], self.table.place))

    def note_missing(self) -> tuple[dict[str, tuple[int, Header]], set[int]]:
        """Note the columns that the instrument needs and the file has not, and whose header the user has not said.

        Returns:
            Those that one header looks like, and where; and where all headers stand that look like one.
        """
        offered: dict[str, tuple[int, Header]] = {}
        taken = {self.positions[name] for name in self.expected if name in self.positions}
        free = [h for i, h in enumerate(self.table.headers) if h.name and i not in taken]
        lacking = [
            column
            for name, column in self.expected.items()
            if _needed(column) and name not in self.positions and name not in self.options.columns
        ]
        alike = told_apart({c.name: self._resembled(c, free) for c in lacking})
        place = {h.raw: i for i, h in reversed([*enumerate(self.table.headers)])}
        single = [found[0].raw for found in alike.values() if len(found) == 1]
        for column in lacking:
            found = alike[column.name]
            # no column is proposed for two
            one = len(found) == 1 and single.count(found[0].raw) == 1
            self._note_lack(column, found, one)
            if one:
                rule = self.rule(column.name)
                kinds = (column.unit or "1", *(RAW if rule.output else ()))
                reading = replace(rule, kinds=kinds).fitting(found[0], {}) or found[0]
                offered[column.name] = place[reading.raw], replace(reading, name=found[0].name)
        return offered, {place[h.raw] for found in alike.values() for h in found}

    def _resembled(self, column: Column, free: Sequence[Header]) -> list[Header]:
        """Headers that may mean a column: the output in the unit of the nominal scale that was given, those that look
        like it, or all that say no unit."""
        rule, scale = self.rule(column.name), self.options.nominal_scale
        raw = []
        if rule.output and scale is not None:
            raw = [h for h in free if any(fits(r.unit or "", scale.unit) for r in readings_of(h))]
        unsaid = [h for h in free if column.unit and not (longest_unit(h) or like_a_unit(h))]
        return rule.resembled(raw) or raw or rule.resembled(free) or unsaid

    def _note_lack(self, column: Column, alike: Sequence[Header], one: bool) -> None:
        """Note that the file has no such column, with the headers that may be meant: `one` whose unit is asked for."""
        asked = f"{column.name} [{column.example}]" if column.unit else column.name
        choices = [self._as_column(column, header, one) for header in alike[:SHOWN_HEADERS]]
        advice, given = "", choices[0] if len(choices) == 1 else f"({' or '.join(choices)})"
        if alike:
            shown = ", ".join(h.raw for h in alike[:SHOWN_HEADERS])
            advice = f"{shown} {'looks' if len(alike) == 1 else 'look'} like it. "
            if "--nominal-scale" in given:
                advice += "The nominal scale says what one unit of output is of it; --nominal-zero what it is at zero. "
            channels = [h.name for h in alike if "," not in h.name and is_channel(h, alike[0])]
            if len(channels) > 1 and column.name == output_name(self.instrument):
                together = option("--channels", ",".join(channels))
                advice += f"Together, as channels of one unit: {together}. "
        meaning = f" ({column.meaning})" if column.meaning else ""
        say = f", or say which one it is {given if len(choices) > 1 else f'({given})'}"
        sentence = (
            f"{self.table.file!r} lacks the column {column.name!r}{meaning} that {self.instrument.name!r} needs; it "
            f"has: {names_in(self.table)}. {advice}Add a column {asked!r}{say if alike else ''}"
        )
        cure = f"{advice}Add such a column{', or say which it is' if alike else ''}"
        self.problem(column.name, _LACKS, asked, cure, given if alike else "", sentence=sentence)

    def _as_column(self, column: Column, header: Header, one: bool) -> str:
        """Return the options that say that a header is a column; what the file cannot tell is left to fill in."""
        said = option("--columns", f"{column.name}={header.raw}")
        raw, rule = raw_unit(header), self.rule(column.name)
        converts = column.unit in (None, ANY) or (raw and fits(raw, column.unit))
        if raw and self.options.nominal_scale is None and not converts:
            per = f"({column.unit})" if "/" in str(column.unit) else column.unit
            return f"{said} {option('--nominal-scale', f'NUMBER {unit_in(raw, (ANY,))}/{per}')}"
        if one or column.unit is None or rule.fitting(header, {}) or header.unit:
            return said
        return f"{said} {option('--unit', f'{header.raw}=UNIT')}"

    def fix_units(self, offered: Mapping[str, tuple[int, Header]]) -> None:
        """Give columns a unit in place of "any": the fixed unit of what the file has, or of a header that is offered.

        A known uncertainty follows its output. What has no unit, or one that is none, is refused where
        the column is converted; a nominal scale for an output that may be anything is a problem here.
        """
        headers = {n: self.header(n) for n in self.expected if n in self.positions}
        headers |= {name: header for name, (_, header) in offered.items()}
        for name, header in headers.items():
            column = self.expected[name]
            if column.unit != ANY:
                continue
            if self.options.nominal_scale is not None:
                came = "a nominal scale was given, but it is taken in the unit that it is in"
                cure = "Leave the scale out, or choose an instrument whose output has a unit"
                self.problem(name, came, cure=cure)
            unit = unit_of(header, name, self.options)
            if name == UNCERTAINTY:
                self.expected[name] = replace(column, unit=self.expected["output"].unit)
            elif unit is not None:
                with contextlib.suppress(InputError):
                    self.expected[name] = replace(column, unit=fixed_unit(unit))

    def could_be(self, header: Header) -> str | None:
        """Return the column, not one that the file must have, which it lacks and a header names in part."""
        free = (n for n, c in self.expected.items() if n not in self.positions and not _needed(c))
        return next((name for name in free if self.rule(name).could_be(header)), None)

    def further_columns(self, passed: Collection[int]) -> tuple[dict[str, Column], list[str]]:
        """Return the columns beyond the instrument's that are kept, in base units, and why others are not.

        One that the instrument could use, or that ends in what may be a unit and is none known here, is a problem:
        what is left out is left out because somebody says so. Columns at positions `passed` are passed over.
        """
        kept, flags, file = dict[str, Column](), list[str](), self.table.file
        without_unit, labelled = list[str](), "run" in self.positions
        for name, position in {} if self.options.only else self.positions.items():
            header = self.table.headers[position]
            if name in self.expected or position in passed or self.options.leaves_out(header):
                continue
            if plain(header.name) in DAYS and not header.unit and "time" in self.positions:
                continue  # taken with the time of day
            if name in TAKEN:
                said = f"{file}: column {header.raw!r} ignored: the name {name!r} is taken"
                flags.append(Flag(said, "column.ignored", header.raw))
                continue
            unit, base = unit_of(header, name, self.options), None
            with contextlib.suppress(InputError):
                base = base_unit(unit) if unit else None
            if base == "s" and self._goes_on(position):
                came = "goes on as a time does, and is no column known here"
                asked = option("--columns", f"time={header.raw}")
                self.problem(header.raw, came, cure="Say what it is", option=asked)
                continue
            if base is not None:
                kept[name] = Column(name, base, required=False)
                continue
            labels = False
            if unit or (unit := like_a_unit(header)) or self.could_be(header):
                useful = self.could_be(header) or _known(unit)
                labels = not useful and self._holds_labels(position)
                if not labels and (unit or "").lower() not in NO_UNIT - {""}:
                    self._note_unclear(position, unit)
                    continue
            if labels and not labelled:
                labelled = True
                came = "holds labels, each for a while, and is no column known here"
                cure = "Are they runs? Say so; if they are not, remove the column"
                self.problem(header.raw, came, "", cure, option("--columns", f"run={header.raw}"))
            else:
                without_unit.append(header.raw)
        if not self.options.only:
            nameless = (i for i, h in enumerate(self.table.headers) if not h.name)
            without_unit += [f"column {i + 1}, without a name" for i in nameless]
        if without_unit:
            needs_none = (n for n, c in self.expected.items() if c.unit is None or n == "time")
            lacking = [n for n in needs_none if n not in self.positions]
            meant = " or ".join(option("--columns", f"{n}={without_unit[0]}") for n in lacking)
            meant = f"to say what one is: {meant}; " * bool(lacking)
            said = (
                f"{file}: ignored, because they have no unit: {', '.join(without_unit)} "
                f"({meant}to keep one beside the instrument's, write 'name [unit]' or give units=)"
            )
            flags.append(Flag(said, "column.ignored", *without_unit))
        return kept, [*flags, *self._unused(kept, without_unit)]

    def _unused(self, kept: Mapping[str, Column], ignored: Sequence[str]) -> list[str]:
        """Which columns that are kept for themselves, or left out, may be one that the instrument could use: by their
        unit alone, or as they hold labels, each for a while."""
        said = []
        if "run" not in self.positions:
            names = {h.raw: i for i, h in enumerate(self.table.headers) if h.raw in ignored}
            labels = [raw for raw, i in names.items() if self._holds_labels(i)]
            if len(labels) == 1:
                asked = option("--columns", f"run={labels[0]}")
                said.append(f"{self.table.file}: may {labels[0]!r} name the runs? Say so: {asked}")
        for name, column in kept.items():
            alike = [n for n, c in kept.items() if c.unit == column.unit]
            meant = [
                n for n, c in self.expected.items()
                if n not in self.positions and not _needed(c) and c.unit == column.unit != "1"
            ]  # fmt: skip
            if meant and len(alike) == 1:
                raw = self.header(name).raw
                asked = " or ".join(option("--columns", f"{n}={raw}") for n in meant)
                said.append(
                    f"{self.table.file}: may {raw!r} be {' or '.join(meant)}? Say so: {asked}"
                )
        return said

    def _note_unclear(self, position: int, unit: str | None) -> None:
        """Note a column that would be left out and may be of use: how to keep it, and how to leave it out."""
        header = self.table.headers[position]
        column = self.expected.get(self.could_be(header) or "")
        kind = (column and column.unit) or ANY
        known, lacking = _known(unit, kind), any(p.came == _LACKS for p in self.problems)
        came = f"ends in [{unit}], no unit known here" if unit else "has no unit"
        left, wanted = option("--ignore", header.raw), "a unit known here"
        given = keep = option("--unit", f"{header.raw}={known or 'UNIT'}")
        cure = f"Say its unit, or leave the column out: {left}"
        if column:
            wanted, dates = f"{column.name} [{column.example}]", False
            if column.name == "time":
                dates = load_whole(self.table, {position: True})[position].dates
            given = option("--columns", f"{column.name}={header.raw}") + f" {keep}" * (not dates)
            cure = f"It may be {column.name}: say so and in which unit, or leave the column out: {left}"
        elif not (known or lacking):  # what may be needed is not proposed to be left out
            cure, given = f"Leave the column out, or say its unit: {keep}", left
        self.problem(header.raw, came, wanted, cure, given)


def _known(unit: str | None, kind: str = ANY) -> str | None:
    """The unit that a text may be meant as; None for none."""
    return unit_in(unit or "", (kind,)) or spelled(unit or "")


def _needed(column: Column) -> bool:
    return column.required and column.default is None


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


_PERIOD = re.compile(r"(\d+\.?\d*)(?:\^(\d{1,2}))?\s*([^\d\s.^].*)?")


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
        came = f"one begin, {options.begin['']!r}, for {len(tables)} files"
        asked = option("--begin", f"{first}={options.begin['']}")
        problems.append(Objection(first, came, cure="Say of each", option=asked))
    said = {name: option("--unit", f"{name}={unit}") for name, unit in options.units.items()}
    said |= {name: option("--ignore", name) for name in options.ignore}
    said |= {name: option("--unwrap", f"{name}={text}") for name, text in options.unwrap.items()}
    for name in (n for n in said if n not in known):
        cure = _there(tables[0], name) + "".join(f", nor has {file!r}" for file in others)
        problems.append(
            Objection(first, f"no such column, but {said[name]}", cure=cure, column=name)
        )


def names_in(table: Table) -> str:
    """The headers of a file, for messages."""
    return ", ".join(header.raw or "(no name)" for header in table.headers)


def _there(table: Table, name: str) -> str:
    """What a file has in place of a column of this name, and which of them may be meant."""
    names = {header.name.lower(): header.raw for header in table.headers if header.name}
    near = get_close_matches(name.lower(), names, 1)
    return f"It has: {names_in(table)}" + (f" (is {names[near[0]]!r} meant?)" if near else "")
