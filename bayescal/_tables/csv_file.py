"""Reading and writing of CSV: a first pass checks all lines, then columns are loaded in chunks. Rows count from 1."""

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
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bayescal._core.atomic_file import replace_user_file
from bayescal._core.errors import InputError
from bayescal._core.quoting import quote_cell, unquote_cell
from bayescal._tables.cells import MAX_INVALID_ROWS, TEXT, is_missing, parse_date, to_number
from bayescal._tables.raw_table import Header, Objection, Objections, Table, check_width, unusable

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"  # of UTF-8
_ASCII = bytes(range(128))
_LEGACY_ENCODING = "windows-1252"  # of Excel in Western Europe and America
_UNUSED_BYTES = {0x81, 0x8D, 0x8F, 0x90, 0x9D}  # bytes without a character in windows-1252
_UTF8 = re.compile(rb"[\xc2-\xdf][\x80-\xbf]|[\xe0-\xef][\x80-\xbf]{2}|[\xf0-\xf4][\x80-\xbf]{3}")
_SAVE_AS_UTF8 = "Save it as 'CSV UTF-8'"
_LABVIEW_HEADER_END = "***End_of_Header***"
# A comma that does not separate thousands, behind another separator: 20,5 or 0,125 or 1234,567, but not 1,234.
_DECIMAL_COMMA = re.compile(
    rb"(?:^|[;\t\n])[ +-]*(?:0?,\d+|\d{4,},\d+|\d{1,3},(?:\d\d?|\d{4,}))(?:[eE][+-]?\d+)?[ \r]*(?=[;\t\n]|$)"
)
# Blanks that separate fields: all but those before or in a unit in brackets; or two or more, if names contain one.
_BLANKS = (
    re.compile(rb"[ \t]+(?![ \t\[(<{]|[^\[(<{\n]*[\])>}])"),
    re.compile(rb"(?: {2,}|[ ]*\t)[ \t]*(?![ \t\[(<{])"),
)
_UNIT_GAP = re.compile(rb"[ \t]+(?=[\[(<{])")  # in a row of units
_CHUNK_ROWS = 100_000  # rows whose text is in memory at a time
_HEADER_ROWS = 200  # first rows of a file that are searched for the header
_WIDTH_ROWS = 5  # last of these rows, which show the number of fields of the readings
_UNIT_ROWS = 2  # maximum number of rows of units or notes between names and readings
_UNIT_LENGTH = 24  # maximum number of characters of a field in such a row
_NO_UNITS = ("TS", "RN")  # Campbell loggers' texts in place of units: time stamp, record number


@dataclass
class CsvText:
    """Text file and its layout; rows are line numbers from 1.

    Attributes:
        data: content in UTF-8; runs of blanks that separate fields are replaced by tabs.
        encoding: encoding of the file.
        decimal: decimal mark, point or comma; empty until it is detected.
        header_row: row of the header.
        first_row, offset: row and byte offset of the first line after the header.
        reading_rows: rows of readings (n,).
        notes: sentences about an unusual layout, for the user.
    """

    file: str
    data: bytes
    encoding: str
    header: list[str] = field(default_factory=list)
    separator: str = ","
    decimal: str = ""
    header_row: int = 0
    first_row: int = 0
    offset: int = 0
    reading_rows: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    notes: list[str] = field(default_factory=list)

    @property
    def blank_bytes(self) -> bytes:
        """Return the bytes that a blank line may contain."""
        return b" \r\n" if self.separator == "\t" else b" \t\r\n"

    def to_table(self, *further_notes: str) -> Table:
        """Return a table that loads the columns of readings on demand; `further_notes` follow the file's own notes."""
        return Table(
            self.file,
            tuple(Header.parse(unquote_cell(text)) for text in self.header),
            len(self.reading_rows),
            self.load,
            self.decimal,
            place=lambda index: f"row {self.reading_rows[index]}",
            notes=tuple(f"{self.file}: {note}" for note in (*self.notes, *further_notes)),
        )

    def rows(self) -> Iterable[bytes]:
        """Return an iterator over the lines below the header, in UTF-8."""
        handle = io.BytesIO(self.data)  # without a copy
        handle.seek(self.offset)
        return handle

    def load(self, columns: Mapping[int, bool]) -> dict[int, np.ndarray]:
        """Return the texts (n,) of columns by position; `columns`: position → whether the column is numeric."""
        text_arrays, blank_bytes = {p: list[np.ndarray]() for p in columns}, self.blank_bytes
        lines = (line for line in self.rows() if line.strip(blank_bytes))
        while chunk := list(islice(lines, _CHUNK_ROWS)):
            text = b"".join(chunk).decode()
            text = text.replace("\r\n", "\n").removesuffix("\n")
            if '"' in text:
                rows = csv.reader(text.split("\n"), delimiter=self.separator)
                fields = [field for row in rows for field in row]
            else:
                fields = text.replace("\n", self.separator).split(self.separator)
            for position, is_number in columns.items():
                texts = fields[position :: len(self.header)]
                if not is_number:
                    texts = [unquote_cell(text.strip()) for text in texts]
                text_arrays[position].append(np.array(texts, TEXT))
        return {position: np.concatenate(arrays) for position, arrays in text_arrays.items()}

    def split(self, line: str, row: int, position: str = "", cure: str = "") -> list[str]:
        """Split a line into fields; raise InputError about its `row` for unpaired quotation marks."""
        if '"' not in line:
            return line.split(self.separator)
        try:
            return next(csv.reader([line], delimiter=self.separator, strict=True))
        except csv.Error as error:
            is_long = "limit" in str(error)
            problem = "a field that is too long" if is_long else "an unpaired quotation mark"
            fault = f"has {problem}{position}: {line[:80]!r}"
            raise unusable(self.file, fault, f"Close or remove it{cure}", f"row {row}") from error


def parse_text(data: bytes, file: str, decimal: str = "") -> CsvText:
    """Parse the bytes of a text file: find its encoding, layout and rows of readings.

    Fields are separated by comma, semicolon, tab, bar or blanks. `decimal`: point or comma; empty to detect it: comma
    if the separator is not a comma and a number such as 20,5 cannot contain a thousands separator, else point.

    Raises:
        InputError: an empty file, an unknown encoding, invalid line ends, or rows with another number of fields than
            the header.
    """
    text = CsvText(file, *_decode(data, file), decimal=decimal)
    if text.encoding != "utf-8":
        text.notes.append(f"read as {text.encoding}")
    _read_header(text)
    _scan_lines(text)
    return text


def _decode(data: bytes, file: str) -> tuple[bytes, str]:
    """Decode the bytes of a file; return its content in UTF-8, and the name of its encoding.

    The encoding is windows-1252 if no non-ASCII bytes form a UTF-8 character, since such sequences hardly occur in it.
    A file with characters of both encodings is refused.
    """
    encoding, fault, cure, non_ascii = "utf-8", "", _SAVE_AS_UTF8, set(data.translate(None, _ASCII))
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif non_ascii and non_ascii.isdisjoint(_UNUSED_BYTES) and not _UTF8.search(data):
        encoding = _LEGACY_ENCODING
    if encoding != "utf-8":
        try:
            data = data.decode(encoding).encode()
        except UnicodeError as error:
            raise unusable(file, "is incomplete UTF-16 text", _SAVE_AS_UTF8) from error
    if (offset := data.find(b"\0")) >= 0:
        fault = "contains a zero byte: it is UTF-16 text or no text at all"
    elif match := re.search(rb"\r(?!\n)", data):
        offset = match.start()
        fault = "contains a carriage return without a line feed: lines must end in LF or CR LF"
    elif not data.isascii():
        try:
            data.decode()
        except UnicodeDecodeError as error:
            offset = error.start
            line = data[data.rfind(b"\n", 0, offset) + 1 : offset]
            fault = f"is not UTF-8: byte {len(line) + 1} of the row is 0x{data[offset]:02x}, after "
            fault += f"{line[-20:].decode('utf-8', 'replace')!r}"
            cure += "; do not join files of different encodings"
    if fault:
        row = 1 + data.count(b"\n", 0, offset)
        raise unusable(file, fault, cure, f"row {row}")
    return data, encoding


def _read_header(text: CsvText) -> None:
    """Find the separator and the header of a file, and store them and their rows in `text`.

    The header is the first line that is neither blank nor a '#' comment, unless column names follow below a description
    of the test, or are in a comment. If no header is found, blanks are tried as separators.
    """
    header, lines = None, _read_first_lines(text)
    for include_comments, blanks in product((False, True), (None, *_BLANKS)):
        texts = _read_first_lines(text, include_comments)
        if header := _find_header([_insert_tabs(x.encode(), blanks).decode() for _, x, _ in texts]):
            if blanks:
                text.notes.append("its fields are separated by blanks")
                text.data = _insert_tabs(text.data, blanks)
            lines = _read_first_lines(text, include_comments)
            break
    if not lines:
        expected = "a header 'name [unit], …' and rows of readings were expected"
        raise unusable(text.file, "is empty", expected)
    row, line, end_offset = lines[header.first if header else 0]
    last_row, _, end_offset = lines[header.last] if header else (row, line, end_offset)
    separator = text.separator = header.separator if header else _rank_separators(line)[0]
    check_width(text.file, 1 + line.count(separator))
    fields = line.split(separator), line.split()
    if any(not any(map(math.isnan, map(to_number, texts))) for texts in fields):
        cure = "Add a row of column names, such as 'time [s],temperature [degC],output [deg/s]'"
        fault = f"has no header: its first row, row {row}, contains only numbers"
        raise unusable(text.file, fault, cure)
    text.header = text.split(line, row, position=", in the header")
    if header and (header.last > header.first or len(header.names) != len(text.header)):
        text.header = header.names
    lines_above = lines[: header.first if header else 0]
    rows_above = [_split_fields(line, separator) for _, line, _ in lines_above]
    text.header = _append_units(text.header, _find_labview_units(rows_above))
    text.first_row, text.offset, text.header_row = last_row + 1, end_offset, row
    if rows_above:
        text.notes.append(f"its header is row {row}; the rows above are not read as data")
    if text.first_row - row > 1:
        text.notes.append(f"its units are read from row {row + 1}")


def _read_first_lines(text: CsvText, include_comments: bool = False) -> list[tuple[int, str, int]]:
    """Return (row, text, end offset) of first lines that are neither blank nor, unless `include_comments`, comments."""
    stream, first_lines, row = io.BytesIO(text.data), [], 0
    while len(first_lines) < _HEADER_ROWS and (raw := stream.readline()):
        row += 1
        line = raw.removeprefix(_BYTE_ORDER_MARK if row == 1 else b"").decode("utf-8", "replace")
        line = line.removeprefix("#").lstrip() if include_comments else line
        if line.strip() and not line.startswith("#"):
            first_lines.append((row, line.rstrip("\r\n"), stream.tell()))
    return first_lines


def _find_header(texts: Sequence[str]) -> _HeaderRows | None:
    """Find the header among the first lines of a file; return None if there is none."""
    header_ends = [i for i, text in enumerate(texts) if text.startswith(_LABVIEW_HEADER_END)]
    rows = dict[str, list[list[str]]]()
    for i in range(header_ends[-1] + 1 if header_ends else 0, len(texts)):
        for separator in _rank_separators(texts[i]):
            if separator not in rows:
                rows[separator] = [_split_fields(text, separator) for text in texts]
            if header := _parse_header(rows[separator], i, separator):
                return header
    return None


def _insert_tabs(data: bytes, blanks: re.Pattern[bytes] | None) -> bytes:
    """Strip the lines and replace the blanks that separate fields (matches of `blanks`) by tabs; unchanged for None."""
    if blanks is None:
        return data
    lines = (x.strip(b" \t") for x in data.replace(b"\r\n", b"\n").split(b"\n"))
    return b"\n".join((_UNIT_GAP if x[:1] in b"[(<{" else blanks).sub(b"\t", x) for x in lines)


def _split_fields(line: str, separator: str) -> list[str]:
    """Split a line into fields; return [] for unpaired quotation marks."""
    if '"' not in line:
        return line.split(separator)
    with suppress(csv.Error):
        return next(csv.reader([line], delimiter=separator), [])
    return []


def _find_labview_units(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the columns' units from the rows above the header of a LabVIEW measurement file (.lvm), [] for others."""
    properties = {row[0].strip(): [text.strip() for text in row[1:]] for row in rows}
    if _LABVIEW_HEADER_END not in properties or "Y_Unit_Label" not in properties:
        return []
    return ["s" if "Time" in properties.get("X_Dimension", ()) else "", *properties["Y_Unit_Label"]]


def _rank_separators(line: str) -> list[str]:
    """Return the possible separators of a line, the most frequent first, commas last (numbers may contain them)."""
    marks = filter(line.count, (";", "\t", "|", ","))
    return sorted(marks, key=lambda mark: (mark == ",", -line.count(mark))) or [","]


def _scan_lines(text: CsvText) -> None:
    """Detect decimal commas, find the rows of readings, and raise InputError for a wrong number of fields."""
    separator, expected, blank_bytes = text.separator.encode(), len(text.header), text.blank_bytes
    if not text.decimal and separator != b"," and _DECIMAL_COMMA.search(text.data, text.offset - 1):
        text.decimal = ","
    if text.decimal == ",":
        text.notes.append("its numbers have decimal commas")
    row, blank_rows, ragged_rows = text.first_row - 1, list[int](), list[tuple[int, str, int]]()
    for row, line in enumerate(text.rows(), text.first_row):
        if b'"' in line:
            decoded_line, cure = line.decode(), "; a field cannot contain a line break"
            field_count = len(text.split(decoded_line.rstrip("\r\n"), row, cure=cure))
        elif line.strip(blank_bytes):
            field_count = line.count(separator) + 1
        else:
            blank_rows.append(row)
            continue
        if field_count != expected and len(ragged_rows) < MAX_INVALID_ROWS:
            ragged_rows.append((row, line.decode().strip()[:80], field_count))
    if ragged_rows:
        _refuse_ragged_rows(text, ragged_rows)
    text.reading_rows = np.setdiff1d(np.arange(text.first_row, row + 1), blank_rows)


def _refuse_ragged_rows(text: CsvText, ragged_rows: Sequence[tuple[int, str, int]]) -> None:
    """Raise InputError for rows (row, text, number of fields) with more or fewer fields than the header."""
    _, line, field_count = ragged_rows[0]
    expected_count = len(text.header)
    comma = text.separator == "," and field_count > expected_count
    cure = "If its numbers have decimal commas, export them with decimal points. " * comma
    if any(expected_count < n for _, _, n in ragged_rows):
        cure += "If the first lines only describe the test, begin each with #. "
    cure += "Give every row one field for each column"
    fault = f"has {field_count} field{'s' * (field_count != 1)}, but the header has {expected_count}: {line!r}"
    places = tuple(f"row {row}" for row, _, _ in ragged_rows)
    Objections([Objection(text.file, fault, cure=cure, places=places)]).refuse()


class _HeaderRows(NamedTuple):
    """First and last header row (indices), names of the columns with units in brackets, and the separator."""

    first: int
    last: int
    names: list[str]
    separator: str


def _parse_header(rows: Sequence[Sequence[str]], first: int, separator: str) -> _HeaderRows | None:
    """Return the header if it begins at `rows[first]`, else None; `rows`: fields of each row that is not blank.

    Names are text; rows of readings, with as many fields and at least one number or date, follow directly or after rows
    of units. Rows of readings may end in an additional empty field.
    """
    names = [name.strip() for name in rows[first]]
    if len(names) < 2 or any(map(_is_reading, names)) or sum(map(bool, names)) < 2:
        return None
    last_rows = [row for row in rows[first + 1 :][-_WIDTH_ROWS:] if any(map(_is_reading, row))]
    if not last_rows or sum(map(bool, names)) < min(sum(map(bool, row)) for row in last_rows):
        return None
    width = Counter(map(len, last_rows)).most_common(1)[0][0]
    ends_empty = all(not row[-1].strip() for row in last_rows if len(row) == width)
    if width == len(names) - 1 and names[-1].lower() in ("", "comment"):
        names = names[:-1]
    elif width == len(names) + 1 and ends_empty:
        names = [*names, ""]
    if width != len(names):
        return None
    start = first + 1
    last_start = min(len(rows), first + 2 + _UNIT_ROWS)
    while start < last_start and _are_units(rows[start], len(names)):
        start += 1
    if start == len(rows) or len(rows[start]) != width or not any(map(_is_reading, rows[start])):
        return None
    units = rows[first + 1] if start > first + 1 else ()
    return _HeaderRows(first, start - 1, _append_units(names, units), separator)


def _is_reading(text: str) -> bool:
    """Return whether a field is a number (not a mark of a missing reading) or a date."""
    with suppress(ValueError):
        float(text.strip().replace(",", ".", 1))
        return not is_missing(text)
    return bool(parse_date(text))


def _are_units(row: Sequence[str], width: int) -> bool:
    """Return whether a row may contain units: short texts, none of them a reading."""
    texts = [text.strip() for text in row if text.strip()]
    is_short = all(len(t) <= _UNIT_LENGTH and (t[0] in "[(" or not t.endswith("]")) for t in texts)
    has_width = abs(len(row) - width) <= 1 and len(texts) >= 2
    readings = (t for t in texts if _is_reading(t) or (is_missing(t) and t != "-"))
    return has_width and is_short and not any(readings)


def _append_units(names: Sequence[str], units: Sequence[str]) -> list[str]:
    """Append units in brackets to the names that have none: `name [unit]`."""
    headers = list(names)
    for i, (name, unit) in enumerate(zip(names, map(str.strip, units), strict=False)):
        if unit[:1] + unit[-1:] in ("()", "[]", "<>", "{}"):
            unit = unit[1:-1].strip()
        if name and unit and unit not in _NO_UNITS and not name.endswith("]"):
            headers[i] = f"{name} [{unit}]"
    return headers


def write(
    columns: Mapping[str, np.ndarray], units: Mapping[str, str | None], path: str | Path
) -> Path:
    """Write readings to a .csv file, numbers with all digits and NaN as empty cells; return the path.

    `units`: column → unit of numbers, None for labels.

    Raises:
        InputError: the suffix is not .csv, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".csv":
        raise InputError(
            f"{path.name!r}: readings are written as CSV: give a name that ends in .csv"
        )
    names = [name if units[name] is None else f"{name} [{units[name]}]" for name in columns]
    cells = (
        map(quote_cell, values.tolist())
        if values.dtype.kind in "OU"
        else ("" if value != value else value for value in values.tolist())
        for values in columns.values()
    )
    with (
        replace_user_file(path) as partial,
        partial.open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(map(quote_cell, names))
        writer.writerows(zip(*cells, strict=True))
    return path
