"""Parquet and NetCDF as tables: numbers and text only, nothing that a file could have evaluated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa
import pyarrow.parquet as pq

from bayescal._core.atomic_file import named_back
from bayescal._core.errors import InputError
from bayescal._tables.cells import Cells, cells_of
from bayescal._tables.raw_table import (
    ROW,
    Header,
    Table,
    after,
    as_format,
    refuse_large,
    refuse_many,
)
from bayescal._tables.unpacked import ARRAYS, refuse_hdf5, refuse_unpacked

if TYPE_CHECKING:
    import xarray as xr


def open_parquet(path: Path, file: str, max_bytes: int) -> Table:
    """Look at a Parquet file: units stand in the column names or in the fields' metadata.

    Args: as of `open_table`.

    Raises:
        InputError: it is not Parquet, or too large once unpacked.
    """
    with as_format(file, "Parquet"), pq.ParquetFile(path) as opened:
        refuse_many(file, opened.metadata.num_columns)
        schema, rows = opened.schema_arrow, opened.metadata.num_rows
    refuse_unpacked(file, path.stat().st_size, 8 * rows * len(schema), ARRAYS)
    refuse_large(file, rows, len(schema), max_bytes)

    def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
        found = {}
        with as_format(file, "Parquet"), pq.ParquetFile(path) as opened:
            for position, number in wanted.items():
                name = schema.names[position]
                found[position] = arrow_cells(opened.read(columns=[name]).column(name), number)
        pa.default_memory_pool().release_unused()  # what it unpacked, as much again as the numbers
        return found

    return Table(file, arrow_headers(schema), rows, load)


def parquet_parts(path: Path, file: str, rows: int) -> Iterator[tuple[pa.RecordBatch, Table]]:
    """A Parquet file a stretch of rows at a time: as it stands, and as a table."""
    with as_format(file, "Parquet"), pq.ParquetFile(path) as opened:
        done = 0
        for batch in opened.iter_batches(batch_size=rows):

            def load(wanted: Mapping[int, bool], batch=batch) -> dict[int, Cells]:
                columns = {p: pa.chunked_array([batch.column(p)]) for p in wanted}
                return {p: arrow_cells(columns[p], number) for p, number in wanted.items()}

            if batch.num_rows:
                headers = arrow_headers(batch.schema)
                yield batch, Table(file, headers, batch.num_rows, load, place=after(done))
            done += batch.num_rows


def arrow_headers(schema: pa.Schema) -> tuple[Header, ...]:
    """The columns, with the units that their fields' metadata state."""
    units = ((field.metadata or {}).get(b"units") for field in schema)
    said = (None if unit is None else unit.decode("utf-8", "replace") for unit in units)
    return tuple(map(Header.parse, schema.names, said))


def arrow_cells(column: pa.ChunkedArray, number: bool) -> Cells:
    """A column's cells: numbers as they are, anything else as text."""
    kind = column.type
    if number and (
        pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)
    ):
        return cells_of(column.cast(pa.float64()).to_numpy(), number)
    return cells_of(column.to_pandas().to_numpy(object), number)


def open_netcdf(path: Path, file: str, max_bytes: int) -> Table:
    """Look at a NetCDF-4 file: variables along one dimension, units in the attribute `units`.

    Args: as of `open_table`.

    Raises:
        InputError: it is not NetCDF-4, has several dimensions to choose from, or is too large once
            unpacked.
    """
    import h5py  # a tenth of a second that only NetCDF needs

    with as_format(file, "NetCDF-4"), h5py.File(path) as hdf5:
        # h5netcdf, failing at this, would print its own complaint later
        hdf5.attrs.get("_nc3_strict")
        refuse_hdf5(hdf5, file, path.stat().st_size)
    with as_format(file, "NetCDF-4"), _dataset(path) as dataset:
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
        refuse_large(file, rows, len(names), max_bytes)
        units = [lines[name].attrs.get("units") for name in names]
    said = (None if unit is None else str(unit) for unit in units)
    headers = tuple(map(Header.parse, map(named_back, names), said))

    def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
        with as_format(file, "NetCDF-4"), _dataset(path) as dataset:
            return {p: cells_of(dataset[names[p]].values, number) for p, number in wanted.items()}

    return Table(file, headers, rows, load)


def _dataset(path: Path) -> xr.Dataset:
    import xarray as xr  # half a second that only NetCDF needs

    return xr.open_dataset(path, engine="h5netcdf", decode_times=False)
