"""A calibration as one page that answers: sliders, the corrected reading with its band, each effect's share.

One HTML file without server or network (its content policy forbids both). The arithmetic is JavaScript written from the
same graph of operations as the C header, and computes the same (`compensation_program.py`); names are text only, since
the script knows inputs, coefficients and effects by number.
"""

from __future__ import annotations

import re
from typing import Any, NamedTuple

from markupsafe import Markup

from bayescal._core.errors import InputError
from bayescal._core.quoting import html_text, number_text, one_line
from bayescal._data.unit_conversion import unit_label
from bayescal._use.compensation_program import STEPS, STIMULUS, CompensationProgram
from bayescal._use.inputs import PAST, Input
from bayescal._use.languages import JAVASCRIPT, statements, template

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
    return template("page.html.jinja", FILTERS, autoescape=True).render(
        p=program,
        about=program.about,
        why_not=program.about.why_not,
        notes=program.about.notes_on_use,
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
