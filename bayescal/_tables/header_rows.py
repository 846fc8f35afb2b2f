"""Which rows of a file name its columns: below lines that tell of the test, and above a row of units."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

from bayescal._tables.cells import is_date, is_missing

LOOKED_AT = 200  # rows from the start of a file
_LAST = 5  # of these, whose width is that of the readings
_UNITS = 2  # rows of units and the like, at most, between names and readings
_LONGEST_UNIT = 24  # characters
_NO_UNITS = ("TS", "RN")  # what Campbell's loggers write for moments and the numbers of records


class HeaderRows(NamedTuple):
    """Indices of the first and last row that name columns, and the names, with units in brackets, one a column."""

    first: int
    last: int
    names: list[str]


def header_rows(rows: Sequence[Sequence[str]], first: int = 0) -> HeaderRows | None:
    """Return the rows that name the columns, if `rows[first]` (fields, blank rows left out) begins them.

    Names are text; readings with as many fields and a number or a date among them follow, at once or after a row of
    units. Readings may end each row with one empty field more.
    """
    names = [name.strip() for name in rows[first]]
    if len(names) < 2 or any(map(is_reading, names)) or sum(map(bool, names)) < 2:
        return None
    last = [row for row in rows[first + 1 :][-_LAST:] if any(map(is_reading, row))]
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
    while below < min(len(rows), first + 2 + _UNITS) and _names_units(rows[below], len(names)):
        below += 1
    if below == len(rows) or len(rows[below]) != width or not any(map(is_reading, rows[below])):
        return None
    units = rows[first + 1] if below > first + 1 else ()
    return HeaderRows(first, below - 1, with_units(names, units))


def is_reading(text: str) -> bool:
    """Whether a field holds a number or a date."""
    with suppress(ValueError):
        float(text.strip().replace(",", ".", 1))
        return not is_missing(text)
    return is_date(text)


def _names_units(row: Sequence[str], width: int) -> bool:
    """Whether a row between names and readings may be one of units: short texts, none of them a reading."""
    texts = [text.strip() for text in row if text.strip()]
    short = all(len(t) <= _LONGEST_UNIT and (t[0] in "[(" or not t.endswith("]")) for t in texts)
    there = abs(len(row) - width) <= 1 and len(texts) >= 2
    return there and short and not any(is_reading(t) or (is_missing(t) and t != "-") for t in texts)


def with_units(names: Sequence[str], units: Sequence[str]) -> list[str]:
    """Names, each with its unit, if there is one, behind it in brackets."""
    found = list(names)
    for i, (name, unit) in enumerate(zip(names, map(str.strip, units), strict=False)):
        if unit[:1] + unit[-1:] in ("()", "[]", "<>", "{}"):
            unit = unit[1:-1].strip()
        if name and unit and unit not in _NO_UNITS and not name.endswith("]"):
            found[i] = f"{name} [{unit}]"
    return found
