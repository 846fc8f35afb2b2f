"""Dates and times of day as people log them, as seconds since 1970 (UTC)."""

from __future__ import annotations

import re
from contextlib import suppress
from datetime import UTC, date, datetime, timedelta
from functools import lru_cache

import numpy as np

EXAMPLE = "2026-11-22 10:00:00.123"
ORDERS = ("mdy", "dmy", "ymd")  # month first, day first, year first
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_DAY = 86_400.0  # s
# How dates are written, and where year, month and day stand in each by the order in which it may be meant.
_FORMS = {
    re.compile(r"(\d{4})([./-])(\d{1,2})\2(\d{2})(?!\d)"): {"": (1, 3, 4)},
    re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{2,4})(?!\d)"): {"": (3, 2, 1)},  # always the day first
    re.compile(r"(\d{1,2})([/-])(\d{1,2})\2(\d{2,4})(?!\d)"): {"mdy": (4, 1, 3), "dmy": (4, 3, 1), "ymd": (1, 3, 4)},
    re.compile(r"(\d{1,2})[ -]([^\W\d_]{3,9})\.?[ -](\d{4})(?!\d)"): {"": (3, 2, 1)},  # 23-Nov-2026
    re.compile(r"([^\W\d_]{3,9})\.? (\d{1,2}),? (\d{4})(?!\d)"): {"": (3, 1, 2)},  # Nov 23, 2026
}  # fmt: skip
_BETWEEN = re.compile(r"\s*[T,_-]?\s*")  # a date and its time of day
_CLOCK = re.compile(
    r"(\d{1,4}):(\d\d)(?::(\d\d)(?:[.,:](\d{1,9}))?)?(?:\s*([AaPp])\.?[Mm]\.?)?\s*(Z|[+-]\d\d:?\d\d)?"
)
_MONTHS = {
    "jan": 1, "feb": 2, "mar": 3, "apr": 4, "may": 5, "jun": 6, "jul": 7, "aug": 8, "sep": 9, "oct": 10, "nov": 11,
    "dec": 12, "mrz": 3, "mai": 5, "okt": 10, "dez": 12,
}  # fmt: skip


def unix_seconds(text: str) -> dict[str, float]:
    """A date, or a time of day, in seconds since 1970, by the order of day, month and year in which it may be written.

    Known are ISO 8601, with or without a zone; 11/23/2026, 23/11/2026, 23.11.2026, 2026/11/23, 23-Nov-2026, Nov 23,
    2026 with times such as 14:05:33.250, 14:05:33,250, 14:05:33:250 and 2:05:33 PM behind them; and times alone. A
    date without a zone is taken as UTC: only differences count. What float64 holds of it, a quarter of a microsecond,
    is finer than what the text can say.

    Returns:
        Seconds by each of `ORDERS` in which it is a date; under "" where there is no choice.

    Raises:
        ValueError: the text is none of these.
    """
    text = text.strip()
    if text[4:5] == "-":
        with suppress(ValueError):
            return {"": _seconds(datetime.fromisoformat(text))}
    if _CLOCK.fullmatch(text):
        return {"": _time_of_day(text, longest=9999)}
    begin = next((found for form in _FORMS if (found := form.match(text))), None)
    if not begin:
        raise ValueError(f"{text!r} is not a date")
    rest = _BETWEEN.sub("", text[begin.end() :], count=1)
    clock = _time_of_day(rest, longest=23) if begin.end() < len(text) else 0.0
    return {name: day * _DAY + clock for name, day in _days(begin[0]).items()}


@lru_cache(maxsize=4096)  # days repeat
def _days(text: str) -> dict[str, int]:
    """Days since 1970 by the order in which a date may be written, "" for one that leaves no choice."""
    days = dict[str, int]()
    for form, orders in _FORMS.items():
        if found := form.fullmatch(text):
            for order, parts in orders.items():
                with suppress(ValueError):
                    days[order] = _day(*(found[part] for part in parts))
    if not days:
        raise ValueError(f"{text!r} is not a date")
    return days


def _day(year: str, month: str, day: str) -> int:
    """Days from 1970 to a date; a year of two digits is one of this century."""
    if len(year) not in (2, 4):
        raise ValueError(f"{year!r} is no year")
    number = int(month) if month.isdigit() else _MONTHS.get(month[:3].lower(), 0)
    return (date(int(year) + 2000 * (len(year) == 2), number, int(day)) - _EPOCH.date()).days


def _time_of_day(text: str, longest: int) -> float:
    """A time of day in s, less its zone; up to so many hours."""
    found = _CLOCK.fullmatch(text.strip())
    if not found:
        raise ValueError(f"{text!r} is no time of day")
    hours, minutes, seconds, parts, half, zone = found.groups()
    hour = int(hours)
    if half:
        if not 1 <= hour <= 12:
            raise ValueError(f"{text!r} is no time of day")
        hour = hour % 12 + 12 * (half in "Pp")
    if hour > longest or int(minutes) > 59 or int(seconds or 0) > 59:
        raise ValueError(f"{text!r} is no time of day")
    zone = (zone or "Z").replace(":", "")
    ahead = 0 if zone == "Z" else int(f"{zone[0]}1") * (3600 * int(zone[1:3]) + 60 * int(zone[3:5]))
    whole = hour * 3600 + 60 * int(minutes) + int(seconds or 0) - ahead
    return whole + int((parts or "0").ljust(9, "0")) * 1e-9


def _seconds(when: datetime) -> float:
    since = (when if when.tzinfo else when.replace(tzinfo=UTC)) - _EPOCH
    return (since.days * 86400 + since.seconds) + since.microseconds * 1e-6


def zoned(text: str) -> bool:
    """Whether a date says its zone."""
    return bool(re.search(r"(?:Z|[+-]\d\d:?\d\d)$", text.strip())) and ":" in text


def date_text(seconds: float) -> str:
    """Seconds since 1970 as a date, to the microsecond."""
    if seconds != seconds:
        return "nan"
    when = _EPOCH + timedelta(seconds=float(seconds))
    return when.replace(tzinfo=None).isoformat(sep=" ")


_EARLIEST, LATEST = 946_684_800.0, 4_102_444_800.0  # s; the years 2000 and 2100
_LONGEST = 1e7  # s, nearly four months: as milliseconds, a clock's microseconds since its start would last longer


def from_first(seconds: np.ndarray) -> tuple[np.ndarray, float | None]:
    """Seconds since 1970 as seconds since the first of them, and that; others as they are, and None.

    To the microsecond, which is what float64 holds of seconds since 1970.
    """
    known = seconds[np.isfinite(seconds)]
    if not known.size or not _is_unix(float(known.min()), float(known.max())):
        return seconds, None
    first = float(known.min())
    return np.round(seconds - first, 6), first


def _is_unix(low: float, high: float) -> bool:
    """Whether seconds between these are seconds since 1970."""
    return low >= _EARLIEST and high <= LATEST


def unit_of_counts(values: np.ndarray) -> str | None:
    """The unit in which numbers count from 1970: s, ms, us or ns; None if they do not, or might not."""
    known = values[np.isfinite(values)]
    if not known.size:
        return None
    low, high = float(known.min()), float(known.max())
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)):
        if _is_unix(low * size, high * size) and (high - low) * size <= _LONGEST:
            return unit
    return None
