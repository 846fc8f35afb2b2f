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
from bayescal._core.quoting import html_text
from bayescal._core.renamed import renamed

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

MAX_REPR_CHARACTERS = 200  # length of the one-line summary


@dataclass(frozen=True)
class TableColumn:
    """Column of a table: heading, value and format."""

    head: str  # heading, without the unit
    # key or function of a row that gives the value; "": the heading is the key
    of: str | Callable[[Any], Any] = ""
    # function that formats the value; None for a column that is not printed
    show: Callable[[Any], str] | None = str
    unit: str = ""  # formatted unit of all values, printed after the heading
    left: bool | None = None  # whether it is aligned left; None: only as the first column
    name: str | None = None  # key in the data; None: the heading; "": not in the data

    def value(self, row: Any) -> Any:
        """Return the column's value for a row."""
        return row[self.of or self.head] if isinstance(self.of, str) else self.of(row)


@dataclass(frozen=True)
class ResultTable:
    """Table of columns, which are evaluated on rows of plain data.

    Attributes:
        columns: the columns, in order; the first one names the row.
        rows: the rows, each a mapping or a sequence.
        fold: if not zero, the last column is aligned left; as text, it is wrapped to this width or to the remaining
            width of the page, whichever is larger.
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
        """Return the formatted cells of each row; they may contain line breaks."""
        return [[c.show(c.value(row)) for c in self.printed_columns if c.show] for row in self.rows]

    @property
    def flush_left(self) -> list[bool]:
        is_left = [i == 0 if c.left is None else c.left for i, c in enumerate(self.printed_columns)]
        return [*is_left[:-1], is_left[-1] or self.fold > 0]

    def only(self, *heads: str) -> ResultTable:
        """Select printed columns by their headings, in this order."""
        columns_by_head = {c.head: c for c in self.printed_columns}
        return replace(self, columns=tuple(columns_by_head[head] for head in heads), fold=0)

    def to_columns(self) -> dict[str, list[Any]]:
        """Return the unformatted values: name of a column → one value per row."""
        columns = {c.head if c.name is None else c.name: c for c in self.columns}
        return {n: [c.value(row) for row in self.rows] for n, c in columns.items() if n}

    def __str__(self) -> str:
        """Format as text, with a ruled line below the headings."""
        return _text(self.head, self.cells, self.flush_left, self.fold)

    def html(self) -> str:
        """Format as HTML, with all text escaped."""
        alignments = ["left" if is_left else "right" for is_left in self.flush_left]

        def row(cells: list[str], tag: str) -> str:
            pairs = zip(map(_format_html_lines, cells), alignments, strict=True)
            elements = (f'<{tag} style="text-align: {side}">{cell}</{tag}>' for cell, side in pairs)
            return f"<tr>{''.join(elements)}</tr>"

        body_html = "".join(row(cells, "td") for cells in self.cells)
        return f"<table><thead>{row(self.head, 'th')}</thead><tbody>{body_html}</tbody></table>"


def plain_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1, fold: int = 0
) -> ResultTable:
    """Create a table of text cells; the first `left` columns are aligned left."""
    columns = (
        TableColumn(name, lambda row, i=i: row[i], left=i < left) for i, name in enumerate(head)
    )
    return ResultTable(tuple(columns), [*rows], fold)


def _text(head: list[str], rows: list[list[str]], flush_left: Sequence[bool], fold: int = 0) -> str:
    """Format a table as text; if it is wider than the page, wrap headings, then the widest left-aligned column."""
    split_rows = [[cell.split("\n") for cell in row] for row in (head, *rows)]
    split_head, *body = split_rows
    widths = [max(map(_width, chain(*column))) for column in zip(*split_rows, strict=True)]
    space = WIDTH - 2 * (len(head) - 1)
    if fold:
        limit = widths[-1] = min(widths[-1], max(space - sum(widths[:-1]), fold))
        for row in split_rows:
            parts = ([t] if _width(t) <= limit else textwrap.wrap(t, limit) for t in row[-1])
            row[-1] = [*chain(*parts)]
    minima = [max((_width(t) for row in body for t in row[i]), default=0) for i in range(len(head))]
    widest_first = sorted(range(len(head)), key=lambda i: minima[i] - widths[i])
    for lines, i in product((2, 3, 4), widest_first):
        if sum(widths) > space:
            folds = (_wrap_name(head[i], w) for w in range(minima[i], widths[i] + 1))
            split_head[i] = next(wrapped for wrapped in folds if len(wrapped) <= lines)
            widths[i] = max(minima[i], *map(_width, split_head[i]))
    if sum(widths) > space:
        i = max(range(max(1, len(head) - 1)), key=lambda i: flush_left[i] * widths[i])
        for row in split_rows:
            row[i] = [*chain(*(_wrap_name(t, widths[i] + space - sum(widths)) for t in row[i]))]
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


def _wrap_name(text: str, width: int) -> list[str]:
    """Wrap a name to a width at blanks, before dots and brackets, and after hyphens."""
    lines = [""]
    for part in re.split(r"(?= (?![^(]*\)))|(?=[.\[(])|(?<=\w-)", text):
        if _width(lines[-1] + part) > width and lines[-1]:
            lines.append("")
        lines[-1] += part if lines[-1] else part.lstrip()
    return [line.rstrip() for line in lines]


def _width(text: str) -> int:
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

    def _columns(self) -> Mapping[str, Sequence[Any]]:
        """Return the unformatted values of the first table, by column; the first column names the rows."""
        return next(
            part for part in self._list_parts() if isinstance(part, ResultTable)
        ).to_columns()

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

        frame = pd.DataFrame(dict(self._columns()))
        return frame.set_index(frame.columns[0])

    def to_xarray(self) -> xr.Dataset:
        """Return the printed table as an `xarray.Dataset` along the names of rows."""
        return self.to_pandas().to_xarray()


def as_html(parts: Sequence[str | ResultTable]) -> str:
    """Format lines and tables as HTML, with all text escaped."""
    blocks = list[str]()
    for are_tables, group in groupby(parts, key=lambda part: isinstance(part, ResultTable)):
        if are_tables:
            blocks += [part.html() for part in group if isinstance(part, ResultTable)]
        elif text := "\n".join(map(str, group)).strip("\n"):
            blocks.append(f"<p>{_format_html_lines(text)}</p>")
    return "".join(blocks)


def _format_html_lines(text: str) -> str:
    return html_text(text).replace("\n", "<br>")
