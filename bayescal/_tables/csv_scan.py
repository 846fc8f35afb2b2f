"""The first pass over a CSV file: it finds what is wrong and on which line, and keeps nothing but counts.

So a file is refused before it takes memory. Line numbers in messages are those an editor shows, the first line being
row 1.
"""

from __future__ import annotations

import csv
import hashlib
import re
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from bayescal._core.atomic_file import sha256_of
from bayescal._core.errors import InputError
from bayescal._tables.cells import MOST_BAD
from bayescal._tables.encoding import encoding_of, opened
from bayescal._tables.problems import Problem

_BLOCK = 1 << 24  # bytes looked at together, and the longest line allowed
_SAVE = "Save it as 'CSV UTF-8'"
# A comma that parts no thousands, behind a separator that is none: 20,5 or 0,125 or 1234,567, but not 1,234.
_DECIMAL_COMMA = re.compile(
    rb"(?:^|[;\t\n])[ +-]*(?:0?,\d+|\d{4,},\d+|\d{1,3},(?:\d\d?|\d{4,}))(?:[eE][+-]?\d+)?[ \r]*(?=[;\t\n]|$)"
)


@dataclass
class CsvScan:
    """What the first pass found; rows are line numbers."""

    file: str
    header: list[str] = field(default_factory=list)
    separator: str = ","
    encoding: str = "utf-8"
    decimal: str = ""  # a point or a comma; empty until a number shows it
    first: int = 0  # row of the first line after the header
    offset: int = 0  # its byte
    lines: int = 0  # after the header
    blanks: list[int] = field(default_factory=list)
    ragged: list[tuple[int, str, int]] = field(default_factory=list)  # row, text, number of fields
    passed_over: frozenset[int] = frozenset()  # ragged rows, where there are others to look at
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


def scan_csv(path: Path, file: str, decimal: str) -> CsvScan:
    scan = CsvScan(file, encoding=encoding_of(path), decimal=decimal)
    with opened(path, scan.encoding) as handle:
        _look_through(handle, scan)
    odd = [row for row, _, _ in scan.ragged]
    if len(odd) < min(MOST_BAD, scan.lines - len(scan.blanks)):
        scan.passed_over = frozenset(odd)
        scan.blanks = sorted([*scan.blanks, *odd])
    if scan.encoding == "utf-16":  # what was looked through are not the bytes of the file
        scan.sha256 = sha256_of(path)
    return scan


def _look_through(handle: BinaryIO, scan: CsvScan) -> None:
    digest = hashlib.sha256()
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
                f"row {scan.first + scan.lines} of {scan.file!r} is longer than {_BLOCK} bytes: is it a "
                "CSV file?"
            )
        rest = block[end:]
        _scan_lines(scan, block[:end])
    if rest:
        _scan_lines(scan, rest + b"\n")
    scan.sha256 = digest.hexdigest()


def _header_line(
    handle: BinaryIO, scan: CsvScan, update: Callable[[bytes], None]
) -> tuple[int, str]:
    """Row and text of the header: the first line that is neither blank nor a '#' comment."""
    row = 0
    while line := handle.readline(_BLOCK):
        row += 1
        update(line)
        if row == 1:
            line = line.removeprefix(b"\xef\xbb\xbf")
        text = _decode(line, scan, row)
        if text.strip() and not text.startswith("#"):
            return row, text
    raise InputError(
        f"{scan.file!r} is empty: a header 'name [unit], …' and rows of readings were expected"
    )


def _split_header(scan: CsvScan, row: int, line: str) -> None:
    line = line.rstrip("\r\n")
    counts = {separator: line.count(separator) for separator in (";", "\t", ",")}
    scan.separator = max(counts, key=lambda separator: counts[separator])
    if not counts[scan.separator]:
        scan.separator = ","
    if all(map(_is_number, line.split(scan.separator))):
        raise InputError(
            f"{scan.file!r} has no header: its first row, row {row}, is numbers. Write one that names the columns, "
            "such as 'time [s],temperature [degC],output [deg/s]'"
        )
    try:
        scan.header = next(csv.reader([line], delimiter=scan.separator, strict=True))
    except csv.Error as error:
        raise InputError(
            f"row {row} of {scan.file!r}, the header, has a quotation mark without its pair: "
            f"{line[:80]!r}. Close or remove it"
        ) from error


def _is_number(text: str) -> bool:
    try:
        return float(text) == float(text)
    except ValueError:
        return False


def _decode(data: bytes, scan: CsvScan, row: int) -> str:
    """Text of whole lines, the first of which is `row`.

    Raises:
        InputError: zero bytes, line ends that are a lone CR, or bytes that are not of the encoding.
    """
    file = scan.file
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
        return data.decode(scan.encoding if scan.encoding == "latin-1" else "utf-8")
    except UnicodeDecodeError as error:
        start = data.rfind(b"\n", 0, error.start) + 1
        row += data.count(b"\n", 0, error.start)
        raise InputError(
            f"row {row} of {file!r} is not UTF-8: byte {error.start - start + 1} of the row is "
            f"0x{data[error.start]:02x}, after "
            f"{data[start : error.start][-20:].decode('utf-8', 'replace')!r}. {_SAVE}; do not join "
            "files of different encodings"
        ) from error


def _scan_lines(scan: CsvScan, data: bytes) -> None:
    """Check whole lines: their encoding, and that each has as many fields as the header."""
    row = scan.first + scan.lines
    _decode(data, scan, row)
    if not scan.decimal and scan.separator != "," and _DECIMAL_COMMA.search(data):
        scan.decimal = ","
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
        if fields != expected and len(scan.ragged) < MOST_BAD:
            scan.ragged.append((row + index, text_of(line, scan).strip()[:80], fields))
    scan.lines += len(lines)


def _quoted_fields(scan: CsvScan, row: int, line: bytes) -> int:
    text = text_of(line, scan).rstrip("\r")
    try:
        return len(next(csv.reader([text], delimiter=scan.separator, strict=True)))
    except csv.Error as error:
        raise InputError(
            f"row {row} of {scan.file!r} has a quotation mark without its pair: {text[:80]!r}. "
            "Close or remove it; a field cannot run over several lines"
        ) from error


def ragged_rows(scan: CsvScan) -> tuple[Problem, ...]:
    """The rows that have not one field for each column, as one problem."""
    if not scan.ragged:
        return ()
    _, text, fields = scan.ragged[0]
    expected = len(scan.header)
    comma = scan.separator == "," and fields > expected
    hint = "If its numbers have decimal commas, export them with decimal points. " if comma else ""
    longer = any(expected < n for _, _, n in scan.ragged)
    above = "If the first lines only tell of the test, begin each with #. " if longer else ""
    cure = f"{hint}{above}Give every row one field for each column"
    came = f"{fields} field{'s' * (fields != 1)}, {text!r}, its header has {expected}"
    places = tuple(f"row {row}" for row, _, _ in scan.ragged)
    return (Problem(scan.file, came, cure=cure, places=places),)


def text_of(line: bytes, scan: CsvScan) -> str:
    """A line that `_decode` let pass."""
    return line.decode("latin-1" if scan.encoding == "latin-1" else "utf-8")
