"""Excel sheets and MATLAB variables as tables. Heavy modules load inside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayescal._core.atomic_file import sha256_of
from bayescal._core.errors import InputError
from bayescal._tables.cells import Cells, cells_of
from bayescal._tables.raw_table import Header, Table, as_format, refuse_large, row_place


def open_excel(path: Path, file: str, max_bytes: int) -> Table:
    """Read an Excel file (.xlsx): the first sheet with cells in it, its header in the first row that is not empty.

    Args:
        path: where it is.
        file: its name in messages.
        max_bytes: most that its numbers may take in memory.

    Raises:
        InputError: openpyxl is not installed, it is no such file, or too large once unpacked.
    """
    try:
        from openpyxl import load_workbook
    except ImportError:
        raise InputError(
            f"{file!r}: reading Excel files needs openpyxl: pip install 'bayescal[logs]'; or save it as CSV UTF-8"
        ) from None
    with as_format(file, "Excel (.xlsx)"):
        book = load_workbook(path, read_only=True, data_only=True)
        try:
            sheets = [sheet for sheet in book.worksheets if sheet.max_row and sheet.max_column]
            for sheet in sheets:
                refuse_large(file, sheet.max_row, sheet.max_column, max_bytes)
                rows = list(sheet.iter_rows(values_only=True))
                if any(value is not None for row in rows for value in row):
                    break
            else:
                raise InputError(f"{file!r} is empty: a header and rows of readings were expected")
        finally:
            book.close()
    others = f", the first of {len(sheets)}" if len(sheets) > 1 else ""
    notes = (f"{file}: read from the sheet {sheet.title!r}{others}",) if others else ()
    return _of_rows(path, file, rows, notes)


def _of_rows(path: Path, file: str, rows: Sequence[Sequence[Any]], notes: tuple[str, ...]) -> Table:
    """A table of rows of cells: the first that is not empty names the columns, empty rows are none."""
    there = [i for i, row in enumerate(rows) if any(_there(value) for value in row)]
    head, *data = there
    width = 1 + max(i for row in there for i, value in enumerate(rows[row]) if _there(value))
    names = ["" if value is None else str(value) for value in rows[head][:width]]
    columns = [[rows[row][i] for row in data] for i in range(width)]

    def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
        return {p: cells_of(_objects(columns[p]), number) for p, number in wanted.items()}

    return Table(
        file=file,
        headers=tuple(Header.parse(name) for name in names),
        rows=len(data),
        sha256=sha256_of(path),
        load=load,
        place=lambda index: f"row {data[index] + 1}",
        notes=notes,
    )


def _there(value: Any) -> bool:
    return value is not None and str(value).strip() != ""


def _objects(values: Sequence[Any]) -> np.ndarray:
    """Cells of whatever kind; dates and times as text, which is read as in any other file."""
    found = np.empty(len(values), dtype=object)
    found[:] = [v.isoformat() if hasattr(v, "isoformat") else v for v in values]
    return found


def open_matlab(path: Path, file: str, max_bytes: int) -> Table:
    """Read a MATLAB file (.mat): vectors of one length, the fields of a structure too, are its columns.

    The columns of a matrix `data` are called `data(:,1)` and so on.

    Args:
        path: where it is.
        file: its name in messages.
        max_bytes: most that its numbers may take in memory.

    Raises:
        InputError: it is no such file, or has vectors of several lengths to choose from.
    """
    with as_format(file, "MATLAB (.mat)"):
        with path.open("rb") as handle:
            old = b"MATLAB 7.3" not in handle.read(128)
        found = _variables(path) if old else _variables_of_hdf5(path)
    columns = {
        name: vector for key, value in found.items() for name, vector in _vectors(key, value)
    }
    lengths = {len(vector) for vector in columns.values()} - {1}
    if len(lengths) != 1:
        sizes = ", ".join(f"{name} ({len(vector)})" for name, vector in columns.items()) or "none"
        raise InputError(
            f"{file!r} holds vectors of {len(lengths) or 'no'} lengths, and which are its readings cannot be told: "
            f"{sizes}. "
            "Save those of one length, as numbers or text (tables and timetables by table2struct(T, ToScalar=true))"
        )
    rows = lengths.pop()
    kept = {name: vector for name, vector in columns.items() if len(vector) == rows}
    refuse_large(file, rows, len(kept), max_bytes)
    vectors = list(kept.values())
    return Table(
        file=file,
        headers=tuple(Header.parse(name) for name in kept),
        rows=rows,
        sha256=sha256_of(path),
        load=lambda wanted: {p: cells_of(vectors[p], number) for p, number in wanted.items()},
        place=row_place,
    )


def _variables(path: Path) -> dict[str, Any]:
    """Of a file of version 7.2 or before."""
    from scipy.io import loadmat

    loaded = loadmat(path, squeeze_me=True, struct_as_record=False, chars_as_strings=True)
    return {name: value for name, value in loaded.items() if not name.startswith("__")}


def _variables_of_hdf5(path: Path) -> dict[str, Any]:
    """Of a file of version 7.3: arrays are stored transposed, text as numbers of characters."""
    import h5py

    def value(node: Any) -> Any:
        if isinstance(node, h5py.Group):
            return {str(name): value(node[name]) for name in node if not str(name).startswith("#")}
        kind = node.attrs.get("MATLAB_class", b"")
        array = node[()].T
        if kind == b"char":
            return np.array(["".join(map(chr, row)) for row in np.atleast_2d(array)])
        return np.squeeze(array) if array.dtype.kind in "iufb" else None

    with h5py.File(path) as opened:
        return {str(name): value(opened[name]) for name in opened if not str(name).startswith("#")}


def _vectors(name: str, value: Any) -> list[tuple[str, np.ndarray]]:
    """The columns in a variable: a vector, those of a matrix, or of a structure's fields."""
    fields = value if isinstance(value, dict) else getattr(value, "__dict__", None)
    if fields is not None:
        own = {n: v for n, v in fields.items() if not n.startswith("_")}
        return [pair for field, inner in own.items() for pair in _vectors(field, inner)]
    array = np.asarray(value)
    if array.dtype.kind not in "iufbUO" or array.dtype.fields:
        return []
    if array.ndim == 2 and array.dtype.kind in "iuf":
        return [(f"{name}(:,{i + 1})", array[:, i]) for i in range(array.shape[1])]
    return [(name, array.reshape(-1))] if array.ndim < 2 else []
