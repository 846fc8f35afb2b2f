"""Conversion of a file's columns to an instrument's units; all problems are collected before any is reported."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from typing import Any

import numpy as np

from bayescal._core.errors import InputError
from bayescal._core.flag import Flag
from bayescal._data import dataset_checks as checks
from bayescal._data import unit_conversion as units
from bayescal._data.column import (
    ASSUMED_GRAVITY,
    SOAK_POINT,
    UNCERTAINTY,
    Column,
    ConvertedColumns,
    NominalScale,
    find_overloads,
    find_placeholders,
)
from bayescal._data.header_matching import DATE_NAMES, MatchedFile, find_channels, normalise
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
from bayescal._tables import cells as table_cells
from bayescal._tables.cells import MAX_INVALID_ROWS, Cells, format_date
from bayescal._tables.raw_table import Objections, Table, load_whole, option

_EMPTY_FAULT = "contains no number (empty, NaN, - or similar)"
_MAX_QUOTED = 3  # cells of a column quoted in a message
_OVERLOAD_FAULT = "reads {:.4g}, a code for an overload or no reading (SCPI: ±9.9E37, 9.91E37)"
_PLACEHOLDER_FAULT = "reads {:g}, far from all other numbers: a placeholder for a missing reading"
_EPOCH_OFFSET_S = 2_082_844_800.0  # from 1904 to 1970
_EARLIEST_SINCE_1904_S = table_cells.EARLIEST_S + _EPOCH_OFFSET_S  # the year 2000 counted from 1904
_CONVERTER_BITS = (12, 16, 20, 24, 32)  # word lengths of analogue-to-digital converters


def convert_columns(
    table: Table, instrument: InstrumentLike, options: ReadOptions
) -> ConvertedColumns:
    """Convert a file's columns to the instrument's units: the columns that it declares in their order, then others.

    Rows with a missing reading are dropped if the options request it. An InputError lists all problems of the file.
    """
    problems = Objections()
    file = MatchedFile(table, instrument, options, problems)
    if not file.note_missing():
        file.add_further_columns()
    converted = ConvertedColumns((file.table,), flags=file.flags)
    cells = _load_cells(file)
    for name, column in file.columns.items():
        default = column.default
        if name in cells:
            _convert_column(ColumnReader(file, column, converted), cells[name])
        if name == MAGNITUDE and options.local_field is not None:
            if name in cells:
                raise InputError(
                    f"{table.file} has the local field in its column {file.header(name).raw!r}, and --local-field "
                    "gives it too: omit one of them (--ignore excludes the column)"
                )
            default = options.local_field
        if name not in converted.values and default is not None:
            converted.fill(name, default, column.unit)
    _note_gravity(file, converted)
    _note_channels(file, converted)
    if converted.missing and not problems:
        _drop_rows(file.table, converted)
    problems.refuse()
    return converted


def _load_cells(file: MatchedFile) -> dict[str, Cells]:
    """Load the cells of all columns that are used; combine times of day with the dates of a date column."""
    table, positions = file.table, file.positions
    columns = {name: column for name, column in file.columns.items() if name in positions}
    requested = {positions[n]: c.unit is not None for n, c in columns.items()}
    names = {i: normalise(h.name) for i, h in enumerate(table.headers) if not h.unit}
    days = [i for i, n in names.items() if n in DATE_NAMES and i != positions.get("time")]
    dates = dict.fromkeys(days, True) if len(days) == 1 and "time" in columns else {}
    cells = load_whole(table, requested | dates)
    loaded = {name: cells[positions[name]] for name in columns}
    for day in dates:
        loaded["time"] = loaded["time"].on_days(cells[day])
    return loaded


def _convert_column(reader: ColumnReader, cells: Cells) -> None:
    """Convert a column; if it is undeclared and has a cell that is not a number, ignore it with a flag."""
    reader.read(cells)
    if reader.is_declared or not reader.problems:
        reader.file.problems += reader.problems
        reader.converted.flags += reader.flags
    else:
        problem = reader.problems[0]
        reason = " ".join((*problem.places[:1], problem.fault))
        message = f"{problem.file}: column {problem.column!r} ignored: {reason}"
        reader.converted.flags.append(message)


def _note_gravity(file: MatchedFile, converted: ConvertedColumns) -> None:
    """Add the column `ASSUMED_GRAVITY` and a flag if outputs were converted with an assumed local gravity."""
    outputs = getattr(file.instrument, "outputs", ()) or (output_name(file.instrument),)
    is_assumed = file.options.local_gravity is None and converted.by_gravity.intersection(outputs)
    if is_assumed and ASSUMED_GRAVITY in file.expected and MAGNITUDE not in converted.by_gravity:
        converted.fill(ASSUMED_GRAVITY, 1.0, "1")
        message = (
            f"{file.table.file}: local gravity is assumed to be {file.options.gravity:g} m/s² because it was not given "
            "(--local-gravity): scale factors are as uncertain as gravity on Earth, 9.780 to 9.832 m/s²"
        )
        converted.flags.append(Flag(message, "gravity.assumed", *outputs))


def _note_channels(file: MatchedFile, converted: ConvertedColumns) -> None:
    """Flag the other channels of the same device, which are excluded as covariates."""
    if (output := output_name(file.instrument)) not in converted.values:
        return
    header = file.header(output).name
    undeclared = {n: u for n, u in converted.units.items() if n not in file.expected}
    converted.other_channels.update(find_channels(header, undeclared, converted.units[output]))
    if converted.other_channels:
        names = ", ".join(sorted(converted.other_channels))
        converted.flags.append(
            f"{file.table.file}: {names}: not used as covariates of {header!r}, because they look like other "
            "channels of the device (to use one as a covariate: --covariates NAME, in Python covariates=)"
        )


def _drop_rows(table: Table, converted: ConvertedColumns) -> None:
    """Drop the rows with a missing reading and flag their number; raise InputError if no row remains."""
    missing = converted.missing
    dropped_rows = np.unique(np.concatenate(list(missing.values())))
    converted.kept_rows = np.setdiff1d(np.arange(table.rows), dropped_rows)
    converted.tables = (table.take(converted.kept_rows),)
    converted.values = {name: v[converted.kept_rows] for name, v in converted.values.items()}
    places = "; ".join(f"{name} in {_format_rows(table, rows)}" for name, rows in missing.items())
    message = f"{table.file}: {len(dropped_rows)} of {table.rows} rows dropped, with missing readings: {places}"
    converted.flags.append(Flag(message, "rows.dropped", *missing))


def _format_rows(table: Table, rows: np.ndarray) -> str:
    """Format rows (indices) for messages: the label of a single one, else the number and the first three labels."""
    labels = ", ".join(table.place(int(i)) for i in rows[:3])
    return labels if len(rows) == 1 else f"{len(rows)} rows ({labels}{' …' * (len(rows) > 3)})"


class ColumnReader:
    """Reader of one column of a file, which checks and converts it, and collects problems and flags."""

    def __init__(self, file: MatchedFile, column: Column, converted: ConvertedColumns) -> None:
        self.file, self.column, self.converted = file, column, converted
        self.options, self.problems, self.flags = file.options, Objections(), list[str]()
        self.name, self.header = column.name, file.header(column.name)
        self.is_declared = self.name in file.expected
        self.is_time = self.name == "time" and column.unit == "s"
        self.is_output = self.name == output_name(file.instrument)

    def read(self, cells: Cells) -> None:
        """Check and convert the cells of the column; if empty and not required, skip it and record this in `flags`."""
        is_label = self.column.unit is None
        is_empty = cells.values == "" if is_label else np.isnan(cells.values)
        if not self.column.required and not cells.invalid_texts and is_empty.all():
            self._flag("is empty and ignored")
            return
        if is_label:
            if is_empty.any():
                self._note_missing(np.flatnonzero(is_empty), "the field is empty", "a label")
            self._note_labels(cells.values)
            if not self.problems:
                self._store(cells.values)
            return
        texts = cells.dates if self.is_time else None
        if has_dates := texts is not None:  # only a time column is read as dates
            cells = self._read_dates(texts)
        unit = "s" if has_dates else self._find_unit(cells)
        raw, noted_rows = cells.values, set(cells.invalid_texts)
        self._note_text(cells, unit, has_dates)
        searches = (find_overloads, _OVERLOAD_FAULT), (find_placeholders, _PLACEHOLDER_FAULT)
        for find, template in searches:
            if (rows := find(raw)).size:
                self._note_missing(rows, template.format(raw[rows[0]]))
                noted_rows |= {*rows.tolist()}
                raw = raw.copy()
                raw[rows] = np.nan
        raw = self._unwrap(raw, unit)
        self._note_unsigned(raw)
        with np.errstate(over="ignore"):
            values = raw if has_dates or unit is None else self._convert(raw, unit)
        if values is None:
            return
        self._note_not_finite(raw, values, unit, noted_rows)
        if unit is not None:
            self._note_implausible(raw, values, unit)
        if not self.problems:
            self._store(self._shift_origin(values, has_dates) if self.is_time else values)

    def _store(self, values: np.ndarray) -> None:
        self.converted.values[self.name] = values
        self.converted.units[self.name] = self.column.unit

    def _report(self, fault: str, *texts: str, **details: Any) -> None:
        self.problems.append(self.file.table.objection(self.header.raw, fault, *texts, **details))

    def _flag(self, text: str) -> None:
        self.flags.append(f"{self.file.table.file}: column {self.header.raw!r} {text}")

    def _note_missing(self, rows: np.ndarray, fault: str, expected: str = "") -> None:
        """Record rows to drop, of declared columns if `missing="drop"`; else add a problem (`fault`, `expected`)."""
        if self.options.missing == "refuse" or not self.is_declared:
            cure, suggestion = "Fill it in, or drop such rows", option("--missing", "drop")
            self._report(fault, expected, cure, suggestion, rows=rows)
            return
        earlier_rows = self.converted.missing.get(self.name, rows[:0])
        self.converted.missing[self.name] = np.union1d(earlier_rows, rows)

    def _note_labels(self, labels: np.ndarray) -> None:
        """Add a problem for each label that is unknown or contains a control character."""
        allowed, choices = self.column.allowed, f"one of {', '.join(self.column.allowed)}"
        for label in dict.fromkeys(labels.tolist()):
            if any(unicodedata.category(character) in ("Cc", "Cs") for character in label):
                fault, expected, cure = "which contains a control character", "", "Remove it"
            elif label and allowed and label not in allowed:
                fault, expected, cure = "an unknown label", choices, "Correct it"
            else:
                continue
            rows = np.flatnonzero(labels == label)
            self._report(f"reads {label!r}, {fault}", expected, cure, rows=rows)

    def _read_dates(self, texts: np.ndarray) -> Cells:
        """Parse dates to s since 1970; add a problem if the order of day, month and year is ambiguous and not given."""
        dates, orders = table_cells.parse_dates(texts, self.options.date_order)
        if orders:
            fault = "has ambiguous dates: the order of day, month and year is unclear, or they are times of day"
            expected = "a day above 12 in one of them, or the year first"
            cure = f"Give their order: {', '.join(orders)}"
            self._report(fault, expected, cure, option("--date-order", orders[0]))
        return dates

    def _find_unit(self, cells: Cells) -> str | None:
        """Return the unit of the numbers; add a problem and return None if it is absent or invalid."""
        unit = unit_of(self.header, self.name, self.options)
        suggestion = option("--unit", f"{self.header.raw}=UNIT")
        if unit is None:
            if self.is_time and (inferred := table_cells.detect_epoch_unit(cells.values)):
                self._flag(f"read as {units.format_unit(inferred)} since 1970, by its magnitude")
                return inferred
            if not (self.is_time and cells.invalid_texts and np.isnan(cells.values).all()):
                like = self.column.example
                cure = f"Write it in the header, such as '{self.header.name} [{like}]', or give UNIT, such as {like}"
                self._report("the header has no unit", "", cure, suggestion)
            return None  # unparsable dates are reported by `_note_text`
        if self.column.unit != units.ANY:
            unit = units.unit_in(unit, (str(self.column.unit),)) or unit
        try:
            units.parse(unit)
        except InputError as error:
            self._report(str(error), "", "Correct the header, or give the unit", suggestion)
            return None
        if self.header.unit and unit != self.header.unit:
            self._flag(f"read as [{unit}], as given by --unit")
        return unit

    def _note_text(self, cells: Cells, unit: str | None, has_dates: bool) -> None:
        """Add a problem for cells that contain text in place of a number or a date."""
        if not cells.invalid_texts:
            return
        expected, date = _describe_number(unit), f"a date such as {table_cells.EXAMPLE}"
        if has_dates:
            expected = f"{date}, with a time zone in all cells or in none"
        elif self.is_time:
            expected = date if unit is None else f"{expected}, or a date"
        texts = list(dict.fromkeys(cells.invalid_texts.values()))
        hint = "Correct the cell, or remove the row"
        if any(map(table_cells.DECIMAL_COMMA.fullmatch, texts)):
            hint = "If that is a decimal comma, say so (--decimal ,), or export the file with decimal points"
        quoted_texts = ", ".join(repr(t[:60]) for t in texts[:_MAX_QUOTED])
        quoted_texts += " …" * (len(texts) > _MAX_QUOTED)
        self._report(f"reads {quoted_texts}", expected, hint, rows=sorted(cells.invalid_texts))

    def _unwrap(self, raw: np.ndarray, unit: str | None) -> np.ndarray:
        """Unwrap the values of a counter whose period the user gives; return those of other columns unchanged."""
        periods, names = self.options.unwrap, (self.header.raw, self.header.name, self.name)
        text = next((periods[n] for n in names if n in periods), None)
        if text is None or unit is None:
            return raw
        has_degrees = units.same_dimension(unit, "degC")
        period, period_unit = parse_period(text)
        if period_unit != "1":
            period = float(units.convert(period, period_unit, unit, difference=True))
        finite = np.isfinite(raw)
        wraps = int(np.count_nonzero(abs(np.diff(raw[finite])) > 0.5 * period))
        if self.is_time:  # a clock is unsigned, a converter's counts are signed
            values = raw.copy()
            values[finite] = np.unwrap(raw[finite], period=period)
        else:
            start = units.convert(checks.ROOM_DEGREES, "degC", unit).item() if has_degrees else 0.0
            records = Records.of({**self.converted.values, "": raw})
            values = checks.unwrap(raw, records, period, start)
        self._flag(f"was unwrapped at {wraps} wrap-around{'s' * (wraps != 1)} (unwrap={text})")
        return values

    def _shift_origin(self, values: np.ndarray, has_dates: bool) -> np.ndarray:
        """Return times relative to the first reading if they are dates, or to the user's `begin` if it is given.

        Seconds that, counted from 1970, would lie after 2066 are taken to count from 1904, as LabVIEW's do.
        """
        values, since = table_cells.split_origin(values)
        if since is not None and since > _EARLIEST_SINCE_1904_S and not has_dates:
            begin = format_date(since)[:10]
            since -= _EPOCH_OFFSET_S
            self._flag(f"read as s since 1904 (LabVIEW): since 1970 it would begin on {begin}")
        self.converted.origin = since
        begins, file = self.options.begin, self.file.table.file
        text = begins.get(file, begins.get("", ""))
        if not text or not np.isfinite(values).any():
            return values
        begin, is_date = parse_begin(text)
        if is_date and since is not None and file not in begins:
            return values
        self._flag(f"has its first reading at {text}, as given by --begin")
        self.converted.origin = begin if is_date else self.options.epoch
        return values - np.nanmin(values) + (0.0 if is_date else begin)

    def _note_unsigned(self, raw: np.ndarray) -> None:
        """Add a problem for signed counts stored as unsigned: integers near both ends of the range, none between."""
        finite = raw[np.isfinite(raw)]
        if not self.is_output or not finite.size or finite.min() < 0 or (finite % 1).any():
            return
        bits = next((b for b in _CONVERTER_BITS if finite.max() < 2.0**b), np.inf)
        index = finite // 2.0 ** (bits - 4)  # sixteenths of the range
        if np.isin(index, (0, 15)).all() and (index == 15).any() and np.sum(index == 0) > 1:
            fault = f"contains integers near 0 and near 2^{bits}, none between, like signed counts stored as unsigned"
            suggestion = option("--unwrap", f"{self.header.raw}=2^{bits}")
            self._report(fault, cure="If they are, unwrap them", option=suggestion)

    def _convert(self, values: np.ndarray, unit: str) -> np.ndarray | None:
        """Convert numbers to the column's unit, directly or by the nominal scale; None, with a problem, if not."""
        target, gravity = self.column.unit or "1", self.options.gravity
        given_scale, is_difference = self.options.nominal_scale, self.name == UNCERTAINTY
        scale = given_scale or self.file.instrument.nominal_scale
        suggestion = option("--unit", f"{self.header.raw}=UNIT")
        settings = {"local_gravity": gravity, "difference": is_difference}
        if units.same_dimension(unit, target):
            if units.needs_gravity(unit, target):
                self.converted.by_gravity.add(self.name)
                self._flag(f"converted to units of g = {gravity:g} m/s²")
            try:
                return units.convert(values, unit, target, **settings)
            except InputError as error:  # a difference of temperatures, say
                self._report(str(error), option=suggestion)
                return None
        alternative = hint = ""
        if self.is_output or is_difference:
            if scale is not None and units.same_dimension(unit, scale.unit):
                self._note_scale(scale, is_difference)
                raw = units.convert(values, unit, scale.unit, **settings)
                return scale.apply(raw, difference=is_difference)
            alternative = f", or {scale.unit} (by the nominal scale factor)" if scale else ""
            unit_divisor = f"({target})" if "/" in target else target
            scale_option = option("--nominal-scale", f"250 {unit}/{unit_divisor}")
            hint = f"Give the scale factor of the raw output, such as {scale_option}, or the correct unit"
        cure = hint or "Correct the header, or give the correct unit"
        expected = f"{target} or a unit that converts to it{alternative}"
        self._report(f"its unit is [{unit}]", expected, cure, suggestion)
        return None

    def _note_scale(self, scale: NominalScale, is_difference: bool) -> None:
        """Flag that raw outputs are converted by the nominal scale factor."""
        is_given = self.options.nominal_scale is not None
        has_offset = scale.offset and not is_difference
        reading = f"(reading − {scale.offset:g})" if has_offset else "reading"
        of_instrument = "" if is_given else f" of {self.file.instrument.name}"
        advice = " (for another sensor: --nominal-scale and --nominal-zero)" * (not is_given)
        self._flag(
            f"converted to {units.format_unit(self.column.unit or '1')} by the nominal scale factor{of_instrument}: "
            f"{reading}/{scale.gain:g}, reading in {units.format_unit(scale.unit)}{advice}"
        )
        if scale.by_gravity:
            self.converted.by_gravity.add(self.name)

    def _note_not_finite(
        self, raw: np.ndarray, values: np.ndarray, unit: str | None, noted_rows: set[int]
    ) -> None:
        """Record empty cells as missing; add a problem for infinite values. A temperature point may be empty."""
        expected = _describe_number(unit)
        is_invalid = np.isinf(values) if self.name == SOAK_POINT else ~np.isfinite(values)
        rows = np.setdiff1d(np.flatnonzero(is_invalid), list(noted_rows))
        is_empty = np.isnan(raw[rows])
        if is_empty.any() and len(noted_rows) < MAX_INVALID_ROWS:
            self._note_missing(rows[is_empty], _EMPTY_FAULT, expected)
        if (infinite_rows := rows[~is_empty]).size:
            first_value = float(raw[infinite_rows[0]])
            fault = f"reads {first_value:g}" + ", too large" * bool(np.isfinite(first_value))
            self._report(fault, expected, "Fill it in, or remove the row", rows=infinite_rows)

    def _note_implausible(self, raw: np.ndarray, values: np.ndarray, unit: str) -> None:
        low = -np.inf if self.column.low is None else self.column.low
        high = np.inf if self.column.high is None else self.column.high
        rows = np.flatnonzero((values < low) | (values > high))
        if not rows.size:
            return
        index, target = int(rows[0]), self.column.unit or "1"
        limits = f"at least {low:g}" if high == np.inf else f"at most {high:g}"
        limits = f"{low:g} … {high:g}" if low > -np.inf and high < np.inf else limits
        unit_text, target_text = units.format_unit(unit), units.format_unit(target)
        conversion = f", that is {values[index]:.6g} {target_text}" * (unit_text != target_text)
        fault = f"reads {raw[index]:.6g} {unit_text}{conversion}; plausible: {limits} {target_text}"
        cure = "Check the unit and the number"
        if target == "degC" and values[index] > high:
            unwrap_option = option("--unwrap", f"{self.header.raw}=PERIODdegC")
            cure += f"; if a counter wrapped around, unwrap it with {unwrap_option}"
        self._report(fault, "", cure, rows=rows)


def _describe_number(unit: str | None) -> str:
    return "a number" if unit is None else f"a number in {units.format_unit(unit)}"


def join_files(files: Sequence[ConvertedColumns], labels: Sequence[str]) -> ConvertedColumns:
    """Concatenate the columns of files, `labels` being their runs; raise InputError for incompatible files."""
    if len(files) == 1:
        return files[0]
    _label_runs(files, labels)
    joined = ConvertedColumns(tuple(table for file in files for table in file.tables))
    joined.flags = [flag for file in files for flag in file.flags]
    joined.other_channels = set().union(*(file.other_channels for file in files))
    joined.origin = _align_time_origins(files)
    for name, unit in {n: u for f in files for n, u in f.units.items()}.items():
        for file in files:
            if file.units.get(name, unit) != unit:
                raise InputError(
                    f"column {name!r} is in {file.units[name]} in {file.tables[0].file!r} and in {unit} in another "
                    "file: use units of one dimension, or rename one"
                )
        file_with, file_without = _find_first_files(files, [name in file.values for file in files])
        if file_without and unit is None:
            raise InputError(
                f"{file_without!r} lacks the column {name!r} that {file_with!r} has: label every file, or none"
            )
        if file_without and name == SOAK_POINT:
            joined.flags.append(f"{file_without} has no {name!r}: its readings belong to no cell")
        elif file_without and name != ASSUMED_GRAVITY:
            joined.flags.append(
                f"column {name!r} ignored: it is in {file_with}, not in {file_without}"
            )
            continue
        fill = 0.0 if name == ASSUMED_GRAVITY else np.nan
        missing = (np.full(table.rows, fill) for table in joined.tables)
        columns = [f.values.get(name, nans) for f, nans in zip(files, missing, strict=True)]
        joined.values[name], joined.units[name] = np.concatenate(columns), unit
    file_by_hash = dict[str, str]()
    for table in joined.tables:
        if (first_file := file_by_hash.setdefault(table.sha256, table.file)) != table.file:
            joined.flags.append(f"{table.file} has the same content as {first_file}: given twice?")
    return joined


def _label_runs(files: Sequence[ConvertedColumns], labels: Sequence[str]) -> None:
    """Label each file without a column `run` as one run; flag runs that span several files."""
    run_sets = [set(file.values.get("run", ())) for file in files]
    run_names, file_of_run = set().union(*run_sets), dict[str, str]()
    for file, label, runs in zip(files, labels, run_sets, strict=True):
        (table,) = file.tables
        if "run" not in file.values:
            label = f"file {label}" if label in run_names else label
            file.values["run"] = np.full(table.rows, label, dtype=object)
            file.units["run"] = None
        file.flags += [
            f"run {run!r} of {table.file} is read as the continuation of run {run!r} of {file_of_run[run]}"
            for run in sorted(runs & file_of_run.keys())
        ]
        file_of_run = dict.fromkeys(runs, table.file) | file_of_run


def _find_first_files(
    files: Sequence[ConvertedColumns], flags: Sequence[bool]
) -> tuple[str | None, str | None]:
    """Return the names of the first file whose flag is true and of the first whose flag is false; None if none is."""
    names = [file.tables[0].file for file in files]
    first_by_flag = dict(reversed([*zip(flags, names, strict=True)]))
    return first_by_flag.get(True), first_by_flag.get(False)


def _align_time_origins(files: Sequence[ConvertedColumns]) -> float | None:
    """Shift the times of dated files to the earliest origin; return it, s since 1970, or None without dates."""
    files = [file for file in files if "time" in file.values]
    origins = [file.origin for file in files if file.origin is not None]
    if not origins:
        return None
    file_with, file_without = _find_first_files(files, [f.origin is not None for f in files])
    if file_without:
        raise InputError(
            f"{file_with!r} has dates in its column 'time', but {file_without!r} has none: give the date of the first "
            f"reading of the latter, --begin '{file_without}=2026-05-13 10:14:20', or read the files separately"
        )
    for file, origin in zip(files, origins, strict=True):
        file.values["time"] = np.round(file.values["time"] + (origin - min(origins)), 6)
    return min(origins)
