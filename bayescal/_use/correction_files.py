"""Export of corrections of one output or of three axes as files (C99, Python, JSON, …).

Annexes add kinds of corrections besides those of one output (`_core/annex.py`). All names in a C header have the
sensor's name as prefix, so that a program may include several headers; two with the same prefix do not compile.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from bayescal._core.annex import load_entries
from bayescal._core.errors import InputError
from bayescal._core.inverse import MAX_NEWTON_STEPS
from bayescal._core.json_data import format_json
from bayescal._core.quoting import format_digits, load_template, quote_python, to_identifier
from bayescal._data.records import MAX_GAP_WINDOWS, RATE_WINDOW_S
from bayescal._use.compensation_program import (
    HISTORY_KINDS,
    INPUT_KINDS,
    CompensationProgram,
    CorrectionInUse,
)
from bayescal._use.expression_graph import LANGUAGES, Language, generate_statements
from bayescal._use.operating_equation import STIMULUS

Writer = Callable[[Mapping[str, Any], bool], str]
"""Function of corrections by sensor name, and of whether to include the uncertainty; returns the text of the file."""


class CorrectionKind(NamedTuple):
    """A kind of corrections: the class, the formats, and the writer of each format."""

    correction_class: type  # class of the corrections, which implements `CorrectionInUse`
    axes: str  # number of axes in words, such as "three axes"
    writers: Mapping[str, Writer]  # format → writer
    suffixes: Mapping[str, str]  # suffix of a file → format
    shared_formats: tuple[str, ...] = ()  # formats whose files may contain several corrections
    # returns a sentence on the terms that a format omits; "" if it omits none
    describe_omissions: Callable[[Any, str], str] = lambda correction, format: ""


# Names used by the templates.
_WORDS = "reading stimulus inputs expected slope gradient noise square total values outside math j dt self state now"
_RESERVED_WORDS = frozenset(_WORDS.split())


def render_program(
    program: CompensationProgram, language: Language, name: str, uncertainty: bool
) -> str:
    """Render a compensation program as a C99 header or a Python module, from its template."""
    equation = program.equation
    noise_outputs = (equation.noise, *equation.gradient) * uncertainty
    outputs = (equation.expected, equation.slope), noise_outputs
    if not uncertainty:  # without inputs that only the uncertainty needs
        needed = program.graph.inputs(outputs[0])
        program = replace(program, inputs=tuple(i for i in program.inputs if i.name in needed))
    fields: dict[str, str] = {}
    for i in program.inputs:
        field = to_identifier(i.name, _RESERVED_WORDS | set(fields.values()))
        fields[i.name] = f"{field}_" if re.fullmatch(r"t\d+", field) else field
    names = {**{k: language.input.format(v) for k, v in fields.items()}, STIMULUS: "stimulus"}
    cholesky = program.cholesky_factor
    factor = [format_digits(cholesky[i, j]) for i in range(len(cholesky)) for j in range(i + 1)]
    expected, gradient = (generate_statements(program.graph, o, names, language) for o in outputs)
    filters = {"comment": language.escape_comment, "quoted": quote_python}
    return load_template("bayescal._use", language.template, filters).render(
        p=program,
        about=program.about,
        name=name,
        guard=format_guard(name, expected, gradient, factor, program.inputs, uncertainty),
        uncertainty=uncertainty,
        fields=fields,
        record=_record_variables(program, fields),
        expected=expected,
        gradient=gradient,
        factor=factor,
        steps=1 if program.affine else MAX_NEWTON_STEPS,
    )


def _record_variables(program: CompensationProgram, fields: Mapping[str, str]) -> dict[str, Any]:
    """Return template variables about a record's history: inputs by kind, columns as (field, unit), lags, window."""
    by_kind = {kind: [i for i in program.inputs if i.kind == kind] for kind in INPUT_KINDS}
    columns = {i.column: (fields[i.name], i.unit) for i in by_kind["column"]}
    for i in (i for i in program.inputs if i.kind in HISTORY_KINDS and i.column not in columns):
        names = {*_RESERVED_WORDS, *fields.values(), *(name for name, _ in columns.values())}
        columns.setdefault(i.column, (to_identifier(i.column, names), "degC"))
    lags = by_kind["lag"] + by_kind["lag slope"]
    window = max((i.tau or RATE_WINDOW_S for i in by_kind["rate"]), default=0.0)
    return {
        "by_kind": by_kind,
        "columns": columns,
        "past": len(by_kind["column"]) < len(program.inputs),
        "dated": "time" in columns,
        "lags": {(i.column, i.tau): fields[i.name] for i in by_kind["lag"]},
        "last": sorted({columns[i.column][0] for i in lags}),
        "window": window * (1 + 1e-9),  # as for rates of records
        "silence": MAX_GAP_WINDOWS * window,
    }


def format_guard(name: str, *contents: Any) -> str:
    """Return an include guard with which two different headers of the same name do not compile.

    A common guard would silently skip the second one. The value of this guard is a checksum of the header's content.
    """
    stamp = f"0x{zlib.crc32(repr(contents).encode()):08x}UL"
    guard = f"BAYESCAL_{name.upper()}_H"
    return (
        f"#if defined({guard}) && {guard} != {stamp}\n"
        f"#error two sensors are called {name}: export one of them with another name\n"
        f"#endif\n#ifndef {guard}\n#define {guard} {stamp}"
    )


def render_json(sensors: Mapping[str, CorrectionInUse], uncertainty: bool) -> str:
    """Render a single correction as JSON, always with its uncertainty."""
    (correction,) = sensors.values()
    return format_json(correction.to_json_data(), indent=1)


def wrap_writer(write: Callable[..., str], *arguments: Any) -> Writer:
    """Return a `Writer` that calls `write(correction, *arguments)`, without sensor names and `uncertainty`."""
    return lambda sensors, uncertainty: write(*sensors.values(), *arguments)


def _render(language: Language, programs: Mapping[str, Any], uncertainty: bool) -> str:
    return "".join(render_program(p, language, n, uncertainty) for n, p in programs.items())


SINGLE_OUTPUT = CorrectionKind(
    correction_class=CompensationProgram,
    axes="one output",
    writers={"json": render_json, **{n: partial(_render, form) for n, form in LANGUAGES.items()}},
    suffixes={".json": "json", ".h": "c", ".py": "python"},
)


def iter_kinds() -> Iterator[CorrectionKind]:
    """Yield the kinds of corrections: `SINGLE_OUTPUT`, then those of annexes, which are loaded only then."""
    yield SINGLE_OUTPUT
    for corrections in load_entries("corrections"):
        yield from corrections


def find_kind(correction: CorrectionInUse) -> CorrectionKind:
    """Return the kind to which a correction belongs."""
    return next(kind for kind in iter_kinds() if isinstance(correction, kind.correction_class))


def choose_name(name: str | None, instrument: str) -> str:
    """Return a sensor's name, valid in C and Python: the one given, else the instrument's.

    Raises:
        InputError: the given name is not a valid identifier.
    """
    if name is None:
        return to_identifier(instrument)
    if to_identifier(name.lower()) != name.lower():
        raise InputError(
            f"{name!r} is not a valid name in C and Python: use letters, digits and _, with a letter first, and no "
            "reserved word (example: gyro_x)"
        )
    return name


def name_sensors(name: str | None, corrections: Sequence[CorrectionInUse]) -> list[str]:
    """Return names of a unit's sensors, valid in C and Python: those of the instruments with the unit's name as prefix.

    Raises:
        InputError: the name is not a valid identifier, or two sensors are of the same instrument.
    """
    instruments = [correction.instrument for correction in corrections]
    if len(corrections) == 1:
        return [choose_name(name, instruments[0])]
    prefix = "" if name is None else f"{choose_name(name, '')}_"
    names = [choose_name(None, f"{prefix}{instrument}") for instrument in instruments]
    if doubles := [n for n in names if names.count(n) > 1]:
        raise InputError(
            f"two corrections are for the instrument {instruments[names.index(doubles[0])]}, but a unit has one sensor "
            "of each instrument: export the second to a separate file, under another name"
        )
    return names


def choose_format(path: str | Path | None, format: str | None) -> str:
    """Return `format` if it is given, else the format that the path's suffix implies.

    Raises:
        InputError: no format is given, and no format has this suffix.
    """
    suffix = Path(path or "").suffix.lower()
    form = format or next((k.suffixes[suffix] for k in iter_kinds() if suffix in k.suffixes), None)
    if form is None:
        suffixes = ", ".join(dict.fromkeys(s for kind in iter_kinds() for s in kind.suffixes))
        raise InputError(f"{path}: give the format, or a name that ends in {suffixes}")
    return form


def as_text(
    correction: CorrectionInUse,
    format: str,
    *,
    name: str | None = None,
    others: Sequence[CorrectionInUse] = (),
    uncertainty: bool = True,
) -> str:
    """Return the text of an exported correction.

    Args:
        correction: the correction to write.
        format: one of the formats of the correction's kind.
        name: name of the sensor in C and Python; default: the instrument's name. With `others`, name of the unit.
        others: corrections of the same kind for the same file; those of three axes have common body axes.
        uncertainty: include the covariance; False for C and Python that return the value alone.

    Raises:
        InputError: the format is unknown, or does not support this quantity, `others` or `uncertainty=False`; two
            triads are of the same instrument; or a name is invalid in C.
    """
    kind = find_kind(correction)
    if format not in kind.writers:
        message = f"a correction of {kind.axes} cannot be written as {format!r}: choose {', '.join(kind.writers)}"
        raise InputError(message)
    corrections = [correction, *others]
    sensors = dict(zip(name_sensors(name, corrections), corrections, strict=True))
    if others and format not in kind.shared_formats:
        raise InputError(
            f"a file in {format} contains one triad: export several as {', '.join(kind.shared_formats)}, or each to a "
            "separate file"
        )
    if not uncertainty and format not in LANGUAGES:
        raise InputError(f"{format} always includes the uncertainty: only C and Python can omit it")
    return kind.writers[format](sensors, uncertainty)
