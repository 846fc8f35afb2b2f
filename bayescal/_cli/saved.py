"""Saved calibrations, and what is made of them: compensators, chapters of a report.

Light: what is heavy loads with the first calibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bayescal as bc
from bayescal._cli.options import InUse, OwnParts, UsedParts
from bayescal._core.annex import first_offered
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
    from bayescal._report.result_json import Chapter
    from bayescal._use.correction import CorrectionInUse


def reliable(given: Mapping[str, bc.Compensator | CorrectionInUse]) -> dict[str, Any]:
    """Return whether what was written is of results that may be used, as an `Answer` has it."""
    told = [f"{name} {one.why_not}".strip() for name, one in given.items() if one.why_not]
    return {"ok": not told, "why": "; ".join(told)}


def _own(parts: OwnParts) -> dict[str, Any]:
    """Return the user's own effects and instrument, as `bc.load` takes them."""
    named = parts.instrument_file
    instruments = () if named is None else (instrument_named(named),)
    return {"effects": user_effects(parts.effects_file), "instruments": instruments}


def load_saved(path: Path, own: OwnParts) -> bc.Calibration:
    """Load a saved calibration, or the one of a folder of results.

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
    """Return the compensator of a saved calibration of one output, or one exported as JSON."""
    found = correction_from(path, own)
    if not isinstance(found, bc.Compensator):
        raise InputError(
            f"{path} is of three axes: `bayescal export` writes its correction, in Python bc.vector_correction makes it"
        )
    return found


def correction_from(path: Path, own: InUse) -> bc.Compensator | CorrectionInUse:
    """Return what corrects readings, of one output or three axes: of a saved calibration, or exported as JSON."""
    if path.suffix.lower() == ".json":
        from bayescal._use.compensation_program import CompensationProgram
        from bayescal._use.correction_files import load_correction

        if own.member:
            raise InputError(
                f"{path.name} is an export, made for its members: give the calibration"
            )
        found = load_correction(path)
        one = isinstance(found, CompensationProgram)
        return bc.Compensator(loaded=found) if one else found
    calibration = load_saved(path, own)
    if calibration.model.instrument.vector is None:
        return bc.compensator(calibration, members=own.members)
    return first_offered("corrected", f"{path} is of three axes: to correct them")(calibration)


def of_units(paths: list[Path], file: str = "") -> list[Path]:
    """Return a unit's channels' folders, or a file in each, in place of its folder."""
    found: list[Path] = []
    for path in paths:
        unit = (path / CHANNELS).is_file()
        found += [path / name / file for name in channel_folders(path)] if unit else [path]
    return found


def chapters_from(paths: list[Path], own: OwnParts) -> list[Chapter]:
    """Return what a report is of: saved calibrations, and folders with the search that led to one."""
    from bayescal._report.result_json import chapters, of_folder

    parts = _own(own)
    given = (of_folder(p, **parts) if p.is_dir() else load_saved(p, own) for p in of_units(paths))
    return chapters(given, parts["effects"])
