"""Numbers and tables as text for people, and as HTML: what every printed result shares."""

from __future__ import annotations

import re
import textwrap
import unicodedata
from collections.abc import Mapping, Sequence
from math import floor, log10
from typing import TYPE_CHECKING, Any

from bayescal._core.quoting import html_text

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

WIDTH = 110  # columns that a table or a sentence should fit in
BRIEF = 200  # characters of a `repr`


def _width(text: str) -> int:
    """Columns that a text takes: the mark over a letter takes none."""
    return sum(not unicodedata.combining(c) for c in text)


def table(head: list[str], rows: list[list[str]], left: int = 1, fold: int = 0) -> str:
    """Columns under a ruled head.

    Args:
        head, rows: cells; in a folded column, a line break stays one.
        left: this many columns are flush left, the others flush right.
        fold: if not zero, the last column is flush left too, and is folded to this width or to
            what is left of the page, whichever is more.
    """
    widths = [
        max(_width(t) for r in [head, *rows] for t in r[i].split("\n")) for i in range(len(head))
    ]
    if fold:
        room = WIDTH - sum(widths[:-1]) - 2 * (len(head) - 1)
        widths[-1] = min(widths[-1], max(room, fold))

    def line(cells: list[str]) -> str:
        *most, last = cells
        folded = [t for part in last.split("\n") for t in _folded(part, widths[-1] if fold else 0)]
        parts = []
        for i, (cell, width) in enumerate(zip([*most, folded[0]], widths, strict=True)):
            space = " " * (width - _width(cell))
            flush_left = i < left or (fold and i == len(cells) - 1)
            parts.append(cell + space if flush_left else space + cell)
        indent = " " * (sum(widths[:-1]) + 2 * (len(widths) - 1))
        return "\n".join(["  ".join(parts).rstrip(), *(indent + rest for rest in folded[1:])])

    return "\n".join([line(head), "  ".join("─" * w for w in widths), *(line(r) for r in rows)])


def _folded(text: str, width: int) -> list[str]:
    return [text] if _width(text) <= width or not width else textwrap.wrap(text, width)


def number(value: float | None, digits: int = 3) -> str:
    """Significant digits, no exponent where it can be avoided, – for nothing."""
    if value is None:
        return "–"
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        text = f"{value:.{digits}g}"
        return f"{float(text):.0f}" if "e" in text else text
    return f"{value:.{digits}g}"


def _scaled(value: float, error: float) -> tuple[int, int]:
    """(power of ten to take out, decimal places that show the error to two digits)."""
    place = floor(log10(error))
    largest = max(place, floor(log10(abs(value))) if value else place)
    power = largest if largest < -3 or largest > 6 else 0
    return power, max(0, 1 - place + power)


_MOST_PLACES = 6  # decimal places beyond which an error is written in brackets


def with_error(value: float, error: float) -> str:
    """value ± error, the error to two significant digits and the value to the same place.

    Where that takes more than six places, the error stands in brackets and counts the last digits of the value,
    0.88819219(31) (JCGM 100, 7.2.2). A value without a sizeable error (held at an estimate, not sampled) stands alone.
    """
    if not error > 1e-12 * abs(value):
        return number(value, 4)
    power, places = _scaled(value, error)
    if places > _MOST_PLACES:
        digits = round(error / 10 ** (power - places))
        text = f"{value / 10**power:z.{places}f}({digits})"
        return f"{text}e{power}" if power else text
    text = f"{value / 10**power:z.{places}f} ± {error / 10**power:.{places}f}"
    return f"({text})e{power}" if power else text


def interval(low: float, high: float, mean: float, error: float) -> str:
    """The two ends, to the place of the error, or one further where that is coarse."""
    if not error > 1e-12 * abs(mean):
        return "–"
    power, places = _scaled(mean, error)
    text = f"{low / 10**power:z.{places}f} to {high / 10**power:z.{places}f}"
    return f"({text})e{power}" if power else text


def probability(p: float | None) -> str:
    if p is None:
        return "–"
    if p > 0.995:
        return "> 0.99"
    return f"{p:.2f}" if p >= 0.005 else "< 0.01"


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
            _table_in_html(rows, _flush_left(lines[i : i + 1] + lines[i + 2 : end], spans)),
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
    return cells if apart and (any(cells[1:]) or (len(spans) == 1 and cells[0])) else []


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


def _table_in_html(rows: list[list[str]], left: list[bool]) -> str:
    def row(cells: list[str], tag: str) -> str:
        made = (
            f'<{tag} style="text-align: {"left" if flush else "right"}">'
            f"{html_text(cell).replace(chr(10), '<br>')}</{tag}>"
            for cell, flush in zip(cells, left, strict=True)
        )
        return f"<tr>{''.join(made)}</tr>"

    body = "".join(row(cells, "td") for cells in rows[1:])
    return f"<table><thead>{row(rows[0], 'th')}</thead><tbody>{body}</tbody></table>"


def _said(lines: list[str]) -> str:
    said = "<br>".join(html_text(line) for line in lines)
    return f"<p>{said}</p>" if said.strip("<br>") else ""
