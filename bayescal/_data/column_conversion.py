"""From a file's columns to an instrument's numbers; all that is wrong with them is noted before any of it is said."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bayescal._core.errors import InputError
from bayescal._data import unit_conversion
from bayescal._data.column import (
    MAY_BE_EMPTY,
    TAKEN,
    Column,
    ConvertedColumns,
    overloads,
    placeholders,
)
from bayescal._data.header_matching import (
    channels_beside,
    could_be,
    matched,
    note_missing,
    with_fixed_units,
)
from bayescal._data.header_reading import like_a_unit, plain, spelled, unit_in
from bayescal._data.read_options import (
    InstrumentLike,
    ReadOptions,
    expected_columns,
    output_name,
    unit_of,
)
from bayescal._data.unit_conversion import base_unit
from bayescal._data.unit_parsing import ANY
from bayescal._tables.cells import Cells
from bayescal._tables.dates import EXAMPLE, date_text, from_first, unit_of_counts
from bayescal._tables.problems import Problem, Problems, option
from bayescal._tables.raw_table import Header, Table, load_whole

_TEXTS = 3  # of a column, that are quoted
_LIKELY_UNITS = (
    *("deg", "arcsec", "rad", "deg/s", "rad/s", "g", "mg", "ug", "degC", "K", "degF"),
    *("s", "ms", "us", "min", "h", "V", "mV", "Hz", "kHz", "1", "%", "ppm"),
)
_DAYS = ("date", "datum", "day", "tag")  # a column of these beside one of times of day


def convert_columns(
    table: Table,
    instrument: InstrumentLike,
    options: ReadOptions,
    problems: Problems | None = None,
) -> ConvertedColumns:
    """Check a file's columns and convert them.

    Args:
        table: the file.
        instrument: whose columns are expected.
        options: renamings, units, gravity, scale, and what becomes of missing readings.
        problems: to add to; the columns without any are converted all the same.

    Returns:
        Columns in the instrument's units, in its order, then what else was kept; of the rows without a missing
        reading, where such rows are dropped.

    Raises:
        InputError: a column, a unit or a cell cannot be used, and there are no `problems` to add to; the message
            names file, row and column.
    """
    own = Problems() if problems is None else problems
    before = len(own)
    converted = _converted(table, instrument, options, own)
    if problems is None:
        own.refuse()
    if converted.missing and len(own) == before:
        _drop(table, converted, own)
    if problems is None:
        own.refuse()
    return converted


def _converted(
    table: Table, instrument: InstrumentLike, options: ReadOptions, problems: Problems
) -> ConvertedColumns:
    expected = expected_columns(instrument)
    table, positions = matched(table, instrument, options, problems)
    offered, proposed = note_missing(table, expected, positions, instrument, problems, options)
    expected = with_fixed_units(expected, table, positions, options, problems)
    others = {n: p for n, p in positions.items() if n in expected or p not in proposed}
    others = {} if options.only else others
    extra, flags = extra_columns(table, expected, others, options, problems)
    converted = ConvertedColumns(flags=[*table.notes, *flags])
    found = {n: c for n, c in (expected | extra).items() if n in positions}
    problems += table.problems
    found |= {n: expected[n] for n in offered}  # looked at already, whether or not they are meant
    positions |= {name: position for name, (position, _) in offered.items()}
    if not table.readable:
        found = {}
    day = _day_position(table, positions) if "time" in found else None
    wanted = {positions[n]: c.unit is not None for n, c in found.items()}
    cells = load_whole(table, wanted if day is None else {**wanted, day: True})
    if day is not None:
        cells[positions["time"]] = cells[positions["time"]].on_days(cells[day], options.date_order)
    readers = {
        name: ColumnReader(
            table=table,
            header=offered[name][1] if name in offered else table.headers[positions[name]],
            column=column,
            options=options,
            instrument=instrument,
            converted=converted,
            problems=problems,
        )
        for name, column in found.items()
    }
    for name, column in expected.items():
        if name in readers:
            readers[name].read(cells[positions[name]])
            converted.unread |= {name} - set(converted.values)
        if name not in converted.values and column.default is not None:
            kind = object if column.unit is None else np.float64
            converted.values[name] = np.full(table.rows, column.default, dtype=kind)
            converted.units[name] = column.unit
            converted.filled.add(name)
    for name in extra:
        if name in readers:
            readers[name].read_if_sound(cells[positions[name]])
    _note_channels(table, converted, set(extra), positions, output_name(instrument))
    return converted


def _note_channels(
    table: Table,
    converted: ConvertedColumns,
    extra: set[str],
    positions: Mapping[str, int],
    output: str,
) -> None:
    """Note which of the columns that no instrument asked for are channels of the output's unit, and say so."""
    if output not in converted.values:
        return
    own = table.headers[positions[output]].name
    others = {n: u for n, u in converted.units.items() if n in extra}
    converted.beside.update(channels_beside(own, others, converted.units[output]))
    if converted.beside:
        names = ", ".join(sorted(converted.beside))
        converted.flags.append(
            f"{table.file}: {names}: other channels beside the output {own!r}, not taken as its causes (--covariates "
            "NAME, in Python covariates=, to let one be)"
        )


def _day_position(table: Table, positions: Mapping[str, int]) -> int | None:
    """Where a column of days stands beside one of times of day."""
    found = [
        i for i, h in enumerate(table.headers) if plain(h.name) in _DAYS and i != positions["time"]
    ]
    return found[0] if len(found) == 1 else None


def _drop(table: Table, converted: ConvertedColumns, problems: Problems) -> None:
    """Leave the rows out in which a reading is missing, and say so; a problem if none would be left."""
    missing = {name: rows for name, (rows, _) in converted.missing.items()}
    gone = np.unique(np.concatenate(list(missing.values())))
    if len(gone) == table.rows:
        counts = ", ".join(f"{name} in {len(rows)}" for name, rows in missing.items())
        came = f"no row without a missing reading: {counts} of {table.rows} rows"
        problems.append(Problem(table.file, came))
        return
    converted.kept = np.setdiff1d(np.arange(table.rows), gone)
    converted.values = {name: v[converted.kept] for name, v in converted.values.items()}
    places = "; ".join(f"{name} in {_rows(table, rows)}" for name, rows in missing.items())
    converted.flags.append(
        f"{table.file}: {len(gone)} of {table.rows} rows dropped, where readings are missing: {places}"
    )


def _rows(table: Table, rows: np.ndarray) -> str:
    """Rows, the first few by number."""
    first = ", ".join(table.place(int(i)).removeprefix("row ") for i in rows[:3])
    if len(rows) == 1:
        return f"row {first}"
    return f"{len(rows)} rows ({first}{' …' * (len(rows) > 3)})"


def kept_table(table: Table, converted: ConvertedColumns) -> Table:
    """The table of the rows that were kept."""
    return table if converted.kept is None else table.take(converted.kept)


def extra_columns(
    table: Table,
    expected: Mapping[str, Column],
    positions: Mapping[str, int],
    options: ReadOptions,
    problems: Problems,
) -> tuple[dict[str, Column], list[str]]:
    """The columns beyond the instrument's that are kept, in base units, and why others are not.

    One that the instrument could use, or that ends in what may be a unit and is none known here, is a problem: what is
    left out is left out because somebody says so.
    """
    kept: dict[str, Column] = {}
    flags: list[str] = []
    without_unit: list[str] = []
    for name in (n for n in positions if n not in expected):
        header = table.headers[positions[name]]
        if not options.others.isdisjoint((header.name, header.raw)) or options.leaves_out(header):
            continue
        if plain(header.name) in _DAYS and "time" in positions:
            continue  # taken with the time of day
        unit = unit_of(header, name, options)
        if name in TAKEN:
            flags.append(f"{table.file}: column {header.raw!r} ignored: the name {name!r} is taken")
            continue
        try:
            base = base_unit(unit) if unit else None
        except InputError:
            base = None
        if base is not None:
            kept[name] = Column(name, base, required=False)
        elif unit or (unit := like_a_unit(header)) or could_be(header, expected, positions):
            problems.append(_unclear(table, positions[name], unit, expected, positions))
        else:
            without_unit.append(header.raw)
    without_unit += [
        f"column {i + 1}, without a name"
        for i, h in enumerate(table.headers)
        if not h.name and not options.only
    ]
    if without_unit:
        needs_none = (n for n, c in expected.items() if c.unit is None or n == "time")
        lacking = [n for n in needs_none if n not in positions]
        meant = f"to say that one is {' or '.join(lacking)}: --columns NAME=HEADER; "
        flags.append(
            f"{table.file}: ignored, because they have no unit: {', '.join(without_unit)} "
            f"({meant if lacking else ''}to keep one beside the instrument's, write 'name [unit]' "
            "or give units=)"
        )
    return kept, flags


def _unclear(
    table: Table,
    position: int,
    unit: str | None,
    expected: Mapping[str, Column],
    positions: Mapping[str, int],
) -> Problem:
    """The problem of a column that would be left out and may be of use: how to keep it, and how to leave it out."""
    header = table.headers[position]
    meant = could_be(header, expected, positions)
    kind = expected[meant].unit if meant else None
    known = unit_in(unit or "", (kind or ANY,)) or spelled(unit or "")
    came = f"ends in [{unit}], no unit known here" if unit else "has no unit"
    left = option("--ignore", header.raw)
    keep = option(
        "--unit", f"{header.raw}={known or expected[meant].example if meant else known or 'UNIT'}"
    )
    if meant:
        dates = meant == "time" and load_whole(table, {position: True})[position].dates
        keep = option("--columns", f"{meant}={header.raw}") + (f" {keep}" if not dates else "")
        cure = f"It may be {meant}: say so and in which unit, or leave the column out: {left}"
        return Problem(
            table.file, came, f"{meant} [{expected[meant].example}]", cure, keep, header.raw
        )
    other = left if known else keep
    cure = (
        f"Leave the column out, or say its unit: {other}"
        if not known
        else f"Say its unit, or leave the column out: {other}"
    )
    return Problem(table.file, came, "a unit known here", cure, keep if known else left, header.raw)


@dataclass(frozen=True)
class ColumnReader:
    """Checks one column of a file and converts it into `converted`; what is wrong goes into `problems`."""

    table: Table
    header: Header
    column: Column
    options: ReadOptions
    instrument: InstrumentLike
    converted: ConvertedColumns
    problems: Problems

    def read(self, cells: Cells) -> None:
        """A column of the instrument; one that is empty and not required is left out."""
        if self.column.unit is None:
            self._labels(cells.values)
            return
        if not self.column.required and not cells.bad and np.isnan(cells.values).all():
            self._flag("is empty and was left out")
            return
        before, cells = len(self.problems), self._as_numbers(self._in_order(cells))
        unit = self._unit(cells)
        codes = overloads(cells.values)
        raw = cells.values.copy() if codes.size else cells.values
        if codes.size:
            what = "an overload or no reading at all (SCPI writes ±9.9E37 and 9.91E37)"
            came = f"reads {raw[codes[0]]:.4g}, an instrument's code for {what}"
            self._missing(codes, Problem(self.table.file, came))
            raw[codes] = np.nan
        held = placeholders(raw)
        self._note_text(cells, unit)
        if held.size:
            came = f"reads {raw[held[0]]:g}, far from all other numbers: it stands for a missing reading"
            self._missing(held, Problem(self.table.file, came))
            raw = raw.copy()
            raw[held] = np.nan
        with np.errstate(over="ignore"):
            values = raw if cells.dates or unit is None else self._convert(raw, unit)
        if values is None:
            return
        self._note_not_finite(raw, values, unit, {*cells.bad, *held.tolist(), *codes.tolist()})
        if unit is not None:
            self._note_implausible(raw, values, unit)
        if len(self.problems) == before or (
            unit is None and not cells.bad
        ):  # the order can be looked at
            if self._is_time:
                values, self.converted.origin = from_first(values)
            self.converted.values[self.column.name] = values
            self.converted.units[self.column.name] = self.column.unit

    def read_if_sound(self, cells: Cells) -> None:
        """A column that no instrument asked for: left out, with a flag, unless every cell is a number."""
        name, fixed, gravity = self.column.name, self.column.unit, self.options.local_gravity
        unit = unit_of(self.header, name, self.options)
        assert unit is not None and fixed is not None  # `extra_columns` keeps no other
        values = unit_conversion.convert(cells.values, unit, fixed, local_gravity=gravity)
        unusable = np.union1d(np.flatnonzero(self._not_finite(values)), overloads(cells.values))
        if cells.bad or unusable.size or cells.dates:
            index = next(iter(cells.bad), int(unusable[0]) if unusable.size else 0)
            seen = (
                f"reads {cells.bad[index]!r}" if cells.bad else _reading(float(cells.values[index]))
            )
            self._flag(f"ignored: {self.table.place(index)} {seen}")
            return
        if unit_conversion.needs_gravity(unit, fixed):
            self._flag(f"turned into local g by {gravity:g} m/s²")
        self.converted.values[name], self.converted.units[name] = values, fixed

    @property
    def _is_time(self) -> bool:
        return self.column.name == "time" and self.column.unit == "s"

    @property
    def _unit_option(self) -> str:
        return option("--unit", f"{self.header.raw}=UNIT")

    def _flag(self, said: str) -> None:
        self.converted.flags.append(f"{self.table.file}: column {self.header.raw!r} {said}")

    def _problem(
        self, came: str, expected: str = "", cure: str = "", *, option: str = "", sentence: str = ""
    ) -> None:
        """Note a problem of the header."""
        raw = self.header.raw
        made = Problem(self.table.file, came, expected, cure, option, raw, sentence=sentence)
        self.problems.append(made)

    def _note(self, rows: np.ndarray, came: str, expected: str = "", cure: str = "") -> None:
        """Note a problem of some rows."""
        made = Problem(self.table.file, came, expected, cure, column=self.header.raw)
        self.problems.of_rows(made, rows.tolist(), self.table.place)

    def _missing(self, rows: np.ndarray, problem: Problem) -> None:
        """Readings that are missing: a problem, unless such rows are dropped."""
        cure = "Fill it in, or drop such rows: missing='drop'"
        own = replace(
            problem, column=self.header.raw, cure=cure, option=option("--missing", "drop")
        )
        earlier, first = self.converted.missing.get(self.column.name, (rows[:0], own))
        self.converted.missing[self.column.name] = (np.union1d(earlier, rows), first)
        if self.options.missing == "refuse":
            self.problems.of_rows(own, rows.tolist(), self.table.place)

    def _labels(self, labels: np.ndarray) -> None:
        if not self.column.required and (labels == "").all():
            self._flag("is empty and was left out")
            return
        empty = np.flatnonzero(labels == "")
        if empty.size:
            self._missing(empty, Problem(self.table.file, "is empty", "a label"))
        before = len(self.problems)
        for label in dict.fromkeys(labels.tolist()):
            if any(unicodedata.category(character) in ("Cc", "Cs") for character in label):
                came = f"reads {label!r}, which holds a control character"
                self._note(np.flatnonzero(labels == label), came, cure="Remove it")
            elif label and self.column.allowed and label not in self.column.allowed:
                came = f"reads {label!r}, an unknown label"
                expected = f"one of {', '.join(self.column.allowed)}"
                self._note(np.flatnonzero(labels == label), came, expected, "Correct it")
        if len(self.problems) == before:
            self.converted.values[self.column.name] = labels
            self.converted.units[self.column.name] = None

    def _in_order(self, cells: Cells) -> Cells:
        """Dates whose day and month are dates apart: by one above 12, or as the user says; a problem if by neither."""
        if not (self._is_time and cells.orders):
            return cells
        dates, fitting = cells.in_order(self.options.date_order), cells.fitting_orders
        if dates.orders:
            came = "leave open which number is the day"
            came = came if fitting else "are not all dates in one order of month, day and year"
            orders = fitting or [n for n, v in cells.orders.items() if not np.isnan(v).all()]
            begin = (
                f"{n} if it begins {date_text(np.nanmin(cells.orders[n]))[:10]}" for n in orders
            )
            self._problem(
                f"its dates {came}",
                "a day above 12 in one of them, or the year first",
                f"Say in which order they are: {', '.join(begin)}",
                option=option("--date-order", orders[0]),
            )
        return dates

    def _as_numbers(self, cells: Cells) -> Cells:
        """Dates are numbers of the time alone; elsewhere they are text."""
        if not cells.dates or self._is_time:
            return cells
        there = np.flatnonzero(~np.isnan(cells.values))
        dates = {int(i): date_text(float(cells.values[i])) for i in there[:1000]}
        return Cells(np.full(len(cells.values), np.nan), {**dates, **cells.bad})

    def _unit(self, cells: Cells) -> str | None:
        """The unit of the numbers; None, and a problem, if there is none or the text is none."""
        unit = unit_of(self.header, self.column.name, self.options)
        if cells.dates:
            return "s"
        if unit is None and self._is_time and (shown := unit_of_counts(cells.values)):
            self._flag(f"taken as {unit_conversion.pretty(shown)} since 1970, as its size shows")
            return shown
        if unit is None and self._is_time and cells.bad and np.isnan(cells.values).all():
            return None  # dates of another form, which are said as such
        if unit is None:
            unit, name = self.column.example, self.header.name
            cure = (
                f"UNIT is what its numbers are in, such as {unit}; in a header, '{name} [{unit}]'"
            )
            self._problem("the header has no unit", "one", cure, option=self._unit_option)
            return None
        if self.column.unit not in (None, unit_conversion.ANY):
            unit = unit_in(unit, (self.column.unit,)) or unit
        try:
            unit_conversion.check_unit(unit)
        except InputError as error:
            sentence = f"{self.table.file!r}, column {self.header.raw!r}: {error}. Correct the header, or give units="
            near = re.findall(r"\(([^()]*meant\?)\)", str(error))
            expected, given = "a unit known here", self._unit_option
            self._problem(f"the unit [{unit}]", expected, *near, option=given, sentence=sentence)
            return None
        if self.header.unit and unit != self.header.unit:
            self._flag(f"taken as [{unit}], as units= says")
        return unit

    def _note_text(self, cells: Cells, unit: str | None) -> None:
        """Note the cells that hold text."""
        expected = _number_in(unit)
        if self._is_time and cells.dates:
            expected = f"a date such as {EXAMPLE}, with a zone everywhere or nowhere"
        elif self._is_time:
            expected = f"a date such as {EXAMPLE}" if unit is None else f"{expected}, or a date"
        texts = list(dict.fromkeys(cells.bad.values()))
        hint = "Correct the cell, or remove the row"
        if any(re.fullmatch(r"[+-]?\d*,\d+([eE][+-]?\d+)?", text) for text in texts):
            hint = "If that is a decimal comma, say so (--decimal ,), or export the file with decimal points"
        came = ", ".join(repr(text[:60]) for text in texts[:_TEXTS]) + " …" * (len(texts) > _TEXTS)
        self._note(np.array(sorted(cells.bad), dtype=int), f"reads {came}", expected, hint)

    def _convert(self, values: np.ndarray, unit: str) -> np.ndarray | None:
        """Numbers in `unit` in the column's, or by the nominal scale; None, and a problem, if neither can be."""
        target, gravity = self.column.unit or "1", self.options.local_gravity
        difference = self.column.name == "output_uncertainty"
        scale = self.options.nominal_scale or self.instrument.nominal_scale
        if unit_conversion.same_dimension(unit, target):
            if unit_conversion.needs_gravity(unit, target):
                self._flag(f"turned into local g by {gravity:g} m/s²")
            with self.problems.collecting(self.table.file):  # a difference of temperatures, say
                return unit_conversion.convert(
                    values, unit, target, local_gravity=gravity, difference=difference
                )
            return None
        raw_output = self.column.name == output_name(self.instrument) or difference
        if raw_output and scale is not None and unit_conversion.same_dimension(unit, scale.unit):
            shifted = scale.offset and not difference
            reading = f"(reading − {scale.offset:g})" if shifted else "reading"
            own = self.options.nominal_scale is None
            of = f" of {self.instrument.name}" * own
            other = " (another sensor's: --nominal-scale and --nominal-zero)" * own
            self._flag(
                f"turned into {unit_conversion.pretty(target)} by the nominal scale{of}: "
                f"{reading}/{scale.gain:g}, reading in {unit_conversion.pretty(scale.unit)}{other}"
            )
            raw = unit_conversion.convert(
                values, unit, scale.unit, local_gravity=gravity, difference=difference
            )
            return scale.apply(raw, difference=difference)
        also = (
            f", or {scale.unit}, which the nominal scale converts" if raw_output and scale else ""
        )
        per = f"({target})" if "/" in target else target
        how = option("--nominal-scale", f"250 {unit}/{per}")
        hint = f" Or say how many {unit} one {target} is, such as {how}" * raw_output
        cure = f"Correct the header, or give the unit that is meant.{hint}"
        expected, given = f"one that converts to {target}{also}", self._unit_option
        self._problem(f"its unit is [{unit}]", expected, cure, option=given)
        return None

    def _not_finite(self, values: np.ndarray) -> np.ndarray:
        """Readings that are no number; a temperature point may be empty."""
        return np.isinf(values) if self.column.name == MAY_BE_EMPTY else ~np.isfinite(values)

    def _note_not_finite(
        self, raw: np.ndarray, values: np.ndarray, unit: str | None, noted: set[int]
    ) -> None:
        """Note what is empty as missing, and what is infinite as wrong."""
        expected = _number_in(unit)
        wrong = np.setdiff1d(np.flatnonzero(self._not_finite(values)), list(noted))
        empty = wrong[np.isnan(raw[wrong])]
        if empty.size and len(noted) < 1000:
            self._missing(empty, Problem(self.table.file, "is empty or NaN", expected))
        infinite = wrong[~np.isnan(raw[wrong])]
        if infinite.size:
            first = float(raw[infinite[0]])
            came = _reading(first) + (", too large" if np.isfinite(first) else "")
            self._note(infinite, came, expected, "Fill it in, or remove the row")

    def _note_implausible(self, raw: np.ndarray, values: np.ndarray, unit: str) -> None:
        low = -np.inf if self.column.low is None else self.column.low
        high = np.inf if self.column.high is None else self.column.high
        wrong = (values < low) | (values > high)
        if not wrong.any():
            return
        index, shown = int(np.argmax(wrong)), unit_conversion.pretty(self.column.unit or "1")
        limits = f"at least {low:g}" if high == np.inf else f"at most {high:g}"
        limits = f"{low:g} … {high:g}" if low > -np.inf and high < np.inf else limits
        same = unit_conversion.pretty(unit) == shown
        internal = "" if same else f", that is {values[index]:.6g} {shown}"
        likely = _LIKELY_UNITS if wrong.mean() >= 0.5 else ()  # a single slip says nothing of units
        better = [u for u in likely if u != unit and self._plausible_in(u, raw, low, high)]
        came = f"reads {raw[index]:.6g} {unit_conversion.pretty(unit)}{internal}; plausible is {limits} {shown}"
        cure, given = "Check the unit and the number", ""
        if better:
            cure = f"Are the numbers in {better[0]}? Then write '{self.header.name} [{better[0]}]'"
            given = option("--unit", f"{self.header.raw}={better[0]}")
        made = Problem(self.table.file, came, "", cure, given, self.header.raw)
        self.problems.of_rows(made, np.flatnonzero(wrong).tolist(), self.table.place)

    def _plausible_in(self, unit: str, raw: np.ndarray, low: float, high: float) -> bool:
        target = self.column.unit or "1"
        if not unit_conversion.same_dimension(unit, target):
            return False
        values = unit_conversion.convert(
            raw, unit, target, local_gravity=self.options.local_gravity
        )
        return bool(np.all(np.isnan(values) | ((values >= low) & (values <= high))))


def _number_in(unit: str | None) -> str:
    return "a number" if unit is None else f"a number in {unit_conversion.pretty(unit)}"


def _reading(value: float) -> str:
    """What a cell that holds no finite number reads."""
    return "is empty or NaN" if np.isnan(value) else f"reads {value:g}"
