"""Cells of a column: numbers, labels, or dates and times of day, in s since 1970 (UTC)."""

from __future__ import annotations

import re
import sys
import unicodedata
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime, time, timedelta
from functools import lru_cache

import numpy as np

from bayescal._core.errors import InputError

EXAMPLE = "2026-11-22 10:00:00.123"  # date quoted in messages
# Orders of month, day and year in dates; of hours, minutes and seconds in times of day.
ORDERS: tuple[str, ...] = ("mdy", "dmy", "ymd", "hms")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_DAY = 86_400.0  # s
# Formats of dates, and the groups of year, month and day in each, by possible order.
_DATE_FORMATS = {
    re.compile(r"(\d{4})([./-])(\d{1,2})\2(\d{2})(?!\d)"): {"": (1, 3, 4)},
    re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{2,4})(?!\d)"): {"": (3, 2, 1)},  # always the day first
    re.compile(r"(\d{1,2})([/-])(\d{1,2})\2(\d{2,4})(?!\d)"): {"mdy": (4, 1, 3), "dmy": (4, 3, 1), "ymd": (1, 3, 4)},
    re.compile(r"(\d{1,2})[ -]([^\W\d_]{3,10})\.?[ -](\d{4})(?!\d)"): {"": (3, 2, 1)},  # 23-Nov-2026
    re.compile(r"([^\W\d_]{3,10})\.? (\d{1,2}),? (\d{4})(?!\d)"): {"": (3, 1, 2)},  # Nov 23, 2026
}  # fmt: skip
_DATE_TIME_GAP = re.compile(r"\s*(?:[T,_-]|klo)?\s*")  # text between a date and its time of day
_CLOCK_TIME = re.compile(
    r"(\d{1,4})([:.])(\d\d)(?:\2(\d\d)(?:[.,:](\d{1,9}))?)?(?:\s*([AaPp])\.?[Mm]\.?)?\s*(Z|[+-]\d\d:?\d\d)?"
)
_POINTED_TEXT = re.compile(r"\d{1,2}\.\d\d\.\d\d(?!\d)")  # 10.14.20: a time of day, or a date
_MONTHS = {  # prefixes of their names in European languages, without accents
    "jan": 1, "gen": 1, "ene": 1, "tammi": 1, "feb": 2, "fev": 2, "helmi": 2, "mar": 3, "mrz": 3, "mrt": 3, "maa": 3,
    "apr": 4, "avr": 4, "abr": 4, "huhti": 4, "may": 5, "mai": 5, "mei": 5, "mag": 5, "maj": 5, "touko": 5, "jun": 6,
    "juin": 6, "giu": 6, "kesa": 6, "jul": 7, "juil": 7, "lug": 7, "heina": 7, "aug": 8, "aou": 8, "ago": 8, "elo": 8,
    "sep": 9, "set": 9, "syys": 9, "oct": 10, "okt": 10, "ott": 10, "out": 10, "loka": 10, "nov": 11, "marras": 11,
    "dec": 12, "dez": 12, "dic": 12, "des": 12, "joulu": 12,
}  # fmt: skip


def parse_date(text: str) -> dict[str, float]:
    """Return a date, s since 1970, or a time of day, s, by order: each valid one of `ORDERS`; {} for other text.

    An unambiguous text has the key "". Accepted are ISO 8601, with or without a time zone; 11/23/2026, 23/11/2026,
    23.11.2026, 2026/11/23, 23-Nov-2026 and Nov 23, 2026, with or without a time such as 14:05:33.250, 14:05:33,250,
    14:05:33:250, 14.05.33 or 2:05:33 PM after them; and times alone (10.11.12 may be a date, too). A date without a
    time zone is UTC. The resolution of float64 for seconds since 1970 is a quarter of a microsecond.
    """
    text = text.strip()
    if text[4:5] == "-":
        with suppress(ValueError):
            date = datetime.fromisoformat(text)
            delta = (date if date.tzinfo else date.replace(tzinfo=UTC)) - _EPOCH
            return {"": (delta.days * 86400 + delta.seconds) + delta.microseconds * 1e-6}
    if _POINTED_TEXT.match(text):
        clock_s, day = _parse_time(text, max_hours=23), _parse_days(text).get("")
        readings = {"hms": clock_s, "dmy": None if day is None else day * _DAY}
        if valid_readings := {name: value for name, value in readings.items() if value is not None}:
            return valid_readings
    elif _CLOCK_TIME.fullmatch(text) and ":" in text:
        clock_s = _parse_time(text, max_hours=9999)
        return {} if clock_s is None else {"": clock_s}
    day, clock_s = _split_date_time(text)
    return {} if clock_s is None else {n: d * _DAY + clock_s for n, d in _parse_days(day).items()}


def _split_date_time(text: str) -> tuple[str, float | None]:
    """Split a text into a date ("" if none) and the time of day after it, s (0 if none, None for other text)."""
    date_match = next((match for pattern in _DATE_FORMATS if (match := pattern.match(text))), None)
    date_text = date_match[0] if date_match else ""
    time_text = _DATE_TIME_GAP.sub("", text[len(date_text) :], count=1)
    return date_text, _parse_time(time_text, max_hours=23) if len(date_text) < len(text) else 0.0


@lru_cache(maxsize=4096)  # days repeat
def _parse_days(text: str) -> dict[str, int]:
    """Return a date, days since 1970, by order: each possible one of day, month and year, or "" if unambiguous."""
    days = dict[str, int]()
    for pattern, orders in _DATE_FORMATS.items():
        if not (match := pattern.fullmatch(text)):
            continue
        for order, group_names in orders.items():
            with suppress(ValueError):
                year, month, day = (match[group_name] for group_name in group_names)
                if len(year) in (2, 4):  # two digits: this century
                    word = "".join(filter(str.isalpha, unicodedata.normalize("NFD", month.lower())))
                    prefix = max(filter(word.startswith, _MONTHS), key=len, default="")
                    month_number = int(month) if month.isdigit() else _MONTHS.get(prefix, 0)
                    day_date = date(int(year) + 2000 * (len(year) == 2), month_number, int(day))
                    days[order] = (day_date - _EPOCH.date()).days
    return days


def _parse_time(text: str, max_hours: int) -> float | None:
    """Return a time of at most `max_hours` hours in s, minus the UTC offset of its time zone; None for other text."""
    if not (match := _CLOCK_TIME.fullmatch(text.strip())):
        return None
    hours, _, minutes, seconds, fraction, am_pm, zone = match.groups()
    hour = int(hours)
    if am_pm and not 1 <= hour <= 12:
        return None
    hour = hour % 12 + 12 * (am_pm in "Pp") if am_pm else hour
    if hour > max_hours or int(minutes) > 59 or int(seconds or 0) > 59:
        return None
    zone = (zone or "+0000").replace("Z", "+0000").replace(":", "")
    offset = int(f"{zone[0]}1") * (3600 * int(zone[1:3]) + 60 * int(zone[3:5]))
    seconds_of_day = hour * 3600 + 60 * int(minutes) + int(seconds or 0) - offset
    return seconds_of_day + int((fraction or "0").ljust(9, "0")) * 1e-9


def has_time_zone(text: str) -> bool:
    """Return whether the text of a date and time ends in a time zone."""
    return bool(re.search(r"(?:Z|[+-]\d\d:?\d\d)$", text.strip())) and ":" in text


def format_date(seconds: float) -> str:
    """Format seconds since 1970 as an ISO 8601 date and time, UTC, to the microsecond."""
    date_time = _EPOCH + timedelta(seconds=float(seconds))
    return date_time.replace(tzinfo=None).isoformat(sep=" ")


EARLIEST_S, LATEST_S = 946_684_800.0, 4_102_444_800.0  # the years 2000 and 2100, s since 1970
_MAX_SPAN_SECONDS = 1e7  # four months; microseconds that are read as milliseconds span more


def split_origin(seconds: np.ndarray) -> tuple[np.ndarray, float | None]:
    """Return times relative to the earliest, and this origin, s since 1970; other numbers unchanged, and None.

    Relative times are rounded to the microsecond, near the resolution of float64 for seconds since 1970.
    """
    if detect_epoch_unit(seconds, max_span=np.inf) != "s":
        return seconds, None
    origin = float(np.nanmin(seconds[np.isfinite(seconds)]))
    return np.round(seconds - origin, 6), origin


def detect_epoch_unit(values: np.ndarray, max_span: float = _MAX_SPAN_SECONDS) -> str | None:
    """Return the unit (s, ms, us, ns) of times since 1970, inferred from their magnitude; None for other numbers."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return None
    low, high = float(finite.min()), float(finite.max())
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        in_range = low * size >= EARLIEST_S and high * size <= LATEST_S
        if in_range and (high - low) * size <= max_span:
            return unit
    return None


TEXT = np.dtypes.StringDType()
MAX_INVALID_ROWS = 1000  # largest number of rows with invalid cells that are recorded
MISSING = frozenset(  # texts that mark a missing reading, of loggers and C's printf
    ("", "nan", "-nan", "na", "n/a", "#n/a", "#nan", "null", "none", "nil", "-", "--")
    + ("1.#qnan", "-1.#ind", "nan(ind)", "-nan(ind)")
)
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")


@dataclass(frozen=True)
class Cells:
    """Cells of one column.

    Attributes:
        values: float64, NaN for empty or invalid cells; or stripped text, "" for empty cells.
        invalid_texts: index → text, of the first 1000 cells of a numeric column that are neither numbers nor empty.
        texts: all cells as text, if any is invalid; else None.
    """

    values: np.ndarray
    invalid_texts: Mapping[int, str] = field(default_factory=dict)
    texts: np.ndarray | None = None

    @property
    def dates(self) -> np.ndarray | None:
        """Return all cells as text if the first that is neither a number nor empty is a date; else None."""
        cells = () if self.texts is None else zip(self.texts, np.isnan(self.values), strict=True)
        first_text = next((text for text, is_text in cells if is_text and not is_missing(text)), "")
        return self.texts if parse_date(first_text) else None

    def on_days(self, days: Cells) -> Cells:
        """Return the times of day joined to the dates of another column; self if either column has other texts."""
        if self.dates is None or days.dates is None:
            return self
        texts = list[str]()
        for day, time_text in zip(days.dates, self.dates, strict=True):
            date_text, day_seconds = _split_date_time(day.strip())
            date_time_text = f"{date_text if day_seconds == 0.0 else day} {time_text}"  # Excel adds midnight to days
            if not parse_date(date_time_text) and parse_date(day) and parse_date(time_text):
                return self
            texts.append("" if is_missing(day) or is_missing(time_text) else date_time_text)
        return replace(self, texts=np.array(texts, TEXT))


def parse_dates(texts: np.ndarray, order: str = "") -> tuple[Cells, list[str]]:
    """Parse a column of dates to s since 1970; other texts, also numbers, are invalid.

    The order of month, day and year is `order`, or the only one in which all cells are dates. The second item lists the
    possible orders if several are, else it is empty.
    """
    rows, invalid_texts = np.full((len(ORDERS), len(texts)), np.nan), dict[int, str]()
    has_zone, is_unambiguous = None, True
    for i, text in enumerate(map(format_cell, texts)):
        if dates := parse_date(text):
            rows[:, i] = [dates.get("", dates.get(name, np.nan)) for name in ORDERS]
            has_zone = has_time_zone(text) if has_zone is None else has_zone
            is_unambiguous &= "" in dates
        is_invalid = has_time_zone(text) != has_zone if dates else not is_missing(text)
        if is_invalid and len(invalid_texts) < MAX_INVALID_ROWS:
            invalid_texts[i] = text
    if is_unambiguous:
        return Cells(rows[0], invalid_texts), []
    values, is_date = dict(zip(ORDERS, rows, strict=True)), ~np.isnan(rows).all(axis=0)
    valid_orders = [n for n, row in values.items() if not np.isnan(row[is_date]).any()]
    if not order and len(valid_orders) != 1:
        possible = [n for n, row in values.items() if not np.isnan(row).all()]
        return Cells(np.fmax.reduce(rows), invalid_texts), valid_orders or possible
    seconds = values[order or valid_orders[0]]
    invalid = np.flatnonzero(is_date & np.isnan(seconds))[:MAX_INVALID_ROWS]
    invalid_texts |= {int(i): f"{format_cell(texts[i])} in another order" for i in invalid}
    return Cells(seconds, invalid_texts), []


def to_numbers(texts: Sequence[str], decimal: str = ".") -> Cells:
    """Parse texts, one per reading, as numbers; also keep the texts if any is not a number, since they may be dates.

    Empty texts, "nan" and other marks of missing readings give NaN; `decimal` is a point or a comma.
    """
    normalised = [_replace_comma(text) for text in texts] if decimal == "," else texts
    all_text = "".join(normalised)
    # Python's float also accepts underscores and digits of other scripts
    if all_text.isascii() and "_" not in all_text:
        with suppress(ValueError):
            return Cells(np.fromiter(map(float, normalised), np.float64, len(normalised)))
    values = np.fromiter(map(to_number, normalised), np.float64, len(normalised))
    invalid = [i for i in np.flatnonzero(np.isnan(values)).tolist() if not is_missing(texts[i])]
    invalid_texts = {i: texts[i].strip() for i in invalid[:MAX_INVALID_ROWS]}
    return Cells(values, invalid_texts, np.array(texts, TEXT) if invalid else None)


def is_missing(text: str) -> bool:
    """Return whether the text of a cell marks a missing reading: "", "nan", "n/a", "-" and others."""
    return text.strip().lower() in MISSING


def _replace_comma(text: str) -> str:
    """Replace a decimal comma by a point; return "?" for a number with a point, which may separate thousands."""
    if DECIMAL_COMMA.fullmatch(text.strip()):
        return text.replace(",", ".")
    return "?" if "." in text and not np.isnan(to_number(text)) else text


def to_number(text: str) -> float:
    """Parse a number; return NaN for any other text."""
    try:
        return float(text) if text.isascii() and "_" not in text else np.nan
    except ValueError:
        return np.nan


def to_cells(array: np.ndarray, is_number: bool, decimal: str = ".") -> Cells:
    """Convert a column's values, one per reading, to `Cells` of numbers or labels; `decimal` as in `to_numbers`."""
    if array.dtype.kind == "M":
        array = array.astype("datetime64[us]").astype(object)
    if is_number and array.dtype.kind in "iuf":
        return Cells(array.astype(np.float64))
    has_text = array.dtype.kind in "OU" or isinstance(array.dtype, np.dtypes.StringDType)
    if is_number and not has_text:
        invalid_texts = {i: str(value) for i, value in enumerate(array[:MAX_INVALID_ROWS].tolist())}
        return Cells(np.full(len(array), np.nan), invalid_texts)
    missing = getattr(sys.modules.get("pandas"), "NA", None)  # exists only if pandas is imported
    texts = array.astype(object)
    if not is_number or array.dtype != TEXT:
        texts = [format_cell(value, missing) for value in texts.tolist()]
    return to_numbers(texts, decimal) if is_number else Cells(np.array(texts, dtype=object))


def broadcast_columns(columns: Mapping[str, object]) -> dict[str, np.ndarray]:
    """Broadcast columns to vectors of equal length; a scalar applies to all readings.

    Raises:
        InputError: lengths differ, or a column is not a vector.
    """
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    lengths = {len(array) for array in arrays.values() if array.ndim == 1}
    if len(lengths) > 1 or any(array.ndim > 1 for array in arrays.values()):
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise InputError(f"columns must be vectors of equal length; their shapes are: {shapes}")
    rows = lengths.pop() if lengths else 1
    return {name: np.broadcast_to(array, (rows,)) for name, array in arrays.items()}


def format_cell(value: object, missing: object = None) -> str:
    """Format a cell as text: whole numbers without a point, dates by ISO 8601, "" for `missing`."""
    if isinstance(value, str):
        return value.strip()
    if value is None or value is missing or (isinstance(value, float) and np.isnan(value)):
        return ""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace").strip()
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return str(int(value))
    return value.isoformat() if isinstance(value, date | time) else str(value).strip()
