"""Saved calibrations, and what is made of them: compensators, exports, chapters of a report.

Light: what is heavy loads with the first calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bayescal as bc
from bayescal._cli.console import Answer, print_notes
from bayescal._cli.options import DecisionRule, InUse, OwnParts, UsedParts
from bayescal._core.annex import first_offered
from bayescal._core.atomic_file import write_text
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


@dataclass(frozen=True, kw_only=True)
class ExportRequest:
    """What `bayescal export` is asked for."""

    calibrations: list[Path] | None = None
    format_: str | None = None
    out: Path | None = None
    axis: list[str] | None = None
    device_id: list[str] | None = None
    local_gravity: float | None = None
    certificate: Path | None = None
    limit: list[str] | None = None
    by: DecisionRule
    own: InUse
    name: str | None = None
    without_uncertainty: bool = False

    @property
    def paths(self) -> list[Path]:
        """The calibrations."""
        return self.calibrations or []

    @property
    def gravity(self) -> float:
        """Local gravity, m/s²."""
        from bayescal._data.unit_conversion import STANDARD_GRAVITY  # loads NumPy

        return self.local_gravity or STANDARD_GRAVITY

    def loaded(self, paths: Sequence[Path] | None = None) -> list[tuple[Path, Any]]:
        """Files and their corrections: all of one output, or none.

        Raises:
            InputError: there are of both kinds, or one cannot be loaded.
        """
        found = [(p, correction_from(p, self.own)) for p in paths or self.paths]
        single = [path for path, one in found if isinstance(one, bc.Compensator)]
        if 0 < len(single) < len(found):
            raise InputError(
                f"{single[0]} is of one output, and others are of three axes: give it alone"
            )
        return found

    def refuse_several(self) -> None:
        """Refuse more than one calibration, or none.

        Raises:
            InputError: so it is.
        """
        named = ", and --axis or --device-id" * bool(self.axis or self.device_id)
        if len(self.paths) != 1 or named:
            raise InputError(
                f"a program is of one calibration, {len(self.paths)} were given{named}: several, by axis, make "
                "parameters (--format px4-params or ardupilot-params)"
            )

    def written(self, corrections: Sequence[Any]) -> Answer:
        """Corrections in one file, or as text; what that has no place for is said."""
        from bayescal._use import correction_files as files

        each = [getattr(one, "program", one) for one in corrections]
        kind, format = files.kind_of(each[0]), files.format_of(self.out, self.format_)
        how = {"name": self.name, "others": each[1:], "uncertainty": not self.without_uncertainty}
        text = files.as_text(each[0], format, **how)
        if self.out is not None:
            text = f"written: {write_text(text, self.out)}"
        names = [one.about_it()[0] for one in each]
        left = [(name, kind.left_out(one, format)) for name, one in zip(names, each, strict=True)]
        print_notes([f"{name}: {words}" for name, words in left if words])
        alone = isinstance(corrections[0], bc.Compensator)
        judged = {f"{n}:" * (not alone): one for n, one in zip(names, corrections, strict=True)}
        return Answer(text.removesuffix("\n"), **reliable(judged))


def reliable(given: Mapping[str, bc.Compensator | CorrectionInUse]) -> dict[str, Any]:
    """Of what was written, whether it is of results that may be used, as an `Answer` has it."""
    told = [f"{name} {one.why_not}".strip() for name, one in given.items() if one.why_not]
    return {"ok": not told, "why": "; ".join(told)}


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
    if not isinstance(found, bc.Compensator):
        raise InputError(
            f"{path} is of three axes: `bayescal export` writes its correction, in Python bc.vector_correction makes it"
        )
    return found


def correction_from(path: Path, own: InUse) -> bc.Compensator | CorrectionInUse:
    """What corrects readings, of one output or of three axes: of a saved calibration, or exported as JSON."""
    if path.suffix.lower() == ".json":
        from bayescal._use.compensation_program import CompensationProgram
        from bayescal._use.correction_files import load_correction

        if own.member:
            raise InputError(
                f"{path.name} is an export, made for its members: give the calibration"
            )
        found = load_correction(path)
        one = isinstance(found, CompensationProgram)
        return bc.Compensator(None, loaded=found) if one else found
    calibration = load_saved(path, own)
    if calibration.model.instrument.vector is None:
        return bc.compensator(calibration, members=own.members)
    return first_offered("corrected", f"{path} is of three axes: to correct them")(calibration)


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


def chapters_from(paths: list[Path], own: OwnParts) -> list[Chapter]:
    """What a report is of: saved calibrations, and folders with the search that led to one."""
    from bayescal._report.result_json import chapters, of_folder

    parts = _own(own)
    given = (of_folder(p, **parts) if p.is_dir() else load_saved(p, own) for p in of_units(paths))
    return chapters(given, parts["effects"])
