"""What every result offers beside its text: one line as `repr`, HTML in a notebook, its numbers as pandas or xarray."""

from __future__ import annotations

import html
import re
import textwrap
import unicodedata
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

BRIEF = 200  # characters of a `repr`


class Printed:
    """A result that prints itself.

    A class says `_brief`, what it is in a few words, and `_columns`, the numbers behind its table: name → one value a
    row, the first naming the row. `str()` is its own; the HTML is made from it, so that both say the same.
    """

    def _brief(self) -> str:
        raise NotImplementedError

    def _columns(self) -> Mapping[str, Sequence[Any]]:
        raise NotImplementedError

    def __repr__(self) -> str:
        said = textwrap.shorten(self._brief(), BRIEF, placeholder=" …")
        return f"<{type(self).__name__}: {said}>"

    def _repr_html_(self) -> str:
        return as_html(str(self))

    def to_pandas(self) -> pd.DataFrame:
        """The table that is printed, its numbers in full: a `pandas.DataFrame`, its rows by name."""
        import pandas as pd  # only where it is asked for

        frame = pd.DataFrame(dict(self._columns()))
        return frame.set_index(frame.columns[0])

    def to_xarray(self) -> xr.Dataset:
        """The same as an `xarray.Dataset` along the rows' names."""
        return self.to_pandas().to_xarray()


def as_html(text: str) -> str:
    """A printed text as HTML, everything in it escaped: its tables as tables, other lines as they are."""
    lines, parts, said = text.split("\n"), [], []
    i = 0
    while i < len(lines):
        spans = _ruled(lines[i + 1]) if i + 1 < len(lines) else []
        if not spans:
            said.append(lines[i])
            i += 1
            continue
        rows, end = [_cells(lines[i], spans)], i + 2
        while end < len(lines) and (cells := _cells(lines[end], spans)):
            if any(cells[:-1]) or len(rows) == 1:
                rows.append(cells)
            else:  # the rest of a folded cell
                rows[-1][-1] += "\n" + cells[-1]
            end += 1
        parts += [
            _said(said),
            _table(rows, _flush_left(lines[i : i + 1] + lines[i + 2 : end], spans)),
        ]
        said, i = [], end
    return "".join([*parts, _said(said)])


def _ruled(line: str) -> list[tuple[int, int]]:
    """Where the columns stand whose rule this is; none where the line is no rule."""
    return [m.span() for m in re.finditer("─+", line)] if re.fullmatch("[─ ]*─", line) else []


def _letters(line: str) -> list[str]:
    """A line as it stands in columns: marks over a letter stand with it."""
    letters: list[str] = []
    for character in line:
        if letters and unicodedata.combining(character):
            letters[-1] += character
        else:
            letters.append(character)
    return letters


def _cells(line: str, spans: list[tuple[int, int]]) -> list[str]:
    """The cells of a table's row; empty for a line that is none: nothing stands between columns or beyond them."""
    letters = _letters(line)
    between = [*zip((end for _, end in spans), (low for low, _ in spans[1:]), strict=False)]
    between.append((spans[-1][1], len(letters)))
    cells = ["".join(letters[low:high]).strip() for low, high in spans]
    apart = all(not "".join(letters[low:high]).strip() for low, high in between)
    return cells if apart and (any(cells[1:]) or len(spans) == 1 and cells[0]) else []


def _flush_left(lines: list[str], spans: list[tuple[int, int]]) -> list[bool]:
    """Of each column, whether its cells begin where it begins."""
    each = [_letters(line) for line in lines]
    return [
        all(
            letters[low].strip() or not "".join(letters[low:high]).strip()
            for letters in each
            if low < len(letters)
        )
        for low, high in spans
    ]


def _table(rows: list[list[str]], left: list[bool]) -> str:
    def row(cells: list[str], tag: str) -> str:
        made = (
            f'<{tag} style="text-align: {"left" if flush else "right"}">'
            f"{html.escape(cell).replace(chr(10), '<br>')}</{tag}>"
            for cell, flush in zip(cells, left, strict=True)
        )
        return f"<tr>{''.join(made)}</tr>"

    body = "".join(row(cells, "td") for cells in rows[1:])
    return f"<table><thead>{row(rows[0], 'th')}</thead><tbody>{body}</tbody></table>"


def _said(lines: list[str]) -> str:
    said = "<br>".join(html.escape(line) for line in lines)
    return f"<p>{said}</p>" if said.strip("<br>") else ""
