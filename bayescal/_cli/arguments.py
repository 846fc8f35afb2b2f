"""What comes through the command line, as instruments, models, readings and methods.

And what goes out through it, written.
"""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fit import load
from bayescal._calibration.predict import Prediction
from bayescal._calibration.storage import installed_instruments
from bayescal._compensation.compensator import Compensator, compensator, load_compensator
from bayescal._core.errors import InputError
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.marginal import Marginal
from bayescal._inference.method import Method
from bayescal._inference.nuts import NUTS
from bayescal._model.effect import Effect
from bayescal._model.frame import Reference
from bayescal._model.frame import reference_of as constants_of
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model
from bayescal._readings.measurements import Measurements
from bayescal._readings.read import read
from bayescal._report.section import Chapter, chapters, of_folder

METHODS: dict[str, type[Method]] = {
    "marginal": Marginal,
    "least-squares": LeastSquares,
    "nuts": NUTS,
}


@dataclass(frozen=True)
class Request:
    """The options that say which model and which readings."""

    instrument: str
    columns: list[str] | None
    units: list[str] | None
    local_gravity: float
    fix: list[str] | None
    reference: list[str] | None
    add: list[str] | None
    structure: str | None
    effects: Path | None


def open_up(asked: Request, files: Sequence[Path]) -> tuple[Instrument, Model, Measurements]:
    """Instrument, model and readings of a request; the instrument tailored to the readings.

    Raises:
        InputError, ModelError: something in it cannot be used; says what.
    """
    instrument = instrument_named(asked.instrument)
    own = {e.name: e for e in user_effects(asked.effects)}
    model = composed(instrument, asked, own)  # before the files, which may be long
    readings = read_files(instrument, files, asked.columns, asked.units, asked.local_gravity)
    tailored = instrument.for_readings(readings)
    return tailored, model if tailored is instrument else composed(tailored, asked, own), readings


def composed(instrument: Instrument, asked: Request, own: Mapping[str, Effect]) -> Model:
    """The model that a request names: a structure or the baseline, effects added, coefficients fixed."""
    model = (
        structure_named(instrument, asked.structure) if asked.structure else instrument.baseline()
    )
    for name in asked.add or []:
        model = model + own.get(name, name)
    return model.fix(numbers(asked.fix, "--fix"))


def read_files(
    instrument: Instrument,
    files: Sequence[Path],
    columns: list[str] | None,
    units: list[str] | None,
    local_gravity: float,
) -> Measurements:
    return read(
        list(files),
        instrument,
        columns=pairs(columns, "--columns"),
        units=pairs(units, "--unit"),
        local_gravity=local_gravity,
    )


def instrument_named(name: str) -> Instrument:
    """An installed instrument, or one in a file: my.py:INSTRUMENT.

    Raises:
        InputError: there is none.
    """
    file, colon, attribute = name.rpartition(":")
    if colon and file.endswith(".py"):
        found = getattr(_module(Path(file)), attribute, None)
        if not isinstance(found, Instrument):
            raise InputError(
                f"{file} defines no instrument called {attribute!r}: give FILE.py:NAME"
            )
        return found
    known = installed_instruments()
    if name not in known:
        raise InputError(
            f"no instrument is called {name!r}; installed: {', '.join(known) or 'none'}. "
            "For one of your own give my.py:INSTRUMENT"
        )
    return known[name]


def structure_named(instrument: Instrument, name: str) -> Model:
    structures = dict(instrument.structures)
    if name not in structures:
        raise InputError(
            f"instrument {instrument.name!r} has no structure {name!r}; "
            f"it has: {', '.join(structures)}"
        )
    return structures[name]()


def structure_with(instrument: Instrument, text: str, own: Sequence[Effect]) -> Model:
    """A structure with effects added to it: "line+bias.thermal_lag"."""
    first, *added = (part.strip() for part in text.split("+"))
    model, known = structure_named(instrument, first), {e.name: e for e in own}
    for name in added:
        model = model + known.get(name, name)
    return model


def user_effects(path: Path | None) -> tuple[Effect, ...]:
    """The effects that a user's file defines: its EFFECTS, or every Effect in it.

    Raises:
        InputError: no such file, it fails, or it defines none.
    """
    if path is None:
        return ()
    module = _module(path)
    found = getattr(module, "EFFECTS", None)
    if found is None:
        found = tuple(v for v in vars(module).values() if isinstance(v, Effect))
    if isinstance(found, Effect):
        found = (found,)
    if not found or not all(isinstance(e, Effect) for e in found):
        raise InputError(f"{path} defines no effect: write EFFECTS = (bayescal.Effect(…),)")
    return tuple(found)


def _module(path: Path) -> ModuleType:
    if not path.is_file():
        raise InputError(f"there is no file {path}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules.setdefault(path.stem, module)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever a user's file does wrong is said in one line
        raise InputError(f"{path} could not be run: {type(error).__name__}: {error}") from None
    return module


def method_named(name: str) -> Method:
    if name not in METHODS:
        raise InputError(f"--method {name!r} is not one of {', '.join(METHODS)}")
    return METHODS[name]()


def reference_of(asked: Request, readings: Measurements) -> Reference:
    """The constants of the bases that the user sets.

    Raises:
        InputError: these readings have no such constant.
    """
    given = numbers(asked.reference, "--reference")
    known = [n for n, value in constants_of(readings).items() if not isinstance(value, dict)]
    for name in given:
        if name not in known:
            raise InputError(
                f"--reference {name}: the bases of these readings have no constant {name!r}; "
                f"they have: {', '.join(known)}"
            )
    return dict(given)


def pairs(given: list[str] | None, option: str) -> dict[str, str]:
    """name=value options as a dictionary."""
    found = {}
    for one in given or []:
        name, equals, value = one.partition("=")
        if not (name and equals and value):
            raise InputError(f"{option} {one!r} is not of the form name=value")
        found[name.strip()] = value.strip()
    return found


def numbers(given: list[str] | None, option: str) -> dict[str, float]:
    found = {}
    for name, value in pairs(given, option).items():
        try:
            found[name] = float(value)
        except ValueError:
            raise InputError(f"{option} {name}={value}: {value!r} is not a number") from None
        if not math.isfinite(found[name]):
            raise InputError(f"{option} {name}={value}: give a finite number")
    return found


def saved(path: Path, effects: Path | None, instrument: str | None) -> Calibration:
    """A saved calibration; of an instrument of the user's own, if one is named."""
    own = () if instrument is None else (instrument_named(instrument),)
    return load(path, effects=user_effects(effects), instruments=own)


def compensator_from(
    path: Path, effects: Path | None, instrument: str | None, members: list[str] | None
) -> Compensator:
    """The compensator of a saved calibration, or one exported as JSON."""
    if path.suffix.lower() == ".json":
        if members:
            raise InputError(
                f"{path.name} is an export, made for its members: give the calibration"
            )
        return load_compensator(path)
    return compensator(saved(path, effects, instrument), members=pairs(members, "--member"))


def chapters_from(paths: list[Path], effects: Path | None, instrument: str | None) -> list[Chapter]:
    """What a report is of: saved calibrations, and folders with the trail that led to one."""
    own = () if instrument is None else (instrument_named(instrument),)
    theirs = user_effects(effects)
    given = (
        of_folder(p, theirs, own) if p.is_dir() else saved(p, effects, instrument) for p in paths
    )
    return chapters(given, theirs)


@contextmanager
def folder(path: Path | None) -> Iterator[Any]:
    """A folder to write to, made if need be, and taken away again if nothing comes of it.

    Raises:
        InputError: it cannot be made, or is a file.
    """
    if path is None:
        yield None
        return
    missing = [p for p in (path, *path.parents) if not p.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write to the folder {path}: {error.strerror}") from None
    try:
        yield path
    except BaseException:
        for made in missing:
            with suppress(OSError):  # not empty: something was written
                made.rmdir()
        raise


def write_prediction(found: Prediction, readings: Measurements, path: Path) -> None:
    """The readings with columns predicted, predicted_uncertainty and residual beside them.

    Raises:
        InputError: the file type is not known or the folder is not there.
    """
    unit = {"units": readings.unit("output")}
    added = {
        "predicted": ("reading", np.asarray(found.mean), unit),
        "predicted_uncertainty": ("reading", np.asarray(found.sd), unit),
        "residual": ("reading", np.asarray(found.residual), unit),
    }
    Measurements(data=readings.data.assign(added), sources=readings.sources).write(path)
