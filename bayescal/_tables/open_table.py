"""Opening of a file as a table, in the format of its suffix."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from bayescal._core.annex import first_offered
from bayescal._core.atomic_file import sha256_of
from bayescal._core.errors import InputError
from bayescal._core.quoting import one_line
from bayescal._tables.csv_reader import parse_text
from bayescal._tables.raw_table import Table, format_bytes, unusable

MAX_BYTES = 2_000_000_000  # of a file, and of its numbers in memory: a larger one is refused before memory runs out
TEXT = (".csv", ".tsv", ".dsv", ".txt", ".lvm", ".dat")
LOGS = (".ulg", ".bin")  # which an annex reads
READ = (*TEXT, ".parquet", ".nc", ".xlsx", ".mat", *LOGS)


def check_files(paths: Sequence[Path], max_bytes: int = MAX_BYTES) -> list[str]:
    """Check the files before any is opened, and return their names for messages.

    Raises:
        InputError: no file, one twice, one that is not there or is no file, or all are too large.
    """
    if not paths:
        raise InputError("no file was given to read: give at least one")
    for path, count in Counter(path.resolve() for path in paths).items():
        if count > 1:
            raise InputError(f"{path.name!r} was given {count} times: give each file once")
    shared, total = Counter(path.name for path in paths), 0
    names = [one_line(path.name if shared[path.name] == 1 else path) for path in paths]
    for path, name in zip(paths, names, strict=True):
        with _reachable(path):
            size = path.stat().st_size
        if not path.is_file():
            raise unusable(str(path), "is not a file", "name a file, or all files of the folder")
        total += size
        if total > max_bytes:
            limit = f"the limit is {format_bytes(max_bytes)}, and nothing was loaded"
            cure = "Average the readings, read fewer files, or raise max_bytes in Python"
            raise unusable(name, f"brings all files to {format_bytes(total)}, {limit}", cure)
    return names


@contextmanager
def _reachable(path: Path) -> Iterator[None]:
    """Raise InputError for a file that the system cannot open."""
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
    asked: Collection[str] = (),
) -> Table:
    """Open a file as a table of at most `max_bytes`; `decimal` as `parse_text`, `asked` are the channels of a log.

    Raises:
        InputError: another suffix, a file that is not what its suffix says, or that cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix not in READ:
        what = repr(suffix) if suffix else "a file without a suffix"
        raise InputError(f"{name!r}: {what} cannot be read. Give one of {', '.join(READ)}")
    with _reachable(path):
        if suffix in TEXT:
            data = path.read_bytes()  # of the very bytes that are parsed
            table = parse_text(data, name, decimal).table()
            return replace(table, sha256=hashlib.sha256(data).hexdigest())
        if suffix in LOGS:
            table = first_offered("log", f"{name!r}, a log,")(path, name, asked)
        else:  # a second that text does without
            from bayescal._tables import formats

            openers = {".xlsx": formats.open_excel, ".mat": formats.open_matlab}
            openers |= {".parquet": formats.open_parquet, ".nc": formats.open_netcdf}
            table = openers[suffix](path, name, max_bytes)
        return replace(table, sha256=sha256_of(path))
