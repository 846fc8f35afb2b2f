"""A file opened as a table, in the format that its suffix names."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from bayescal._core.atomic_file import sha256_of
from bayescal._core.errors import InputError
from bayescal._logs.open_log import LOG_FORMATS, log_columns
from bayescal._tables.cells import cells_of
from bayescal._tables.csv_reader import open_csv
from bayescal._tables.raw_table import Header, Table

MAX_BYTES = 2_000_000_000
TEXT = (".csv", ".tsv", ".txt")
READ = (*TEXT, ".parquet", ".nc", ".xlsx", ".mat", *LOG_FORMATS)
_PICKLES = (".pkl", ".pickle", ".npy", ".npz", ".joblib")


def open_table(
    path: Path,
    name: str,
    max_bytes: int = MAX_BYTES,
    decimal: str = "",
    asked: Collection[str] = (),
) -> Table:
    """Open a file.

    Args:
        path: where it is.
        name: what messages call it.
        max_bytes: most that the file, or its numbers in memory, may take.
        decimal: of a text file, as `open_csv` takes it.
        asked: names of the channels of a log to read.

    Raises:
        InputError: another suffix, a file that is not what its suffix says, or that cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix not in READ:
        never = "Pickled objects are never read, because they can run code. " * (suffix in _PICKLES)
        old = "Save it as .xlsx. " * (suffix == ".xls")
        raise InputError(
            f"{name!r}: {suffix or 'a file without a suffix'!r} cannot be read. {never}{old}"
            f"Give one of {', '.join(READ)}"
        )
    try:
        if not path.stat().st_size:
            raise InputError(
                f"{name!r} is empty (0 bytes): a header and rows of readings were expected"
            )
        if suffix in TEXT:
            return open_csv(path, name, decimal)
        if suffix in LOG_FORMATS:
            return _open_log(path, name, asked)
        if suffix in (".xlsx", ".mat"):
            from bayescal._tables.spreadsheets import open_excel, open_matlab

            return (open_excel if suffix == ".xlsx" else open_matlab)(path, name, max_bytes)
        from bayescal._tables.parquet_netcdf import (
            open_netcdf,
            open_parquet,
        )  # a second that text does without

        return (open_parquet if suffix == ".parquet" else open_netcdf)(path, name, max_bytes)
    except OSError as error:
        raise InputError(
            f"{str(path)!r} cannot be read: {error.strerror or error}. Check the name and the folder"
        ) from error


def _open_log(path: Path, file: str, asked: Collection[str]) -> Table:
    """Channels of a log as a table.

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
