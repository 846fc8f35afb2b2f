"""A compensation program as text, by templates: C99, Python, or a page with JavaScript.

The page answers: sliders, the corrected reading with its band, each effect's share. It is one HTML file without server
or network (its content policy forbids both). Its arithmetic is JavaScript written from the same graph of operations as
the C header, and computes the same; names are text only, since the script knows inputs, coefficients and effects by
number.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from markupsafe import Markup

from bayescal._core.errors import InputError
from bayescal._core.quoting import html_text, identifier, number_text, one_line, python_string
from bayescal._data.time_in_runs import RATE_WINDOW, SILENCE_WINDOWS
from bayescal._data.unit_conversion import unit_label
from bayescal._use.compensation_program import (
    PAST,
    STEPS,
    STIMULUS,
    CompensationProgram,
    Input,
)
from bayescal._use.export_template import code_template, include_guard
from bayescal._use.expression_graph import JAVASCRIPT, Language, statements

TICKS = 500  # steps of a slider: a step is less than a pixel of a wide one
BAND = 1.959964  # standard uncertainties on either side that hold 95 % of a normal distribution


class ShownEffect(NamedTuple):
    """An effect, and its unknowns by number: `linear` are its coefficients, `others` its shapes."""

    name: str
    equation: str
    linear: tuple[int, ...]
    others: tuple[int, ...]


def page(program: CompensationProgram) -> str:
    """The page, as HTML."""
    shown = [i for i in program.inputs if i.kind != "lag slope"]
    places = {i.name: k for k, i in enumerate(program.inputs)}
    names = {name: f"x[{k}]" for name, k in places.items()} | {STIMULUS: "s"}
    factor = program.factor
    return code_template("page.html.jinja", FILTERS, autoescape=True).render(
        p=program,
        about=program.about,
        why_not=program.why_not,
        notes=program.notes_on_use,
        sliders=[(places[i.name], i, i.middle) for i in shown],
        start=[i.middle for i in program.inputs],
        ranges=[(i.low, i.high) for i in program.inputs],
        ticks=TICKS,
        band=BAND,
        effects=effects_of(program),
        expected=_script(
            statements(program.graph, (program.expected, program.slope), names, JAVASCRIPT)
        ),
        gradient=_script(statements(program.graph, program.gradient, names, JAVASCRIPT)),
        factor=[number_text(factor[i, j]) for i in range(len(factor)) for j in range(i + 1)],
        steps=1 if program.affine else STEPS,
        limits=program.stimulus_limits,
    )


def effects_of(program: CompensationProgram) -> list[ShownEffect]:
    """The effects that act, each with its unknowns; what belongs to none of them stands last, as "other"."""
    known = sorted((name for name, _ in program.about.effects), key=len, reverse=True)
    found: dict[str, tuple[list[int], list[int]]] = {n: ([], []) for n, _ in program.about.effects}
    for i, unknown in enumerate(program.unknowns):
        name = next((n for n in known if unknown.name.startswith(n)), "other")
        # Then follows "", "[part]" or "(new run)" of a coefficient, ".tau" of a shape.
        rest = unknown.name.removeprefix(name)
        found.setdefault(name, ([], []))[rest.startswith(".")].append(i)
    equations = dict(program.about.effects)
    return [
        ShownEffect(name, equations.get(name, ""), tuple(linear), tuple(others))
        for name, (linear, others) in found.items()
        if linear or others
    ]


def _script(written: tuple[list[str], list[str]]) -> tuple[list[Markup], list[Markup]]:
    """Statements as they are: they hold numbers and names of the script's own, nothing from a file."""
    made, results = written
    return [Markup(line) for line in made], [Markup(line) for line in results]


def _text(text: Any) -> Markup:
    return Markup(html_text(one_line(text)))


def _unit(unit: str) -> Markup:
    """A unit for people; as it stands where it is none."""
    try:
        return _text(unit_label(unit))
    except InputError:
        return _text(unit)


def _meaning(i: Input) -> str:
    """What an input is, without the recursion that firmware needs."""
    return re.split("[,:]", i.meaning)[0] if i.kind in PAST else i.meaning


FILTERS = {"text": _text, "unit": _unit, "meaning": _meaning}


# Names that the templates give themselves.
_WORDS = "reading stimulus inputs expected slope gradient square total values outside math j dt self state now"
_OWN_WORDS = frozenset(_WORDS.split())


def program_text(
    program: CompensationProgram, language: Language, name: str, uncertainty: bool
) -> str:
    """The C99 header or the Python module, from its template."""
    outputs = (program.expected, program.slope), program.gradient if uncertainty else ()
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
        guard=include_guard(
            name, expected, gradient, factor, program.noise, program.inputs, uncertainty
        ),
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
