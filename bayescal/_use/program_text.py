"""A compensation program as text, by templates: C99 or Python; and what the templates of exports begin with."""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from bayescal._core.quoting import identifier, number_text, python_string
from bayescal._core.templates import template
from bayescal._data.time_in_runs import RATE_WINDOW, SILENCE_WINDOWS
from bayescal._use.compensation_program import (
    PAST,
    STEPS,
    STIMULUS,
    CompensationProgram,
    Input,
)
from bayescal._use.expression_graph import Language, statements

# Names that the templates give themselves.
_WORDS = "reading stimulus inputs expected slope gradient noise square total values outside math j dt self state now"
_OWN_WORDS = frozenset(_WORDS.split())


def program_text(
    program: CompensationProgram, language: Language, name: str, uncertainty: bool
) -> str:
    """The C99 header or the Python module, from its template."""
    outputs = (program.expected, program.slope), (program.noise, *program.gradient) * uncertainty
    if not uncertainty:  # nor what only the uncertainty depends on
        needed = program.graph.inputs(outputs[0])
        program = replace(program, inputs=tuple(i for i in program.inputs if i.name in needed))
    fields: dict[str, str] = {}
    for i in program.inputs:
        own = identifier(i.name, _OWN_WORDS | set(fields.values()))
        fields[i.name] = f"{own}_" if re.fullmatch(r"t\d+", own) else own
    names = {**{k: language.input.format(v) for k, v in fields.items()}, STIMULUS: "stimulus"}
    lower = program.factor
    factor = [number_text(lower[i, j]) for i in range(len(lower)) for j in range(i + 1)]
    expected, gradient = (statements(program.graph, one, names, language) for one in outputs)
    used = [program.graph.inputs(one) for one in outputs]
    filters = {"comment": language.words, "quoted": python_string}
    return template("bayescal._use", language.template, filters).render(
        p=program,
        about=program.about,
        name=name,
        guard=include_guard(name, expected, gradient, factor, program.inputs, uncertainty),
        uncertainty=uncertainty,
        fields=fields,
        record=_record(program, fields),
        expected=expected,
        gradient=gradient,
        factor=factor,
        steps=1 if program.affine else STEPS,
        uses_stimulus=[STIMULUS in one for one in used],
        uses_inputs=[bool(one - {STIMULUS}) for one in used],
    )


def _record(program: CompensationProgram, fields: Mapping[str, str]) -> dict[str, Any]:
    """What a record is corrected by, reading by reading: fields of its columns, and of what is made of their past."""
    now = [i for i in program.inputs if i.kind == "column"]
    of: dict[str, list[Input]] = {
        kind: [i for i in program.inputs if i.kind == kind] for kind in (*PAST, "elapsed")
    }
    columns = {i.column: (fields[i.name], i.unit) for i in now}
    for i in (i for i in program.inputs if i.kind in PAST and i.column not in columns):
        taken = {*_OWN_WORDS, *fields.values(), *(own for own, _ in columns.values())}
        columns.setdefault(i.column, (identifier(i.column, taken), "degC"))

    def both(i: Input) -> tuple[str, str]:
        return columns[i.column][0], fields[i.name]

    lags = {(i.column, i.tau): fields[i.name] for i in of["lag"]}
    slopes = [(i, lags[i.column, i.tau]) for i in of["lag slope"]]
    window = max((i.tau or RATE_WINDOW for i in of["rate"]), default=0.0)
    return {
        "past": len(now) < len(program.inputs),
        "dated": "time" in columns,
        "columns": [*columns.values()],
        "same": [both(i) for i in now],
        "lags": [(*both(i), i.tau, i.silence, i.held) for i in of["lag"]],
        "slopes": [(*both(i), i.tau, i.silence, i.held, lag) for i, lag in slopes],
        "last": sorted({columns[i.column][0] for i in (*of["lag"], *of["lag slope"])}),
        "rates": [both(i) for i in of["rate"]],
        "elapsed": [fields[i.name] for i in of["elapsed"]],
        "window": window * (1 + 1e-9),  # as the rate of a record has it
        "silence": SILENCE_WINDOWS * window,
    }


def include_guard(name: str, *computed: Any) -> str:
    """The first lines of a header: it is taken once, and not at all where another of its name was.

    Else the second of two would be passed over without a word, and its sensor be corrected by the first.

    Args:
        name: of the sensor.
        computed: what the header computes, whose checksum is the guard's value.
    """
    stamp = f"0x{zlib.crc32(repr(computed).encode()):08x}UL"
    guard = f"BAYESCAL_{name.upper()}_H"
    return (
        f"#if defined({guard}) && {guard} != {stamp}\n"
        f"#error two sensors are called {name}: export one of them with another name\n"
        f"#endif\n#ifndef {guard}\n#define {guard} {stamp}"
    )
