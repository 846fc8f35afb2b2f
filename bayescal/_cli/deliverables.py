"""Commands for what the user takes away: compensate, export, budget, report.

Heavy modules load inside the commands.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from typer import Argument

import bayescal as bc
from bayescal._cli import saved
from bayescal._cli.console import Answer, drawn
from bayescal._cli.options import (
    AsJson,
    ColumnOptions,
    Command,
    DecisionRule,
    InUse,
    OwnParts,
    Shared,
    Texts,
    named_numbers,
    opt,
)
from bayescal._core.annex import first_offered, offered
from bayescal._core.atomic_file import write_text
from bayescal._core.errors import InputError
from bayescal._core.progress import print_notes

IN_USE: Any = Argument(help="Folder of results, its calibration (.nc), or a JSON export.")


class CompensateCommand(ColumnOptions, InUse, AsJson, Command):
    """Turn readings back into what was measured."""

    example = "bayescal compensate result/calibration.nc flight.csv --out done.csv"
    in_place = "file"
    calibration: Path = IN_USE
    file: Path = Argument(help="Readings: text, .parquet, .nc, .xlsx or .mat.")
    out: Path = opt(
        "File to write, of the same format (Excel, MATLAB: .csv).", *(..., "--out", "-o")
    )
    first_order: bool = opt("Propagate mean and covariance, as exports do, not draws.", False)
    without_noise: bool = opt("Leave the noise of each reading out.", False)

    def answer(self) -> Answer:
        from bayescal._use.compensate_file import compensate_file

        chosen = saved.compensator_from(self.calibration, self)
        how = {**self.for_read(), "missing": self.missing or "drop"}
        how["method"] = "first order" if self.first_order else None
        done = compensate_file(chosen, self.file, self.out, **how, noise=not self.without_noise)
        self.keep()
        beyond = (
            f"{name} is outside its calibrated range in {count} of {done.rows} readings: an extrapolation there"
            for name, count in done.outside.items()
        )
        flags = (flag for flag in done.flags if getattr(flag, "code", "") != "rows.dropped")
        print_notes((*chosen.notes, *flags, *beyond))
        added = f"columns {' and '.join(done.columns)} [{chosen.unit}] added"
        text = f"{self.out}: {done.rows} readings, {added}"
        text += f"; {done.missing} rows are empty, where a reading is missing" * bool(done.missing)
        data = {"file": str(self.out), "rows": done.rows, "columns": list(done.columns)}
        data |= {"unit": chosen.unit, "epoch": chosen.about.epoch, "outside": done.outside}
        data |= {"unsolved": done.unsolved, "missing": done.missing}
        judged = saved.reliable({"": chosen})
        if done.unsolved:
            why = f"{done.unsolved} readings have no solution and are written empty"
            judged = {"ok": False, "why": why}
        return Answer(text, data, **judged)


class ExportCommand(InUse, DecisionRule, Command):
    """Write C99, Python, JSON, parameters or a certificate.

    Of three axes too, also YAML; those of a unit together in one file.
    """

    example = "bayescal export result/calibration.nc --format c --out gyro.h"
    calibrations: list[Path] = Argument(
        [], help="Folders of results, calibrations (.nc), exports: one, one an axis, or a unit's."
    )
    format_: str | None = opt(
        "json, c or python; of three axes yaml, openvins, realsense, ros; px4-params or ardupilot-params; dcc.",
        *(None, "--format"),
    )
    out: Path | None = opt("File to write; standard output if none.", None, "--out", "-o")
    axis: Texts = opt("gyro_x=a.nc: calibration of an axis, where its readings do not name it.")
    device_id: Texts = opt("gyro=3670026: PX4's number of a sensor; repeat.")
    local_gravity: float | None = Shared.local_gravity
    certificate: Path | None = Shared.certificate
    limit: Texts = Shared.limit
    name: str | None = opt("With which all names in C begin; else that of the instrument.")
    without_uncertainty: bool = opt("C and Python without the coefficients' covariance.", False)

    def answer(self) -> Answer:
        from bayescal._use.correction_files import kinds

        others = {n: write for exports in offered("exports") for n, write in exports().items()}
        known = [*dict.fromkeys((*(name for kind in kinds() for name in kind.writers), *others))]
        if self.format_ is None and self.out is None:
            raise InputError(f"say which format: --format {', '.join(known)}")
        if self.format_ not in (None, *known):
            raise InputError(f"--format {self.format_!r} is not one of {', '.join(known)}")
        if self.format_ in others:
            return others[self.format_](self)
        given = [one for _, one in self.loaded()]
        if not given or isinstance(given[0], bc.Compensator):
            self.refuse_several()
        return self.written(given)

    @property
    def gravity(self) -> float:
        """Local gravity, m/s²."""
        from bayescal._data.unit_conversion import STANDARD_GRAVITY  # loads NumPy

        return self.local_gravity or STANDARD_GRAVITY

    def loaded(self, paths: Sequence[Path] | None = None) -> list[tuple[Path, Any]]:
        """Return files and their corrections; refuse several of which one is of one output."""
        found = [(p, saved.correction_from(p, self)) for p in paths or self.calibrations]
        single = [path for path, one in found if isinstance(one, bc.Compensator)]
        if 0 < len(single) < len(found):
            raise InputError(
                f"{single[0]} is of one output, and others are of three axes: give it alone"
            )
        return found

    def refuse_several(self) -> None:
        """Refuse more than one calibration, or none."""
        named = ", and --axis or --device-id" * bool(self.axis or self.device_id)
        if len(self.calibrations) != 1 or named:
            raise InputError(
                f"a program is of one calibration, {len(self.calibrations)} were given{named}: several, by axis, make "
                "parameters (--format px4-params or ardupilot-params)"
            )

    def written(self, corrections: Sequence[Any]) -> Answer:
        """Write corrections to one file, or give them as text; say what that has no place for."""
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
        return Answer(text.removesuffix("\n"), **saved.reliable(judged))


class BudgetCommand(InUse, AsJson, Command):
    """Split the uncertainty of a compensated value (JCGM 100)."""

    example = "bayescal budget result/calibration.nc --at temperature=60"
    calibration: Path = Shared.calibration
    at: Texts = opt("temperature=60: operating point, in fixed units; repeat for more.")
    k: float = opt("Coverage factor of the expanded uncertainty.", 2.0, "-k")

    def answer(self) -> Answer:
        chosen = saved.compensator_from(self.calibration, self)
        found = bc.budget(chosen, named_numbers(self.at, "--at"), k=self.k)
        return Answer(found, **saved.reliable({"": chosen}))


class ReportCommand(OwnParts, DecisionRule, AsJson, Command):
    """Write the report for sign-off, in one HTML file."""

    example = "bayescal report result -o report.html"
    calibrations: list[Path] = Argument(
        help="Saved calibrations (.nc), or folders that `bayescal calibrate --out` wrote."
    )
    out: Path = opt("HTML file to write.", Path("report.html"), "--out", "-o")
    title: str = opt("Of the report.", "")
    certificate: Path | None = Shared.certificate
    limit: Texts = Shared.limit

    def answer(self) -> Answer:
        stated = decided = None
        if self.certificate:
            stated = first_offered("certificate", "--certificate")(self.certificate)
        given = saved.chapters_from(self.calibrations, self)
        if self.limit:
            if len(given) != 1:
                raise InputError(
                    f"--limit decides about one result, {len(given)} were given: report each by itself"
                )
            decide = first_offered("decided", "--limit")
            decided = decide(given[0].used, self.limit, **self.deciding())
        how = {"title": self.title, "certificate": stated}
        whole = drawn(partial(bc.report, given, self.out, decisions=decided, **how))
        verdicts = [c.data["verdict"] for c in given]
        return Answer(
            f"written: {self.out}",
            {"file": str(self.out), "chapters": len(given)},
            ok=all(v["ok"] for v in verdicts),
            why=" ".join(reason for v in verdicts for reason in v["reasons"]),
            doubt=decided.doubt if decided else "",
            made=whole,
        )


COMMANDS = (CompensateCommand, ExportCommand, BudgetCommand, ReportCommand)
