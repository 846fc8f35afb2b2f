"""Commands for what the user takes away: compensate, export, budget, decide, report.

Heavy modules load inside the commands.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

import bayescal as bc
from bayescal._cli import options
from bayescal._cli.console import exit_unless, print_notes, print_result
from bayescal._cli.options import (
    ColumnOptions,
    Commands,
    DecisionRule,
    Gravity,
    InUse,
    OwnParts,
    named_numbers,
)
from bayescal._core.as_json import write_json
from bayescal._data.unit_parsing import STANDARD_GRAVITY

commands = Commands()


def exit_unless_reliable(given: Mapping[str, bc.Compensator]) -> None:
    """Leave with status 1 if what was written is of a result that is not to be used."""
    from bayescal._cli.saved import why_not

    told = {name: why_not(compensator) for name, compensator in given.items()}
    exit_unless(not any(told.values()), "; ".join(f"{n} {w}".strip() for n, w in told.items() if w))


def exit_unless_conforms(found: bc.Decisions) -> None:
    """Leave with status 1 where a limit is not met, or that is undecided."""
    open_ = [f"{d.limit} ({d.decision})" for d in found.decisions if d.decision != "accept"]
    if open_:
        print_notes([f"not shown to conform: {', '.join(open_)}"])
        raise typer.Exit(1)


@commands.example("bayescal compensate result/calibration.nc flight.csv --out done.csv")
def compensate(
    *,
    calibration: Annotated[
        Path,
        typer.Argument(
            help="Folder of results, its calibration (.nc), or a JSON export.", show_default=False
        ),
    ],
    file: Annotated[
        Path,
        typer.Argument(help="Readings: text, .parquet, .nc, .xlsx or .mat.", show_default=False),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="File to write, of the same format (Excel, MATLAB: .csv).",
            show_default=False,
        ),
    ],
    first_order: Annotated[
        bool,
        typer.Option(
            "--first-order", help="Propagate mean and covariance, as exports do, not draws."
        ),
    ] = False,
    without_noise: Annotated[
        bool, typer.Option("--without-noise", help="Leave the noise of each reading out.")
    ] = False,
    columns: ColumnOptions,
    own: InUse,
    json_: options.Json = False,
) -> None:
    """Turn readings back into what was measured, with standard uncertainty: two columns more."""
    from bayescal._cli.saved import compensator_from
    from bayescal._use.compensate_file import compensate_file

    chosen = compensator_from(calibration, own)
    how = {**columns.for_read(), "missing": columns.missing or "drop"}
    done = compensate_file(
        chosen,
        file,
        out,
        **how,
        method="first order" if first_order else None,
        noise=not without_noise,
    )
    columns.keep()
    beyond = (
        f"{name} is outside its calibrated range in {count} of {done.rows} readings: an extrapolation there"
        for name, count in done.outside.items()
    )
    flags = (flag for flag in done.flags if "rows dropped" not in flag)
    print_notes((*chosen.notes, *flags, *beyond))
    text = (
        f"{out}: {done.rows} readings, columns {' and '.join(done.columns)} [{chosen.unit}] added"
    )
    gaps = f"; {done.missing} rows are empty, where a reading is missing" * bool(done.missing)
    said = {"file": str(out), "rows": done.rows, "columns": list(done.columns), "unit": chosen.unit}
    counts = {"outside": done.outside, "unsolved": done.unsolved, "missing": done.missing}
    print_result({**said, **counts} if json_ else text + gaps)
    exit_unless(
        done.unsolved == 0, f"{done.unsolved} readings have no solution and are written empty"
    )
    exit_unless_reliable({"": chosen})


@commands.example("bayescal export result/calibration.nc --format c --out gyro.h")
def export(
    *,
    calibrations: Annotated[
        list[Path] | None,
        typer.Argument(
            help="A folder of results, or its calibration (.nc); for parameters, one for each axis."
        ),
    ] = None,
    format_: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="json, c, python or html (a page with sliders), else by the suffix of --out; px4-params or "
            "ardupilot-params; dcc.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File to write; standard output if not given."),
    ] = None,
    axis: Annotated[
        list[str] | None,
        typer.Option(
            "--axis", help="gyro_x=a.nc: calibration of an axis, where its readings do not name it."
        ),
    ] = None,
    device_id: Annotated[
        list[str] | None,
        typer.Option("--device-id", help="gyro=3670026: PX4's number of a sensor; repeat."),
    ] = None,
    local_gravity: Gravity = None,
    certificate: options.Certificate = None,
    limit: options.AlsoLimit = None,
    by: DecisionRule,
    own: InUse,
) -> None:
    """Write the calibration for use elsewhere: C99, Python, JSON, a page, autopilot parameters, a certificate."""
    from bayescal._cli import saved
    from bayescal._core.atomic_file import write_text

    saved.refuse_format(format_, out)
    if format_ in saved.PARAMETERS:
        given = saved.by_axis(calibrations or [], axis, own)
        found = saved.parameters(given, str(format_), device_id, local_gravity or STANDARD_GRAVITY)
        if out is None:
            print(found.text(), end="")
        else:
            print(f"{found}\n\nwritten: {found.write(out)}")
        exit_unless_reliable(given)
        return
    chosen = saved.single(calibrations or [], axis, device_id, own)
    if format_ == saved.DCC:
        gravity = local_gravity or STANDARD_GRAVITY
        text = saved.certified(chosen, certificate, gravity, limit, by)
        print(text.rstrip("\n") if out is None else f"written: {write_text(text, out)}")
        return
    if out is None:
        from bayescal._use import code_writer

        print(code_writer.as_text(chosen.program, str(format_)), end="")
    else:
        print(f"written: {chosen.export(out, format_)}")
    exit_unless_reliable({"": chosen})


@commands.example("bayescal budget result/calibration.nc --at temperature=60")
def budget(
    *,
    calibration: options.Saved,
    at: Annotated[
        list[str] | None,
        typer.Option(
            "--at", help="temperature=60: operating point, in fixed units; repeat for more."
        ),
    ] = None,
    k: Annotated[
        float, typer.Option("-k", help="Coverage factor of the expanded uncertainty.")
    ] = 2.0,
    prior_sensitivity: Annotated[
        bool, typer.Option("--prior-sensitivity", help="Also how much the priors matter (psense).")
    ] = False,
    own: InUse,
    json_: options.Json = False,
) -> None:
    """The uncertainty budget of a compensated value (JCGM 100): who contributes how much."""
    from bayescal._calibration import prior_influence
    from bayescal._cli.saved import compensator_from

    chosen = compensator_from(calibration, own)
    found = bc.budget(chosen, named_numbers(at, "--at"), k=k)
    priors = None
    if prior_sensitivity and chosen.calibration is not None:
        priors = prior_influence.prior_sensitivity(chosen.calibration)
    if json_:
        more = {} if priors is None else {"prior_sensitivity": priors.to_dict("index")}
        print_result({**found.data(), **more})
    else:
        print_result(found)
    if priors is not None and not json_:
        print(f"\nPrior sensitivity (above 0.05 it matters):\n{priors}")
    exit_unless_reliable({"": chosen})


@commands.example('bayescal decide result --limit "bias: ±0.5 °/s"')
def decide(
    *,
    calibration: options.Saved,
    limit: Annotated[
        list[str],
        typer.Option(
            "--limit",
            help='"bias: ±0.5 °/s", "corrected reading: ±0.1 °/s over -20..60 °C"; repeat for more.',
            show_default=False,
        ),
    ],
    by: DecisionRule,
    population: Annotated[
        list[str] | None,
        typer.Option(
            "--population",
            help='Devices of this kind, for global risks: what `bayescal batch --population` wrote, or "sd 0.2 °/s"; '
            'repeat, by name of a limit: "bias: sd 0.2 °/s".',
        ),
    ] = None,
    capability: Annotated[
        float, typer.Option("--capability", help="Least T/(4u) with which 'shared-risk' decides.")
    ] = 3.0,
    conformity: Annotated[
        float,
        typer.Option("--conformity", help="Probability of which the next calibration is stated."),
    ] = 0.95,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="JSON file to write the decisions to.")
    ] = None,
    local_gravity: Gravity = None,
    own: InUse,
    json_: options.Json = False,
) -> None:
    """Does it conform? Decisions about limits, with guard bands, risks and when to calibrate again.

    Exit status: 0 where every limit is met; 1 where one is not, or is undecided.
    """
    from bayescal._cli import saved

    found = bc.decide(
        saved.load_saved(calibration, own),
        limit,
        **vars(by),
        population=saved.population_of(population),
        capability=capability,
        conformity=conformity,
        members=own.members,
        local_gravity=local_gravity or STANDARD_GRAVITY,
    )
    print_result(found.data() if json_ else found)
    if out is not None:
        write_json(found.data(), out, indent=1)
    exit_unless_conforms(found)


@commands.example("bayescal report result -o report.html")
def report(
    *,
    calibrations: Annotated[
        list[Path],
        typer.Argument(
            help="Saved calibrations (.nc), or folders that `bayescal calibrate --out` wrote.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="HTML file to write.")] = Path(
        "report.html"
    ),
    title: Annotated[str, typer.Option("--title", help="Of the report.")] = "",
    certificate: options.Certificate = None,
    limit: options.AlsoLimit = None,
    by: DecisionRule,
    output_unit: options.OutputUnit = None,
    own: OwnParts,
    json_: options.Json = False,
) -> None:
    """Write the report for sign-off: a one-page summary with appendices, in one HTML file."""
    from bayescal._cli import saved
    from bayescal._report.certificate import read_certificate

    stated = read_certificate(certificate) if certificate else None
    given = saved.chapters_from(calibrations, own)
    decided = None
    if limit:
        decided = bc.decide(
            saved.load_decided(calibrations, own),
            limit,
            **vars(by),
        )
    written = bc.report(
        given,
        out,
        title=title,
        certificate=stated,
        decisions=decided,
        output_unit=output_unit,
    )
    reasons = [reason for c in given for reason in c.data["verdict"]["reasons"]]
    print_result({"file": str(written), "chapters": len(given)} if json_ else f"written: {written}")
    exit_unless(all(c.data["verdict"]["ok"] for c in given), " ".join(reasons))
    if decided is not None:
        exit_unless_conforms(decided)
