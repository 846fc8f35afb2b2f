"""Saved calibrations, and what is made of them: compensators, an autopilot's parameters, chapters of a report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fit import load
from bayescal._cli.options import DecisionRule, InUse, OwnParts, UsedParts, named_values
from bayescal._core.errors import InputError
from bayescal._fleet.batch_result import load_batch, load_fleet
from bayescal._fleet.population import Population
from bayescal._model.instrument import Instrument
from bayescal._report.certificate import dcc_text
from bayescal._report.section import CALIBRATION, Chapter, chapters, of_folder
from bayescal._report.whole_folder import (
    AVERAGED,
    CHANNELS,
    channel_folders,
    files_of,
    refuse_mixed,
)
from bayescal._search.own_files import instrument_named, user_effects
from bayescal._use.autopilot import AUTOPILOTS
from bayescal._use.compensator import Compensator, compensator
from bayescal._use.correction_files import OF_ONE_OUTPUT, load_correction
from bayescal._use.decide import decide
from bayescal._use.firmware_parameters import (
    FirmwareParameters,
    axis_of,
    firmware_parameters,
)
from bayescal._use.vector_correction import VectorCorrection
from bayescal._use.vector_series import vector_correction

PARAMETERS, DCC = tuple(AUTOPILOTS), "dcc"
KNOWN = (*OF_ONE_OUTPUT, "yaml", *PARAMETERS, DCC)  # formats of an export


def load_saved(path: Path, own: OwnParts) -> Calibration:
    """A saved calibration, or the one of a folder of results; of an instrument of the user's own, if one is named.

    Args:
        path: of the file or folder.
        own: the user's own effects and instrument; and whether the average over structures stands for it, where the
            folder has one.

    Raises:
        InputError: it cannot be loaded, or is not the one that its folder's manifest lists.
    """
    if (path / CHANNELS).is_file():
        raise InputError(
            f"{path} holds several channels: name the folder of one, such as {of_units([path])[0]}"
        )
    path = inside if (inside := path / CALIBRATION).is_file() else path
    if isinstance(own, UsedParts) and path.name == CALIBRATION:
        if own.one_structure not in ("average", "best"):
            raise InputError(f"--structure {own.one_structure!r} is neither 'average' nor 'best'")
        refuse_mixed(path.parent, CALIBRATION)
        if own.one_structure == "average" and AVERAGED in files_of(path.parent):
            path = path.with_name(AVERAGED)
    refuse_mixed(path.parent, path.name)
    return load(path, effects=user_effects(own.effects_file), instruments=_own_instruments(own))


def compensator_from(path: Path, own: InUse) -> Compensator:
    """The compensator of a saved calibration, or one exported as JSON.

    Raises:
        InputError: it cannot be loaded, or members are chosen of an export.
    """
    found = correction_from(path, own)
    if isinstance(found, VectorCorrection):
        raise InputError(
            f"{path} is of three axes: `bayescal export` writes its correction, in Python bc.vector_correction makes it"
        )
    return found


def correction_from(path: Path, own: InUse) -> Compensator | VectorCorrection:
    """What corrects readings, of one output or of three axes: of a saved calibration, or exported as JSON.

    Raises:
        InputError: it cannot be loaded, or members are chosen of an export.
    """
    if path.suffix.lower() == ".json":
        if own.member:
            raise InputError(
                f"{path.name} is an export, made for its members: give the calibration"
            )
        found = load_correction(path)
        return found if isinstance(found, VectorCorrection) else Compensator(None, loaded=found)
    calibration = load_saved(path, own)
    if calibration.model.instrument.vector is not None:
        return vector_correction(calibration)
    return compensator(calibration, members=own.members)


def population_of(given: list[str] | None) -> Population | list[str] | None:
    """Devices of one kind: the population that `bayescal batch` learned, or as they were written.

    Raises:
        InputError: results cannot be read or have no population, or another population is given beside them.
    """
    results = [one for one in given or [] if Path(one).exists()]
    if not results:
        return given or None
    if len(given or []) > 1:
        raise InputError(
            f"--population {results[0]} is a fleet's: give it alone, or devices as text"
        )
    path = Path(results[0])
    found = (load_fleet(path) if path.is_dir() else load_batch(path)).population
    if found is None:
        raise InputError(
            f"--population {path}: these results have no population; fit them with `bayescal batch --population all`, "
            'or give the devices as text, such as "sd 0.2 °/s"'
        )
    return found


def of_units(paths: list[Path], file: str = "") -> list[Path]:
    """A unit's folder stands for those of its channels, or for a file in each.

    Raises:
        InputError: its channels.json cannot be read.
    """
    found: list[Path] = []
    for path in paths:
        unit = (path / CHANNELS).is_file()
        found += [path / name / file for name in channel_folders(path)] if unit else [path]
    return found


def corrections_from(
    paths: Sequence[Path], own: InUse
) -> tuple[list[tuple[Path, Compensator]], list[VectorCorrection]]:
    """What corrects: of one output each, with its path; or the triads of a unit.

    Raises:
        InputError: one cannot be loaded, or some are of one output and others of three axes.
    """
    found = [(path, correction_from(path, own)) for path in paths]
    single = [(path, one) for path, one in found if isinstance(one, Compensator)]
    triads = [one for _, one in found if isinstance(one, VectorCorrection)]
    if single and triads:
        raise InputError(
            f"{single[0][0]} is of one output, and others are of three axes: give it alone"
        )
    return single, triads


def by_axis(
    given: Sequence[tuple[Path, Compensator]], named: list[str] | None, own: InUse
) -> dict[str, Compensator]:
    """Calibrations by their axis: as their readings name it, or as the user does.

    Raises:
        InputError: an axis is not known, or is given twice.
    """
    found: dict[str, Compensator] = {}
    files: dict[str, str] = {}
    said: list[Any] = [(None, path, one) for path, one in given]
    for one in named or []:
        for name, path in named_values([one], "--axis").items():
            said.append((name, Path(path), compensator_from(Path(path), own)))
    for name, path, chosen in said:
        own_name = axis_of(chosen.calibration) if chosen.calibration else None
        name = name or own_name
        if name is None:
            raise InputError(
                f"{path}: its readings do not say of which axis it is: --axis gyro_x={path} in its place"
            )
        if name in found:
            raise InputError(
                f"{path} and {files[name]} are both of {name}: give one, or say of which axis each is "
                f"(--axis gyro_y={path})"
            )
        found[name], files[name] = chosen, str(path)
    return found


def parameters(
    given: dict[str, Compensator], format: str, devices: list[str] | None, local_gravity: float
) -> FirmwareParameters:
    """The parameters that these calibrations come to.

    Raises:
        InputError: what `firmware_parameters` refuses, or a device that is no number.
    """
    said = named_values(devices, "--device-id")
    for name, value in said.items():
        if not value.isdecimal():
            raise InputError(f"--device-id {name}={value}: {value!r} is not a whole number")
    numbers = {name: int(value) for name, value in said.items()}
    return firmware_parameters(given, format, devices=numbers, local_gravity=local_gravity)


def certified(
    path: Path,
    own: InUse,
    certificate: Path | None,
    local_gravity: float,
    limits: list[str] | None,
    by: DecisionRule,
) -> str:
    """The digital calibration certificate of a saved calibration, as XML, with what is decided about limits, if any.

    Raises:
        InputError: no certificate is given, an export, or what `dcc_text` refuses.
    """
    if certificate is None:
        raise InputError(
            "a digital calibration certificate states device, laboratory and customer: --certificate FILE.toml"
        )
    if path.suffix.lower() == ".json":
        raise InputError("an export is no calibration: give the saved calibration (.nc)")
    calibration, decided = load_saved(path, own), None
    if limits:
        how = {"members": own.members, "local_gravity": local_gravity, **vars(by)}
        decided = decide(calibration, limits, **how)
    return dcc_text(calibration, certificate, local_gravity, decided)


def chapters_from(paths: list[Path], own: OwnParts) -> list[Chapter]:
    """What a report is of: saved calibrations, and folders with the search that led to one.

    Raises:
        InputError: one of them cannot be loaded.
    """
    effects, instruments = user_effects(own.effects_file), _own_instruments(own)
    given = (
        of_folder(p, effects, instruments) if p.is_dir() else load_saved(p, own)
        for p in of_units(paths)
    )
    return chapters(given, effects)


def _own_instruments(own: OwnParts) -> tuple[Instrument, ...]:
    return () if own.instrument_file is None else (instrument_named(own.instrument_file),)
