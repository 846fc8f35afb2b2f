"""Corrections as files (C99, Python, JSON, …), of one output or of three axes: one exporter, one loader, one naming.

Everything in a C header carries the name of its sensor, so that those of several go into one program. Two of one name
are refused by the compiler (`export_template.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bayescal._core.as_json import json_text
from bayescal._core.atomic_file import write_text
from bayescal._core.errors import InputError
from bayescal._core.json_shape import read_json
from bayescal._core.quoting import identifier
from bayescal._use.autopilot import AUTOPILOTS
from bayescal._use.compensation_program import SCHEMA, CompensationProgram, from_data
from bayescal._use.correction import CorrectionInUse
from bayescal._use.expression_graph import LANGUAGES, Language
from bayescal._use.program_text import page, program_text
from bayescal._use.vector_correction import VectorCorrection
from bayescal._use.vector_parameters import READ_BY_OTHERS, parameter_file
from bayescal._use.vector_text import headers, module, vector_from_data

Writer = Callable[[Mapping[str, Any], bool], str]  # of corrections by the names of their sensors


def _json(named: Mapping[str, CorrectionInUse], uncertainty: bool) -> str:
    (correction,) = named.values()
    return json_text(correction.data(), indent=1)


def _in_form(write: Callable[..., str], *how: Any) -> Writer:
    """A writer of what has no place for names, nor for leaving the uncertainty out."""
    return lambda named, uncertainty: write(*named.values(), *how)


def _program(language: Language) -> Writer:
    return lambda named, uncertainty: "".join(
        program_text(program, language, name, uncertainty) for name, program in named.items()
    )


FORMATS = {
    **{".json": "json", ".h": "c", ".py": "python", ".html": "html"},
    **{".yaml": "yaml", ".yml": "yaml"},
}
OF_ONE_OUTPUT: dict[str, Writer] = {
    "json": _json,
    **{name: _program(language) for name, language in LANGUAGES.items()},
    "html": _in_form(page),
}
OF_THREE_AXES: dict[str, Writer] = {
    "json": _json,
    "c": headers,
    "python": module,
    **{name: _in_form(write) for name, write in READ_BY_OTHERS.items()},
    **{autopilot: _in_form(parameter_file, autopilot) for autopilot in AUTOPILOTS},
}
TOGETHER = ("c", "python", "yaml", "openvins", "realsense")  # formats of several triads in one file


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
    chosen = format or FORMATS.get(Path(path or "").suffix.lower())
    if chosen is None:
        raise InputError(
            f"{path}: a correction is written as {', '.join(FORMATS)}, or give the format"
        )
    return chosen


def as_text(
    correction: CorrectionInUse,
    format: str,
    *,
    name: str | None = None,
    others: Sequence[VectorCorrection] = (),
    uncertainty: bool = True,
) -> str:
    """A correction as it is exported.

    Args:
        correction: to write.
        format: of those of one output or of three axes.
        name: of the sensor in C and Python; that of the instrument if not given. With `others`, of the unit.
        others: of three axes, beside it in one file, in the same body axes.
        uncertainty: with the covariance; False for C and Python that give what acts alone.

    Raises:
        InputError: another format, one that has no place for this quantity, for others or for no uncertainty, two
            triads of one instrument, or a name that is none in C.
    """
    several = isinstance(correction, VectorCorrection)
    writers = OF_THREE_AXES if several else OF_ONE_OUTPUT
    if format not in writers:
        raise InputError(
            f"a correction of {'three axes' if several else 'one output'} cannot be written as {format!r}: choose "
            f"{', '.join(writers)}"
        )
    unit = [correction, *others]
    named = dict(zip(names_in_unit(name, unit), unit, strict=True))
    if others and format not in TOGETHER:
        raise InputError(
            f"{format} holds one triad: several go into one file as {', '.join(TOGETHER)}; write the others to files "
            "of their own"
        )
    if not uncertainty and format not in LANGUAGES:
        raise InputError(
            f"{format} holds its uncertainty: only C and Python are written without uncertainty"
        )
    return writers[format](named, uncertainty)


def export_vector(
    correction: VectorCorrection,
    path: str | Path,
    format: str | None = None,
    *,
    others: Sequence[VectorCorrection] = (),
    name: str | None = None,
    uncertainty: bool = True,
) -> Path:
    """Write by the suffix of the path (.h, .py, .json, .yaml) or in a `format`.

    Args:
        correction: to write.
        path: of the file.
        format: "json", "c", "python", "yaml" (Kalibr), "openvins", "realsense", "ros", "px4-params" or
            "ardupilot-params", whatever the suffix.
        others: beside it in one file of C, Python, Kalibr, OpenVINS or RealSense, in the same body axes: gyroscopes
            beside accelerometers.
        name: of the sensor in C and Python; that of the instrument if not given. With `others`, of the unit.
        uncertainty: with the covariance; False for C and Python that give what acts alone: of a plain offset and matrix
            twelve numbers are left.

    Raises:
        InputError: another suffix or format, others or no uncertainty in a format that holds none such, two triads of
            one instrument, a name that is none in C, or a place that cannot be written to.
    """
    how = {"name": name, "others": others, "uncertainty": uncertainty}
    return write_text(as_text(correction, format_of(path, format), **how), path)


def load_correction(path: str | Path) -> CompensationProgram | VectorCorrection:
    """A correction from its JSON file, of one output or of three axes. Nothing in it is evaluated as code.

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
    if isinstance(found, dict) and found.get("schema") == SCHEMA:
        return from_data(found, path.name)
    if isinstance(found, dict) and "terms" in found:
        return vector_from_data(found, path.name)
    raise InputError(
        f"{path.name} is no correction: export one by `bayescal export CALIBRATION --format json`"
    )


def load_vector_correction(path: str | Path) -> VectorCorrection:
    """A correction of three axes from its JSON file.

    Raises:
        InputError: there is no such file, it is none, or damaged.
    """
    found = load_correction(path)
    if not isinstance(found, VectorCorrection):
        raise InputError(f"{Path(path).name} is of one output: bayescal.load_compensator loads it")
    return found
