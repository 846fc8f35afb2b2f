"""Tables and lines of results, the common source of their text, HTML and numbers.

A table consists of columns evaluated on rows of plain data, as in a result's JSON, so that results in memory and from a
file give the same table on the screen, in a report and in the workbench.
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
from bayescal._core.quoting import escape_html
from bayescal._core.renamed import renamed

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

MAX_REPR_CHARACTERS = 200  # length of the one-line summary


@dataclass(frozen=True)
class TableColumn:
    """Column of a table: heading, value and format."""

    heading: str  # without the unit
    source: str | Callable[[Any], Any] = ""  # key in a row, or function of it; "": the heading
    format: Callable[[Any], str] | None = str  # of the value; None for a column not printed
    unit: str = ""  # formatted unit of all values, printed after the heading
    left: bool | None = None  # whether it is aligned left; None: only as the first column
    name: str | None = None  # key in the data; None: the heading; "": not in the data

    def value(self, row: Any) -> Any:
        """Return the column's value for a row."""
        source = self.source or self.heading
        return row[source] if isinstance(source, str) else source(row)


@dataclass(frozen=True)
class ResultTable:
    """Table of columns, which are evaluated on rows of plain data.

    Attributes:
        columns: the columns, in order; the first one names the row.
        rows: the rows, each a mapping or a sequence.
        width: minimum width, characters, to which the last column may be wrapped as text; it is aligned left.
            0 for a column that is not wrapped.
    """

    columns: tuple[TableColumn, ...]
    rows: Sequence[Any]
    width: int = 0

    @property
    def printed_columns(self) -> list[TableColumn]:
        """Return the columns that are printed."""
        return [c for c in self.columns if c.format is not None]

    @property
    def headings(self) -> list[str]:
        return [f"{c.heading} [{c.unit}]" if c.unit else c.heading for c in self.printed_columns]

    @property
    def cells(self) -> list[list[str]]:
        """Return the formatted cells of each row; they may contain line breaks."""
        return [[c.format(c.value(row)) for c in self.columns if c.format] for row in self.rows]

    @property
    def left_flags(self) -> list[bool]:
        is_left = [i == 0 if c.left is None else c.left for i, c in enumerate(self.printed_columns)]
        return [*is_left[:-1], is_left[-1] or self.width > 0]

    def select(self, *headings: str) -> ResultTable:
        """Return a table of some of the printed columns, by their headings, in this order."""
        columns_by_heading = {c.heading: c for c in self.printed_columns}
        return replace(self, columns=tuple(columns_by_heading[h] for h in headings), width=0)

    def to_columns(self) -> dict[str, list[Any]]:
        """Return the unformatted values: name of a column → one value per row."""
        columns = {c.heading if c.name is None else c.name: c for c in self.columns}
        return {n: [c.value(row) for row in self.rows] for n, c in columns.items() if n}

    def __str__(self) -> str:
        """Format as text, with a ruled line below the headings."""
        return _format_text(self)

    def to_html(self) -> str:
        """Format as HTML, with all text escaped."""
        alignments = ["left" if is_left else "right" for is_left in self.left_flags]

        def format_row(cells: list[str], tag: str) -> str:
            pairs = zip(map(_format_html_lines, cells), alignments, strict=True)
            elements = (f'<{tag} style="text-align: {side}">{cell}</{tag}>' for cell, side in pairs)
            return f"<tr>{''.join(elements)}</tr>"

        body_html = "".join(format_row(cells, "td") for cells in self.cells)
        return f"<table><thead>{format_row(self.headings, 'th')}</thead><tbody>{body_html}</tbody></table>"


def make_table(
    headings: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1, width: int = 0
) -> ResultTable:
    """Create a table of text cells, the first `left` columns aligned left; `width` as in `ResultTable`."""
    columns = (
        TableColumn(name, lambda row, i=i: row[i], left=i < left) for i, name in enumerate(headings)
    )
    return ResultTable(tuple(columns), [*rows], width)


def _format_text(table: ResultTable) -> str:
    """Format a table as text; if it is wider than the page, wrap headings, then the widest left-aligned column."""
    headings, left_flags, indices = table.headings, table.left_flags, range(len(table.headings))
    split_rows = [[cell.split("\n") for cell in row] for row in (headings, *table.cells)]
    split_headings, *body = split_rows
    widths = [max(map(_measure, chain(*column))) for column in zip(*split_rows, strict=True)]
    space = WIDTH - 2 * (len(headings) - 1)
    if table.width:
        limit = widths[-1] = min(widths[-1], max(space - sum(widths[:-1]), table.width))
        for row in split_rows:
            parts = ([t] if _measure(t) <= limit else textwrap.wrap(t, limit) for t in row[-1])
            row[-1] = [*chain(*parts)]
    minima = [max((_measure(t) for row in body for t in row[i]), default=0) for i in indices]
    widest_first = sorted(indices, key=lambda i: minima[i] - widths[i])
    for lines, i in product((2, 3, 4), widest_first):
        if sum(widths) > space:
            folds = (_wrap_name(headings[i], w) for w in range(minima[i], widths[i] + 1))
            split_headings[i] = next(wrapped for wrapped in folds if len(wrapped) <= lines)
            widths[i] = max(minima[i], *map(_measure, split_headings[i]))
    if sum(widths) > space:
        i = max(range(max(1, len(headings) - 1)), key=lambda i: left_flags[i] * widths[i])
        for row in split_rows:
            row[i] = [*chain(*(_wrap_name(t, widths[i] + space - sum(widths)) for t in row[i]))]
        widths[i] = max(_measure(t) for row in split_rows for t in row[i])
    height = max(map(len, split_headings))
    split_rows[0] = [[""] * (height - len(texts)) + texts for texts in split_headings]
    lines = []
    for row in split_rows:
        for texts in zip_longest(*row, fillvalue=""):
            pads = [" " * (width - _measure(t)) for t, width in zip(texts, widths, strict=True)]
            parts = zip(texts, pads, left_flags, strict=True)
            lines.append("  ".join(t + p if flush else p + t for t, p, flush in parts).rstrip())
    return "\n".join([*lines[:height], "  ".join("─" * w for w in widths), *lines[height:]])


def _wrap_name(text: str, width: int) -> list[str]:
    """Wrap a name to a width at blanks, before dots and brackets, and after hyphens."""
    lines = [""]
    for part in re.split(r"(?= (?![^(]*\)))|(?=[.\[(])|(?<=\w-)", text):
        if _measure(lines[-1] + part) > width and lines[-1]:
            lines.append("")
        lines[-1] += part if lines[-1] else part.lstrip()
    return [line.rstrip() for line in lines]


def _measure(text: str) -> int:
    return sum(not unicodedata.combining(c) for c in text)  # combining marks have no width


@renamed(data="to_json_data")
class Printed:
    """Base class of printable results, from whose parts text, HTML in a notebook and numbers are derived.

    Subclasses define `_format_summary`, one short line, and `_list_parts`, the printed lines and tables.
    """

    def _format_summary(self) -> str:
        raise NotImplementedError

    def _list_parts(self) -> Sequence[str | ResultTable]:
        raise NotImplementedError

    def _list_columns(self) -> Mapping[str, Sequence[Any]]:
        """Return the unformatted values of the first table, by column; the first column names the rows."""
        tables = (part for part in self._list_parts() if isinstance(part, ResultTable))
        return next(tables).to_columns()

    def __str__(self) -> str:
        return "\n".join(map(str, self._list_parts()))

    def __repr__(self) -> str:
        summary = textwrap.shorten(self._format_summary(), MAX_REPR_CHARACTERS, placeholder=" …")
        return f"<{type(self).__name__}: {summary}>"

    def _repr_html_(self) -> str:
        return as_html(self._list_parts())

    def to_pandas(self) -> pd.DataFrame:
        """Return the printed table with all digits as a `pandas.DataFrame`, indexed by the names of rows."""
        import pandas as pd  # slow to import

        frame = pd.DataFrame(dict(self._list_columns()))
        return frame.set_index(frame.columns[0])

    def to_xarray(self) -> xr.Dataset:
        """Return the printed table as an `xarray.Dataset` along the names of rows."""
        return self.to_pandas().to_xarray()


def as_html(parts: Sequence[str | ResultTable]) -> str:
    """Format lines and tables as HTML, with all text escaped."""
    blocks = list[str]()
    for are_tables, group in groupby(parts, key=lambda part: isinstance(part, ResultTable)):
        if are_tables:
            blocks += [part.to_html() for part in group if isinstance(part, ResultTable)]
        elif text := "\n".join(map(str, group)).strip("\n"):
            blocks.append(f"<p>{_format_html_lines(text)}</p>")
    return "".join(blocks)


def _format_html_lines(text: str) -> str:
    return escape_html(text).replace("\n", "<br>")
