"""Tables and lines of a result, from which its text, its HTML and its numbers are made.

A table is columns over rows of plain data, as in a result's JSON, so that a result in memory and one that was read
from a file are the same table on the screen, in a report and in the workbench.
"""

from __future__ import annotations

import re
import textwrap
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, groupby, product, zip_longest
from typing import TYPE_CHECKING, Any

from bayescal._core.formatting import WIDTH
from bayescal._core.quoting import html_text

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

MAX_REPR_CHARACTERS = 200  # in one line


@dataclass(frozen=True)
class TableColumn:
    """One column."""

    head: str  # above it, without its unit
    # key of the row, or function of the row, that gives the value
    of: str | Callable[[Any], Any] = ""
    # format of the value for people; None for a column that is only in the numbers, not printed
    show: Callable[[Any], str] | None = str
    unit: str = ""  # of all its values, as people read it; stands behind the head
    left: bool | None = None  # whether it is flush left; None: where it is the first
    name: str | None = None  # of its numbers; that of `head` if None, and "" for what has none

    def value(self, row: Any) -> Any:
        """Return the value of a row in this column."""
        return row[self.of or self.head] if isinstance(self.of, str) else self.of(row)


@dataclass(frozen=True)
class ResultTable:
    """Columns over rows of plain data.

    Attributes:
        columns: what is shown of a row, in order; the first names the row.
        rows: a mapping each.
        fold: if not zero, the last column is flush left, and in text folded to this width or to what is left of the
            page, whichever is more.
    """

    columns: tuple[TableColumn, ...]
    rows: Sequence[Any]
    fold: int = 0

    @property
    def printed_columns(self) -> list[TableColumn]:
        """Return the columns that are printed."""
        return [c for c in self.columns if c.show is not None]

    @property
    def head(self) -> list[str]:
        return [f"{c.head} [{c.unit}]" if c.unit else c.head for c in self.printed_columns]

    @property
    def cells(self) -> list[list[str]]:
        """Return the rows formatted for people; a line break in a cell stays one."""
        return [[c.show(c.value(row)) for c in self.printed_columns if c.show] for row in self.rows]

    @property
    def flush_left(self) -> list[bool]:
        flush = [i == 0 if c.left is None else c.left for i, c in enumerate(self.printed_columns)]
        return [*flush[:-1], flush[-1] or self.fold > 0]

    def only(self, *heads: str) -> ResultTable:
        """Select columns, in this order."""
        printed = {c.head: c for c in self.printed_columns}
        return replace(self, columns=tuple(printed[head] for head in heads), fold=0)

    def data(self) -> dict[str, list[Any]]:
        """Return its numbers in full: name of a column → one value a row."""
        named = {c.head if c.name is None else c.name: c for c in self.columns}
        return {n: [column.value(row) for row in self.rows] for n, column in named.items() if n}

    def __str__(self) -> str:
        """Format as text: columns under a ruled head."""
        return _text(self.head, self.cells, self.flush_left, self.fold)

    def html(self) -> str:
        """Format as HTML, everything in it escaped."""
        sides = ["left" if flush else "right" for flush in self.flush_left]

        def row(cells: list[str], tag: str) -> str:
            pairs = zip(map(_html_lines, cells), sides, strict=True)
            elements = (f'<{tag} style="text-align: {side}">{cell}</{tag}>' for cell, side in pairs)
            return f"<tr>{''.join(elements)}</tr>"

        body = "".join(row(cells, "td") for cells in self.cells)
        return f"<table><thead>{row(self.head, 'th')}</thead><tbody>{body}</tbody></table>"


def plain_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1, fold: int = 0
) -> ResultTable:
    """Make a table of text cells; the first `left` columns are flush left."""
    columns = (
        TableColumn(name, lambda row, i=i: row[i], left=i < left) for i, name in enumerate(head)
    )
    return ResultTable(tuple(columns), [*rows], fold)


def _text(head: list[str], rows: list[list[str]], flush_left: Sequence[bool], fold: int = 0) -> str:
    """Format a table; one wider than the page has its heads and then its widest column of texts folded."""
    split_rows = [[cell.split("\n") for cell in row] for row in (head, *rows)]
    split_head, *body = split_rows
    widths = [max(map(_width, chain(*column))) for column in zip(*split_rows, strict=True)]
    room = WIDTH - 2 * (len(head) - 1)
    if fold:
        last = widths[-1] = min(widths[-1], max(room - sum(widths[:-1]), fold))
        for row in split_rows:
            parts = ([t] if _width(t) <= last else textwrap.wrap(t, last) for t in row[-1])
            row[-1] = [*chain(*parts)]
    least = [max((_width(t) for row in body for t in row[i]), default=0) for i in range(len(head))]
    by_gain = sorted(range(len(head)), key=lambda i: least[i] - widths[i])
    for lines, i in product((2, 3, 4), by_gain):
        if sum(widths) > room:
            folds = (_folded_name(head[i], w) for w in range(least[i], widths[i] + 1))
            split_head[i] = next(fold for fold in folds if len(fold) <= lines)
            widths[i] = max(least[i], *map(_width, split_head[i]))
    if sum(widths) > room:
        i = max(range(max(1, len(head) - 1)), key=lambda i: flush_left[i] * widths[i])
        for row in split_rows:
            row[i] = [*chain(*(_folded_name(t, widths[i] + room - sum(widths)) for t in row[i]))]
        widths[i] = max(_width(t) for row in split_rows for t in row[i])
    height = max(map(len, split_head))
    split_rows[0] = [[""] * (height - len(texts)) + texts for texts in split_head]
    lines = []
    for row in split_rows:
        for texts in zip_longest(*row, fillvalue=""):
            pads = [" " * (width - _width(t)) for t, width in zip(texts, widths, strict=True)]
            parts = zip(texts, pads, flush_left, strict=True)
            lines.append("  ".join(t + p if flush else p + t for t, p, flush in parts).rstrip())
    return "\n".join([*lines[:height], "  ".join("─" * w for w in widths), *lines[height:]])


def _folded_name(text: str, width: int) -> list[str]:
    """Fold a name to a width where it can be: at blanks, before a dot or bracket, behind a hyphen."""
    lines = [""]
    for part in re.split(r"(?= (?![^(]*\)))|(?=[.\[(])|(?<=\w-)", text):
        if _width(lines[-1] + part) > width and lines[-1]:
            lines.append("")
        lines[-1] += part if lines[-1] else part.lstrip()
    return [line.rstrip() for line in lines]


def _width(text: str) -> int:
    return sum(not unicodedata.combining(c) for c in text)  # the mark over a letter takes none


class Printed:
    """A result that prints itself.

    A class defines `_brief`, a summary in a few words, and `_parts`, the lines and tables that it is printed as. Its
    text, its HTML in a notebook and its numbers are made of these, so that all agree.
    """

    def _brief(self) -> str:
        raise NotImplementedError

    def _parts(self) -> Sequence[str | ResultTable]:
        raise NotImplementedError

    def _columns(self) -> Mapping[str, Sequence[Any]]:
        """Return the numbers behind its table: name → one value a row, the first naming the row."""
        return next(part for part in self._parts() if isinstance(part, ResultTable)).data()

    def __str__(self) -> str:
        return "\n".join(map(str, self._parts()))

    def __repr__(self) -> str:
        brief = textwrap.shorten(self._brief(), MAX_REPR_CHARACTERS, placeholder=" …")
        return f"<{type(self).__name__}: {brief}>"

    def _repr_html_(self) -> str:
        return as_html(self._parts())

    def to_pandas(self) -> pd.DataFrame:
        """Return the printed table with all digits as a `pandas.DataFrame`, its rows by name."""
        import pandas as pd  # only where it is needed

        frame = pd.DataFrame(dict(self._columns()))
        return frame.set_index(frame.columns[0])

    def to_xarray(self) -> xr.Dataset:
        """Return the printed table as an `xarray.Dataset` along the rows' names."""
        return self.to_pandas().to_xarray()


def as_html(parts: Sequence[str | ResultTable]) -> str:
    """Format lines and tables as HTML, everything in them escaped."""
    blocks = list[str]()
    for tables, some in groupby(parts, key=lambda part: isinstance(part, ResultTable)):
        if tables:
            blocks += [part.html() for part in some if isinstance(part, ResultTable)]
        elif text := "\n".join(map(str, some)).strip("\n"):
            blocks.append(f"<p>{_html_lines(text)}</p>")
    return "".join(blocks)


def _html_lines(text: str) -> str:
    return html_text(text).replace("\n", "<br>")
