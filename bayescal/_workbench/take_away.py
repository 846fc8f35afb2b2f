"""What leaves a session: the report and exports, made of one folder as the command line makes them of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from bayescal._core.atomic_file import write_text
from bayescal._core.errors import InputError
from bayescal._data.measurements import Measurements
from bayescal._data.unit_parsing import STANDARD_GRAVITY
from bayescal._model.effect import Effect
from bayescal._report.dcc import dcc_text
from bayescal._report.report import report
from bayescal._report.section import of_folder
from bayescal._search.gate import judged
from bayescal._search.search_path import SearchPath, Step
from bayescal._use import code_writer
from bayescal._use.autopilots import AUTOPILOTS
from bayescal._use.compensator import compensator
from bayescal._use.decision import Decisions
from bayescal._use.firmware_parameters import axis_of, firmware_parameters
from bayescal._workbench.origin import Origin
from bayescal._workbench.state import State

SUFFIXES = {format: suffix for suffix, format in code_writer.FORMATS.items()}
FORMATS = (*SUFFIXES, *AUTOPILOTS, "dcc")


def trail_of(path: list[State], final: Step, holdout: Measurements | None) -> SearchPath:
    """The way to a state as `calibrate` leaves one: `final` is its last model by the method asked for."""
    steps = [replace(s.step, discovery=s.discovery) for s in path[:-1]]
    steps.append(replace(final, discovery=path[-1].discovery))
    return SearchPath(*judged(steps), holdout)


def write_report(
    folder: Path,
    origin: Origin,
    own: Mapping[str, Effect],
    certificate: str | Path | None = None,
    decisions: Decisions | None = None,
) -> Path:
    """The report of a folder that a trail was saved to: what `bayescal report FOLDER` writes."""
    instrument, effects = origin.open_instrument(), tuple(own.values())
    given = () if instrument is None else (instrument,)
    chapter = of_folder(folder, effects, given)
    stated = {"certificate": certificate, "decisions": decisions}
    return report([chapter], folder / "report.html", effects=effects, **stated)


def refuse_unknown(what: str) -> None:
    """Refuse a format that is none.

    Raises:
        InputError: it is so.
    """
    if what not in FORMATS:
        raise InputError(f"{what!r} is not one of {', '.join(FORMATS)}")


def write_export(
    folder: Path,
    trail: SearchPath,
    what: str,
    certificate: str | Path | None = None,
    decisions: Decisions | None = None,
) -> Path:
    """One export of the trail's calibration: what `bayescal export FOLDER/calibration.nc --format WHAT` writes.

    Raises:
        InputError: what the export itself refuses.
    """
    refuse_unknown(what)
    made = compensator(trail.calibration)
    if what in SUFFIXES:
        return made.export(folder / f"compensation{SUFFIXES[what]}", what)
    if what == "dcc":
        if certificate is None:
            raise InputError(
                "a digital calibration certificate needs the TOML file of what a certificate states"
            )
        text = dcc_text(trail.final.calibration, certificate, STANDARD_GRAVITY, decisions)
        return write_text(text, folder / "certificate.xml")
    axis = axis_of(trail.final.calibration)
    if axis is None:
        raise InputError(
            "these readings do not say of which axis they are, and an autopilot's parameters need it: export the "
            f"calibration with bayescal export --format {what} --axis gyro_x=FILE"
        )
    return firmware_parameters({axis: made}, what).write(folder / f"{what}.txt")
