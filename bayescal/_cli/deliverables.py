"""Commands for what the user takes away: compensate, export, budget, report; and how every command answers.

Heavy modules load inside the commands, as in `main.py`, which offers these with its own.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

import bayescal as bc
from bayescal._cli import options
from bayescal._core.errors import InputError

GRAVITY = 9.80665  # m/s², standard gravity

commands = typer.Typer()


def say(answer: Any) -> None:
    """Data as JSON, anything else as the text that it prints as."""
    if isinstance(answer, dict | list):
        answer = json.dumps(answer, indent=2, ensure_ascii=False, allow_nan=False)
    print(answer)


def leave(ok: bool, why: str) -> None:
    if not ok:
        print(f"bayescal: not to be trusted as it is: {why}", file=sys.stderr)
        raise typer.Exit(1)


@commands.command(
    epilog="Example: bayescal compensate result/calibration.nc flight.csv --out done.csv"
)
def compensate(
    calibration: Annotated[
        Path,
        typer.Argument(help="A saved calibration (.nc), or its JSON export.", show_default=False),
    ],
    file: Annotated[
        Path, typer.Argument(help="Readings: .csv, .parquet or .nc.", show_default=False)
    ],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="File to write, of the same format.", show_default=False),
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
    member: options.Members = None,
    columns: options.Columns = None,
    unit: options.Units = None,
    local_gravity: options.Gravity = GRAVITY,
    effects_file: options.OwnEffects = None,
    instrument: options.OwnInstrument = None,
    json_: options.Json = False,
) -> None:
    """Turn readings back into what was measured, with standard uncertainty: two columns more."""
    from bayescal._cli import arguments
    from bayescal._compensation.compensate_file import compensate_file

    chosen = arguments.compensator_from(calibration, effects_file, instrument, member)
    done = compensate_file(
        chosen,
        file,
        out,
        columns=arguments.pairs(columns, "--columns"),
        units=arguments.pairs(unit, "--unit"),
        local_gravity=local_gravity,
        method="first order" if first_order else None,
        noise=not without_noise,
    )
    for flag in done.flags:
        print(f"bayescal: note: {flag}", file=sys.stderr)
    for name, count in done.outside.items():
        print(
            f"bayescal: note: {name} is outside its calibrated range in {count} of {done.rows} readings: "
            "an extrapolation there",
            file=sys.stderr,
        )
    text = (
        f"{out}: {done.rows} readings, columns {' and '.join(done.columns)} [{chosen.unit}] added"
    )
    said = {"file": str(out), "rows": done.rows, "columns": list(done.columns), "unit": chosen.unit}
    say({**said, "outside": done.outside, "unsolved": done.unsolved} if json_ else text)
    leave(done.unsolved == 0, f"{done.unsolved} readings have no solution and are written as nan")


@commands.command(epilog="Example: bayescal export result/calibration.nc --format c --out gyro.h")
def export(
    calibration: options.Saved,
    format_: Annotated[
        str | None, typer.Option("--format", help="json, c or python; else by the suffix of --out.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File to write; standard output if not given."),
    ] = None,
    member: options.Members = None,
    effects_file: options.OwnEffects = None,
    instrument: options.OwnInstrument = None,
) -> None:
    """Write the compensation for firmware: a C99 header, a Python function, or JSON."""
    from bayescal._cli import arguments
    from bayescal._compensation import code_writer

    if format_ is None and out is None:
        raise InputError("say which format: --format json, c or python")
    if format_ not in (None, "json", "c", "python"):
        raise InputError(f"--format {format_!r} is not one of json, c, python")
    chosen = arguments.compensator_from(calibration, effects_file, instrument, member)
    if out is None:
        print(code_writer.as_text(chosen.program, str(format_)), end="")
        return
    print(f"written: {chosen.export(out, format_)}")


@commands.command(epilog="Example: bayescal budget result/calibration.nc --at temperature=60")
def budget(
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
    member: options.Members = None,
    effects_file: options.OwnEffects = None,
    instrument: options.OwnInstrument = None,
    json_: options.Json = False,
) -> None:
    """The uncertainty budget of a compensated value (JCGM 100): who contributes how much."""
    from bayescal._cli import arguments
    from bayescal._diagnostics import prior_influence

    chosen = arguments.compensator_from(calibration, effects_file, instrument, member)
    found = bc.budget(chosen, arguments.numbers(at, "--at"), k=k)
    priors = None
    if prior_sensitivity and chosen.calibration is not None:
        priors = prior_influence.prior_sensitivity(chosen.calibration)
    if json_:
        more = {} if priors is None else {"prior_sensitivity": priors.to_dict("index")}
        say({**found.data(), **more})
        return
    say(found)
    if priors is not None:
        print(f"\nPrior sensitivity (above 0.05 it matters):\n{priors}")


@commands.command(epilog="Example: bayescal report result -o report.html")
def report(
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
    effects_file: options.OwnEffects = None,
    instrument: options.OwnInstrument = None,
    json_: options.Json = False,
) -> None:
    """Write the report to sign: one HTML file that needs nothing else."""
    from bayescal._cli import arguments

    given = arguments.chapters_from(calibrations, effects_file, instrument)
    written = bc.report(given, out, title=title)
    reasons = [reason for c in given for reason in c.data["verdict"]["reasons"]]
    say({"file": str(written), "chapters": len(given)} if json_ else f"written: {written}")
    leave(all(c.data["verdict"]["ok"] for c in given), " ".join(reasons))
