"""A compensation program as a file: JSON, which is read back; C99 or Python, by the templates beside this file."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from bayescal._core.atomic_file import write_text
from bayescal._core.errors import InputError
from bayescal._core.json_shape import read_json
from bayescal._core.quoting import (
    c_comment,
    identifier,
    number_text,
    python_string,
    python_words,
)
from bayescal._use.compensation_program import (
    STEPS,
    STIMULUS,
    CompensationProgram,
    from_data,
)
from bayescal._use.expression_graph import OPERATIONS, Graph

FORMATS = {".json": "json", ".h": "c", ".py": "python"}


def export(program: CompensationProgram, path: str | Path, format: str | None = None) -> Path:
    """Write as .h (C99), .py (Python) or .json; beside and then renamed.

    Raises:
        InputError: another suffix or format, or a place that cannot be written to.
    """
    path = Path(path)
    format = format or FORMATS.get(path.suffix.lower(), "")
    if format not in FORMATS.values():
        raise InputError(
            f"a compensator cannot be written as {format or path.name!r}: choose json, c or python "
            "(.json, .h, .py)"
        )
    return write_text(as_text(program, format), path)


def load_program(path: Path) -> CompensationProgram:
    """A program from a JSON export.

    Raises:
        InputError: there is no such file, or what `from_data` refuses.
    """
    if not path.is_file():
        raise InputError(f"there is no file {path}: give a compensator exported as JSON")
    try:
        data = read_json(path)
    except ValueError as error:
        raise InputError(f"{path.name} is not JSON ({error}): is it a compensator?") from None
    return from_data(data, path.name)


def as_text(program: CompensationProgram, format: str) -> str:
    """The program as a C99 header ("c"), a Python module ("python") or "json"."""
    if format == "json":
        return json.dumps(program.data(), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    return _from_template(program, format)


# Names that the templates give themselves.
_WORDS = "reading stimulus inputs expected slope gradient square total values outside math j"
_OWN_WORDS = frozenset(_WORDS.split())


def _from_template(program: CompensationProgram, language: str) -> str:
    """The C99 header or the Python module, from its template."""
    from jinja2 import Environment, PackageLoader, StrictUndefined  # only an export needs it

    fields: dict[str, str] = {}
    for i in program.inputs:
        name = identifier(i.name, _OWN_WORDS | set(fields.values()))
        fields[i.name] = f"{name}_" if re.fullmatch(r"t\d+", name) else name
    own = {k: f"in->{v}" for k, v in fields.items()} if language == "c" else dict(fields)
    names = {**own, STIMULUS: "stimulus"}
    first = _statements(program.graph, (program.expected, program.slope), names, language)
    second = _statements(program.graph, program.gradient, names, language)
    factor = program.factor
    environment = Environment(
        loader=PackageLoader("bayescal._use"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    words = c_comment if language == "c" else python_words
    environment.filters |= {"comment": words, "quoted": python_string, "number": number_text}
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
        factor=[number_text(factor[i, j]) for i in range(len(factor)) for j in range(i + 1)],
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


def _uses(program: CompensationProgram, outputs: Sequence[int]) -> bool:
    return any(program.graph.nodes[n].value == STIMULUS for n in program.graph.needed(outputs))


def _uses_inputs(program: CompensationProgram, outputs: Sequence[int]) -> bool:
    nodes = (program.graph.nodes[n] for n in program.graph.needed(outputs))
    return any(n.op == "input" and n.value != STIMULUS for n in nodes)


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


def _statements(
    graph: Graph, outputs: Sequence[int], names: Mapping[str, str], language: str
) -> tuple[list[str], list[str]]:
    """Statements, one for each operation, and the expressions of the outputs.

    Args:
        graph, outputs: what is written.
        names: of the inputs, as the language writes them.
        language: "c" or "python".
    """
    text, statements, count = {}, [], 0
    number = _c_number if language == "c" else _python_number
    for place in graph.needed(outputs):
        node = graph.nodes[place]
        if node.op == "const":
            text[place] = number(node.value)  # pyright: ignore[reportArgumentType]
        elif node.op == "input":
            text[place] = names[str(node.value)]
        else:
            form = getattr(OPERATIONS[node.op], language)
            made = form.format(*(text[a] for a in node.args))
            kind = "int" if graph.boolean(place) else "BAYESCAL_REAL"
            left = f"const {kind} t{count}" if language == "c" else f"t{count}"
            statements.append(f"{left} = {made}" + (";" if language == "c" else ""))
            text[place] = f"t{count}"
            count += 1
    return statements, [text[o] for o in outputs]
