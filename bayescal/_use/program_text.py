"""A compensation program as text, by templates: C99 or Python."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from bayescal._core.quoting import identifier, number_text, python_string
from bayescal._data.time_in_runs import RATE_WINDOW, SILENCE_WINDOWS
from bayescal._use.compensation_program import (
    PAST,
    STEPS,
    STIMULUS,
    CompensationProgram,
)
from bayescal._use.export_template import code_template, include_guard
from bayescal._use.expression_graph import Language, statements

# Names that the templates give themselves.
_WORDS = "reading stimulus inputs expected slope gradient noise square total values outside math j dt self state now"
_OWN_WORDS = frozenset(_WORDS.split())


def program_text(
    program: CompensationProgram, language: Language, name: str, uncertainty: bool
) -> str:
    """The C99 header or the Python module, from its template."""
    uncertain = (program.noise, *program.gradient) if uncertainty else ()
    outputs = (program.expected, program.slope), uncertain
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
    record = _record(program, fields)
    words = language.words
    return code_template(language.template, {"comment": words, "quoted": python_string}).render(
        p=program,
        about=program.about,
        name=name,
        guard=include_guard(name, expected, gradient, factor, program.inputs, uncertainty),
        uncertainty=uncertainty,
        fields=fields,
        record=record,
        expected=expected,
        gradient=gradient,
        factor=factor,
        steps=1 if program.affine else STEPS,
        uses_stimulus=[STIMULUS in one for one in used],
        uses_inputs=[bool(one - {STIMULUS}) for one in used],
    )


def _record(program: CompensationProgram, fields: Mapping[str, str]) -> dict[str, Any]:
    """What a record is corrected by, reading by reading: fields of its columns, and of what is made of their past."""
    past = [i for i in program.inputs if i.kind != "column"]
    columns = {i.column: fields[i.name] for i in program.inputs if i.kind == "column"}
    units = {i.column: i.unit for i in program.inputs if i.kind == "column"}
    for i in past:
        if i.kind in PAST and i.column not in columns:
            taken = {*_OWN_WORDS, *fields.values(), *columns.values()}
            columns[i.column], units[i.column] = identifier(i.column, taken), "degC"
    lags = {(i.column, i.tau): fields[i.name] for i in past if i.kind == "lag"}
    rates = [i for i in past if i.kind == "rate"]
    window = max((i.tau or RATE_WINDOW for i in rates), default=0.0)
    return {
        "past": bool(past),
        "dated": "time" in columns,
        "columns": [(columns[name], units[name]) for name in columns],
        "same": [(columns[i.column], fields[i.name]) for i in program.inputs if i.kind == "column"],
        "lags": [
            (columns[i.column], fields[i.name], i.tau, i.silence, i.held)
            for i in past
            if i.kind == "lag"
        ],
        "slopes": [
            (columns[i.column], fields[i.name], i.tau, i.silence, i.held, lags[i.column, i.tau])
            for i in past
            if i.kind == "lag slope"
        ],
        "last": sorted({columns[i.column] for i in past if i.kind.startswith("lag")}),
        "rates": [(columns[i.column], fields[i.name]) for i in rates],
        "elapsed": [fields[i.name] for i in past if i.kind == "elapsed"],
        "window": window * (1 + 1e-9),  # as the rate of a record has it
        "silence": SILENCE_WINDOWS * window,
    }
