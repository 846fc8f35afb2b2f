"""Readers of Parquet, NetCDF, Excel and MATLAB files: numbers and text only; no code in a file is executed.

A module that only one format needs is imported in its function.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow import types

from bayescal._core.atomic_file import decode_name
from bayescal._core.errors import InputError
from bayescal._tables import unpacked
from bayescal._tables.cells import format_cell
from bayescal._tables.csv_file import parse_text
from bayescal._tables.raw_table import (
    ROW,
    Header,
    Table,
    as_format,
    check_size,
    check_width,
    to_one_line,
    unusable,
)


def open_parquet(path: Path, file: str, max_bytes: int) -> Table:
    """Return a Parquet file as a table, with units from column names or the fields' metadata; `file`: its name."""
    with as_format(file, "Parquet"), pq.ParquetFile(path) as parquet:
        check_width(file, parquet.metadata.num_columns)
        schema, rows = parquet.schema_arrow, parquet.metadata.num_rows
    unpacked.refuse_unpacked(file, path.stat().st_size, 8 * rows * len(schema), unpacked.ARRAYS)
    check_size(file, rows, len(schema), max_bytes)

    def load(requested: Mapping[int, bool]) -> dict[int, np.ndarray]:
        values = {}
        with as_format(file, "Parquet"), pq.ParquetFile(path) as parquet:
            for position, number in requested.items():
                name, arrow_type = schema.names[position], schema.types[position]
                column = parquet.read(columns=[name]).column(name)
                is_number = types.is_integer(arrow_type) or types.is_floating(arrow_type)
                if number and (is_number or types.is_decimal(arrow_type)):
                    values[position] = column.cast(pa.float64()).to_numpy()
                else:
                    values[position] = column.to_pandas().to_numpy(object)
        pa.default_memory_pool().release_unused()  # decompressed buffers are as large as the numbers
        return values

    units = ((field.metadata or {}).get(b"units") for field in schema)
    unit_texts = (None if unit is None else unit.decode("utf-8", "replace") for unit in units)
    return Table(file, tuple(map(Header.parse, schema.names, unit_texts)), rows, load)


def open_netcdf(path: Path, file: str, max_bytes: int) -> Table:
    """Return the variables of a NetCDF-4 file along one dimension as a table, with units from attributes `units`."""
    import h5py  # takes a tenth of a second
    import xarray as xr  # half a second

    with as_format(file, "NetCDF-4"), h5py.File(path) as hdf5:
        # an invalid attribute would make h5netcdf print an error later
        hdf5.attrs.get("_nc3_strict")
        unpacked.refuse_hdf5(hdf5, file, path.stat().st_size)
    with (
        as_format(file, "NetCDF-4"),
        xr.open_dataset(path, engine="h5netcdf", decode_times=False) as data,
    ):
        vectors = {str(n): v for n, v in data.variables.items() if v.ndim == 1 and n != ROW}
        dimensions = {str(v.dims[0]) for v in vectors.values()}
        if ROW not in dimensions and len(dimensions) > 1:
            raise InputError(
                f"{file!r} has variables along {', '.join(sorted(dimensions))}, so that the dimension of readings is "
                f"ambiguous. Save variables of one dimension, preferably called {ROW!r}"
            )
        row_dimension = ROW if ROW in dimensions else next(iter(dimensions), "")
        columns = {decode_name(n): v for n, v in vectors.items() if v.dims[0] == row_dimension}
        check_size(file, data.sizes.get(row_dimension, 0), len(columns), max_bytes)
        units = {n: str(v.attrs["units"]) for n, v in columns.items() if "units" in v.attrs}
        return Table.from_columns(file, {n: v.values for n, v in columns.items()}, units)


def open_excel(path: Path, file: str, max_bytes: int) -> Table:
    """Return the first non-empty sheet of an Excel file (.xlsx) as a table; `file`: its name in messages.

    Raises:
        InputError: openpyxl is not installed, or the file is invalid, empty, or too large (decompressed, or as text).
    """
    try:
        from openpyxl import load_workbook
    except ImportError:
        raise InputError(
            f"{file!r}: reading Excel files needs openpyxl: pip install 'bayescal[logs]'; or save it as CSV UTF-8"
        ) from None
    with as_format(file, "Excel (.xlsx)"), path.open("rb") as handle:
        with ZipFile(path) as archive:
            unpacked_size = sum(entry.file_size for entry in archive.infolist())  # unpacked size
        unpacked.refuse_unpacked(file, path.stat().st_size, unpacked_size, unpacked.SHEET_LIMIT)
        with closing(load_workbook(handle, read_only=True, data_only=True)) as book:
            sheets = book.worksheets
            pairs = ((s, t) for s in sheets if (t := _sheet_to_text(s, file, max_bytes)).strip())
            sheet, text = next(pairs, (None, b""))
    if sheet is None:
        raise unusable(file, "is empty", "a header and rows of readings were expected")
    note = f"read from the sheet {sheet.title!r}, the first non-empty one of {len(sheets)} sheets"
    return parse_text(text, file).to_table(*[note] * (len(sheets) > 1))


def _sheet_to_text(sheet: Any, file: str, max_bytes: int) -> bytes:
    """Return a sheet as UTF-8 text, one line of tab-separated cells per row; empty for a sheet without cells."""
    rows, count = list[list[str]](), 0
    sheet.reset_dimensions()
    for values in sheet.iter_rows(values_only=True):
        rows.append([to_one_line(format_cell(value)).replace('"', '""') for value in values])
        count += sum(map(bool, rows[-1]))
        check_size(file, count, 1, max_bytes)
    width = max((i + 1 for row in rows for i, cell in enumerate(row) if cell), default=0)
    padded_rows = ([*row, *[""] * width][:width] if any(row) else [] for row in rows)
    return "".join("\t".join(f'"{cell}"' for cell in row) + "\n" for row in padded_rows).encode()


def open_matlab(path: Path, file: str, max_bytes: int) -> Table:
    """Return the vectors of a MATLAB file (.mat), including fields of structures, as columns of a table.

    The columns of a matrix `data` are called `data(:,1)` and so on. `file`: name of the file in messages.

    Raises:
        InputError: the file is invalid or too large, or has vectors of several lengths.
    """
    from scipy.io import loadmat

    with as_format(file, "MATLAB (.mat)"):
        with path.open("rb") as handle:
            is_before_73 = b"MATLAB 7.3" not in handle.read(128)
        if is_before_73:
            unpacked.refuse_matlab(path, file)
            loaded = loadmat(path, squeeze_me=True, struct_as_record=False, chars_as_strings=True)
            variables = {name: value for name, value in loaded.items() if not name.startswith("__")}
        else:
            variables = _load_hdf5_variables(path, file)
    columns = dict(pair for key, value in variables.items() for pair in _split_variable(key, value))
    lengths = {len(vector) for vector in columns.values()} - {1}
    if len(lengths) != 1:
        sizes = ", ".join(f"{name} ({len(vector)})" for name, vector in columns.items()) or "none"
        raise InputError(
            f"{file!r} must contain vectors of one length, an element for each reading; it has: {sizes}. Save them "
            "as numbers or text (tables and timetables by table2struct(T, ToScalar=true))"
        )
    rows = lengths.pop()
    long_vectors = {name: vector for name, vector in columns.items() if len(vector) == rows}
    check_size(file, rows, len(long_vectors), max_bytes)
    return Table.from_columns(file, long_vectors)


def _load_hdf5_variables(path: Path, file: str) -> dict[str, Any]:
    """Return the variables of a MATLAB 7.3 file by name; it stores arrays transposed, and text as character codes."""
    import h5py

    def value(node: Any) -> Any:
        if isinstance(node, h5py.Group):
            return {str(name): value(node[name]) for name in node if not str(name).startswith("#")}
        matlab_class = node.attrs.get("MATLAB_class", b"")
        array = node[()].T
        if matlab_class == b"char":
            return np.array(["".join(map(chr, row)) for row in np.atleast_2d(array)])
        return np.squeeze(array) if array.dtype.kind in "iufb" else None

    with h5py.File(path) as hdf5:
        unpacked.refuse_hdf5(hdf5, file, path.stat().st_size)
        return {str(name): value(hdf5[name]) for name in hdf5 if not str(name).startswith("#")}


def _split_variable(name: str, value: Any) -> list[tuple[str, np.ndarray]]:
    """Return a variable's columns with their names: a vector, a matrix's columns, or those of a structure's fields."""
    fields = value if isinstance(value, dict) else getattr(value, "__dict__", None)
    if fields is not None:
        members = {n: v for n, v in fields.items() if not n.startswith("_")}
        return [pair for field, entry in members.items() for pair in _split_variable(field, entry)]
    array = np.asarray(value)
    if array.dtype.kind not in "iufbUO" or array.dtype.fields:
        return []
    if array.ndim == 2 and array.dtype.kind in "iuf":
        return [(f"{name}(:,{i + 1})", array[:, i]) for i in range(array.shape[1])]
    return [(name, array.reshape(-1))] if array.ndim < 2 else []
