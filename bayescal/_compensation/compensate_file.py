"""Compensate a file: every column and row as they were, and two columns more.

CSV and Parquet go through a stretch of rows at a time, unless the calibration needs the past of the record; then
the columns that it needs are held whole, never the file. The new file is written beside its place and renamed.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import xarray as xr

from bayescal._compensation.compensator import Compensated, Compensator, Method
from bayescal._core.atomic_file import netcdf_bytes, replacing_for_user
from bayescal._core.errors import InputError
from bayescal._readings.column import Column, ConvertedColumns, NominalScale, Source
from bayescal._readings.column_conversion import convert_columns
from bayescal._readings.column_matching import ReadOptions, match
from bayescal._readings.dataset_checks import problems_of_whole
from bayescal._readings.header_matching import understood
from bayescal._readings.measurements import Measurements, assemble
from bayescal._tables.csv_reader import csv_parts
from bayescal._tables.open_table import MAX_BYTES, open_table
from bayescal._tables.parquet_netcdf import parquet_parts
from bayescal._tables.problems import Problems
from bayescal._tables.raw_table import ROW, Table, bytes_text

FORMATS = (".csv", ".parquet", ".nc")  # in which a file can be written as it was
ROWS = 200_000  # compensated at a time


@dataclass(frozen=True)
class ExpectedColumns:
    """What a file to compensate must hold, as `convert_columns` asks an instrument."""

    name: str
    columns: tuple[Column, ...]
    nominal_scale: NominalScale | None


@dataclass
class CompensationSummary:
    """What was done.

    Attributes:
        file: written.
        columns: names of the two columns added.
        rows: compensated.
        outside: name → readings outside its calibrated range.
        unsolved: readings for which the equation has no solution; their value is NaN.
        flags: input warnings, each a sentence.
    """

    file: Path
    columns: tuple[str, str]
    rows: int = 0
    outside: dict[str, int] = field(default_factory=dict)
    unsolved: int = 0
    flags: tuple[str, ...] = ()


@dataclass
class _FileCompensation:
    """One file on its way: by what it is compensated, and what has been done so far."""

    compensator: Compensator
    options: ReadOptions
    method: Method | None
    noise: bool
    expected: ExpectedColumns
    done: CompensationSummary

    def part(self, table: Table) -> Compensated:
        """Compensate the rows of a table by themselves."""
        converted = convert_columns(table, self.expected, self.options)
        if not self.done.flags:
            self.done.flags = tuple(converted.flags)
        return self._take(_measurements(converted))

    def whole(self, table: Table) -> Compensated:
        """Compensate all rows of a table, the past of each counting."""
        size = 8 * table.rows * len(self.expected.columns)
        if size > MAX_BYTES:
            raise InputError(
                f"{table.file!r}: this calibration needs the past of the record, {bytes_text(size)} in memory; the "
                f"limit is {bytes_text(MAX_BYTES)}. Split it by runs, or average it"
            )
        converted = convert_columns(table, self.expected, self.options)
        source = Source(table.file, table.sha256, table.rows)
        problems_of_whole([table], converted, self.expected, True).refuse()
        readings = assemble([table], converted, self.expected, (source,))
        self.done.flags = readings.flags
        return self._take(readings)

    def _take(self, readings: Measurements) -> Compensated:
        found = self.compensator(readings, noise=self.noise, method=self.method, warn=False)
        self.done.rows += len(readings)
        self.done.unsolved += int(np.isnan(found.value).sum())
        for name, mask in found.outside.items():
            self.done.outside[name] = self.done.outside.get(name, 0) + int(mask.sum())
        return found


def compensate_file(
    compensator: Compensator,
    path: str | Path,
    out: str | Path,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    local_gravity: float = 9.80665,
    decimal: str = "",
    method: Method | None = None,
    noise: bool = True,
) -> CompensationSummary:
    """Add `<output>_compensated` and `<output>_uncertainty` to a file of readings.

    Args:
        compensator: of the instrument.
        path: .csv, .parquet or .nc.
        out: file to write, of the same format; may be the same file.
        columns, units, local_gravity, decimal: as in `bayescal.read`.
        method, noise: as of the compensator.

    Raises:
        InputError: what `bayescal.read` refuses; another format; columns of these names are there already.
    """
    path, out = Path(path), Path(out)
    suffix = path.suffix.lower()
    if not path.is_file():
        raise InputError(f"there is no file {path}")
    if suffix not in FORMATS:
        raise InputError(f"{path.name!r} cannot be read: choose a file of {', '.join(FORMATS)}")
    if out.suffix.lower() != suffix:
        raise InputError(
            f"{out.name!r}: every column is kept as it is, so the file to write must be {suffix} like {path.name!r}"
        )
    expected = _expected(compensator)
    options = ReadOptions(columns or {}, units or {}, local_gravity, None, decimal=decimal)
    with replacing_for_user(out) as partial:
        table = open_table(path, path.name, _limit(suffix), decimal)
        raw, names = _names(table, expected, options)
        done = CompensationSummary(out, names)
        job = _FileCompensation(
            compensator=compensator,
            options=options,
            method=method,
            noise=noise,
            expected=expected,
            done=done,
        )
        {".csv": _csv, ".parquet": _parquet, ".nc": _netcdf}[suffix](job, path, partial, table, raw)
    return done


def _limit(suffix: str) -> int:
    return MAX_BYTES if suffix == ".nc" else 1 << 62  # Parquet is read a stretch at a time


def _expected(compensator: Compensator) -> ExpectedColumns:
    if compensator.calibration is not None:
        instrument = compensator.calibration.model.instrument
        return ExpectedColumns(instrument.name, compensator.columns, instrument.nominal_scale)
    about = compensator.program.about
    scale = NominalScale(*about.raw) if about.raw else None
    return ExpectedColumns(about.instrument, compensator.columns, scale)


def _names(
    table: Table, expected: ExpectedColumns, options: ReadOptions
) -> tuple[str, tuple[str, str]]:
    """The output's header in the file, and the names of the columns to add.

    Raises:
        InputError: there is no output, or the names are taken.
    """
    columns = {column.name: column for column in expected.columns}
    table = understood(table, expected, options)
    problems = Problems(table.problems)
    places = match(table, columns, options, problems)
    problems.refuse()
    if "output" not in places:
        raise InputError(
            f"{table.file!r} has no column 'output' (it has: {', '.join(h.name for h in table.headers)}). If it is "
            "called otherwise, say so: columns={'output': …} (--columns output=…)"
        )
    header = table.headers[places["output"]]
    names = f"{header.name}_compensated", f"{header.name}_uncertainty"
    for name in names:
        if any(h.name == name for h in table.headers):
            raise InputError(
                f"{table.file!r} has a column {name!r} already: take it out, or compensate the original"
            )
    return header.raw, names


def _measurements(converted: ConvertedColumns) -> Measurements:
    variables: dict[str, Any] = {}
    for name, values in converted.values.items():
        unit = converted.units[name]
        variables[name] = (ROW, np.asarray(values), {"units": unit} if unit else {})
    return Measurements(xr.Dataset(variables))


def _slices(
    job: _FileCompensation, whole: Compensated | None
) -> Callable[[Table], tuple[np.ndarray, np.ndarray]]:
    """A function that gives value and uncertainty of the next rows."""
    start = 0

    def take(table: Table) -> tuple[np.ndarray, np.ndarray]:
        nonlocal start
        if whole is None:
            found = job.part(table)
            return found.value, found.uncertainty
        rows = slice(start, start + table.rows)
        start += table.rows
        return whole.value[rows], whole.uncertainty[rows]

    return take


def _csv(job: _FileCompensation, path: Path, partial: Path, table: Table, raw: str) -> None:
    """Lines as they stand, with two fields more."""
    whole = job.whole(table) if job.compensator.history else None
    take, unit = _slices(job, whole), job.compensator.unit
    with partial.open("wb") as target:
        for part in csv_parts(path, table.file, ROWS, job.options.decimal):
            if part.table is None:  # comments and the header
                added = [f"{name} [{unit}]" for name in job.done.columns]
                target.writelines(part.before)
                target.write(_longer(part.lines[0], added, part.separator))
                continue
            value, uncertainty = take(part.table)
            rows = iter(zip(value.tolist(), uncertainty.tolist(), strict=True))
            for line in part.lines:
                if not line.strip():
                    target.write(line)
                    continue
                target.write(_longer(line, [_number(v) for v in next(rows)], part.separator))


def _number(value: float) -> str:
    return "nan" if value != value else repr(value)


def _longer(line: bytes, fields: list[str], separator: str) -> bytes:
    body = line.rstrip(b"\r\n")
    end = line[len(body) :] or b"\n"
    text = io.StringIO()
    csv.writer(text, delimiter=separator, lineterminator="").writerow(fields)
    return body + (separator + text.getvalue()).encode("utf-8") + end


def _parquet(job: _FileCompensation, path: Path, partial: Path, table: Table, raw: str) -> None:
    whole = job.whole(table) if job.compensator.history else None
    take, unit = _slices(job, whole), job.compensator.unit
    with pq.ParquetFile(path) as opened:
        schema = opened.schema_arrow
    in_header = raw != raw.partition(" [")[0]  # the unit of the output stands in its name
    names = [f"{name} [{unit}]" if in_header else name for name in job.done.columns]
    for name in names:
        schema = schema.append(pa.field(name, pa.float64(), metadata={"units": unit}))
    with pq.ParquetWriter(partial, schema) as writer:
        for batch, part in parquet_parts(path, table.file, ROWS):
            columns = [*batch.columns, *(pa.array(v) for v in take(part))]
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))


def _netcdf(job: _FileCompensation, path: Path, partial: Path, table: Table, raw: str) -> None:
    found = job.whole(table) if job.compensator.history else job.part(table)
    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as opened:
        dataset = opened.load()
    (dimension,) = dataset[raw].dims
    unit = {"units": job.compensator.unit}
    values = zip(job.done.columns, (found.value, found.uncertainty), strict=True)
    dataset = dataset.assign({name: (dimension, v, unit) for name, v in values})
    partial.write_bytes(netcdf_bytes(dataset))
