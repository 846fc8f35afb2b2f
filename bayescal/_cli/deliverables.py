"""Commands for what the user takes away: compensate, export, budget, report.

Heavy modules load inside the commands.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import bayescal as bc
from bayescal._cli import saved
from bayescal._cli.console import Answer, drawn, print_notes
from bayescal._cli.options import (
    ColumnOptions,
    Commands,
    DecisionRule,
    InUse,
    OwnParts,
    named_numbers,
)
from bayescal._core.annex import first_offered, offered
from bayescal._core.errors import InputError
from bayescal._core.flag import code_of

commands = Commands()


@commands.example("bayescal compensate result/calibration.nc flight.csv --out done.csv")
def compensate(
    *,
    calibration: Path,
    file: Path,
    out: Path,
    first_order: bool = False,
    without_noise: bool = False,
    columns: ColumnOptions,
    own: InUse,
) -> Answer:
    """Turn readings back into what was measured."""
    from bayescal._use.compensate_file import compensate_file

    chosen = saved.compensator_from(calibration, own)
    how = {**columns.for_read(), "missing": columns.missing or "drop"}
    method = "first order" if first_order else None
    done = compensate_file(chosen, file, out, **how, method=method, noise=not without_noise)
    columns.keep()
    beyond = (
        f"{name} is outside its calibrated range in {count} of {done.rows} readings: an extrapolation there"
        for name, count in done.outside.items()
    )
    flags = (flag for flag in done.flags if code_of(flag) != "rows.dropped")
    print_notes((*chosen.notes, *flags, *beyond))
    text = (
        f"{out}: {done.rows} readings, columns {' and '.join(done.columns)} [{chosen.unit}] added"
    )
    gaps = f"; {done.missing} rows are empty, where a reading is missing" * bool(done.missing)
    data = {"file": str(out), "rows": done.rows, "columns": list(done.columns), "unit": chosen.unit}
    data |= {
        "epoch": chosen.epoch,
        "outside": done.outside,
        "unsolved": done.unsolved,
        "missing": done.missing,
    }
    judged = saved.reliable({"": chosen})
    if done.unsolved:
        why = f"{done.unsolved} readings have no solution and are written empty"
        judged = {"ok": False, "why": why}
    return Answer(text + gaps, data, **judged)


@commands.example("bayescal export result/calibration.nc --format c --out gyro.h", data=False)
def export(asked: saved.ExportRequest) -> Answer:
    """Write C99, Python, JSON, parameters or a certificate.

    Of three axes too, also YAML; those of a unit together in one file.
    """
    from bayescal._use.correction_files import kinds

    others = {name: write for exports in offered("exports") for name, write in exports().items()}
    known = [*dict.fromkeys((*(name for kind in kinds() for name in kind.writers), *others))]
    if asked.format_ is None and asked.out is None:
        raise InputError(f"say which format: --format {', '.join(known)}")
    if asked.format_ not in (None, *known):
        raise InputError(f"--format {asked.format_!r} is not one of {', '.join(known)}")
    if asked.format_ in others:
        return others[asked.format_](asked)
    given = [one for _, one in asked.loaded()]
    if not given or isinstance(given[0], bc.Compensator):
        asked.refuse_several()
    return asked.written(given)


@commands.example("bayescal budget result/calibration.nc --at temperature=60")
def budget(
    *,
    calibration: Path,
    at: list[str] | None = None,
    k: float = 2.0,
    prior_sensitivity: bool = False,
    own: InUse,
) -> Answer:
    """Split the uncertainty of a compensated value (JCGM 100)."""
    from bayescal._calibration.prior_influence import prior_sensitivity as influence

    chosen = saved.compensator_from(calibration, own)
    found = bc.budget(chosen, named_numbers(at, "--at"), k=k)
    text, data = str(found), found.data()
    if prior_sensitivity and chosen.calibration is not None:
        priors = influence(chosen.calibration)
        text += f"\n\nPrior sensitivity (above 0.05 it matters):\n{priors}"
        data = {**data, "prior_sensitivity": priors.to_dict("index")}
    return Answer(text, data, **saved.reliable({"": chosen}))


@commands.example("bayescal report result -o report.html")
def report(
    *,
    calibrations: list[Path],
    out: Path = Path("report.html"),
    title: str = "",
    certificate: Path | None = None,
    limit: list[str] | None = None,
    by: DecisionRule,
    output_unit: str | None = None,
    own: OwnParts,
) -> Answer:
    """Write the report for sign-off, in one HTML file."""
    stated = decided = None
    if certificate:
        stated = first_offered("certificate", "--certificate")(certificate)
    given = saved.chapters_from(calibrations, own)
    if limit:
        if len(given) != 1:
            raise InputError(
                f"--limit decides about one result, {len(given)} were given: report each by itself"
            )
        decided = first_offered("decided", "--limit")(given[0].used, limit, **vars(by))
    how = {"title": title, "certificate": stated, "output_unit": output_unit}
    whole = drawn(partial(bc.report, given, out, decisions=decided, **how))
    verdicts = [c.data["verdict"] for c in given]
    return Answer(
        f"written: {out}",
        {"file": str(out), "chapters": len(given)},
        ok=all(v["ok"] for v in verdicts),
        why=" ".join(reason for v in verdicts for reason in v["reasons"]),
        doubt=decided.doubt if decided else "",
        pictures=lambda: whole,
    )
