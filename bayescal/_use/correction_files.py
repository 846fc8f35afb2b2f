"""Corrections as files (C99, Python, JSON, …), of one output or of three axes: one exporter, one loader, one naming.

What kinds of corrections there are beside those of one output, annexes say (`_core/annex.py`). Everything in a C
header carries the name of its sensor, so that those of several go into one program. Two of one name are refused by the
compiler.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from bayescal._core.annex import offered
from bayescal._core.as_json import json_text
from bayescal._core.errors import InputError
from bayescal._core.inverse import STEPS
from bayescal._core.json_shape import read_json
from bayescal._core.quoting import identifier, number_text, python_string
from bayescal._core.templates import template
from bayescal._data.records import RATE_WINDOW, SILENCE_WINDOWS
from bayescal._use.compensation_program import (
    KINDS,
    PAST,
    SCHEMA,
    CompensationProgram,
    CorrectionInUse,
    Input,
    from_data,
)
from bayescal._use.expression_graph import LANGUAGES, Language, statements
from bayescal._use.operating_equation import STIMULUS

Writer = Callable[[Mapping[str, Any], bool], str]
"""Writes corrections by the names of their sensors, with or without uncertainty."""


class CorrectionKind(NamedTuple):
    """A kind of corrections: how they are told, written, read back and made."""

    of: type[CorrectionInUse]  # their class
    axes: str  # what they are of, in words, such as "three axes"
    writers: Mapping[str, Writer]  # by format
    suffixes: Mapping[str, str]  # formats by the suffix of a file
    is_data: Callable[[Mapping[str, Any]], bool]  # whether JSON is one of them
    # one from JSON and the name of its file, for messages; `InputError` if it is damaged
    read: Callable[[Any, str], CorrectionInUse]
    loader: str  # the public function that does
    together: tuple[str, ...] = ()  # formats that hold several
    # what a format has no place for, in a sentence; empty for nothing
    left_out: Callable[[Any, str], str] = lambda correction, format: ""


# Names that the templates give themselves.
_WORDS = "reading stimulus inputs expected slope gradient noise square total values outside math j dt self state now"
_OWN_WORDS = frozenset(_WORDS.split())


def program_text(
    program: CompensationProgram, language: Language, name: str, uncertainty: bool
) -> str:
    """The C99 header or the Python module, from its template."""
    equation = program.equation
    outputs = (
        (equation.expected, equation.slope),
        (equation.noise, *equation.gradient) * uncertainty,
    )
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
    of = {kind: [i for i in program.inputs if i.kind == kind] for kind in KINDS}
    now = of["column"]
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

    Else the second would be passed over without a word. The guard's value is a checksum of what the header computes.
    """
    stamp = f"0x{zlib.crc32(repr(computed).encode()):08x}UL"
    guard = f"BAYESCAL_{name.upper()}_H"
    return (
        f"#if defined({guard}) && {guard} != {stamp}\n"
        f"#error two sensors are called {name}: export one of them with another name\n"
        f"#endif\n#ifndef {guard}\n#define {guard} {stamp}"
    )


def as_data(named: Mapping[str, CorrectionInUse], uncertainty: bool) -> str:
    """The writer of JSON."""
    (correction,) = named.values()
    return json_text(correction.data(), indent=1)


def in_form(write: Callable[..., str], *how: Any) -> Writer:
    """A writer of what has no place for names, nor for leaving the uncertainty out."""
    return lambda named, uncertainty: write(*named.values(), *how)


def _program(language: Language, named: Mapping[str, Any], uncertainty: bool) -> str:
    return "".join(program_text(one, language, n, uncertainty) for n, one in named.items())


ONE_OUTPUT = CorrectionKind(
    of=CompensationProgram,
    axes="one output",
    writers={"json": as_data, **{name: partial(_program, one) for name, one in LANGUAGES.items()}},
    suffixes={".json": "json", ".h": "c", ".py": "python"},
    is_data=lambda data: data.get("schema") == SCHEMA,
    read=from_data,
    loader="load_compensator",
)


def kinds() -> Iterator[CorrectionKind]:
    """The kinds of corrections: of one output, then those of annexes, which load when they are asked for."""
    yield ONE_OUTPUT
    for corrections in offered("corrections"):
        yield from corrections


def kind_of(correction: CorrectionInUse) -> CorrectionKind:
    """Return that of a correction."""
    return next(kind for kind in kinds() if isinstance(correction, kind.of))


def sensor_name(given: str | None, instrument: str) -> str:
    """What a sensor is called in C and Python: as the user says, else as its instrument.

    Raises:
        InputError: what the user says is no name there.
    """
    if given is None:
        return identifier(instrument)
    if identifier(given.lower()) != given.lower():
        raise InputError(
            f"{given!r} is no name in C and Python: letters, digits and _, a letter first, and no word of theirs, such "
            "as gyro_x"
        )
    return given


def names_in_unit(name: str | None, unit: Sequence[CorrectionInUse]) -> list[str]:
    """What the sensors of a unit are called in C and Python: after their instruments, behind a name of the unit.

    Raises:
        InputError: the name is none in C, or two are of one instrument.
    """
    of = [one.about_it()[0] for one in unit]
    if len(unit) == 1:
        return [sensor_name(name, of[0])]
    first = "" if name is None else f"{sensor_name(name, '')}_"
    found = [sensor_name(None, f"{first}{instrument}") for instrument in of]
    if twice := [n for n in found if found.count(n) > 1]:
        raise InputError(
            f"two of these are of {of[found.index(twice[0])]}: a unit has one of each; write the other to a file of "
            "its own, with a name"
        )
    return found


def format_of(path: str | Path | None, format: str | None) -> str:
    """A format, or that of a path's suffix.

    Raises:
        InputError: no format is given, and the suffix is of none.
    """
    suffix = Path(path or "").suffix.lower()
    chosen = format or next((k.suffixes[suffix] for k in kinds() if suffix in k.suffixes), None)
    if chosen is None:
        known = ", ".join(dict.fromkeys(suffix for kind in kinds() for suffix in kind.suffixes))
        raise InputError(f"{path}: a correction is written as {known}, or give the format")
    return chosen


def as_text(
    correction: CorrectionInUse,
    format: str,
    *,
    name: str | None = None,
    others: Sequence[CorrectionInUse] = (),
    uncertainty: bool = True,
) -> str:
    """A correction as it is exported.

    Args:
        correction: to write.
        format: of those of its kind.
        name: of the sensor in C and Python; that of the instrument if not given. With `others`, of the unit.
        others: of its kind, beside it in one file; of three axes, in the same body axes.
        uncertainty: with the covariance; False for C and Python that give what acts alone.

    Raises:
        InputError: another format, one that has no place for this quantity, for others or for no uncertainty, two
            triads of one instrument, or a name that is none in C.
    """
    kind = kind_of(correction)
    if format not in kind.writers:
        raise InputError(
            f"a correction of {kind.axes} cannot be written as {format!r}: choose {', '.join(kind.writers)}"
        )
    unit = [correction, *others]
    named = dict(zip(names_in_unit(name, unit), unit, strict=True))
    if others and format not in kind.together:
        raise InputError(
            f"{format} holds one triad: several go into one file as {', '.join(kind.together)}; write the others to "
            "files of their own"
        )
    if not uncertainty and format not in LANGUAGES:
        raise InputError(
            f"{format} holds its uncertainty: only C and Python are written without uncertainty"
        )
    return kind.writers[format](named, uncertainty)


def load_correction(path: str | Path) -> CorrectionInUse:
    """A correction from its JSON file, of any kind. Nothing in it is evaluated as code.

    Raises:
        InputError: there is no such file, it is none, of another version, or damaged.
    """
    path = Path(path)
    try:
        found = read_json(path)
    except OSError:
        raise InputError(f"there is no file {path}: give a correction exported as JSON") from None
    except ValueError as error:
        raise InputError(f"{path.name} is not JSON ({error}): is it a correction?") from None
    for kind in kinds():
        if isinstance(found, dict) and kind.is_data(found):
            return kind.read(found, path.name)
    raise InputError(
        f"{path.name} is no correction: export one by `bayescal export CALIBRATION --format json`"
    )
