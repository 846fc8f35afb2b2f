"""Compensate a file: every column and row as they were, and two columns more.

Parquet goes through a stretch of rows at a time, unless the calibration needs the past of the record or its time; then
the columns that it needs are held whole. What cannot be written as it was (Excel, MATLAB)
becomes CSV. Rows with a missing reading are gaps, and come out empty. The new file is written beside its place and
renamed.
"""

from __future__ import annotations

import csv
import sys
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bayescal._core.atomic_file import replacing_for_user
from bayescal._core.errors import InputError
from bayescal._core.quoting import csv_line
from bayescal._data.column import ConvertedColumns, NominalScale, Source
from bayescal._data.column_conversion import convert_columns
from bayescal._data.dataset_checks import problems_of_whole
from bayescal._data.header_matching import MatchedFile
from bayescal._data.header_rules import unit_behind
from bayescal._data.measurements import Measurements, assemble
from bayescal._data.read_options import ExpectedColumns, ReadOptions
from bayescal._tables.csv_reader import CsvText, read_text
from bayescal._tables.open_table import MAX_BYTES, TEXT, check_files, open_table
from bayescal._tables.parquet_netcdf import parquet_parts
from bayescal._tables.raw_table import Header, Objections, Table, bytes_text, load_whole
from bayescal._use.compensator import Compensator, Method

KEPT = (*TEXT, ".parquet", ".nc")  # in which a file can be written as it was
AS_CSV = (".xlsx", ".mat")
ROWS = 200_000  # compensated at a time


@dataclass
class CompensationSummary:
    """What was done."""

    file: Path  # written
    columns: tuple[str, str]  # names of the two columns added
    rows: int = 0  # compensated
    # name → readings outside its calibrated range
    outside: dict[str, int] = field(default_factory=dict)
    unsolved: int = 0  # readings for which the equation has no solution; their value is NaN
    missing: int = 0  # rows without a reading, or without an input; their value is empty
    flags: tuple[str, ...] = ()  # input warnings, each a sentence


@dataclass
class _FileCompensation:
    """One file on its way: by what it is compensated, and what has been done so far."""

    compensator: Compensator
    options: ReadOptions
    method: Method | None
    noise: bool
    expected: ExpectedColumns
    done: CompensationSummary
    all: np.ndarray | None = None  # value and uncertainty of rows whose past counts (2, n)
    start: int = 0  # of the next rows among them

    def rows(self, table: Table) -> np.ndarray:
        """Value and uncertainty of the next rows of the file, which are in `table` (2, n)."""
        if self.all is None:
            converted = convert_columns(table, self.expected, self.options)
            self.done.flags = self.done.flags or tuple(converted.flags)
            return self._compensated(table, converted)
        rows = slice(self.start, self.start + table.rows)
        self.start += table.rows
        return self.all[:, rows]

    def whole(self, table: Table) -> None:
        """Compensate all rows of a table beforehand, the past of each counting."""
        size = 8 * table.rows * len(self.expected.columns)
        if size > MAX_BYTES:
            raise InputError(
                f"{table.file!r}: this calibration needs the past of the record, {bytes_text(size)} in memory; the "
                f"limit is {bytes_text(MAX_BYTES)}. Split it by runs, or average it"
            )
        converted = convert_columns(table, self.expected, self.options)
        source = Source(table.file, table.sha256, table.rows)
        problems_of_whole(converted, self.expected, True).refuse()
        self.done.flags = assemble(converted, self.expected, (source,)).flags
        self.all = self._compensated(table, converted)

    def _refuse_another_clock(self, readings: Measurements) -> None:
        """Refuse times without dates that fall among those of the calibration: no device is read twice at one time."""
        used = self.compensator
        undated = readings.since is None and used.epoch is None and not self.options.begin
        if not (used.dated and undated) or {s.sha256 for s in readings.sources} & used.fitted:
            return
        (clock,) = (i for i in used.inputs if i.name == "time")
        low, high = float(readings["time"].min()), float(readings["time"].max())
        if low <= clock.high and high >= clock.low:
            raise InputError(
                f"{readings.file}: its times, {low:.6g} to {high:.6g} s, are among those of the calibration, "
                f"{clock.low:.6g} to {clock.high:.6g} s, at which it was not read: its clock began anew, and with "
                f"the date changes {used.dated}. Say when its first reading was taken on the clock of the "
                "calibration: --begin '9 days'; or --begin '0 s' where time counts from the start of each run"
            )

    def _compensated(self, table: Table, converted: ConvertedColumns) -> np.ndarray:
        source, done = Source(table.file, table.sha256, table.rows), self.done
        readings = Measurements(converted.values, converted.units, (source,))
        readings = replace(readings, since=converted.origin)
        self._refuse_another_clock(readings)
        found = self.compensator(readings, noise=self.noise, method=self.method, warn=False)
        done.rows += table.rows
        done.unsolved += int(np.isnan(found.value).sum())
        for name, mask in found.outside.items():
            done.outside[name] = done.outside.get(name, 0) + int(mask.sum())
        kept = slice(None) if converted.kept is None else converted.kept
        done.missing += table.rows - len(found.value)
        both = np.full((2, table.rows), np.nan)
        both[:, kept] = found.value, found.uncertainty
        return both


def compensate_file(
    compensator: Compensator,
    path: str | Path,
    out: str | Path,
    *,
    local_gravity: float | None = None,
    missing: str = "drop",
    method: Method | None = None,
    noise: bool = True,
    **how: Any,
) -> CompensationSummary:
    """Add `<output>_compensated` and `<output>_uncertainty` to a file of readings.

    Args:
        compensator: of the instrument.
        path: text, .parquet or .nc; Excel or MATLAB.
        out: file to write, of the same format, or .csv for Excel and MATLAB; may be the same file.
        local_gravity: as of `bayescal.read`.
        missing: "drop" for a gap where a reading is missing: its row stays and comes out empty; or "refuse".
        method, noise: as of the compensator.
        how: columns, units, decimal, date_order, nominal_scale, nominal_zero, as of `bayescal.read`; without a nominal
            scale that of the calibration holds.

    Raises:
        InputError: what `bayescal.read` refuses; another format; columns of these names are there already.
    """
    path, out = Path(path), Path(out)
    suffix = path.suffix.lower()
    check_files([path], 1 << 62)
    if suffix not in (*KEPT, *AS_CSV):
        raise InputError(
            f"{path.name!r} cannot be compensated as a file: choose one of {', '.join((*KEPT, *AS_CSV))}. Of a log "
            "read the channels, and compensate these: bc.compensator(…)(bc.read(…))"
        )
    wanted = ".csv" if suffix in AS_CSV else suffix
    if out.suffix.lower() != wanted and not (suffix in TEXT and out.suffix.lower() in TEXT):
        why = f"every column is kept as it is, so the file to write must be {wanted} like {path.name!r}"
        if suffix in AS_CSV:
            why = f"{path.name!r} can only be written as text: name a file .csv"
        raise InputError(f"{out.name!r}: {why}")
    expected = _expected(compensator)
    # Nothing is left out of the file, and nothing calibrated.
    unused = ("ignore", "local_field")
    given = {n: value for n, value in how.items() if value is not None and n not in unused}
    if compensator.calibration is not None:
        given["remembered"] = compensator.calibration.readings.sources
    given["epoch"] = compensator.epoch
    options = ReadOptions.of(
        expected, local_gravity=local_gravity, missing=missing, only=True, **given
    )
    with replacing_for_user(out) as partial:
        limit = 1 << 62 if suffix == ".parquet" else MAX_BYTES  # that is read a stretch at a time
        table = open_table(path, path.name, limit, options.decimal, options.headers)
        options = options.of_file(table)
        raw, names = _names(table, expected, options)
        done = CompensationSummary(out, names)
        job = _FileCompensation(compensator, options, method, noise, expected, done)
        # Rows cannot be taken by themselves where their past counts: of history, counters, times from the first.
        if compensator.history or options.unwrap or any(c.name == "time" for c in expected.columns):
            job.whole(table)
        writers = {".parquet": _parquet, ".nc": _netcdf, **dict.fromkeys(AS_CSV, _as_csv)}
        writers.get(suffix, _csv)(job, path, partial, table, raw)
    return done


def _expected(compensator: Compensator) -> ExpectedColumns:
    about = compensator.about
    scale = NominalScale(*about.raw) if about.raw else None
    return ExpectedColumns(about.instrument, compensator.columns, scale)


def _names(
    table: Table, expected: ExpectedColumns, options: ReadOptions
) -> tuple[str, tuple[str, str]]:
    """The output's header in the file, and the names of the columns to add."""
    problems = Objections(table.problems)
    file = MatchedFile(table, expected, options, problems)
    file.note_missing()
    problems.refuse()
    table, places = file.table, file.positions
    header = table.headers[places["output"]]
    behind = unit_behind(Header.parse(header.raw))  # of a unit in other brackets than [] too
    name = header.name if behind is None or header.name != header.raw else behind.name
    names = f"{name}_compensated", f"{name}_uncertainty"
    for name in names:
        if any(h.name == name for h in table.headers):
            raise InputError(
                f"{table.file!r} has a column {name!r} already: take it out, or compensate the original"
            )
    return header.raw, names


def _csv(job: _FileCompensation, path: Path, partial: Path, table: Table, raw: str) -> None:
    """Lines as they stand, with two fields more."""
    text = read_text(path, table.file, job.options.decimal)
    added = [f"{name} [{job.compensator.unit}]" for name in job.done.columns]
    head = text.data[: text.offset].splitlines(keepends=True)
    rows = iter(job.rows(table).T.tolist())
    with partial.open("wb") as target:
        for row, line in enumerate(head, 1):  # comments, the header, a row of units
            empty = added if row == text.named else ["", ""]
            target.write(line if row < text.named else _longer(line, empty, text))
        for line in text.rows():
            if not line.strip(text.blank):
                target.write(line)
                continue
            fields = [_number(v, text.decimal or ".") for v in next(rows)]
            target.write(_longer(line, fields, text))


def _number(value: float, decimal: str = ".") -> str:
    """As the file writes numbers; nothing where there is none."""
    return "" if value != value else repr(value).replace(".", decimal)


def _longer(line: bytes, fields: list[str], text: CsvText) -> bytes:
    """A line with fields more, in the encoding of its file."""
    body = line.rstrip(b"\r\n")
    end = line[len(body) :] or b"\n"
    more = text.separator + csv_line(fields, text.separator)
    return body + more.encode(text.written_in) + end


def _parquet(job: _FileCompensation, path: Path, partial: Path, table: Table, raw: str) -> None:
    unit = job.compensator.unit
    with pq.ParquetFile(path) as opened:
        schema = opened.schema_arrow
    in_header = raw != raw.partition(" [")[0]  # the unit of the output stands in its name
    names = [f"{name} [{unit}]" if in_header else name for name in job.done.columns]
    for name in names:
        schema = schema.append(pa.field(name, pa.float64(), metadata={"units": unit}))
    with pq.ParquetWriter(partial, schema) as writer:
        for batch, part in parquet_parts(path, table.file, ROWS):
            columns = [*batch.columns, *(pa.array(v) for v in job.rows(part))]
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))


def _as_csv(job: _FileCompensation, path: Path, partial: Path, table: Table, raw: str) -> None:
    """A sheet or vectors as CSV: its cells as text, with two columns more."""
    told = load_whole(table, dict.fromkeys(range(len(table.headers)), False))
    unit = job.compensator.unit
    with partial.open("w", encoding="utf-8", newline="") as target:
        writer = csv.writer(target, lineterminator="\n")
        added = [f"{name} [{unit}]" for name in job.done.columns]
        writer.writerow([*(header.raw for header in table.headers), *added])
        texts = [told[i].values.tolist() for i in range(len(table.headers))]
        values = ([_number(v) for v in vs.tolist()] for vs in job.rows(table))
        writer.writerows(zip(*texts, *values, strict=True))


def _netcdf(job: _FileCompensation, path: Path, partial: Path, table: Table, raw: str) -> None:
    import xarray as xr

    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as opened:
        dataset = opened.load()
    (dimension,) = dataset[raw].dims
    unit = {"units": job.compensator.unit}
    values = zip(job.done.columns, job.rows(table), strict=True)
    dataset = dataset.assign({name: (dimension, v, unit) for name, v in values})
    # In memory, because HDF5 ends the process where it writes to a full disk itself; and in this process alone: where a
    # Dask cluster is open, xarray would ask it for a lock.
    dask: Any = sys.modules.get("dask")
    with dask.config.set(scheduler="synchronous") if dask else nullcontext():
        partial.write_bytes(dataset.to_netcdf(engine="h5netcdf"))
