"""What the cells of one column hold: numbers, labels, or dates."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from bayescal._core.errors import InputError
from bayescal._tables.dates import ORDERS, date_text, unix_seconds, zoned

MOST_BAD = 1000  # cells that are no number, beyond which no more are kept
MISSING = frozenset(  # what loggers and C's printf write for a reading that is not there
    ("", "nan", "-nan", "na", "n/a", "#n/a", "#nan", "null", "none", "nil", "-", "--")
    + ("1.#qnan", "-1.#ind", "nan(ind)", "-nan(ind)")
)
_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")


@dataclass(frozen=True)
class Cells:
    """One column's content.

    Attributes:
        values: float64, NaN where empty (or bad); or text, stripped, "" where empty.
        bad: index → text of the cells that should be numbers and are not, the first 1000.
        dates: the values are dates, in seconds since 1970.
        orders: of dates that leave open which number is the day: the values by the order of month, day and year, NaN
            where a cell is not a date in it.
    """

    values: np.ndarray
    bad: Mapping[int, str] = field(default_factory=dict)
    dates: bool = False
    orders: Mapping[str, np.ndarray] = field(default_factory=dict)

    def take(self, rows: np.ndarray) -> Cells:
        """The cells of some rows."""
        orders = {name: values[rows] for name, values in self.orders.items()}
        if not self.bad:
            return Cells(self.values[rows], dates=self.dates, orders=orders)
        bad = {i: self.bad[row] for i, row in enumerate(rows.tolist()) if row in self.bad}
        return Cells(self.values[rows], bad, self.dates, orders)

    def in_order(self, order: str = "") -> Cells:
        """Dates in the order that is said, or in the only one in which each is a date; else as they are."""
        fitting = self.fitting_orders
        chosen = order if order in self.orders else fitting[0] if len(fitting) == 1 else ""
        if not chosen:
            return self
        values = self.orders[chosen]
        wrong = np.flatnonzero(np.isnan(values) & ~np.isnan(self.values))[:MOST_BAD]
        bad = {int(i): f"{date_text(float(self.values[i]))[:10]} in another order" for i in wrong}
        return Cells(values, {**self.bad, **bad}, dates=True)

    @property
    def fitting_orders(self) -> list[str]:
        """The orders in which each date is one."""
        there = ~np.isnan(self.values)
        return [n for n, values in self.orders.items() if not np.isnan(values[there]).any()]

    def on_days(self, days: Cells, order: str = "") -> Cells:
        """Times of day on the days of another column, where these cells are the one and those the other."""
        days = days.in_order(order)
        clock = self.values[~np.isnan(self.values)]
        whole = days.values[~np.isnan(days.values)] % 86_400.0
        if not (self.dates and days.dates and clock.size and whole.size):
            return self
        if clock.max() >= 86_400.0 or whole.any():
            return self
        orders = {name: values + self.values for name, values in days.orders.items()}
        return Cells(days.values + self.values, {**days.bad, **self.bad}, dates=True, orders=orders)

    @classmethod
    def joined(cls, parts: Sequence[Cells]) -> Cells:
        """Stretches of a column, one after the other; numbers among dates are bad."""
        dates = any(part.dates for part in parts)
        values, bad, done = [], dict[int, str](), 0
        for part in parts:
            own, wrong = part.values, dict(part.bad)
            if dates and not part.dates:
                there = np.flatnonzero(~np.isnan(own))
                wrong |= {int(i): f"{own[i]:g}" for i in there[:MOST_BAD]}
            values.append(own)
            bad |= {done + i: text for i, text in wrong.items()} if len(bad) < MOST_BAD else {}
            done += len(own)
        names = ORDERS if any(part.orders for part in parts) else ()
        orders = {n: np.concatenate([p.orders.get(n, p.values) for p in parts]) for n in names}
        return cls(np.concatenate(values), bad, dates, orders)


def numbers_of(texts: Sequence[str], decimal: str = ".") -> Cells:
    """Text as numbers, or as dates if that is what the first that is no number is.

    Args:
        texts: one for each reading; empty, "nan" and other marks of a missing reading are NaN.
        decimal: between the whole and its parts, a point or a comma.
    """
    plain = [_with_point(text) for text in texts] if decimal == "," else texts
    together = "".join(plain)
    # else Python takes for a number what nobody writes as one
    if together.isascii() and "_" not in together:
        with suppress(ValueError):
            return Cells(np.fromiter(map(float, plain), np.float64, len(plain)))
    values = np.fromiter(map(number_of, plain), np.float64, len(plain))
    odd = [i for i in np.flatnonzero(np.isnan(values)).tolist() if not is_missing(texts[i])]
    if odd and _is_date(texts[odd[0]]):
        return _dates_of(texts, values, odd)
    return Cells(values, {i: texts[i].strip() for i in odd[:MOST_BAD]})


def is_missing(text: str) -> bool:
    """Whether a cell says that there is no reading."""
    return text.strip().lower() in MISSING


def _dates_of(texts: Sequence[str], values: np.ndarray, odd: Sequence[int]) -> Cells:
    """A column whose first text is a date: whatever else stands there, a number too, is bad."""
    bad, orders = dict[int, str](), {name: np.full(len(texts), np.nan) for name in ORDERS}
    has_zone = zoned(texts[odd[0]])
    for i in sorted([*odd, *np.flatnonzero(~np.isnan(values)).tolist()]):
        found = dict[str, float]()
        with suppress(ValueError):
            found = unix_seconds(texts[i])
        if (not found or zoned(texts[i]) != has_zone) and len(bad) < MOST_BAD:
            bad[i] = texts[i].strip()
        for name, of_order in orders.items():
            of_order[i] = found.get("", found.get(name, np.nan))
    first, *others = orders.values()
    if all(np.array_equal(first, other, equal_nan=True) for other in others):
        return Cells(first, bad, dates=True)
    shown = first.copy()
    for other in others:
        shown = np.where(np.isnan(shown), other, shown)
    return Cells(shown, bad, dates=True, orders=orders)


def _is_date(text: str) -> bool:
    with suppress(ValueError):
        unix_seconds(text)
        return True
    return False


def _with_point(text: str) -> str:
    """A number with a decimal comma as one with a point; a point in it parts thousands, and makes it none."""
    if _COMMA.fullmatch(text.strip()):
        return text.replace(",", ".")
    return "?" if "." in text and not np.isnan(number_of(text)) else text


def number_of(text: str) -> float:
    """A number as people write it, NaN if the text is none."""
    try:
        return float(text) if text.isascii() and "_" not in text else np.nan
    except ValueError:
        return np.nan


def cells_of(values: object, number: bool) -> Cells:
    """An array or a list as the cells of one column.

    Args:
        values: one entry per reading: numbers, text, or both.
        number: whether the column is one of numbers.
    """
    import pandas as pd  # half a second that a CSV file does without

    array = np.asarray(values)
    if array.dtype.kind == "M":
        array = array.astype("datetime64[us]").astype(object)
    if array.dtype.kind in "OU" or isinstance(array.dtype, np.dtypes.StringDType):
        if not number and pd.api.types.infer_dtype(array, skipna=True) == "string":
            # labels repeat: each is read once; the last is for −1, missing
            codes, levels = pd.factorize(array.astype(object))
            return Cells(np.array([*(_text(v, pd.NA) for v in levels), ""], dtype=object)[codes])
        texts = [_text(value, pd.NA) for value in array.tolist()]
        return numbers_of(texts) if number else Cells(np.array(texts, dtype=object))
    if not number:
        return Cells(np.array([_text(value, pd.NA) for value in array.tolist()], dtype=object))
    if array.dtype.kind in "iuf":
        return Cells(array.astype(np.float64))
    bad = {i: str(value) for i, value in enumerate(array[:MOST_BAD].tolist())}
    return Cells(np.full(len(array), np.nan), bad)


def equally_long(columns: Mapping[str, object]) -> dict[str, np.ndarray]:
    """The columns as vectors; a single value counts for every reading.

    Raises:
        InputError: lengths differ, or a column is no vector.
    """
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    lengths = {len(array) for array in arrays.values() if array.ndim == 1}
    if len(lengths) > 1 or any(array.ndim > 1 for array in arrays.values()):
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise InputError(f"columns must be vectors of one length, these are: {shapes}")
    rows = lengths.pop() if lengths else 1
    return {name: np.broadcast_to(array, (rows,)) for name, array in arrays.items()}


def _text(value: object, missing: object) -> str:
    """A cell as a label: whole numbers without a point, nothing for what is `missing`."""
    if value is None or value is missing or (isinstance(value, float) and np.isnan(value)):
        return ""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace").strip()
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return str(int(value))
    return str(value).strip()
