"""Formatting of numbers, common to all printed results."""

from __future__ import annotations

import textwrap
from math import floor, log10

WIDTH = 110  # characters per line of tables and sentences


def wrap(line: str, indent: str = "  ") -> str:
    """Wrap a line to at most `WIDTH` characters; all lines but the first begin with `indent`."""
    return textwrap.fill(line, WIDTH, subsequent_indent=indent)


def number(value: float | None, digits: int = 3) -> str:
    """Format a number to significant digits, without an exponent if possible; "–" for None."""
    if value is None:
        return "–"
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        text = f"{value:.{digits}g}"
        return f"{float(text):.0f}" if "e" in text else text
    return f"{value:.{digits}g}"


def _find_scale(value: float, error: float) -> tuple[int, int]:
    """Return the power of ten to factor out (0: none) and the number of decimal places for an error of two digits."""
    # The error is given to two significant digits (JCGM 100, 7.2.6).
    error_exponent = floor(log10(error))
    largest_exponent = max(error_exponent, floor(log10(abs(value))) if value else error_exponent)
    power = largest_exponent if largest_exponent < -3 or largest_exponent > 6 else 0
    return power, max(0, 1 - error_exponent + power)


_MAX_DECIMAL_PLACES = 6  # decimal places above which an error is written in parentheses


def format_value(value: float, error: float) -> str:
    """Format value ± error: the error to two significant digits, the value to the same decimal place.

    With more than six decimal places, the error is in parentheses, in units of the last digit: 0.88819219(31) (JCGM
    100, 7.2.2). A value with a negligible error (fixed at an estimate) is formatted without it.
    """
    if not error > 1e-12 * abs(value):
        return number(value, 4)
    power, places = _find_scale(value, error)
    if places > _MAX_DECIMAL_PLACES:
        digits = round(error / 10 ** (power - places))
        text = f"{value / 10**power:z.{places}f}({digits})"
        return f"{text}e{power}" if power else text
    text = f"{value / 10**power:z.{places}f} ± {error / 10**power:.{places}f}"
    return f"({text})e{power}" if power else text


def format_interval(low: float, high: float, mean: float, error: float) -> str:
    """Format an interval "low to high" to the decimal place of the error of its mean; "–" for a negligible error."""
    if not error > 1e-12 * abs(mean):
        return "–"
    power, places = _find_scale(mean, error)
    text = f"{low / 10**power:z.{places}f} to {high / 10**power:z.{places}f}"
    return f"({text})e{power}" if power else text


def probability(p: float | None) -> str:
    """Format a probability to two decimal places, from "< 0.01" to "> 0.99"; "–" for None."""
    if p is None:
        return "–"
    if p > 0.995:
        return "> 0.99"
    return f"{p:.2f}" if p >= 0.005 else "< 0.01"
