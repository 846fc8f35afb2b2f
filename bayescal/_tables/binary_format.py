"""What formats other than text share: rows by their number, sizes, and refusals of what is broken."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from bayescal._core.errors import InputError
from bayescal._tables.raw_table import bytes_text


def row_place(index: int) -> str:
    return f"row {index + 1}"


def refuse_large(file: str, rows: int, columns: int, max_bytes: int) -> None:
    if (size := 8 * rows * columns) > max_bytes:
        raise InputError(
            f"{file!r} holds {rows} rows of {columns} columns, {bytes_text(size)} in memory; the "
            f"limit is {bytes_text(max_bytes)}. Average or split it, or raise max_bytes"
        )


@contextmanager
def as_format(file: str, name: str) -> Iterator[None]:
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
