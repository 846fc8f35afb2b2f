"""Files of readings: Parquet and NetCDF opened as tables, and readings written, with the units where `read` finds them.

Numbers and text only, nothing that a file could have evaluated. Everything is written beside its place and then
renamed, so a file is there whole or not at all.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import xarray as xr

from bayescal._core.atomic_file import netcdf_bytes, replacing_for_user, sha256_of
from bayescal._core.errors import InputError
from bayescal._logs.open_log import log_columns
from bayescal._readings.column import ROW
from bayescal._readings.raw_table import FORMATS, Cells, Header, Table, bytes_text, cells_of


def open_parquet(path: Path, file: str, max_bytes: int) -> Table:
    """Look at a Parquet file: units stand in the column names or in the fields' metadata.

    Args:
        path: where it is.
        file: its name in messages.
        max_bytes: most that its numbers may take in memory.

    Raises:
        InputError: it is not Parquet, or too large once unpacked.
    """
    with _as_format(file, "Parquet"), pq.ParquetFile(path) as opened:
        schema, rows = opened.schema_arrow, opened.metadata.num_rows
    _refuse_large(file, rows, len(schema), max_bytes)
    fields = [schema.field(position) for position in range(len(schema))]
    headers = tuple(Header.parse(f.name, _field_unit(f)) for f in fields)

    def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
        found = {}
        with _as_format(file, "Parquet"), pq.ParquetFile(path) as opened:
            for position, number in wanted.items():
                name = fields[position].name
                found[position] = _arrow_cells(opened.read(columns=[name]).column(name), number)
        pa.default_memory_pool().release_unused()  # what it unpacked, as much again as the numbers
        return found

    return Table(
        file=file,
        headers=headers,
        rows=rows,
        sha256=sha256_of(path),
        load=load,
        place=_row,
    )


def parquet_parts(path: Path, file: str, rows: int) -> Iterator[tuple[pa.RecordBatch, Table]]:
    """A Parquet file a stretch of rows at a time: as it stands, and as a table."""
    with _as_format(file, "Parquet"), pq.ParquetFile(path) as opened:
        done = 0
        for batch in opened.iter_batches(batch_size=rows):
            fields = [batch.schema.field(position) for position in range(len(batch.schema))]
            headers = tuple(Header.parse(f.name, _field_unit(f)) for f in fields)

            def load(wanted: Mapping[int, bool], batch=batch) -> dict[int, Cells]:
                columns = {p: pa.chunked_array([batch.column(p)]) for p in wanted}
                return {p: _arrow_cells(columns[p], number) for p, number in wanted.items()}

            if batch.num_rows:
                table = Table(
                    file=file,
                    headers=headers,
                    rows=batch.num_rows,
                    sha256="",
                    load=load,
                    place=lambda index, start=done: _row(start + index),
                )
                yield batch, table
            done += batch.num_rows


def _field_unit(field: pa.Field) -> str | None:
    unit = (field.metadata or {}).get(b"units")
    return None if unit is None else unit.decode("utf-8", "replace")


def _arrow_cells(column: pa.ChunkedArray, number: bool) -> Cells:
    kind = column.type
    if number and (
        pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)
    ):
        return cells_of(column.cast(pa.float64()).to_numpy(), number)
    return cells_of(column.to_pandas().to_numpy(object), number)


def open_netcdf(path: Path, file: str, max_bytes: int) -> Table:
    """Look at a NetCDF-4 file: variables along one dimension, units in the attribute `units`.

    Args:
        path: where it is.
        file: its name in messages.
        max_bytes: most that its numbers may take in memory.

    Raises:
        InputError: it is not NetCDF-4, has several dimensions to choose from, or is too large once
            unpacked.
    """
    import h5py  # a tenth of a second that only NetCDF needs

    with _as_format(file, "NetCDF-4"), h5py.File(path) as hdf5:
        hdf5.attrs.get(
            "_nc3_strict"
        )  # h5netcdf, failing at this, would print its own complaint later
    with _as_format(file, "NetCDF-4"), _dataset(path) as dataset:
        lines = {str(n): v for n, v in dataset.variables.items() if v.ndim == 1 and n != ROW}
        dimensions = {str(v.dims[0]) for v in lines.values()}
        if ROW not in dimensions and len(dimensions) > 1:
            raise InputError(
                f"{file!r} has variables along {', '.join(sorted(dimensions))}: which are the "
                f"readings cannot be told. Give its variables one dimension, best called {ROW!r}"
            )
        chosen = ROW if ROW in dimensions else next(iter(dimensions), "")
        names = [name for name, variable in lines.items() if variable.dims[0] == chosen]
        rows = dataset.sizes.get(chosen, 0)
        units = {name: lines[name].attrs.get("units") for name in names}
    _refuse_large(file, rows, len(names), max_bytes)
    headers = tuple(Header.parse(n, None if units[n] is None else str(units[n])) for n in names)

    def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
        with _as_format(file, "NetCDF-4"), _dataset(path) as dataset:
            return {p: cells_of(dataset[names[p]].values, number) for p, number in wanted.items()}

    return Table(
        file=file,
        headers=headers,
        rows=rows,
        sha256=sha256_of(path),
        load=load,
        place=_row,
    )


def _dataset(path: Path) -> xr.Dataset:
    return xr.open_dataset(path, engine="h5netcdf", decode_times=False)


def open_log(path: Path, file: str, asked: Collection[str]) -> Table:
    """Channels of a log as a table.

    Args:
        path: where it is.
        file: its name in messages.
        asked: names of the channels to read.

    Raises:
        InputError: it cannot be read, or has none of these channels.
    """
    found = log_columns(path, file, asked)
    arrays = list(found.columns.values())
    return Table(
        file=file,
        headers=tuple(map(Header.parse, found.columns)),
        rows=len(arrays[0]),
        sha256=sha256_of(path),
        load=lambda wanted: {p: cells_of(arrays[p], number) for p, number in wanted.items()},
        place=lambda index: f"sample {index + 1}",
        notes=found.notes,
    )


def _row(index: int) -> str:
    return f"row {index + 1}"


def _refuse_large(file: str, rows: int, columns: int, max_bytes: int) -> None:
    if (size := 8 * rows * columns) > max_bytes:
        raise InputError(
            f"{file!r} holds {rows} rows of {columns} columns, {bytes_text(size)} in memory; the "
            f"limit is {bytes_text(max_bytes)}. Average or split it, or raise max_bytes"
        )


@contextmanager
def _as_format(file: str, name: str) -> Iterator[None]:
    """Turn whatever a broken file makes its library raise into a refusal.

    Raises:
        InputError: the file is not what its suffix says.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            f"{file!r} cannot be read as {name}: {_first_line(error)}. Is it what its suffix says, "
            "and whole?"
        ) from error


def _first_line(error: Exception) -> str:
    first = (str(error).strip().splitlines() or [type(error).__name__])[0]
    return first[:200].rstrip(".")


def write(dataset: xr.Dataset, path: str | Path) -> Path:
    """Write a data set of readings in the format that the suffix names.

    Args:
        dataset: one dimension, numbers with the attribute `units`, and text.
        path: ending in .csv, .parquet or .nc.

    Returns:
        The path.

    Raises:
        InputError: another suffix, no such folder, or a place that cannot be written to.
    """
    path = Path(path)
    writers: dict[str, Callable[[xr.Dataset, Path], None]] = {
        ".csv": _write_csv,
        ".parquet": _write_parquet,
        ".nc": _write_netcdf,
    }
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise InputError(
            f"{path.name!r}: readings cannot be written as "
            f"{path.suffix or 'a file without a suffix'!r}; choose {', '.join(FORMATS)}"
        )
    with replacing_for_user(path) as partial:
        writer(dataset, partial)
    return path


def _columns(dataset: xr.Dataset) -> dict[str, np.ndarray]:
    """Values under `name [unit]`, labels under their name."""
    found = {}
    for name, variable in dataset.data_vars.items():
        unit = variable.attrs.get("units")
        found[str(name) if unit is None else f"{name} [{unit}]"] = variable.values
    return found


def _write_csv(dataset: xr.Dataset, path: Path) -> None:
    frame = pd.DataFrame(_columns(dataset))
    frame.to_csv(path, index=False, lineterminator="\n", encoding="utf-8")


def _write_parquet(dataset: xr.Dataset, path: Path) -> None:
    arrays, fields = [], []
    units = [variable.attrs.get("units") for variable in dataset.data_vars.values()]
    for (name, values), unit in zip(_columns(dataset).items(), units, strict=True):
        kind = pa.string() if unit is None else pa.float64()
        metadata = None if unit is None else {"units": unit}
        arrays.append(pa.array(values.tolist() if unit is None else values, type=kind))
        fields.append(pa.field(name, kind, metadata=metadata))
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), path)


def _write_netcdf(dataset: xr.Dataset, path: Path) -> None:
    for name in dataset.data_vars:
        if "/" in str(name):
            raise InputError(
                f"column {name!r} cannot be written to NetCDF because of its '/': rename it, or "
                "write .csv or .parquet"
            )
    path.write_bytes(netcdf_bytes(dataset))
