"""Dates and times of day as people log them, as seconds since 1970 (UTC)."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta

import numpy as np

EXAMPLE = "2026-11-22 10:00:00.123"
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_DAY_FIRST = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})")  # with points the day always comes first
_TIME_ONLY = re.compile(r"\d{1,2}:\d\d(:\d\d.*)?")


def unix_seconds(text: str) -> float:
    """A date in ISO 8601, with or without a zone, day.month.year, year/month/day, or a time of day, in s since 1970.

    A date without a zone is taken as UTC: only differences count. What float64 holds of it, a quarter of a
    microsecond, is finer than what the text can say.

    Raises:
        ValueError: the text is none of these. Where days and months could be exchanged (05/06/2026) it is none.
    """
    text = text.strip()
    if _TIME_ONLY.fullmatch(text):
        text = f"1970-01-01 {text.zfill(8) if text[1] == ':' else text}"
    elif found := _DAY_FIRST.match(text):
        day, month, year = found.groups()
        text = f"{year}-{month:0>2}-{day:0>2}{text[found.end() :]}"
    elif text[4:5] == "/":
        text = text.replace("/", "-", 2)
    elif text[4:5] != "-":
        raise ValueError(f"{text!r} is no date")
    return _seconds(datetime.fromisoformat(text))


def exchangeable(texts: Iterable[str]) -> str:
    """What to do about dates that leave open which number is the day, as 05/06/2026; empty if there are none."""
    if any(re.match(r"\s*\d{1,2}[/-]\d{1,2}[/-]\d{2,4}\b", text) for text in texts):
        return "Day and month could be exchanged: write the year first, or points (22.11.2026)"
    return ""


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
