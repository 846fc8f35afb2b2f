"""A compensation program as a file: JSON, which is read back; by templates C99, Python, or a page with JavaScript."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

from bayescal._core.atomic_file import write_text
from bayescal._core.errors import InputError
from bayescal._core.json_shape import read_json
from bayescal._core.quoting import identifier, number_text, python_string
from bayescal._use.answering_page import page
from bayescal._use.compensation_program import (
    STEPS,
    STIMULUS,
    CompensationProgram,
    from_data,
)
from bayescal._use.languages import LANGUAGES, Language, statements, template

FORMATS = {".json": "json", ".h": "c", ".py": "python", ".html": "html"}


def export(program: CompensationProgram, path: str | Path, format: str | None = None) -> Path:
    """Write as .h (C99), .py (Python), .html (a page) or .json; beside and then renamed.

    Raises:
        InputError: another suffix or format, or a place that cannot be written to.
    """
    path = Path(path)
    format = format or FORMATS.get(path.suffix.lower(), "")
    if format not in FORMATS.values():
        raise InputError(
            f"a compensator cannot be written as {format or path.name!r}: choose json, c, python "
            "or html (.json, .h, .py, .html)"
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
    """The program as a C99 header ("c"), a Python module ("python"), a page ("html") or "json"."""
    if format == "json":
        return json.dumps(program.data(), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    if format == "html":
        return page(program)
    return _from_template(program, LANGUAGES[format])


# Names that the templates give themselves.
_WORDS = "reading stimulus inputs expected slope gradient square total values outside math j"
_OWN_WORDS = frozenset(_WORDS.split())


def _from_template(program: CompensationProgram, language: Language) -> str:
    """The C99 header or the Python module, from its template."""
    fields: dict[str, str] = {}
    for i in program.inputs:
        name = identifier(i.name, _OWN_WORDS | set(fields.values()))
        fields[i.name] = f"{name}_" if re.fullmatch(r"t\d+", name) else name
    names = {**{k: language.input.format(v) for k, v in fields.items()}, STIMULUS: "stimulus"}
    factor = program.factor
    words = language.words
    return template(language.template, {"comment": words, "quoted": python_string}).render(
        p=program,
        about=program.about,
        name=identifier(program.about.instrument),
        fields=fields,
        expected=statements(program, (program.expected, program.slope), names, language),
        gradient=statements(program, program.gradient, names, language),
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
