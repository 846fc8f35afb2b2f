"""Numbers and tables as text for people: what every printed result shares."""

from __future__ import annotations

import re
import textwrap
import unicodedata
from math import floor, log10

WIDTH = 110  # columns that a table or a sentence should fit in


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


def with_error(value: float, error: float) -> str:
    """value ± error, the error to two significant digits and the value to the same place.

    A value without a sizeable error (held at an estimate, not sampled) stands alone.
    """
    if not error > 1e-9 * abs(value):
        return number(value, 4)
    power, places = _scaled(value, error)
    if places > 8:
        return f"{value:.6g} ± {error:.2g}"
    text = f"{value / 10**power:z.{places}f} ± {error / 10**power:.{places}f}"
    return f"({text})e{power}" if power else text


def interval(low: float, high: float, mean: float, error: float) -> str:
    """The two ends, to the place of the error, or one further where that is coarse."""
    if not error > 1e-9 * abs(mean):
        return "–"
    power, places = _scaled(mean, error)
    if places > 8:
        return f"{low:.6g} to {high:.6g}"
    text = f"{low / 10**power:z.{places}f} to {high / 10**power:z.{places}f}"
    return f"({text})e{power}" if power else text


def probability(p: float | None) -> str:
    if p is None:
        return "–"
    if p > 0.995:
        return "> 0.99"
    return f"{p:.2f}" if p >= 0.005 else "< 0.01"


_SPELLED: dict[str, str] = dict(
    [
        *(("·", "*"), ("×", "x"), ("−", "-"), ("–", "-"), ("—", "-"), ("√", "sqrt"), ("±", "+-")),
        *(
            ("°", "deg "),
            ("µ", "u"),
            ("≤", "<="),
            ("≥", ">="),
            ("≈", "~"),
            ("∞", "inf"),
            ("∂", "d"),
        ),
        *(
            ("→", "->"),
            ("∫", "int "),
            ("′", "'"),
            ("’", "'"),
            ("‘", "'"),
            ("“", '"'),
            ("”", '"'),
            ("‰", "per mille"),
            ("\u2044", "/"),
            ("ß", "ss"),
        ),
        *(("\u0303", "~"), ("\u0302", "^"), ("\u0304", "_mean"), ("\u0307", "_dot")),
    ]
)
_GREEK = re.compile(r"GREEK (SMALL|CAPITAL) LETTER (\w+)")


def ascii_text(text: str) -> str:
    """Text in ASCII, with a spelling for every character: T̃ as T~, τ as tau, ² as ^2, € as <U+20AC>.

    Marks that make another symbol of one stay (ẋ as x_dot), accents of a language go (é as e).
    """
    spelled = "".join(map(_spelled, unicodedata.normalize("NFC", text)))
    return re.sub(r"(?<=[\^_][-+0-9])[\^_](?=[0-9])", "", spelled)  # ^-^6 is ^-6


def _spelled(character: str) -> str:
    if character.isascii() or character in _SPELLED:
        return _SPELLED.get(character, character)
    if found := _GREEK.fullmatch(unicodedata.name(character, "")):
        return found[2].lower() if found[1] == "SMALL" else found[2].capitalize()
    kind, _, parts = unicodedata.decomposition(character).rpartition("> ")
    if parts:
        before = {"<super": "^", "<sub": "_"}.get(kind, "")
        return before + "".join(_spelled(chr(int(part, 16))) for part in parts.split())
    return "" if unicodedata.combining(character) else f"<U+{ord(character):04X}>"
