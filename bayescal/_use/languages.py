"""What exports are written in: C99, Python, JavaScript, each with its numbers and statements."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from bayescal._core import templates
from bayescal._core.quoting import c_comment, number_text, python_words
from bayescal._use.expression_graph import OPERATIONS, Graph


@dataclass(frozen=True)
class Language:
    """A language that exports are written in.

    Attributes:
        name: its form in the table of operations.
        cast: before a constant.
        nan, infinity: constants of these.
        truths: what is false, and what is true.
        statement: of a name and an expression; the same of one that is true or false.
        input: an input as it is written, of its field.
        template: file beside this one that writes the program, if it is one by itself.
        words: text within a comment.
    """

    name: Literal["c", "python", "javascript"]
    cast: str
    nan: str
    infinity: str
    truths: tuple[str, str]
    statement: str
    statement_boolean: str
    input: str = "{}"
    template: str = ""
    words: Callable[[Any], str] = str

    def number(self, value: float | bool) -> str:
        """A constant, as an operand."""
        if isinstance(value, bool):
            return self.truths[value]
        if math.isnan(value):
            return self.cast + self.nan
        text = repr(abs(value)) if math.isfinite(value) else self.infinity
        return self.cast + (text if math.copysign(1.0, value) > 0 else f"(-{text})")


PYTHON = Language(
    *("python", "", "math.nan", "math.inf", ("False", "True"), "{} = {}", "{} = {}"),
    template="compensator.py.jinja",
    words=python_words,
)
C = Language(
    *("c", "(BAYESCAL_REAL)", "NAN", "INFINITY", ("0", "1")),
    *("const BAYESCAL_REAL {} = {};", "const int {} = {};"),
    input="in->{}",
    template="compensator.h.jinja",
    words=c_comment,
)
JAVASCRIPT = Language(
    *("javascript", "", "NaN", "Infinity", ("false", "true"), "const {} = {};", "const {} = {};")
)
LANGUAGES = {"c": C, "python": PYTHON}


def statements(
    graph: Graph, outputs: Sequence[int], names: Mapping[str, str], language: Language
) -> tuple[list[str], list[str]]:
    """Statements, one for each operation, and the expressions of the outputs.

    Args:
        graph, outputs: what is written.
        names: of the inputs, as the language writes them.
        language: to write.
    """
    text, written = dict[int, str](), list[str]()
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
