"""Raw tables: columns of a file by the names and units of its header, not yet matched; and its problems.

Every format is converted to this, so that matching and checks are one code. Objections are collected before any is
reported: one as a sentence, several as a list.
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

_NAMED_ROWS = 3  # that a message names; the others are counted


@dataclass(frozen=True)
class Objection:
    """One problem of a file that prevents its use.

    Attributes:
        file: its name; empty where `came` is the whole message.
        came: the fault, such as "reads 'x'", as a verb goes on behind the name of the column or file.
        expected: what was expected, such as "a number in °/s".
        cure: what to do, in words.
        option: of the command line that does it, quoted for a shell; empty if only an edit helps.
        column: its header; empty if it concerns no single column.
        rows: indices of the readings concerned; empty if it concerns no single reading.
        places: the first of them as an editor counts, "row 5".
    """

    file: str
    came: str
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
        if self.option:  # several stand in brackets already
            cure += f" {self.option}" if self.option[0] == "(" else f" ({self.option})"
        return f"{where} " * bool(self.file) + f"{self.came}{others}{expected}{cure}"


class Objections(list[Objection]):
    """Objections of some files, in the order in which they were found."""

    def refuse(self) -> None:
        """Raise InputError, which carries them as `problems`, if there is a problem."""
        if self:
            raise InputError(_problems_text(self), tuple(self))

    @contextmanager
    def collecting(self) -> Iterator[None]:
        """Collect the InputError of a check inside, in place of raising it."""
        try:
            yield
        except InputError as error:
            self += error.problems or [Objection("", str(error))]


def unusable(file: str, came: str, cure: str = "", place: str = "") -> InputError:
    """Return the InputError of a whole file, or of its row at `place`; `came`, `cure`: as in `Objection`."""
    places = (place,) if place else ()
    problem = Objection(file, came, cure=cure[:1].upper() + cure[1:], places=places)
    return InputError(str(problem), (problem,))


def option(name: str, value: str) -> str:
    """Format an option of the command line for a shell: --columns 'output=gz (deg/s)'."""
    return f"{name}{'=' if value.startswith('-') else ' '}{shlex.quote(value)}"


def _problems_text(problems: Sequence[Objection]) -> str:
    """Format one problem as a sentence, several as a list, and the options that cure them as one line to copy."""
    if len(problems) == 1:
        return str(problems[0])
    files, groups = {p.file for p in problems if p.file}, dict[Any, list[Objection]]()
    for p in problems:  # the same problem of several files is reported once
        groups.setdefault((p.column, p.came, p.expected, p.cure, p.option), []).append(p)
    lines = [
        f"{same[0]}" + f" (and {len(same) - 1} more like it)" * (len(same) > 1)
        for same in groups.values()
    ]
    of = f"{next(iter(files))!r}" if len(files) == 1 else f"{len(files)} files"
    options = " ".join(dict.fromkeys(p.option for p in problems if p.option))
    by_hand = "with the rest mended and " if not all(p.option for p in problems) else "with "
    suggestion = f"\n\n{by_hand}these options, if they are meant: {options}" * bool(options)
    count = f"{len(lines)} problem{'s' * (len(lines) > 1)} with {of}"
    return "\n".join([f"{count}\n", *(f"- {line}" for line in lines)]) + suggestion


ROW = "reading"  # the one dimension of readings
MAX_COLUMNS = 100_000  # a file of more has readings in columns, or is no table


def bytes_text(size: float) -> str:
    """Format a number of bytes for people: 180 bytes, 2.1 GB."""
    return f"{size / 1e9:.3g} GB" if size >= 1e8 else f"{size:,.0f} bytes"


def in_one_line(text: str) -> str:
    """Replace line breaks and other control characters of a name by spaces."""
    parts = (part.strip() for part in re.split(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+", text))
    return " ".join(part for part in parts if part)


@dataclass(frozen=True)
class Header:
    """A column as the file names it: `raw` is all of it, name and unit its parts."""

    raw: str
    name: str
    unit: str | None

    @classmethod
    def parse(cls, raw: str, unit: str | None = None) -> Header:
        """Split `name [unit]`; a separately given unit counts if the name has none.

        Line breaks and invisible characters are replaced by spaces.
        """
        raw = in_one_line(raw)
        name, bracket, unit_text = raw.rpartition("[")
        if bracket and name.strip() and unit_text.endswith("]") and unit_text.count("]") == 1:
            return cls(raw, name.rstrip(), unit_text[:-1].strip())
        return cls(raw, raw, unit)


UNIT_SEARCH_CHARACTERS = 80  # of a header, from its end, in which a unit is searched
BRACKETS = [
    re.compile(rf"(.+?)[\s_,:/]*\{a}\s*(.+?)\s*\{b}", re.DOTALL)
    for a, b in ("()", "[]", "{}", "<>")
]
_BEHIND_SLASH = re.compile(r"([^/]*?[^/\s])\s*/\s*(.+)", re.DOTALL)
_BEHIND_COMMA = re.compile(r"(.+?)\s*[,:;]\s*(.+)", re.DOTALL)
_BEHIND_IN = re.compile(r"(.+?)\s+in\s+(.+)", re.DOTALL)
# No unit begins so: "Thermo 1 (°F)"; one may be 1/K.
_NUMBERED = re.compile(r"[(\[{<]|\d+(?![\d/])")


@lru_cache(maxsize=4096)  # each is called for many columns
def readings_of(header: Header) -> tuple[Header, ...]:
    """Return every split of a header into a name and, if it has one, the text of a unit; the plainest first."""
    if header.unit:
        return (header,)
    splits = [header]
    before, end = header.raw[:-UNIT_SEARCH_CHARACTERS], header.raw[-UNIT_SEARCH_CHARACTERS:]
    for pattern in (*BRACKETS, _BEHIND_SLASH, _BEHIND_COMMA, _BEHIND_IN):
        if parts := pattern.fullmatch(end):
            unit = parts[2].strip()
            unit = unit[1:-1] if unit[:1] + unit[-1:] == "()" else unit.removeprefix("in ")
            splits.append(Header(header.raw, (before + parts[1]).strip(), unit))
    for gap in re.finditer(r"[_\s.]+", end):
        name, unit = before + end[: gap.start()], end[gap.end() :]
        if name and unit and not _NUMBERED.match(unit):
            splits.append(Header(header.raw, name, unit))
    return tuple(splits)


def called(headers: Sequence[Header], name: str) -> int | None:
    """Return position of the header that a user means: by all of it, its name, or its name in one of its readings."""
    ways = [({h.raw}, {h.name}, {r.name for r in readings_of(h)}) for h in headers]
    for names in zip(*ways, strict=True):
        positions = [i for i, forms in enumerate(names) if name in forms]
        if len(positions) == 1:
            return positions[0]
    return None


@dataclass(frozen=True)
class Table:
    """An opened file.

    Attributes:
        file: name for messages.
        headers: its columns, in order.
        rows: number of readings.
        load: function from position of a column → whether it is a number, to its cells.
        sha256: of the bytes; "" for arrays.
        place: index of a reading → its row, "row 12".
        notes: unusual ways in which it was read, a sentence each.
    """

    file: str
    headers: tuple[Header, ...]
    rows: int
    load: Callable[[Mapping[int, bool]], dict[int, Cells]]
    sha256: str = ""
    place: Callable[[int], str] = lambda index: f"row {index + 1}"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise InputError for no readings, or one name for two columns."""
        if self.rows < 1:
            cure = "give a file with at least one row without missing values"
            raise unusable(self.file, "holds no readings", cure)
        counts = Counter(header.name for header in self.headers if header.name)
        for name, count in counts.items():
            if count > 1:
                came = f"has {count} columns called {name!r}: which one is meant cannot be told"
                raise unusable(self.file, came, "Rename or remove all but one")

    @classmethod
    def of_columns(
        cls,
        file: str,
        columns: Mapping[str, np.ndarray],
        units: Mapping[str, str | None] = MappingProxyType({}),
        **fields: Any,
    ) -> Table:
        """Make a table of columns of one length: header → values; `units` are of headers without one."""
        headers = tuple(Header.parse(name, units.get(name)) for name in columns)
        arrays = list(columns.values())
        rows = len(arrays[0]) if arrays else 0

        def load(requested: Mapping[int, bool]) -> dict[int, Cells]:
            return {position: to_cells(arrays[position], n) for position, n in requested.items()}

        return cls(file, headers, rows, load, **fields)

    def objection(
        self,
        column: str,
        came: str,
        expected: str = "",
        cure: str = "",
        option: str = "",
        *,
        rows: Sequence[int] | np.ndarray = (),
    ) -> Objection:
        """Make an objection to a column, given by its header; to some of its readings, if `rows` are given."""
        at = tuple(int(row) for row in rows)
        places = tuple(map(self.place, at[:_NAMED_ROWS]))
        return Objection(self.file, came, expected, cure, option, column, at, places)

    def take(self, rows: np.ndarray) -> Table:
        """Select rows by index."""

        def load(requested: Mapping[int, bool]) -> dict[int, Cells]:
            return {position: cells.take(rows) for position, cells in self.load(requested).items()}

        def place(index: int) -> str:
            return self.place(int(rows[index]))

        return replace(self, rows=len(rows), load=load, place=place)


def load_whole(table: Table, wanted: Mapping[int, bool]) -> dict[int, Cells]:
    """Load columns (position → whether of numbers); raise InputError where one has not the file's number of rows."""
    columns = table.load(wanted)
    for position, cells in columns.items():
        if (count := len(cells.values)) != table.rows:
            came = f"says that it holds {table.rows} rows, column {table.headers[position].raw!r} has {count}"
            cure = "Export it again"
            raise unusable(table.file, f"{came}: it is damaged, or changed while it was read", cure)
    return columns


def refuse_many(file: str, columns: int) -> None:
    """Raise InputError for a table of too many columns, before their names are parsed."""
    if columns > MAX_COLUMNS:
        came = f"has {columns:,} columns, at most {MAX_COLUMNS:,} are read"
        cure = "is one row of it meant as a column? Write one row for each reading"
        raise unusable(file, came, cure)


def refuse_large(file: str, rows: int, columns: int, max_bytes: int) -> None:
    """Raise InputError for a table that is too wide, or takes too much memory."""
    refuse_many(file, columns)
    if (size := 8 * rows * columns) > max_bytes:
        came = f"holds {rows} rows of {columns} columns, {bytes_text(size)} in memory"
        cure = "Average or split it, or raise max_bytes in Python"
        raise unusable(file, f"{came}; the limit is {bytes_text(max_bytes)}", cure)


@contextmanager
def as_format(file: str, name: str) -> Iterator[None]:
    """Convert any exception of a library on a broken file to an InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        first = (str(error).strip().splitlines() or [type(error).__name__])[0][:200].rstrip(".")
        cure = "Is it what its suffix says, and whole?"
        raise unusable(file, f"cannot be read as {name}: {first}", cure) from error
