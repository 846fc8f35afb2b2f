"""Text as data of another language: names of files, columns, devices and effects may hold anything.

Whatever is written for a compiler, an interpreter, a browser or a spreadsheet takes text through the function of that
language here, and numbers through `number_text`, so that none of it is read as code, markup or a formula.
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
_SPELLED = {one[0]: one[2:].replace("␣", " ") for one in _SPELLINGS.split()}
_GREEK = r"GREEK (SMALL|CAPITAL) LETTER (\w+)"


def ascii_text(text: str) -> str:
    """Text in ASCII, with a spelling for every character: T̃ as T~, τ as tau, ² as ^2, € as <U+20AC>.

    Marks that make another symbol of one stay (ẋ as x_dot), accents of a language go (é as e).
    """
    spelled = "".join(map(_spelled, unicodedata.normalize("NFC", text)))
    return re.sub(r"(?<=[\^_][-+0-9])[\^_](?=[0-9])", "", spelled)  # ^-^6 is ^-6


def _spelled(character: str) -> str:
    if character.isascii() or character in _SPELLED:
        return _SPELLED.get(character, character)
    if found := re.fullmatch(_GREEK, unicodedata.name(character, "")):
        return found[2].lower() if found[1] == "SMALL" else found[2].capitalize()
    kind, _, parts = unicodedata.decomposition(character).rpartition("> ")
    if parts:
        before = {"<super": "^", "<sub": "_"}.get(kind, "")
        return before + "".join(_spelled(chr(int(part, 16))) for part in parts.split())
    return "" if unicodedata.combining(character) else f"<U+{ord(character):04X}>"


def one_line(text: Any) -> str:
    """Text in one line: what does not print (controls, marks that turn the direction) as <U+001B>."""
    return "".join(
        c if c.isprintable() else " " if c.isspace() else f"<U+{ord(c):04X}>" for c in str(text)
    )


_JOINT = r"(?<=\*)(?=/)|(?<=/)(?=\*)|(?<=\?)(?=\?)|^(?=[*/])|(?<=[*/])$"


def c_comment(text: Any) -> str:
    """Text within a comment of C: ASCII, one line; it neither ends a comment nor begins one, and splices no line.

    Backslashes become slashes first, so that no later one completes a `*/`.
    """
    return re.sub(_JOINT, " ", _words(text))


def python_words(text: Any) -> str:
    """Text within a docstring or a comment of Python: ASCII, one line, no double quote and no backslash."""
    return _words(text).replace('"', "'")


def _words(text: Any) -> str:
    return " ".join(ascii_text(one_line(text)).replace("\\", "/").split())


def python_string(text: Any) -> str:
    """Text as a string of Python, its quotes included; ASCII."""
    return '"' + str(text).encode("unicode_escape").decode("ascii").replace('"', r"\"") + '"'


_WORDS_OF_C = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
    "asm typeof linux unix i386 errno complex imaginary bool true false stdin stdout stderr"
)
_TAKEN_BY_C = frozenset(_WORDS_OF_C.split())


def identifier(text: Any, taken: Collection[str] = ()) -> str:
    """A name that C and Python accept: no word of theirs, no macro of C's headers, none that is taken."""
    # A name from a column or an effect goes into C and Python alike: the stricter of the two decides.
    made = re.sub(r"\W+", "_", str(text), flags=re.ASCII).strip("_") or "x"
    made = made if not made[0].isdigit() else f"x_{made}"
    made += "_" * made.isupper()  # as macros of C are: NAN, INFINITY
    while (
        made in taken or made in _TAKEN_BY_C or keyword.iskeyword(made) or hasattr(builtins, made)
    ):
        made += "_"
    return made


def number_text(value: Any) -> str:
    """Return a number as every language here reads it, with all its digits; refuse text."""
    if isinstance(value, str | bytes):
        raise TypeError(f"{value!r} is text, a number was expected")
    return repr(float(value))


def html_text(text: Any) -> str:
    """Text of HTML or of an attribute in quotes: no tag begins, no attribute ends."""
    return html.escape(str(text))


_FORMULA = r"[=+\-@\t\r]"
_A_NUMBER = r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)"


def csv_cell(text: Any) -> str:
    """A cell that no spreadsheet takes for a formula: one that begins like it has an apostrophe before it.

    Numbers stay as they are. `csv_cell_read` gives the text back.
    """
    text = str(text)
    begins = re.match(_FORMULA, text.lstrip("'"))
    return f"'{text}" if begins and not re.fullmatch(_A_NUMBER, text) else text


def csv_cell_read(text: str) -> str:
    """The text of which `csv_cell` made a cell."""
    return text[1:] if text.startswith("'") and re.match(_FORMULA, text.lstrip("'")) else text


def csv_line(cells: Iterable[Any], separator: str = ",") -> str:
    """Cells as a line of CSV, without its end."""
    written = io.StringIO()
    csv.writer(written, delimiter=separator).writerow(map(csv_cell, cells))
    return written.getvalue().removesuffix("\r\n")
