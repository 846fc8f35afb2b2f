"""Opening of files as tables; the suffix determines the format."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from bayescal._core.annex import load_entry
from bayescal._core.atomic_file import compute_sha256
from bayescal._core.errors import InputError
from bayescal._core.quoting import to_printable
from bayescal._tables.csv_file import parse_text
from bayescal._tables.raw_table import Table, format_bytes, unusable

MAX_BYTES = 2_000_000_000  # size of a file, and of its numbers in memory; larger files are refused
TEXT_SUFFIXES = (".csv", ".tsv", ".dsv", ".txt", ".lvm", ".dat")
LOG_SUFFIXES = (".ulg", ".bin")  # read by an annex
SUFFIXES = (*TEXT_SUFFIXES, ".parquet", ".nc", ".xlsx", ".mat", *LOG_SUFFIXES)


def check_files(paths: Sequence[Path], max_bytes: int = MAX_BYTES) -> list[str]:
    """Check files before any is opened; return their names for messages (paths where names are equal).

    Raises:
        InputError: no file is given, or one twice; a file does not exist or is a folder; the total size is too large.
    """
    if not paths:
        raise InputError("no file was given: give at least one")
    for path, count in Counter(path.resolve() for path in paths).items():
        if count > 1:
            raise InputError(f"{path.name!r} was given {count} times: give each file once")
    name_counts, total_size = Counter(path.name for path in paths), 0
    names = [to_printable(path.name if name_counts[path.name] == 1 else path) for path in paths]
    for path, name in zip(paths, names, strict=True):
        with _convert_os_errors(path):
            size = path.stat().st_size
        if not path.is_file():
            raise unusable(str(path), "is not a file", "give a file, or all files of the folder")
        total_size += size
        if total_size > max_bytes:
            limit = f"above the limit of {format_bytes(max_bytes)}"
            cure = "Average the readings, read fewer files, or raise max_bytes in Python"
            raise unusable(name, f"makes the total size {format_bytes(total_size)}, {limit}", cure)
    return names


@contextmanager
def _convert_os_errors(path: Path) -> Iterator[None]:
    """Convert an OSError in the `with` block to an InputError about the file."""
    try:
        yield
    except OSError as error:
        fault = f"cannot be read: {error.strerror or error}"
        raise unusable(str(path), fault, "Check the name and the folder") from error


def open_table(
    path: Path,
    name: str,
    max_bytes: int = MAX_BYTES,
    decimal: str = "",
    channels: Collection[str] = (),
) -> Table:
    """Open a file, `name` in messages, as a table; `decimal` as in `parse_text`, `channels`: those to read of a log.

    Raises:
        InputError: the suffix is unknown, or the file is unreadable, above `max_bytes`, or in another format.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        kind = repr(suffix) if suffix else "a file without a suffix"
        raise InputError(f"{name!r}: {kind} cannot be read. Give one of {', '.join(SUFFIXES)}")
    with _convert_os_errors(path):
        if suffix in TEXT_SUFFIXES:
            data = path.read_bytes()  # the digest is of the parsed bytes
            table = parse_text(data, name, decimal).to_table()
            return replace(table, sha256=hashlib.sha256(data).hexdigest())
        if suffix in LOG_SUFFIXES:
            table = load_entry("log", f"{name!r}, a log,")(path, name, channels)
        else:  # takes a second, not needed for text
            from bayescal._tables import formats

            openers = {".xlsx": formats.open_excel, ".mat": formats.open_matlab}
            openers |= {".parquet": formats.open_parquet, ".nc": formats.open_netcdf}
            table = openers[suffix](path, name, max_bytes)
        return replace(table, sha256=compute_sha256(path))
