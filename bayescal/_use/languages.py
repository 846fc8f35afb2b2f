"""What exports are written in: C99, Python, JavaScript, each with its numbers and statements."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from bayescal._core import templates
from bayescal._core.quoting import c_comment, number_text, python_words
from bayescal._use.compensation_program import CompensationProgram
from bayescal._use.expression_graph import OPERATIONS


@dataclass(frozen=True)
class Language:
    """A language that exports are written in.

    Attributes:
        name: its form in the table of operations.
        number: a constant.
        statement: of a name and an expression; the same of one that is true or false.
        input: an input as it is written, of its field.
        template: file beside this one that writes the program, if it is one by itself.
        words: text within a comment.
    """

    name: Literal["c", "python", "javascript"]
    number: Callable[[float | bool], str]
    statement: str
    statement_boolean: str
    input: str = "{}"
    template: str = ""
    words: Callable[[Any], str] = str


def _python_number(value: float | bool) -> str:
    if isinstance(value, bool) or math.isfinite(value):
        return repr(value) if value >= 0 else f"({value!r})"
    return "math.nan" if math.isnan(value) else "math.inf" if value > 0 else "-math.inf"


def _c_number(value: float | bool) -> str:
    if isinstance(value, bool):
        return "1" if value else "0"
    if not math.isfinite(value):
        return "(BAYESCAL_REAL)" + (
            "NAN" if math.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"
        )
    return f"(BAYESCAL_REAL){value!r}" if value >= 0 else f"(BAYESCAL_REAL)({value!r})"


def _javascript_number(value: float | bool) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "(-Infinity)"
    return repr(value) if math.copysign(1.0, value) > 0 else f"({value!r})"


PYTHON = Language(
    *("python", _python_number, "{} = {}", "{} = {}"),
    template="compensator.py.jinja",
    words=python_words,
)
C = Language(
    *("c", _c_number, "const BAYESCAL_REAL {} = {};", "const int {} = {};"),
    input="in->{}",
    template="compensator.h.jinja",
    words=c_comment,
)
JAVASCRIPT = Language("javascript", _javascript_number, "const {} = {};", "const {} = {};")
LANGUAGES = {"c": C, "python": PYTHON}


def statements(
    program: CompensationProgram,
    outputs: Sequence[int],
    names: Mapping[str, str],
    language: Language,
) -> tuple[list[str], list[str]]:
    """Statements, one for each operation, and the expressions of the outputs.

    Args:
        program, outputs: what is written.
        names: of the inputs, as the language writes them.
        language: to write.
    """
    graph, text, written = program.graph, dict[int, str](), list[str]()
    for place in graph.needed(outputs):
        node = graph.nodes[place]
        if node.op == "const":
            text[place] = language.number(node.value)  # pyright: ignore[reportArgumentType]
        elif node.op == "input":
            text[place] = names[str(node.value)]
        else:
            made = getattr(OPERATIONS[node.op], language.name).format(*(text[a] for a in node.args))
            form = language.statement_boolean if graph.boolean(place) else language.statement
            text[place] = f"t{len(written)}"
            written.append(form.format(text[place], made))
    return written, [text[o] for o in outputs]


def template(file: str, filters: Mapping[str, Callable[..., Any]], autoescape: bool = False):
    """A template beside this file, in which `number` writes a number with all its digits."""
    filters = {"number": number_text, **filters}
    how = {"autoescape": autoescape, "keep_trailing_newline": True}
    return templates.template("bayescal._use", file, filters, **how)
