"""Quoting of arbitrary text (names of files, columns, devices, effects) for other languages; templates.

Text for a compiler, an interpreter, a browser or a spreadsheet passes through the function of that language, numbers
through `number_text`, so that none is interpreted as code, markup or a formula.
"""

from __future__ import annotations

import builtins
import csv
import html
import io
import keyword
import re
import unicodedata
from collections.abc import Collection, Iterable, Mapping
from typing import Any

_SPELLINGS = (
    "·|* ×|x −|- –|- —|- √|sqrt ±|+- °|deg␣ µ|u ≤|<= ≥|>= ≈|~ ∞|inf ∂|d →|-> ∫|int␣ ′|' ’|' ‘|' “|\" ”|\" ‰|per␣mille "
    "\u2044|/ ß|ss \u0303|~ \u0302|^ \u0304|_mean \u0307|_dot"
)
_SPELLING_BY_CHARACTER = {pair[0]: pair[2:].replace("␣", " ") for pair in _SPELLINGS.split()}
_GREEK = r"GREEK (SMALL|CAPITAL) LETTER (\w+)"


def ascii_text(text: str) -> str:
    """Transliterate text to ASCII: T̃ as T~, τ as tau, ² as ^2, € as <U+20AC>.

    Marks that distinguish symbols are spelled out (ẋ as x_dot), accents are dropped (é as e).
    """
    spelled_text = "".join(map(_transliterate, unicodedata.normalize("NFC", text)))
    return re.sub(r"(?<=[\^_][-+0-9])[\^_](?=[0-9])", "", spelled_text)  # ^-^6 is ^-6


def _transliterate(character: str) -> str:
    if character.isascii() or character in _SPELLING_BY_CHARACTER:
        return _SPELLING_BY_CHARACTER.get(character, character)
    if greek_match := re.fullmatch(_GREEK, unicodedata.name(character, "")):
        return greek_match[2].lower() if greek_match[1] == "SMALL" else greek_match[2].capitalize()
    kind, _, codes = unicodedata.decomposition(character).rpartition("> ")
    if codes:
        prefix = {"<super": "^", "<sub": "_"}.get(kind, "")
        return prefix + "".join(_transliterate(chr(int(code, 16))) for code in codes.split())
    return "" if unicodedata.combining(character) else f"<U+{ord(character):04X}>"


def one_line(text: Any) -> str:
    """Format text as one line, each non-printing character (control, direction mark) as its code point: <U+001B>."""
    return "".join(
        c if c.isprintable() else " " if c.isspace() else f"<U+{ord(c):04X}>" for c in str(text)
    )


_JOINT = r"(?<=\*)(?=/)|(?<=/)(?=\*)|(?<=\?)(?=\?)|^(?=[*/])|(?<=[*/])$"


def c_comment(text: Any) -> str:
    """Quote text for a C comment: ASCII, one line, without comment delimiters and line continuations.

    Backslashes are replaced by slashes first, so that none completes a `*/` later.
    """
    return re.sub(_JOINT, " ", _quote(text))


def python_words(text: Any) -> str:
    """Make text safe in a Python docstring or comment: one line of ASCII, with single quotes, and / for backslashes."""
    return _quote(text).replace('"', "'")


def _quote(text: Any) -> str:
    return " ".join(ascii_text(one_line(text)).replace("\\", "/").split())


def python_string(text: Any) -> str:
    """Quote text as a Python string literal in ASCII, with its quotation marks."""
    return '"' + str(text).encode("unicode_escape").decode("ascii").replace('"', r"\"") + '"'


_C_WORDS = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
    "asm typeof linux unix i386 errno complex imaginary bool true false stdin stdout stderr"
)
_C_RESERVED = frozenset(_C_WORDS.split())


def identifier(text: Any, taken: Collection[str] = ()) -> str:
    """Convert text to an identifier valid in C and Python: no keyword, no C macro, and none of `taken`."""
    # The same identifier is used in C and Python, so that it must be valid in both.
    name = re.sub(r"\W+", "_", str(text), flags=re.ASCII).strip("_") or "x"
    name = name if not name[0].isdigit() else f"x_{name}"
    name += "_" * name.isupper()  # C macros are in upper case: NAN, INFINITY
    while (
        name in taken or name in _C_RESERVED or keyword.iskeyword(name) or hasattr(builtins, name)
    ):
        name += "_"
    return name


def number_text(value: Any) -> str:
    """Format a number with all its digits, in a form valid in all languages; raise TypeError for text."""
    if isinstance(value, str | bytes):
        raise TypeError(f"{value!r} is text, but a number was expected")
    return repr(float(value))


def html_text(text: Any) -> str:
    """Escape text for HTML content or a quoted attribute."""
    return html.escape(str(text))


_FORMULA = r"[=+\-@\t\r]"
_NUMBER = r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)"


def csv_cell(text: Any) -> str:
    """Quote a CSV cell: prefix an apostrophe to text that a spreadsheet would interpret as a formula.

    Numbers are unchanged. `csv_cell_read` is the inverse.
    """
    text = str(text)
    is_formula = re.match(_FORMULA, text.lstrip("'"))
    return f"'{text}" if is_formula and not re.fullmatch(_NUMBER, text) else text


def csv_cell_read(text: str) -> str:
    """Return the text of a cell that `csv_cell` quoted."""
    return text[1:] if text.startswith("'") and re.match(_FORMULA, text.lstrip("'")) else text


def csv_line(cells: Iterable[Any], separator: str = ",") -> str:
    """Format cells as a line of CSV, without a line end."""
    buffer = io.StringIO()
    csv.writer(buffer, delimiter=separator).writerow(map(csv_cell, cells))
    return buffer.getvalue().removesuffix("\r\n")


def template(package: str, name: str, filters: Mapping[str, Any], **options: Any) -> Any:
    """Load a template from the folder `templates` of a package; an undefined variable in it is an error.

    The filter `digits`, which formats a number with all digits, is added; `options` are those of `jinja2.Environment`.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined  # only where it is needed

    environment = Environment(
        loader=PackageLoader(package),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        **options,
    )
    environment.filters |= {"digits": number_text, **filters}
    return environment.get_template(name)
