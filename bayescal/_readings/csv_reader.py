"""CSV as a table: a pass over the bytes finds what is wrong and on which line, a second reads.

The first pass keeps nothing but counts, so a file is refused before it takes memory. Line numbers
in messages are those an editor shows, the first line being row 1.
"""

from __future__ import annotations

import csv
import hashlib
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from bayescal._core.errors import InputError
from bayescal._readings.raw_table import Cells, Header, Table, numbers_of

_BLOCK = 1 << 24  # bytes looked at together, and the longest line allowed
_ROWS = 100_000  # rows whose text is held at a time
_SAVE = "Save it as 'CSV UTF-8'"


@dataclass
class _Scan:
    """What the first pass found; rows are line numbers."""

    file: str
    header: list[str] = field(default_factory=list)
    separator: str = ","
    first: int = 0  # row of the first line after the header
    offset: int = 0  # its byte
    lines: int = 0  # after the header
    blanks: list[int] = field(default_factory=list)
    sha256: str = ""

    @property
    def blank(self) -> bytes:
        """What a line may hold and count as blank."""
        return b" \r\n" if self.separator == "\t" else b" \t\r\n"

    def place(self, index: int) -> str:
        """The row of a reading; blank lines count as rows but hold none."""
        row = self.first + index
        passed = 0
        while (blanks := bisect_right(self.blanks, row)) > passed:
            row += blanks - passed
            passed = blanks
        return f"row {row}"


def open_csv(path: Path, file: str) -> Table:
    """Look through a CSV file (comma, semicolon or tab between fields, points in numbers).

    Args:
        path: where it is.
        file: its name in messages.

    Raises:
        InputError: it is empty, not UTF-8, has rows of unequal length, or ends lines in a way that
            cannot be counted; the message names the row.
    """
    with path.open("rb") as handle:
        scan = _scan(handle, file)
    rows = scan.lines - len(scan.blanks)

    return Table(
        file=file,
        headers=tuple(Header.parse(text) for text in scan.header),
        rows=rows,
        sha256=scan.sha256,
        load=lambda wanted: _load(path, scan, wanted),
        place=scan.place,
    )


@dataclass(frozen=True)
class CsvLines:
    """Some lines of a file as they stand.

    Attributes:
        lines: with their ends; blank ones among them.
        table: their readings; None for the header.
        separator: between fields.
        before: of the header: the lines above it.
    """

    lines: list[bytes]
    table: Table | None
    separator: str
    before: list[bytes] = field(default_factory=list)


def csv_parts(path: Path, file: str, rows: int) -> Iterator[CsvLines]:
    """A file that `open_csv` let pass, a stretch of rows at a time: its header first, then its readings.

    Args:
        path: where it is.
        file: its name in messages.
        rows: readings in a stretch, at most.
    """
    with path.open("rb") as handle:
        scan = _scan(handle, file)
    headers = tuple(Header.parse(text) for text in scan.header)
    done = 0
    with path.open("rb") as handle:
        above: list[bytes] = []
        while handle.tell() < scan.offset:
            above.append(handle.readline())
        yield CsvLines([above.pop()], None, scan.separator, above)
        while lines := list(islice(handle, rows)):
            while not any(line.strip() for line in lines) and (more := handle.readline()):
                lines.append(more)  # a stretch of blank lines is no table
            count = sum(bool(line.strip()) for line in lines)
            if count:

                def load(wanted: Mapping[int, bool], lines=lines) -> dict[int, Cells]:
                    return _cells(lines, scan, wanted)

                table = Table(
                    file=file,
                    headers=headers,
                    rows=count,
                    sha256=scan.sha256,
                    load=load,
                    place=lambda index, start=done: scan.place(start + index),
                )
                yield CsvLines(lines, table, scan.separator)
            done += count


def _scan(handle: BinaryIO, file: str) -> _Scan:
    scan, digest = _Scan(file), hashlib.sha256()
    row, line = _header_line(handle, scan, digest.update)
    _split_header(scan, row, line)
    scan.first, scan.offset = row + 1, handle.tell()
    rest = b""
    while block := handle.read(_BLOCK):
        digest.update(block)
        block = rest + block
        end = block.rfind(b"\n") + 1
        if not end and len(block) > _BLOCK:
            raise InputError(
                f"row {scan.first + scan.lines} of {file!r} is longer than {_BLOCK} bytes: is it a "
                "CSV file?"
            )
        rest = block[end:]
        _scan_lines(scan, block[:end])
    if rest:
        _scan_lines(scan, rest + b"\n")
    scan.sha256 = digest.hexdigest()
    return scan


def _header_line(handle: BinaryIO, scan: _Scan, update: Callable[[bytes], None]) -> tuple[int, str]:
    """Row and text of the header: the first line that is neither blank nor a '#' comment."""
    row = 0
    while line := handle.readline(_BLOCK):
        row += 1
        update(line)
        if row == 1 and line[:2] in (b"\xff\xfe", b"\xfe\xff"):
            raise InputError(f"{scan.file!r} is UTF-16 text, UTF-8 was expected. {_SAVE}")
        if row == 1:
            line = line.removeprefix(b"\xef\xbb\xbf")
        text = _decode(line, scan.file, row)
        if text.strip() and not text.startswith("#"):
            return row, text
    raise InputError(
        f"{scan.file!r} is empty: a header 'name [unit], …' and rows of readings were expected"
    )


def _split_header(scan: _Scan, row: int, line: str) -> None:
    line = line.rstrip("\r\n")
    counts = {separator: line.count(separator) for separator in (";", "\t", ",")}
    scan.separator = max(counts, key=lambda separator: counts[separator])
    if not counts[scan.separator]:
        scan.separator = ","
    try:
        scan.header = next(csv.reader([line], delimiter=scan.separator, strict=True))
    except csv.Error as error:
        raise InputError(
            f"row {row} of {scan.file!r}, the header, has a quotation mark without its pair: "
            f"{line[:80]!r}. Close or remove it"
        ) from error


def _decode(data: bytes, file: str, row: int) -> str:
    """Text of whole lines, the first of which is `row`.

    Raises:
        InputError: zero bytes, line ends that are a lone CR, or bytes that are not UTF-8.
    """
    if (zero := data.find(b"\0")) >= 0:
        row += data.count(b"\n", 0, zero)
        raise InputError(
            f"row {row} of {file!r} holds a zero byte: it is UTF-16 text or no text at all. {_SAVE}"
        )
    unix = data.replace(b"\r\n", b"\n")
    if (lone := unix.find(b"\r")) >= 0:
        row += unix.count(b"\n", 0, lone)
        raise InputError(
            f"row {row} of {file!r} holds a carriage return that ends no line: lines must end in "
            f"LF or CR LF. {_SAVE}"
        )
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        start = data.rfind(b"\n", 0, error.start) + 1
        row += data.count(b"\n", 0, error.start)
        raise InputError(
            f"row {row} of {file!r} is not UTF-8: byte {error.start - start + 1} of the row is "
            f"0x{data[error.start]:02x}, after "
            f"{data[start : error.start][-20:].decode('utf-8', 'replace')!r}. {_SAVE}; do not join "
            "files of different encodings"
        ) from error


def _scan_lines(scan: _Scan, data: bytes) -> None:
    """Check whole lines: their encoding, and that each has as many fields as the header."""
    row = scan.first + scan.lines
    _decode(data, scan.file, row)
    lines = data.split(b"\n")[:-1]
    separator, expected = scan.separator.encode(), len(scan.header)
    for index, line in enumerate(lines):
        if b'"' in line:
            fields = _quoted_fields(scan, row + index, line)
        elif line.strip(scan.blank):
            fields = line.count(separator) + 1
        else:
            scan.blanks.append(row + index)
            continue
        if fields != expected:
            _refuse_ragged(scan, row + index, line, fields)
    scan.lines += len(lines)


def _quoted_fields(scan: _Scan, row: int, line: bytes) -> int:
    text = line.decode("utf-8").rstrip("\r")
    try:
        return len(next(csv.reader([text], delimiter=scan.separator, strict=True)))
    except csv.Error as error:
        raise InputError(
            f"row {row} of {scan.file!r} has a quotation mark without its pair: {text[:80]!r}. "
            "Close or remove it; a field cannot run over several lines"
        ) from error


def _refuse_ragged(scan: _Scan, row: int, line: bytes, fields: int) -> None:
    expected = len(scan.header)
    comma = scan.separator == "," and fields > expected
    hint = "If its numbers have decimal commas, export them with decimal points. " if comma else ""
    raise InputError(
        f"row {row} of {scan.file!r} has {fields} field{'s' * (fields != 1)}, its header "
        f"{expected}: {line.decode('utf-8').strip()[:80]!r}. {hint}Give every row one field for "
        "each column"
    )


def _load(path: Path, scan: _Scan, wanted: Mapping[int, bool]) -> dict[int, Cells]:
    with path.open("rb") as handle:
        handle.seek(scan.offset)
        return _cells(handle, scan, wanted)


def _cells(handle: Iterable[bytes], scan: _Scan, wanted: Mapping[int, bool]) -> dict[int, Cells]:
    """The wanted columns, a stretch of rows at a time, so that only one stretch is held as text."""
    parts: dict[int, list[np.ndarray]] = {position: [] for position in wanted}
    bad: dict[int, tuple[int, str]] = {}
    done, lines = 0, iter(handle)
    while stretch := list(islice(lines, _ROWS)):
        fields = _fields([line for line in stretch if line.strip(scan.blank)], scan.separator)
        for position, number in wanted.items():
            texts = fields[position :: len(scan.header)]
            if not number:
                parts[position].append(np.array([text.strip() for text in texts], dtype=object))
                continue
            cells = numbers_of(texts)
            parts[position].append(cells.values)
            if cells.bad and position not in bad:
                bad[position] = (done + cells.bad[0], cells.bad[1])
        done += len(fields) // len(scan.header)
    return {
        position: Cells(np.concatenate(found), bad.get(position))
        for position, found in parts.items()
    }


def _fields(lines: Sequence[bytes], separator: str) -> list[str]:
    """The fields of rows, one row after the other."""
    text = b"".join(lines).decode("utf-8").replace("\r\n", "\n").removesuffix("\n")
    if '"' in text:
        return [field for row in csv.reader(text.split("\n"), delimiter=separator) for field in row]
    return text.replace("\n", separator).split(separator) if lines else []
