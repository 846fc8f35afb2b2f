"""Raw tables, the common form of all file formats (columns with names and units from headers); problems of files.

Problems (objections) are collected before any is reported: one as a sentence, several as a list.
"""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from bayescal._core.errors import InputError
from bayescal._tables.cells import Cells, to_cells

_MAX_ROW_LABELS = 3  # row labels in a message; further rows are counted


@dataclass(frozen=True)
class Objection:
    """One problem of a file that prevents its use.

    Attributes:
        file: name of the file; empty if `fault` is the whole message.
        fault: predicate of a sentence whose subject is the column or file, such as "reads 'x'".
        expected: the expected content, such as "a number in °/s".
        cure: the remedy, as a sentence.
        option: command-line option that is the remedy, quoted for a shell; empty if the file must be edited.
        column: header of the column; empty if the problem concerns no single column.
        rows: indices of the readings concerned; empty if it concerns no single reading.
        places: labels of the first of these rows, "row 5", counted from 1 in the file.
    """

    file: str
    fault: str
    expected: str = ""
    cure: str = ""
    option: str = ""
    column: str = ""
    rows: tuple[int, ...] = ()
    places: tuple[str, ...] = ()

    def __str__(self) -> str:
        where = f"{self.places[0]} of {self.file!r}" if self.places else f"{self.file!r}"
        where += f", column {self.column!r}:" * bool(self.column)
        expected = f"; expected: {self.expected}" * bool(self.expected)
        count = max(len(self.rows), len(self.places))
        others = f" (and in {count - 1} more)" * (count > 1)
        cure = f". {self.cure}" * bool(self.cure)
        if self.option:  # several are in brackets already
            cure += f" {self.option}" if self.option[0] == "(" else f" ({self.option})"
        return f"{where} " * bool(self.file) + f"{self.fault}{others}{expected}{cure}"


class Objections(list[Objection]):
    """List of objections to files, in the order of detection."""

    def refuse(self) -> None:
        """Raise InputError, with the objections as its `problems`, if there are any."""
        if self:
            raise InputError(_format_problems(self), tuple(self))

    @contextmanager
    def collecting(self) -> Iterator[None]:
        """Append the problems of an InputError raised in the `with` block, and suppress the error."""
        try:
            yield
        except InputError as error:
            self += error.problems or [Objection("", str(error))]


def unusable(file: str, fault: str, cure: str = "", place: str = "") -> InputError:
    """Return an InputError about a file, or its row `place` ("row 5"); `fault` and `cure` as in `Objection`."""
    places = (place,) if place else ()
    problem = Objection(file, fault, cure=cure[:1].upper() + cure[1:], places=places)
    return InputError(str(problem), (problem,))


def option(name: str, value: str) -> str:
    """Format a command-line option for a shell: --columns 'output=gz (deg/s)'."""
    return f"{name}{'=' if value.startswith('-') else ' '}{shlex.quote(value)}"


def _format_problems(problems: Sequence[Objection]) -> str:
    """Format one problem as a sentence, several as a list and a line of all options that resolve them."""
    if len(problems) == 1:
        return str(problems[0])
    files, groups = {p.file for p in problems if p.file}, dict[Any, list[Objection]]()
    for p in problems:  # equal problems of several files are reported once
        groups.setdefault((p.column, p.fault, p.expected, p.cure, p.option), []).append(p)
    lines = [
        f"{group[0]}" + f" (and {len(group) - 1} more like it)" * (len(group) > 1)
        for group in groups.values()
    ]
    files_text = f"{next(iter(files))!r}" if len(files) == 1 else f"{len(files)} files"
    options = " ".join(dict.fromkeys(p.option for p in problems if p.option))
    verb = "use" if all(p.option for p in problems) else "correct the others and use"
    suggestion = f"\n\n{verb} these options, if they apply: {options}" * bool(options)
    count = f"{len(lines)} problem{'s' * (len(lines) > 1)} with {files_text}"
    return "\n".join([f"{count}\n", *(f"- {line}" for line in lines)]) + suggestion


ROW = "reading"  # name of the dimension of readings
MAX_COLUMNS = 100_000  # a file with more is transposed, or not a table


def format_bytes(size: float) -> str:
    """Format a number of bytes: "180 bytes", "2.1 GB"."""
    return f"{size / 1e9:.3g} GB" if size >= 1e8 else f"{size:,.0f} bytes"


def to_one_line(text: str) -> str:
    """Replace line breaks and other control characters of a name by spaces."""
    lines = (line.strip() for line in re.split(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+", text))
    return " ".join(line for line in lines if line)


@dataclass(frozen=True)
class Header:
    """Header of a column: its text (`raw`), and the parts of it, name and unit (None if there is none)."""

    raw: str
    name: str
    unit: str | None

    @classmethod
    def parse(cls, raw: str, unit: str | None = None) -> Header:
        """Parse a header `name [unit]`, with `unit` if it states none; control characters are replaced by spaces."""
        raw = to_one_line(raw)
        name, bracket, unit_text = raw.rpartition("[")
        if bracket and name.strip() and unit_text.endswith("]") and unit_text.count("]") == 1:
            return cls(raw, name.rstrip(), unit_text[:-1].strip())
        return cls(raw, raw, unit)


UNIT_SEARCH_CHARACTERS = 80  # last characters of a header that are searched for a unit
BRACKETS = [
    re.compile(rf"(.+?)[\s_,:/]*\{a}\s*(.+?)\s*\{b}", re.DOTALL)
    for a, b in ("()", "[]", "{}", "<>")
]
_UNIT_AFTER_SLASH = re.compile(r"([^/]*?[^/\s])\s*/\s*(.+)", re.DOTALL)
_UNIT_AFTER_COMMA = re.compile(r"(.+?)\s*[,:;]\s*(.+)", re.DOTALL)
_UNIT_AFTER_IN = re.compile(r"(.+?)\s+in\s+(.+)", re.DOTALL)
# Texts that begin no unit, as in "Thermo 1 (°F)"; 1/K is a unit.
_NO_UNIT = re.compile(r"[(\[{<]|\d+(?![\d/])")


@lru_cache(maxsize=4096)  # one header is compared with many columns
def list_splits(header: Header) -> tuple[Header, ...]:
    """Return all possible splits of a header into name and unit, first the header itself if it has no unit."""
    if header.unit:
        return (header,)
    splits = [header]
    prefix, suffix = header.raw[:-UNIT_SEARCH_CHARACTERS], header.raw[-UNIT_SEARCH_CHARACTERS:]
    for pattern in (*BRACKETS, _UNIT_AFTER_SLASH, _UNIT_AFTER_COMMA, _UNIT_AFTER_IN):
        if match := pattern.fullmatch(suffix):
            unit = match[2].strip()
            unit = unit[1:-1] if unit[:1] + unit[-1:] == "()" else unit.removeprefix("in ")
            splits.append(Header(header.raw, (prefix + match[1]).strip(), unit))
    for gap in re.finditer(r"[_\s.]+", suffix):
        name, unit = prefix + suffix[: gap.start()], suffix[gap.end() :]
        if name and unit and not _NO_UNIT.match(unit):
            splits.append(Header(header.raw, name, unit))
    return tuple(splits)


def find_header(headers: Sequence[Header], name: str) -> int | None:
    """Return the position of the only header whose text, name or split name is `name`; None without such a header."""
    names_by_rule = [({h.raw}, {h.name}, {r.name for r in list_splits(h)}) for h in headers]
    for names in zip(*names_by_rule, strict=True):
        positions = [i for i, header_names in enumerate(names) if name in header_names]
        if len(positions) == 1:
            return positions[0]
    return None


@dataclass(frozen=True)
class Table:
    """Table of an opened file, whose columns are loaded on demand.

    Attributes:
        file: name for messages.
        headers: headers of the columns, in order.
        rows: number of readings.
        load: function that loads columns: {position: whether numeric} → {position: values or texts (n,)}.
        decimal: decimal mark of numbers in text.
        sha256: SHA-256 of the file's bytes; "" for arrays.
        place: index of a reading → its row label, "row 12".
        notes: sentences about an unusual layout of the file.
    """

    file: str
    headers: tuple[Header, ...]
    rows: int
    load: Callable[[Mapping[int, bool]], dict[int, np.ndarray]]
    decimal: str = "."
    sha256: str = ""
    place: Callable[[int], str] = lambda index: f"row {index + 1}"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise InputError for a table without readings, or with two columns of the same name."""
        if self.rows < 1:
            cure = "give a file with at least one row without missing values"
            raise unusable(self.file, "contains no readings", cure)
        counts = Counter(header.name for header in self.headers if header.name)
        for name, count in counts.items():
            if count > 1:
                fault = f"has {count} columns called {name!r}, which is ambiguous"
                raise unusable(self.file, fault, "Rename or remove all but one")

    @classmethod
    def from_columns(
        cls,
        file: str,
        columns: Mapping[str, np.ndarray],
        units: Mapping[str, str | None] = MappingProxyType({}),
        **fields: Any,
    ) -> Table:
        """Create a table from columns of equal length, header → values; `units` apply to headers without a unit."""
        headers = tuple(Header.parse(name, units.get(name)) for name in columns)
        arrays = list(columns.values())
        rows = len(arrays[0]) if arrays else 0
        return cls(
            file, headers, rows, lambda requested: {i: arrays[i] for i in requested}, **fields
        )

    def objection(
        self,
        column: str,
        fault: str,
        expected: str = "",
        cure: str = "",
        option: str = "",
        *,
        rows: Sequence[int] | np.ndarray = (),
    ) -> Objection:
        """Return an objection to a column, or to its readings `rows` (indices); other arguments as in `Objection`."""
        indices = tuple(int(row) for row in rows)
        places = tuple(map(self.place, indices[:_MAX_ROW_LABELS]))
        return Objection(self.file, fault, expected, cure, option, column, indices, places)

    def take(self, rows: np.ndarray) -> Table:
        """Return a table of the readings with the indices `rows`, in this order."""

        def load(requested: Mapping[int, bool]) -> dict[int, np.ndarray]:
            return {position: values[rows] for position, values in self.load(requested).items()}

        def place(index: int) -> str:
            return self.place(int(rows[index]))

        return replace(self, rows=len(rows), load=load, place=place)


def load_whole(table: Table, requested: Mapping[int, bool]) -> dict[int, Cells]:
    """Return cells of columns by position, given whether each is numeric; InputError: a wrong number of rows."""
    columns = table.load(requested)
    for position, values in columns.items():
        if (count := len(values)) != table.rows:
            fault = f"declares {table.rows} rows, but column {table.headers[position].raw!r} has {count}"
            cure = "Export it again"
            fault += ": the file is damaged, or changed while it was read"
            raise unusable(table.file, fault, cure)
    return {p: to_cells(columns[p], is_number, table.decimal) for p, is_number in requested.items()}


def check_width(file: str, columns: int) -> None:
    """Raise InputError for a table of more than `MAX_COLUMNS` columns, before their names are parsed."""
    if columns > MAX_COLUMNS:
        fault = f"has {columns:,} columns, more than the maximum of {MAX_COLUMNS:,}"
        cure = "Is the table transposed? Write one row for each reading"
        raise unusable(file, fault, cure)


def check_size(file: str, rows: int, columns: int, max_bytes: int) -> None:
    """Raise InputError for a table of too many columns, or of more than `max_bytes` as float64."""
    check_width(file, columns)
    if (size := 8 * rows * columns) > max_bytes:
        fault = f"contains {rows} rows of {columns} columns, {format_bytes(size)} in memory"
        cure = "Average or split it, or raise max_bytes in Python"
        raise unusable(file, f"{fault}; the limit is {format_bytes(max_bytes)}", cure)


@contextmanager
def as_format(file: str, name: str) -> Iterator[None]:
    """Convert exceptions that a library raises in the `with` block to an InputError: not of the format `name`."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        cure = "Give the file the suffix of its format, or copy it again from its source"
        fault = f"cannot be read as {name}: it is of another format, damaged or incomplete"
        raise unusable(file, fault, cure) from error
