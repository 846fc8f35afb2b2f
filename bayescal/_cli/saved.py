"""Saved calibrations, and what is made of them: compensators, an autopilot's parameters, chapters of a report.

Light: what is heavy loads with the first calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bayescal as bc
from bayescal._cli.options import DecisionRule, InUse, OwnParts, UsedParts, named_values
from bayescal._core.errors import InputError
from bayescal._report.whole_folder import (
    AVERAGED,
    CALIBRATION,
    CHANNELS,
    channel_folders,
    files_of,
    refuse_mixed,
)
from bayescal._search.own_files import instrument_named, user_effects

if TYPE_CHECKING:
    from bayescal._report.section import Chapter


def _own(parts: OwnParts) -> dict[str, Any]:
    """The user's own effects and instrument, as `bc.load` takes them."""
    named = parts.instrument_file
    instruments = () if named is None else (instrument_named(named),)
    return {"effects": user_effects(parts.effects_file), "instruments": instruments}


def load_saved(path: Path, own: OwnParts) -> bc.Calibration:
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
    return bc.load(path, **_own(own))


def compensator_from(path: Path, own: InUse) -> bc.Compensator:
    """The compensator of a saved calibration, or one exported as JSON.

    Raises:
        InputError: it cannot be loaded, or members are chosen of an export.
    """
    found = correction_from(path, own)
    if isinstance(found, bc.VectorCorrection):
        raise InputError(
            f"{path} is of three axes: `bayescal export` writes its correction, in Python bc.vector_correction makes it"
        )
    return found


def correction_from(path: Path, own: InUse) -> bc.Compensator | bc.VectorCorrection:
    """What corrects readings, of one output or of three axes: of a saved calibration, or exported as JSON.

    Raises:
        InputError: it cannot be loaded, or members are chosen of an export.
    """
    if path.suffix.lower() == ".json":
        from bayescal._use.correction_files import load_correction

        if own.member:
            raise InputError(
                f"{path.name} is an export, made for its members: give the calibration"
            )
        found = load_correction(path)
        triad = isinstance(found, bc.VectorCorrection)
        return found if triad else bc.Compensator(None, loaded=found)
    calibration = load_saved(path, own)
    if calibration.model.instrument.vector is not None:
        return bc.vector_correction(calibration)
    return bc.compensator(calibration, members=own.members)


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


def by_axis(
    given: Sequence[tuple[Path, bc.Compensator]], named: list[str] | None, own: InUse
) -> dict[str, bc.Compensator]:
    """Calibrations by their axis: as their readings name it, or as the user does.

    Raises:
        InputError: an axis is not known, or is given twice.
    """
    from bayescal._use.firmware_parameters import axis_of

    found, files = dict[str, bc.Compensator](), dict[str, Path]()
    given_names = [(None, path, one) for path, one in given]
    for name, file in (
        pair for one in named or [] for pair in named_values([one], "--axis").items()
    ):
        given_names.append((name, Path(file), compensator_from(Path(file), own)))
    for name, path, chosen in given_names:
        name = name or (axis_of(chosen.calibration) if chosen.calibration else None)
        if name is None:
            raise InputError(
                f"{path}: its readings do not say of which axis it is: --axis gyro_x={path} in its place"
            )
        if name in found:
            raise InputError(
                f"{path} and {files[name]} are both of {name}: give one, or say of which axis each is "
                f"(--axis gyro_y={path})"
            )
        found[name], files[name] = chosen, path
    return found


def device_numbers(given: list[str] | None) -> dict[str, int]:
    """--device-id as `firmware_parameters` takes it.

    Raises:
        InputError: one is no number.
    """
    said = named_values(given, "--device-id")
    for name, value in said.items():
        if not value.isdecimal():
            raise InputError(f"--device-id {name}={value}: {value!r} is not a whole number")
    return {name: int(value) for name, value in said.items()}


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
    from bayescal._report.certificate import dcc_text

    if certificate is None:
        raise InputError(
            "a digital calibration certificate states device, laboratory and customer: --certificate FILE.toml"
        )
    if path.suffix.lower() == ".json":
        raise InputError("an export is no calibration: give the saved calibration (.nc)")
    calibration, decided = load_saved(path, own), None
    if limits:
        how = {"members": own.members, "local_gravity": local_gravity, **vars(by)}
        decided = bc.decide(calibration, limits, **how)
    return dcc_text(calibration, certificate, local_gravity, decided)


def chapters_from(paths: list[Path], own: OwnParts) -> list[Chapter]:
    """What a report is of: saved calibrations, and folders with the search that led to one.

    Raises:
        InputError: one of them cannot be loaded.
    """
    from bayescal._report.section import chapters, of_folder

    parts = _own(own)
    given = (of_folder(p, **parts) if p.is_dir() else load_saved(p, own) for p in of_units(paths))
    return chapters(given, parts["effects"])
