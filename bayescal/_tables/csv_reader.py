"""CSV as a table. The file's bytes are held as one text; a first pass finds malformed lines.

Columns are then parsed in chunks of rows. The first line is row 1, as in an editor.
"""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice, product
from typing import NamedTuple

import numpy as np

from bayescal._core.quoting import csv_cell_read
from bayescal._tables.cells import MAX_BAD, Cells, is_missing, parse_date, to_number, to_numbers
from bayescal._tables.raw_table import Header, Objection, Objections, Table, refuse_many, unusable

_MARK = b"\xef\xbb\xbf"  # of UTF-8
_ASCII = bytes(range(128))
_LEGACY = "windows-1252"  # of CSV from Excel in the west of Europe and in America
_NO_LEGACY = {0x81, 0x8D, 0x8F, 0x90, 0x9D}  # bytes that it does not use
_BEYOND = re.compile(rb"[\xc2-\xdf][\x80-\xbf]|[\xe0-\xef][\x80-\xbf]{2}|[\xf0-\xf4][\x80-\xbf]{3}")
_SAVE = "Save it as 'CSV UTF-8'"
_LABVIEW = "***End_of_Header***"
# A comma that does not separate thousands, behind another separator: 20,5 or 0,125 or 1234,567, but not 1,234.
_DECIMAL_COMMA = re.compile(
    rb"(?:^|[;\t\n])[ +-]*(?:0?,\d+|\d{4,},\d+|\d{1,3},(?:\d\d?|\d{4,}))(?:[eE][+-]?\d+)?[ \r]*(?=[;\t\n]|$)"
)
# Blanks that separate fields: any except before a unit in brackets and in it; or two and more, where names hold one.
_BLANKS = (
    re.compile(rb"[ \t]+(?![ \t\[(<{]|[^\[(<{\n]*[\])>}])"),
    re.compile(rb"(?: {2,}|[ ]*\t)[ \t]*(?![ \t\[(<{])"),
)
_BEFORE_UNIT = re.compile(rb"[ \t]+(?=[\[(<{])")  # in a row of units
_CHUNK_ROWS = 100_000  # rows whose text is held at a time
_HEADER_ROWS = 200  # rows from the start of a file, in which the header is searched
_WIDTH_ROWS = 5  # last of these, whose width is that of the readings
_UNIT_ROWS = 2  # rows of units and the like between names and readings
_UNIT_LENGTH = 24  # of a field in such a row
_NO_UNITS = ("TS", "RN")  # of Campbell's loggers, for time stamps and record numbers


@dataclass
class CsvText:
    """A text file and its layout; rows are line numbers.

    Attributes:
        data: the file in UTF-8, with tabs where runs of blanks separate the fields.
        encoding: of the file.
        decimal: a point or a comma; empty until a number shows it.
        named: row of the header.
        first, offset: row and byte of the first line after the header.
        readings: rows of readings (n,).
        notes: unusual ways in which it was read.
    """

    file: str
    data: bytes
    encoding: str
    header: list[str] = field(default_factory=list)
    separator: str = ","
    decimal: str = ""
    named: int = 0
    first: int = 0
    offset: int = 0
    readings: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    notes: list[str] = field(default_factory=list)

    @property
    def blank(self) -> bytes:
        """Return the bytes of which a blank line may consist."""
        return b" \r\n" if self.separator == "\t" else b" \t\r\n"

    def table(self, *further_notes: str) -> Table:
        """Convert to a table, with its notes and further ones."""
        return Table(
            self.file,
            tuple(Header.parse(csv_cell_read(text)) for text in self.header),
            len(self.readings),
            self.cells,
            place=lambda index: f"row {self.readings[index]}",
            notes=tuple(f"{self.file}: {note}" for note in (*self.notes, *further_notes)),
        )

    def rows(self) -> Iterable[bytes]:
        """Iterate over the lines below the header."""
        handle = io.BytesIO(self.data)  # without a copy
        handle.seek(self.offset)
        return handle

    def cells(self, columns: Mapping[int, bool]) -> dict[int, Cells]:
        """Parse columns (position → whether of numbers); one chunk of rows is held as text at a time."""
        parts: dict[int, list[Cells]] = {position: [] for position in columns}
        lines = (line for line in self.rows() if line.strip(self.blank))
        while stretch := list(islice(lines, _CHUNK_ROWS)):
            text = b"".join(stretch).decode()
            text = text.replace("\r\n", "\n").removesuffix("\n")
            if '"' in text:
                rows = csv.reader(text.split("\n"), delimiter=self.separator)
                fields = [field for row in rows for field in row]
            else:
                fields = text.replace("\n", self.separator).split(self.separator)
            for position, number in columns.items():
                texts = fields[position :: len(self.header)]
                if number:
                    piece = to_numbers(texts, self.decimal)
                else:
                    piece = Cells(np.array([csv_cell_read(t.strip()) for t in texts], dtype=object))
                parts[position].append(piece)
        return {position: Cells.joined(pieces) for position, pieces in parts.items()}

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


def parse_text(data: bytes, file: str, decimal: str = "") -> CsvText:
    """Parse the bytes of a file: its layout, and its rows.

    Comma, semicolon, tab, bar or blanks separate fields. `decimal` is a point or a comma; empty for a point, or for a
    comma where semicolons or tabs separate the fields and a number such as 20,5 cannot have a thousands separator.

    Raises:
        InputError: it is empty, in an encoding that cannot be told, ends lines in a way that cannot be counted, or has
            rows with another number of fields than the header.
    """
    text = CsvText(file, *_decode(data, file), decimal=decimal)
    if text.encoding != "utf-8":
        text.notes.append(f"read as {text.encoding}")
    _read_header(text)
    _scan_lines(text)
    return text


def _decode(data: bytes, file: str) -> tuple[bytes, str]:
    """Decode the bytes of a file; return it in UTF-8, and its encoding.

    It is windows-1252 if bytes beyond ASCII form no character of UTF-8 anywhere: in windows-1252 two such bytes are
    adjacent in hardly any word. A file with characters of both was concatenated from two, and is refused.
    """
    encoding, came, cure, beyond = "utf-8", "", _SAVE, set(data.translate(None, _ASCII))
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif beyond and beyond.isdisjoint(_NO_LEGACY) and not _BEYOND.search(data):
        encoding = _LEGACY
    if encoding != "utf-8":
        try:
            data = data.decode(encoding).encode()
        except UnicodeError as error:
            raise unusable(file, "is UTF-16 text that breaks off", _SAVE) from error
    if (at := data.find(b"\0")) >= 0:
        came = "holds a zero byte: it is UTF-16 text or no text at all"
    elif lone := re.search(rb"\r(?!\n)", data):
        at = lone.start()
        came = "holds a carriage return that ends no line: lines must end in LF or CR LF"
    elif not data.isascii():
        try:
            data.decode()
        except UnicodeDecodeError as error:
            at = error.start
            line = data[data.rfind(b"\n", 0, at) + 1 : at]
            came = f"is not UTF-8: byte {len(line) + 1} of the row is 0x{data[at]:02x}, after "
            came += f"{line[-20:].decode('utf-8', 'replace')!r}"
            cure += "; do not join files of different encodings"
    if came:
        row = 1 + data.count(b"\n", 0, at)
        raise unusable(file, came, cure, f"row {row}")
    return data, encoding


def _read_header(text: CsvText) -> None:
    """Find the separator and the header.

    The header is the first line that is neither blank nor a '#' comment, unless it describes the test and column names
    follow further down, or only a comment names them; blanks separate the fields where no other header is found.
    """
    header, lines = None, _first_lines(text)
    for commented, runs in product((False, True), (None, *_BLANKS)):
        texts = _first_lines(text, commented)
        if header := _header_among([_with_tabs(x.encode(), runs).decode() for _, x, _ in texts]):
            if runs:
                text.notes.append("its fields are parted by blanks")
                text.data = _with_tabs(text.data, runs)
            lines = _first_lines(text, commented)
            break
    if not lines:
        expected = "a header 'name [unit], …' and rows of readings were expected"
        raise unusable(text.file, "is empty", expected)
    row, line, end = lines[header.first if header else 0]
    last, _, end = lines[header.last] if header else (row, line, end)
    separator = text.separator = header.separator if header else _separators_of(line)[0]
    refuse_many(text.file, 1 + line.count(separator))
    fields = line.split(separator), line.split()
    if any(not any(map(math.isnan, map(to_number, texts))) for texts in fields):
        cure = (
            "Write one that names the columns, such as 'time [s],temperature [degC],output [deg/s]'"
        )
        raise unusable(text.file, f"has no header: its first row, row {row}, is numbers", cure)
    text.header = text.split(line, row, called=", in the header")
    if header and (header.last > header.first or len(header.names) != len(text.header)):
        text.header = header.names
    above = [_fields_of(texts, separator) for _, texts, _ in lines[: header.first if header else 0]]
    text.header = _with_units(text.header, _labview_units(above))
    text.first, text.offset, text.named = last + 1, end, row
    if above:
        text.notes.append(f"its columns are named in row {row}; what stands above it is left out")
    if text.first - row > 1:
        text.notes.append(f"its units are taken from row {row + 1}")


def _first_lines(text: CsvText, commented: bool = False) -> list[tuple[int, str, int]]:
    """Return row, text and end offset of the first lines that are neither blank nor comments."""
    handle, first, row = io.BytesIO(text.data), [], 0
    while len(first) < _HEADER_ROWS and (raw := handle.readline()):
        row += 1
        line = raw.removeprefix(_MARK if row == 1 else b"").decode("utf-8", "replace")
        line = line.removeprefix("#").lstrip() if commented else line
        if line.strip() and not line.startswith("#"):
            first.append((row, line.rstrip("\r\n"), handle.tell()))
    return first


def _header_among(texts: Sequence[str]) -> _HeaderRows | None:
    """Find the header among the first lines of a file; None for none."""
    after = [i for i, text in enumerate(texts) if text.startswith(_LABVIEW)]
    rows = dict[str, list[list[str]]]()
    for i in range(after[-1] + 1 if after else 0, len(texts)):
        for separator in _separators_of(texts[i]):
            if separator not in rows:
                rows[separator] = [_fields_of(text, separator) for text in texts]
            if header := _header_rows(rows[separator], i, separator):
                return header
    return None


def _with_tabs(data: bytes, runs: re.Pattern[bytes] | None) -> bytes:
    """Replace the blanks that separate fields by tabs, and strip lines."""
    if runs is None:
        return data
    lines = (line.strip(b" \t") for line in data.replace(b"\r\n", b"\n").split(b"\n"))
    return b"\n".join((_BEFORE_UNIT if x[:1] in b"[(<{" else runs).sub(b"\t", x) for x in lines)


def _fields_of(line: str, separator: str) -> list[str]:
    """Split a line into fields; [] where its quotation marks are not in pairs."""
    if '"' not in line:
        return line.split(separator)
    with suppress(csv.Error):
        return next(csv.reader([line], delimiter=separator), [])
    return []


def _labview_units(above: Sequence[Sequence[str]]) -> list[str]:
    """Return the column units in the head of a LabVIEW measurement file (.lvm); [] for other files."""
    stated = {row[0].strip(): [text.strip() for text in row[1:]] for row in above}
    if _LABVIEW not in stated or "Y_Unit_Label" not in stated:
        return []
    return ["s" if "Time" in stated.get("X_Dimension", ()) else "", *stated["Y_Unit_Label"]]


def _separators_of(line: str) -> list[str]:
    """Return possible separators of a line, the most frequent first; commas last, as numbers and names hold them."""
    marks = filter(line.count, (";", "\t", "|", ","))
    return sorted(marks, key=lambda mark: (mark == ",", -line.count(mark))) or [","]


def _scan_lines(text: CsvText) -> None:
    """Check the number of fields of each line of readings; detect decimal commas."""
    separator, expected, blank = text.separator.encode(), len(text.header), text.blank
    if not text.decimal and separator != b"," and _DECIMAL_COMMA.search(text.data, text.offset - 1):
        text.decimal = ","
    if text.decimal == ",":
        text.notes.append("its numbers have decimal commas")
    row, blanks, ragged = text.first - 1, list[int](), list[tuple[int, str, int]]()
    for row, line in enumerate(text.rows(), text.first):
        if b'"' in line:
            decoded, cure = line.decode(), "; a field cannot run over several lines"
            fields = len(text.split(decoded.rstrip("\r\n"), row, cure=cure))
        elif line.strip(blank):
            fields = line.count(separator) + 1
        else:
            blanks.append(row)
            continue
        if fields != expected and len(ragged) < MAX_BAD:
            ragged.append((row, line.decode().strip()[:80], fields))
    if ragged:
        _refuse_ragged(text, ragged)
    text.readings = np.setdiff1d(np.arange(text.first, row + 1), blanks)


def _refuse_ragged(text: CsvText, ragged: Sequence[tuple[int, str, int]]) -> None:
    """Raise InputError for rows (number, text, number of fields) with another number of fields than columns."""
    _, line, fields = ragged[0]
    expected = len(text.header)
    comma = text.separator == "," and fields > expected
    cure = "If its numbers have decimal commas, export them with decimal points. " * comma
    if any(expected < n for _, _, n in ragged):
        cure += "If the first lines only tell of the test, begin each with #. "
    cure += "Give every row one field for each column"
    came = f"has {fields} field{'s' * (fields != 1)}, {line!r}, its header has {expected}"
    places = tuple(f"row {row}" for row, _, _ in ragged)
    Objections([Objection(text.file, came, cure=cure, places=places)]).refuse()


class _HeaderRows(NamedTuple):
    """Indices of the first and last row that name columns, and the names, with units in brackets, one a column."""

    first: int
    last: int
    names: list[str]
    separator: str


def _header_rows(rows: Sequence[Sequence[str]], first: int, separator: str) -> _HeaderRows | None:
    """Return the rows that name the columns, if `rows[first]` (fields, without blank rows) is the first of them.

    Names are text; readings with as many fields and a number or a date among them follow, at once or after a row of
    units. Rows of readings may have one more, empty field at their end.
    """
    names = [name.strip() for name in rows[first]]
    if len(names) < 2 or any(map(_is_reading, names)) or sum(map(bool, names)) < 2:
        return None
    last = [row for row in rows[first + 1 :][-_WIDTH_ROWS:] if any(map(_is_reading, row))]
    if not last or sum(map(bool, names)) < min(sum(map(bool, row)) for row in last):
        return None
    width = Counter(map(len, last)).most_common(1)[0][0]
    ends_empty = all(not row[-1].strip() for row in last if len(row) == width)
    if width == len(names) - 1 and names[-1].lower() in ("", "comment"):
        names = names[:-1]
    elif width == len(names) + 1 and ends_empty:
        names = [*names, ""]
    if width != len(names):
        return None
    below = first + 1
    while below < min(len(rows), first + 2 + _UNIT_ROWS) and _are_units(rows[below], len(names)):
        below += 1
    if below == len(rows) or len(rows[below]) != width or not any(map(_is_reading, rows[below])):
        return None
    units = rows[first + 1] if below > first + 1 else ()
    return _HeaderRows(first, below - 1, _with_units(names, units), separator)


def _is_reading(text: str) -> bool:
    """Return whether a field holds a number or a date."""
    with suppress(ValueError):
        float(text.strip().replace(",", ".", 1))
        return not is_missing(text)
    return bool(parse_date(text))


def _are_units(row: Sequence[str], width: int) -> bool:
    """Return whether a row between names and readings may be one of units: short texts, none of them a reading."""
    texts = [text.strip() for text in row if text.strip()]
    short = all(len(t) <= _UNIT_LENGTH and (t[0] in "[(" or not t.endswith("]")) for t in texts)
    fits = abs(len(row) - width) <= 1 and len(texts) >= 2
    readings = (t for t in texts if _is_reading(t) or (is_missing(t) and t != "-"))
    return fits and short and not any(readings)


def _with_units(names: Sequence[str], units: Sequence[str]) -> list[str]:
    """Append units in brackets to names, where there are any."""
    headers = list(names)
    for i, (name, unit) in enumerate(zip(names, map(str.strip, units), strict=False)):
        if unit[:1] + unit[-1:] in ("()", "[]", "<>", "{}"):
            unit = unit[1:-1].strip()
        if name and unit and unit not in _NO_UNITS and not name.endswith("]"):
            headers[i] = f"{name} [{unit}]"
    return headers
