"""A compensation program as a C99 header or a Python module, by the templates beside this file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from bayescal._compensation.expression_graph import lines

if TYPE_CHECKING:
    from bayescal._compensation.firmware import Program

STIMULUS = "(stimulus)"
STEPS = 20  # of Newton


def identifier(text: str) -> str:
    """A name that C and Python accept."""
    made = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_") or "x"
    return made if not made[0].isdigit() else f"x_{made}"


_WORDS = (
    "reading auto break case char const continue default do double else enum extern float for goto if int long "
    "inline register restrict return short signed sizeof static struct switch typedef union unsigned void "
    "volatile while and as assert class def del elif except finally from global import in is lambda nonlocal not "
    "or pass raise try with yield None True False math"
)
RESERVED = tuple(_WORDS.split())


def printed(program: Program, language: str) -> str:
    """The C99 header or the Python module, from its template."""
    from jinja2 import Environment, PackageLoader, StrictUndefined  # only an export needs it

    fields: dict[str, str] = {}
    for i in program.inputs:
        name = identifier(i.name)
        while name in RESERVED or name in fields.values() or re.fullmatch(r"t\d+", name):
            name += "_"
        fields[i.name] = name
    own = {k: f"in->{v}" for k, v in fields.items()} if language == "c" else dict(fields)
    names = {**own, STIMULUS: "stimulus"}
    first = lines(program.graph, (program.expected, program.slope), names, language)
    second = lines(program.graph, program.gradient, names, language)
    factor = program.factor
    environment = Environment(
        loader=PackageLoader("bayescal._compensation"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["comment"] = _comment
    template = environment.get_template(
        {"c": "compensator.h.jinja", "python": "compensator.py.jinja"}[language]
    )
    return template.render(
        p=program,
        about=program.about,
        name=identifier(program.about.instrument),
        fields=fields,
        expected=first,
        gradient=second,
        factor=[repr(float(factor[i, j])) for i in range(len(factor)) for j in range(i + 1)],
        steps=1 if program.affine else STEPS,
        uses_stimulus=[
            _uses(program, (program.expected, program.slope)),
            _uses(program, program.gradient),
        ],
        uses_inputs=[
            _uses_inputs(program, (program.expected, program.slope)),
            _uses_inputs(program, program.gradient),
        ],
    )


def _uses(program: Program, outputs: Sequence[int]) -> bool:
    return any(program.graph.nodes[n].value == STIMULUS for n in program.graph.needed(outputs))


def _uses_inputs(program: Program, outputs: Sequence[int]) -> bool:
    nodes = (program.graph.nodes[n] for n in program.graph.needed(outputs))
    return any(n.op == "input" and n.value != STIMULUS for n in nodes)


def _comment(text: Any) -> str:
    """Text that cannot end a comment or a docstring, in one line of ASCII where there is a spelling."""
    plain = " ".join(str(text).split())
    for seen, meant in (
        ("·", "*"),
        ("−", "-"),
        ("²", "^2"),
        ("³", "^3"),
        ("°", "deg "),
        ("µ", "u"),
        ("τ", "tau"),
        ("κ", "kappa"),
        ("–", "-"),
        ("√", "sqrt"),
    ):
        plain = plain.replace(seen, meant)
    plain = (
        plain.replace("*/", "* /")
        .replace("/*", "/ *")
        .replace("\\", "/")
        .replace('"""', "'''")
        .replace("??", "? ?")
    )
    return plain.encode("ascii", "replace").decode("ascii")
