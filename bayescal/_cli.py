"""The command line. Exit status 0 done, 1 not converged or the noise gate failed (results still written), 2 bad input.

Heavy modules load inside the commands, so that `bayescal --help` answers at once.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import bayescal as bc
from bayescal._errors import BayescalError, InputError, NotConverged

if TYPE_CHECKING:
    from bayescal._measurements import Measurements

app = typer.Typer(
    name="bayescal",
    help="Bayesian calibration of inertial and tilt sensors: compare, see where the model fails, find the "
    "missing effect, add it, watch the error fall.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)

Files = Annotated[list[Path], typer.Argument(help="CSV, Parquet or NetCDF files of readings.", show_default=False)]
Name = Annotated[
    str, typer.Option("--instrument", help="Name of an installed instrument, or my.py:INSTRUMENT.", show_default=False)
]
Columns = Annotated[list[str] | None, typer.Option("--columns", help="output=gyro_x: our column = the file's.")]
Units = Annotated[list[str] | None, typer.Option("--unit", help="gyro_x=rad/s: unit of a column.")]
Gravity = Annotated[float, typer.Option(help="Local gravity, m/s², for files in m/s².")]
Fix = Annotated[
    list[str] | None, typer.Option("--fix", help="bias.temperature=0.041: hold an unknown at a value, in its unit.")
]
Ref = Annotated[list[str] | None, typer.Option("--reference", help="T0=0: reference temperature of the bases, °C.")]
Add = Annotated[list[str] | None, typer.Option("--add", help="Effect to add to the baseline; repeat for more.")]
Structure = Annotated[str | None, typer.Option(help="A model structure of the instrument in place of its baseline.")]
Effects = Annotated[Path | None, typer.Option("--effects", help="Python file that defines EFFECTS of your own.")]
MethodName = Annotated[str, typer.Option("--method", help="marginal, least-squares or nuts.")]
Seed = Annotated[int, typer.Option(help="Seed of every random number.")]
Out = Annotated[Path | None, typer.Option("--out", help="Folder to write to.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


def main() -> None:
    """Run the command line; every refusal is a sentence on stderr, never a traceback."""
    try:
        app(standalone_mode=False)
    except NotConverged as error:
        _fail(str(error), 1)
    except BayescalError as error:
        _fail(str(error), 2)
    except typer.Exit as exit_:
        sys.exit(exit_.exit_code)
    except typer.Abort:
        _fail("stopped.", 1)
    except Exception as error:
        usage = getattr(error, "format_message", None)
        if usage is None:
            raise
        _fail(usage(), 2)


def _fail(message: str, status: int) -> None:
    print(f"bayescal: {message}", file=sys.stderr)
    sys.exit(status)


@app.command(epilog="Example: bayescal instruments")
def instruments(json_: Json = False) -> None:
    """List the installed instruments."""
    from bayescal._store import installed_instruments
    from bayescal._text import table

    known = installed_instruments()
    if json_:
        return _print_json(
            {n: {"title": i.title, "source": i.source, "unit": i.unit, "columns": [c.name for c in i.columns]}
             for n, i in known.items()}
        )
    print(table(["instrument", "measures", "output"], [[n, i.title, i.unit] for n, i in known.items()], left=3))


@app.command(epilog="Example: bayescal effects --instrument mems_gyro")
def effects(instrument: Name, effects_file: Effects = None, json_: Json = False) -> None:
    """List an instrument's effects: equation, unit, plausible size, columns needed, source."""
    from bayescal._doors import instrument_named, user_effects
    from bayescal._text import number, table
    from bayescal._units import pretty

    chosen = instrument_named(instrument)
    rows, data = [], []
    for effect in (*chosen.effects, *chosen.candidates, *user_effects(effects_file)):
        kind = "baseline" if effect in chosen.effects else "candidate"
        first = effect.coefficients[0]
        rows.append(
            [effect.name, kind, effect.equation, f"{number(first.size)} {pretty(first.unit)}",
             ", ".join(effect.columns) or "–", effect.source]
        )
        data.append(
            {"name": effect.name, "kind": kind, "equation": effect.equation, "size": first.size,
             "unit": first.unit, "columns": list(effect.columns), "source": effect.source}
        )
    if json_:
        return _print_json(data)
    print(table(["effect", "", "equation", "plausible size", "needs", "source"], rows, left=6))


@app.command(epilog="Example: bayescal simulate --instrument mems_gyro --effect bias.thermal_lag=0.05 --out sim.csv")
def simulate(
    instrument: Name,
    out: Annotated[Path, typer.Option("--out", help="File to write: .csv, .parquet or .nc.")],
    effect: Annotated[list[str] | None, typer.Option("--effect", help="name=size: a hidden effect.")] = None,
    noise_law: Annotated[str, typer.Option(help="white, student_t or ornstein_uhlenbeck.")] = "white",
    seed: Seed = 0,
    json_: Json = False,
) -> None:
    """Simulate a test campaign, with effects hidden in it if you like."""
    from bayescal._doors import instrument_named, numbers

    chosen = instrument_named(instrument)
    if chosen.simulate is None:
        raise InputError(f"instrument {chosen.name!r} has no simulator")
    hidden = numbers(effect, "--effect")
    try:
        readings = chosen.simulate(hidden, seed=seed, noise_law=noise_law)
    except ValueError as error:
        raise InputError(str(error)) from None
    readings.write(out)
    said = {"file": str(out), "rows": len(readings), "seed": seed, "effects": hidden}
    _print_json(said) if json_ else print(f"{out}: {len(readings)} readings, seed {seed}")


@app.command(epilog="Example: bayescal fit table.csv --instrument mems_gyro --out result")
def fit(
    files: Files, instrument: Name, columns: Columns = None, unit: Units = None,
    local_gravity: Gravity = 9.80665, fix: Fix = None, reference: Ref = None, add: Add = None,
    structure: Structure = None, effects_file: Effects = None, method: MethodName = "marginal",
    seed: Seed = 0, out: Out = None, json_: Json = False,
) -> None:
    """Fit one model: coefficients with uncertainty."""
    from bayescal import _doors as doors
    from bayescal._result import clean
    from bayescal._summary import null_directions, summary

    asked = doors.Request(instrument, columns, unit, local_gravity, fix, reference, add, structure, effects_file)
    _, model, readings = doors.open_up(asked, files)
    _say_flags(readings)
    found = bc.fit(model, readings, doors.method_named(method), seed=seed, strict=False,
                   reference=doors.reference_of(asked))
    if out is not None:
        found.save(doors.folder(out) / "calibration.nc")
    coefficients, spreads = summary(found)
    if json_:
        _print_json(clean({"coefficients": coefficients, "spreads": spreads, "reference": found.reference,
                           "log_evidence": found.log_evidence, "verdict": vars(found.verdict),
                           "identifiability": {"null_directions": null_directions(found)}}))
    else:
        print(found)
    _leave(found.verdict.ok)


@app.command(epilog="Example: bayescal check result/calibration.nc")
def check(calibration: Annotated[Path, typer.Argument(help="A saved calibration.")],
          effects_file: Effects = None, json_: Json = False) -> None:
    """Where a fitted model fails."""
    from bayescal._result import check_data, clean

    found = bc.check(_load(calibration, effects_file))
    _print_json(clean(check_data(found, 0))) if json_ else print(found)


@app.command(epilog="Example: bayescal discover result/calibration.nc")
def discover(calibration: Annotated[Path, typer.Argument(help="A saved calibration.")],
             effects_file: Effects = None, max_effects: int = 5, json_: Json = False) -> None:
    """Which effect is missing from a fitted model."""
    from bayescal._doors import user_effects
    from bayescal._result import clean, missing_data

    loaded = _load(calibration, effects_file)
    found = bc.discover(loaded, effects=user_effects(effects_file), max_effects=max_effects)
    _print_json(clean(missing_data(found, 0, bc.check(loaded)))) if json_ else print(found)


@app.command(epilog="Example: bayescal compare table.csv --instrument mems_gyro --structure line --structure quadratic")
def compare(
    files: Files, instrument: Name,
    structure: Annotated[list[str] | None, typer.Option(help="Structures to set side by side; all if none.")] = None,
    columns: Columns = None, unit: Units = None, local_gravity: Gravity = 9.80665, reference: Ref = None,
    method: MethodName = "marginal", seed: Seed = 0, json_: Json = False,
) -> None:
    """Set model structures side by side: left-out groups, leave-one-out, evidence, weights."""
    from bayescal import _doors as doors
    from bayescal._result import clean

    asked = doors.Request(instrument, columns, unit, local_gravity, None, reference, None, None, None)
    chosen, _, readings = doors.open_up(asked, files)
    _say_flags(readings)
    names = structure or [name for name, _ in chosen.structures]
    fits = {
        name: bc.fit(doors.structure_named(chosen, name), readings, doors.method_named(method), seed=seed,
                     strict=False, reference=doors.reference_of(asked))
        for name in names
    }
    found = bc.compare(fits)
    _print_json(clean({"rows": [vars(r) for r in found.rows], "group": found.group, "groups": found.groups,
                       "chosen_by": found.chosen_by, "warnings": found.warnings})) if json_ else print(found)
    failed = [n for n, c in fits.items() if not c.verdict.ok]
    for name in failed:
        print(f"{name}: {fits[name].verdict}", file=sys.stderr)
    _leave(not failed)


@app.command(epilog="Example: bayescal predict result/calibration.nc new.csv --out predicted.csv")
def predict(
    calibration: Annotated[Path, typer.Argument(help="A saved calibration.")], files: Files,
    out: Annotated[Path | None, typer.Option("--out", help="CSV to write.")] = None,
    columns: Columns = None, unit: Units = None, local_gravity: Gravity = 9.80665,
    effects_file: Effects = None, json_: Json = False,
) -> None:
    """Predict readings with a calibration, and compare."""
    from bayescal import _doors as doors
    from bayescal._text import number
    from bayescal._units import pretty

    loaded = _load(calibration, effects_file)
    readings = doors.read_files(loaded.model.instrument, files, columns, unit, local_gravity)
    _say_flags(readings)
    found = bc.predict(loaded, readings)
    if out is not None:
        doors.write_prediction(found, readings, out)
    if json_:
        return _print_json({"rows": len(readings), "rmse": found.rmse, "unit": loaded.unit})
    print(f"{len(readings)} readings, rmse {number(found.rmse)} {pretty(loaded.unit)}")


@app.command(epilog="Example: bayescal calibrate readings.csv --instrument mems_gyro --out result")
def calibrate(
    files: Files, instrument: Name,
    holdout: Annotated[list[Path] | None, typer.Option(help="Readings kept apart; read after the last step.")] = None,
    columns: Columns = None, unit: Units = None, local_gravity: Gravity = 9.80665, fix: Fix = None,
    reference: Ref = None, add: Add = None, structure: Structure = None, effects_file: Effects = None,
    method: MethodName = "marginal", max_effects: int = 5, seed: Seed = 0, out: Out = None, json_: Json = False,
) -> None:
    """The whole loop: fit, see where it fails, find what is missing, add it, watch the error fall."""
    from bayescal import _doors as doors
    from bayescal._result import result

    asked = doors.Request(instrument, columns, unit, local_gravity, fix, reference, add, structure, effects_file)
    chosen, model, readings = doors.open_up(asked, files)
    kept = doors.read_files(chosen, holdout, columns, unit, local_gravity) if holdout else None
    _say_flags(readings)
    folder = doors.folder(out) if out is not None else None
    trail = bc.calibrate(
        model, readings, holdout=kept, effects=doors.user_effects(effects_file),
        method=doors.method_named(method), max_effects=max_effects, seed=seed,
        reference=doors.reference_of(asked),
    )
    if folder is not None:
        trail.save(folder)
    if json_:
        _print_json(result(trail))
    else:
        _print_trail(trail)
        if folder is not None:
            print(f"\nwritten: {folder}/result.json, calibration.nc, loop.png")
    _leave(trail.ok)


@app.command(epilog="Example: bayescal demo --out demo_output")
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder to write to.")] = Path("demo_output"),
    instrument: Annotated[str, typer.Option("--instrument", help="Whose demonstration.")] = "mems_gyro",
    seed: Seed = 0,
) -> None:
    """A gyroscope's table against its published line, then a hidden effect found and added."""
    from bayescal import _doors as doors

    chosen = doors.instrument_named(instrument)
    if chosen.demo is None:
        raise InputError(f"instrument {chosen.name!r} has no demonstration")
    chosen.demo(doors.folder(out), seed)


def _print_trail(trail: Any) -> None:
    first, final = trail.steps[0], trail.final
    print("WHERE THE FIRST MODEL FAILS\n")
    print(first.check)
    for i, step in enumerate(trail.steps):
        print(f"\nWHAT IS MISSING FROM STEP {i} ({step.added or 'baseline'})\n")
        print(step.discovery if step.discovery else "no probabilities: " + " ".join(step.calibration.verdict.reasons))
    print("\nTHE ERROR, STEP BY STEP\n")
    print(trail)
    print("\nCOEFFICIENTS\n")
    print(final.calibration)
    print(f"\ngate: {trail.gate.reason}")


def _say_flags(readings: Measurements) -> None:
    for flag in readings.flags:
        print(f"bayescal: note: {flag}", file=sys.stderr)


def _load(path: Path, effects_file: Path | None) -> Any:
    from bayescal._doors import user_effects

    return bc.load(path, effects=user_effects(effects_file))


def _print_json(data: Any) -> None:
    print(json.dumps(data, indent=2, ensure_ascii=False))


def _leave(ok: bool) -> None:
    if not ok:
        raise typer.Exit(1)


if __name__ == "__main__":
    main()
