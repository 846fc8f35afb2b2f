"""Numbers and tables as text for people, and as HTML: what every printed result shares."""

from __future__ import annotations

import textwrap
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from math import floor, log10
from typing import TYPE_CHECKING, Any, NamedTuple

from bayescal._core.quoting import html_text

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

WIDTH = 110  # columns that a table or a sentence should fit in
BRIEF = 200  # characters of a `repr`


class _Table(NamedTuple):
    """A table as text, its cells, and which columns are flush left."""

    text: str
    head: list[str]
    rows: list[list[str]]
    left: list[bool]


_MADE: ContextVar[list[_Table] | None] = ContextVar("tables", default=None)


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

    text = "\n".join([line(head), "  ".join("─" * w for w in widths), *(line(r) for r in rows)])
    if (made := _MADE.get()) is not None:
        flush = [i < left or (fold > 0 and i == len(head) - 1) for i in range(len(head))]
        made.append(_Table(text, head, rows, flush))
    return text


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
    # Two digits of the error: places from its leading one to the next (JCGM 100, 7.2.6).
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
        return as_html(self.__str__)

    def to_pandas(self) -> pd.DataFrame:
        """The table that is printed, its numbers in full: a `pandas.DataFrame`, its rows by name."""
        import pandas as pd  # only where it is asked for

        frame = pd.DataFrame(dict(self._columns()))
        return frame.set_index(frame.columns[0])

    def to_xarray(self) -> xr.Dataset:
        """The same as an `xarray.Dataset` along the rows' names."""
        return self.to_pandas().to_xarray()


def as_html(say: Callable[[], str]) -> str:
    """What is said as HTML, everything in it escaped: tables made by `table` as tables, other lines as they are."""
    token = _MADE.set([])
    try:
        text, made = say(), _MADE.get() or []
    finally:
        _MADE.reset(token)
    parts = []
    for one in made:
        before, found, after = text.partition(one.text)
        if found:  # a table may be made and not said
            parts += [_said(before), _table_in_html([one.head, *one.rows], one.left)]
            text = after.removeprefix("\n")
    return "".join([*parts, _said(text)])


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


def _said(text: str) -> str:
    text = text.removesuffix("\n")
    return f"<p>{html_text(text).replace(chr(10), '<br>')}</p>" if text.strip() else ""
