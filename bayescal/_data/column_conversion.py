"""From a file's columns to an instrument's numbers; all that is wrong with them is noted before any of it is said."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayescal._core.errors import InputError
from bayescal._core.flag import Flag
from bayescal._data.column import (
    ASSUMED_GRAVITY,
    MAY_BE_EMPTY,
    UNCERTAINTY,
    Column,
    ConvertedColumns,
    NominalScale,
    overloads,
    placeholders,
)
from bayescal._data.counter_wrap import (
    PERIODS,
    ROOM,
    SIGN,
    restore_sign,
    unwrap,
    wrap_period,
)
from bayescal._data.header_matching import MatchedFile
from bayescal._data.header_rules import DAYS, channels_beside, plain
from bayescal._data.pose_rows import MAGNITUDE
from bayescal._data.read_options import (
    InstrumentLike,
    ReadOptions,
    output_name,
    parse_begin,
    period_of,
    unit_of,
)
from bayescal._data.records import RECORD, record_codes
from bayescal._data.thermometer_checks import allowed_changes
from bayescal._data.unit_conversion import (
    ANY,
    convert,
    needs_gravity,
    parse,
    pretty,
    same_dimension,
    unit_in,
)
from bayescal._tables import cells as of_cells
from bayescal._tables.cells import EXAMPLE, MOST_BAD, Cells, date_text, from_first, unit_of_counts
from bayescal._tables.raw_table import Header, Objection, Objections, Table, load_whole, option

_EMPTY = "holds no number (empty, NaN, - or the like)"
_TEXTS = 3  # of a column, that are quoted
_OVERLOAD = "reads {:.4g}, an instrument's code for an overload or no reading at all (SCPI writes ±9.9E37 and 9.91E37)"
_PLACEHOLDER = "reads {:g}, far from all other numbers: it stands for a missing reading"
_MOST_AT_REST = 20.0  # g; a sensor that takes any unit is at rest, or nearly so
_COLDEST = 100.0  # K; no inertial sensor is tested below, and no difference between two of its temperatures is above
_SINCE_1904 = 2_082_844_800.0  # s, from 1904 to 1970
_EARLIEST_1904 = of_cells.EARLIEST + _SINCE_1904  # s; the year 2000 counted from 1904


def convert_columns(
    table: Table,
    instrument: InstrumentLike,
    options: ReadOptions,
    problems: Objections | None = None,
) -> ConvertedColumns:
    """Convert a file's columns to the instrument's units, in its order, then what else was kept.

    What is wrong is added to `problems`, and the columns without any are converted all the same; where there are none
    to add to, InputError is raised. Rows with a missing reading are dropped where the options say so.
    """
    own = Objections() if problems is None else problems
    before = len(own)
    file = MatchedFile(table, instrument, options, own)
    extra, flags = ({}, []) if file.note_missing() else file.further_columns()
    own += table.problems
    converted = ConvertedColumns((file.table,), flags=[*file.table.notes, *flags])
    cells = _load(file, extra) if table.readable else {}
    _read_expected(file, cells, converted)
    _read_further(file, extra, cells, converted)
    _note_gravity(file, converted)
    _note_channels(file, extra, converted)
    if converted.missing and len(own) == before:
        _drop(file.table, converted, own)
    if problems is None:
        own.refuse()
    return converted


def _load(file: MatchedFile, extra: Mapping[str, Column]) -> dict[str, Cells]:
    """Load the cells of the columns that are read; times of day on the days of a column beside them."""
    table, positions = file.table, file.positions
    columns = {n: c for n, c in {**file.expected, **extra}.items() if n in positions}
    wanted = {positions[n]: c.unit is not None for n, c in columns.items()}
    days = [i for i, h in enumerate(table.headers) if plain(h.name) in DAYS and not h.unit]
    days = [i for i in days if "time" in columns and i != positions["time"]]
    beside = dict.fromkeys(days, True) if len(days) == 1 else {}
    cells = load_whole(table, wanted | beside)
    found = {name: cells[positions[name]] for name in columns}
    for day in beside:
        found["time"] = found["time"].on_days(cells[day], file.options.date_order)
    return found


def _read_expected(
    file: MatchedFile, cells: Mapping[str, Cells], converted: ConvertedColumns
) -> None:
    """Read the instrument's columns, in its order; those that the file lacks and that have a default hold that."""
    for name, column in file.expected.items():
        default = column.default
        if name in cells:
            ColumnReader(file, column, converted).read(cells[name])
            converted.unread |= {name} - set(converted.values)
        if name == MAGNITUDE and file.options.local_field is not None:
            if name in cells:
                raise InputError(
                    f"{file.table.file} has the local field in its column {file.header(name).raw!r}, and --local-field "
                    "says it too: leave one out (the column by --ignore)"
                )
            default = file.options.local_field
        if name not in converted.values and default is not None:
            kind = object if column.unit is None else np.float64
            converted.values[name] = np.full(file.table.rows, default, dtype=kind)
            converted.units[name] = column.unit
            converted.filled.add(name)


def _read_further(
    file: MatchedFile,
    extra: Mapping[str, Column],
    cells: Mapping[str, Cells],
    converted: ConvertedColumns,
) -> None:
    """Read columns that no instrument asked for; one of which a cell is no number is left out with a flag."""
    beside = copy(file)  # what is wrong with these is no problem of the file
    beside.options = replace(file.options, missing="refuse")
    for name in (n for n in extra if n in cells):
        beside.problems, flags = Objections(), len(converted.flags)
        ColumnReader(beside, extra[name], converted).read(cells[name])
        for problem in beside.problems[:1]:
            del converted.flags[flags:]
            why = " ".join((*problem.places[:1], problem.came))
            converted.flags.append(f"{file.table.file}: column {problem.column!r} ignored: {why}")


def _note_gravity(file: MatchedFile, converted: ConvertedColumns) -> None:
    """Mark readings that were divided by a local gravity that nobody stated, where scale factors depend on it."""
    outputs = getattr(file.instrument, "outputs", ()) or (output_name(file.instrument),)
    assumed = file.options.local_gravity is None and converted.by_gravity.intersection(outputs)
    if assumed and ASSUMED_GRAVITY in file.expected and MAGNITUDE not in converted.by_gravity:
        converted.values[ASSUMED_GRAVITY] = np.ones(file.table.rows)
        converted.units[ASSUMED_GRAVITY] = "1"
        converted.filled.add(ASSUMED_GRAVITY)
        said = (
            f"{file.table.file}: {file.options.gravity:g} m/s² was taken for local gravity, which nobody stated "
            "(--local-gravity): scale factors are as uncertain as it is on Earth, 9.780 to 9.832 m/s²"
        )
        converted.flags.append(Flag(said, "gravity.assumed", *outputs))


def _note_channels(
    file: MatchedFile, extra: Mapping[str, Column], converted: ConvertedColumns
) -> None:
    """Note the other channels of the unit whose output this is: they are no causes of it."""
    if (output := output_name(file.instrument)) not in converted.values:
        return
    own = file.header(output).name
    others = {n: u for n, u in converted.units.items() if n in extra}
    converted.beside.update(channels_beside(own, others, converted.units[output]))
    if converted.beside:
        converted.flags.append(
            f"{file.table.file}: {', '.join(sorted(converted.beside))}: other channels beside the output {own!r}, not "
            "taken as its causes (--covariates NAME, in Python covariates=, to let one be)"
        )


def _drop(table: Table, converted: ConvertedColumns, problems: Objections) -> None:
    """Leave the rows out in which a reading is missing, and say so; a problem if none would be left."""
    missing = converted.missing
    gone = np.unique(np.concatenate(list(missing.values())))
    if len(gone) == table.rows:
        counts = ", ".join(f"{name} in {len(rows)}" for name, rows in missing.items())
        came = f"has no row without a missing reading: {counts} of {table.rows} rows"
        problems.append(Objection(table.file, came))
        return
    converted.kept = np.setdiff1d(np.arange(table.rows), gone)
    converted.tables = (table.take(converted.kept),)
    converted.values = {name: v[converted.kept] for name, v in converted.values.items()}
    places = "; ".join(f"{name} in {_rows(table, rows)}" for name, rows in missing.items())
    said = f"{table.file}: {len(gone)} of {table.rows} rows dropped, where readings are missing: {places}"
    converted.flags.append(Flag(said, "rows.dropped", *missing))


def _rows(table: Table, rows: np.ndarray) -> str:
    """Rows, the first few by number."""
    first = ", ".join(table.place(int(i)) for i in rows[:3])
    return first if len(rows) == 1 else f"{len(rows)} rows ({first}{' …' * (len(rows) > 3)})"


@dataclass(frozen=True)
class ColumnReader:
    """Checks a column of a file and converts it into `converted`."""

    file: MatchedFile
    column: Column
    converted: ConvertedColumns

    def read(self, cells: Cells) -> None:
        """Read a column; one that is empty and not required is left out."""
        if self.column.unit is None:
            self._read_labels(cells.values)
            return
        if not self.column.required and not cells.bad and np.isnan(cells.values).all():
            self._flag("is empty and was left out")
            return
        before, cells = len(self.file.problems), self._in_order(cells)
        if cells.dates and not self._is_time:  # dates are numbers of the time alone
            cells = _as_text(cells)
        unit = self._unit(cells)
        raw, noted = cells.values, set(cells.bad)
        self._note_text(cells, unit)
        for find, said in ((overloads, _OVERLOAD), (placeholders, _PLACEHOLDER)):
            if (rows := find(raw)).size:
                self._note_missing(rows, said.format(raw[rows[0]]))
                noted |= {*rows.tolist()}
                raw = raw.copy()
                raw[rows] = np.nan
        raw = self._unwrapped(raw, unit)
        self._note_unsigned(raw)
        self._note_mass(raw, unit)
        with np.errstate(over="ignore"):
            values = raw if cells.dates or unit is None else self._convert(raw, unit)
        if values is None:
            return
        self._note_not_finite(raw, values, unit, noted)
        if unit is not None:
            self._note_implausible(raw, values, unit)
        # without a unit, the order of times can be looked at all the same
        if len(self.file.problems) == before or (unit is None and not cells.bad):
            if self._is_time:
                values = self._on_clock(values, cells.dates)
            self.converted.values[self.column.name] = values
            self.converted.units[self.column.name] = self.column.unit

    @property
    def header(self) -> Header:
        return self.file.header(self.column.name)

    @property
    def _is_time(self) -> bool:
        return self.column.name == "time" and self.column.unit == "s"

    @property
    def _is_output(self) -> bool:
        return self.column.name == output_name(self.file.instrument)

    @property
    def _names(self) -> tuple[str, str, str]:
        return self.header.raw, self.header.name, self.column.name

    def _problem(self, came: str, *about: str, **more: Any) -> None:
        self.file.problem(self.header.raw, came, *about, **more)

    def _flag(self, said: str) -> None:
        self.converted.flags.append(f"{self.file.table.file}: column {self.header.raw!r} {said}")

    def _note_missing(self, rows: np.ndarray, came: str, expected: str = "") -> None:
        """Note readings that are missing: a problem, unless such rows are dropped."""
        if self.file.options.missing == "refuse":
            cure, given = "Fill it in, or drop such rows", option("--missing", "drop")
            self._problem(came, expected, cure, given, rows=rows)
            return
        earlier = self.converted.missing.get(self.column.name, rows[:0])
        self.converted.missing[self.column.name] = np.union1d(earlier, rows)

    def _read_labels(self, labels: np.ndarray) -> None:
        if not self.column.required and (labels == "").all():
            self._flag("is empty and was left out")
            return
        empty, allowed = np.flatnonzero(labels == ""), self.column.allowed
        if empty.size:
            self._note_missing(empty, "is empty", "a label")
        before = len(self.file.problems)
        for label in dict.fromkeys(labels.tolist()):
            if any(unicodedata.category(character) in ("Cc", "Cs") for character in label):
                came = f"reads {label!r}, which holds a control character"
                self._problem(came, cure="Remove it", rows=np.flatnonzero(labels == label))
            elif label and allowed and label not in allowed:
                came, known = f"reads {label!r}, an unknown label", f"one of {', '.join(allowed)}"
                self._problem(came, known, "Correct it", rows=np.flatnonzero(labels == label))
        if len(self.file.problems) == before:
            self.converted.values[self.column.name] = labels
            self.converted.units[self.column.name] = None

    def _in_order(self, cells: Cells) -> Cells:
        """Dates whose day and month are dates apart: by one above 12, or as the user says; a problem if by neither."""
        if not (self._is_time and cells.orders):
            return cells
        dates, fitting = cells.in_order(self.file.options.date_order), cells.fitting_orders
        if dates.orders:
            came = "its dates are not all dates in one order of month, day and year"
            if fitting:
                came = "its dates leave open which number is the day, or whether they are times"
            orders = fitting or [n for n, v in cells.orders.items() if not np.isnan(v).all()]
            firsts = {n: date_text(float(np.nanmin(cells.orders[n]))).split() for n in orders}
            begin = ", ".join(f"{n} if it begins {f[n == 'hms']}" for n, f in firsts.items())
            cure = f"Say in which order they are: {begin}"
            expected = "a day above 12 in one of them, or the year first"
            self._problem(came, expected, cure, option("--date-order", orders[0]))
        return dates

    def _unit(self, cells: Cells) -> str | None:
        """Return the unit of the numbers; None, and a problem, if there is none or the text is none."""
        unit = unit_of(self.header, self.column.name, self.file.options)
        asked = option("--unit", f"{self.header.raw}=UNIT")
        if cells.dates:
            return "s"
        if unit is None and self._is_time and (shown := unit_of_counts(cells.values)):
            self._flag(f"taken as {pretty(shown)} since 1970, as its size shows")
            return shown
        if unit is None:
            if not (self._is_time and cells.bad and np.isnan(cells.values).all()):
                own = self.column.example
                cure = f"UNIT is what its numbers are in, such as {own}; in a header, '{self.header.name} [{own}]'"
                self._problem("the header has no unit", "one", cure, asked)
            return None  # dates of another form are said as such
        if self.column.unit != ANY:
            unit = unit_in(unit, (str(self.column.unit),)) or unit
        try:
            parse(unit)
        except InputError as error:
            self._problem(str(error), "", "Correct the header, or say the unit", asked)
            return None
        if self.header.unit and unit != self.header.unit:
            self._flag(f"taken as [{unit}], as --unit says")
        return unit

    def _note_text(self, cells: Cells, unit: str | None) -> None:
        """Note the cells that hold text."""
        if not cells.bad:
            return
        expected = _number_in(unit)
        if self._is_time and cells.dates:
            expected = f"a date such as {EXAMPLE}, with a zone everywhere or nowhere"
        elif self._is_time:
            expected = f"a date such as {EXAMPLE}" if unit is None else f"{expected}, or a date"
        texts = list(dict.fromkeys(cells.bad.values()))
        hint = "Correct the cell, or remove the row"
        if any(map(of_cells.DECIMAL_COMMA.fullmatch, texts)):
            hint = "If that is a decimal comma, say so (--decimal ,), or export the file with decimal points"
        came = ", ".join(repr(text[:60]) for text in texts[:_TEXTS]) + " …" * (len(texts) > _TEXTS)
        self._problem(f"reads {came}", expected, hint, rows=sorted(cells.bad))

    def _unwrapped(self, raw: np.ndarray, unit: str | None) -> np.ndarray:
        """Undo a counter's wraps, or a sign that was lost, where the user says so."""
        given = self.file.options.unwrap
        said = next((given[n] for n in self._names if n in given), None)
        if said is None or unit is None:
            return raw
        warm = same_dimension(unit, "degC")
        if said == SIGN and warm:
            values = restore_sign(raw, self._records(raw))
            self._flag(f"given back its sign at {np.count_nonzero(values != raw)} readings")
            return values
        period, own = period_of(said)
        if own != "1":
            period = float(convert(period, own, unit, difference=True))
        known = np.isfinite(raw)
        begun = int(np.count_nonzero(abs(np.diff(raw[known])) > 0.5 * period))
        if self._is_time:  # a converter's counts have a sign; a clock's have none
            values = raw.copy()
            values[known] = np.unwrap(raw[known], period=period)
        else:
            start = float(convert([ROOM], "degC", unit)[0]) if warm else 0.0
            values = unwrap(raw, self._records(raw), period, start)
        self._flag(f"began anew {begun} time{'s' * (begun != 1)}, which was undone (unwrap={said})")
        return values

    def _records(self, raw: np.ndarray) -> np.ndarray:
        """The record in time of each row, by the labels that are known."""
        known = {n: v for n, v in self.converted.values.items() if n in RECORD}
        return record_codes(known) if known else np.zeros(len(raw), np.int64)

    def _on_clock(self, values: np.ndarray, dates: bool) -> np.ndarray:
        """Count times from the first reading, if they are dates, and from when that was taken, where the user says so.

        Seconds that lie so far ahead since 1970 that nobody measured count from 1904, as LabVIEW's do.
        """
        values, since = from_first(values)
        if since is not None and since > _EARLIEST_1904 and not dates:
            begin = date_text(since)[:10]
            since -= _SINCE_1904
            self._flag(f"taken as since 1904 (LabVIEW): since 1970 it would begin {begin}")
        self.converted.origin = since
        begins, file = self.file.options.begin, self.file.table.file
        text = begins.get(file, begins.get("", ""))
        if not text or not np.isfinite(values).any():
            return values
        begin, dated = parse_begin(text)
        if dated and since is not None and file not in begins:
            return values
        self._flag(f"is counted from its first reading at {text} (--begin)")
        self.converted.origin = begin if dated else self.file.options.epoch
        return values - np.nanmin(values) + (0.0 if dated else begin)

    def _note_mass(self, raw: np.ndarray, unit: str | None) -> None:
        """Note a g that is hardly that of gravity, where the instrument takes whatever unit there is."""
        anything = {c.name for c in self.file.instrument.columns if c.unit == ANY}
        said = self.file.options.units.keys() & {*self._names}
        if unit is None or self.column.name not in anything or said:
            return
        powers, known = parse(unit).powers, raw[np.isfinite(raw)]
        far = powers == {"ug": 1} and known.size
        far = far and np.median(convert(abs(known), unit, "g")) > _MOST_AT_REST
        if far or (powers.get("ug") == 1 and powers.get("m") == -3):
            mass = re.sub(r"\b([mu]?)g\b", r"\1gram", unit)
            came = f"reads {known[0]:.4g} {pretty(unit)}, and g is gravity here: hardly an acceleration"
            cure = f"Is it a mass? Its unit is {mass}; if it is gravity, say so: "
            cure += option("--unit", f"{self.header.raw}={unit}")
            self._problem(came, cure=cure, option=option("--unit", f"{self.header.raw}={mass}"))

    def _note_unsigned(self, raw: np.ndarray) -> None:
        """Note signed counts that were written as unsigned: at both ends of the bits, and never between."""
        known = raw[np.isfinite(raw)]
        if not self._is_output or not known.size or (known != np.round(known)).any():
            return
        low, high = float(known.min()), float(known.max())
        bits = next((b for b in (12, 16, 20, 24, 32) if high < 2.0**b), 0)
        ends = 2.0**bits / 16
        first, last = known < ends, known >= 15 * ends
        if (
            bits
            and low >= 0
            and last.any()
            and np.count_nonzero(first) > 1
            and (first | last).all()
        ):
            came = f"holds whole numbers near 0 and near 2^{bits}, and none between: signed counts read as unsigned"
            asked = option("--unwrap", f"{self.header.raw}=2^{bits}")
            self._problem(came, cure="Undo it, if that is so", option=asked)

    def _convert(self, values: np.ndarray, unit: str) -> np.ndarray | None:
        """Numbers in `unit` in the column's, or by the nominal scale; None, and a problem, if neither can be."""
        target, gravity = self.column.unit or "1", self.file.options.gravity
        own, difference = self.file.options.nominal_scale, self.column.name == UNCERTAINTY
        scale = own or self.file.instrument.nominal_scale
        asked = option("--unit", f"{self.header.raw}=UNIT")
        if same_dimension(unit, target):
            if needs_gravity(unit, target):
                self.converted.by_gravity.add(self.column.name)
                self._flag(f"turned into local g by {gravity:g} m/s²")
            try:
                return convert(values, unit, target, local_gravity=gravity, difference=difference)
            except InputError as error:  # a difference of temperatures, say
                if (absolute := _above_zero(values, unit, target)) is not None:
                    self._flag(f"[{unit}] taken as temperatures above absolute zero")
                    return absolute
                self._problem(str(error), option=asked)
                return None
        raw_output, also, hint = self._is_output or difference, "", ""
        if raw_output and scale is not None:
            if same_dimension(unit, scale.unit):
                return self._by_scale(values, unit, scale, difference)
            also = f", or {scale.unit}, which the nominal scale converts"
        if raw_output:
            per = f"({target})" if "/" in target else target
            how = option("--nominal-scale", f"250 {unit}/{per}")
            hint = f" Or say how many {unit} one {target} is, such as {how}"
        cure = f"Correct the header, or give the unit that is meant.{hint}"
        came, expected = f"its unit is [{unit}]", f"one that converts to {target}{also}"
        self._problem(came, expected, cure, asked)
        return None

    def _by_scale(
        self, values: np.ndarray, unit: str, scale: NominalScale, difference: bool
    ) -> np.ndarray:
        """Turn raw outputs into the instrument's by the nominal scale, and say so."""
        own = self.file.options.nominal_scale is not None
        shifted = scale.offset and not difference
        reading = f"(reading − {scale.offset:g})" if shifted else "reading"
        of = "" if own else f" of {self.file.instrument.name}"
        other = "" if own else " (another sensor's: --nominal-scale and --nominal-zero)"
        self._flag(
            f"turned into {pretty(self.column.unit or '1')} by the nominal scale{of}: {reading}/{scale.gain:g}, "
            f"reading in {pretty(scale.unit)}{other}"
        )
        if scale.by_gravity:
            self.converted.by_gravity.add(self.column.name)
        gravity = self.file.options.gravity
        raw = convert(values, unit, scale.unit, local_gravity=gravity, difference=difference)
        return scale.apply(raw, difference=difference)

    def _note_not_finite(
        self, raw: np.ndarray, values: np.ndarray, unit: str | None, noted: set[int]
    ) -> None:
        """Note what is empty as missing, and what is infinite as wrong; a temperature point may be empty."""
        expected = _number_in(unit)
        bad = np.isinf(values) if self.column.name == MAY_BE_EMPTY else ~np.isfinite(values)
        wrong = np.setdiff1d(np.flatnonzero(bad), list(noted))
        none = np.isnan(raw[wrong])
        if none.any() and len(noted) < MOST_BAD:
            self._note_missing(wrong[none], _EMPTY, expected)
        if (infinite := wrong[~none]).size:
            first = float(raw[infinite[0]])
            came = f"reads {first:g}" + ", too large" * bool(np.isfinite(first))
            self._problem(came, expected, "Fill it in, or remove the row", rows=infinite)

    def _note_implausible(self, raw: np.ndarray, values: np.ndarray, unit: str) -> None:
        low = -np.inf if self.column.low is None else self.column.low
        high = np.inf if self.column.high is None else self.column.high
        wrong = np.flatnonzero((values < low) | (values > high))
        if not wrong.size:
            return
        index, target = int(wrong[0]), self.column.unit or "1"
        limits = f"at least {low:g}" if high == np.inf else f"at most {high:g}"
        limits = f"{low:g} … {high:g}" if low > -np.inf and high < np.inf else limits
        shown = pretty(target)
        internal = f", that is {values[index]:.6g} {shown}" * (pretty(unit) != shown)
        came = f"reads {raw[index]:.6g} {pretty(unit)}{internal}; plausible is {limits} {shown}"
        cure, given = "Check the unit and the number", ""
        if target == "degC" and (period := self._period(values, low, high)):
            came = f"{came}; a counter of {period:g} °C that began anew"
            cure, given = (
                "Undo it, if that is so",
                option("--unwrap", f"{self.header.raw}={period:g}degC"),
            )
        self._problem(came, "", cure, given, rows=wrong)

    def _period(self, values: np.ndarray, low: float, high: float) -> float | None:
        """The period, °C, of a counter without whose wraps all temperatures are plausible; None where there is none."""
        known, labels = np.isfinite(values), ("time", *RECORD)
        columns = {n: v[known] for n, v in self.converted.values.items() if n in labels}
        values, codes = values[known], self._records(values)[known]
        found = wrap_period(values, codes, allowed_changes(columns, values))
        whole = () if (values <= high).any() else PERIODS  # all readings are beyond
        for period in (p for p in (found, *whole) if p and values.max() < p):
            undone = unwrap(values, codes, period, ROOM)
            if low < undone.min() and undone.max() < high:
                return period
        return None


def _as_text(dates: Cells) -> Cells:
    """Dates as cells that hold no number."""
    there = np.flatnonzero(~np.isnan(dates.values))[:MOST_BAD]
    texts = {int(i): date_text(float(dates.values[i])) for i in there}
    return Cells(np.full(len(dates.values), np.nan), {**texts, **dates.bad})


def _number_in(unit: str | None) -> str:
    return "a number" if unit is None else f"a number in {pretty(unit)}"


def _above_zero(values: np.ndarray, unit: str, target: str) -> np.ndarray | None:
    """Temperatures in parts of a kelvin, such as mK, that can only be absolute; None where they may be differences."""
    kelvin = convert(values, unit, "delta_degC") if unit.endswith("K") else np.zeros(1)
    found = kelvin[np.isfinite(kelvin)]
    return convert(kelvin, "K", target) if found.size and found.min() > _COLDEST else None
