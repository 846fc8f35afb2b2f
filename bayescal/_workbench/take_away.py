"""What a session says of its models and what leaves it: the report and exports, as the command line makes them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bayescal._calibration.compare import compare
from bayescal._calibration.summary import summary
from bayescal._core.errors import InputError
from bayescal._core.formatting import table, with_error
from bayescal._data.unit_conversion import unit_label
from bayescal._model.effect import Effect
from bayescal._report.report import report
from bayescal._report.section import of_folder
from bayescal._search.search_path import SearchPath
from bayescal._use import code_writer
from bayescal._use.compensator import compensator
from bayescal._use.decide import Decisions
from bayescal._use.firmware_parameters import AUTOPILOTS, axis_of, firmware_parameters
from bayescal._workbench.origin import Origin
from bayescal._workbench.state import State

SUFFIXES = {format: suffix for suffix, format in code_writer.FORMATS.items()}
FORMATS = (*SUFFIXES, *AUTOPILOTS)


def side_by_side(one: State, other: State) -> str:
    """`bc.compare` of two states, then their coefficients, noise and shapes with standard uncertainties.

    Raises:
        InputError: they were fitted to other readings.
    """
    fits = {f"{s.number} {s.title}": s.calibration for s in (one, other)}
    values = [
        {t["name"]: with_error(t["mean"], t["sd"]) for told in summary(c) for t in told}
        for c in fits.values()
    ]
    units = {t["name"]: t["unit"] for c in fits.values() for told in summary(c) for t in told}
    rows = [[n, *(v.get(n, "–") for v in values), unit_label(unit)] for n, unit in units.items()]
    return f"{compare(fits)}\n\n{table(['', *fits, 'unit'], rows)}"


def write_report(
    folder: Path, origin: Origin, own: Mapping[str, Effect], decisions: Decisions | None
) -> Path:
    """The report of a folder that a trail was saved to: what `bayescal report FOLDER` writes."""
    instrument, effects = origin.open_instrument(), tuple(own.values())
    given = () if instrument is None else (instrument,)
    chapter = of_folder(folder, effects, given)
    return report([chapter], folder / "report.html", effects=effects, decisions=decisions)


def write_export(folder: Path, trail: SearchPath, what: str) -> Path:
    """One export of the trail's calibration: what `bayescal export FOLDER/calibration.nc --format WHAT` writes.

    Raises:
        InputError: what the export itself refuses.
    """
    made = compensator(trail.calibration)
    if what in SUFFIXES:
        return made.export(folder / f"compensation{SUFFIXES[what]}", what)
    axis = axis_of(trail.final.calibration)
    if axis is None:
        raise InputError(
            "these readings do not say of which axis they are, and an autopilot's parameters need it: export the "
            f"calibration with bayescal export --format {what} --axis gyro_x=FILE"
        )
    return firmware_parameters({axis: made}, what).write(folder / f"{what}.txt")
