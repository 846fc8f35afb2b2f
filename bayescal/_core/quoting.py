"""Quoting of names (of files, columns, devices, effects) and numbers for C, Python, HTML and CSV; templates.

Text for a compiler, an interpreter, a browser or a spreadsheet passes through the function of that language, numbers
through `format_digits`, so that none is interpreted as code, markup or a formula.
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
_GREEK_NAME = r"GREEK (SMALL|CAPITAL) LETTER (\w+)"


def to_ascii(text: str) -> str:
    """Transliterate text to ASCII: τ as tau, ² as ^2; other characters as code points, such as € as <U+20AC>.

    Combining marks of symbols are spelled out (T̃ as T~, ẋ as x_dot); accents are dropped (é as e).
    """
    spelled_text = "".join(map(_transliterate, unicodedata.normalize("NFC", text)))
    return re.sub(r"(?<=[\^_][-+0-9])[\^_](?=[0-9])", "", spelled_text)  # ^-^6 is ^-6


def _transliterate(character: str) -> str:
    if character.isascii() or character in _SPELLING_BY_CHARACTER:
        return _SPELLING_BY_CHARACTER.get(character, character)
    if greek_match := re.fullmatch(_GREEK_NAME, unicodedata.name(character, "")):
        return greek_match[2].lower() if greek_match[1] == "SMALL" else greek_match[2].capitalize()
    kind, _, codes = unicodedata.decomposition(character).rpartition("> ")
    if codes:
        prefix = {"<super": "^", "<sub": "_"}.get(kind, "")
        return prefix + "".join(_transliterate(chr(int(code, 16))) for code in codes.split())
    return "" if unicodedata.combining(character) else f"<U+{ord(character):04X}>"


def to_printable(text: Any) -> str:
    """Format text as one line: line breaks as blanks, other unprintable characters as code points, such as <U+001B>."""
    return "".join(
        c if c.isprintable() else " " if c.isspace() else f"<U+{ord(c):04X}>" for c in str(text)
    )


_COMMENT_DELIMITER_GAP = r"(?<=\*)(?=/)|(?<=/)(?=\*)|(?<=\?)(?=\?)|^(?=[*/])|(?<=[*/])$"


def quote_c_comment(text: Any) -> str:
    """Quote text for a C comment: one line of ASCII without comment delimiters, trigraphs or line continuations.

    Backslashes are replaced by slashes first, so that such a slash cannot form a delimiter.
    """
    return re.sub(_COMMENT_DELIMITER_GAP, " ", _to_ascii_line(text))


def quote_python_comment(text: Any) -> str:
    """Quote text for a Python docstring or comment: one line of ASCII, with ' for " and slashes for backslashes."""
    return _to_ascii_line(text).replace('"', "'")


def _to_ascii_line(text: Any) -> str:
    return " ".join(to_ascii(to_printable(text)).replace("\\", "/").split())


def quote_python(text: Any) -> str:
    """Format text as a Python string literal in ASCII, with quotation marks."""
    return '"' + str(text).encode("unicode_escape").decode("ascii").replace('"', r"\"") + '"'


_C_WORDS = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
    "asm typeof linux unix i386 errno complex imaginary bool true false stdin stdout stderr"
)
_C_RESERVED = frozenset(_C_WORDS.split())


def to_identifier(text: Any, taken: Collection[str] = ()) -> str:
    """Convert text to an identifier not in `taken` and not reserved in C or Python (keyword, macro, builtin)."""
    name = re.sub(r"\W+", "_", str(text), flags=re.ASCII).strip("_") or "x"
    name = name if not name[0].isdigit() else f"x_{name}"
    name += "_" * name.isupper()  # C macros are in upper case: NAN, INFINITY
    reserved = {*taken, *_C_RESERVED, *keyword.kwlist, *dir(builtins)}
    while name in reserved:
        name += "_"
    return name


def format_digits(value: Any) -> str:
    """Format a number with all its digits as a literal valid in C, Python and JSON; raise TypeError for text."""
    if isinstance(value, str | bytes):
        raise TypeError(f"{value!r} is text, but a number was expected")
    return repr(float(value))


def escape_html(text: Any) -> str:
    """Escape text for HTML content or a quoted attribute."""
    return html.escape(str(text))


_FORMULA_START = r"[=+\-@\t\r]"
_NUMBER_PATTERN = r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)"


def quote_cell(text: Any) -> str:
    """Format a CSV cell: prefix an apostrophe to text that a spreadsheet would interpret as a formula.

    Numbers are unchanged. `unquote_cell` is the inverse.
    """
    text = str(text)
    is_formula = re.match(_FORMULA_START, text.lstrip("'"))
    return f"'{text}" if is_formula and not re.fullmatch(_NUMBER_PATTERN, text) else text


def unquote_cell(text: str) -> str:
    """Return the text of a cell that `quote_cell` quoted."""
    return text[1:] if text.startswith("'") and re.match(_FORMULA_START, text.lstrip("'")) else text


def format_csv_line(cells: Iterable[Any], separator: str = ",") -> str:
    """Format cells as a line of CSV, quoted by `quote_cell`, without a line end."""
    buffer = io.StringIO()
    csv.writer(buffer, delimiter=separator).writerow(map(quote_cell, cells))
    return buffer.getvalue().removesuffix("\r\n")


def load_template(package: str, name: str, filters: Mapping[str, Any], **options: Any) -> Any:
    """Load a Jinja template from the folder `templates` of a package; undefined variables raise an error at rendering.

    `filters` are added, and `digits`, which formats a number with all digits; `options`: of `jinja2.Environment`.
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
    environment.filters |= {"digits": format_digits, **filters}
    return environment.get_template(name)
