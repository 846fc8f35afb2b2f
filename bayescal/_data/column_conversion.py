"""Conversion of a file's columns to an instrument's units; all problems are collected before any is reported."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bayescal._core.errors import InputError
from bayescal._core.flag import Flag
from bayescal._data import dataset_checks as checks
from bayescal._data import unit_conversion as units
from bayescal._data.column import (
    ASSUMED_GRAVITY,
    MAY_BE_EMPTY,
    UNCERTAINTY,
    Column,
    ConvertedColumns,
    NominalScale,
    find_overloads,
    find_placeholders,
)
from bayescal._data.header_matching import DAYS, MatchedFile, channels_beside, plain
from bayescal._data.pose_rows import MAGNITUDE
from bayescal._data.read_options import (
    InstrumentLike,
    ReadOptions,
    output_name,
    parse_begin,
    parse_period,
    unit_of,
)
from bayescal._data.records import Records
from bayescal._tables import cells as of_cells
from bayescal._tables.cells import MAX_BAD, Cells, format_date
from bayescal._tables.raw_table import Objections, Table, load_whole, option

_EMPTY = "holds no number (empty, NaN, - or the like)"
_QUOTED = 3  # of a column
_OVERLOAD = "reads {:.4g}, an instrument's code for an overload or no reading at all (SCPI writes ±9.9E37 and 9.91E37)"
_PLACEHOLDER = "reads {:g}, far from all other numbers: it stands for a missing reading"
_SINCE_1904 = 2_082_844_800.0  # s, from 1904 to 1970
_EARLIEST_1904 = of_cells.EARLIEST + _SINCE_1904  # s; the year 2000 counted from 1904
_BITS = (12, 16, 20, 24, 32)  # of converters


def convert_columns(
    table: Table, instrument: InstrumentLike, options: ReadOptions
) -> ConvertedColumns:
    """Convert a file's columns to the instrument's units, in its order, then the further columns that are kept.

    Rows with a missing reading are dropped where the options say so. Raises InputError with all problems of the file.
    """
    problems = Objections()
    file = MatchedFile(table, instrument, options, problems)
    extra, flags = ({}, []) if file.note_missing() else file.further_columns()
    converted = ConvertedColumns((file.table,), flags=[*file.table.notes, *flags])
    cells = _load(file, extra)
    _read_expected(file, cells, converted)
    _read_further(file, extra, cells, converted)
    _note_gravity(file, converted)
    _note_channels(file, extra, converted)
    if converted.missing and not problems:
        _drop(file.table, converted)
    problems.refuse()
    return converted


def _load(file: MatchedFile, extra: Mapping[str, Column]) -> dict[str, Cells]:
    """Load the cells of the columns that are read; times of day are joined with a column of dates."""
    table, positions = file.table, file.positions
    columns = {n: c for n, c in {**file.expected, **extra}.items() if n in positions}
    requested = {positions[n]: c.unit is not None for n, c in columns.items()}
    days = [i for i, h in enumerate(table.headers) if plain(h.name) in DAYS and not h.unit]
    days = [i for i in days if "time" in columns and i != positions["time"]]
    dates = dict.fromkeys(days, True) if len(days) == 1 else {}
    cells = load_whole(table, requested | dates)
    loaded = {name: cells[positions[name]] for name in columns}
    for day in dates:
        loaded["time"] = loaded["time"].on_days(cells[day])
    return loaded


def _read_expected(
    file: MatchedFile, cells: Mapping[str, Cells], converted: ConvertedColumns
) -> None:
    """Read the instrument's columns, in its order; fill those that the file lacks with their default."""
    for name, column in file.expected.items():
        default = column.default
        if name in cells:
            ColumnReader(file, column, converted).read(cells[name])
        if name == MAGNITUDE and file.options.local_field is not None:
            if name in cells:
                raise InputError(
                    f"{file.table.file} has the local field in its column {file.header(name).raw!r}, and --local-field "
                    "says it too: leave one out (the column by --ignore)"
                )
            default = file.options.local_field
        if name not in converted.values and default is not None:
            converted.fill(name, default, column.unit)


def _read_further(
    file: MatchedFile,
    extra: Mapping[str, Column],
    cells: Mapping[str, Cells],
    converted: ConvertedColumns,
) -> None:
    """Read columns that the instrument does not expect; flag and leave out one with a cell that is no number."""
    options = replace(file.options, missing="refuse")
    for name in (n for n in extra if n in cells):
        objections, flags = Objections(), len(converted.flags)  # these are no problems of the file
        ColumnReader(file, extra[name], converted, options, objections).read(cells[name])
        for problem in objections[:1]:
            why = " ".join((*problem.places[:1], problem.came))
            message = f"{file.table.file}: column {problem.column!r} ignored: {why}"
            converted.flags[flags:] = [message]


def _note_gravity(file: MatchedFile, converted: ConvertedColumns) -> None:
    """Mark readings divided by a local gravity that nobody stated, where scale factors depend on it."""
    outputs = getattr(file.instrument, "outputs", ()) or (output_name(file.instrument),)
    assumed = file.options.local_gravity is None and converted.by_gravity.intersection(outputs)
    if assumed and ASSUMED_GRAVITY in file.expected and MAGNITUDE not in converted.by_gravity:
        converted.fill(ASSUMED_GRAVITY, 1.0, "1")
        message = (
            f"{file.table.file}: {file.options.gravity:g} m/s² was taken for local gravity, which nobody stated "
            "(--local-gravity): scale factors are as uncertain as it is on Earth, 9.780 to 9.832 m/s²"
        )
        converted.flags.append(Flag(message, "gravity.assumed", *outputs))


def _note_channels(
    file: MatchedFile, extra: Mapping[str, Column], converted: ConvertedColumns
) -> None:
    """Flag the other channels of the unit whose output this is: they are no causes of it."""
    if (output := output_name(file.instrument)) not in converted.values:
        return
    output_header = file.header(output).name
    others = {n: u for n, u in converted.units.items() if n in extra}
    converted.other_channels.update(channels_beside(output_header, others, converted.units[output]))
    if converted.other_channels:
        names = ", ".join(sorted(converted.other_channels))
        converted.flags.append(
            f"{file.table.file}: {names}: not covariates, as they look like channels beside output {output_header!r} "
            "(to use one as a covariate: --covariates NAME, in Python covariates=)"
        )


def _drop(table: Table, converted: ConvertedColumns) -> None:
    """Drop the rows with a missing reading, with a flag; raise InputError if no row would remain."""
    missing = converted.missing
    gone = np.unique(np.concatenate(list(missing.values())))
    converted.kept_rows = np.setdiff1d(np.arange(table.rows), gone)
    converted.tables = (table.take(converted.kept_rows),)
    converted.values = {name: v[converted.kept_rows] for name, v in converted.values.items()}
    places = "; ".join(f"{name} in {_format_rows(table, rows)}" for name, rows in missing.items())
    message = f"{table.file}: {len(gone)} of {table.rows} rows dropped, where readings are missing: {places}"
    converted.flags.append(Flag(message, "rows.dropped", *missing))


def _format_rows(table: Table, rows: np.ndarray) -> str:
    """Format rows, the first three by number."""
    first = ", ".join(table.place(int(i)) for i in rows[:3])
    return first if len(rows) == 1 else f"{len(rows)} rows ({first}{' …' * (len(rows) > 3)})"


class ColumnReader:
    """Checker and converter of one column of a file; options and problems are the file's unless given."""

    def __init__(
        self,
        file: MatchedFile,
        column: Column,
        converted: ConvertedColumns,
        options: ReadOptions | None = None,
        problems: Objections | None = None,
    ) -> None:
        self.file, self.column, self.converted = file, column, converted
        self.options = options or file.options
        self.problems = file.problems if problems is None else problems
        self.name, self.header = column.name, file.header(column.name)
        self.is_time = self.name == "time" and column.unit == "s"
        self.is_output = self.name == output_name(file.instrument)
        self.names = self.header.raw, self.header.name, self.name

    def read(self, cells: Cells) -> None:
        """Check and convert the cells of the column; leave it out if it is empty and not required."""
        label, before = self.column.unit is None, len(self.problems)
        empty = cells.values == "" if label else np.isnan(cells.values)
        if not self.column.required and not cells.bad and empty.all():
            self._flag("is empty and was left out")
            return
        if label:
            if empty.any():
                self._note_missing(np.flatnonzero(empty), "is empty", "a label")
            self._note_labels(cells.values)
            if len(self.problems) == before:
                self._keep(cells.values)
            return
        texts = cells.dates if self.is_time else None
        if dates := texts is not None:  # which are numbers of the time alone
            cells = self._read_dates(texts)
        unit = "s" if dates else self._unit(cells)
        raw, noted = cells.values, set(cells.bad)
        self._note_text(cells, unit, dates)
        for find, template in ((find_overloads, _OVERLOAD), (find_placeholders, _PLACEHOLDER)):
            if (rows := find(raw)).size:
                self._note_missing(rows, template.format(raw[rows[0]]))
                noted |= {*rows.tolist()}
                raw = raw.copy()
                raw[rows] = np.nan
        raw = self._unwrapped(raw, unit)
        self._note_unsigned(raw)
        with np.errstate(over="ignore"):
            values = raw if dates or unit is None else self._convert(raw, unit)
        if values is None:
            return
        self._note_not_finite(raw, values, unit, noted)
        if unit is not None:
            self._note_implausible(raw, values, unit)
        if len(self.problems) == before:
            self._keep(self._on_clock(values, dates) if self.is_time else values)

    def _keep(self, values: np.ndarray) -> None:
        self.converted.values[self.name] = values
        self.converted.units[self.name] = self.column.unit

    def _problem(self, came: str, *about: str, **details: Any) -> None:
        self.problems.append(self.file.table.objection(self.header.raw, came, *about, **details))

    def _flag(self, text: str) -> None:
        self.converted.flags.append(f"{self.file.table.file}: column {self.header.raw!r} {text}")

    def _note_missing(self, rows: np.ndarray, came: str, expected: str = "") -> None:
        """Record missing readings: a problem, unless such rows are dropped."""
        if self.options.missing == "refuse":
            cure, suggestion = "Fill it in, or drop such rows", option("--missing", "drop")
            self._problem(came, expected, cure, suggestion, rows=rows)
            return
        earlier = self.converted.missing.get(self.name, rows[:0])
        self.converted.missing[self.name] = np.union1d(earlier, rows)

    def _note_labels(self, labels: np.ndarray) -> None:
        """Add a problem for labels that are unknown, or hold a control character."""
        allowed, choices = self.column.allowed, f"one of {', '.join(self.column.allowed)}"
        for label in dict.fromkeys(labels.tolist()):
            if any(unicodedata.category(character) in ("Cc", "Cs") for character in label):
                came, expected, cure = "which holds a control character", "", "Remove it"
            elif label and allowed and label not in allowed:
                came, expected, cure = "an unknown label", choices, "Correct it"
            else:
                continue
            rows = np.flatnonzero(labels == label)
            self._problem(f"reads {label!r}, {came}", expected, cure, rows=rows)

    def _read_dates(self, texts: np.ndarray) -> Cells:
        """Parse dates; add a problem where they leave open which number is the day, and the user does not say."""
        dates, orders = of_cells.parse_dates(texts, self.options.date_order)
        if orders:
            came = "its dates leave open which number is the day, or whether they are times"
            expected = "a day above 12 in one of them, or the year first"
            cure = f"Say in which order they are: {', '.join(orders)}"
            self._problem(came, expected, cure, option("--date-order", orders[0]))
        return dates

    def _unit(self, cells: Cells) -> str | None:
        """Return the unit of the numbers; None, and a problem, if there is none or the text is no unit."""
        unit = unit_of(self.header, self.name, self.options)
        suggestion = option("--unit", f"{self.header.raw}=UNIT")
        if unit is None:
            if self.is_time and (inferred := of_cells.detect_epoch_unit(cells.values)):
                self._flag(f"taken as {units.pretty(inferred)} since 1970, as its size shows")
                return inferred
            if not (self.is_time and cells.bad and np.isnan(cells.values).all()):
                like = self.column.example
                cure = f"Write it in the header, such as '{self.header.name} [{like}]', or give UNIT, such as {like}"
                self._problem("the header has no unit", "", cure, suggestion)
            return None  # dates of another form are said as such
        if self.column.unit != units.ANY:
            unit = units.unit_in(unit, (str(self.column.unit),)) or unit
        try:
            units.parse(unit)
        except InputError as error:
            self._problem(str(error), "", "Correct the header, or say the unit", suggestion)
            return None
        if self.header.unit and unit != self.header.unit:
            self._flag(f"taken as [{unit}], as --unit says")
        return unit

    def _note_text(self, cells: Cells, unit: str | None, dates: bool) -> None:
        """Add a problem for cells that hold text."""
        if not cells.bad:
            return
        expected, date = _number_in(unit), f"a date such as {of_cells.EXAMPLE}"
        if dates:
            expected = f"{date}, with a zone everywhere or nowhere"
        elif self.is_time:
            expected = date if unit is None else f"{expected}, or a date"
        texts = list(dict.fromkeys(cells.bad.values()))
        hint = "Correct the cell, or remove the row"
        if any(map(of_cells.DECIMAL_COMMA.fullmatch, texts)):
            hint = "If that is a decimal comma, say so (--decimal ,), or export the file with decimal points"
        quoted = ", ".join(repr(t[:60]) for t in texts[:_QUOTED]) + " …" * (len(texts) > _QUOTED)
        self._problem(f"reads {quoted}", expected, hint, rows=sorted(cells.bad))

    def _unwrapped(self, raw: np.ndarray, unit: str | None) -> np.ndarray:
        """Unwrap a counter, where the user gives its period."""
        periods = self.options.unwrap
        text = next((periods[n] for n in self.names if n in periods), None)
        if text is None or unit is None:
            return raw
        warm = units.same_dimension(unit, "degC")
        period, period_unit = parse_period(text)
        if period_unit != "1":
            period = float(units.convert(period, period_unit, unit, difference=True))
        finite = np.isfinite(raw)
        wraps = int(np.count_nonzero(abs(np.diff(raw[finite])) > 0.5 * period))
        if self.is_time:  # a converter's counts have a sign; a clock's have none
            values = raw.copy()
            values[finite] = np.unwrap(raw[finite], period=period)
        else:
            start = float(units.convert([checks.ROOM_DEGREES], "degC", unit)[0]) if warm else 0.0
            records = Records.of({**self.converted.values, "": raw})
            values = checks.unwrap(raw, records, period, start)
        self._flag(f"began anew {wraps} time{'s' * (wraps != 1)}, which was undone (unwrap={text})")
        return values

    def _on_clock(self, values: np.ndarray, dates: bool) -> np.ndarray:
        """Return times from the first reading, if they are dates, and from the user's `begin`, where it is given.

        Seconds that lie so far ahead since 1970 that nobody measured count from 1904, as LabVIEW's do.
        """
        values, since = of_cells.split_origin(values)
        if since is not None and since > _EARLIEST_1904 and not dates:
            begin = format_date(since)[:10]
            since -= _SINCE_1904
            self._flag(f"taken as since 1904 (LabVIEW): since 1970 it would begin {begin}")
        self.converted.origin = since
        begins, file = self.options.begin, self.file.table.file
        text = begins.get(file, begins.get("", ""))
        if not text or not np.isfinite(values).any():
            return values
        begin, dated = parse_begin(text)
        if dated and since is not None and file not in begins:
            return values
        self._flag(f"is counted from its first reading at {text} (--begin)")
        self.converted.origin = begin if dated else self.options.epoch
        return values - np.nanmin(values) + (0.0 if dated else begin)

    def _note_unsigned(self, raw: np.ndarray) -> None:
        """Add a problem for signed counts written as unsigned: at both ends of the bits, and never between."""
        finite = raw[np.isfinite(raw)]
        if not self.is_output or not finite.size or finite.min() < 0 or (finite % 1).any():
            return
        bits = next((b for b in _BITS if finite.max() < 2.0**b), np.inf)
        part = finite // 2.0 ** (bits - 4)  # sixteenths of the range
        if np.isin(part, (0, 15)).all() and (part == 15).any() and np.sum(part == 0) > 1:
            came = f"holds whole numbers near 0 and near 2^{bits}, and none between: signed counts read as unsigned"
            suggestion = option("--unwrap", f"{self.header.raw}=2^{bits}")
            self._problem(came, cure="Undo it, if that is so", option=suggestion)

    def _convert(self, values: np.ndarray, unit: str) -> np.ndarray | None:
        """Convert numbers to the column's unit, or by the nominal scale; None, and a problem, if neither can be."""
        target, gravity = self.column.unit or "1", self.options.gravity
        given_scale, difference = self.options.nominal_scale, self.name == UNCERTAINTY
        scale = given_scale or self.file.instrument.nominal_scale
        suggestion = option("--unit", f"{self.header.raw}=UNIT")
        how = {"local_gravity": gravity, "difference": difference}
        if units.same_dimension(unit, target):
            if units.needs_gravity(unit, target):
                self.converted.by_gravity.add(self.name)
                self._flag(f"turned into local g by {gravity:g} m/s²")
            try:
                return units.convert(values, unit, target, **how)
            except InputError as error:  # a difference of temperatures, say
                self._problem(str(error), option=suggestion)
                return None
        also = hint = ""
        if self.is_output or difference:
            if scale is not None and units.same_dimension(unit, scale.unit):
                self._note_scale(scale, difference)
                raw = units.convert(values, unit, scale.unit, **how)
                return scale.apply(raw, difference=difference)
            also = f", or {scale.unit} (by the nominal scale)" if scale else ""
            per = f"({target})" if "/" in target else target
            scale_option = option("--nominal-scale", f"250 {unit}/{per}")
            hint = f" Or say how many {unit} one {target} is, such as {scale_option}"
        cure = f"Correct the header, or give the unit that is meant.{hint}"
        came, expected = f"its unit is [{unit}]", f"{target} or a unit that converts to it{also}"
        self._problem(came, expected, cure, suggestion)
        return None

    def _note_scale(self, scale: NominalScale, difference: bool) -> None:
        """Flag that raw outputs are converted to the instrument's by the nominal scale."""
        is_given = self.options.nominal_scale is not None
        shifted = scale.offset and not difference
        reading = f"(reading − {scale.offset:g})" if shifted else "reading"
        of = "" if is_given else f" of {self.file.instrument.name}"
        other = "" if is_given else " (another sensor's: --nominal-scale and --nominal-zero)"
        self._flag(
            f"turned into {units.pretty(self.column.unit or '1')} by the nominal scale{of}: {reading}/{scale.gain:g}, "
            f"reading in {units.pretty(scale.unit)}{other}"
        )
        if scale.by_gravity:
            self.converted.by_gravity.add(self.name)

    def _note_not_finite(
        self, raw: np.ndarray, values: np.ndarray, unit: str | None, noted: set[int]
    ) -> None:
        """Record empty cells as missing and infinite ones as problems; a temperature point may be empty."""
        expected = _number_in(unit)
        bad = np.isinf(values) if self.name == MAY_BE_EMPTY else ~np.isfinite(values)
        wrong = np.setdiff1d(np.flatnonzero(bad), list(noted))
        none = np.isnan(raw[wrong])
        if none.any() and len(noted) < MAX_BAD:
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
        unit_text, target_text = units.pretty(unit), units.pretty(target)
        internal = f", that is {values[index]:.6g} {target_text}" * (unit_text != target_text)
        came = f"reads {raw[index]:.6g} {unit_text}{internal}; plausible is {limits} {target_text}"
        cure = "Check the unit and the number"
        if target == "degC" and values[index] > high:
            undo = option("--unwrap", f"{self.header.raw}=PERIODdegC")
            cure += f"; a counter that began anew is undone by {undo}"
        self._problem(came, "", cure, rows=wrong)


def _number_in(unit: str | None) -> str:
    return "a number" if unit is None else f"a number in {units.pretty(unit)}"


def join_files(parts: Sequence[ConvertedColumns], labels: Sequence[str]) -> ConvertedColumns:
    """Concatenate the files' columns; files without a column `run` take `labels`.

    Raises:
        InputError: labels or dates stand in some files only, or one column has two dimensions.
    """
    if len(parts) == 1:
        return parts[0]
    _label_runs(parts, labels)
    whole = ConvertedColumns(tuple(table for part in parts for table in part.tables))
    whole.flags = [flag for part in parts for flag in part.flags]
    whole.other_channels = set().union(*(part.other_channels for part in parts))
    whole.origin = _align_time_origins(parts)
    for name, unit in {name: unit for part in parts for name, unit in part.units.items()}.items():
        for part in parts:
            if part.units.get(name, unit) != unit:
                raise InputError(
                    f"column {name!r} is in {part.units[name]} in {part.tables[0].file!r} and in {unit} in another "
                    "file: give it one kind of unit, or rename one"
                )
        with_it, without = _first_files(parts, [name in part.values for part in parts])
        if without and unit is None:
            raise InputError(
                f"{without!r} lacks the column {name!r} that {with_it!r} has: label every file, or none"
            )
        if without and name == MAY_BE_EMPTY:
            whole.flags.append(f"{without}: no {name!r}: its readings belong to no cell (a ramp)")
        elif without and name != ASSUMED_GRAVITY:
            whole.flags.append(f"column {name!r} left out: {with_it} has it, {without} has not")
            continue
        fill = 0.0 if name == ASSUMED_GRAVITY else np.nan
        missing = (np.full(table.rows, fill) for table in whole.tables)
        columns = [p.values.get(name, none) for p, none in zip(parts, missing, strict=True)]
        whole.values[name], whole.units[name] = np.concatenate(columns), unit
    first = dict[str, str]()
    for table in whole.tables:
        if (other := first.setdefault(table.sha256, table.file)) != table.file:
            same = f"{table.file} has the same content as {other}: the same readings twice?"
            whole.flags.append(same)
    return whole


def _label_runs(parts: Sequence[ConvertedColumns], labels: Sequence[str]) -> None:
    """Label the files without a column `run` as a run each, and flag runs that span files."""
    run_sets = [set(part.values.get("run", ())) for part in parts]
    named, file_of_run = set().union(*run_sets), dict[str, str]()
    for part, label, runs in zip(parts, labels, run_sets, strict=True):
        (table,) = part.tables
        if "run" not in part.values:
            label = f"file {label}" if label in named else label
            part.values["run"] = np.full(table.rows, label, dtype=object)
            part.units["run"] = None
        part.flags += [
            f"run {run!r} of {table.file} is taken as the one of {file_of_run[run]}, continued"
            for run in sorted(runs & file_of_run.keys())
        ]
        file_of_run = dict.fromkeys(runs, table.file) | file_of_run


def _first_files(
    parts: Sequence[ConvertedColumns], have: Sequence[bool]
) -> tuple[str | None, str | None]:
    """Return the first file that has something (`have`), and the first that has not."""
    first = {has: part.tables[0].file for part, has in reversed([*zip(parts, have, strict=True)])}
    return first.get(True), first.get(False)


def _align_time_origins(parts: Sequence[ConvertedColumns]) -> float | None:
    """Shift the times of dated files to a common origin, the earliest date; return that date, or None without dates."""
    timed = [part for part in parts if "time" in part.values]
    origins = [part.origin for part in timed if part.origin is not None]
    if not origins:
        return None
    with_it, without = _first_files(timed, [part.origin is not None for part in timed])
    if without:
        raise InputError(
            f"{with_it!r} has dates in its column 'time', {without!r} has none: say when its first reading was taken, "
            f"--begin '{without}=2026-05-13 10:14:20', or read them one by one"
        )
    for part, origin in zip(timed, origins, strict=True):
        part.values["time"] = np.round(part.values["time"] + (origin - min(origins)), 6)
    return min(origins)
