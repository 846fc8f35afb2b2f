"""Compensate a file: add the compensated value and its standard uncertainty as columns.

Of a Parquet file only the needed columns are loaded, the others copied in batches. Excel and MATLAB files become CSV.
The two added cells of a row without a reading are empty. The new file is written atomically.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bayescal._core.atomic_file import replace_user_file
from bayescal._core.errors import InputError
from bayescal._core.quoting import format_csv_line, quote_cell
from bayescal._data.column import NominalScale, Source
from bayescal._data.column_conversion import convert_columns
from bayescal._data.dataset_checks import find_problems, find_repeated_rows, flags_of
from bayescal._data.header_matching import MatchedFile, split_trailing_unit
from bayescal._data.measurements import Measurements
from bayescal._data.read_options import ExpectedColumns, ReadOptions
from bayescal._tables.csv_file import CsvText, parse_text
from bayescal._tables.open_table import MAX_BYTES, TEXT_SUFFIXES, check_files, open_table
from bayescal._tables.raw_table import Header, Objections, Table, load_whole
from bayescal._use.compensator import Compensator, Method

NATIVE_SUFFIXES = (*TEXT_SUFFIXES, ".parquet")  # of files written in the format of the input
CSV_SUFFIXES = (".xlsx", ".mat")
ROWS_PER_BATCH = 200_000  # of Parquet


@dataclass(frozen=True)
class CompensationSummary:
    """Result of `compensate_file`: the written file, its added columns, and counts of rows and of problems."""

    file: Path  # the written file
    columns: tuple[str, str]  # names of the two added columns
    rows: int  # number of rows of the file
    outside: dict[str, int]  # input or stimulus → number of readings outside its calibrated range
    unsolved: int  # number of readings for which the equation has no solution; both cells are empty
    missing: int  # number of rows that lack the reading or an input; both cells are empty
    flags: tuple[str, ...]  # input warnings, each a sentence


class AddedColumns(NamedTuple):
    """The two columns added to a file."""

    names: tuple[str, str]
    unit: str
    values: np.ndarray  # value and standard uncertainty of each row (2, n), NaN if missing
    decimal: str  # decimal sign given by the user, or empty

    @property
    def headers(self) -> list[str]:
        return [f"{name} [{self.unit}]" for name in self.names]

    def cells(self, decimal_sign: str = ".") -> Iterator[list[str]]:
        """Yield the two cells of each row as text; "" for NaN."""
        for row in self.values.T.tolist():
            yield ["" if v != v else repr(v).replace(".", decimal_sign) for v in row]


def compensate_file(
    compensator: Compensator,
    path: str | Path,
    out: str | Path,
    *,
    local_gravity: float | None = None,
    missing: str = "drop",
    method: Method = "draws",
    noise: bool = True,
    **how: Any,
) -> CompensationSummary:
    """Add `<output>_compensated` and `<output>_standard_uncertainty` (k = 1) to a file of readings.

    Args:
        compensator: compensator of the instrument.
        path: file of readings: text, Parquet, Excel or MATLAB.
        out: file to write, in the format of `path`, or .csv for Excel and MATLAB; may be `path` itself.
        local_gravity: as in `bayescal.read`.
        missing: "drop" leaves the results of rows with a missing reading empty; "refuse" raises InputError.
        method, noise: as in `Compensator.__call__`.
        how: columns, units, decimal, date_order, nominal_scale, nominal_zero, as in `bayescal.read`; the default
            nominal scale is that of the calibration.

    Raises:
        InputError: as in `bayescal.read`; or the format is unsupported, or the file already has columns of these names.
    """
    path, out = Path(path), Path(out)
    suffix = path.suffix.lower()
    check_files([path], 1 << 62)
    if suffix not in (readable := (*NATIVE_SUFFIXES, *CSV_SUFFIXES)):
        raise InputError(
            f"{path.name!r} cannot be compensated as a file: use one of {', '.join(readable)}. For other formats, "
            "read the columns and compensate them: bc.compensator(…)(bc.read(…))"
        )
    ending = ".csv" if suffix in CSV_SUFFIXES else suffix
    if out.suffix.lower() != ending and not {suffix, out.suffix.lower()} <= {*TEXT_SUFFIXES}:
        raise InputError(f"{out.name!r}: the output file of {path.name!r} must end in {ending}")
    about = compensator.about
    scale = NominalScale(*about.raw) if about.raw else None
    expected = ExpectedColumns(about.instrument, compensator.columns, scale)
    ignored = ("ignore", "local_field")  # options without effect on compensation
    read_options = {n: value for n, value in how.items() if value is not None and n not in ignored}
    read_options |= {"remembered": compensator.calibration.readings.sources, "epoch": about.epoch}
    how = {"local_gravity": local_gravity, "missing": missing, **read_options}
    options = ReadOptions.of(expected, only_declared=True, **how)
    with replace_user_file(out) as partial_path:
        limit = 1 << 62 if suffix == ".parquet" else MAX_BYTES  # Parquet reads needed columns only
        table = open_table(path, path.name, limit, options.decimal, options.headers)
        options = options.restrict_to(table)
        output_header, names = _name_columns(table, expected, options)
        converted = convert_columns(table, expected, options)
        source, flags = Source(table.file, table.sha256, table.rows), tuple(converted.flags)
        # History, unwrapped counters and times from the first row need the whole record checked.
        if compensator.history or options.unwrap or any(c.name == "time" for c in expected.columns):
            find_problems(converted, expected, True).refuse()
            flags = flags_of(converted, "output", table.file, find_repeated_rows(converted.values))
        epoch, columns = converted.origin, (converted.values, converted.units)
        readings = Measurements(*columns, (source,), since=epoch)
        _refuse_overlap(compensator, readings, bool(options.begin))
        compensated = compensator(readings, noise=noise, method=method, warn=False)
        values = np.full((2, table.rows), np.nan)
        rows = slice(None) if converted.kept_rows is None else converted.kept_rows
        values[:, rows] = compensated.value, compensated.uncertainty
        writers = dict.fromkeys(CSV_SUFFIXES, _write_csv)
        writers[".parquet"] = _add_parquet
        added_columns = AddedColumns(names, compensator.unit, values, options.decimal)
        writers.get(suffix, _add_text)(added_columns, path, partial_path, table, output_header)
    return CompensationSummary(
        file=out,
        columns=names,
        rows=table.rows,
        outside={name: int(mask.sum()) for name, mask in compensated.outside.items()},
        unsolved=int(np.isnan(compensated.value).sum()),
        missing=table.rows - len(compensated.value),
        flags=flags,
    )


def _refuse_overlap(compensator: Compensator, readings: Measurements, has_begin: bool) -> None:
    """Raise InputError if another file's undated times overlap the calibration's: their origins then differ."""
    hashes = {sha for _, sha in compensator.about.sources}
    is_undated = readings.since is None and compensator.about.epoch is None and not has_begin
    if not (compensator.dated and is_undated) or {s.sha256 for s in readings.sources} & hashes:
        return
    (clock,) = (i for i in compensator.inputs if i.name == "time")
    first_time, last_time = float(readings["time"].min()), float(readings["time"].max())
    if first_time <= clock.high and last_time >= clock.low:
        raise InputError(
            f"{readings.file}: its times ({first_time:.6g} to {last_time:.6g} s) overlap those of the calibration "
            f"({clock.low:.6g} to {clock.high:.6g} s), which did not use this file: its clock has another origin. "
            f"{compensator.dated} depends on absolute time: give the time of the first reading on the calibration's "
            "clock (--begin '9 days'), or --begin '0 s' if time counts from the start of each run"
        )


def _name_columns(
    table: Table, expected_columns: ExpectedColumns, options: ReadOptions
) -> tuple[str, tuple[str, str]]:
    """Return the output's header in the file, and the names of the columns to add."""
    file = MatchedFile(table, expected_columns, options, problems := Objections())
    file.note_missing()
    problems.refuse()
    table, header = file.table, file.table.headers[file.positions["output"]]
    unit_suffix = split_trailing_unit(Header.parse(header.raw))  # in brackets of any kind
    name = header.name if unit_suffix is None or header.name != header.raw else unit_suffix.name
    names = f"{name}_compensated", f"{name}_standard_uncertainty"
    for name in names:
        if any(h.name == name for h in table.headers):
            message = f"{table.file!r} already has a column {name!r}: remove it, or compensate the original file"
            raise InputError(message)
    return header.raw, names


def _add_text(added: AddedColumns, path: Path, partial: Path, table: Table, header: str) -> None:
    """Copy the lines of a text file and append two fields to each."""
    text = parse_text(path.read_bytes(), table.file, added.decimal)
    rows = added.cells(text.decimal or ".")
    encoding = "utf-8" if text.encoding == "utf-16" else text.encoding
    with partial.open("w", encoding=encoding, newline="") as target:
        preamble, header_row = text.data[: text.offset].splitlines(keepends=True), text.header_row
        for row, line in enumerate(preamble, 1):  # comments, the header, a row of units
            fields = added.headers if row == header_row else ["", ""]
            target.write(line.decode() if row < header_row else _append_fields(line, fields, text))
        for line in text.rows():
            is_row = line.strip(text.blank_bytes)
            target.write(_append_fields(line, next(rows), text) if is_row else line.decode())


def _append_fields(line: bytes, fields: list[str], text: CsvText) -> str:
    """Return a line of a text file with further fields, quoted and separated as its own."""
    content = line.decode().rstrip("\r\n")
    line_end = line.decode()[len(content) :] or "\n"
    return content + text.separator + format_csv_line(fields, text.separator) + line_end


def _add_parquet(added: AddedColumns, path: Path, partial: Path, table: Table, header: str) -> None:
    with pq.ParquetFile(path) as file:
        schema, row_count = file.schema_arrow, 0
        for name in added.headers if " [" in header else added.names:  # with the unit
            schema = schema.append(pa.field(name, pa.float64(), metadata={"units": added.unit}))
        with pq.ParquetWriter(partial, schema) as writer:
            for batch in file.iter_batches(batch_size=ROWS_PER_BATCH):
                batch_values = added.values[:, row_count : row_count + batch.num_rows]
                columns = [*batch.columns, *map(pa.array, batch_values)]
                writer.write_table(pa.Table.from_arrays(columns, schema=schema))
                row_count += batch.num_rows


def _write_csv(added: AddedColumns, path: Path, partial: Path, table: Table, header: str) -> None:
    """Write an Excel sheet or MATLAB vectors, cells as quoted text, and the two added columns as CSV."""
    columns = load_whole(table, dict.fromkeys(range(len(table.headers)), False))
    with partial.open("w", encoding="utf-8", newline="") as target:
        writer = csv.writer(target, lineterminator="\n")
        writer.writerow(map(quote_cell, [*(h.raw for h in table.headers), *added.headers]))
        texts = [map(quote_cell, columns[i].values.tolist()) for i in range(len(table.headers))]
        rows = zip(*texts, added.cells(), strict=True)
        writer.writerows([*cells, *added_cells] for *cells, added_cells in rows)
