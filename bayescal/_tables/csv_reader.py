"""CSV as a table, in two passes.

The first finds what is wrong and on which line, and keeps nothing but counts, so that a file is refused before it takes
memory. The second reads what the first let pass, a stretch of rows at a time. The first line is row 1, as in an editor.
"""

from __future__ import annotations

import codecs
import csv
import hashlib
import io
import math
import re
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from bayescal._core.atomic_file import sha256_of
from bayescal._core.errors import InputError
from bayescal._core.quoting import csv_cell_read
from bayescal._tables.cells import MOST_BAD, Cells, number_of, numbers_of
from bayescal._tables.header_rows import LOOKED_AT, HeaderRows, header_rows, with_units
from bayescal._tables.raw_table import Header, Objection, Table, after, refuse_many, unusable

_BLOCK = 1 << 24  # bytes looked at together, and the longest line allowed
_MARK = b"\xef\xbb\xbf"  # of UTF-8
_ASCII = bytes(range(128))
_LEGACY = "windows-1252"  # what Excel writes as CSV in the west of Europe and in America
_NO_LEGACY = {0x81, 0x8D, 0x8F, 0x90, 0x9D}  # bytes that it does not use
_BEYOND = re.compile(rb"[\xc2-\xdf][\x80-\xbf]|[\xe0-\xef][\x80-\xbf]{2}|[\xf0-\xf4][\x80-\xbf]{3}")
_MOST_HELD = 500_000_000  # bytes: it is held whole
_SAVE = "Save it as 'CSV UTF-8'"
_LABVIEW = "***End_of_Header***"
# A comma that parts no thousands, behind a separator that is none: 20,5 or 0,125 or 1234,567, but not 1,234.
_DECIMAL_COMMA = re.compile(
    rb"(?:^|[;\t\n])[ +-]*(?:0?,\d+|\d{4,},\d+|\d{1,3},(?:\d\d?|\d{4,}))(?:[eE][+-]?\d+)?[ \r]*(?=[;\t\n]|$)"
)
# Blanks that part fields: any but before a unit in brackets and in it; or two and more, where names or dates hold one.
_BLANKS = (
    re.compile(rb"[ \t]+(?![ \t\[(<{]|[^\[(<{\n]*[\])>}])"),
    re.compile(rb"(?: {2,}|[ ]*\t)[ \t]*(?![ \t\[(<{])"),
)
_BEFORE_UNIT = re.compile(rb"[ \t]+(?=[\[(<{])")  # in a row of units
_ROWS = 100_000  # rows whose text is held at a time


def open_csv(path: Path, file: str, decimal: str = "") -> Table:
    """Scan a CSV file: comma, semicolon, tab or blanks between fields.

    Args:
        path: where it is.
        file: its name in messages.
        decimal: a point or a comma; empty for a point, or a comma where semicolons or tabs part the fields and a
            number such as 20,5 shows that it parts no thousands.

    Returns:
        The table; rows of unequal length are its `problems`.

    Raises:
        InputError: it is empty, in an encoding that cannot be told, or ends lines in a way that cannot be counted.
    """
    scan = scan_csv(path, file, decimal)

    def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
        with opened(path, scan.encoding, scan.blank_runs) as handle:
            handle.seek(scan.offset)
            return scan.cells(handle, wanted)

    notes = {
        f"read as {scan.encoding}": scan.encoding != "utf-8",
        "its fields are parted by blanks": scan.blank_runs is not None,
        "its numbers have decimal commas": scan.decimal == ",",
        f"its columns are named in row {scan.named}; what stands above it is left out": scan.above,
        f"its units are taken from row {scan.named + 1}": scan.first - scan.named > 1,
    }
    return Table(
        file,
        scan.headers,
        scan.lines - len(scan.blanks),
        load,
        scan.sha256,
        scan.place,
        notes=tuple(f"{file}: {note}" for note, holds in notes.items() if holds),
        problems=ragged_rows(scan),
        readable=len(scan.passed_over) == len(scan.ragged),
    )


@dataclass(frozen=True)
class CsvLines:
    """Some lines of a file as they stand, with their ends, a tab for blanks between fields; blank ones among them.

    Attributes:
        table: their readings; None for the header.
        separator, decimal: between fields, and between the whole and its parts.
        encoding: of the lines, "utf-8" or "windows-1252".
        before, behind: of the header: the lines above it; the row of units below it, and such.
    """

    lines: list[bytes]
    table: Table | None
    separator: str
    decimal: str = "."
    encoding: str = "utf-8"
    before: list[bytes] = field(default_factory=list)
    behind: list[bytes] = field(default_factory=list)


def csv_parts(path: Path, file: str, rows: int, decimal: str = "") -> Iterator[CsvLines]:
    """Yield a file that `open_csv` let pass: its header, then its readings, at most `rows` at a time."""
    scan, done = scan_csv(path, file, decimal), 0
    with opened(path, scan.encoding, scan.blank_runs) as handle:
        above: list[bytes] = []
        while handle.tell() < scan.offset:
            above.append(handle.readline())
        named = scan.named - 1
        before, header, behind = above[:named], above[named], above[named + 1 :]
        written = scan.written_in
        yield CsvLines([header], None, scan.separator, ".", written, before, behind)
        while lines := list(islice(handle, rows)):
            while not any(line.strip() for line in lines) and (more := handle.readline()):
                lines.append(more)  # a stretch of blank lines is no table
            if count := sum(bool(line.strip()) for line in lines):
                load, place = partial(scan.cells, lines), after(done, scan.place)
                table = Table(file, scan.headers, count, load, scan.sha256, place)
                yield CsvLines(lines, table, scan.separator, scan.decimal or ".", written)
            done += count


@dataclass
class CsvScan:
    """What the first pass found; rows are line numbers."""

    file: str
    header: list[str] = field(default_factory=list)
    separator: str = ","
    encoding: str = "utf-8"
    commented: bool = False  # whether a comment names its columns
    blank_runs: re.Pattern[bytes] | None = None  # that part its fields
    decimal: str = ""  # a point or a comma; empty until a number shows it
    named: int = 0  # row of the header
    above: bool = False  # whether lines that tell of the test stand above it
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

    @property
    def written_in(self) -> str:
        """The encoding of its lines as `opened` gives them."""
        return _LEGACY if self.encoding == _LEGACY else "utf-8"

    def text(self, line: bytes) -> str:
        """A line that was looked through."""
        return line.decode(self.written_in)

    @property
    def headers(self) -> tuple[Header, ...]:
        return tuple(Header.parse(csv_cell_read(text)) for text in self.header)

    def cells(self, lines: Iterable[bytes], wanted: Mapping[int, bool]) -> dict[int, Cells]:
        """Parse the wanted columns of lines below the header; one stretch of rows is held as text at a time."""
        parts: dict[int, list[Cells]] = {position: [] for position in wanted}
        if self.passed_over:
            numbered = enumerate(lines, self.first)
            lines = (line for row, line in numbered if row not in self.passed_over)
        filled = (line for line in lines if line.strip(self.blank))
        while stretch := list(islice(filled, _ROWS)):
            text = self.text(b"".join(stretch)).replace("\r\n", "\n").removesuffix("\n")
            if '"' in text:
                rows = csv.reader(text.split("\n"), delimiter=self.separator)
                fields = [field for row in rows for field in row]
            else:
                fields = text.replace("\n", self.separator).split(self.separator)
            for position, number in wanted.items():
                texts = fields[position :: len(self.header)]
                if number:
                    own = numbers_of(texts, self.decimal)
                else:
                    own = Cells(np.array([csv_cell_read(t.strip()) for t in texts], dtype=object))
                parts[position].append(own)
        return {position: Cells.joined(found) for position, found in parts.items()}

    def split(self, line: str, row: int, called: str = "", cure: str = "") -> list[str]:
        """Split a line into fields; raise InputError where its quotation marks are not in pairs."""
        if '"' not in line:
            return line.split(self.separator)
        try:
            return next(csv.reader([line], delimiter=self.separator, strict=True))
        except csv.Error as error:
            long = "limit" in str(error)
            what = "a field that is too long" if long else "a quotation mark without its pair"
            came = f"has {what}{called}: {line[:80]!r}"
            raise unusable(self.file, came, f"Close or remove it{cure}", f"row {row}") from error

    def place(self, index: int) -> str:
        """Return the row of a reading; blank lines count as rows but hold none."""
        row, passed = self.first + index, 0
        while (blanks := bisect_right(self.blanks, row)) > passed:
            row, passed = row + blanks - passed, blanks
        return f"row {row}"


def scan_csv(path: Path, file: str, decimal: str) -> CsvScan:
    """Scan a file: its layout, its rows, and which of them are blank or have another number of fields."""
    scan = CsvScan(file, encoding=encoding_of(path), decimal=decimal)
    _find_layout(path, scan)
    with opened(path, scan.encoding, scan.blank_runs) as handle:
        digest, rest = hashlib.sha256(_read_header(handle, scan)), b""
        while block := handle.read(_BLOCK):
            digest.update(block)
            block = rest + block
            end = block.rfind(b"\n") + 1
            if not end and len(block) > _BLOCK:
                place = f"row {scan.first + scan.lines}"
                raise unusable(file, f"is longer than {_BLOCK} bytes", "is it a CSV file?", place)
            rest = block[end:]
            _scan_lines(scan, block[:end])
        if rest:
            _scan_lines(scan, rest + b"\n")
    # of UTF-16 and of blanks, what was scanned are not the bytes of the file
    changed = scan.blank_runs or scan.encoding == "utf-16"
    scan.sha256 = sha256_of(path) if changed else digest.hexdigest()
    odd = [row for row, _, _ in scan.ragged]
    if len(odd) < min(MOST_BAD, scan.lines - len(scan.blanks)):
        scan.passed_over = frozenset(odd)
        scan.blanks = sorted([*scan.blanks, *odd])
    return scan


def _read_header(handle: BinaryIO, scan: CsvScan) -> bytes:
    """Find the header, leave the file where the readings begin, and return the bytes above them.

    It is the first line that is neither blank nor a '#' comment, unless that tells of the test and names of columns
    stand further down, or no line but a comment names them.
    """
    first_lines = _first_lines(handle, scan)
    handle.seek(0)
    if not first_lines:
        _decode(handle.read(), scan, 1)
        expected = "a header 'name [unit], …' and rows of readings were expected"
        raise unusable(scan.file, "is empty", expected)
    texts, units = [text for _, text, _ in first_lines], list[str]()
    found, separator = _header_among(texts)
    scan.separator = separator or max(_separators_of(texts[0]), key=texts[0].count)
    if found:
        units = _labview_units([_fields_of(t, separator) for t in texts[: found.first]])
    row, text, end = first_lines[found.first if found else 0]
    last, _, end = first_lines[found.last] if found else (row, text, end)
    above = handle.read(end)
    _decode(above.removeprefix(_MARK), scan, 1)
    refuse_many(scan.file, 1 + text.count(scan.separator))
    fields = text.split(scan.separator), text.split()
    if any(not any(map(math.isnan, map(number_of, own))) for own in fields):
        cure = (
            "Write one that names the columns, such as 'time [s],temperature [degC],output [deg/s]'"
        )
        raise unusable(scan.file, f"has no header: its first row, row {row}, is numbers", cure)
    scan.header = scan.split(text, row, called=", in the header")
    if found and (found.last > found.first or len(found.names) != len(scan.header)):
        scan.header = found.names
    scan.header = with_units(scan.header, units)
    scan.first, scan.offset, scan.named = last + 1, end, row
    scan.above = row > first_lines[0][0]
    return above


def _find_layout(path: Path, scan: CsvScan) -> None:
    """Find whether blanks part the fields, or a comment names the columns, where nothing else makes a header."""
    with opened(path, scan.encoding) as handle:
        texts = [text for _, text, _ in _first_lines(handle, replace(scan, commented=True))]
        handle.seek(0)
        plain = [text for _, text, _ in _first_lines(handle, scan)]
    for commented, lines in ((False, plain), (True, texts)):
        for runs in (None, *_BLANKS):
            if _header_among([_with_tabs(t.encode(), runs).decode() for t in lines])[0]:
                scan.commented, scan.blank_runs = commented, runs
                return


def _first_lines(handle: BinaryIO, scan: CsvScan) -> list[tuple[int, str, int]]:
    """Return row, text and the byte behind it of the first lines that are neither blank nor comments."""
    there, row = [], 0
    while len(there) < LOOKED_AT and (line := handle.readline(_BLOCK)):
        row += 1
        text = line.removeprefix(_MARK if row == 1 else b"").decode(scan.written_in, "replace")
        text = text.removeprefix("#").lstrip() if scan.commented else text
        if text.strip() and not text.startswith("#"):
            there.append((row, text.rstrip("\r\n"), handle.tell()))
    return there


def _header_among(texts: Sequence[str]) -> tuple[HeaderRows | None, str]:
    """Return the header among the first lines of a file, and what parts its fields; None and nothing for no header."""
    after = [i for i, text in enumerate(texts) if text.startswith(_LABVIEW)]
    begin = after[-1] + 1 if after else 0
    for i in range(begin, len(texts)):
        for separator in _separators_of(texts[i]):
            if found := header_rows([_fields_of(text, separator) for text in texts], i):
                return found, separator
    return None, ""


def _with_tabs(data: bytes, runs: re.Pattern[bytes] | None) -> bytes:
    """Return lines with a tab in place of the blanks that part fields, and none about them."""
    if runs is None:
        return data
    lines = (line.strip(b" \t") for line in data.replace(b"\r\n", b"\n").split(b"\n"))
    return b"\n".join((_BEFORE_UNIT if x[:1] in b"[(<{" else runs).sub(b"\t", x) for x in lines)


def _fields_of(line: str, separator: str) -> list[str]:
    """Return the fields of a line; none where its quotation marks are not in pairs."""
    if '"' not in line:
        return line.split(separator)
    with suppress(csv.Error):
        return next(csv.reader([line], delimiter=separator), [])
    return []


def _labview_units(above: Sequence[Sequence[str]]) -> list[str]:
    """Units of the columns that the head of a LabVIEW measurement file (.lvm) states; none elsewhere."""
    stated = {row[0].strip(): [text.strip() for text in row[1:]] for row in above}
    if _LABVIEW not in stated or "Y_Unit_Label" not in stated:
        return []
    return ["s" if "Time" in stated.get("X_Dimension", ()) else "", *stated["Y_Unit_Label"]]


def _separators_of(line: str) -> list[str]:
    """What may part the fields of a line, the most frequent first; commas last: numbers and names hold them."""
    there = filter(line.count, (";", "\t", "|", ","))
    return sorted(there, key=lambda one: (one == ",", -line.count(one))) or [","]


def _decode(data: bytes, scan: CsvScan, row: int) -> None:
    """Raise InputError where whole lines, the first of which is `row`, are no text that is known."""

    def refuse(came: str, before: bytes, cure: str = "") -> InputError:
        place = row + before.count(b"\n")
        return unusable(scan.file, came, _SAVE + cure, f"row {place}")

    if (zero := data.find(b"\0")) >= 0:
        raise refuse("holds a zero byte: it is UTF-16 text or no text at all", data[:zero])
    unix = data.replace(b"\r\n", b"\n")
    if (lone := unix.find(b"\r")) >= 0:
        came = "holds a carriage return that ends no line: lines must end in LF or CR LF"
        raise refuse(came, unix[:lone])
    try:
        scan.text(data)
    except UnicodeDecodeError as error:
        line = data[data.rfind(b"\n", 0, error.start) + 1 : error.start]
        came = f"is not UTF-8: byte {len(line) + 1} of the row is 0x{data[error.start]:02x}"
        came += f", after {line[-20:].decode('utf-8', 'replace')!r}"
        cure = "; do not join files of different encodings"
        raise refuse(came, data[: error.start], cure) from error


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
            text, cure = scan.text(line).rstrip("\r"), "; a field cannot run over several lines"
            fields = len(scan.split(text, row + index, cure=cure))
        elif line.strip(scan.blank):
            fields = line.count(separator) + 1
        else:
            scan.blanks.append(row + index)
            continue
        if fields != expected and len(scan.ragged) < MOST_BAD:
            scan.ragged.append((row + index, scan.text(line).strip()[:80], fields))
    scan.lines += len(lines)


def ragged_rows(scan: CsvScan) -> tuple[Objection, ...]:
    """Return the rows that have not one field for each column, as one problem."""
    if not scan.ragged:
        return ()
    _, text, fields = scan.ragged[0]
    expected = len(scan.header)
    comma = scan.separator == "," and fields > expected
    cure = "If its numbers have decimal commas, export them with decimal points. " * comma
    if any(expected < n for _, _, n in scan.ragged):
        cure += "If the first lines only tell of the test, begin each with #. "
    cure += "Give every row one field for each column"
    came = f"{fields} field{'s' * (fields != 1)}, {text!r}, its header has {expected}"
    places = tuple(f"row {row}" for row, _, _ in scan.ragged)
    return (Objection(scan.file, came, cure=cure, places=places),)


def encoding_of(path: Path) -> str:
    """By its mark "utf-16"; "windows-1252" where bytes beyond ASCII make no character in UTF-8 anywhere; else "utf-8".

    Windows-1252 has two and more of such bytes side by side in hardly any word, and in none that are UTF-8 throughout:
    a file that has characters of both was joined of two, and is refused as what it is not.
    """
    beyond = set[int]()
    with path.open("rb") as handle:
        if handle.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            return "utf-16"
        handle.seek(0)
        while block := handle.read(_BLOCK):
            block += handle.readline()  # no character lies across blocks
            beyond.update(block.translate(None, _ASCII))
            if _BEYOND.search(block) or not beyond.isdisjoint(_NO_LEGACY):
                return "utf-8"
    return _LEGACY if beyond else "utf-8"


def opened(path: Path, encoding: str, runs: re.Pattern[bytes] | None = None) -> BinaryIO:
    """Open a file's bytes; those of UTF-16 as UTF-8, with tabs where runs of blanks part the fields.

    Raises:
        InputError: text that has to be held and is too large, or UTF-16 that is broken.
    """
    if runs is None and encoding != "utf-16":
        return path.open("rb")
    what = "UTF-16 text" if runs is None else "text whose fields are parted by blanks"
    if path.stat().st_size > _MOST_HELD:
        cure = f"{_SAVE}, with commas between fields"
        raise unusable(path.name, f"is {what} of more than 500 MB", cure)
    data = path.read_bytes()
    try:
        data = data.decode("utf-16").encode() if encoding == "utf-16" else data
    except UnicodeError as error:
        raise unusable(path.name, f"is {what} that breaks off", "save it as 'CSV UTF-8'") from error
    return io.BytesIO(_with_tabs(data, runs))
