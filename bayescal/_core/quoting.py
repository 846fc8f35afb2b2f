"""Quoting of text for other languages: names of files, columns, devices and effects may hold anything.

Text written for a compiler, an interpreter, a browser or a spreadsheet passes through the function of that language
here, and numbers through `number_text`, so that none of it is read as code, markup or a formula.
"""

from __future__ import annotations

import builtins
import csv
import html
import io
import keyword
import re
import unicodedata
from collections.abc import Collection, Iterable
from typing import Any

_SPELLINGS = (
    "·|* ×|x −|- –|- —|- √|sqrt ±|+- °|deg␣ µ|u ≤|<= ≥|>= ≈|~ ∞|inf ∂|d →|-> ∫|int␣ ′|' ’|' ‘|' “|\" ”|\" ‰|per␣mille "
    "\u2044|/ ß|ss \u0303|~ \u0302|^ \u0304|_mean \u0307|_dot"
)
_SPELLED = {pair[0]: pair[2:].replace("␣", " ") for pair in _SPELLINGS.split()}
_GREEK = r"GREEK (SMALL|CAPITAL) LETTER (\w+)"


def ascii_text(text: str) -> str:
    """Transliterate text to ASCII, with a spelling for every character: T̃ as T~, τ as tau, ² as ^2, € as <U+20AC>.

    Marks that make another symbol stay (ẋ as x_dot), accents of a language go (é as e).
    """
    spelled = "".join(map(_transliterate, unicodedata.normalize("NFC", text)))
    return re.sub(r"(?<=[\^_][-+0-9])[\^_](?=[0-9])", "", spelled)  # ^-^6 is ^-6


def _transliterate(character: str) -> str:
    if character.isascii() or character in _SPELLED:
        return _SPELLED.get(character, character)
    if greek := re.fullmatch(_GREEK, unicodedata.name(character, "")):
        return greek[2].lower() if greek[1] == "SMALL" else greek[2].capitalize()
    kind, _, parts = unicodedata.decomposition(character).rpartition("> ")
    if parts:
        before = {"<super": "^", "<sub": "_"}.get(kind, "")
        return before + "".join(_transliterate(chr(int(part, 16))) for part in parts.split())
    return "" if unicodedata.combining(character) else f"<U+{ord(character):04X}>"


def one_line(text: Any) -> str:
    """Format text in one line: characters that do not print (controls, direction marks) as <U+001B>."""
    return "".join(
        c if c.isprintable() else " " if c.isspace() else f"<U+{ord(c):04X}>" for c in str(text)
    )


_JOINT = r"(?<=\*)(?=/)|(?<=/)(?=\*)|(?<=\?)(?=\?)|^(?=[*/])|(?<=[*/])$"


def c_comment(text: Any) -> str:
    """Quote text within a comment of C: ASCII, one line; it neither ends a comment nor begins one, and splices no line.

    Backslashes become slashes first, so that no later one completes a `*/`.
    """
    return re.sub(_JOINT, " ", _quote(text))


def python_words(text: Any) -> str:
    """Quote text within a docstring or a comment of Python: ASCII, one line, no double quote and no backslash."""
    return _quote(text).replace('"', "'")


def _quote(text: Any) -> str:
    return " ".join(ascii_text(one_line(text)).replace("\\", "/").split())


def python_string(text: Any) -> str:
    """Quote text as a string of Python, its quotes included; ASCII."""
    return '"' + str(text).encode("unicode_escape").decode("ascii").replace('"', r"\"") + '"'


_WORDS_OF_C = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
    "asm typeof linux unix i386 errno complex imaginary bool true false stdin stdout stderr"
)
_TAKEN_BY_C = frozenset(_WORDS_OF_C.split())


def identifier(text: Any, taken: Collection[str] = ()) -> str:
    """Return an identifier of C and Python: no keyword, no macro of C's headers, none that is taken."""
    # A name from a column or an effect goes into C and Python alike: the stricter of the two decides.
    name = re.sub(r"\W+", "_", str(text), flags=re.ASCII).strip("_") or "x"
    name = name if not name[0].isdigit() else f"x_{name}"
    name += "_" * name.isupper()  # as macros of C are: NAN, INFINITY
    while (
        name in taken or name in _TAKEN_BY_C or keyword.iskeyword(name) or hasattr(builtins, name)
    ):
        name += "_"
    return name


def number_text(value: Any) -> str:
    """Format a number as every language here reads it, with all its digits; raise TypeError for text."""
    if isinstance(value, str | bytes):
        raise TypeError(f"{value!r} is text, a number was expected")
    return repr(float(value))


def html_text(text: Any) -> str:
    """Escape text of HTML or of an attribute in quotes: no tag begins, no attribute ends."""
    return html.escape(str(text))


_FORMULA = r"[=+\-@\t\r]"
_A_NUMBER = r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)"


def csv_cell(text: Any) -> str:
    """Quote a cell so that no spreadsheet takes it for a formula: one that begins like it gets an apostrophe before it.

    Numbers stay as they are. `csv_cell_read` is the inverse.
    """
    text = str(text)
    begins = re.match(_FORMULA, text.lstrip("'"))
    return f"'{text}" if begins and not re.fullmatch(_A_NUMBER, text) else text


def csv_cell_read(text: str) -> str:
    """Return the text of a cell that `csv_cell` quoted."""
    return text[1:] if text.startswith("'") and re.match(_FORMULA, text.lstrip("'")) else text


def csv_line(cells: Iterable[Any], separator: str = ",") -> str:
    """Format cells as a line of CSV, without its end."""
    written = io.StringIO()
    csv.writer(written, delimiter=separator).writerow(map(csv_cell, cells))
    return written.getvalue().removesuffix("\r\n")
