"""Saved calibrations, and what is made of them: compensators, chapters of a report."""

from __future__ import annotations

from pathlib import Path

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fit import load
from bayescal._cli.options import OwnParts, named_values
from bayescal._cli.request import instrument_named, user_effects
from bayescal._compensation.compensator import Compensator, compensator, load_compensator
from bayescal._core.errors import InputError
from bayescal._model.instrument import Instrument
from bayescal._report.section import Chapter, chapters, of_folder
from bayescal._report.whole_folder import refuse_mixed


def load_saved(path: Path, own: OwnParts) -> Calibration:
    """A saved calibration; of an instrument of the user's own, if one is named.

    Raises:
        InputError: it cannot be loaded, or is not the one that its folder's manifest lists.
    """
    refuse_mixed(path.parent, path.name)
    return load(path, effects=user_effects(own.effects_file), instruments=_own_instruments(own))


def compensator_from(path: Path, own: OwnParts, members: list[str] | None) -> Compensator:
    """The compensator of a saved calibration, or one exported as JSON.

    Raises:
        InputError: it cannot be loaded, or members are chosen of an export.
    """
    if path.suffix.lower() == ".json":
        if members:
            raise InputError(
                f"{path.name} is an export, made for its members: give the calibration"
            )
        return load_compensator(path)
    return compensator(load_saved(path, own), members=named_values(members, "--member"))


def chapters_from(paths: list[Path], own: OwnParts) -> list[Chapter]:
    """What a report is of: saved calibrations, and folders with the search that led to one.

    Raises:
        InputError: one of them cannot be loaded.
    """
    effects, instruments = user_effects(own.effects_file), _own_instruments(own)
    given = (
        of_folder(p, effects, instruments) if p.is_dir() else load_saved(p, own) for p in paths
    )
    return chapters(given, effects)


def _own_instruments(own: OwnParts) -> tuple[Instrument, ...]:
    return () if own.instrument is None else (instrument_named(own.instrument),)
