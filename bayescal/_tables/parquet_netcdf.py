"""Parquet and NetCDF as tables: numbers and text only, nothing that a file could have evaluated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from bayescal._core.atomic_file import named_back
from bayescal._core.errors import InputError
from bayescal._tables.cells import Cells, cells_of
from bayescal._tables.raw_table import (
    ROW,
    Header,
    Table,
    as_format,
    refuse_large,
    refuse_many,
)
from bayescal._tables.unpacked import ARRAYS, refuse_hdf5, refuse_unpacked


def open_parquet(path: Path, file: str, max_bytes: int) -> Table:
    """Open a Parquet file; units stand in the column names or in the fields' metadata. Arguments as `open_table`."""
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


def arrow_headers(schema: pa.Schema) -> tuple[Header, ...]:
    """The columns, with the units that their fields' metadata state."""
    units = ((field.metadata or {}).get(b"units") for field in schema)
    said = (None if unit is None else unit.decode("utf-8", "replace") for unit in units)
    return tuple(map(Header.parse, schema.names, said))


def arrow_cells(column: pa.ChunkedArray, number: bool) -> Cells:
    """Return a column's cells: numbers as they are, anything else as text."""
    kind, types = column.type, pa.types
    if number and (types.is_integer(kind) or types.is_floating(kind) or types.is_decimal(kind)):
        return cells_of(column.cast(pa.float64()).to_numpy(), number)
    return cells_of(column.to_pandas().to_numpy(object), number)


def open_netcdf(path: Path, file: str, max_bytes: int) -> Table:
    """Open a NetCDF-4 file: variables along one dimension, units in `units`. Arguments as `open_table`."""
    import h5py  # a tenth of a second that only NetCDF needs
    import xarray as xr  # half a second

    def dataset() -> xr.Dataset:
        return xr.open_dataset(path, engine="h5netcdf", decode_times=False)

    with as_format(file, "NetCDF-4"), h5py.File(path) as hdf5:
        # h5netcdf, failing at this, would print its own complaint later
        hdf5.attrs.get("_nc3_strict")
        refuse_hdf5(hdf5, file, path.stat().st_size)
    with as_format(file, "NetCDF-4"), dataset() as data:
        vectors = {str(n): v for n, v in data.variables.items() if v.ndim == 1 and n != ROW}
        dimensions = {str(v.dims[0]) for v in vectors.values()}
        if ROW not in dimensions and len(dimensions) > 1:
            raise InputError(
                f"{file!r} has variables along {', '.join(sorted(dimensions))}: which are the readings cannot be told. "
                f"Give its variables one dimension, best called {ROW!r}"
            )
        chosen = ROW if ROW in dimensions else next(iter(dimensions), "")
        names = [name for name, variable in vectors.items() if variable.dims[0] == chosen]
        rows = data.sizes.get(chosen, 0)
        refuse_large(file, rows, len(names), max_bytes)
        units = [vectors[name].attrs.get("units") for name in names]
    stated = (None if unit is None else str(unit) for unit in units)
    headers = tuple(map(Header.parse, map(named_back, names), stated))

    def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
        with as_format(file, "NetCDF-4"), dataset() as data:
            return {p: cells_of(data[names[p]].values, number) for p, number in wanted.items()}

    return Table(file, headers, rows, load)
